"""The hash as an object: grows, keeps ids, and agrees with the functions it stands on."""

import pytest
import torch

from spslam import ops


def cube(low, high):
    return torch.cartesian_prod(*[torch.arange(low, high, dtype=torch.int32)] * 3)


def test_ids_stay_while_it_grows(device):
    cells = ops.VoxelHash(capacity=1, device=device)
    coords = cube(-2, 2).to(device)
    first = cells.insert(coords)
    corners = cells.corner_ids.clone()
    cells.insert(cube(-9, 9).to(device))
    assert len(cells) == 18**3
    assert torch.equal(cells.find(coords), first)
    assert torch.equal(cells.voxel_coords[: len(first)][first.long()], coords)
    complete = corners[:, 0] >= 0
    assert torch.equal(cells.corner_ids[: len(first)][complete], corners[complete])


def test_growing_in_steps_or_at_once_gives_the_same_cells(device, generator):
    coords = torch.randint(-20, 20, (4000, 3), generator=generator, dtype=torch.int32).to(device)
    steps, once = ops.VoxelHash(capacity=4, device=device), ops.VoxelHash(device=device)
    for part in coords.split(300):
        steps.insert(part)
    once.insert(coords)
    ids = steps.find(once.voxel_coords).long()
    assert len(steps) == len(once)
    missing = once.corner_ids < 0
    assert torch.equal(steps.corner_ids[ids] < 0, missing)
    renamed = ids[once.corner_ids.clamp(min=0).long()]
    assert torch.equal(steps.corner_ids[ids][~missing].long(), renamed[~missing])


def test_nothing_and_repetitions(device):
    cells = ops.VoxelHash(device=device)
    assert cells.insert(torch.zeros(0, 3, dtype=torch.int32, device=device)).shape == (0,)
    assert cells.insert(torch.zeros(5, 3, dtype=torch.int32, device=device)).tolist() == [0] * 5
    assert len(cells) == 1


def test_out_of_range_leaves_it_as_it_was(device):
    cells = ops.VoxelHash(device=device)
    cells.insert(cube(0, 2).to(device))
    with pytest.raises(RuntimeError, match=r"must lie in \[-2\^20, 2\^20 - 1\], got 1 rows outside"):
        cells.insert(torch.tensor([[3, 3, 3], [2**20, 0, 0]], dtype=torch.int32, device=device))
    assert len(cells) == 8
    assert cells.find(cube(0, 2).to(device)).tolist() == list(range(8))


def test_capacity_is_checked():
    with pytest.raises(ValueError, match="VoxelHash: capacity must be at least 1, got 0"):
        ops.VoxelHash(capacity=0)
