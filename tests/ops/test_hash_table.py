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


def test_adding_enters_as_inserting_does(device, generator):
    coords = torch.randint(-20, 20, (4000, 3), generator=generator, dtype=torch.int32).to(device)
    inserted, added = ops.VoxelHash(capacity=4, device=device), ops.VoxelHash(capacity=4, device=device)
    for part in coords.split(300):
        before = len(inserted)
        inserted.insert(part)
        assert added.add(part) == len(inserted) - before
    assert added.add(coords) == 0 and added.add(coords[:0]) == 0
    assert torch.equal(added.voxel_coords, inserted.voxel_coords)
    assert torch.equal(added.corner_ids, inserted.corner_ids)
    with pytest.raises(ops.VoxelLimitError):
        ops.VoxelHash(device=device, max_voxels=10).add(coords)


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


def test_the_limit_leaves_it_as_it_was(device):
    cells = ops.VoxelHash(capacity=2, device=device, max_voxels=10)
    cells.insert(cube(0, 2).to(device))
    cells.insert(cube(0, 2).repeat(3, 1).to(device))
    message = "VoxelHash: voxels must stay within max_voxels = 10, got 27"
    with pytest.raises(ops.VoxelLimitError, match=message) as error:
        cells.insert(cube(0, 3).repeat(2, 1).to(device))
    assert (error.value.wanted, error.value.max_voxels) == (27, 10)
    with pytest.raises(ops.VoxelLimitError, match=message):
        cells.build(cube(0, 3).to(device))
    assert cells.find(cube(0, 2).to(device)).tolist() == list(range(8))
    assert cells.capacity == 8
    with pytest.raises(ValueError, match="VoxelHash: max_voxels must be at least 1, got 0"):
        ops.VoxelHash(max_voxels=0)


def test_built_it_is_the_same_as_grown(device, generator):
    grown, built = ops.VoxelHash(capacity=4, device=device), ops.VoxelHash(capacity=4, device=device)
    for part in torch.randint(-9, 9, (900, 3), generator=generator, dtype=torch.int32).to(device).split(300):
        grown.insert(part)
    built.insert(cube(30, 33).to(device))
    where = built.corners_buffer.data_ptr()
    built.build(cube(40, 42).to(device))
    assert built.corners_buffer.data_ptr() == where
    built.build(grown.voxel_coords)
    for name in ("num_voxels", "capacity"):
        assert getattr(built, name) == getattr(grown, name)
    for name in ("voxel_coords", "corner_ids"):
        assert torch.equal(getattr(built, name), getattr(grown, name))
    assert torch.equal(built.insert(cube(-12, 12).to(device)), grown.insert(cube(-12, 12).to(device)))
    built.build(cube(0, 0).to(device))
    assert len(built) == 0
    assert (built.find(cube(40, 42).to(device)) == -1).all()


@pytest.mark.parametrize(
    "rows, message",
    [
        ([[1, 1, 1], [2, 2, 2], [1, 1, 1]], "VoxelHash.build: voxel_coords must be distinct, got a repeated row"),
        ([[1, 1, 1], [0, 2**20, 0]], r"voxel_coords must lie in \[-2\^20, 2\^20 - 1\]"),
    ],
)
def test_what_cannot_be_built_leaves_it_as_it_was(device, rows, message):
    cells = ops.VoxelHash(capacity=2, device=device)
    cells.insert(cube(0, 2).to(device))
    with pytest.raises(ValueError, match=message):
        cells.build(torch.tensor(rows, dtype=torch.int32, device=device))
    assert cells.find(cube(0, 2).to(device)).tolist() == list(range(8))
    assert cells.corner_ids[0].tolist() == [0, 4, 2, 6, 1, 5, 3, 7]
