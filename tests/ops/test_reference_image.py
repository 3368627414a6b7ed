"""Tracking beyond the plain surface: weights by depth, a kernel for the statistics, colors of an earlier frame."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import pose7_to_matrix, rotation_angle
from tests.ops.scenes import INTRINSICS, corner_pixels, make_scene
from tests.ops.tracking_scene import (
    ONE_STEP,
    OPTIONS,
    POSE,
    camera_points,
    certainties,
    corner_depth,
    drawn_pixels,
    moved_points,
    moved_pose,
    noise_model,
    pose7,
    surface_equations,
)

NOISES = [None, (0.0, 4e-5), (1e-6, 1e-6)]


@pytest.mark.parametrize("noise", NOISES)
def test_far_pixels_weigh_less(device, generator, noise):
    """By their variance in the equations, which are told at a mean weight of 1; the fit doesn't know of it."""
    noise = None if noise is None else noise_model(*noise, device=device)
    scene = make_scene(generator, random_decoder=True, device=device)
    records = corner_pixels(POSE, generator, 400)
    drawn = drawn_pixels(records)
    residual, jacobian, weight, _ = surface_equations(scene, drawn, 0.03)
    depth = camera_points(drawn)[:, 2]
    certain = weight * certainties(noise, depth)[0]
    options = replace(ONE_STEP, tf32=False)
    _, stats, hessian = ops.track_gauss_newton(
        scene, records.to(device), pose7(POSE, device), INTRINSICS, options, noise=noise
    )
    want = torch.einsum("n,ni,nj->ij", certain, jacobian, jacobian) * weight.sum() / certain.sum()
    assert torch.allclose(hessian.cpu().double(), want, rtol=0, atol=2e-3 * want.abs().max())
    assert stats[0, 0].item() == pytest.approx(float((weight * residual**2).sum() / weight.sum()), rel=1e-3)
    assert stats[0, 4].item() == pytest.approx(float(weight.mean()), rel=2e-3)


@pytest.mark.parametrize("noise", NOISES)
def test_statistics_have_a_kernel_of_their_own(device, generator, noise):
    """The step is that of the iteration's kernel; the fit and the size of the equations are those of the other."""
    noise = None if noise is None else noise_model(*noise, device=device)
    scene = make_scene(generator, random_decoder=True, device=device)
    records = corner_pixels(POSE, generator, 400)
    drawn = drawn_pixels(records)
    residual, jacobian, weight, _ = surface_equations(scene, drawn, 0.03)
    score_weight = surface_equations(scene, drawn, 0.05)[2]
    depth = camera_points(drawn)[:, 2]
    certain = weight * certainties(noise, depth)[0]
    arguments = scene, records.to(device), pose7(POSE, device), INTRINSICS
    options = replace(ONE_STEP, tf32=False)
    pose, plain, _ = ops.track_gauss_newton(*arguments, options, noise=noise)
    same_pose, stats, hessian = ops.track_gauss_newton(*arguments, replace(options, score_kernel=0.05), noise=noise)
    assert torch.equal(pose, same_pose)
    assert torch.equal(plain[:, 1:4], stats[:, 1:4])
    assert stats[0, 0].item() == pytest.approx(float((score_weight * residual**2).sum() / score_weight.sum()), rel=1e-3)
    assert stats[0, 4].item() == pytest.approx(float(score_weight.mean()), rel=2e-3)
    want = torch.einsum("n,ni,nj->ij", certain, jacobian, jacobian) * score_weight.sum() / certain.sum()
    assert torch.allclose(hessian.cpu().double(), want, rtol=0, atol=2e-3 * want.abs().max())


def test_statistics_take_the_iterations_own_kernel_where_none_is_named(device, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    arguments = scene, corner_pixels(POSE, generator, 400).to(device), pose7(POSE, device), INTRINSICS
    plain = ops.track_gauss_newton(*arguments, ONE_STEP)
    named = ops.track_gauss_newton(*arguments, replace(ONE_STEP, score_kernel=ONE_STEP.kernel_end))
    assert all(torch.equal(one, other) for one, other in zip(plain, named, strict=True))


CELL_PX = 2


def _reference(pose, device="cpu", weight=0.3):
    """The corner, painted with smooth waves, as a camera at `pose` (float64 [4, 4]) sees it in cells."""
    intrinsics = ops.Intrinsics(INTRINSICS.fx / CELL_PX, INTRINSICS.fy / CELL_PX, 15.5, 11.5)
    depth = corner_depth(pose, intrinsics, 24, 32)
    v, u = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    rays = torch.stack(
        [(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, torch.ones(24, 32)], -1
    )
    points = rays.double() @ torch.from_numpy(pose[:3, :3]).T * depth[..., None] + torch.from_numpy(pose[:3, 3])
    cells = torch.stack([_paint(points), depth], -1).float().to(device)
    return ops.ReferenceImage(cells, pose7(pose, device), intrinsics, weight, kernel=0.4)


def _paint(points):
    return 0.5 + 0.2 * torch.sin(6 * points).sum(-1) / 3


def _painted(records):
    """The records with the color of the waves where a camera at POSE sees them."""
    gray = _paint(moved_points(camera_points(records), torch.zeros(6, dtype=torch.float64)))
    level = (255 * gray).round().int()
    return torch.stack([records[:, 0], records[:, 1], level | level << 8 | level << 16], 1)


def _intensity_equations(reference, records):
    """Jacobian [P, 6] (m) by autograd through torch's bilinear sampling, and weight [P], at POSE."""
    local, gray = camera_points(records), (records[:, 2] & 0xFF).double() / 255
    cells, k = reference.cells.cpu().double(), reference.intrinsics
    pose = torch.from_numpy(pose7_to_matrix(reference.pose.cpu().double().numpy()))
    size = torch.tensor([cells.shape[1] - 1, cells.shape[0] - 1], dtype=torch.float64)

    def seen(increment):
        return (moved_points(local, increment) - pose[:3, 3]) @ pose[:3, :3]

    def place(increment):
        x, y, z = seen(increment).unbind(-1)
        return torch.stack([x / z * k.fx + k.cx, y / z * k.fy + k.cy], -1)

    def difference(uv):
        grid = (2 * uv / size - 1)[None, None]
        image = cells[None, ..., 0][None]
        return torch.nn.functional.grid_sample(image, grid, align_corners=True)[0, 0, 0] - gray

    zero = torch.zeros(6, dtype=torch.float64)
    uv = place(zero).requires_grad_()
    left_top, depth = uv.detach().floor().long(), seen(zero)[:, 2]
    inside = ((left_top >= 0) & (left_top < size.long())).all(1)
    u, v = torch.where(inside[:, None], left_top, 0).unbind(1)
    corners = torch.stack([cells[v + dv, u + du, 1] for dv in (0, 1) for du in (0, 1)])
    agrees = inside & ((corners - depth).abs() < 0.1 * depth).all(0)
    value = difference(uv)
    (slope,) = torch.autograd.grad(value.sum(), uv)
    weight = (1 / (1 + (value.detach() / reference.kernel) ** 2)) ** 2 * agrees
    jacobian = torch.einsum("ni,nij->nj", slope, torch.func.jacfwd(place)(zero))
    return reference.weight * jacobian, weight


def test_color_equations_are_those_of_autograd(device, generator):
    """On a map without voxels the equations are the reference image's alone."""
    scene = ops.SceneView.empty(device=device)
    reference = _reference(moved_pose(POSE, 0.01, 0.03), device)
    records = _painted(corner_pixels(POSE, generator, 400))
    jacobian, weight = _intensity_equations(reference, drawn_pixels(records))
    _, stats, hessian = ops.track_gauss_newton(
        scene, records.to(device), pose7(POSE, device), INTRINSICS, ONE_STEP, reference=reference
    )
    want = torch.einsum("n,ni,nj->ij", weight, jacobian, jacobian)
    assert weight.gt(0).double().mean() > 0.5
    # A point that rounding moves over the border of a cell has another gradient.
    assert torch.allclose(hessian.cpu().double(), want, rtol=0, atol=5e-3 * want.abs().max())
    assert stats[0, [0, 1, 4]].tolist() == [0, 0, 0]


def test_colors_count_by_their_luma(device, generator):
    """Rec. 601's: a color of the same luma as a gray gives the same equations."""
    assert ops.LUMA_WEIGHTS == (299, 587, 114)
    red, green, blue = 11, 1, -34  # that weigh nothing together
    gray = _painted(corner_pixels(POSE, generator, 400))
    level = gray[:, 2] & 0xFF
    colored = torch.stack([gray[:, 0], gray[:, 1], (level + red) | (level + green) << 8 | (level + blue) << 16], 1)
    reference, scene = _reference(moved_pose(POSE, 0.01, 0.03), device), ops.SceneView.empty(device=device)
    (pose, _, hessian), (want_pose, _, want) = (
        ops.track_gauss_newton(
            scene, records.to(device), pose7(POSE, device), INTRINSICS, ONE_STEP, reference=reference
        )
        for records in (colored, gray)
    )
    torch.testing.assert_close(pose, want_pose, rtol=0, atol=1e-6)
    assert torch.allclose(hessian, want, rtol=0, atol=1e-5 * float(want.abs().max()))


def test_colors_alone_find_the_pose(device, generator):
    """Three painted walls, of which nothing is mapped."""
    reference = _reference(POSE, device)
    records = _painted(corner_pixels(POSE, generator)).to(device)
    start = moved_pose(POSE, 0.01 * np.array([0.6, -0.64, 0.48]), np.radians(1.0))
    pose, _, _ = ops.track_gauss_newton(
        ops.SceneView.empty(device=device), records, pose7(start, device), INTRINSICS,
        replace(OPTIONS, iterations=20), reference=reference,
    )  # fmt: skip
    found = pose7_to_matrix(pose.cpu().double().numpy())
    # Cells of two pixels, seen from 1 m at a focal length of 60: a tenth of a cell.
    assert np.linalg.norm(found[:3, 3] - POSE[:3, 3]) < 4e-3
    assert np.degrees(rotation_angle(found[:3, :3].T @ POSE[:3, :3])) < 0.2


def test_devices_agree_with_a_reference(device, generator):
    """The CPU's pose and equations, with weights by depth and colors."""
    records, start = _painted(corner_pixels(POSE, generator)), pose7(moved_pose(POSE, 0.01, 0.02))
    results = []
    for place in ("cpu", device):
        scene = make_scene(torch.Generator().manual_seed(0), random_decoder=False, device=place)
        results.append(
            ops.track_gauss_newton(
                scene,
                records.to(place),
                start.to(place),
                INTRINSICS,
                replace(OPTIONS, tf32=False),
                noise=noise_model(1e-6, 9e-6, device=place),
                reference=_reference(POSE, place),
            )  # fmt: skip
        )
    want, got = results
    # Other orders of float32 sums.
    torch.testing.assert_close(got[0].cpu(), want[0], rtol=0, atol=1e-5)
    assert torch.allclose(got[2].cpu(), want[2], rtol=0, atol=1e-4 * float(want[2].abs().max()))


def test_bad_references_are_named(generator):
    scene, records = ops.SceneView.empty(), corner_pixels(POSE, generator)
    good = _reference(POSE)
    for bad, message in (
        (good._replace(kernel=0.0), "reference.kernel must be positive, got 0.0"),
        (good._replace(weight=-1.0), "reference.weight must be at least 0, got -1.0"),
        (good._replace(cells=good.cells[..., 0]), r"reference.cells must have shape \[H, W, 2\]"),
    ):
        with pytest.raises(ValueError, match=f"track_gauss_newton: {message}"):
            ops.track_gauss_newton(scene, records, pose7(POSE), INTRINSICS, OPTIONS, reference=bad)


def test_opcheck_with_a_reference(generator):
    scene, reference = make_scene(generator, random_decoder=False), _reference(POSE)
    options = replace(OPTIONS, num_pixels=32, iterations=2)
    arguments = [corner_pixels(POSE, generator, 50), pose7(POSE)], *options.arguments(INTRINSICS)
    call = (*scene.arguments(), *arguments, *reference.arguments(), [], [], [])
    torch.library.opcheck(torch.ops.spslam.track_gauss_newton.default, call)
