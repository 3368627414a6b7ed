"""A frame that comes later than others, as where frames were dropped, is predicted where the camera is by then."""

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.slam.system import SlamSystem

KEPT = [*range(12), 15, 16, 18, 19]


@pytest.mark.parametrize("rolling_shutter_ms", [0, 20])  # predicted by one op, or together with what it rectifies
def test_the_camera_is_predicted_where_it_is_by_then(rolling_shutter_ms, device):
    places = {"place": "room", "motion": "walking", "frames": 60, "seed": 3, "width": 320, "height": 240}
    places["rolling_shutter_ms"] = rolling_shutter_ms
    settings = [f"dataset.{name}={value}" for name, value in places.items()]
    config = load_config("places", "balanced", [*settings, "tracking.moving_objects=false"])  # predicts by features
    dataset = open_dataset(config.dataset)
    truth = dataset.poses()
    system = SlamSystem(config, dataset.camera, truth[0], device)
    for before, number in zip([0, *KEPT], KEPT, strict=False):
        fit = system.process(dataset[number]).fit
        if number >= 4:
            way_cm = 100 * np.linalg.norm(truth[number, :3, 3] - truth[before, :3, 3])
            # Another step like the last one misses 0.5 to 2 of it where a step is half, twice or more as long.
            assert fit.prediction_error_cm < 0.4 * way_cm, number
    system.close()
