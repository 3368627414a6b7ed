"""Registration of many pairs of depth images against tracking without a map, and against NumPy."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam import ops
from tests.ops.arguments import opcheck

CAMERA, SOURCE_CAMERA = ops.Intrinsics(60.0, 60.0, 39.5, 29.5), ops.Intrinsics(55.0, 56.0, 38.0, 30.0)
SHAPE, UNIT, FRAMES, PIXELS = (60, 80), 1e-4, 4, 300
NOISE = torch.tensor([1e-6, 2e-6, 1e-4, 0.04])
OPTIONS = ops.AlignmentOptions(
    num_pixels=256, iterations=8, kernel_start=0.1, kernel_end=0.01, damping=1e-4, seed=3,
    stream=ops.RandomStream.TRACKING_PIXELS,
)  # fmt: skip
PAIRS = torch.tensor([[0, 1], [1, 0], [2, 0], [3, 1], [2, 2]])


def _surface(camera, origin, shape=SHAPE):
    """Depth [H, W] of a corner of three walls as seen from `origin`, axes as the world's, and its normals."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(shape)], -1)
    walls = np.array([[-0.55, 0.1, -0.83], [0.6, 0.2, -0.77], [0.05, -0.7, -0.7]])
    walls /= np.linalg.norm(walls, axis=1, keepdims=True)
    distance = (-1.4 - walls @ origin) / (rays @ walls.T)
    distance[distance <= 0] = np.inf
    return distance.min(-1), walls[distance.argmin(-1)]


def _intensity(camera, depth, origin):
    """uint8 [H, W] of a texture fixed to the world."""
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    x, y = (u - camera.cx) / camera.fx * depth + origin[0], (v - camera.cy) / camera.fy * depth + origin[1]
    return (127 + 60 * np.sin(9 * x) + 50 * np.cos(8 * y)).astype(np.uint8)


@pytest.fixture(scope="module")
def world():
    """Sources and targets of frames a few centimeters apart, and where they are, [F, 3]."""
    rng = np.random.default_rng(7)
    origins = rng.normal(0, 0.04, (FRAMES, 3))
    depths, images, records, normals = [], [], [], []
    for origin in origins:
        depth, _ = _surface(CAMERA, origin)
        image = np.round(depth / UNIT).astype(np.uint16)
        image[10:14, 20:30] = 0
        depths.append(image)
        images.append(_intensity(CAMERA, depth, origin))
        of_source, normal = _surface(SOURCE_CAMERA, origin)
        gray = _intensity(SOURCE_CAMERA, of_source, origin).astype(np.int32)
        v, u = rng.integers(1, SHAPE[0] - 1, PIXELS), rng.integers(1, SHAPE[1] - 1, PIXELS)
        words = of_source[v, u].astype(np.float32).view(np.int32)
        words[:5] = 0
        records.append(np.stack([u | v << 16, words, gray[v, u] * 0x010101], -1).astype(np.int32))
        found = normal[v, u].astype(np.float32)
        found[5:9] = 0
        normals.append(found)
    sources = ops.DrawnPixels(
        torch.from_numpy(np.stack(records)),
        torch.from_numpy(np.stack(normals)),
        10 * torch.arange(FRAMES),
        SOURCE_CAMERA,
    )
    targets = ops.DepthImages(torch.from_numpy(np.stack(depths)), UNIT, CAMERA, torch.from_numpy(np.stack(images)))
    return sources, targets, origins


def _on(device, named):
    return named._replace(
        **{name: value.to(device) for name, value in named._asdict().items() if isinstance(value, torch.Tensor)}
    )


def _poses(origins, off_m=0.0):
    """T_target_source of the pairs, off by so much."""
    poses = torch.zeros(len(PAIRS), 7)
    poses[:, 0] = 1
    for row, (source, target) in enumerate(PAIRS.tolist()):
        poses[row, 4:] = torch.from_numpy(origins[source] - origins[target]).float() + off_m
    return poses


def _tracked(world, pair, start, noise):
    """What `track_gauss_newton` finds for a pair."""
    sources, targets, _ = world
    source, target = pair
    keyframe = ops.DepthKeyframes(
        targets.depth[target, None], UNIT, torch.tensor([[1.0, 0, 0, 0, 0, 0, 0]]), ((0, 0),), CAMERA,
        OPTIONS.kernel_end, intensities=targets.intensities[target, None],
    )  # fmt: skip
    options = ops.GaussNewtonOptions(
        num_pixels=OPTIONS.num_pixels, iterations=OPTIONS.iterations, truncation=0.1, kernel_start=OPTIONS.kernel_start,
        kernel_end=0.05, damping=OPTIONS.damping, seed=OPTIONS.seed, stream=OPTIONS.stream,
        frame=int(sources.numbers[source]),
    )  # fmt: skip
    scene = ops.SceneView.empty()
    return ops.track_gauss_newton(
        scene, sources.records[source], start, SOURCE_CAMERA, options, noise=noise, depth_keyframes=keyframe
    )[0]


@pytest.mark.parametrize("noise", [None, NOISE])
def test_each_pair_is_tracked_as_alone_without_a_map(device, world, noise):
    sources, targets, origins = world
    starts = _poses(origins, 0.01)
    want = torch.stack(
        [_tracked(world, pair, start, noise) for pair, start in zip(PAIRS.tolist(), starts, strict=True)]
    )
    got = ops.align_depth_images(
        _on(device, sources), _on(device, targets), PAIRS.to(device), starts.to(device), OPTIONS,
        noise=None if noise is None else noise.to(device),
    ).cpu()  # fmt: skip
    assert (want[:, 4:] - starts[:, 4:]).norm(dim=1).min() > 0.01
    torch.testing.assert_close(got, want, rtol=0, atol=2e-5)


def test_pairs_come_to_where_they_are(device, world):
    sources, targets, origins = world
    found = ops.align_depth_images(
        _on(device, sources), _on(device, targets), PAIRS.to(device), _poses(origins, 0.02).to(device), OPTIONS,
        noise=NOISE.to(device),
    )  # fmt: skip
    torch.testing.assert_close(found.cpu(), _poses(origins), rtol=0, atol=1.5e-3)


def test_pairs_without_images_and_poses_that_are_not_finite_stay(device, world):
    sources, targets, origins = world
    pairs, starts = PAIRS.clone(), _poses(origins, 0.01)
    pairs[0, 0], pairs[1, 1], pairs[2, 0] = FRAMES, -1, -(2**62)
    starts[3, 5] = math.nan
    arguments = _on(device, sources), _on(device, targets), pairs.to(device), starts.to(device)
    found = ops.align_depth_images(*arguments, OPTIONS, noise=NOISE.to(device)).cpu()
    assert torch.equal(found[:3], starts[:3])
    assert found[3, 5].isnan()
    assert not torch.equal(found[4], starts[4])
    compared = ops.compare_depth_images(*arguments, NOISE.to(device), tolerance=0.01)
    for part in (compared.seen, compared.on_surface, compared.through, compared.information):
        assert not part[:4].any()
    assert compared.correlation[:4].isnan().all()
    assert compared.seen[4] > 0


def _reference(sources, targets, pair, translation, tolerance):
    """seen, on_surface, through, correlation and information of a pair, in NumPy."""
    source, target = pair
    words = sources.records[source].numpy()
    u, v = words[:, 0] & 0xFFFF, words[:, 0] >> 16
    z = words[:, 1].copy().view(np.float32).astype(np.float64)
    local = np.stack(
        [(u - SOURCE_CAMERA.cx) / SOURCE_CAMERA.fx * z, (v - SOURCE_CAMERA.cy) / SOURCE_CAMERA.fy * z, z], 1
    )
    local, normals, gray = local[z > 0], sources.normals[source].numpy()[z > 0], (words[:, 2] & 255)[z > 0] / 255
    points = local + translation
    column = np.floor(points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx + 0.5).astype(int)
    row = np.floor(points[:, 1] / points[:, 2] * CAMERA.fy + CAMERA.cy + 0.5).astype(int)
    inside = (row >= 0) & (row < SHAPE[0]) & (column >= 0) & (column < SHAPE[1])
    depth = np.where(inside, targets.depth[target].numpy()[row * inside, column * inside] * UNIT, 0)
    seen = depth > 0
    a2, c2, s2, e2 = NOISE.double().tolist()
    deviation = np.maximum(np.sqrt(a2 + c2 * depth**4), 2e-4)
    band = tolerance + 3 * deviation
    behind = points[:, 2] - depth
    on_it = seen & (np.abs(behind) < band)
    row, column, points, arms = row[on_it], column[on_it], points[on_it], local[on_it]
    image = targets.intensities[target].numpy() / 255.0
    across = (image[row, np.minimum(column + 1, SHAPE[1] - 1)] - image[row, np.maximum(column - 1, 0)]) / 2
    down = (image[np.minimum(row + 1, SHAPE[0] - 1), column] - image[np.maximum(row - 1, 0), column]) / 2
    scale = min(1, 0.3 / math.sqrt(e2)) / np.maximum(np.sqrt(s2 + e2 * (across**2 + down**2)), 1e-3)
    x, y, depth_of = points.T
    by_u, by_v = scale * across * CAMERA.fx / depth_of, scale * down * CAMERA.fy / depth_of
    slopes = np.stack([by_u, by_v, -(by_u * x + by_v * y) / depth_of], 1)
    directions = np.concatenate([normals[on_it] / deviation[on_it, None], slopes])
    jacobians = np.concatenate([directions, np.cross(np.concatenate([arms, arms]), directions)], 1)
    correlation = np.corrcoef(gray[on_it], image[row, column])[0, 1] if on_it.sum() > 1 else math.nan
    return seen.sum(), on_it.sum(), (seen & (behind < -2 * band)).sum(), correlation, jacobians.T @ jacobians


def test_comparison_is_that_of_numpy(device, world):
    sources, targets, origins = world
    poses = _poses(origins)
    poses[3, 6] -= 0.3
    found = ops.compare_depth_images(
        _on(device, sources),
        _on(device, targets),
        PAIRS.to(device),
        poses.to(device),
        NOISE.to(device),
        tolerance=0.004,
    )
    for row, pair in enumerate(PAIRS.tolist()):
        seen, on_surface, through, correlation, information = _reference(
            sources, targets, pair, poses[row, 4:].double().numpy(), 0.004
        )
        # A point that rounding moves over the border of a pixel, or of the tolerance, may count or not.
        counts = [int(part[row]) for part in (found.seen, found.on_surface, found.through)]
        np.testing.assert_allclose(counts, [seen, on_surface, through], atol=2)
        if on_surface > 20:
            assert found.correlation[row].item() == pytest.approx(correlation, abs=0.02)
            scale = np.sqrt(np.outer(information.diagonal(), information.diagonal()))
            np.testing.assert_allclose(found.information[row].cpu().numpy() / scale, information / scale, atol=0.02)
    assert found.on_surface[0] > 150
    assert found.through[3] > 100


def test_intensities_that_are_plain_or_missing_have_no_correlation(device, world):
    sources, targets, origins = world
    arguments = PAIRS.to(device), _poses(origins).to(device), NOISE.to(device)
    plain = targets._replace(intensities=torch.full_like(targets.intensities, 90))
    for images in (plain, targets._replace(intensities=None)):
        found = ops.compare_depth_images(_on(device, sources), _on(device, images), *arguments, tolerance=0.01)
        assert found.correlation.isnan().all()
        assert (found.on_surface > 0).all()
    both = _on(device, sources), _on(device, targets)
    assert (ops.compare_depth_images(*both, *arguments, tolerance=0.01, least_deviation=0.02).correlation > 0.9).all()
    assert ops.compare_depth_images(*both, *arguments, tolerance=0.01, least_deviation=0.5).correlation.isnan().all()


def test_no_pairs(device, world):
    sources, targets, _ = world
    none = PAIRS[:0].to(device), torch.zeros(0, 7, device=device)
    both = _on(device, sources), _on(device, targets)
    assert ops.align_depth_images(*both, *none, OPTIONS).shape == (0, 7)
    assert ops.compare_depth_images(*both, *none, NOISE.to(device), tolerance=0.01).information.shape == (0, 6, 6)


def test_results_repeat_for_any_number_of_threads(world):
    sources, targets, origins = world
    threads, results = ops.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            ops.set_num_threads(count)
            results.append(ops.align_depth_images(sources, targets, PAIRS, _poses(origins, 0.01), OPTIONS, noise=NOISE))
    finally:
        ops.set_num_threads(threads)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_errors(world):
    sources, targets, origins = world
    poses = _poses(origins)
    bad = [
        (sources._replace(records=sources.records[:, :0]), targets, "sources.records must have at least one pixel"),
        (sources._replace(numbers=sources.numbers[:2]), targets, "sources.numbers must have shape"),
        (sources, targets._replace(unit=0.0), "targets.unit must be positive, got 0"),
        (sources, targets._replace(intensities=targets.intensities[:, :5]), "targets.intensities must have shape"),
    ]
    for one, other, message in bad:
        with pytest.raises(ValueError, match=f"align_depth_images: {message}"):
            ops.align_depth_images(one, other, PAIRS, poses, OPTIONS)
    with pytest.raises(TypeError, match="align_depth_images: pairs must be int64, got int32"):
        ops.align_depth_images(sources, targets, PAIRS.int(), poses, OPTIONS)
    with pytest.raises(ValueError, match="align_depth_images: kernel_end must be positive, got 0"):
        ops.align_depth_images(sources, targets, PAIRS, poses, replace(OPTIONS, kernel_end=0))
    with pytest.raises(ValueError, match="compare_depth_images: tolerance must be at least 0, got -1"):
        ops.compare_depth_images(sources, targets, PAIRS, poses, NOISE, tolerance=-1)


def test_opcheck(device, world):
    sources, targets, origins = world
    tensors = [targets.depth, sources.records, PAIRS, _poses(origins), sources.numbers, NOISE, targets.intensities]
    scalars = [*CAMERA, UNIT, *SOURCE_CAMERA]
    opcheck(
        torch.ops.spslam.align_depth_images.default, (tensors, scalars, [0.1, 0.01, 1e-4], [64, 2, 0, 0, 0]), device
    )
    tensors[4] = sources.normals
    opcheck(torch.ops.spslam.compare_depth_images.default, (tensors, scalars, [0.01, 3.0, 2.0]), device)
