"""What a viewer knows of a run, and what it draws from it."""

import json
import math
import threading
import time
from multiprocessing import Pipe

import numpy as np
import pytest

from spslam.viewer import segments
from spslam.viewer.colors import AHEAD, error_probability_colors
from spslam.viewer.curves import CURVES, MAX_POINTS, known_curves
from spslam.viewer.model import RunInfo, RunModel
from spslam.viewer.panel import describe
from spslam.viewer.player import LivePlayer, ReplayPlayer
from spslam.viewer.protocol import MapSnapshot, Request, Row, Update, closed_loops, receive, send
from spslam.viewer.worker import NewestWorker
from tests.viewer.worlds import CAMERA, model, row, straight


def test_updates_append_and_refined_poses_replace():
    made = model(300)
    made.update(Update(300, [row(300)], straight(300, 1)))
    assert len(made) == 301
    np.testing.assert_allclose(made.poses[300, :3, 3], [30, 0, 0], atol=1e-5)
    refined = straight(0, 301)
    refined[:, 5] = 1
    made.set_poses(refined)
    np.testing.assert_allclose(made.poses[:, 1, 3], 1)


def test_frames_that_were_never_sent_repeat_the_last_pose():
    made = model(3)
    made.update(Update(5, [row(5)], straight(5, 1)))
    np.testing.assert_allclose(made.poses[:, 0, 3], [0, 0.1, 0.2, 0.2, 0.2, 0.5], atol=1e-6)
    assert np.isnan(made.column("residual_cm")[3:5]).all()


def test_ground_truth_begins_where_the_estimate_does():
    truth = np.tile(np.eye(4), (4, 1, 1))
    truth[:, 1, 3] = 7 + 0.1 * np.arange(4)
    made = RunModel(RunInfo("test", CAMERA, 4, (0.1, 5.0)), truth)
    made.update(Update(0, [row(0), row(1)], straight(1, 2)))
    np.testing.assert_allclose(made.ground_truth[0, :3, 3], [0.1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(made.ground_truth[3, :3, 3], [0.1, 0.3, 0], atol=1e-6)
    assert len(segments.ground_truth(made)) == 3


def test_lost_frames_break_the_path_and_are_bridged():
    made = RunModel(RunInfo("test", CAMERA, 5, (0.1, 5.0)))
    made.update(Update(0, [row(i, lost=i in (2, 3)) for i in range(5)], straight(0, 5)))
    path = segments.path(made, 4)
    lengths = np.linalg.norm(path.points[:, 1] - path.points[:, 0], axis=1)
    np.testing.assert_allclose(lengths, [0.1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(segments.lost_stretches(made).points[0, :, 0], [0.1, 0.4], atol=1e-6)


def test_path_is_gray_after_the_shown_frame():
    path = segments.path(model(6), 2)
    assert (path.colors[2:] == AHEAD).all()
    assert not (path.colors[:2] == AHEAD).any()


def test_keyframes_are_frusta_at_mapped_frames():
    assert len(segments.keyframes(model(11))) == 3 * 8


def test_error_probability_goes_from_blue_to_red():
    colors = error_probability_colors(np.array([0.0, 1.0, np.nan]))
    assert colors[0, 2] > colors[0, 0]
    assert colors[1, 0] > colors[1, 2]
    assert colors[2].std() < 20


def test_curves_are_reduced_and_have_no_gaps():
    made = model(3 * MAX_POINTS + 1, memory_mb=math.nan)
    assert "memory_mb" not in [curve.column for curve in known_curves(made)]
    for curve in known_curves(made):
        frames, values = curve.points(made)
        assert len(frames) == len(values) <= MAX_POINTS
        assert np.isfinite(values).all()
    assert len(CURVES) == 5


def test_line_of_the_log_becomes_a_row():
    line = {"index": 3, "timestamp": 0.5, "lost": False, "error_probability": None, "tracking_ms": 4, "mapping_ms": 6}
    made = Row.of_log({**line, "mapping_iterations": 2})
    assert (made.source_index, made.mapped, made.fps) == (3, True, 100.0)
    assert math.isnan(made.error_probability)
    # A live run optimizes the map after frames that were not fused, too.
    assert not Row.of_log({**line, "mapping_iterations": 2, "encode_ms": 0.0}).mapped
    assert math.isnan(Row.of_log({}).timestamp)


def test_requests_survive_the_socket():
    asked = Request(update=True, map=True, paused=False)
    assert Request.decode(json.dumps(vars(asked)).encode()) == asked == Request.decode(asked.encode())


def test_maps_survive_the_socket():
    """Their large arrays are not pickled, and can be written to, as torch wants it."""
    arrays = {"large": np.arange(1 << 16).reshape(2, -1), "small": np.arange(3), "none": np.zeros((0, 3))}
    own, other = Pipe()
    with own, other:
        sender = threading.Thread(target=send, args=(own, MapSnapshot(arrays, straight(0, 2))))
        sender.start()
        received = receive(other)
        sender.join()
    assert isinstance(received, MapSnapshot)
    np.testing.assert_array_equal(received.poses, straight(0, 2))
    assert list(received.tensors) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(received.tensors[name], array)
        assert received.tensors[name].dtype == array.dtype
    assert received.tensors["large"].flags.writeable


def test_state_is_told_in_words():
    assert describe(model(3), 1).startswith("**tracked**, frame 2 of 3")
    assert "LOST" in describe(model(3, lost=True), 1)
    assert describe(model(3), 9) == "waiting for the first frame"


def test_live_player_pauses_and_steps():
    sent = []
    player = LivePlayer(sent.append)
    player.step()
    player.toggle()
    assert [(request.paused, request.step) for request in sent] == [(True, False), (None, True), (False, False)]


def test_replay_player_plays_seeks_and_steps():
    shown = []
    player = ReplayPlayer(np.arange(5) * 0.01, shown.append)
    player.seek(2)
    player.step()
    player.seek(99)
    assert shown == [2, 3, 4]
    player.toggle()
    deadline = 200
    while player.is_playing and deadline:
        time.sleep(0.05)
        deadline -= 1
    assert shown[3:8] == [0, 1, 2, 3, 4]


def test_replay_player_ends_its_thread_while_it_plays():
    shown = []
    player = ReplayPlayer(np.arange(5.0), shown.append)
    player.toggle()
    for _ in range(2):
        player.close()
    count = len(shown)
    for act in (player.toggle, player.step, lambda: player.seek(1)):
        act()
    assert not player._thread.is_alive() and not player.is_playing
    assert len(shown) == count <= 1


def test_closed_worker_takes_nothing():
    done = []
    worker = NewestWorker(done.append, "test")
    worker.close()
    worker.submit(1)
    assert worker.wait_until_idle(0) and done == []


def test_worker_skips_to_the_newest():
    release, done = threading.Event(), []

    def work(item):
        done.append(item)
        release.wait(5)

    worker = NewestWorker(work, "test")
    worker.submit(1)
    while not done:
        release.wait(0.01)
    for item in (2, 3, 4):
        worker.submit(item)
    release.set()
    assert worker.wait_until_idle(5)
    worker.close()
    assert done == [1, 4]


@pytest.mark.parametrize("count", [0, 1])
def test_runs_without_a_path_can_be_drawn(count):
    made = model(count)
    assert len(segments.path(made, 0)) == len(segments.lost_stretches(made)) == 0


def test_loops_are_drawn_from_frame_to_frame():
    made = model(6)
    made.update(Update(6, [row(6)], straight(6, 1), loops=[(5, 0), (6, 1)]))
    made.update(Update(7, [row(7)], straight(7, 1)))
    assert made.loops == [(5, 0), (6, 1)]
    lines = segments.loops(made)
    np.testing.assert_allclose(lines.points[1], made.poses[[6, 1], :3, 3])
    made.loops.append((99, 0))  # of a frame that was not sent
    assert len(segments.loops(made)) == 2


def test_loops_of_a_log_that_may_hold_anything():
    accepted = {"source": 9, "target": 2, "accepted": True, "reason": "", "correction_m": 0.1}
    refused = {**accepted, "accepted": False}
    lines = [{}, {"loops": None}, {"loops": [accepted, refused, 3, {"source": "x"}]}, {"loops": 5}]
    assert closed_loops(lines) == [(9, 2)]


def test_poses_of_tracked_frames_are_as_many_as_have_come():
    made = model(6)
    made.update(Update(6, [row(6)._replace(lost=True), row(7)], straight(6, 2)))
    np.testing.assert_allclose(made.tracked_poses(7)[:, 0, 3], made.poses[:6, 0, 3])
    assert len(made.tracked_poses(100)) == 7
