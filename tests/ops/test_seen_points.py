"""Points of a surface in frames against plain NumPy, and sums of their colors."""

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import pose7_to_matrix
from tests.ops.threads import assert_same_for_any_threads
from tests.reference import seen_points as reference

CAMERA = ops.Intrinsics(52.0, 50.0, 31.5, 23.5)
SIZE = (48, 64)
NOISE = (4e-6, 1e-6)
POSE = torch.nn.functional.normalize(torch.tensor([1.0, 0.05, -0.1, 0.08]), dim=0).tolist() + [0.1, -0.05, 0.2]
POSE = torch.tensor(POSE)
# The share of points that rounding may decide otherwise: they lie a hair's breadth from a limit, or between two pixels.
UNDECIDED = 0.005


def surface(count=5000, seed=0):
    """Points of a wavy wall, of a ball before it, and all around the camera; in runs that lie next to each other."""
    draw = np.random.default_rng(seed)
    wall = np.stack([*draw.uniform(-2.0, 2.0, (2, count)), np.zeros(count)], 1)
    wall[:, 2] = 2.5 + 0.1 * np.sin(4 * wall[:, 0])
    slopes = np.stack([0.4 * np.cos(4 * wall[:, 0]), np.zeros(count), -np.ones(count)], 1)
    ball = draw.normal(size=(count, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    around = 6 * draw.normal(size=(count, 3))
    points = np.concatenate([wall, [0.2, 0.1, 1.4] + 0.3 * ball, around]).astype(np.float32)
    normals = np.concatenate([slopes, ball, -around])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, normals.astype(np.float32)


def frame(seed=1):
    """Depth with a hole and a board in front on one side, and colors of noise."""
    draw = np.random.default_rng(seed)
    depth = (2.4 + 0.05 * draw.standard_normal(SIZE)).astype(np.float32)
    depth[:10], depth[:, :12] = 0, 1.0
    return depth, draw.integers(0, 256, (*SIZE, 3), dtype=np.uint8)


def seen(points, normals, depth, color, pose=POSE, device="cpu"):
    on = [torch.from_numpy(each).to(device) for each in (points, normals, depth, color)]
    return ops.see_points(ops.SurfacePoints.of(*on[:2]), *on[2:], pose.to(device), CAMERA, NOISE)


@pytest.mark.parametrize("seed", range(3))
def test_seen_points_are_those_of_numpy(device, seed):
    points, normals = surface(seed=seed)
    depth, color = frame(seed)
    colors, weights = (each.cpu().numpy() for each in seen(points, normals, depth, color, device=device))
    wide = [each.astype(np.float64) for each in (points, normals, depth)]
    pose = pose7_to_matrix(POSE.double().numpy())
    want_colors, want = reference.see_points(*wide, color, pose, CAMERA, NOISE)
    assert 0.02 < (want > 0).mean() < 0.5
    assert ((weights > 0) != (want > 0)).mean() < UNDECIDED
    both = (weights > 0) & (want > 0)
    assert np.allclose(weights[both], want[both], rtol=1e-4)
    assert np.abs(colors[both] - want_colors[both]).max() < 0.51  # of rounding, and 1e-4 px of a step of 255 levels
    assert not colors[weights == 0].any()


def test_what_lies_before_hides_points_and_gaps_of_two_pixels_are_closed(device):
    x, y = np.meshgrid(np.arange(-8, 9), np.arange(-8, 9))
    pitch = 2 * 1.0 / CAMERA.fx  # a sheet at 1 m with a point at every second pixel
    sheet = np.stack([pitch * x, pitch * y, np.ones_like(x)], -1).reshape(-1, 3)
    behind = sheet * 2 + [0.6 * pitch, 0.6 * pitch, 0]
    points = np.concatenate([sheet, behind]).astype(np.float32)
    normals = np.tile(np.float32([0, 0, -1]), (len(points), 1))
    identity = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
    unknown, color = np.zeros(SIZE, np.float32), frame()[1]
    _, weights = seen(points, normals, unknown, color, identity, device)
    front, back = weights.view(2, 17, 17)[:, 1:-1, 1:-1].cpu()
    assert (front > 0).all() and not back.any()
    _, alone = seen(points[len(sheet) :], normals[len(sheet) :], unknown, color, identity, device)
    assert (alone.view(17, 17)[1:-1, 1:-1] > 0).all()
    _, measured = seen(points, normals, np.full(SIZE, 0.9, np.float32), color, identity, device)
    assert not measured.any()


def test_points_that_are_not_finite_are_not_seen(device):
    points, normals = surface(1500)
    depth, color = frame()
    whole = seen(points, normals, depth, color, device=device)[1].cpu().numpy()
    broken = np.flatnonzero(whole > 0)[::7]
    points[broken] = np.nan
    points[broken[::2]] = np.inf
    weights = seen(points, normals, depth, color, device=device)[1].cpu().numpy()
    assert not weights[broken].any() and (weights > 0).sum() > 0.5 * (whole > 0).sum()


def test_no_points_and_no_pixels(device):
    points, normals = surface(100)
    depth, color = frame()
    colors, weights = seen(points[:0], normals[:0], depth, color, device=device)
    assert colors.shape == (0, 3) and weights.shape == (0,)
    _, weights = seen(points, normals, depth[:0], color[:0], device=device)
    assert not weights.any()


def test_the_same_bits_for_any_number_of_threads():
    points, normals = surface(40_000)
    depth, color = frame()
    assert_same_for_any_threads(lambda: seen(points, normals, depth, color))


def test_means_of_weighted_colors(device):
    draw = np.random.default_rng(0)
    colors = draw.integers(0, 256, (4, 300, 3), dtype=np.uint8)
    weights = draw.uniform(0, 1e5, (4, 300)).astype(np.float32) * (draw.uniform(size=(4, 300)) < 0.5)
    sums = torch.zeros(300, 4, device=device)
    for each in zip(colors, weights.astype(np.float32), strict=True):
        ops.add_seen_colors_(sums, *(torch.from_numpy(array).to(device) for array in each))
    want = np.concatenate([(weights[..., None] * colors).sum(0), weights.sum(0)[:, None]], 1)
    assert np.allclose(sums.cpu().numpy(), want, rtol=1e-5)


def test_detail_of_edges(device):
    draw = np.random.default_rng(0)
    points, edges = 50, 200
    ends = draw.integers(0, points, (edges, 2))
    ends[3], ends[5, 1] = -1, points  # no points
    sums, want = torch.zeros(edges, 5, device=device), np.zeros((edges, 5))
    for _ in range(3):
        colors = draw.integers(0, 256, (points + edges, 3), dtype=np.uint8)
        weights = (draw.uniform(size=points + edges) < 0.7).astype(np.float32)
        ops.add_color_detail_(sums, *(torch.from_numpy(each).to(device) for each in (colors, weights, ends)))
        for e, (first, second) in enumerate(ends):
            known = first >= 0 and max(first, second) < points
            if not known or not (weights[first] and weights[second] and weights[points + e]):
                continue
            off = colors[points + e] - (colors[first].astype(float) + colors[second]) / 2
            want[e] += [*off, off @ off, 1]
    assert np.allclose(sums.cpu().numpy(), want)
