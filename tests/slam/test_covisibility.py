"""Which frames see the same surface, and which a mapping call optimises."""

import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.slam.covisibility import overlap, select_frames
from spslam.slam.state import FrameTable
from tests.system.sequences import settings

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
SIZES = ("mapping.frames=12", "mapping.recent=4", "mapping.covisible=5")


def views(count, seen):
    """Poses and lattices of frames that look at a wall at z = 2 m; those not in `seen` look the other way."""
    rotations = torch.eye(3).repeat(count, 1, 1)
    away = torch.tensor([i not in seen for i in range(count)])
    rotations[away] = torch.diag(torch.tensor([-1.0, 1, -1]))
    shape = FrameTable(CAMERA).lattices.shape[1:]
    return rotations, torch.zeros(count, 3), torch.full((count, *shape), 2.0, dtype=torch.float16)


def wall(count=256):
    generator = torch.Generator().manual_seed(0)
    xy = torch.rand(count, 2, generator=generator) * 1.6 - 0.8
    return torch.cat([xy, torch.full((count, 1), 2.0)], 1)


def select(frames, seen, *overrides, usable=None):
    usable = torch.ones(frames, dtype=torch.bool) if usable is None else usable
    return select_frames(wall(), *views(frames, seen), usable, CAMERA, settings(*SIZES, *overrides)).tolist()


def test_overlap_is_the_share_seen():
    rotations, centers, lattices = views(4, {0, 1, 2})
    lattices[1] = 3  # sees something farther: the wall is hidden or gone
    lattices[2, :, : lattices.shape[2] // 2] = 0  # no depth in the left half
    share = overlap(wall(), rotations, centers, lattices, CAMERA)
    assert share[0] > 0.95
    assert share[1] == share[3] == 0
    assert 0.4 < share[2] < 0.6


def test_overlap_follows_the_pose():
    rotations, centers, lattices = views(2, {0, 1})
    angle = 0.3
    rotations[1] = torch.tensor(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], dtype=torch.float32
    )
    centers[1] = torch.tensor([0.0, 0.0, -0.5])
    local = (wall() - centers[1]) @ rotations[1]
    inside = (local[:, :2] / local[:, 2:] * 140).abs() <= torch.tensor([80.0, 60.0])
    near = (local[:, 2] - 2).abs() < 0.1
    expected = (inside.all(1) & near).float().mean()
    assert float(overlap(wall(), rotations, centers, lattices, CAMERA)[1]) == pytest.approx(float(expected), abs=0.02)


def test_few_frames_are_all_taken():
    assert select(12, set()) == list(range(12))


def test_recent_covisible_and_others():
    seen = set(range(0, 300, 3))
    chosen = select(300, seen)
    assert len(chosen) == len(set(chosen)) == 12
    assert chosen == sorted(chosen)
    assert chosen[-4:] == [296, 297, 298, 299]
    assert len(seen & set(chosen[:-4])) >= 5
    assert set(chosen[:-4]) - seen


def test_all_places_are_filled_when_nothing_is_covisible():
    assert len(select(50, set())) == 12


def test_the_draw_repeats_and_follows_seed_and_frame():
    assert select(60, set()) == select(60, set())
    assert select(60, set()) != select(60, set(), "seed=1")
    assert select(60, set())[:-4] != select(61, set())[:-4]


def test_only_usable_frames_are_chosen_and_the_newest_of_them_always():
    usable = torch.ones(60, dtype=torch.bool)
    usable[10:40] = usable[55:] = False
    chosen = select(60, set(range(60)), usable=usable)
    assert usable[chosen].all()
    assert chosen[-1] == 54


def test_a_search_that_stops_early_finds_the_same():
    """Co-visible frames are looked for in parts; the first in the shuffled order count, however it is cut."""
    from spslam.slam import covisibility

    whole = select(400, set(range(0, 400, 2)))
    before, covisibility.FRAMES_AT_ONCE = covisibility.FRAMES_AT_ONCE, 7
    try:
        assert select(400, set(range(0, 400, 2))) == whole
    finally:
        covisibility.FRAMES_AT_ONCE = before
