"""Every function gives what its torch op gives, to the bit, from the same arrays."""

import numpy as np
import pytest
import spslam_numpy as sn
import torch

from spslam import ops

VOXEL = 0.04
LAYOUT = [0, -3, 2, 7, 5, 35, -3, -1, 7, 4, 63, 2, -1, 5, 4]
DTYPES = [np.float32, np.float64]
KEY = (7, int(ops.RandomStream.MAPPING_RAYS), 3, 1)


@pytest.fixture(autouse=True)
def same_instruction_set():
    # Another one rounds otherwise, and the bits would differ.
    assert sn.CPU_ISA == ops.CPU_ISA


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def torch_of(value):
    return torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value


def flat(result):
    result = result if isinstance(result, tuple) else (result,)
    return [np.asarray(value) for value in result]


def assert_same(got, want):
    got, want = flat(got), flat(want)
    assert len(got) == len(want)
    for g, w in zip(got, want, strict=True):
        assert g.dtype == w.dtype
        np.testing.assert_array_equal(g, w)


def call_both(name, *arguments, **options):
    return getattr(sn, name)(*arguments, **options), getattr(ops, name)(*map(torch_of, arguments), **options)


def gradients(name, arguments, differentiable, grads):
    """Of the torch op, by autograd."""
    leaves = [torch_of(argument) for argument in arguments]
    for i in differentiable:
        leaves[i].requires_grad_()
    results = getattr(ops, name)(*leaves)
    results = results if isinstance(results, tuple) else (results,)
    inputs = [leaves[i] for i in differentiable]
    return tuple(torch.autograd.grad(results, inputs, [torch_of(grad) for grad in grads]))


def random_coords(rng, count=500, span=12):
    return rng.integers(-span, span, (count, 3), dtype=np.int32)


def table(coords):
    """Hash table, coordinates and corner ids, by the NumPy functions."""
    keys, values = sn.new_voxel_hash(4096)
    new = sn.voxel_hash_insert(keys, values, coords, 0)
    corners = np.full((len(new), 8), -1, np.int32)
    sn.voxel_hash_update_corner_ids(keys, values, new, corners, 0)
    return keys, values, new, corners


def test_voxel_hash(rng):
    coords = random_coords(rng, 4000, 6)
    keys, values, new, corners = table(coords)
    torch_keys, torch_values = ops.new_voxel_hash(4096)
    torch_new = ops.voxel_hash_insert(torch_keys, torch_values, torch_of(coords), 0)
    torch_corners = torch.full((len(torch_new), 8), -1, dtype=torch.int32)
    ops.voxel_hash_update_corner_ids(torch_keys, torch_values, torch_new, torch_corners, 0)
    assert_same((keys, values, new, corners), (torch_keys, torch_values, torch_new, torch_corners))
    assert (corners >= 0).any()
    assert_same(*call_both("voxel_hash_find", keys, values, random_coords(rng)))
    for dtype in DTYPES:
        points = rng.uniform(-0.3, 0.3, (300, 3)).astype(dtype)
        points[0] = np.nan
        assert_same(*call_both("voxel_hash_lookup", keys, values, corners, points, VOXEL))
    sn.voxel_hash_build_(keys, values, new[::-1])
    ops.voxel_hash_build_(torch_keys, torch_values, torch_new.flip(0))
    assert_same((keys, values), (torch_keys, torch_values))


@pytest.mark.parametrize("dtype", DTYPES)
def test_interpolation(rng, dtype):
    ids = rng.integers(-1, 40, (300, 8), dtype=np.int32)
    cases = {
        "trilinear_interpolate": ([rng.normal(size=(40, 8)), ids, rng.random((300, 3))], (0, 2)),
        "bilinear_interpolate": ([rng.normal(size=(6, 9, 5)), rng.uniform(-1, 9, (300, 2))], (0, 1)),
        "tri_plane_interpolate": ([rng.normal(size=(83, 32)), rng.uniform(-0.2, 0.3, (300, 3)), VOXEL, LAYOUT], (0, 1)),
    }
    for name, (arguments, differentiable) in cases.items():
        for i in differentiable:
            arguments[i] = arguments[i].astype(dtype)
        got, want = call_both(name, *arguments)
        assert_same(got, want)
        grad = rng.normal(size=got.shape).astype(dtype)
        assert_same(
            getattr(sn, f"{name}_backward")(grad, *arguments), gradients(name, arguments, differentiable, [grad])
        )


def test_draws():
    assert_same(sn.philox_uniform(*KEY, 100), ops.philox_uniform(*KEY, 100))
    assert_same(sn.sample_indices(*KEY, 100, 17), ops.sample_indices(*KEY, 100, 17))


@pytest.mark.parametrize("dtype", DTYPES)
def test_rays(rng, dtype):
    depth = rng.uniform(0.5, 3, 50).astype(dtype)
    depth[:3] = 0, np.nan, np.inf
    got, want = call_both("sample_along_rays", depth, 16, 5, 0.2, 1.02, 0.08, *KEY)
    assert_same(got, want)
    sdf = np.clip((depth[:, None] - got) / 0.08, -1, 1)
    color, valid = rng.random((50, 21, 3)).astype(dtype), rng.random((50, 21)) < 0.9
    sdf[:3] = 1
    arguments = [sdf, color, got, valid, 0.08]
    rendered, want = call_both("volume_render", *arguments)
    assert_same(rendered, want)
    grads = [rng.normal(size=value.shape).astype(dtype) for value in rendered]
    assert_same(
        sn.volume_render_backward(*grads, sdf, color, got, valid, rendered[2], 0.08),
        gradients("volume_render", arguments, (0, 1, 2), grads),
    )
    measured = [rng.random((50, 3)).astype(dtype), depth, rng.random(50).astype(dtype)]
    losses = [rendered[0], rendered[1], sdf, got, valid, rendered[2].any(1), *measured, 0.08, True]
    assert_same(*call_both("rendering_losses", *losses))


@pytest.mark.parametrize("dtype", DTYPES)
def test_mlp(rng, dtype):
    x = rng.normal(size=(100, 11)).astype(dtype)
    params = rng.normal(size=sn.mlp_num_params(11, 32, 3)).astype(dtype) / 6
    got, want = call_both("mlp", x, params, 32, 3, 1)
    assert_same(got, want)
    grad = rng.normal(size=got.shape).astype(dtype)
    arguments = [x, params, 32, 3, 1]
    assert_same(sn.mlp_backward(grad, *arguments), gradients("mlp", arguments, (0, 1), [grad]))


@pytest.mark.parametrize("dtype", DTYPES)
def test_optimizer(rng, dtype):
    tensors = [rng.random((40, 8)).astype(dtype) for _ in range(4)]
    stamps = rng.integers(0, 2, 40, dtype=np.int32)
    for marks in (stamps, None):
        torch_tensors = [torch_of(tensor) for tensor in tensors]
        ops.sparse_adam_(*torch_tensors, torch_of(marks), 1, lr=1e-2, step=3)
        sn.sparse_adam_(*tensors, marks, 1, lr=1e-2, step=3)
        assert_same(tuple(tensors), tuple(torch_tensors))
    shapes = (2, 300), (2, 300, 6), (2, 300)
    residuals, jacobians, weights = (rng.random(shape).astype(dtype) for shape in shapes)
    (hessian, gradient, cost), want = call_both("normal_equations", residuals, jacobians, weights)
    assert_same((hessian, gradient, cost), want)
    assert_same(*call_both("solve_normal_equations", hessian, gradient, 1e-4, 1e-9))


def test_prior(rng):
    depth = (1 + 0.1 * rng.random((48, 64))).astype(np.float32)
    pixels = rng.integers(0, 48, (200, 2), dtype=np.int32)
    assert_same(*call_both("depth_normals", depth, pixels, 60.0, 61.0, 31.5, 23.5, 2, 0.1))
    points = rng.uniform(-0.5, 0.5, (200, 3)).astype(np.float32)
    normals = rng.normal(size=(200, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    params = rng.normal(size=sn.ENCODER_PARAMETERS).astype(np.float32) / 8
    encoded, want = call_both("encode_points", points, normals, params, VOXEL)
    assert_same(encoded, want)
    coords, features, weights = encoded
    assert_same(*call_both("random_embeddings", coords, 5))
    embeddings, totals = np.zeros((len(coords), 8), np.float32), np.zeros(len(coords), np.float32)
    torch_embeddings, torch_totals = torch_of(embeddings), torch_of(totals)
    ids = np.arange(len(coords), dtype=np.int32)
    sn.fuse_prior_(embeddings, totals, ids, features, weights, 2.0)
    ops.fuse_prior_(torch_embeddings, torch_totals, *map(torch_of, (ids, features, weights)), 2.0)
    assert_same((embeddings, totals), (torch_embeddings, torch_totals))


def test_marching_cubes():
    axis = np.linspace(-1, 1, 9, dtype=np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    values = (np.sqrt(x * x + y * y + z * z) - 0.7)[None].astype(np.float32)
    got, want = call_both("marching_cubes", np.zeros((1, 3), np.int32), values)
    assert_same(got, want)
    assert len(got[1])


def test_threads():
    before = sn.get_num_threads()
    try:
        sn.set_num_threads(3)
        assert sn.get_num_threads() == 3
    finally:
        sn.set_num_threads(before)


def test_names_are_those_of_the_torch_ops():
    own = {"CPU_ISA"} | {name for name in sn.__all__ if name.endswith("_backward")}
    assert set(sn.__all__) - own <= set(ops.__all__)
