"""The plan of trials: no frame is processed twice, and the camera returns to places that were mapped."""

import pytest
import torch

from experiments.fault_injection import BACK_FRAMES, STEP, copy_of, plan, plan_black_outs, try_fault
from spslam.datasets.generated import GeneratedDataset
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings


@pytest.mark.parametrize("frames", [150, 400])
def test_plan(frames):
    trials = plan(GeneratedDataset(frames, 16, 16), 10, seed=3)
    assert len(trials) == 40
    assert [trial.place for trial in trials] == sorted(trial.place for trial in trials)
    for trial in trials:
        assert trial.place > BACK_FRAMES
        assert len(trial.back) == BACK_FRAMES
        for shown in trial.back:
            assert shown.index % STEP == 1
            assert 0 < shown.index < STEP * (trial.place - 1)
        assert all(STEP * trial.place <= shown.index < frames for shown in trial.during)
    assert len({trial.back[0].index for trial in trials}) > 5
    assert plan(GeneratedDataset(frames, 16, 16), 10, seed=3) == trials


def test_a_copy_tracks_as_the_system_does(tmp_path):
    dataset = Recorded(3)
    system = SlamSystem(settings("device=cpu", preset="fast"), dataset.camera, dataset.poses()[0])
    for index in range(2):
        system.process(dataset[index])
    copy = copy_of(system, dataset.poses()[0], tmp_path / "state")
    for each in (system, copy):
        each.process(dataset[2])
    assert torch.equal(copy.state.frames.poses, system.state.frames.poses)


def test_black_outs_end_elsewhere_and_time_goes_on():
    """The camera is found after it, and what it saw in between has poses."""
    dataset = Recorded(40)
    (trial,) = plan_black_outs(dataset, 1, 0, [0.2], between=4)
    assert [shown.change is None for shown in trial.during] == [False] * 6 + [True] * 4
    assert trial.during[6].index == STEP * trial.place + 6
    none = plan_black_outs(dataset, 1, 0, [0.2])[0]
    assert len(none.during) == 6
    assert none.back == trial.back
    system = SlamSystem(settings("device=cpu", preset="fast"), dataset.camera, dataset.poses()[0])
    for i in range(trial.place):
        system.process(dataset[STEP * i])
    outcome = try_fault(system, dataset, trial)
    times = system.state.frames.timestamps
    assert bool((times[1:] > times[:-1]).all())
    assert outcome.seen == 4
    assert outcome.kept + outcome.kept_apart <= 4
