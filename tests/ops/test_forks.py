"""Ops in processes that come from a fork: each child has kernel threads of its own, and no lock of its parent's.

Every child runs under a time limit, as what fails here hangs.
"""

import multiprocessing
import os
import threading
import time

import pytest
import torch

from spslam import ops

THREADS = 2
POINTS = 20_000  # several chunks of work for the kernel threads
LIMIT_S = 60
CALLS = 5
EXPECTED = 3.0  # three planes of ones


@pytest.fixture(autouse=True)
def two_threads():
    before = ops.get_num_threads()
    ops.set_num_threads(THREADS)
    yield
    ops.set_num_threads(before)


def call_ops() -> bool:
    """Whether several calls, shared by the kernel threads, give what they should."""
    layout = (0, 0, 0, 2, 2, 4, 0, 0, 2, 2, 8, 0, 0, 2, 2)
    points = torch.full((POINTS, 3), 0.02)
    results = [ops.tri_plane_interpolate(torch.ones(12, 1), points, 0.04, layout) for _ in range(CALLS)]
    return all(result.eq(EXPECTED).all() for result in results) and ops.get_num_threads() == THREADS


def fork(work) -> int:
    """The exit status of a child that runs `work`: 0 if that is true; fails the test where the child hangs."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            torch.set_num_threads(1)  # torch's own threads are no better off in a child
            status = 0 if work() else 2
        finally:
            os._exit(status)
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(child, 9)
    os.waitpid(child, 0)
    pytest.fail(f"the child hung for {LIMIT_S} s")


def test_children_of_a_fork_run_ops():
    assert call_ops()
    for _ in range(8):
        assert fork(call_ops) == 0
    assert call_ops()


def test_a_child_may_fork_again():
    def grandchild():
        return call_ops() and fork(call_ops) == 0 and call_ops()

    assert call_ops()
    assert fork(grandchild) == 0


def test_a_fork_before_the_first_call():
    """Nothing is there to renew: the child's first call makes the threads."""
    assert fork(lambda: fork(call_ops) == 0) == 0


def test_a_child_may_change_the_number_of_threads():
    def change():
        ops.set_num_threads(1)
        ops.set_num_threads(THREADS)
        return call_ops()

    assert call_ops()
    assert fork(change) == 0


def test_forks_while_another_thread_runs_ops():
    """The locks of the parent's pool may be held at the fork, and its work be half done."""
    stop = threading.Event()

    def loop():
        points = torch.full((50 * POINTS, 3), 0.02)
        layout = (0, 0, 0, 2, 2, 4, 0, 0, 2, 2, 8, 0, 0, 2, 2)
        while not stop.is_set():
            ops.tri_plane_interpolate(torch.ones(12, 1), points, 0.04, layout)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        for _ in range(20):
            assert fork(call_ops) == 0
    finally:
        stop.set()
        thread.join()
    assert call_ops()


def _report(queue) -> None:
    torch.set_num_threads(1)
    ops.set_num_threads(THREADS)
    queue.put(call_ops())


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_multiprocessing(method):
    assert call_ops()
    context = multiprocessing.get_context(method)
    queue = context.SimpleQueue()
    process = context.Process(target=_report, args=(queue,))
    process.start()
    process.join(LIMIT_S)
    hung = process.is_alive()
    process.kill()
    assert not hung
    assert queue.get()


class OpsDataset(torch.utils.data.Dataset):
    """Items that are made by ops."""

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> torch.Tensor:
        assert call_ops()
        return ops.sample_indices(0, ops.RandomStream.EVALUATION, index, 0, POINTS, 100)


def test_workers_of_a_data_loader():
    assert call_ops()
    loader = torch.utils.data.DataLoader(
        OpsDataset(), batch_size=None, num_workers=2, timeout=LIMIT_S, multiprocessing_context="fork"
    )
    own = [ops.sample_indices(0, ops.RandomStream.EVALUATION, index, 0, POINTS, 100) for index in range(8)]
    assert all(torch.equal(a, b) for a, b in zip(loader, own, strict=True))
