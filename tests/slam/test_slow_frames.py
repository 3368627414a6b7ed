"""Recordings of few frames a second: the camera has moved far from one frame to the next, and noisy depth says little.

Each case was lost, or wrong and believed, in its last frame or just before.
"""

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.geometry import rotation_angle
from spslam.slam.system import SlamSystem

CASES = {
    # Most of what the camera sees lies beyond the range of depth: 58 features with depth agreed, 60 were wanted.
    "it looks up": ("arcade", "phone_lidar", "fast_turns", 530, 11),
    # It slid by 5.6 cm: an eigenvalue of 0.011 is little where pixels are off by 0.7 cm.
    "it slides on steps": ("stairwell", "phone_lidar", "walking", 530, 18),
    # A pose 8 degrees from the prediction was 1.3 cm off and not verified; features of later frames contradicted it.
    "it begins to turn": ("desk", "time_of_flight", "fast_turns", 540, 35),
}


# `make test` has the first.
@pytest.mark.parametrize(
    "case",
    [pytest.param(case, id=name, marks=[pytest.mark.slow] * bool(at)) for at, (name, case) in enumerate(CASES.items())],
)
def test_it_is_followed(case, device):
    place, sensor, motion, seed, frames = case
    options = [f"dataset.place={place}", f"dataset.sensor={sensor}", f"dataset.motion={motion}", f"dataset.seed={seed}"]
    config = load_config("places", "balanced", [*options, "dataset.frames=100", "dataset.rate_hz=8"])
    dataset = open_dataset(config.dataset)
    truth = dataset.poses()
    system = SlamSystem(config, dataset.camera, truth[0], device)
    for number in range(frames):  # they are up to 1.4 cm and 0.25 degrees off
        pose = system.process(dataset[number]).pose
        assert pose is not None, number
        assert np.linalg.norm(pose[:3, 3] - truth[number, :3, 3]) < 0.025, number
        assert rotation_angle(pose[:3, :3] @ truth[number, :3, :3].T) < np.radians(1.0), number
    system.close()
