"""Keyframes' images in files without a name: they stay what they were, and where there is no room, in memory."""

import os

import numpy as np
import pytest
import torch

from spslam.slam.graph.image_pool import IMAGES, ImagePool

ROWS, COLUMNS = 6, 8


def images(seed):
    random = np.random.default_rng(seed)
    depth = random.integers(0, 2**16, (ROWS, COLUMNS), dtype=np.uint16)
    return torch.from_numpy(depth), torch.from_numpy(random.integers(0, 256, (ROWS, COLUMNS), dtype=np.uint8))


def no_room(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("is_full", [False, True])
def test_images_stay_what_they_were(is_full, monkeypatch):
    if is_full:
        monkeypatch.setattr(os, "posix_fallocate", no_room)
    pool, count = ImagePool(ROWS, COLUMNS), 2 * IMAGES + 3
    kept = [pool.keep(*images(seed)) for seed in range(count)]
    for seed, pair in enumerate(kept):
        assert all(torch.equal(one, other) for one, other in zip(pair, images(seed), strict=True))


def test_no_file_is_left(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    pool = ImagePool(ROWS, COLUMNS)
    pool.keep(*images(0))
    assert list(tmp_path.iterdir()) == []


def test_places_that_are_given_back_are_used_again():
    pool = ImagePool(ROWS, COLUMNS)
    kept = [pool.keep(*images(seed)) for seed in range(3)]
    pool.give_back(*kept[1])
    again = pool.keep(*images(9))
    assert again[0].data_ptr() == kept[1][0].data_ptr()
    for pair, seed in ((kept[0], 0), (again, 9), (kept[2], 2)):
        assert all(torch.equal(one, other) for one, other in zip(pair, images(seed), strict=True))
