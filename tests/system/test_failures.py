"""A device that fails, and Ctrl-C: one clear line, and what was written so far is whole and can be gone on from."""

import json
import os
import signal

import pytest
import torch

from spslam.camera import Camera
from spslam.config import load_config
from spslam.errors import DeviceError
from spslam.run.device import explained_failures, resolve_device
from spslam.run.interruption import Interruption
from spslam.scene.scene import Scene
from spslam.scene.sparse_volume import SparseVolume
from spslam.slam.mapper import Mapper
from spslam.slam.system import SlamSystem
from spslam.trajectory import Trajectory
from tests.system.sequences import Recorded, results, run_on

FRAMES = 12


def fail_in_mapping_call(monkeypatch, number: int, error: Exception) -> None:
    optimize, calls = Mapper.optimize, []

    def failing(*args):
        calls.append(None)
        if len(calls) == number:
            raise error
        return optimize(*args)

    monkeypatch.setattr(Mapper, "optimize", failing)


def frames_logged(output) -> list[int]:
    return [json.loads(line)["frame"] for line in (output / "log.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), "the machine is out of memory: lower"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: not enough memory: you tried"), "is out of memory: lower"),
        (RuntimeError("CUDA error: an illegal memory access was encountered\nmore"), "has failed: CUDA error: an ille"),
    ],
)
def test_a_failing_device_is_one_line_and_the_run_goes_on_later(monkeypatch, tmp_path, error, text):
    run_on(monkeypatch, Recorded(FRAMES), tmp_path / "whole")
    output = tmp_path / "out"
    with monkeypatch.context() as patch:
        fail_in_mapping_call(patch, 3, error)  # on frame 10
        with pytest.raises(DeviceError, match=text) as raised:
            run_on(patch, Recorded(FRAMES), output, "run.checkpoint_every=4")
    assert "\n" not in str(raised.value)
    assert "cpu" in str(raised.value) or "memory" in str(raised.value)
    assert frames_logged(output) == list(range(10))
    run_on(monkeypatch, Recorded(FRAMES), output, resume=True)
    assert results(output) == results(tmp_path / "whole")


def test_other_errors_are_left_as_they_are():
    with pytest.raises(RuntimeError, match="shape mismatch"), explained_failures(torch.device("cpu")):
        raise RuntimeError("shape mismatch")


def test_out_of_memory_says_what_to_change():
    with pytest.raises(DeviceError) as raised, explained_failures(torch.device("cuda", 0)):
        raise torch.OutOfMemoryError("CUDA out of memory.")
    for word in ("device cuda:0", "pixels.budget_mb", "scene.voxel_size_m", "--device cpu"):
        assert word in str(raised.value)


@pytest.mark.cuda
def test_memory_that_is_really_not_there(tmp_path):
    device = torch.device("cuda")
    with pytest.raises(DeviceError, match=r"device cuda is out of memory \(\d+ MB in use by this run"):  # noqa: SIM117
        with explained_failures(device):
            torch.empty(1 << 50, dtype=torch.uint8, device=device)


@pytest.mark.parametrize("name", ["cuda:99", "cuda"])
def test_an_absent_device_is_one_line(monkeypatch, name):
    if name == "cuda" and torch.cuda.is_available():
        pytest.skip("it is there")
    camera = Camera(fx=60, fy=60, cx=40, cy=30, width=80, height=60)
    for call in (
        resolve_device,
        lambda device: SparseVolume(0.05, device=device),
        lambda device: SlamSystem(load_config("demo"), camera, device=device),
        lambda device: Scene.load("no-file", device),
    ):
        with pytest.raises(DeviceError, match=f"device {name} is not available: ") as raised:
            call(name)
        assert "\n" not in str(raised.value)


def interrupt_after(frames: int):
    """A progress callback that presses Ctrl-C."""

    def progress(done, total, report):
        if done == frames:
            os.kill(os.getpid(), signal.SIGINT)

    return progress


@pytest.mark.parametrize(
    "after", [pytest.param(1, marks=pytest.mark.slow), 7, pytest.param(FRAMES, marks=pytest.mark.slow)]
)
def test_ctrl_c_leaves_a_checkpoint_of_every_frame_up_to_there(monkeypatch, tmp_path, after):
    output = tmp_path / "out"
    run_on(monkeypatch, Recorded(FRAMES), tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run_on(monkeypatch, Recorded(FRAMES), output, progress=interrupt_after(after))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert frames_logged(output) == list(range(after))
    seen = []
    run_on(monkeypatch, Recorded(FRAMES), output, resume=True, progress=lambda done, *_: seen.append(done))
    assert seen == list(range(after + 1, FRAMES + 1))
    assert results(output) == results(tmp_path / "whole")
    assert len(Trajectory.load_tum(output / "trajectory.txt")) == FRAMES


def test_without_checkpoints_ctrl_c_leaves_none(monkeypatch, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_on(monkeypatch, Recorded(4), tmp_path / "out", "run.checkpoint_every=0", progress=interrupt_after(2))
    assert not (tmp_path / "out" / "checkpoint.safetensors").exists()
    assert frames_logged(tmp_path / "out") == [0, 1]


def test_a_second_ctrl_c_interrupts_at_once():
    with pytest.raises(KeyboardInterrupt), Interruption() as interruption:
        os.kill(os.getpid(), signal.SIGINT)
        assert interruption.requested
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_programs_own_handler_is_kept():
    caught = []
    before = signal.signal(signal.SIGINT, lambda *_: caught.append(1))
    try:
        with Interruption() as interruption:
            os.kill(os.getpid(), signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert caught == [1]
    assert not interruption.requested
