"""The frames of a map's recordings, read again."""

import re
from dataclasses import replace

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.run.recordings import read_again, source_of
from spslam.run.request import RunRequest
from spslam.slam.graph.archive import KeyframeArchive, Recording
from spslam.trajectory import Trajectory
from tests.datasets.layouts import write_folder


def test_a_first_frame_that_can_not_be_read_is_no_reason(tmp_path):
    folder = write_folder(tmp_path / "frames")
    recording = of(folder)
    for color in sorted((folder / "color").iterdir())[:1]:
        color.write_bytes(b"")
    frames, missing = read_again(KeyframeArchive([recording], [], [], None, [], set(), {}), [recording])
    assert missing == [] and len(frames[0].dataset) == len(recording.trajectory)


def test_paths_hold_in_any_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = load_config("folder", overrides=["dataset.path=frames", "dataset.mask=mask.png"])
    source = source_of(RunRequest(config, None, tmp_path / "out"))["dataset"]
    assert (source["path"], source["mask"]) == (str(tmp_path / "frames"), str(tmp_path / "mask.png"))
    free = config.model_copy(update={"dataset": config.dataset.model_copy(update={"mask": "none"})})
    assert source_of(RunRequest(free, None, tmp_path / "out"))["dataset"]["mask"] == "none"


def test_without_any_the_first_fault_is_named(tmp_path):
    folder = write_folder(tmp_path / "frames")
    recording = of(folder)
    for color in (folder / "color").iterdir():
        color.write_bytes(b"")
    frames, missing = read_again(KeyframeArchive([recording], [], [], None, [], set(), {}), [recording])
    assert frames[0].dataset is None and "its frames can't be read again" in missing[0]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda each: replace(each, camera=replace(each.camera, fx=each.camera.fx + 1)), "is of another camera now"),
        (lambda each: replace(each, trajectory=shifted(each.trajectory)), "none of its frames is in .* any more"),
    ],
)
def test_other_data_in_its_place_is_not_taken_for_it(tmp_path, change, reason):
    """It was fused with its own camera, or ended the run because no frame of it had a pose."""
    recording = change(of(write_folder(tmp_path / "frames")))
    frames, missing = read_again(KeyframeArchive([recording], [], [], None, [], set(), {}), [recording])
    assert frames[0].dataset is None
    assert re.fullmatch(f"the mesh is of the map alone where frames was: .*{reason}", missing[0])


def shifted(trajectory):
    return Trajectory(trajectory.timestamps + 1000.0, trajectory.poses, trajectory.lost)


def of(folder):
    config = load_config("folder", None, [f"dataset.path={folder}"])
    count = len(list((folder / "color").iterdir()))
    poses = np.tile(np.eye(4), (count, 1, 1))
    dataset = open_dataset(config.dataset)
    trajectory = Trajectory(dataset.timestamps(), poses, np.zeros(count, bool))
    return Recording("frames", {"dataset": config.dataset.model_dump(mode="json")}, dataset.camera, trajectory)
