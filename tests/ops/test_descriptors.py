"""Nearest binary descriptors against plain NumPy, and OpenCV."""

import cv2
import numpy as np
import pytest
import torch

from spslam import ops
from spslam.ops import trusted
from tests.ops.threads import assert_same_for_any_threads
from tests.reference import descriptors as reference


def drawn(rows, size, seed=0, values=256):
    return np.random.default_rng(seed).integers(0, values, (rows, size), dtype=np.uint8)


def nearest(descriptors, others, device="cpu"):
    found = ops.nearest_descriptors(torch.from_numpy(descriptors).to(device), torch.from_numpy(others).to(device))
    return [each.cpu().numpy() for each in found]


@pytest.mark.parametrize("size", [8, 32, 64, 128])
@pytest.mark.parametrize("others", [0, 1, 2, 31, 33, 200])
def test_nearest_are_those_of_numpy(device, size, others):
    # Of few different values, so that many are as near.
    a, b = drawn(150, size, 0, 3), drawn(others, size, 1, 3)
    rows, distances = nearest(a, b, device)
    want_rows, want = reference.nearest_descriptors(a, b)
    assert (rows == want_rows).all() and (distances == want).all()


def test_nearest_are_those_of_opencv(device):
    a, b = drawn(700, 32), drawn(900, 32, 1)
    b[:300] = a[100:400]
    distances, rows = cv2.batchDistance(a, b, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    found, found_distances = nearest(a, b, device)
    assert (found_distances == distances).all()
    alone = distances[:, 0] < distances[:, 1]
    assert alone.sum() > 300 and (found == rows[:, 0])[alone].all()


def test_bytes_that_begin_anywhere(device):
    a, b = torch.from_numpy(drawn(40, 36)).to(device), torch.from_numpy(drawn(50, 33, 1)).to(device)
    shifted = torch.cat([b.flatten(), b.flatten()[:1]])[1:].view(-1, 33)[:, 1:]
    rows, distances = ops.nearest_descriptors(a[:, 3:35], shifted)
    want_rows, want = reference.nearest_descriptors(a[:, 3:35].cpu().numpy(), shifted.cpu().numpy())
    assert (rows.cpu().numpy() == want_rows).all() and (distances.cpu().numpy() == want).all()
    whole = b.flatten()[5 : 5 + 32 * 40].view(40, 32)  # contiguous, but not from a word on
    rows, _ = ops.nearest_descriptors(whole, whole)
    assert rows.tolist() == list(range(40))


def test_the_same_bits_for_any_number_of_threads():
    a, b = (torch.from_numpy(drawn(500, 32, seed)) for seed in (0, 1))
    assert_same_for_any_threads(lambda: ops.nearest_descriptors(a, b))


@pytest.mark.parametrize("size", [0, 12, 136])
def test_sizes_that_are_not_words(size):
    bytes_ = torch.zeros(2, size, dtype=torch.uint8)
    with pytest.raises(ValueError, match="nearest_descriptors: descriptors must have a multiple of 8 bytes each"):
        ops.nearest_descriptors(bytes_, bytes_)


def test_groups_are_compared_each_for_itself(device):
    a, groups = drawn(150, 32, 0, 3), [drawn(rows, 32, 1 + rows, 3) for rows in (40, 0, 1, 300)]
    others = torch.from_numpy(np.concatenate(groups)).to(device)
    found = trusted.nearest_in_groups(torch.from_numpy(a).to(device), others, [len(group) for group in groups]).cpu()
    for rows, distances, group in zip(*found.numpy(), groups, strict=True):
        want_rows, want = nearest(a, group, device)
        assert (rows == want_rows).all() and (distances.view(np.int32).reshape(-1, 2) == want).all()
    none = trusted.nearest_in_groups(torch.from_numpy(a).to(device), others, [])
    assert none.shape == (2, 0, 150)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [([3, 3], "as many rows as sizes"), ([-1], "as many rows as sizes"), ([0] * 17, "be 16 at most")],
)
def test_groups_that_are_not_there_are_refused(sizes, message):
    five = torch.zeros(5, 32, dtype=torch.uint8)
    with pytest.raises(RuntimeError, match=message):
        trusted.nearest_in_groups(five, five, sizes)
