"""What a run changes of its process's threads, and that it puts it back."""

import sys

import pytest

from spslam.run.threads import INTERPRETER_SHARE_S, interpreter_shared


def test_the_interpreter_is_handed_over_early_during_a_run_only():
    before = sys.getswitchinterval()
    with pytest.raises(KeyError), interpreter_shared():
        assert sys.getswitchinterval() == pytest.approx(INTERPRETER_SHARE_S)
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
