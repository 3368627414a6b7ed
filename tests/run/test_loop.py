"""When a GPU's frames are logged: several at a time, and none is left out or kept back while nothing comes."""

import json
import os
import signal
from types import SimpleNamespace

import pytest

from spslam.run.loop import LOGGED_TOGETHER, RunLoop

FRAMES = 60


class Pending:
    """A report that is done."""

    def __init__(self, number):
        self.number = number

    def is_done(self):
        return True

    def result(self):
        return SimpleNamespace(log_row=lambda: {"frame": self.number})


class Feed:
    """Frames that are there, but for some that have to be waited for; `before` is called with each one's number."""

    decode_seconds = 0.0

    def __init__(self, before, awaited=()):
        self.before, self.awaited, self.next = before, awaited, 0

    def __iter__(self):
        for number in range(FRAMES):
            self.before(number)
            self.next = number + 1
            yield number

    @property
    def is_ready(self):
        return self.next not in self.awaited

    def want_features(self, wanted):
        pass

    def look_ahead(self):
        pass


class System:
    """Tracks on a GPU, at once."""

    device = SimpleNamespace(type="cuda")
    config = SimpleNamespace(run=SimpleNamespace(checkpoint_every=0))
    features = SimpleNamespace(are_expected=False)
    while_tracking = None

    def submit(self, number):
        self.while_tracking()
        return Pending(number)

    def finish(self):
        pass


def loop(folder, feed):
    clock = SimpleNamespace(start_loop=lambda: None, update=lambda *_: None)
    paths = SimpleNamespace(log=folder / "log.jsonl", checkpoint=folder / "checkpoint")
    return RunLoop(System(), feed, SimpleNamespace(clock=clock, start=0, total=FRAMES, folder=paths), None)


def logged(folder):
    return [json.loads(line)["frame"] for line in (folder / "log.jsonl").read_text().splitlines()]


def test_frames_are_logged_several_at_a_time(tmp_path):
    counts = []
    loop(tmp_path, Feed(lambda number: counts.append(number - len(logged(tmp_path))))).run()
    assert logged(tmp_path) == list(range(FRAMES))
    assert max(counts) <= LOGGED_TOGETHER + 1


def test_what_is_done_is_logged_while_a_frame_is_waited_for(tmp_path):
    counts = {}
    loop(tmp_path, Feed(lambda number: counts.update({number: len(logged(tmp_path))}), awaited=(37,))).run()
    assert counts[37] == 37


def test_ctrl_c_leaves_no_frame_out_of_the_log(tmp_path):
    def interrupt(number):
        if number == 37:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        loop(tmp_path, Feed(interrupt)).run()
    assert logged(tmp_path) == list(range(38))
