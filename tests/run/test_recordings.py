"""The frames of a map's recordings, read again."""

import numpy as np

from spslam.config import load_config
from spslam.run.recordings import read_again
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


def test_without_any_the_first_fault_is_named(tmp_path):
    folder = write_folder(tmp_path / "frames")
    recording = of(folder)
    for color in (folder / "color").iterdir():
        color.write_bytes(b"")
    frames, missing = read_again(KeyframeArchive([recording], [], [], None, [], set(), {}), [recording])
    assert frames[0].dataset is None and "its frames can't be read again" in missing[0]


def of(folder):
    config = load_config("folder", None, [f"dataset.path={folder}"])
    count = len(list((folder / "color").iterdir()))
    poses = np.tile(np.eye(4), (count, 1, 1))
    trajectory = Trajectory(np.arange(float(count)), poses, np.zeros(count, bool))
    return Recording("frames", {"dataset": config.dataset.model_dump(mode="json")}, None, trajectory)
