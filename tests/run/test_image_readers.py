"""Images that several processes read: the same ones, and what happens where one can't be read or a process ends."""

import importlib
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch

from spslam import helper_process
from spslam.errors import DatasetError, SpslamError
from spslam.evaluation.run_data import RunData
from spslam.helper_process import DISCONNECTED
from spslam.meshing.frame_fusion import FusionOptions, PosedFrames, fuse_frames
from spslam.run import image_readers
from spslam.run.image_readers import IMAGE_READERS, LEAST_FRAMES, NotSharedError, SharedOutDataset, launch, shared_out
from spslam.run.image_service import serve
from spslam.run.reader_launch import READERS
from spslam.run.standby import launch_standby
from spslam.slam.graph.solver_launch import SOLVERS
from tests.run.test_reader_process import PATIENCE_S, ROOT, fail_second, wait_until_ended
from tests.run.test_reader_workers import children, refuse_some
from tests.system.sequences import Recorded, settings

FRAMES = 34


@pytest.fixture(autouse=True)
def cores(monkeypatch):
    monkeypatch.setattr(image_readers, "usable_cores", lambda: 6)


def shared(change=None) -> SharedOutDataset:
    return SharedOutDataset(Recorded(FRAMES, change, is_random_access=True), launch())


def processes_of(dataset: SharedOutDataset) -> list[int]:
    helper = dataset._launched.helper.process.pid
    return [helper, *children(helper)]


def test_the_function_that_the_process_runs_exists():
    module = importlib.import_module(image_readers.SERVICE_MODULE)
    assert getattr(module, image_readers.SERVICE_FUNCTION) is serve


def test_neither_side_imports_torch():
    code = "import sys, spslam.run.image_readers, spslam.run.image_service; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=PATIENCE_S)


def test_frames_are_the_datasets():
    alone, dataset = Recorded(FRAMES, is_random_access=True), shared()
    pids = processes_of(dataset)
    assert dataset.readers == len(pids) - 1 == 4
    assert np.array_equal(dataset.timestamps(), alone.timestamps()) and dataset.camera == alone.camera
    for index in range(FRAMES):
        frame, wanted = dataset[index], alone[index]
        assert (frame.index, frame.timestamp, frame.offsets) == (wanted.index, wanted.timestamp, wanted.offsets)
        assert np.array_equal(frame.color, wanted.color) and np.array_equal(frame.depth, wanted.depth)
        assert np.array_equal(dataset.depth(index), wanted.depth)
    first = dataset[0].depth
    dataset[1]  # in the same memory, of which the first is a copy
    assert np.array_equal(first, alone[0].depth)
    with pytest.raises(IndexError, match="frame must be in 0..33, got 34"):
        dataset[FRAMES]
    dataset.close()
    wait_until_ended(pids)


def test_large_images_are_read_by_fewer_processes(monkeypatch):
    alone = Recorded(FRAMES, is_random_access=True)
    monkeypatch.setattr(image_readers, "usable_cores", lambda: 8)
    monkeypatch.setattr(image_readers, "MOST_BYTES", 5 * 7 * alone.camera.width * alone.camera.height)
    dataset = shared()
    assert dataset.readers == len(processes_of(dataset)) - 1 == 5
    for index in range(12):
        assert np.array_equal(dataset[index].depth, alone[index].depth)
    dataset.close()
    monkeypatch.setattr(image_readers, "MOST_BYTES", 3 * 7 * alone.camera.width * alone.camera.height)
    IMAGE_READERS.prepare()
    with shared_out(alone) as readable:  # threads read as fast
        assert readable is alone
    IMAGE_READERS.end()


def test_voxels_are_the_same():
    alone, dataset, every = Recorded(FRAMES, is_random_access=True), shared(), np.arange(0, FRAMES, 3)
    options = FusionOptions(0.04, 256, (1e-6, 1e-6))
    one, other = (fuse_frames(PosedFrames(each, every, each.poses()[every]), options) for each in (alone, dataset))
    for name in ("block_coords", "sdf", "weights", "colors"):
        assert torch.equal(getattr(one, name), getattr(other, name))
    dataset.close()


def test_images_of_another_kind_are_read_here():
    dataset = shared(lose_a_channel)
    with pytest.raises(AssertionError, match="asked here"):
        dataset[1]
    dataset.close()


def lose_a_channel(frame):
    if frame.index == 1:
        frame.color = frame.color[..., :1]
        assert os.getpid() != HERE, "asked here"


HERE = os.getpid()


@pytest.mark.parametrize(
    ("changes", "device", "fuses", "is_launched"),
    [
        ((), "cuda", True, True),
        ((), "cuda", False, False),
        ((), "cpu", True, False),
        (("run.reader=threads",), "cuda", True, False),
        (("run.reader=process",), "cpu", True, False),
        (("mesh.source=neural",), "cuda", True, False),
    ],
)
def test_a_run_that_fuses_beside_a_gpu_launches_them(monkeypatch, changes, device, fuses, is_launched):
    launched = []
    for standby in (IMAGE_READERS, READERS, SOLVERS):
        monkeypatch.setattr(standby, "prepare", lambda standby=standby: launched.append(standby))
    monkeypatch.setattr(helper_process, "_GPU_DRIVERS", (ROOT,))
    launch_standby(settings(f"device={device}", *changes), fuses=fuses)
    assert (IMAGE_READERS in launched) == is_launched


def test_what_can_not_be_read_is_remembered():
    data = RunData(Recorded(FRAMES, refuse_some, is_random_access=True))
    dataset = SharedOutDataset(data, launch())
    for index, read in ((3, dataset.__getitem__), (12, dataset.depth)):
        with pytest.raises(DatasetError, match=f"frame {index}: torn"):
            read(index)
    assert data.unreadable == {3, 12} and dataset[4].index == 4
    dataset.close()


def test_a_bug_is_shown_with_its_place():
    dataset = shared(fail_second)
    with pytest.raises(RuntimeError, match=r"(?s)reading frames failed:.*in fail.*ZeroDivisionError: a bug"):
        dataset[1]
    assert dataset[2].index == 2
    dataset.close()


def test_a_process_that_has_ended_is_named():
    dataset = shared()
    pids = processes_of(dataset)
    for pid in pids[1:]:
        os.kill(pid, signal.SIGKILL)
    wait_until_ended(pids[1:])
    with pytest.raises(SpslamError, match=r"a process that reads frames has ended; .*run.reader=threads .*needs none"):
        dataset[0]
    dataset.close()


def test_the_processes_end_with_their_parent():
    dataset = shared()
    pids = processes_of(dataset)
    dataset._launched.helper.connection.close()  # as the system does when the parent is killed
    for connection in dataset._launched.connections:
        connection.close()
    dataset._launched.helper.process.wait(PATIENCE_S)
    wait_until_ended(pids)


def test_data_that_can_not_be_shared_out_is_read_as_it_is():
    local, few = Recorded(FRAMES, lambda frame: None, is_random_access=True), Recorded(29, is_random_access=True)
    assert len(few) < LEAST_FRAMES <= FRAMES
    with pytest.raises(NotSharedError):
        SharedOutDataset(local, launch())
    for dataset in (local, few, Recorded(FRAMES)):
        IMAGE_READERS.prepare()
        with shared_out(dataset) as readable:
            assert readable is dataset
    IMAGE_READERS.end()
    with shared_out(Recorded(FRAMES, is_random_access=True)) as readable:  # nobody has started processes
        assert readable.readers == 0


def test_what_can_not_be_started_leaves_nothing_open(monkeypatch):
    pipes = iter([image_readers.Pipe, image_readers.Pipe])

    def few_pipes():
        try:
            return next(pipes)()
        except StopIteration:
            raise OSError("too many open files") from None

    monkeypatch.setattr(image_readers, "Pipe", few_pipes)
    before = set(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match="too many open files"):
        launch()
    assert set(os.listdir("/proc/self/fd")) == before


def test_processes_on_standby_are_used():
    IMAGE_READERS.prepare()
    waiting = IMAGE_READERS.waiting
    with shared_out(Recorded(FRAMES, is_random_access=True)) as readable:
        assert isinstance(readable, SharedOutDataset) and readable[0].index == 0
        assert IMAGE_READERS.waiting is None
    wait_until_ended([waiting.helper.process.pid])
    with pytest.raises((*DISCONNECTED, OSError)):
        readable[1]


def test_few_cores_have_no_processes(monkeypatch):
    monkeypatch.setattr(image_readers, "usable_cores", lambda: 4)
    IMAGE_READERS.prepare()
    assert IMAGE_READERS.waiting is None
