"""Copies to the CPU are what was on the device, of any size, type and layout."""

import pytest
import torch

from spslam.slam import device_events
from spslam.slam.device_events import host_copy


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
