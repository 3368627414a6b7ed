"""Frames that come one at a time: where they are sampled, and what is extracted of them while they are tracked."""

import numpy as np
import pytest
import torch

from spslam.slam.arrival import FrameArrival
from spslam.slam.feature_store import INTERVAL
from spslam.slam.image_features import extract_features
from spslam.slam.pixels import sample_frame
from spslam.slam.upload import Upload
from tests.system.sequences import Recorded, settings

NORMAL_TOLERANCE = 1e-4  # devices differ by rounding


def received(prepared):
    pixels = prepared.pixels
    return pixels.received() if isinstance(pixels, Upload) else pixels


def test_pixels_are_those_of_the_cpu(device):
    dataset, config = Recorded(3), settings()
    arrival = FrameArrival(config, dataset.camera, device)
    for number in range(3):  # the memory that frames pass through is used again
        frame = dataset[number]
        pixels = received(arrival.prepare(frame, number, False))
        wanted = sample_frame(frame, dataset.camera, config)
        assert pixels.buffer.device.type == device.type
        assert pixels.valid_depth_share == wanted.valid_depth_share > 0
        assert torch.equal(pixels.records[:, :2].cpu(), wanted.records[:, :2])
        assert (pixels.normals.cpu() - wanted.normals).abs().max() <= NORMAL_TOLERANCE
        for image in ("depth_image", "intensity_image", "depth_thumbnail"):
            assert torch.equal(getattr(pixels, image).cpu(), getattr(wanted, image))
    arrival.close()


@pytest.mark.parametrize(
    ("number", "are_expected", "is_extracted"), [(7, True, True), (7, False, False), (INTERVAL, False, True)]
)
def test_features_that_will_be_asked_for_are_extracted_beside_a_gpu(device, number, are_expected, is_extracted):
    dataset, config = Recorded(1), settings()
    largest_m = config.dataset.max_depth_m
    arrival = FrameArrival(config, dataset.camera, device)
    frame = dataset[0]
    pixels = received(arrival.prepare(frame, number, are_expected))
    wanted = extract_features(sample_frame(frame, dataset.camera, config), dataset.camera, largest_m)
    frame.color[:], frame.depth[:] = 0, 0  # whoever took the frame may do so
    assert (pixels.features is not None) == (is_extracted and device.type == "cuda")
    found = extract_features(pixels, dataset.camera, largest_m)
    for name in ("descriptors", "positions", "points"):
        assert np.array_equal(getattr(found, name), getattr(wanted, name))
    arrival.close()
