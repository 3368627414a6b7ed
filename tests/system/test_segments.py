"""What a lost camera sees is mapped on its own, and joined with the map when the camera is known there again."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam.datasets.base import RgbdDataset
from spslam.datasets.generated import GeneratedDataset
from spslam.slam import segments
from spslam.slam.state import UnjoinedFrames
from spslam.slam.system import SlamSystem
from spslam.trajectory import Trajectory
from tests.system.sequences import run_on, settings

YOUNG_S, TIMES_AS_MANY = segments.YOUNG_S, segments.TIMES_AS_MANY
KNOWN, BLACK, ELSEWHERE = 12, 3, 30  # frames
CONFIG = ("graph.new_map_after_s=0.05", "mapping.iterations=3", "tracking.first_frames=2")
BACK = (*range(76, 54, -3),)  # from where nothing known is seen to where the first frames look
ORDER = (*range(0, 2 * KNOWN, 2), *[-1] * BLACK, *range(106, 76, -3), *BACK)
COUNT = len(ORDER)
AWAY = (*ORDER[: KNOWN + BLACK], *range(106, 78, -1))  # from where nothing known is seen
POSES = GeneratedDataset(300, 160, 120).poses()


class Frames(RgbdDataset):
    """The generated room's frames in the order of the test, -1 black, at 30 Hz."""

    name = "lost"

    def __init__(self, count=None, order=ORDER):
        self._room, self.order, self._count = GeneratedDataset(300, 160, 120), order, count or len(order)
        self.camera = self._room.camera

    def __len__(self):
        return self._count

    def timestamps(self):
        return np.arange(len(self)) / 30

    def poses(self):
        return None

    def truth(self):
        """float64 [F, 4, 4] where the camera was, black frames where the first one was."""
        return POSES[np.maximum(self.order, 0)]

    def read(self, index):
        frame = self._room[max(self.order[index], 0)]
        if self.order[index] < 0:
            frame.color[:], frame.depth[:] = 0, 0
        return replace(frame, index=index, timestamp=index / 30)


def lost_and_back(frames, stop_at=None, path=None):
    """A system after the frames, which was saved and loaded once before frame `stop_at`."""
    system = SlamSystem(settings(*CONFIG), frames.camera, POSES[0])
    for i in range(len(frames)):
        if i == stop_at:
            assert system.state.segment is not None
            system.save(path)
            system = SlamSystem.load(path)
        system.process(frames[i])
    return system


@pytest.fixture(scope="module")
def frames():
    return Frames()


@pytest.fixture(scope="module", params=["old", "young"])
def map_age(request):
    """A map of 12 frames has hardly begun; as if it were longer, and as if the segment were too short to replace it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments, *(("YOUNG_S", 0.0) if request.param == "old" else ("TIMES_AS_MANY", 1000)))
        yield request.param


@pytest.fixture(scope="module")
def joined(frames, map_age):
    system = lost_and_back(frames)
    assert system.state.segment is None
    system.finish()
    return system


def test_frames_seen_while_lost_get_poses_and_a_map(joined):
    trajectory = joined.trajectory()
    assert np.flatnonzero(trajectory.lost).tolist() == list(range(KNOWN, KNOWN + BLACK))
    known = ~trajectory.lost
    distance = np.linalg.norm(trajectory.poses[known, :3, 3] - POSES[np.array(ORDER)[known], :3, 3], axis=1)
    assert distance.max() < 0.005
    assert joined.segments() == []
    # Keyframes of the places that were seen while it was lost are the graph's.
    rows = joined.state.graph.rows
    assert (np.diff(rows) > 0).all()
    assert ((rows >= KNOWN + BLACK) & (rows < len(ORDER) - len(BACK))).sum() >= 2


@pytest.mark.parametrize("stop_at", [KNOWN + BLACK + 4, COUNT - 1])  # both maps know the last two frames
def test_resumed_within_a_segment_it_gives_the_same_bytes(frames, joined, tmp_path, stop_at):
    resumed = lost_and_back(frames, stop_at, tmp_path / "system")
    resumed.finish()
    np.testing.assert_array_equal(resumed.trajectory().poses, joined.trajectory().poses)
    one, other = (system.state.scene.volume for system in (resumed, joined))
    assert one.embeddings.equal(other.embeddings)


def test_frames_that_both_maps_know_are_in_one_file_only(joined, monkeypatch):
    rows = torch.arange(KNOWN - 2, KNOWN + 2)  # the first two are known in the map
    poses = torch.arange(28.0).reshape(4, 7)
    unjoined = [UnjoinedFrames(rows, poses), UnjoinedFrames(rows[:2], poses[:2])]
    monkeypatch.setattr(joined.state, "unjoined", unjoined)
    (segment,) = joined.segments()
    np.testing.assert_array_equal(segment.timestamps, joined.trajectory().timestamps[KNOWN : KNOWN + 2])
    np.testing.assert_array_equal(segment.poses[:, :3, 3], poses[2:, 4:])


def test_a_place_that_is_never_joined_is_kept_apart(frames):
    system = SlamSystem(settings(*CONFIG), frames.camera, POSES[0])
    voxels = 0
    for i in range(KNOWN + BLACK + 5):
        system.process(frames[i])
        voxels = system.state.scene.volume.num_voxels if i < KNOWN else voxels
    system.finish()
    assert system.trajectory().lost[KNOWN:].all()
    assert system.state.scene.volume.num_voxels == voxels
    (segment,) = system.segments()
    truth = POSES[np.array(ORDER)[KNOWN + BLACK : KNOWN + BLACK + 5]]
    assert len(segment) == 5
    np.testing.assert_allclose(segment.poses, np.linalg.inv(truth[0]) @ truth, atol=0.01)


def test_memory_of_a_system_goes_with_it(frames):
    """Without the garbage collector: a segment's map would else stay until that runs."""
    system = SlamSystem(settings(*CONFIG), frames.camera, POSES[0])
    system.close()
    state = weakref.ref(system.state)
    gc.disable()
    try:
        del system
        assert state() is None
    finally:
        gc.enable()


@pytest.fixture(scope="module")
def away():
    return Frames(order=AWAY)


def replacing(patch):
    """Rules as they are, whatever `map_age` is."""
    patch.setattr(segments, "YOUNG_S", YOUNG_S)
    patch.setattr(segments, "TIMES_AS_MANY", TIMES_AS_MANY)


@pytest.fixture(scope="module")
def replaced(away):
    with pytest.MonkeyPatch.context() as patch:
        replacing(patch)
        system = lost_and_back(away)
        system.finish()
        return system


def test_a_map_that_had_hardly_begun_is_replaced(replaced):
    """As of a recording that begins with a hand before the camera, or before that was taken up."""
    trajectory, first = replaced.trajectory(), KNOWN + BLACK
    assert np.flatnonzero(trajectory.lost).tolist() == list(range(first))
    expected = np.linalg.inv(POSES[AWAY[first]]) @ POSES[np.array(AWAY[first:])]
    moved = np.linalg.inv(trajectory.poses[first]) @ trajectory.poses[first:]
    assert np.linalg.norm(moved[:, :3, 3] - expected[:, :3, 3], axis=1).max() < 0.01
    # It goes on where the camera was seen last, to a frame's step, and what was known then is kept apart.
    seen, before = POSES[ORDER[KNOWN - 1], :3, 3], POSES[ORDER[KNOWN - 2], :3, 3]
    assert np.linalg.norm(trajectory.poses[first, :3, 3] - seen) < 1.5 * np.linalg.norm(seen - before)
    (before,) = replaced.segments()
    np.testing.assert_array_equal(before.timestamps, np.arange(KNOWN) / 30)
    assert replaced.state.graph.rows.min() >= first
    assert min(replaced.state.features.frames) >= first


@pytest.mark.parametrize("known", [5, 2 * KNOWN, 2 * KNOWN + 1])
def test_resumed_around_the_replacement_it_gives_the_same_bytes(away, replaced, tmp_path, monkeypatch, known):
    replacing(monkeypatch)
    first, system = KNOWN + BLACK, SlamSystem(settings(*CONFIG), away.camera, POSES[0])
    for i in range(len(away)):
        if i == first + known:
            assert (system.state.segment is None) == (known > 2 * KNOWN)
            system.save(tmp_path / "system")
            system = SlamSystem.load(tmp_path / "system")
        system.process(away[i])
    system.finish()
    np.testing.assert_array_equal(system.trajectory().poses, replaced.trajectory().poses)
    one, other = (each.state.scene.volume for each in (system, replaced))
    assert one.embeddings.equal(other.embeddings)


def test_without_the_option_none_begins(frames):
    system = SlamSystem(settings(*CONFIG, "graph.new_map_after_s=null"), frames.camera, POSES[0])
    for i in range(KNOWN + BLACK + 2):
        system.process(frames[i])
    assert system.state.segment is None


def test_a_run_writes_the_poses_of_segments(monkeypatch, tmp_path):
    metrics = run_on(monkeypatch, Frames(KNOWN + BLACK + 5), tmp_path / "run", *CONFIG)
    assert (metrics["lost_frames"], metrics["unjoined_frames"]) == (BLACK + 5, 5)
    segment = Trajectory.load_tum(tmp_path / "run" / "segment-1.txt")
    np.testing.assert_allclose(segment.timestamps, np.arange(KNOWN + BLACK, KNOWN + BLACK + 5) / 30, atol=1e-6)
