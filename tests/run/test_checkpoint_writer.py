"""Asynchronous checkpoints have the state at the time of the call."""

import threading

import pytest
import torch

from spslam.errors import OutputError
from spslam.run import checkpoint_writer
from spslam.run.checkpoint_writer import CheckpointWriter
from spslam.slam.checkpoint import load_checkpoint
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings

SETTINGS = ("mapping.every=2", "mapping.first_iterations=10", "mapping.reset_moments=false")
sync_nothing = bool  # a call that returns
SOURCE = {"next": 4, "data": {"frames": 8}, "clock": {"frames": 4, "wall_s": 0.5, "decode_s": 0.1}}


@pytest.fixture
def system(device):
    dataset = Recorded(8)
    system = SlamSystem(settings(*SETTINGS), dataset.camera, device=device)
    for i in range(4):
        system.process(dataset[i])
    return system


def go_on(system):
    for i in range(4, 8):
        system.process(Recorded(8)[i])


def test_thread_writes_the_state_at_the_time_of_the_call(monkeypatch, tmp_path, system):
    """The thread is delayed until four more frames have been processed."""
    CheckpointWriter(tmp_path / "in_place", threaded=False).write(system.state, system.config, SOURCE, sync_nothing)
    may_write, write = threading.Event(), checkpoint_writer.write_snapshot
    monkeypatch.setattr(checkpoint_writer, "write_snapshot", lambda *args: may_write.wait(60) and write(*args))
    writer = CheckpointWriter(tmp_path / "beside", threaded=True)
    writer.write(system.state, system.config, SOURCE, sync_nothing)
    assert writer.is_busy
    go_on(system)
    may_write.set()
    writer.wait()
    assert not writer.is_busy
    assert (tmp_path / "beside").read_bytes() == (tmp_path / "in_place").read_bytes()


def test_restored_state_continues_identically(tmp_path, system, device):
    writer = CheckpointWriter(tmp_path / "checkpoint", threaded=True)
    writer.write(system.state, system.config, SOURCE, sync_nothing)
    go_on(system)
    writer.wait()
    resumed = SlamSystem(system.config, system.camera, device=device)
    assert load_checkpoint(tmp_path / "checkpoint", resumed.state, system.config) == SOURCE
    go_on(resumed)
    ours, others = (s.state.scene.tensors() for s in (system, resumed))
    assert all(torch.equal(ours[name], others[name]) for name in ours)
    assert torch.equal(system.state.frames.poses, resumed.state.frames.poses)


def test_error_on_the_thread_is_raised(tmp_path, system):
    writer = CheckpointWriter(tmp_path / "absent" / "checkpoint", threaded=True)
    writer.write(system.state, system.config, SOURCE, sync_nothing)
    with pytest.raises(OutputError, match="absent/checkpoint: can't be written: No such file or directory"):
        writer.wait()
    writer.close()
