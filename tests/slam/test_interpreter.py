"""Python's interpreter is handed over early while frames are processed, and as before afterwards."""

import sys

import pytest

from spslam.slam.interpreter import INTERPRETER_SHARE_S, interpreter_shared
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings


def test_the_interpreter_is_handed_over_early_in_the_block_only():
    before = sys.getswitchinterval()
    with pytest.raises(KeyError), interpreter_shared():
        assert sys.getswitchinterval() == pytest.approx(INTERPRETER_SHARE_S, abs=1.5e-6)
        raise KeyError
    assert sys.getswitchinterval() == before


def test_an_interval_that_is_shorter_stays():
    before = sys.getswitchinterval()
    sys.setswitchinterval(INTERPRETER_SHARE_S / 10)
    try:
        with interpreter_shared():
            assert sys.getswitchinterval() == pytest.approx(INTERPRETER_SHARE_S / 10)
    finally:
        sys.setswitchinterval(before)


def test_no_interval_changes_with_the_frames():
    before = sys.getswitchinterval()
    try:
        for interval_s in (0.005, 0.0029, 1.7e-4):
            sys.setswitchinterval(interval_s)
            known = sys.getswitchinterval()
            for _ in range(100):
                with interpreter_shared(), interpreter_shared():
                    assert sys.getswitchinterval() == pytest.approx(INTERPRETER_SHARE_S, abs=1.5e-6)
            assert sys.getswitchinterval() == known
    finally:
        sys.setswitchinterval(before)


def test_it_is_so_while_a_frame_is_processed():
    dataset, before, intervals = Recorded(2), sys.getswitchinterval(), []
    system = SlamSystem(settings(), dataset.camera)
    for frame in dataset:
        system.process(frame, lambda pose: intervals.append(sys.getswitchinterval()))
    assert intervals == [pytest.approx(INTERPRETER_SHARE_S, abs=1.5e-6)] * 2
    assert sys.getswitchinterval() == before
