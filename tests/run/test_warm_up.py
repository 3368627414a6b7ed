"""The warm-up runs what a run will, and does not change its results."""

import pytest

from spslam.run.warm_up import FRAMES, warm_up
from tests.system.sequences import Recorded, results, run_on, settings


@pytest.mark.parametrize("preset", ["balanced", "paper"])
def test_frames_are_tracked_and_mapped(device, preset):
    reports = warm_up(settings(preset=preset), Recorded(1).camera, device)
    assert len(reports) == FRAMES
    assert not any(report.lost for report in reports)
    assert all(report.mapping_iterations for report in reports)
    assert all(report.tracking_iterations for report in reports[1:])


def test_depth_range_without_the_default_distance(device):
    config = settings("dataset.min_depth_m=3", "dataset.max_depth_m=4")
    assert not any(report.lost for report in warm_up(config, Recorded(1).camera, device))


def test_results_do_not_depend_on_warm_up(monkeypatch, tmp_path, device):
    options = ("mapping.first_iterations=5", f"device={device}")
    run_on(monkeypatch, Recorded(6), tmp_path / "one", *options)
    warm_up(settings("seed=5"), Recorded(1).camera, device)
    run_on(monkeypatch, Recorded(6), tmp_path / "two", *options)
    assert results(tmp_path / "one") == results(tmp_path / "two")


def test_limits_of_the_run_are_not_those_of_the_warm_up(device):
    config = settings("scene.max_voxels=1000", "pixels.per_frame=2000", "pixels.budget_mb=0.05")
    assert len(warm_up(config, Recorded(1).camera, device)) == FRAMES
