import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError


class Slow(RgbdDataset):
    """Frames that take a different time each; counts how many were read."""

    name = "slow"
    camera = Camera(2, 2, 2, 2, 0.5, 0.5)

    def __init__(self, count: int = 30, broken: tuple[int, ...] = (), bug: int | None = None) -> None:
        self.count, self.broken, self.bug, self.started = count, broken, bug, 0
        self.lock = threading.Lock()

    def __len__(self):
        return self.count

    def timestamps(self):
        return np.arange(self.count, dtype=float)

    def poses(self):
        return None

    def read(self, index):
        with self.lock:
            self.started += 1
        time.sleep(0.001 * (index * 7 % 5))
        if index in self.broken:
            raise DatasetError(f"frame {index} is broken")
        if index == self.bug:
            raise RuntimeError("bug")
        return RgbdFrame(index, float(index), np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), np.float32))


def reader_threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("spslam-prefetch")]


@pytest.fixture(autouse=True)
def no_thread_left():
    yield
    assert not reader_threads()


@pytest.mark.parametrize("workers", [0, 1, 4])
def test_every_frame_in_order(workers):
    with prefetch(Slow(), workers=workers, ahead=6) as frames:
        assert [frame.index for frame in frames] == list(range(30))
        assert frames.frames_read == 30
        assert frames.read_seconds > 0.05  # 30 frames sleep 2 ms on average
        assert next(frames, None) is None


@pytest.mark.parametrize("workers", [0, 3])
def test_a_broken_frame_comes_as_its_error_in_its_place(workers):
    with prefetch(Slow(8, broken=(0, 5)), workers=workers) as frames:
        got = list(frames)
    assert [isinstance(item, DatasetError) for item in got] == [index in (0, 5) for index in range(8)]
    assert str(got[5]) == "frame 5 is broken"


@pytest.mark.parametrize("workers", [0, 3])
def test_a_bug_is_raised_in_its_place(workers):
    frames = prefetch(Slow(20, bug=4), workers=workers)
    assert [next(frames).index for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(RuntimeError, match="bug"):
        next(frames)
    assert not reader_threads()
    assert next(frames, None) is None


def test_reads_no_further_ahead_than_asked():
    dataset = Slow(50)
    with prefetch(dataset, workers=4, ahead=5) as frames:
        next(frames)
        time.sleep(0.1)
        assert dataset.started == 6


def test_leaving_early_ends_the_threads():
    dataset = Slow(1000)
    with prefetch(dataset, workers=3, ahead=10) as frames:
        next(frames)
        assert reader_threads()
    assert not reader_threads()
    assert dataset.started <= 11
    assert list(frames) == []


def test_dropping_an_iterator_ends_the_threads():
    for frame in prefetch(Slow(1000), workers=3):
        if frame.index == 2:
            break
    del frame
    for _ in range(100):
        if not reader_threads():
            break
        time.sleep(0.01)


def test_ctrl_c_ends_the_process_at_once():
    script = (
        "import time, os, signal, threading\n"
        "from tests.datasets.test_prefetch import Slow\n"
        "from spslam.datasets.prefetch import prefetch\n"
        "threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT)).start()\n"
        "try:\n"
        "    with prefetch(Slow(10**6), workers=3) as frames:\n"
        "        for frame in frames: time.sleep(0.01)\n"
        "except KeyboardInterrupt:\n"
        "    print('left', sum(t.name.startswith('spslam-prefetch') for t in threading.enumerate()))\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert result.stdout == "left 0\n", result.stderr


@pytest.mark.parametrize(("workers", "ahead", "name"), [(-1, 4, "workers"), (2, 0, "ahead")])
def test_errors(workers, ahead, name):
    with pytest.raises(ValueError, match=f"prefetch: {name} must be at least"):
        prefetch(Slow(), workers, ahead)
