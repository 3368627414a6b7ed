"""Image features of the last frame: those of its images as they were read, rectified as the camera moved then."""

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam import image_features
from spslam.slam.image_features import FrameFeatures, features_of_images
from spslam.slam.newest_frame import NewestFrame
from spslam.slam.pixels import image_pixels
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.row_copies import RowCopies

CAMERA = Camera(fx=150.0, fy=150.0, cx=79.5, cy=59.5, width=160, height=120)
MAX_DEPTH_M = 6.0
BEFORE = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
POSE = torch.tensor([0.99875, 0, 0.05, 0, 0.01, 0, 0])


def images():
    """Blocks of random brightness in front of a wall, of which the left third has no depth."""
    generator = np.random.default_rng(3)
    intensity = np.kron(generator.integers(0, 255, (15, 20), np.uint8), np.ones((8, 8), np.uint8))
    depth = np.full(intensity.shape, 20_000, np.uint16)
    depth[:, :53] = 0
    return intensity, depth


def newest_of(shutter, copies=None):
    intensity, depth = images()
    pixels = image_pixels(torch.from_numpy(depth), torch.from_numpy(intensity))
    newest = NewestFrame(CAMERA, MAX_DEPTH_M)
    newest.replace(7, FrameFeatures(pixels, CAMERA, MAX_DEPTH_M), shutter, copies)
    return newest


def motion(readout=0.02):
    return ops.ShutterMotion(BEFORE.clone(), POSE.clone(), 1 / 30, torch.tensor([readout]))


def assert_same(one, other):
    for name in ("descriptors", "positions", "points", "beyond_m"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("shutter", [None, motion()])
def test_features_are_those_of_the_images_rectified(shutter):
    expected = features_of_images(*images(), CAMERA, MAX_DEPTH_M)
    if shutter is not None:
        expected = ShutterRectifier(CAMERA, MAX_DEPTH_M).features(expected, shutter)
    found = newest_of(shutter).features()
    assert_same(found, expected)
    assert 20 < len(found.with_depth()) < len(found)


def test_poses_that_change_later_bend_nothing():
    shutter, copies = motion(), RowCopies()
    newest = newest_of(shutter, copies)
    copies.make()
    shutter.before.copy_(POSE)
    assert_same(newest.features(), newest_of(motion()).features())


def test_nothing_is_extracted_before_it_is_asked_for_nor_twice(monkeypatch):
    calls = []
    original = image_features.features_of_images
    monkeypatch.setattr(image_features, "features_of_images", lambda *args: calls.append(1) or original(*args))
    newest = newest_of(None)
    assert not calls
    newest.features()
    newest.features()
    assert len(calls) == 1


@pytest.mark.parametrize("shutter", [None, motion()])
def test_a_checkpoint_brings_them_back(shutter):
    newest, other = newest_of(shutter), NewestFrame(CAMERA, MAX_DEPTH_M)
    assert other.number == -1
    other.load_state_dict({name: tensor.clone() for name, tensor in newest.tensors().items()})
    assert other.number == 7
    assert_same(other.features(), newest.features())
