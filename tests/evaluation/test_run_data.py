"""The data of a finished run read again: another camera, missing frames, and frames that can't be read."""

from dataclasses import replace

import numpy as np
import pytest

from spslam.datasets.base import Subset
from spslam.datasets.generated import GeneratedDataset
from spslam.errors import DatasetError, OutputError
from spslam.evaluation.run_data import data_of_run
from spslam.evaluation.run_output import RunOutput
from spslam.run_folder import RunFolder
from spslam.trajectory import Trajectory


class Damaged(Subset):
    """A dataset with two unreadable frames."""

    def read(self, index):
        if index in (2, 6):
            raise DatasetError(f"frame {index} is broken")
        return super().read(index)


@pytest.fixture
def dataset():
    return GeneratedDataset(frames=8, width=40, height=30)


def run_over(dataset, tmp_path, camera=None):
    trajectory = Trajectory(dataset.timestamps(), dataset.poses())
    return RunOutput(RunFolder(tmp_path / "run"), trajectory, None, {}, [], "", camera or dataset.camera)


def test_the_same_data_is_read_without_a_word(dataset, tmp_path):
    again, missing = data_of_run(run_over(dataset, tmp_path), dataset)
    np.testing.assert_array_equal(again[3].depth, dataset[3].depth)
    np.testing.assert_array_equal(again.depth(3), dataset.depth(3))
    assert missing == again.unreadable_in_words() == [] and len(again) == 8
    assert again.surface is dataset.surface


@pytest.mark.parametrize("change", [{"width": 41}, {"height": 29}, {"fx": 39.0}, {"cy": 14.0}])
def test_another_camera_is_refused(dataset, tmp_path, change):
    run = run_over(dataset, tmp_path, replace(dataset.camera, **change))
    with pytest.raises(OutputError, match="the data has changed since the run, whose camera was .*; that of .* is"):
        data_of_run(run, dataset)


def test_a_rounded_calibration_is_the_same_camera(dataset, tmp_path):
    data_of_run(run_over(dataset, tmp_path, replace(dataset.camera, fx=dataset.camera.fx + 1e-3)), dataset)
    data_of_run(replace(run_over(dataset, tmp_path), camera=None), dataset)


def test_frames_that_are_no_longer_there_are_counted(dataset, tmp_path):
    _, missing = data_of_run(run_over(dataset, tmp_path), Subset(dataset, 0, 7))
    assert missing == [f"1 of 8 frames of the run is not in {dataset.name} any more"]


def test_frames_that_cannot_be_read_are_counted_once(dataset, tmp_path):
    again, missing = data_of_run(run_over(dataset, tmp_path), Damaged(dataset))
    for index in (1, 2, 6, 2):
        for read in (again.depth, again.__getitem__):
            try:
                read(index)
            except DatasetError:
                assert index in (2, 6)
    (line,) = again.unreadable_in_words()
    assert missing == [] and line.startswith("2 frames of the run can't be read and are left out, the first: ")
    assert "frame 2" in line
