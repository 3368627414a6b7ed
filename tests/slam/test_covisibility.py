"""Which frames a mapping call optimizes."""

import torch

from spslam.camera import Camera
from spslam.slam.covisibility import select_frames
from spslam.slam.frame_table import FrameTable
from tests.system.sequences import settings

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
SIZES = ("mapping.frames=12", "mapping.recent=4", "mapping.covisible=5")


def views(count, seen):
    """Pixels, poses and thumbnails of frames that look at a wall at z = 2 m; those not in `seen` look the other way."""
    poses = torch.tensor([1.0, 0, 0, 0, 0, 0, 0]).repeat(count, 1)
    away = torch.tensor([i not in seen for i in range(count)])
    poses[away, :4] = torch.tensor([0.0, 0, 1, 0])
    generator = torch.Generator().manual_seed(0)
    u, v = (torch.randint(0, size, (500,), generator=generator) for size in (CAMERA.width, CAMERA.height))
    depth = torch.full((500,), 2.0).view(torch.int32)
    records = torch.stack([(u | v << 16).int(), depth, torch.zeros(500, dtype=torch.int32)], 1)
    depth_thumbnail = torch.full(FrameTable(CAMERA).depth_thumbnails.shape[1:], 2.0, dtype=torch.float16)
    return records.expand(count, -1, -1), poses, depth_thumbnail.expand(count, -1, -1)


def select(frames, seen, *overrides, usable=None):
    """What is chosen where the newest usable frame sees the wall, beside those in `seen`."""
    usable = torch.ones(frames, dtype=torch.bool) if usable is None else usable
    newest = int(usable.nonzero()[-1])
    return select_frames(*views(frames, {*seen, newest}), usable, CAMERA, settings(*SIZES, *overrides)).tolist()


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
