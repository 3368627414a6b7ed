"""Pixels of a frame: which are drawn, and how they are packed."""

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.slam.frame_table import FrameTable
from spslam.slam.pixels import THUMBNAIL_STEP_PX, sample_frame, unpack_points
from spslam.slam.poses import pose_tensor
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings


@pytest.fixture(scope="module")
def dataset():
    return Recorded(3)


def test_records_hold_what_the_images_do(dataset):
    frame, camera = dataset[0], dataset.camera
    records = sample_frame(frame, camera, settings()).records.numpy().view(np.uint32)
    u, v = records[:, 0] & 0xFFFF, records[:, 0] >> 16
    assert records.shape == (15000, 3)
    np.testing.assert_array_equal(records[:, 1].view(np.float32), frame.depth[v, u])
    np.testing.assert_array_equal(records[:, 2:].copy().view(np.uint8)[:, :3], frame.color[v, u])


def test_foreshortening_is_that_of_the_normals(dataset):
    frame, camera = dataset[0], dataset.camera
    pixels = sample_frame(frame, camera, settings())
    words = pixels.records.numpy().view(np.uint32)
    u, v = words[:, 0] & 0xFFFF, words[:, 0] >> 16
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], 1)
    expected = np.abs((pixels.normals.numpy() * rays).sum(1)) * 128
    np.testing.assert_allclose(words[:, 2] >> 24, expected.clip(0, 255), atol=0.51)
    assert ((words[:, 2] >> 24 == 0) == (expected < 0.5)).all()


def test_kernels_unpack_the_same_points(dataset):
    frame, camera = dataset[0], dataset.camera
    config, pose = settings("mapping.first_iterations=0"), pose_tensor(frame.pose, torch.device("cpu"))
    system = SlamSystem(config, camera, frame.pose)
    system.process(frame)
    scene, records = system.state.scene, sample_frame(dataset[1], camera, config).records[:2000]
    rotation = torch.from_numpy(frame.pose[:3, :3]).float()
    sdf, valid = scene.sdf(unpack_points(records, camera) @ rotation.T + pose[4:])
    _, _, _, inlier_share = ops.gauss_newton_poses(
        scene.view(), records[None], pose[None], system.tracker.intrinsics, truncation=0.08, kernel=0.02
    )
    assert float(inlier_share) > 0.3
    assert float(inlier_share) == pytest.approx(float((valid & (sdf.abs() < 0.98)).float().mean()), abs=2e-3)


def test_the_draw_depends_on_seed_and_frame_alone(dataset):
    def records(index, *overrides):
        return sample_frame(dataset[index], dataset.camera, settings(*overrides)).records

    assert torch.equal(records(0), records(0))
    assert not torch.equal(records(0), records(0, "seed=1"))
    assert not torch.equal(records(0)[:, 0], records(1)[:, 0])


def test_only_usable_depth_is_drawn(dataset):
    frame = dataset[0]
    frame.depth[:, :100] = 0
    frame.depth[:40] = np.nan
    pixels = sample_frame(frame, dataset.camera, settings())
    u, v = pixels.records[:, 0] & 0xFFFF, pixels.records[:, 0] >> 16
    assert (u >= 100).all()
    assert (v >= 40).all()
    assert pixels.valid_depth_share == pytest.approx(60 * 80 / (160 * 120))


def test_a_frame_without_depth_has_no_records(dataset):
    frame = dataset[0]
    frame.depth[:] = 0
    pixels = sample_frame(frame, dataset.camera, settings())
    assert pixels.records.shape == pixels.normals.shape == (0, 3)
    assert pixels.valid_depth_share == 0
    assert not pixels.depth_thumbnail.any()


def test_the_lattice_fits_the_frame_table(dataset):
    frame = dataset[0]
    depth_thumbnail = sample_frame(frame, dataset.camera, settings()).depth_thumbnail
    assert depth_thumbnail.shape == FrameTable(dataset.camera).depth_thumbnails.shape[1:]
    half = THUMBNAIL_STEP_PX // 2
    np.testing.assert_allclose(depth_thumbnail[2, 3], frame.depth[half + 32, half + 48], rtol=1e-3)


def test_one_buffer_holds_everything(dataset):
    frame, camera = dataset[0], dataset.camera
    pixels = sample_frame(frame, camera, settings())
    copy = pixels.holding(pixels.buffer.clone())
    for name in ("records", "normals", "depth_thumbnail"):
        assert torch.equal(getattr(copy, name), getattr(pixels, name))
        storage = getattr(copy, name).untyped_storage()
        assert storage.data_ptr() == copy.buffer.untyped_storage().data_ptr()
    assert copy.count == len(copy.records) == 15000
    assert pixels.to(torch.device("cpu")).valid_depth_share == pixels.valid_depth_share


def test_a_buffer_may_be_part_of_larger_memory(dataset):
    """As one frame's slot of those that the reading process shares."""
    pixels = sample_frame(dataset[0], dataset.camera, settings())
    words = len(pixels.buffer)
    memory = torch.zeros(3 * words + 1, dtype=torch.int32)
    memory[words + 1 : 2 * words + 1] = pixels.buffer
    other = pixels.holding(memory[words + 1 : 2 * words + 1])
    for name in ("records", "normals", "depth_thumbnail", "depth_image", "intensity_image"):
        one, same = getattr(pixels, name), getattr(other, name)
        assert one.dtype == same.dtype and torch.equal(one.float(), same.float()) and same.is_contiguous()
