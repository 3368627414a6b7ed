"""Copies to the CPU are what was on the device, of any size, type and layout."""

import pytest
import torch

from spslam.slam import device_events
from spslam.slam.device_events import event_recorder, host_copy, read_together


@pytest.mark.parametrize(
    "tensor",
    [
        torch.arange(3 * 700_001, dtype=torch.int32).view(-1, 3),
        torch.zeros(0, 7),
        torch.arange(24.0).view(4, 6).T,
        torch.tensor(2.5, dtype=torch.float64),
        torch.arange(5).to(torch.uint16),
        torch.tensor([True, False]),
    ],
    ids=["pieces", "empty", "transposed", "number", "uint16", "bool"],
)
def test_copies_are_equal_and_contiguous(device, tensor):
    copy = host_copy(tensor.to(device))
    assert copy.device.type == "cpu" and copy.is_contiguous() and copy.dtype == tensor.dtype
    assert torch.equal(copy, tensor)


def test_tensor_on_the_cpu_is_not_copied():
    tensor = torch.arange(4)
    assert host_copy(tensor).data_ptr() == tensor.data_ptr()


@pytest.mark.parametrize("count", [1, 4, 9])
def test_pieces_meet(monkeypatch, device, count):
    monkeypatch.setattr(device_events, "PIECE_BYTES", 16)
    tensor = torch.arange(count, dtype=torch.int32)
    assert torch.equal(host_copy(tensor.to(device)), tensor)


def test_tensors_that_are_read_together_come_apart(device):
    tensors = [torch.arange(6.0).view(2, 3), torch.tensor(7.0), torch.zeros(0), torch.arange(8.0, 10.0)]
    found = read_together(*(tensor.to(device) for tensor in tensors))
    assert [part.tolist() for part in found] == [[0, 1, 2, 3, 4, 5], [7], [], [8, 9]]


def test_events_that_nobody_refers_to_are_used_again(device):
    if device.type != "cuda":
        pytest.skip("events of a CPU are the time")
    record = event_recorder(device)
    first = record()
    kept = first.event
    del first
    again, other = record(), record()
    assert again.event is kept and other.event is not kept
    other.wait()
    assert again.is_complete() and other.ms_since(again) >= 0
