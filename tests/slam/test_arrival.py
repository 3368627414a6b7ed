"""Frames that come one at a time: what is extracted of them while they are tracked."""

import numpy as np
import pytest
import torch

from spslam.slam.arrival import FrameArrival
from spslam.slam.feature_store import INTERVAL
from spslam.slam.image_features import extract_features
from spslam.slam.pixels import sample_frame
from tests.system.sequences import Recorded, settings


@pytest.mark.parametrize(
    ("device", "number", "are_expected", "is_extracted"),
    [("cuda", 7, True, True), ("cuda", 7, False, False), ("cuda", INTERVAL, False, True), ("cpu", 7, True, False)],
)
def test_features_that_will_be_asked_for_are_extracted_beside_a_gpu(device, number, are_expected, is_extracted):
    dataset, config = Recorded(1), settings()
    largest_m = config.dataset.max_depth_m
    arrival = FrameArrival(config, dataset.camera, torch.device(device))
    prepared = arrival.prepare(dataset[0], number, are_expected)
    alone = sample_frame(dataset[0], dataset.camera, config)
    assert torch.equal(prepared.pixels.buffer, alone.buffer)
    assert (prepared.pixels.features is not None) == is_extracted
    found, wanted = (extract_features(pixels, dataset.camera, largest_m) for pixels in (prepared.pixels, alone))
    for name in ("descriptors", "positions", "points"):
        assert np.array_equal(getattr(found, name), getattr(wanted, name))
