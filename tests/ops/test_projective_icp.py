"""Projective ICP: against a float64 reference, recovery of known motions, holes, determinism."""

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import matrix_to_pose7, pose7_to_matrix, rotation_angle
from tests.ops.arguments import opcheck
from tests.ops.threads import with_threads
from tests.reference.projective_icp import icp

WIDTH, HEIGHT = 64, 48
INTRINSICS = ops.Intrinsics(50.0, 50.0, 31.5, 23.5)
OPTIONS = dict(iterations=15, max_distance=0.4, kernel_start=0.1, kernel_end=0.03, damping=1e-4)
WALLS = torch.tensor([0.9, 0.6, 1.6], dtype=torch.float64)  # the corner where x = 0.9, y = 0.6 and z = 1.6 m meet
# float32 against float64: a few points change their partner by rounding.
POSE_TOLERANCE = 2e-4
SHARE_TOLERANCE = 3e-3


def corner_maps(pose):
    """Vertices and normals [H, W, 3] of the corner as a camera at `pose` (float64 [4, 4]) sees it."""
    pose = torch.from_numpy(pose)
    rows, columns = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (HEIGHT, WIDTH)), indexing="ij")
    k = INTRINSICS
    rays = torch.stack([(columns - k.cx) / k.fx, (rows - k.cy) / k.fy, torch.ones_like(rows)], -1)
    directions = rays @ pose[:3, :3].T
    depth, wall = torch.where(directions > 1e-6, (WALLS - pose[:3, 3]) / directions, torch.inf).min(-1)
    normals = -torch.eye(3, dtype=torch.float64)[wall] @ pose[:3, :3]
    seen = depth[..., None].isfinite()
    return torch.where(seen, rays * depth[..., None], 0).float(), torch.where(seen, normals, 0).float()


def look(turn=0.0):
    """A pose from which all three walls are seen."""
    forward = np.array([0.55 + turn, 0.4, 1.0])
    forward /= np.linalg.norm(forward)
    right = np.cross([0.1, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    return pose


def motion(shift_m, angle_deg):
    axis = np.array([0.3, -0.8, 0.52]) / np.linalg.norm([0.3, -0.8, 0.52])
    half = np.radians(angle_deg) / 2
    shift = shift_m * np.array([0.6, -0.64, 0.48])
    return pose7_to_matrix(np.concatenate([[np.cos(half)], np.sin(half) * axis, shift]))


def problem(shift_m, angle_deg, device="cpu"):
    """Points of one view, the maps of another, and T_target_source between them."""
    target, moved = look(), look() @ motion(shift_m, angle_deg)
    vertices, normals = corner_maps(target)
    points, _ = corner_maps(moved)
    points = points.reshape(-1, 3)
    return points[points[:, 2] > 0].to(device), vertices.to(device), normals.to(device), np.linalg.inv(target) @ moved


def pose7(matrix, device="cpu"):
    return torch.from_numpy(matrix_to_pose7(matrix)).float().to(device)


START = pose7(np.eye(4))


@pytest.mark.parametrize("iterations", [1, 2, 15])
def test_is_the_reference(device, iterations):
    points, vertices, normals, _ = problem(0.05, 4.0)
    options = {**OPTIONS, "iterations": iterations}
    want, want_h, fits = icp(points, vertices, normals, torch.eye(4), INTRINSICS, **options)
    pose, stats, h = ops.projective_icp(
        *(t.to(device) for t in (points, vertices, normals, START)), INTRINSICS, **options
    )
    np.testing.assert_allclose(pose7_to_matrix(pose.cpu().double().numpy()), want, atol=POSE_TOLERANCE)
    assert torch.allclose(h.cpu().double(), want_h, rtol=0, atol=5e-3 * float(want_h.abs().max()))
    torch.testing.assert_close(
        stats[:, [1, 4]].cpu(), torch.tensor(fits, dtype=torch.float32), rtol=0, atol=SHARE_TOLERANCE
    )


@pytest.mark.parametrize(("shift_m", "angle_deg"), [(0.0, 0.0), (0.05, 5.0), (0.1, 8.0)])
def test_recovers_the_motion(device, shift_m, angle_deg):
    points, vertices, normals, ground_truth = problem(shift_m, angle_deg, device)
    pose, stats, hessian = ops.projective_icp(points, vertices, normals, START.to(device), INTRINSICS, **OPTIONS)
    found = pose7_to_matrix(pose.cpu().double().numpy())
    assert np.linalg.norm(found[:3, 3] - ground_truth[:3, 3]) < 1e-3
    assert np.degrees(rotation_angle(found[:3, :3].T @ ground_truth[:3, :3])) < 0.1
    assert float(stats[-1, 1]) > 0.5
    assert torch.linalg.eigvalsh(hessian.cpu().double()).min() > 0


def test_holes_and_strangers_take_no_part(device):
    """Pixels without vertex or normal, NaN, and things that were not there before change nothing but their share."""
    points, vertices, normals, ground_truth = problem(0.04, 3.0, device)
    vertices[10:20, 10:30, 2] = 0
    vertices[20:24, :20] = torch.nan
    normals[30:40, 30:50] = 0
    points[::7] *= 0.5
    points[::11] = torch.nan
    pose, _, _ = ops.projective_icp(points, vertices, normals, START.to(device), INTRINSICS, **OPTIONS)
    found = pose7_to_matrix(pose.cpu().double().numpy())
    assert np.linalg.norm(found[:3, 3] - ground_truth[:3, 3]) < 2e-3


def test_same_bits_every_time(device):
    points, vertices, normals, _ = problem(0.05, 4.0, device)
    start = START.to(device)
    first = ops.projective_icp(points, vertices, normals, start, INTRINSICS, **OPTIONS)
    repeated = with_threads(
        lambda: ops.projective_icp(points, vertices, normals, start, INTRINSICS, **OPTIONS), (1, 2, 3, 4)
    )
    for again in repeated:
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_clouds_are_aligned_each_by_itself(device):
    points, vertices, normals, _ = problem(0.05, 4.0, device)
    clouds = torch.stack([points, points * 0.99, points[:1].expand_as(points)])
    starts = torch.stack([START, pose7(motion(0.02, 1.0)), START]).to(device)
    together = ops.projective_icp(clouds, vertices, normals, starts, INTRINSICS, **OPTIONS)
    assert [tuple(each.shape) for each in together] == [(3, 7), (3, 15, 5), (3, 6, 6)]
    for i in range(3):
        alone = ops.projective_icp(clouds[i], vertices, normals, starts[i], INTRINSICS, **OPTIONS)
        assert all(torch.equal(several[i], one) for several, one in zip(together, alone, strict=True))
    none = ops.projective_icp(clouds[:0], vertices, normals, starts[:0], INTRINSICS, iterations=2)
    assert [tuple(each.shape) for each in none] == [(0, 7), (0, 2, 5), (0, 6, 6)]


def test_strided_input(device):
    points, vertices, normals, _ = problem(0.05, 4.0, device)
    wide = torch.stack([points, points], 2)[..., 0]
    assert not wide.is_contiguous()
    want = ops.projective_icp(points, vertices, normals, START.to(device), INTRINSICS)
    got = ops.projective_icp(wide, vertices, normals, START.to(device), INTRINSICS)
    assert torch.equal(want[0], got[0])


@pytest.mark.parametrize("empty", ["points", "maps"])
def test_nothing_to_hold_against_leaves_the_pose(device, empty):
    points, vertices, normals, _ = problem(0.05, 4.0, device)
    start = pose7(motion(0.3, 20.0), device)
    if empty == "points":
        points = points[:0]
    else:
        vertices, normals = vertices[:0], normals[:0]
    pose, stats, hessian = ops.projective_icp(points, vertices, normals, start, INTRINSICS, iterations=3)
    torch.testing.assert_close(pose, start)
    assert not stats.any()
    assert not hessian.any()


def test_arguments_are_named():
    points, vertices, normals, _ = problem(0.0, 0.0)
    with pytest.raises(ValueError, match="projective_icp: iterations must be at least 1, got 0"):
        ops.projective_icp(points, vertices, normals, START, INTRINSICS, iterations=0)
    with pytest.raises(ValueError, match=r"projective_icp: normals must have shape \[48, 64, 3\], got \[1, 64, 3\]"):
        ops.projective_icp(points, vertices, normals[:1], START, INTRINSICS)
    with pytest.raises(TypeError, match="projective_icp: pose must be float32, got float64"):
        ops.projective_icp(points, vertices, normals, START.double(), INTRINSICS)
    with pytest.raises(ValueError, match=r"projective_icp: pose must have shape \[2, 7\], got \[7\]"):
        ops.projective_icp(torch.stack([points, points]), vertices, normals, START, INTRINSICS)
    with pytest.raises(TypeError, match=r"projective_icp: points must be a torch.Tensor, got list"):
        ops.projective_icp([], vertices, normals, START, INTRINSICS)


def test_opcheck(device):
    points, vertices, normals, _ = problem(0.0, 0.0)
    clouds, starts = torch.stack([points, points]), torch.stack([START, START])
    arguments = (clouds, vertices, normals, starts, list(INTRINSICS), 2, 0.3, 0.1, 0.03, 1e-4)
    opcheck(torch.ops.spslam.projective_icp.default, arguments, device)
