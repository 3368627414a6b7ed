"""The results of chunks: of each frame what its own chunk says, once."""

import numpy as np
import pytest

from spslam.run.chunk_results import own_segments
from spslam.run_folder import RunFolder
from spslam.trajectory import Trajectory


def poses(count):
    """Along x, and turned by a quarter about z from the second one on."""
    made = np.tile(np.eye(4), (count, 1, 1))
    made[1:, :2, :2] = [[0, -1], [1, 0]]
    made[:, 0, 3] = np.arange(count)
    return made


@pytest.fixture
def folder(tmp_path):
    """A run of ten frames, of which 2 to 8 are lost, in two segments: 3 to 5 and 7 to 9, the last one known."""
    lost = np.isin(np.arange(10), range(2, 9))
    times = 1700000000 + np.arange(10) / 30
    Trajectory(times, poses(10), lost).save_tum(tmp_path / "trajectory.txt")
    for number, rows in ((1, slice(3, 6)), (10, slice(7, 10))):
        Trajectory(times[rows], poses(3)).save_tum(RunFolder(tmp_path).segment(number))
    return RunFolder(tmp_path)


@pytest.mark.parametrize(
    ("own", "found"),
    [
        (slice(0, 10), [[3, 4, 5], [7, 8]]),
        (slice(0, 5), [[3, 4]]),
        (slice(4, 8), [[4, 5], [7]]),
        (slice(0, 3), []),
        (slice(9, 10), []),
    ],
)
def test_segments_are_of_own_frames_that_are_lost(folder, own, found):
    segments = own_segments(folder, own)
    times = Trajectory.load_tum(folder.trajectory).timestamps
    assert [np.searchsorted(times, segment.timestamps).tolist() for segment in segments] == found
    for segment in segments:
        np.testing.assert_allclose(segment.poses[0], np.eye(4), atol=1e-9)


def test_a_segment_that_is_cut_has_the_axes_of_its_first_frame(folder):
    (segment, _) = own_segments(folder, slice(4, 10))
    np.testing.assert_allclose(segment.poses[1, :3, 3], [0, -1, 0], atol=1e-9)
