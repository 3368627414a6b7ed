"""Gauss-Newton tracking: normal equations against autograd, recovery of a known pose, determinism."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import constant_speed, pose7_to_matrix, rotation_angle
from spslam.ops.gauss_newton import _SCALARS
from tests.ops.arguments import opcheck
from tests.ops.scenes import INTRINSICS, TRUNCATION, corner_pixels, make_scene
from tests.ops.tracking_scene import OPTIONS, POSE, moved_pose, pose7, surface_equations


def test_normal_equations_are_those_of_autograd(device, generator):
    """H and g from the Jacobian that autograd finds through the SDF's own gradient."""
    scene = make_scene(generator, random_decoder=True, device=device)
    records = corner_pixels(POSE, generator, 400)
    residual, jacobian, weight, inlier = surface_equations(scene, records, 0.03)
    h, g, cost, inliers = (
        t.cpu()
        for t in ops.gauss_newton_poses(
            scene, records[None].to(device), pose7(POSE, device)[None], INTRINSICS, truncation=TRUNCATION, kernel=0.03
        )
    )
    want = torch.einsum("n,ni,nj->ij", weight, jacobian, jacobian)
    # A point that rounding puts on the other side of a voxel's face has another gradient: allow the share of a few.
    assert torch.allclose(h[0].double(), want, rtol=0, atol=2e-3 * want.abs().max())
    want_g = torch.einsum("n,n,ni->i", weight, residual, jacobian)
    assert torch.allclose(g[0].double(), want_g, rtol=0, atol=5e-3 * want_g.abs().max())
    assert torch.isclose(cost[0].double(), (weight * residual**2).sum() / weight.sum(), rtol=1e-3)
    assert torch.isclose(inliers[0].double(), inlier.double().mean(), atol=0.01)


@pytest.mark.parametrize("shift_m, angle_deg", [(0.0, 0.0), (0.02, 2.0), (0.04, 3.0)])
def test_recovers_the_pose(device, generator, shift_m, angle_deg):
    scene = make_scene(generator, random_decoder=False, device=device)
    records = corner_pixels(POSE, generator).to(device)
    start = moved_pose(POSE, shift_m * np.array([0.6, -0.64, 0.48]), np.radians(angle_deg))
    pose, stats, hessian = ops.track_gauss_newton(scene, records, pose7(start, device), INTRINSICS, OPTIONS)
    found = pose7_to_matrix(pose.cpu().double().numpy())
    assert np.linalg.norm(found[:3, 3] - POSE[:3, 3]) < 2e-3
    assert np.degrees(rotation_angle(found[:3, :3].T @ POSE[:3, :3])) < 0.1
    assert stats.shape == (8, 7) and float(stats[-1, 1]) > 0.8
    assert torch.linalg.eigvalsh(hessian.cpu().double()).min() > 0


# Between devices: other orders of float32 sums; with tf32, factors of 10 bits in the decoder.
FLOAT32_POSE = dict(rtol=0, atol=1e-5)
TF32_POSE = dict(rtol=0, atol=2e-4)
FLOAT32_SUMS, TF32_SUMS = 1e-4, 5e-3  # of the largest


@pytest.mark.parametrize("tf32", [False, True])
@pytest.mark.parametrize("num_pixels", [50, 1024, 1100, 5000])
def test_devices_agree(device, generator, tf32, num_pixels):
    """Whole and part tiles, one per warp and several."""
    scene = make_scene(generator, random_decoder=False, device=device)
    records, start = corner_pixels(POSE, generator), pose7(moved_pose(POSE, 0.01, 0.02))
    options = replace(OPTIONS, num_pixels=num_pixels)
    on_cpu = make_scene(torch.Generator().manual_seed(0), random_decoder=False)
    want = ops.track_gauss_newton(on_cpu, records, start, INTRINSICS, options)
    options = replace(options, tf32=tf32)
    got = ops.track_gauss_newton(scene, records.to(device), start.to(device), INTRINSICS, options)
    pose, stats, hessian = (tensor.cpu() for tensor in got)
    torch.testing.assert_close(pose, want[0], **(TF32_POSE if tf32 else FLOAT32_POSE))
    bound = TF32_SUMS if tf32 else FLOAT32_SUMS
    assert torch.allclose(hessian, want[2], rtol=0, atol=bound * float(want[2].abs().max()))
    # A point that rounding moves over the border of the inliers counts as one of the pixels.
    assert torch.allclose(stats[:, 1], want[1][:, 1], rtol=0, atol=2 / num_pixels)
    assert torch.allclose(stats[:, 4], want[1][:, 4], rtol=0, atol=2 / num_pixels + bound)


def test_same_bits_every_time(device, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    records = corner_pixels(POSE, generator).to(device)
    start = pose7(moved_pose(POSE, 0.01, 0.02), device)
    options = replace(OPTIONS, num_pixels=3000)
    first = ops.track_gauss_newton(scene, records, start, INTRINSICS, options)
    for _ in range(9):
        again = ops.track_gauss_newton(scene, records, start, INTRINSICS, options)
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_support_is_the_mean_weight(device, generator):
    """At the true pose every mapped pixel weighs one; off the map none does."""
    scene = make_scene(generator, random_decoder=False, device=device)
    records = corner_pixels(POSE, generator).to(device)
    _, stats, _ = ops.track_gauss_newton(scene, records, pose7(POSE, device), INTRINSICS, OPTIONS)
    inliers, support = stats[-1, 1].item(), stats[-1, 4].item()
    assert 0.95 * inliers < support <= inliers + 1e-6


@pytest.mark.parametrize("shift_m, angle_deg", [(0.0, 0.0), (0.03, 2.0), (0.5, 80.0)])
def test_prediction_is_constant_speed(device, shift_m, angle_deg):
    before, last = POSE, moved_pose(POSE, shift_m * np.array([0.6, -0.64, 0.48]), np.radians(angle_deg))
    predicted = ops.predict_pose(pose7(before, device), pose7(last, device)).cpu()
    torch.testing.assert_close(predicted, pose7(constant_speed(before, last)))
    assert predicted[0] >= 0


@pytest.mark.parametrize("shift_m, angle_deg", [(0.0, 0.0), (0.03, 2.0), (0.03, 0.0), (0.5, 25.0)])
def test_a_camera_at_constant_speed_goes_on_as_far_as_the_time_is_long(device, shift_m, angle_deg):
    first = POSE
    second = moved_pose(POSE, shift_m * np.array([0.6, -0.64, 0.48]), np.radians(angle_deg))
    third = constant_speed(first, second)
    fourth = constant_speed(second, third)
    fifth = constant_speed(third, fourth)
    for before, last, steps, expected in (
        (first, second, 2.0, fourth),
        (second, fourth, 0.5, fifth),
        (first, third, 1.0, fifth),
        (first, second, 3.0, fifth),
    ):
        predicted = ops.predict_pose(pose7(before, device), pose7(last, device), steps).cpu()
        torch.testing.assert_close(predicted, pose7(expected), rtol=1e-5, atol=2e-6)
    for steps in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="predict_pose: steps must be above 0 and finite, got"):
            ops.predict_pose(pose7(first, device), pose7(second, device), steps)


def test_same_bits_for_any_number_of_threads(generator):
    scene = make_scene(generator, random_decoder=False)
    records = corner_pixels(POSE, generator)
    start = pose7(moved_pose(POSE, 0.01, 0.02))
    results = []
    threads = torch.ops.spslam.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.ops.spslam.set_num_threads(count)
            results.append(ops.track_gauss_newton(scene, records, start, INTRINSICS, OPTIONS))
    finally:
        torch.ops.spslam.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_outside_the_map_nothing_moves(device, generator):
    scene = make_scene(generator, random_decoder=False, device=device)
    far = POSE.copy()
    far[:3, 3] += 50
    records = corner_pixels(POSE, generator).to(device)
    start = pose7(far, device)
    pose, stats, _ = ops.track_gauss_newton(scene, records, start, INTRINSICS, OPTIONS)
    assert torch.allclose(pose, start, atol=1e-6)
    assert bool((stats[:, 1] == 0).all())


def test_no_frames(device, generator):
    scene = make_scene(generator, random_decoder=False, device=device)
    pixels, poses = torch.zeros(0, 5, 3, dtype=torch.int32, device=device), torch.zeros(0, 7, device=device)
    h, g, cost, inliers = ops.gauss_newton_poses(scene, pixels, poses, INTRINSICS, truncation=0.08, kernel=0.02)
    assert h.shape == (0, 6, 6) and g.shape == (0, 6) and cost.shape == inliers.shape == (0,)


def test_arguments_are_named(generator):
    scene = make_scene(generator, random_decoder=False)
    records = corner_pixels(POSE, generator)
    with pytest.raises(ValueError, match="track_gauss_newton: iterations must be at least 1, got 0"):
        ops.track_gauss_newton(scene, records, pose7(POSE), INTRINSICS, replace(OPTIONS, iterations=0))
    with pytest.raises(ValueError, match="track_gauss_newton: kernel_end must be positive, got -0.1"):
        ops.track_gauss_newton(scene, records, pose7(POSE), INTRINSICS, replace(OPTIONS, kernel_end=-0.1))
    with pytest.raises(ValueError, match="track_gauss_newton: score_kernel must be positive, got 0"):
        ops.track_gauss_newton(scene, records, pose7(POSE), INTRINSICS, replace(OPTIONS, score_kernel=0))
    with pytest.raises(ValueError, match=r"track_gauss_newton: frame must be in \[0, 2\^32 - 1\], got -1"):
        ops.track_gauss_newton(scene, records, pose7(POSE), INTRINSICS, replace(OPTIONS, frame=-1))
    with pytest.raises(ValueError, match=r"predict_pose: before must have shape \[7\], got \[8\]"):
        ops.predict_pose(torch.zeros(8), torch.zeros(7))
    with pytest.raises(ValueError, match="track_gauss_newton: pixels must have at least one row, got 0"):
        ops.track_gauss_newton(scene, records[:0], pose7(POSE), INTRINSICS, OPTIONS)


@pytest.mark.parametrize("place, name, length", [(1, "scalars", 10), (2, "integers", 6)])
def test_the_op_counts_its_numbers(place, name, length, generator):
    """Python and C++ name the places of the same lists: one that is longer in one of them is refused."""
    scene = ops.SceneView.empty()
    arguments = [[corner_pixels(POSE, generator, 50), pose7(POSE)], *OPTIONS.arguments(INTRINSICS), [], [], [], [], []]
    arguments[place] = [*arguments[place], 0]
    with pytest.raises(RuntimeError, match=f"track_gauss_newton: {name} must have {length} numbers, got {length + 1}"):
        torch.ops.spslam.track_gauss_newton(*scene.arguments(), *arguments)


def test_opcheck(device, generator):
    scene = make_scene(generator, random_decoder=False)
    records, pose = corner_pixels(POSE, generator, 50), pose7(POSE)
    options = replace(OPTIONS, num_pixels=32, iterations=2)
    frame = [records, pose, torch.rand(4)]
    call = (*scene.arguments(), frame, *options.arguments(INTRINSICS), [], [], [], [], [])
    opcheck(torch.ops.spslam.track_gauss_newton.default, call, device)
    opcheck(torch.ops.spslam.predict_pose.default, (pose, pose, 2.5), device)
    arguments = (records[None], pose[None], list(INTRINSICS), 0.08, 0.02)
    opcheck(torch.ops.spslam.gauss_newton_poses.default, (*scene.arguments(), *arguments), device)


HEADER = Path(__file__).parents[2] / "csrc/include/spslam/gauss_newton.h"


@pytest.mark.skipif(not HEADER.exists(), reason="the tests stand without the sources")
def test_python_and_cpp_list_the_same_scalars_in_the_same_order():
    assert re.findall(r"  FIELD\(\w+, (\w+)\)", HEADER.read_text()) == list(_SCALARS)
