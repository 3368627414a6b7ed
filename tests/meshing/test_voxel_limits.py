"""Voxels too small for the memory allowed: refused before frames are read, or made larger as before."""

import numpy as np
import pytest
import torch

from spslam.datasets.generated import GeneratedDataset
from spslam.errors import SpslamError
from spslam.meshing import frame_fusion
from spslam.meshing.frame_fusion import FusionOptions, PosedFrames, fuse_frames
from tests.meshing.test_extract_mesh import _scene, _slab

EXACT = (1e-8, 0.0)


class NotRead(PosedFrames):
    """Frames that must not be read."""

    def __init__(self):
        super().__init__(GeneratedDataset(frames=1, width=32, height=24), np.arange(1), np.eye(4)[None])

    def __getitem__(self, position):
        raise AssertionError("a frame was read")

    depth = __getitem__


@pytest.fixture(scope="module")
def scene():
    return _scene(_slab, (0.5, 0.5, 0.1), torch.device("cpu"))


@pytest.mark.parametrize("voxel_m", [1e-5, 1e-300, 5e-324])
def test_voxels_that_can_never_fit_are_refused_at_once(scene, voxel_m):
    with pytest.raises(SpslamError, match=r"need far more than 2 MB: choose a resolution of at least 0\.0\d+ m"):
        fuse_frames(NotRead(), FusionOptions(voxel_m, 2, EXACT), scene)


def test_the_size_that_is_named_fits_after_some_coarsening(scene):
    with pytest.raises(SpslamError) as refused:
        fuse_frames(NotRead(), FusionOptions(1e-5, 2, EXACT), scene)
    least_m = float(str(refused.value).split("at least ")[1].split()[0])
    dataset = GeneratedDataset(frames=1, width=32, height=24)
    frames = PosedFrames(dataset, np.arange(1), np.eye(4)[None])
    assert least_m <= fuse_frames(frames, FusionOptions(least_m, 20, EXACT), scene).voxel_size < 30 * least_m


@pytest.mark.parametrize("memory_mb", [2, 5, 20])
def test_only_sizes_that_do_not_fit_are_passed_over(scene, monkeypatch, memory_mb):
    """The same volume comes out as where every size is tried."""
    frames = PosedFrames(GeneratedDataset(frames=1, width=32, height=24), np.arange(1), np.eye(4)[None])
    options = FusionOptions(0.002, memory_mb, EXACT)
    fused = fuse_frames(frames, options, scene)
    monkeypatch.setattr(frame_fusion, "_least_voxel_m", lambda *_: 0.0)
    tried = fuse_frames(frames, options, scene)
    assert fused.voxel_size == tried.voxel_size > options.voxel_size_m
    assert torch.equal(fused.block_coords, tried.block_coords) and torch.equal(fused.sdf, tried.sdf)
