"""How long a camera is lost for before another map begins: by the recording's own clock."""

from types import SimpleNamespace

import pytest
import torch

from spslam.slam.segments import _lost_s


def state_of(seconds, lost, opened=0):
    frames = SimpleNamespace(timestamps=torch.tensor(seconds), lost=torch.tensor(lost), opened=opened)
    return SimpleNamespace(frames=frames)


def test_since_the_last_known_frame_or_the_first():
    assert _lost_s(state_of([0.0, 1.0, 2.5], [False, False, True])) == pytest.approx(1.5)
    assert _lost_s(state_of([4.0, 5.0, 6.5], [True, True, True])) == pytest.approx(2.5)


@pytest.mark.parametrize("start_s", [0.0, 1000.0, -1000.0])
def test_frames_of_an_opened_map_have_another_clock(start_s):
    seconds = [0.1, 0.3, start_s, start_s + 0.5]
    assert _lost_s(state_of(seconds, [False, False, True, True], opened=2)) == pytest.approx(0.5)
