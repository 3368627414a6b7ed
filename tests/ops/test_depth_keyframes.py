"""Tracking against earlier frames' depth images: their equations, their weight, what is left out."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import pose7_to_matrix, rotation_angle
from tests.ops.arguments import opcheck
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
    rotation_exp,
    surface_equations,
)

UNIT = 1e-4
CAMERA = ops.Intrinsics(50.0, 52.0, 32.3, 21.8)  # of the keyframes, another than that of the pixels
SHAPE = (45, 66)


def _keyframes(poses, device="cpu", noise=0.0, generator=None):
    """The corner as cameras at those poses (float64 [4, 4] each) see it, in an order of images other than of poses."""
    depth = torch.stack([corner_depth(pose, CAMERA, *SHAPE) for pose in reversed(poses)])
    if noise:
        depth += noise * torch.randn(depth.shape, generator=generator, dtype=torch.float64)
    images = (depth / UNIT).round().to(torch.int32).to(torch.uint16).to(device)
    rows = tuple((len(poses) - 1 - k, k) for k in range(len(poses)))
    return ops.DepthKeyframes(images, UNIT, torch.stack([pose7(p, device) for p in poses]), rows, CAMERA, 0.03)


def _equations(keyframes, k, records):
    """Signed distance [P] from the surface of keyframe k, Jacobian [P, 6], which pixels are compared; at POSE, float64.

    By torch's bilinear sampling of the inverse depth; autograd gives both the slope that makes z q - 1 a distance and
    the Jacobian, in which that slope stands still.
    """
    image_row, pose_row = keyframes.rows[k]
    depth = keyframes.images[image_row].cpu().to(torch.int32).double() * keyframes.unit
    pose = torch.from_numpy(pose7_to_matrix(keyframes.poses[pose_row].cpu().double().numpy()))
    inverse = torch.where(depth > 0, 1 / depth, 0)
    height, width = inverse.shape
    size = torch.tensor([width - 1, height - 1], dtype=torch.float64)
    local, zero = camera_points(records), torch.zeros(6, dtype=torch.float64)

    def place(points):
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).unbind(-1)
        return torch.stack([x / z * CAMERA.fx + CAMERA.cx, y / z * CAMERA.fy + CAMERA.cy], -1), z

    def linear(points):
        uv, z = place(points)
        grid = (2 * uv / size - 1)[None, None]
        return z * torch.nn.functional.grid_sample(inverse[None, None], grid, align_corners=True)[0, 0, 0] - 1

    points = moved_points(local, zero).requires_grad_()
    value = linear(points)
    (slope,) = torch.autograd.grad(value.sum(), points)
    length = slope.norm(dim=1).clamp(min=1e-6).detach()
    points_by_increment = torch.func.jacfwd(lambda increment: moved_points(local, increment))(zero)
    jacobian = torch.einsum("ni,nij->nj", slope / length[:, None], points_by_increment)
    left_top, z = place(points.detach())
    left_top = left_top.floor().long()
    inside = ((left_top >= 0) & (left_top < size.long())).all(1) & (z > 0.05)
    u, v = torch.where(inside[:, None], left_top, 0).unbind(1)
    corners = torch.stack([inverse[v + dv, u + du] for dv in (0, 1) for du in (0, 1)])
    spread = corners.amax(0) - corners.amin(0) < 0.03 * corners.amax(0)
    return (value / length).detach(), jacobian, inside & (corners > 0).all(0) & spread


def _weight(residual, kernel=0.03):
    return (1 / (1 + (residual / kernel) ** 2)) ** 2


def _sums(residual, jacobian, weight):
    return torch.einsum("n,ni,nj->ij", weight, jacobian, jacobian), torch.einsum(
        "n,ni,n->i", weight, jacobian, residual
    )


def _step(hessian, gradient):
    matrix = hessian + (1e-6 * hessian.trace() + 1e-8) * torch.eye(6, dtype=torch.float64)
    return -torch.linalg.solve(matrix, gradient)


def _assert_moved_by(pose, delta, tolerance):
    """Whether a pose is POSE moved by an increment."""
    found = torch.from_numpy(pose7_to_matrix(pose.cpu().double().numpy()))
    want = rotation_exp(delta[3:]) @ torch.from_numpy(POSE[:3, :3])
    torch.testing.assert_close(found[:3, 3], torch.from_numpy(POSE[:3, 3]) + delta[:3], rtol=0, atol=tolerance)
    torch.testing.assert_close(found[:3, :3], want, rtol=0, atol=tolerance)


EARLIER = [moved_pose(POSE, np.array([0.02, -0.01, 0.015]), 0.03), moved_pose(POSE, np.array([-0.1, 0.05, 0.0]), -0.15)]


def test_distances_are_those_from_the_walls(generator):
    """Nearly: between pixels on both sides of a corner the inverse depth is not linear."""
    records = drawn_pixels(corner_pixels(POSE, generator, 400))
    residual, _, compared = _equations(_keyframes(EARLIER), 0, records)
    points = moved_points(camera_points(records), torch.zeros(6, dtype=torch.float64))
    walls = torch.tensor([0.9, 0.5, 1.1], dtype=torch.float64)
    distance = (points - walls).abs().amin(1)
    assert compared.double().mean() > 0.7
    assert ((residual.abs() - distance).abs()[compared] < 2 * UNIT).double().mean() > 0.9


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("noise", [None, (1e-6, 9e-6)])
def test_the_step_is_that_of_autograd(device, generator, count, noise):
    """On a map without voxels the mean of the keyframes' equations is all there is."""
    scene, keyframes = ops.SceneView.empty(device=device), _keyframes(EARLIER[:count], device, 0.003, generator)
    records = corner_pixels(POSE, generator, 400)
    drawn = drawn_pixels(records)
    noise = None if noise is None else noise_model(*noise, device=device)
    certainty = certainties(noise, camera_points(drawn)[:, 2])[1]
    hessian, gradient = torch.zeros(6, 6, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
    for k in range(count):
        residual, jacobian, compared = _equations(keyframes, k, drawn)
        h, g = _sums(residual, jacobian, _weight(residual) * compared * certainty)
        hessian, gradient = hessian + h / count, gradient + g / count
    pose, stats, map_hessian = ops.track_gauss_newton(
        scene, records.to(device), pose7(POSE, device), INTRINSICS, ONE_STEP, noise=noise, depth_keyframes=keyframes
    )
    delta = _step(hessian, gradient)
    assert delta.norm() > 1e-3
    # A point that rounding moves over the border of a pixel has another slope.
    _assert_moved_by(pose, delta, 2e-2 * float(delta.norm()))
    assert stats[0, 2].item() == pytest.approx(float(delta[:3].norm()), rel=2e-2)
    assert stats[0, [0, 1, 4]].tolist() == [0, 0, 0]
    assert not map_hessian.any()


@pytest.mark.parametrize("noise", [0.0005, 0.02])
def test_the_map_weighs_by_the_square_of_the_variances(device, generator, noise):
    """Against exact keyframes a map of random features weighs nearly nothing, against noisy ones more."""
    scene, keyframes = (
        make_scene(generator, random_decoder=True, device=device),
        _keyframes(EARLIER, device, noise, generator),
    )
    records = corner_pixels(POSE, generator, 400)
    drawn = drawn_pixels(records)
    of_map, map_jacobian, map_weight, known = surface_equations(scene, drawn, 0.03)
    hessian, gradient = torch.zeros(6, 6, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
    squares, weights, map_squares, map_weights = 0.0, 0.0, 0.0, 0.0
    for k in range(2):
        residual, jacobian, compared = _equations(keyframes, k, drawn)
        weight, common = _weight(residual) * compared, (compared & known).double()
        h, g = _sums(residual, jacobian, weight)
        hessian, gradient = hessian + h / 2, gradient + g / 2
        squares += float((weight * common * residual**2).sum())
        weights += float((weight * common).sum())
        map_squares += float((map_weight * common * of_map**2).sum())
        map_weights += float((map_weight * common).sum())
    share = min(max(((squares / weights) / (map_squares / map_weights)) ** 2, 1e-3), 4.0)
    h, g = _sums(of_map, map_jacobian, map_weight)
    delta = _step(hessian + share * h, gradient + share * g)
    arguments = scene, records.to(device), pose7(POSE, device), INTRINSICS
    options = replace(ONE_STEP, tf32=False)
    pose, stats, map_hessian = ops.track_gauss_newton(*arguments, options, depth_keyframes=keyframes)
    # There are more such points where keyframes are noisy, and c is a ratio of sums over them, squared.
    _assert_moved_by(pose, delta, 3e-2 * float(delta.norm()))
    _, plain, plain_hessian = ops.track_gauss_newton(*arguments, options)
    # The statistics are the map's alone.
    assert torch.equal(stats[:, [0, 1, 4]], plain[:, [0, 1, 4]])
    assert torch.equal(map_hessian, plain_hessian)


def test_keyframes_alone_find_the_pose(device, generator):
    """Nothing is mapped, and a keyframe's pixel covers 2 cm: bilinear depth is slightly off at creases."""
    records = corner_pixels(POSE, generator).to(device)
    start = moved_pose(POSE, 0.02 * np.array([0.6, -0.64, 0.48]), np.radians(2.0))
    pose, _, _ = ops.track_gauss_newton(
        ops.SceneView.empty(device=device), records, pose7(start, device), INTRINSICS,
        replace(OPTIONS, iterations=20), depth_keyframes=_keyframes(EARLIER, device),
    )  # fmt: skip
    found = pose7_to_matrix(pose.cpu().double().numpy())
    assert np.linalg.norm(found[:3, 3] - POSE[:3, 3]) < 1.5e-3
    assert np.degrees(rotation_angle(found[:3, :3].T @ POSE[:3, :3])) < 0.1


def test_keyframes_join_at_their_first_iteration(device, generator):
    """Before it they change nothing."""
    scene = make_scene(generator, random_decoder=True, device=device)
    arguments = scene, corner_pixels(POSE, generator, 400).to(device), pose7(POSE, device), INTRINSICS
    keyframes, options = _keyframes(EARLIER, device), replace(OPTIONS, tf32=False)

    def track(depth_keyframes=None):
        return ops.track_gauss_newton(*arguments, options, depth_keyframes=depth_keyframes)[1]

    plain, late = track(), track(keyframes._replace(first_iteration=5))
    assert torch.equal(late[:5], plain[:5])
    # The step of iteration 5 is the first that they change.
    assert not torch.equal(late[5, 2:4], plain[5, 2:4])
    assert not torch.equal(track(keyframes)[0, 2:4], plain[0, 2:4])


@pytest.mark.parametrize("held", [0.0, 0.01, 1.0])
def test_until_keyframes_join_the_map_moves_little_where_it_says_little(device, generator, held):
    """The held information comes onto the diagonal, times the sum of the map's weights; once they join, it is gone."""
    scene = make_scene(generator, random_decoder=True, device=device)
    records = corner_pixels(POSE, generator, 400)
    residual, jacobian, weight, _ = surface_equations(scene, drawn_pixels(records), 0.03)
    hessian, gradient = _sums(residual, jacobian, weight)
    delta = _step(hessian + held * weight.sum() * torch.eye(6, dtype=torch.float64), gradient)
    arguments = scene, records.to(device), pose7(POSE, device), INTRINSICS
    options, keyframes = replace(ONE_STEP, tf32=False, held_information=held), _keyframes(EARLIER, device)
    waiting = keyframes._replace(first_iteration=1)
    _assert_moved_by(
        ops.track_gauss_newton(*arguments, options, depth_keyframes=waiting)[0], delta, 2e-3 * float(delta.norm())
    )
    free = replace(options, held_information=0.0)
    for others in (keyframes, None):
        pose, plain = (ops.track_gauss_newton(*arguments, o, depth_keyframes=others)[0] for o in (options, free))
        assert torch.equal(pose, plain)


def test_what_no_keyframe_measured_moves_nothing(device, generator):
    """No depth, another direction, behind the camera, no keyframes, and images too small to lie between pixels."""
    records = corner_pixels(POSE, generator).to(device)
    scene, start = ops.SceneView.empty(device=device), pose7(POSE, device)
    away = moved_pose(POSE, 0.0, np.pi)
    good = _keyframes(EARLIER, device)
    for keyframes in (
        good._replace(images=torch.zeros_like(good.images)),
        good._replace(poses=torch.stack([pose7(away, device)] * 2)),
        good._replace(poses=torch.full_like(good.poses, torch.nan)),
        good._replace(rows=()),
        good._replace(images=good.images[:, :1, :1]),
        good._replace(images=good.images[:, :0]),
    ):
        pose, _, _ = ops.track_gauss_newton(scene, records, start, INTRINSICS, OPTIONS, depth_keyframes=keyframes)
        torch.testing.assert_close(pose, start, rtol=0, atol=1e-6)


def test_an_edge_says_nothing(generator):
    """Pixels between two depths that differ by more than 3 % are not compared, as neither is what lies between them."""
    records, depth = corner_pixels(POSE, generator, 400), corner_depth(POSE, CAMERA, *SHAPE)
    depth[::2] *= 1.3
    keyframes = _keyframes([POSE])._replace(images=(depth / UNIT).round().to(torch.int32).to(torch.uint16)[None])
    start = pose7(POSE)
    pose, _, _ = ops.track_gauss_newton(
        ops.SceneView.empty(), records, start, INTRINSICS, OPTIONS, depth_keyframes=keyframes
    )
    torch.testing.assert_close(pose, start, rtol=0, atol=1e-6)


def test_devices_agree_with_keyframes(device, generator):
    records, start = corner_pixels(POSE, generator), pose7(moved_pose(POSE, 0.01, 0.02))
    results = []
    for place in ("cpu", device):
        scene = make_scene(torch.Generator().manual_seed(0), random_decoder=False, device=place)
        arguments = scene, records.to(place), start.to(place), INTRINSICS
        keyframes = _keyframes(EARLIER, place)
        results.append(ops.track_gauss_newton(*arguments, replace(OPTIONS, tf32=False), depth_keyframes=keyframes))
    # Other orders of float32 sums, and points that these move over the border of a pixel.
    torch.testing.assert_close(results[1][0].cpu(), results[0][0], rtol=0, atol=2e-5)


def test_bad_keyframes_are_named(generator):
    scene, records, good = ops.SceneView.empty(), corner_pixels(POSE, generator), _keyframes(EARLIER)
    for bad, message in (
        (good._replace(unit=0.0), "depth_keyframes.unit must be positive, got 0.0"),
        (good._replace(kernel_end=0.0), "depth_keyframes.kernel_end must be positive, got 0.0"),
        (good._replace(first_iteration=-1), "depth_keyframes.first_iteration must be at least 0, got -1"),
        (good._replace(images=good.images.to(torch.int32)), "depth_keyframes.images must be uint16, got int32"),
        (good._replace(poses=good.poses[:, :6]), r"depth_keyframes.poses must have shape \[F, 7\]"),
        (
            good._replace(rows=((2, 0),)),
            r"depth_keyframes.rows must name images and poses that are there, got \(2, 0\)",
        ),
        (
            good._replace(rows=((0, -1),)),
            r"depth_keyframes.rows must name images and poses that are there, got \(0, -1\)",
        ),
        (good._replace(rows=((0, 0),) * 9), "depth_keyframes.rows must be at most 8, got 9"),
    ):
        with pytest.raises((ValueError, TypeError), match=f"track_gauss_newton: {message}"):
            ops.track_gauss_newton(scene, records, pose7(POSE), INTRINSICS, OPTIONS, depth_keyframes=bad)


def test_opcheck_with_keyframes(device, generator):
    scene, keyframes = make_scene(generator, random_decoder=False), _keyframes(EARLIER)
    options = replace(OPTIONS, num_pixels=32, iterations=2)
    arguments = [corner_pixels(POSE, generator, 50), pose7(POSE)], *options.arguments(INTRINSICS)
    call = (*scene.arguments(), *arguments, [], [], *keyframes.arguments())
    opcheck(torch.ops.spslam.track_gauss_newton.default, call, device)
