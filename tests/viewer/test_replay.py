"""A finished run in the browser ends with what it was made of."""

import gc
import threading
import time
import weakref

import numpy as np
import pytest

from tests.viewer.worlds import replay

pytest.importorskip("viser", reason="viser is not installed: pip install 'spslam[viewer]'")


def play_and_close():
    """Closes a replay while it plays; returns how long that took, s, and a weak reference to what it held."""
    with replay() as opened:
        player, shown = opened._player, []
        show = player._show
        player._show = lambda frame: shown.append(frame) or show(frame)
        player._pauses_s = np.full(10_000, 0.02)  # it would play for minutes
        player.seek(0)
        player.toggle()
        deadline = time.monotonic() + 30
        while len(shown) < 3:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        held, started = weakref.ref(opened._model), time.monotonic()
    return time.monotonic() - started, held


def test_a_replay_that_plays_ends_at_once_and_leaves_nothing():
    before = set(threading.enumerate())
    seconds, held = play_and_close()
    assert seconds < 3
    for thread in set(threading.enumerate()) - before:
        if thread.name.startswith("spslam-viewer"):
            thread.join(30)
            assert not thread.is_alive(), thread.name
    deadline = time.monotonic() + 30  # threads of the server end when they come to it
    while held() is not None and time.monotonic() < deadline:
        time.sleep(0.05)
        gc.collect()
    assert held() is None
