"""Frames prepared by processes that the reading process forks: the same frames, and what happens when one ends."""

import contextlib
import os
import signal
import subprocess
import sys
from multiprocessing import Pipe
from pathlib import Path

import pytest
import torch

from spslam.errors import DatasetError, SpslamError
from spslam.run import reader_workers
from spslam.run.frame_feed import FrameFeed
from spslam.run.reader_service import Work, _shared_out
from spslam.slam.prepared_frame import FramePreparation
from tests.run.test_reader_process import ROOT, fail, has_ended, wait_until_ended
from tests.system.sequences import Recorded, settings

FRAMES = 34  # image features of the first and the 31st are extracted ahead
WORKERS = 3


def feed_of(change=None, reader="process", start=0) -> FrameFeed:
    config = settings(f"run.reader={reader}", f"run.prefetch_workers={WORKERS}")
    return FrameFeed(Recorded(FRAMES, change, is_random_access=True), config, torch.device("cpu"), start)


def refuse_some(frame):
    if frame.index in (3, 12):
        raise DatasetError(f"frame {frame.index}: torn")


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.parametrize("change", [None, refuse_some])
@pytest.mark.parametrize("start", [0, 7])
def test_frames_are_those_of_threads(change, start):
    with feed_of(change, start=start) as feed:
        shared = list(feed)
    with feed_of(change, "threads", start) as feed:
        alone = list(feed)
    assert len(shared) == len(alone) == FRAMES - start
    for one, other in zip(shared, alone, strict=True):
        if isinstance(other, DatasetError):
            assert isinstance(one, DatasetError) and str(one) == str(other)
            continue
        assert (one.index, one.timestamp, one.offsets) == (other.index, other.timestamp, other.offsets)
        assert torch.equal(one.pixels.buffer, other.pixels.buffer)
        assert one.pixels.valid_depth_share == other.pixels.valid_depth_share
        assert (one.features is None) == (other.features is None)
        if other.features is not None:
            assert (one.features.descriptors == other.features.descriptors).all()
    assert any(not isinstance(one, DatasetError) and one.features is not None for one in shared)


@pytest.mark.parametrize(("wanted", "workers", "are_extracted"), [(True, 4, True), (False, 4, False), (True, 3, False)])
def test_features_are_extracted_ahead_while_they_are_wanted(wanted, workers, are_extracted):
    """By as many processes as do that without holding up the loop; the first frames are read before it says so."""
    ahead = 8
    config = settings("run.reader=process", f"run.prefetch_workers={workers}", f"run.prefetch_ahead={ahead}")
    with FrameFeed(Recorded(3 * ahead, is_random_access=True), config, torch.device("cpu")) as feed:
        feed.prepare()
        feed.want_features(wanted)
        extracted = [frame.pixels.features is not None for frame in feed]
    assert all(extracted[ahead:]) == any(extracted[ahead:]) == are_extracted
    assert extracted[:2] == [True, True]  # those of the first two are needed in any case


def test_every_thread_has_a_process_which_end_with_the_feed():
    with feed_of() as feed:
        next(feed)
        workers = children(feed.prepare()._process.pid)
        assert len(workers) == WORKERS
    wait_until_ended(workers)


def test_workers_end_when_the_reading_process_is_killed():
    with feed_of() as feed:
        next(feed)
        process = feed.prepare()._process
        workers = children(process.pid)
        process.send_signal(signal.SIGKILL)
        with pytest.raises(SpslamError, match="^the process that reads frames ended by SIGKILL"):
            list(feed)
    wait_until_ended(workers)


def test_workers_end_when_the_loop_is_killed():
    script = (
        "import time\nfrom tests.run.test_reader_workers import children, feed_of\n"
        "feed = feed_of()\nnext(feed)\npid = feed.prepare()._process.pid\n"
        "print(pid, *children(pid), flush=True)\ntime.sleep(600)"
    )
    loop = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    pids = [int(pid) for pid in loop.stdout.readline().split()]
    assert len(pids) == 1 + WORKERS
    os.kill(loop.pid, signal.SIGKILL)
    loop.wait()
    loop.stdout.close()
    wait_until_ended(pids)


def kill_itself(frame):
    if frame.index == 20:
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_is_killed_is_reported_in_one_line():
    with feed_of(kill_itself) as feed:
        frames = []
        with pytest.raises(SpslamError, match=r"^the process that reads frames ended by SIGKILL; .*run.reader=threads"):
            for frame in feed:
                frames.append(frame)
        pid = feed._process._process.pid
    assert [frame.index for frame in frames] == list(range(20))
    assert has_ended(pid)


def test_exception_in_a_dataset_keeps_its_traceback():
    with feed_of(fail) as feed, pytest.raises(RuntimeError, match="(?s)in fail.*ZeroDivisionError"):
        next(feed)


class Unprepared(Recorded):
    """Fails when the reading process makes itself ready."""

    def __setstate__(self, state):
        self.__dict__.update(state, is_random_access=None)

    def __getattribute__(self, name):
        if name == "is_random_access" and super().__getattribute__(name) is None:
            fail(None)
        return super().__getattribute__(name)


def test_exception_before_it_is_ready_keeps_its_traceback_too():
    config = settings("run.reader=process", f"run.prefetch_workers={WORKERS}")
    feed = FrameFeed(Unprepared(FRAMES, is_random_access=True), config, torch.device("cpu"))
    with feed, pytest.raises(RuntimeError, match="(?s)in fail.*ZeroDivisionError"):
        feed.prepare()


def test_processes_are_there_before_the_first_frame_is_requested():
    with feed_of() as feed:
        feed.prepare()
        assert len(children(feed._process._process.pid)) == WORKERS


def wait_for_the_end(_, connection, memory, inherited):
    for other in inherited:
        other.close()
    with contextlib.suppress(EOFError):
        connection.recv_bytes()


def test_where_no_process_can_start_threads_read(monkeypatch):
    """And those that had started are ended."""
    started, fork = [], os.fork

    def fork_once():
        if started:
            raise BlockingIOError("no more processes")
        started.append(fork())
        return started[0]

    monkeypatch.setattr(os, "fork", fork_once)
    monkeypatch.setattr(reader_workers, "_work", wait_for_the_end)
    dataset = Recorded(3, is_random_access=True)
    work = Work(dataset, settings(), 0, WORKERS, 4, 4, 0, 0)
    preparation = FramePreparation(dataset, work.config)
    with _shared_out(work, preparation, Pipe()[0]) as source:
        assert source is preparation
    assert os.waitpid(started[0], 0) == (started[0], 0)
