"""The scene prior's ops against plain formulas."""

import numpy as np
import pytest
import torch

from spslam import ops
from tests.ops.threads import assert_same_for_any_threads
from tests.reference import prior_fusion as reference

VOXEL = 0.04
# Float32 networks of 64 hidden units against double precision, features of order 1.
FEATURE_TOLERANCE = 2e-5
WEIGHT_TOLERANCE = 1e-5
# Float32 cross products of depths of some meters over 4 px.
NORMAL_TOLERANCE = 2e-3
CAMERA = {"fx": 60.0, "fy": 62.0, "cx": 31.0, "cy": 23.0}


def random_encoder(generator):
    return torch.randn(ops.ENCODER_PARAMETERS, generator=generator) * 0.2


def surface(count, generator, extent=0.3):
    points = (torch.rand(count, 3, generator=generator) - 0.5) * extent
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return points, normals


def room_depth(generator, noise=0.002):
    """64x48 px of a slanted wall with a box before it, holes and noise."""
    v, u = np.mgrid[:48, :64]
    depth = 2.0 + 0.01 * (u - 31) - 0.004 * (v - 23)
    depth[10:30, 20:40] -= 0.5
    depth += noise * torch.randn(48, 64, generator=generator).numpy()
    depth[40:44, 5:9] = 0
    depth[5, 50], depth[6, 52], depth[20, 10] = np.nan, np.inf, -1
    return torch.from_numpy(depth.astype(np.float32))


def all_pixels(device):
    v, u = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2).int().to(device)


def test_normals_match_the_formula_at_every_pixel(device, generator):
    depth = room_depth(generator)
    got = ops.depth_normals(depth.to(device), all_pixels(device), **CAMERA, step_px=3, max_jump=0.05).cpu().numpy()
    depth = np.where(np.isfinite(depth.numpy()) & (depth.numpy() > 0), depth.numpy(), 0).astype(np.float64)
    want = np.stack(
        [reference.depth_normal(depth, u, v, **CAMERA, step=3, max_jump=0.05) for v in range(48) for u in range(64)]
    )
    known = np.abs(want).sum(1) > 0
    assert 0.5 < known.mean() < 0.9
    assert np.array_equal(np.abs(got).sum(1) > 0, known)
    assert np.abs(got - want).max() < NORMAL_TOLERANCE


def test_normals_of_a_plane_are_exact_and_face_the_camera(device, generator):
    normal = torch.tensor([0.3, -0.5, -0.8])
    normal /= normal.norm()
    v, u = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    rays = torch.stack([(u - CAMERA["cx"]) / CAMERA["fx"], (v - CAMERA["cy"]) / CAMERA["fy"], torch.ones_like(u)], -1)
    depth = (-1.5 / (rays @ normal)).to(device)
    pixels = torch.randint(10, 38, (200, 2), generator=generator, dtype=torch.int32).to(device)
    normals = ops.depth_normals(depth, pixels, **CAMERA, step_px=2, max_jump=0.5).cpu()
    # The window's mean of a slanted, perspective depth is off by a small second-order term.
    assert ((normals @ normal).clamp(max=1).arccos() < np.radians(0.7)).all()


def test_normals_are_unknown_at_the_border_and_outside(device):
    depth = torch.full((48, 64), 1.5, device=device)
    pixels = torch.tensor([[2, 20], [3, 20], [60, 20], [61, 20], [20, 2], [20, 45], [-5, 7], [7, 1000]])
    normals = ops.depth_normals(depth, pixels.int().to(device), **CAMERA, step_px=3, max_jump=0.05)
    assert normals.cpu().tolist() == [[0, 0, 0], [0, 0, -1], [0, 0, -1]] + [[0, 0, 0]] * 5
    assert ops.depth_normals(depth, pixels[:0].int().to(device), **CAMERA, step_px=3, max_jump=0.05).shape == (0, 3)


def test_normals_of_strided_depth(device, generator):
    depth = room_depth(generator).to(device)
    pixels = all_pixels(device)
    want = ops.depth_normals(depth, pixels, **CAMERA, step_px=3, max_jump=0.05)
    strided = depth.T.contiguous().T
    got = ops.depth_normals(strided, pixels.T.contiguous().T, **CAMERA, step_px=3, max_jump=0.05)
    assert torch.equal(got, want)


@pytest.mark.parametrize("neighborhood", [64, 8])
@pytest.mark.parametrize("min_pair_weight", [0.0, 0.01])
def test_encoding_matches_the_formula(device, neighborhood, min_pair_weight, generator):
    params = random_encoder(generator)
    points, normals = surface(150, generator)
    points[3], points[4, 1], normals[5] = float("nan"), float("inf"), 0
    want = reference.encode_points(points, normals, params, VOXEL, neighborhood, min_pair_weight)
    got = ops.encode_points(
        points.to(device), normals.to(device), params.to(device), VOXEL, neighborhood, min_pair_weight, tf32=False
    )
    assert torch.equal(got[0].cpu(), want[0])
    assert torch.allclose(got[2].cpu().double(), want[2], rtol=WEIGHT_TOLERANCE, atol=1e-7)
    solid = want[2] > 1e-6  # below, a weight is a difference of nearly equal numbers and so is its mean
    assert torch.allclose(got[1].cpu().double()[solid], want[1].double()[solid], atol=FEATURE_TOLERANCE)


def test_encoding_of_many_points_in_few_cells(device, generator):
    params = random_encoder(generator)
    points, normals = surface(300, generator, extent=0.07)
    want = reference.encode_points(points, normals, params, VOXEL, 64, 0.001)
    got = ops.encode_points(points.to(device), normals.to(device), params.to(device), VOXEL, 64, 0.001, tf32=False)
    assert torch.equal(got[0].cpu(), want[0])
    assert torch.allclose(got[1].cpu().double(), want[1], atol=FEATURE_TOLERANCE)
    assert torch.allclose(got[2].cpu().double(), want[2], rtol=WEIGHT_TOLERANCE)


def test_encoding_is_sorted_and_the_same_for_any_order_of_points_up_to_rounding(device, generator):
    params = random_encoder(generator).to(device)
    points, normals = (x.to(device) for x in surface(20_000, generator, extent=4.0))
    coords, features, weights = ops.encode_points(points, normals, params, VOXEL)
    x, y, z = (coords.long() + 2**20).unbind(1)
    keys = (x << 42) | (y << 21) | z
    assert (keys.diff() > 0).all()
    shuffled = torch.randperm(len(points), generator=generator).to(device)
    again = ops.encode_points(points[shuffled], normals[shuffled], params, VOXEL)
    assert torch.equal(again[0], coords)
    assert torch.allclose(again[1], features, atol=1e-5)
    assert torch.allclose(again[2], weights, rtol=1e-5)


def test_encoding_does_not_depend_on_the_number_of_threads(generator):
    params = random_encoder(generator)
    points, normals = surface(30_000, generator, extent=4.0)
    assert_same_for_any_threads(lambda: ops.encode_points(points, normals, params, VOXEL), (1, 2, 5))


def test_points_beyond_the_range_of_coordinates_are_skipped(device, generator):
    params = random_encoder(generator).to(device)
    limit = 2**20
    points = torch.tensor([[limit - 1.5, 0.5, 0.5], [-limit + 0.5, 0.5, 0.5], [1e30, 0, 0], [0.5, 0.5, 0.5]])
    normals = torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3)
    coords, _, _ = ops.encode_points(points.to(device), normals.to(device), params, 1.0, 64, 0.0)
    assert coords.abs().max() <= 2
    assert len(coords) == 64


def test_encoding_of_nothing_and_of_strided_input(device, generator):
    params = random_encoder(generator).to(device)
    points, normals = (x.to(device) for x in surface(50, generator))
    for none in (points[:0], torch.full_like(points, float("nan"))):
        coords, features, weights = ops.encode_points(none, normals[: len(none)], params, VOXEL)
        assert (coords.shape, features.shape, weights.shape) == ((0, 3), (0, 8), (0,))
    want = ops.encode_points(points, normals, params, VOXEL)
    got = ops.encode_points(points.T.contiguous().T, normals.T.contiguous().T, params.repeat(2, 1).T[:, 1], VOXEL)
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


def test_random_embeddings_follow_voxel_and_seed(device, generator):
    coords = torch.randint(-50, 50, (2000, 3), generator=generator, dtype=torch.int32).to(device)
    got = ops.random_embeddings(coords, 2**40 + 3, 0.01).cpu()
    want = np.stack([reference.random_embedding(2**40 + 3, tuple(c), 0.01) for c in coords[:50].tolist()])
    assert np.abs(got[:50].numpy() - want).max() < 1e-6
    assert abs(got.mean()) < 4e-4
    assert abs(got.std() - 0.01) < 4e-4
    assert torch.equal(ops.random_embeddings(coords[7:8], 2**40 + 3, 0.01).cpu(), got[7:8])
    assert not torch.equal(ops.random_embeddings(coords, 4, 0.01).cpu(), got)
    assert ops.random_embeddings(coords[:0], 0).shape == (0, 8)


def fusion_case(generator, device, voxels=50, rows=20):
    embeddings = torch.randn(voxels, 8, generator=generator)
    weights = torch.rand(voxels, generator=generator) * 3
    weights[::3] = 0
    ids = torch.randperm(voxels, generator=generator)[:rows].int()
    features = torch.randn(rows, 8, generator=generator)
    feature_weights = torch.rand(rows, generator=generator)
    feature_weights[::4] = 0
    return [x.to(device) for x in (embeddings, weights, ids, features, feature_weights)]


def test_fuse_prior_is_equation_1(device, generator):
    embeddings, weights, ids, features, feature_weights = fusion_case(generator, device)
    want, want_weights = embeddings.double(), weights.double()
    for row, v in enumerate(ids.tolist()):
        w, total = feature_weights[row].double(), want_weights[v] + feature_weights[row].double()
        if w > 0:
            want[v] = (want_weights[v] * want[v] + w * features[row].double()) / total
            want_weights[v] = min(total, 2.0)
    ops.fuse_prior_(embeddings, weights, ids, features, feature_weights, 2.0)
    assert torch.allclose(embeddings.double(), want, atol=1e-6)
    assert torch.allclose(weights.double(), want_weights, atol=1e-6)


def test_fuse_prior_skips_rows_outside(device, generator):
    embeddings, weights, _, features, feature_weights = fusion_case(generator, device, rows=3)
    before = embeddings.clone(), weights.clone()
    ids = torch.tensor([-1, 50, 2**31 - 1], dtype=torch.int32, device=device)
    ops.fuse_prior_(embeddings, weights, ids, features, feature_weights, 2.0)
    assert torch.equal(embeddings, before[0])
    assert torch.equal(weights, before[1])
    ops.fuse_prior_(embeddings, weights, ids[:0], features[:0], feature_weights[:0], 2.0)


def test_fuse_prior_takes_strided_features(device, generator):
    embeddings, weights, ids, features, feature_weights = fusion_case(generator, device)
    again = embeddings.clone(), weights.clone()
    ops.fuse_prior_(embeddings, weights, ids, features, feature_weights, 2.0)
    ops.fuse_prior_(*again, ids, features.T.contiguous().T, feature_weights.repeat(2, 1).T[:, 0], 2.0)
    assert torch.equal(embeddings, again[0])
    assert torch.equal(weights, again[1])


def test_fuse_prior_names_wrong_arguments(generator):
    embeddings, weights, ids, features, feature_weights = fusion_case(generator, "cpu")
    with pytest.raises(ValueError, match=r"fuse_prior_: features must have shape \[20, 8\], got \[19, 8\]"):
        ops.fuse_prior_(embeddings, weights, ids, features[1:], feature_weights, 2.0)
    with pytest.raises(ValueError, match=r"fuse_prior_: weights must have shape \[50\], got \[49\]"):
        ops.fuse_prior_(embeddings, weights[1:], ids, features, feature_weights, 2.0)
    with pytest.raises(ValueError, match="fuse_prior_: max_weight must be positive, got 0"):
        ops.fuse_prior_(embeddings, weights, ids, features, feature_weights, 0)
    with pytest.raises(TypeError, match="fuse_prior_: voxel_ids must be int32, got int64"):
        ops.fuse_prior_(embeddings, weights, ids.long(), features, feature_weights, 2.0)


def test_depth_normals_names_wrong_arguments():
    depth, pixels = torch.ones(4, 5), torch.zeros(2, 2, dtype=torch.int32)
    good = dict(CAMERA, step_px=1, max_jump=0.1)
    for change, message in (
        ({"fx": 0}, "fx must be positive, got 0"),
        ({"fy": -1.0}, "fy must be positive, got -1.0"),
        ({"step_px": 0}, "step_px must be at least 1, got 0"),
        ({"max_jump": 0}, "max_jump must be positive, got 0"),
    ):
        with pytest.raises(ValueError, match=f"depth_normals: {message}"):
            ops.depth_normals(depth, pixels, **{**good, **change})
    with pytest.raises(TypeError, match="depth_normals: depth must be float32, got float64"):
        ops.depth_normals(depth.double(), pixels, **good)
    with pytest.raises(ValueError, match=r"depth_normals: pixels must have shape \[N, 2\], got \[2, 3\]"):
        ops.depth_normals(depth, torch.zeros(2, 3, dtype=torch.int32), **good)


def test_encode_points_names_wrong_arguments(generator):
    params = random_encoder(generator)
    points, normals = surface(4, generator)
    with pytest.raises(ValueError, match=r"encode_points: normals must have shape \[4, 3\], got \[3, 3\]"):
        ops.encode_points(points, normals[1:], params, VOXEL)
    with pytest.raises(ValueError, match=r"encode_points: encoder_params must have shape \[5128\], got \[5127\]"):
        ops.encode_points(points, normals, params[1:], VOXEL)
    with pytest.raises(ValueError, match="encode_points: voxel_size must be positive, got 0"):
        ops.encode_points(points, normals, params, 0)
    with pytest.raises(ValueError, match="encode_points: neighborhood must be 64 or 8, got 27"):
        ops.encode_points(points, normals, params, VOXEL, 27)
    with pytest.raises(ValueError, match="encode_points: min_pair_weight must be at least 0, got -1"):
        ops.encode_points(points, normals, params, VOXEL, 64, -1)
    with pytest.raises(TypeError, match="encode_points: points must be float32, got float64"):
        ops.encode_points(points.double(), normals, params, VOXEL)
    with pytest.raises(ValueError, match="random_embeddings: scale must be at least 0, got -1"):
        ops.random_embeddings(torch.zeros(1, 3, dtype=torch.int32), 0, -1)


def test_opcheck(device, generator):
    op = torch.ops.spslam
    points, normals = (x.to(device) for x in surface(20, generator))
    depth, pixels = room_depth(generator).to(device), all_pixels(device)[::50]
    torch.library.opcheck(op.fuse_prior_, (*fusion_case(generator, device), 2.0))
    torch.library.opcheck(op.depth_normals, (depth, pixels, 60.0, 62.0, 31.0, 23.0, 3, 0.05))
    torch.library.opcheck(op.encode_points, (points, normals, random_encoder(generator).to(device), VOXEL, 64, 1e-3))
    torch.library.opcheck(op.random_embeddings, (pixels.new_zeros((3, 3)), 7, 0.01))
