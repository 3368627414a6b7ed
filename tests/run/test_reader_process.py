"""Frames read by another process: fallback to threads, and what happens when either process ends."""

import importlib
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest
import torch

from spslam import helper_process
from spslam.errors import SpslamError
from spslam.run import frame_feed, reader_launch
from spslam.run.frame_feed import SENT_TOGETHER, FrameFeed
from spslam.run.reader_launch import READERS
from spslam.run.reader_process import ReaderProcess
from spslam.run.reader_service import serve
from spslam.run.standby import end_standby, launch_standby
from spslam.slam.device_events import HostEvent
from spslam.slam.pixels import sample_frame
from spslam.slam.upload import Upload
from tests.system.sequences import Recorded, settings

CPU = torch.device("cpu")
FRAMES = 6
PATIENCE_S = 60
ROOT = Path(__file__).parents[2]


def feed_of(dataset: Recorded, reader: str = "process", ahead: int = 2) -> FrameFeed:
    options = f"run.reader={reader}", "run.prefetch_workers=1", f"run.prefetch_ahead={ahead}"
    return FrameFeed(dataset, settings(*options), CPU)


def fail(frame):
    raise ZeroDivisionError("a bug")


def fail_second(frame):
    if frame.index == 1:
        fail(frame)


def has_ended(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return True
    return state == "Z"


def wait_until_ended(pids):
    deadline = time.monotonic() + PATIENCE_S
    while not all(has_ended(pid) for pid in pids):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_the_function_that_the_process_runs_exists():
    """It is named by a string, as importing it would load torch."""
    module = importlib.import_module(reader_launch.SERVICE_MODULE)
    assert getattr(module, reader_launch.SERVICE_FUNCTION) is serve


def test_starting_the_process_does_not_import_torch():
    code = "import sys, spslam.run.standby, spslam.run.request; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=PATIENCE_S)


def not_pickled(monkeypatch):
    return Recorded(FRAMES, lambda frame: None)


def not_imported(monkeypatch):
    class Stranger(Recorded):
        pass

    Stranger.__module__, Stranger.__qualname__ = "spslam_nowhere", "Stranger"
    module = types.ModuleType("spslam_nowhere")
    module.Stranger = Stranger
    monkeypatch.setitem(sys.modules, "spslam_nowhere", module)
    return Stranger(FRAMES)


def not_started(monkeypatch):
    def fail_to_fork(*_, **__):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(helper_process.subprocess, "Popen", fail_to_fork)
    return Recorded(FRAMES)


def killed_at_its_start(monkeypatch):
    take = READERS.take

    def take_and_kill():
        reader = take()
        reader.process.kill()
        return reader

    monkeypatch.setattr(READERS, "take", take_and_kill)
    return Recorded(FRAMES)


UNAVAILABLE = {
    killed_at_its_start: "the process ended by SIGKILL before it could read",
    not_pickled: "recorded can't be pickled (",
    not_imported: "spslam_nowhere.Stranger can't be imported by another process",
    not_started: "the process can't be started ([Errno 11] Resource temporarily unavailable)",
}


@pytest.mark.parametrize("make", UNAVAILABLE)
def test_auto_falls_back_to_threads(monkeypatch, make):
    monkeypatch.setattr(frame_feed, "uses_process", lambda reader, device: reader == "auto")
    with feed_of(make(monkeypatch), "auto") as feed:
        assert not isinstance(feed.prepare(), ReaderProcess)
        assert [frame.index for frame in feed] == list(range(FRAMES))


@pytest.mark.parametrize(("make", "reason"), UNAVAILABLE.items())
def test_a_process_that_was_asked_for_and_cannot_read_is_an_error(monkeypatch, make, reason):
    with pytest.raises(SpslamError) as caught, feed_of(make(monkeypatch)) as feed:
        feed.prepare()
    message = str(caught.value)
    assert message.startswith(f"run.reader=process can't be used: {reason}")
    assert message.endswith("; run.reader=threads uses no separate process") and "\n" not in message


def test_standby_reader_is_used_once():
    launch_standby(settings("run.reader=process"))
    launch_standby(settings("run.reader=process"))
    pid = READERS.waiting.process.pid
    with feed_of(Recorded(FRAMES)) as feed:
        assert feed.prepare()._process.pid == pid
        assert [frame.index for frame in feed] == list(range(FRAMES))
    assert READERS.waiting is None


class LateUploader:
    """Like `Uploader`, without a device: copies are complete some frames later; records calls about pages."""

    def __init__(self, can_lock):
        self.can_lock, self.notes, self.sent = can_lock, [], 0

    def send(self, pixels):
        self.sent += 1
        return Upload(pixels.holding(pixels.buffer.clone()), pixels, HostEvent(), LateEvent(self, self.sent + 1))

    def lock_pages(self, memory):
        self.notes.append("lock")
        return self.can_lock

    def unlock_pages(self, memory):
        self.notes.append("unlock")


class LateEvent(HostEvent):
    def __init__(self, uploader, ends_with):
        super().__init__()
        self.uploader, self.ends_with = uploader, ends_with

    def is_complete(self):
        return self.uploader.sent >= self.ends_with


@pytest.mark.parametrize(("can_lock", "notes"), [(True, ["lock", "unlock"]), (False, ["lock"])])
def test_slots_are_freed_when_their_uploads_are_complete(can_lock, notes):
    dataset, config, uploader = Recorded(FRAMES), settings(), LateUploader(can_lock)
    reader = ReaderProcess.start(dataset, config, begin=(0, 0), workers=1, ahead=4, uploader=uploader)
    reader.wait_until_ready()
    frames = list(reader)
    assert [frame.index for frame in frames] == list(range(FRAMES))
    for frame in frames:
        want = sample_frame(dataset[frame.index], dataset.camera, config)
        assert torch.equal(frame.pixels.pixels.buffer, want.buffer)
    assert uploader.notes == ["lock"]  # what takes long is left to the end of the run
    assert not reader.is_ready() and next(reader, None) is None
    reader.close()
    assert uploader.notes == notes


def look_ahead(feed):
    """Waits until there is something to look at."""
    end = time.monotonic() + PATIENCE_S
    while not feed._ahead:
        assert time.monotonic() < end
        time.sleep(1e-3)
        feed.look_ahead()
    held = list(feed._ahead)
    feed.look_ahead()  # changes nothing: they are held already
    assert feed.is_ready and list(feed._ahead) == held
    assert len(held) <= min(SENT_TOGETHER, max(feed.prepare().slots // 2, 1))


@pytest.mark.parametrize("ahead", [2, 24])
def test_frames_taken_ahead_are_the_same(ahead):
    with feed_of(Recorded(FRAMES), ahead=ahead) as feed:
        feed.prepare()
        indices = []
        for _ in range(FRAMES):
            if not feed._ahead:
                look_ahead(feed)  # the first one too is read before it is requested
            indices.append(next(feed).index)
        assert indices == list(range(FRAMES))
        look_ahead(feed)
        with pytest.raises(StopIteration):
            next(feed)


def test_what_fails_ahead_is_raised_where_it_is_requested():
    with feed_of(Recorded(FRAMES, fail_second)) as feed:
        next(feed)
        look_ahead(feed)
        with pytest.raises(RuntimeError, match="ZeroDivisionError: a bug"):
            next(feed)


def test_unused_standby_reader_is_ended():
    launch_standby(settings("run.reader=process"))
    pid = READERS.waiting.process.pid
    end_standby()
    assert has_ended(pid) and READERS.waiting is None


@pytest.mark.parametrize("options", [("device=cpu",), ("run.reader=threads", "device=cuda")])
def test_no_standby_reader_where_the_run_uses_threads(options):
    launch_standby(settings(*options))
    assert READERS.waiting is None


def test_exception_in_a_dataset_keeps_its_traceback():
    with feed_of(Recorded(FRAMES, fail)) as feed, pytest.raises(RuntimeError, match="(?s)in fail.*ZeroDivisionError"):
        next(feed)


def test_killed_reader_is_reported_in_one_line():
    with feed_of(Recorded(FRAMES)) as feed:
        next(feed)
        feed.prepare()._process.send_signal(signal.SIGKILL)
        with pytest.raises(SpslamError, match=r"^the process that reads frames ended by SIGKILL; .*run.reader=threads"):
            list(feed)


def test_closing_early_ends_the_process():
    with feed_of(Recorded(FRAMES)) as feed:
        next(feed)
        pid = feed.prepare()._process.pid
    assert has_ended(pid)


def test_reader_ends_when_the_loop_is_killed():
    script = (
        "import time\nfrom tests.run.test_reader_process import FRAMES, Recorded, feed_of\n"
        "feed = feed_of(Recorded(FRAMES))\nnext(feed)\n"
        "print(feed.prepare()._process.pid, flush=True)\ntime.sleep(600)"
    )
    loop = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    reader = int(loop.stdout.readline())
    assert not has_ended(reader)
    os.kill(loop.pid, signal.SIGKILL)
    loop.wait()
    loop.stdout.close()
    wait_until_ended([reader])
