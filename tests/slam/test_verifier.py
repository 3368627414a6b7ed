"""Verification of several poses of one frame: what is the same for all of them is counted once."""

import pytest

from spslam.slam.fit import Fit
from spslam.slam.pixels import sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.verifier import Verifier
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings


def test_the_maps_coverage_is_counted_once_a_frame(monkeypatch):
    dataset = Recorded(12)
    system = SlamSystem(settings(), dataset.camera, dataset.poses()[0])
    for i in range(8):
        system.process(dataset[i])
    verifier, counted, count = system.recovery._verifier, [], Verifier._map_coverage
    monkeypatch.setattr(Verifier, "_map_coverage", lambda *args: counted.append(count(*args)) or counted[-1])

    def coverage(pixels, frame):
        pose = pose_tensor(dataset.poses()[frame], system.device)
        return verifier.verified(Fit(), pose, system.state.scene, pixels, system.history).map_coverage

    pixels = sample_frame(dataset[10], dataset.camera, system.config)
    first = coverage(pixels, 10)
    assert 0 < first <= 1
    assert coverage(pixels, 9) == first and len(counted) == 1
    system.process(dataset[8])  # the last trusted frame is another
    assert coverage(pixels, 10) == pytest.approx(float(counted[-1])) and len(counted) == 2
    coverage(sample_frame(dataset[10], dataset.camera, system.config), 10)
    assert len(counted) == 3
