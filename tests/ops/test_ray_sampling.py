"""Philox draws."""

import numpy as np
import pytest
import torch

from spslam import ops
from tests.reference import philox4x32


def _words(seed, stream, frame, iteration, count):
    counter = np.stack([np.arange(count), np.full(count, iteration), np.full(count, frame), np.full(count, stream)], 1)
    return philox4x32(counter.astype(np.uint32), (seed & 0xFFFFFFFF, seed >> 32))[:, 0]


def test_reference_reproduces_the_published_vector():
    out = philox4x32(np.zeros((1, 4), np.uint32), (0, 0))[0]
    assert [hex(x) for x in out] == ["0x6627e8d5", "0xe169c58d", "0xbc57ac4c", "0x9b00dbd8"]


def test_uniform_is_the_high_bits_of_philox(device):
    got = ops.philox_uniform(2**40 + 7, ops.Stream.TRACKING_RAYS, 3, 11, 5000, device).cpu()
    want = (_words(2**40 + 7, 2, 3, 11, 5000) >> 8).astype(np.float32) / np.float32(2**24)
    assert torch.equal(got, torch.from_numpy(want))


def test_indices_cover_the_range_evenly(device):
    got = ops.sample_indices(1, ops.Stream.PIXEL_DATABASE, 0, 0, 100_000, 7, device).cpu()
    want = (_words(1, 0, 0, 0, 100_000).astype(np.uint64) * np.uint64(7)) >> np.uint64(32)
    assert torch.equal(got, torch.from_numpy(want.astype(np.int64)))
    assert (torch.bincount(got, minlength=7) - 100_000 / 7).abs().max() < 600


def test_empty(device):
    assert ops.philox_uniform(0, 0, 0, 0, 0, device).shape == (0,)


@pytest.mark.parametrize("upper", [0, -3, 2**32 + 1])
def test_upper_out_of_range_is_named(upper):
    with pytest.raises(ValueError, match=rf"sample_indices: upper must be in \[1, 2\^32\], got {upper}"):
        ops.sample_indices(0, 0, 0, 0, 1, upper)
