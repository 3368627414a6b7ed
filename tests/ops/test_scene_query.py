"""Point queries of a scene against their composition in plain torch, in float64."""

import pytest
import torch

from spslam import ops
from tests.ops.arguments import opcheck
from tests.ops.scenes import VOXEL, make_scene

# float32 sums of some 100 terms of order one.
ATOL = 2e-5


def _points(generator, count=3000):
    return torch.rand(count, 3, generator=generator) * 2.2 - 0.8


def _mlp(params, x, outputs):
    hidden, inputs = 32, x.shape[1]
    sizes = [hidden * inputs, hidden, hidden * hidden, hidden, outputs * hidden, outputs]
    w1, b1, w2, b2, w3, b3 = params.double().split(sizes)
    h = torch.relu(x @ w1.view(hidden, inputs).T + b1)
    return torch.relu(h @ w2.view(hidden, hidden).T + b2) @ w3.view(outputs, hidden).T + b3


def reference_sdf(scene, points):
    """SDF / truncation and validity by a dictionary of vertices, differentiable in the points."""
    rows = {}
    for slot in (scene.hash_values >= 0).nonzero()[:, 0].tolist():
        key = int(scene.hash_keys[slot])
        if key >= 0:
            coord = tuple(((key >> shift) & (2**21 - 1)) - 2**20 for shift in (42, 21, 0))
            rows[coord] = int(scene.hash_values[slot])
    base = torch.floor(points.detach() / VOXEL)
    local = points / VOXEL - base
    values, valid = [], []
    offsets = [(k & 1, k >> 1 & 1, k >> 2 & 1) for k in range(8)]
    embeddings = scene.embeddings.double()
    for cell, f in zip(base.int().tolist(), local, strict=True):
        ids = [rows.get((cell[0] + x, cell[1] + y, cell[2] + z)) for x, y, z in offsets]
        valid.append(None not in ids)
        if not valid[-1]:
            values.append(torch.zeros(8, dtype=torch.float64))
            continue
        weights = torch.stack(
            [torch.prod(torch.stack([f[a] if o[a] else 1 - f[a] for a in range(3)])) for o in offsets]
        )
        values.append(weights @ embeddings[ids])
    position = (points - torch.tensor(scene.origin, dtype=torch.float64)) * scene.position_scale
    sdf = torch.tanh(_mlp(scene.geometry_params, torch.cat([position, torch.stack(values)], 1), 1))[:, 0]
    valid = torch.tensor(valid)
    return torch.where(valid, sdf, torch.ones_like(sdf)), valid


def test_sdf_and_gradient(device, generator):
    scene = make_scene(generator, random_decoder=True)
    points = _points(generator, 200)
    exact = points.double().requires_grad_()
    want, want_valid = reference_sdf(scene, exact)
    want.sum().backward()
    on_device = make_scene(torch.Generator().manual_seed(0), random_decoder=True, device=device)
    sdf, valid, gradient = (t.cpu() for t in ops.query_sdf_gradient(on_device, points.to(device)))
    assert 0.1 < want_valid.float().mean() < 0.9
    assert torch.equal(valid, want_valid)
    assert torch.allclose(sdf.double(), want, atol=ATOL)
    assert torch.allclose(gradient.double(), exact.grad, atol=50 * ATOL)  # the gradient is in 1/m: 25 voxels per meter
    assert torch.equal(ops.query_sdf(on_device, points.to(device))[0].cpu(), sdf)


def test_color_is_the_public_composition(device, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    points = _points(generator).to(device)
    feature = ops.tri_plane_interpolate(scene.texels, points, scene.plane_cell_size, list(scene.plane_layout))
    want = torch.sigmoid(_mlp(scene.color_params.cpu(), feature.cpu().double(), 3))
    assert torch.allclose(ops.query_color(scene, points).cpu().double(), want, atol=ATOL)


def test_empty_and_not_finite(device, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    sdf, valid = ops.query_sdf(scene, torch.empty(0, 3, device=device))
    assert sdf.shape == valid.shape == (0,)
    odd = torch.tensor([[float("nan"), 0, 0], [float("inf"), 0, 0], [1e30, 0, 0]], device=device)
    sdf, valid = ops.query_sdf(scene, odd)
    assert not valid.any() and bool((sdf == 1).all())


def test_arguments_are_named(generator):
    scene = make_scene(generator, random_decoder=True)
    with pytest.raises(ValueError, match=r"query_sdf: points must have shape \[N, 3\], got \[4, 2\]"):
        ops.query_sdf(scene, torch.zeros(4, 2))
    with pytest.raises(TypeError, match="query_color: points must be float32, got float64"):
        ops.query_color(scene, torch.zeros(4, 3, dtype=torch.float64))


def test_opcheck(device, generator):
    scene = make_scene(generator, random_decoder=True)
    points = _points(generator, 10)
    opcheck(torch.ops.spslam.query_sdf.default, (*scene.arguments(), points, True), device)
    opcheck(torch.ops.spslam.query_color.default, (*scene.arguments(), points), device)
