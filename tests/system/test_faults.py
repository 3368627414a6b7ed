"""A camera that is covered, carried away or cut off: loss is noticed, the map stays, and the camera is found again."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from experiments.fault_injection import COVERS, black_out, plan, run_trials
from spslam.config import load_config
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.generated import GeneratedDataset
from spslam.run.sequence import RunRequest, run_sequence
from spslam.trajectory import Trajectory
from tests.datasets.layouts import shared_data
from tests.system.sequences import Recorded, results, run_on, settings


@pytest.fixture(scope="module")
def outcomes():
    dataset = GeneratedDataset(150, 160, 120)
    return list(run_trials(settings(preset="fast"), dataset, plan(dataset, 1, 0), torch.device("cpu")))


def test_every_fault_is_noticed_and_the_camera_found_again(outcomes):
    assert sorted(outcome.trial.fault for outcome in outcomes) == ["black-out", "cover", "jump", "return"]
    for outcome in outcomes:
        assert outcome.passed, outcome
        assert outcome.wrong_unflagged == 0, outcome
        assert outcome.error_cm < 3, outcome


def test_the_map_is_not_touched_while_lost(outcomes):
    assert [outcome.voxels_added for outcome in outcomes] == [0] * 4


RECORDINGS = {"7scenes": "7scenes-redkitchen", "synthetic_rgbd": "synthetic-grey-white-room"}


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["fast", "balanced"])
@pytest.mark.parametrize("name", RECORDINGS)
def test_faults_in_recordings(name, preset):
    data = shared_data(RECORDINGS[name])
    config = load_config(name, preset, ["device=cpu"])
    dataset = open_sequence(config.dataset, data, slice(0, 160))
    for outcome in run_trials(config, dataset, plan(dataset, 1, 0), torch.device("cpu")):
        assert outcome.passed, outcome


class Edited(RgbdDataset):
    """The generated room's frames in an order of the test's own, some corrupted; they keep the times of a camera."""

    name = "edited"

    def __init__(self, order, changes=()):
        self.room, self.order, self.changes = Recorded(25), list(order), dict(changes)
        self.camera = self.room.camera

    def __len__(self):
        return len(self.order)

    def timestamps(self):
        return np.arange(len(self)) / 30

    def poses(self):
        return self.room.poses()[self.order]

    def read(self, index: int) -> RgbdFrame:
        frame = replace(self.room[self.order[index]], index=index, timestamp=index / 30)
        if index in self.changes:
            self.changes[index](frame, np.random.default_rng(index))
        return frame


BLACK = range(12, 18)
AWAY_AND_BACK = [*range(12), *range(12, 18), *range(4, 12)]


def test_the_trajectory_has_a_gap_where_the_camera_was_lost(monkeypatch, tmp_path):
    dataset = Edited(AWAY_AND_BACK, {i: black_out for i in BLACK})
    metrics = run_on(monkeypatch, dataset, tmp_path / "out", "run.previews=4", mesh=True)
    lines = (tmp_path / "out" / "trajectory.txt").read_text().splitlines()[1:]
    assert [i for i, line in enumerate(lines) if line.startswith("# lost")] == list(BLACK)
    assert (metrics["lost_frames"], metrics["tracking_failures"]) == (6, 1)
    assert metrics["ate_max_cm"] < 3  # of the frames whose pose is known
    found = Trajectory.load_tum(tmp_path / "out" / "trajectory.txt")
    np.testing.assert_allclose(found.poses[18:, :3, 3], dataset.poses()[18:, :3, 3], atol=0.03)
    log = [json.loads(line) for line in (tmp_path / "out" / "log.jsonl").read_text().splitlines()]
    assert all(log[i]["mapping_iterations"] == 0 for i in (*BLACK, 18, 19))
    assert all(line["error_probability"] < 0.1 for line in log[1:] if not line["lost"])


@pytest.mark.slow
def test_a_run_killed_while_lost_goes_on_to_the_same_bytes(monkeypatch, tmp_path):
    dataset = Edited(AWAY_AND_BACK, {i: COVERS[0] for i in BLACK})
    run_on(monkeypatch, dataset, tmp_path / "whole")

    def stop(done, total, report):
        if done == 15:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_on(monkeypatch, dataset, tmp_path / "cut", "run.checkpoint_every=1", progress=stop)
    run_sequence(RunRequest(settings("run.checkpoint_every=1"), None, tmp_path / "cut", resume=True, mesh=False))
    assert results(tmp_path / "whole") == results(tmp_path / "cut")
    assert Trajectory.load_tum(tmp_path / "cut" / "trajectory.txt").lost.nonzero()[0].tolist() == list(BLACK)


def test_repeated_and_dropped_frames_are_no_loss(monkeypatch, tmp_path):
    order = [0, 0, 1, 2, 3, 3, 3, 3, 4, 5, 9, 10, 10, 11, 16, 17, 18, 24]
    metrics = run_on(monkeypatch, Edited(order), tmp_path / "out")
    assert metrics["lost_frames"] == 0
    assert metrics["ate_max_cm"] < 1.5


def test_a_sudden_change_of_light_is_no_loss(monkeypatch, tmp_path):
    def dim(frame, random):
        frame.color[:] = frame.color // 4

    def flash(frame, random):
        frame.color[:] = np.minimum(3 * frame.color.astype(int) + 60, 255)

    changes = {i: dim for i in range(6, 12)} | {i: flash for i in range(15, 18)}
    metrics = run_on(monkeypatch, Edited(range(24), changes), tmp_path / "out")
    assert metrics["lost_frames"] == 0
    assert metrics["ate_max_cm"] < 1.5


def hand(frame, random):
    """Something 30 cm before the lens, over two fifths of the picture."""
    height, width = frame.depth.shape
    frame.depth[height // 4 :, : int(0.53 * width)] = 0.3 + random.normal(0, 0.003)
    frame.color[height // 4 :, : int(0.53 * width)] = (200, 150, 120)


def little_depth(frame, random):
    """Depth in a tenth of the picture."""
    frame.depth[:, : int(0.9 * frame.depth.shape[1])] = 0


@pytest.mark.parametrize("change", [hand, little_depth])
def test_part_of_the_view_missing_moves_no_pose(monkeypatch, tmp_path, change):
    dataset = Edited(range(24), {i: change for i in range(9, 16)})
    metrics = run_on(monkeypatch, dataset, tmp_path / "out")
    assert not Trajectory.load_tum(tmp_path / "out" / "trajectory.txt").lost[16:].any()
    assert metrics["lost_frames"] <= 2
    assert metrics["ate_max_cm"] < 2
    log = [json.loads(line) for line in (tmp_path / "out" / "log.jsonl").read_text().splitlines()]
    # A hand would be mapped at 10 and 15, and the camera held to it.
    assert change is not hand or all(log[i]["mapping_iterations"] == 0 for i in (10, 15))
