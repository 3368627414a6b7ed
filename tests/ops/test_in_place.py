"""Ops that write to their arguments: autograd knows of it, and what they make does not depend on torch's defaults."""

import contextlib

import pytest
import torch

from spslam import ops

POSE = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
CAMERA = ops.Intrinsics(8.0, 8.0, 3.5, 3.5)


@contextlib.contextmanager
def default_dtype(dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def step(param):
    ops.sparse_adam_(param, *(torch.ones_like(param) for _ in range(3)), lr=0.5, step=1)


def fuse(param):
    rows = torch.arange(len(param), dtype=torch.int32)
    ops.fuse_prior_(param, torch.ones(len(param)), rows, torch.ones_like(param), torch.ones(len(param)), 9.0)


def copy(param):
    ops.copy_rows_([param], [0], [torch.ones(param.shape[1:])])


def integrate(param):
    planes = ops.measure_planes(torch.full((8, 8), 2.0), CAMERA)
    block, colors = torch.tensor([[0, 0, 2]], dtype=torch.int32), torch.zeros(1, 512, 4, dtype=torch.uint16)
    weights = torch.zeros(1, 512)
    ops.tsdf_integrate_(block, param, weights, colors, planes, POSE, CAMERA, voxel_size=0.1, truncation=0.3)


@pytest.mark.parametrize(("change", "shape"), [(step, (4, 8)), (fuse, (4, 8)), (copy, (4, 8)), (integrate, (1, 512))])
def test_a_gradient_of_what_was_overwritten_is_an_error(change, shape):
    param, factor = torch.full(shape, 2.0), torch.ones(shape, requires_grad=True)
    product = (param * factor).sum()
    change(param)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        product.backward()


@pytest.mark.parametrize("change", [step, fuse, copy])
def test_tensors_without_versions_are_changed_too(change):
    with torch.inference_mode():
        param = torch.full((4, 8), 2.0)
        change(param)
        assert not torch.equal(param, torch.full((4, 8), 2.0))


def test_another_default_dtype_changes_nothing():
    keys, values = ops.new_voxel_hash(256)
    coords, corners = torch.zeros(128, 3, dtype=torch.int32), torch.full((128, 8), -1, dtype=torch.int32)
    volume = ops.VolumeBuffers(keys, values, coords, corners, torch.zeros(128, 8), torch.zeros(128))
    point, normal = torch.tensor([[0.02, 0.02, 1.02]]), torch.tensor([[0.0, 0.0, -1.0]])
    fusion = ops.FrameFusion(0.04, 8, 0.0, max_points=100, min_weight=0.0, kappa=2.5, max_weight=20.0)
    encoder, depth = torch.zeros(5128), torch.full((8, 8), 2.0)
    with default_dtype(torch.float64):
        assert ops.encode_frame_(volume, 0, 128, point, normal, encoder, fusion).new_voxels == 8
        fused = ops.TsdfVolume(0.05)
        fused.integrate(depth, POSE, CAMERA)
        assert fused.sdf.dtype == torch.float32
        assert ops.SensorNoise.unknown().model.dtype == torch.float32
        assert ops.CaptureTiming.unknown().seconds.dtype == torch.float32
        assert ops.mlp_init_params(3, 8, 1).dtype == torch.float32
