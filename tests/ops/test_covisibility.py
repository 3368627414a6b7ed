"""Overlap of frames and the selection by it: against plain torch, the same rows on every device, empty input."""

import pytest
import torch

from spslam import ops
from tests.ops.arguments import opcheck
from tests.ops.threads import with_threads
from tests.reference.covisibility import overlap, select

INTRINSICS = ops.Intrinsics(140.0, 140.0, 79.5, 59.5)
WIDTH, HEIGHT, STEP = 160, 120, 16
SHAPE = (HEIGHT // STEP, WIDTH // STEP)
POINTS = 256


def make_frames(generator, count):
    """Poses about the origin that look along z more or less, and depth_thumbnails of a wall 2 m away with holes."""
    turns = 0.35 * torch.randn(count, 3, generator=generator)
    quaternions = torch.nn.functional.normalize(torch.cat([torch.ones(count, 1), turns], 1))
    poses = torch.cat([quaternions, 0.2 * torch.randn(count, 3, generator=generator)], 1)
    depth_thumbnails = 2 + 0.06 * torch.randn(count, *SHAPE, generator=generator)
    depth_thumbnails[torch.rand(count, *SHAPE, generator=generator) < 0.2] = 0
    return poses, depth_thumbnails.half()


def make_records(generator, count=2000):
    u = torch.randint(0, WIDTH, (count,), generator=generator)
    v = torch.randint(0, HEIGHT, (count,), generator=generator)
    depth = 2 + 0.05 * torch.randn(count, generator=generator)
    return torch.stack([(u | v << 16).int(), depth.view(torch.int32), torch.zeros(count, dtype=torch.int32)], 1)


def drawn_points(records, pose, seed, frame):
    """World points float64 [N, 3] of the pixels that the op draws."""
    draw = ops.sample_indices(seed, ops.RandomStream.COVISIBILITY, frame, 0, POINTS, len(records))
    chosen = records[draw]
    u, v = (chosen[:, 0] & 0xFFFF).double(), (chosen[:, 0] >> 16).double()
    z = chosen[:, 1].contiguous().view(torch.float32).double()
    k = INTRINSICS
    local = torch.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], 1)
    w, x, y, q = torch.nn.functional.normalize(pose[:4].double(), dim=0)
    rotation = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + q * q), 2 * (x * y - w * q), 2 * (x * q + w * y)]),
            torch.stack([2 * (x * y + w * q), 1 - 2 * (x * x + q * q), 2 * (y * q - w * x)]),
            torch.stack([2 * (x * q - w * y), 2 * (y * q + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )
    return local @ rotation.T + pose[4:].double()


def choose(frames, records, current, candidates, device, **options):
    settings = {"num_covisible": 40, "count": 100, "threshold": 0.3, "frame": 7, **options}
    poses, depth_thumbnails = (tensor.to(device) for tensor in frames)
    return ops.select_covisible_frames(
        records.to(device),
        current,
        poses,
        depth_thumbnails,
        candidates.to(device),
        INTRINSICS,
        thumbnail_step=STEP,
        num_points=POINTS,
        seed=5,
        **settings,
    )


def test_overlap_is_the_reference(device, generator):
    poses, depth_thumbnails = make_frames(generator, 50)
    points = torch.rand(300, 3, generator=generator) * torch.tensor([3.0, 2.0, 0.6]) + torch.tensor([-1.5, -1.0, 1.7])
    share = ops.frame_overlap(points.to(device), poses.to(device), depth_thumbnails.to(device), INTRINSICS, STEP).cpu()
    want = overlap(points, poses, depth_thumbnails, INTRINSICS, STEP)
    assert torch.equal(share, want.float())
    assert share.max() > 0.1


def test_overlap_knows_every_float16(device):
    """A frame whose depth_thumbnail holds each non-negative float16 in turn sees points at its depth only."""
    depths = torch.tensor([0.0625, 0.1, 0.999, 1.0, 5.5, 65504.0]).half()
    depth_thumbnails = depths[:, None, None].expand(-1, *SHAPE).contiguous()
    poses = torch.tensor([1.0, 0, 0, 0, 0, 0, 0]).repeat(len(depths), 1)
    for row, depth in enumerate(depths.float().tolist()):
        point = torch.tensor([[0.0, 0.0, depth]], device=device)
        share = ops.frame_overlap(point, poses.to(device), depth_thumbnails.to(device), INTRINSICS, STEP)
        assert share[row] == 1


@pytest.mark.parametrize(
    ("num_frames", "options"),
    [
        (1200, {}),  # more than are looked at in one go
        (150, {"num_covisible": 0}),
        (150, {"num_covisible": 300}),
        (150, {"threshold": 0.0}),
        (150, {"threshold": 1.0}),
        (150, {"count": 1}),
    ],
)
def test_selection_is_the_reference(device, generator, num_frames, options):
    """With the candidates in an order that is not that of their rows."""
    frames, records = make_frames(generator, num_frames), make_records(generator)
    candidates = torch.randperm(num_frames - 20, generator=generator)
    current = num_frames - 1
    selected = choose(frames, records, current, candidates, device, **options)
    shares = overlap(drawn_points(records, frames[0][current], 5, 7), *frames, INTRINSICS, STEP)
    settings = {"covisible": 40, "count": 100, "threshold": 0.3, **options}
    settings["covisible"] = settings.pop("num_covisible", settings["covisible"])
    assert selected.tolist() == select(shares, candidates.tolist(), **settings)


def test_all_candidates_where_there_are_fewer(device, generator):
    frames, records = make_frames(generator, 30), make_records(generator)
    candidates = torch.tensor([8, 3, 21, 5])
    assert choose(frames, records, 29, candidates, device).tolist() == [3, 5, 8, 21]


def test_what_is_no_frame_is_passed_over(device, generator):
    frames, records = make_frames(generator, 30), make_records(generator)
    candidates = torch.tensor([8, -1, 21, 30, 8, 2**40])
    assert choose(frames, records, 29, candidates, device).tolist() == [8, 21, -1, -1, -1, -1]


def test_nothing_to_choose_from(device, generator):
    frames, records = make_frames(generator, 3), make_records(generator)
    none = torch.zeros(0, dtype=torch.int64)
    assert choose(frames, records, 2, none, device).shape == (0,)
    assert choose(frames, records, 2, torch.tensor([0, 1]), device, count=0).shape == (0,)
    poses, depth_thumbnails = (tensor[:0].to(device) for tensor in frames)
    assert ops.frame_overlap(torch.zeros(4, 3, device=device), poses, depth_thumbnails, INTRINSICS, STEP).shape == (0,)
    poses, depth_thumbnails = (tensor.to(device) for tensor in frames)
    nothing = ops.frame_overlap(torch.zeros(0, 3, device=device), poses, depth_thumbnails, INTRINSICS, STEP)
    assert nothing.tolist() == [0, 0, 0]


def test_same_rows_for_any_number_of_threads(generator):
    frames, records = make_frames(generator, 600), make_records(generator)
    candidates = torch.randperm(590, generator=generator)
    rows = with_threads(lambda: choose(frames, records, 599, candidates, "cpu").tolist(), (1, 2, 3))
    assert rows[0] == rows[1] == rows[2]


def test_arguments_are_named(generator):
    frames, records = make_frames(generator, 5), make_records(generator)
    candidates = torch.arange(4)
    with pytest.raises(ValueError, match="select_covisible_frames: current must be a row of the 5 poses, got 5"):
        choose(frames, records, 5, candidates, "cpu")
    with pytest.raises(ValueError, match="select_covisible_frames: count must be at least 0, got -1"):
        choose(frames, records, 4, candidates, "cpu", count=-1)
    with pytest.raises(ValueError, match=r"select_covisible_frames: frame must be in \[0, 2\^32 - 1\], got -1"):
        choose(frames, records, 4, candidates, "cpu", frame=-1)
    with pytest.raises(TypeError, match="select_covisible_frames: candidates must be int64, got int32"):
        choose(frames, records, 4, candidates.int(), "cpu")
    with pytest.raises(TypeError, match="frame_overlap: depth_thumbnails must be float16, got float32"):
        ops.frame_overlap(torch.zeros(1, 3), frames[0], frames[1].float(), INTRINSICS, STEP)


def test_opcheck(device, generator):
    (poses, depth_thumbnails), records = make_frames(generator, 6), make_records(generator)
    k = list(INTRINSICS)
    points = torch.rand(9, 3, generator=generator)
    opcheck(torch.ops.spslam.frame_overlap.default, (points, poses, depth_thumbnails, k, STEP), device)
    arguments = (records, poses, depth_thumbnails, torch.arange(5), k, 0.1, [5, STEP, 64, 2, 3, 0, 6, 0])
    opcheck(torch.ops.spslam.select_covisible_frames.default, arguments, device)
