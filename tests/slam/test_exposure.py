"""A camera whose exposure changes: the gain of each frame's brightness is found, kept with the frames, and goes on."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.slam.frame_table import FrameTable
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings

COUNT = 14
# The gains of frames, and in all of them nothing becomes white.
GAINS = [1.0, 1.0, 0.95, 0.9, 0.9, 0.8, 0.7, 0.65, 0.6, 0.6, 0.7, 0.8, 0.8, 0.8]


def darkened(frame: RgbdFrame) -> None:
    frame.color[:] = (frame.color * GAINS[frame.index]).round()


def run(dataset, *overrides, lost_from=COUNT):
    """The system after all frames, of which those from `lost_from` on have no depth."""
    system = SlamSystem(settings("device=cpu", *overrides), dataset.camera, dataset.poses()[0])
    for frame in dataset:
        if frame.index >= lost_from:
            frame = replace(frame, depth=np.zeros_like(frame.depth))
        system.process(frame)
    return system


def test_gains_are_found_and_kept_with_the_frames(tmp_path):
    system = run(Recorded(COUNT, darkened))
    found = system.state.frames.gains[:, 0].exp()
    torch.testing.assert_close(found, torch.tensor(GAINS), rtol=0, atol=0.02)
    history = system.history
    assert torch.equal(history.log_gain(7), system.state.frames.gains[7, :1])
    exposure = history.depth_keyframes().exposure
    assert torch.equal(exposure.frame, system.state.frames.gains[-1])
    assert len(exposure.log_gains) == len(system.state.frames.pose_rows)
    system.save(tmp_path / "saved")
    assert torch.equal(SlamSystem.load(tmp_path / "saved").state.frames.gains, system.state.frames.gains)


def test_poses_are_as_right_as_with_an_even_exposure():
    errors = [
        np.abs(run(dataset).trajectory().poses[:, :3, 3] - dataset.poses()[:, :3, 3]).max()
        for dataset in (Recorded(COUNT, darkened), Recorded(COUNT))
    ]
    assert errors[0] < 1.5 * errors[1] + 2e-4


def test_noise_of_brightness_is_not_that_of_exposure():
    models = [run(Recorded(COUNT, change)).state.noise.model for change in (darkened, None)]
    assert float(models[0][2]) < 1e-4  # a deviation of 1 % of white; the gains alone are 40 %
    assert float(models[0][3]) < 2 * float(models[1][3]) + 0.01


def test_an_even_exposure_has_no_gain():
    assert run(Recorded(COUNT)).state.frames.gains[:, 0].abs().max() < 0.01


def test_a_lost_frame_has_the_gain_of_the_one_before():
    system = run(Recorded(COUNT, darkened), lost_from=9)
    gains = system.state.frames.gains[:, 0]
    assert system.state.frames.lost[9:].all()
    assert float(gains[8].exp()) == pytest.approx(GAINS[8], abs=0.02)
    assert (gains[9:] == gains[8]).all()


@pytest.mark.parametrize("overrides", [["tracking.color=false"], ["tracking.depth_keyframes=false"]])
def test_without_brightness_there_are_no_gains(overrides):
    system = run(Recorded(6, darkened), *overrides)
    assert not system.state.frames.gains[:, 0].any()


def test_rows_of_a_table_carry_gains_on(device):
    table = FrameTable(Camera(64, 48, 50.0, 50.0, 31.5, 23.5), device)
    pose, thumbnail = torch.tensor([1.0, 0, 0, 0, 0, 0, 0]), torch.zeros(3, 4, dtype=torch.float16)
    for number, gain in enumerate((None, 0.25, None, None, -0.5, None)):
        known = None if gain is None else torch.tensor([gain, 0.1], device=device)
        table.append(pose, 0.1 * number, number, gain is None, thumbnail, gain=known)
    assert table.log_gain_rows[:6, 0].tolist() == [0.0, 0.25, 0.25, 0.25, -0.5, -0.5]
