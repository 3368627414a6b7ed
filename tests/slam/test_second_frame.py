"""The second frame of a run: nothing says how far the camera moved, and the map is that of one noisy image."""

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.slam.system import SlamSystem

FRAMES = 4


@pytest.mark.parametrize("seed", [107, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (108, 111))])
def test_it_does_not_slide_along_a_wall(seed, device):
    """Halls in which it slid by 4 to 5 cm, one of them into loss."""
    place = ["dataset.place=hall", "dataset.sensor=structured_light", "dataset.motion=walking"]
    config = load_config("places", "balanced", [*place, f"dataset.seed={seed}", "dataset.frames=300"])
    dataset = open_dataset(config.dataset)
    truth = dataset.poses()
    system = SlamSystem(config, dataset.camera, truth[0], device)
    for number in range(FRAMES):
        pose = system.process(dataset[number]).pose
        assert np.linalg.norm(pose[:3, 3] - truth[number, :3, 3]) < 0.025
