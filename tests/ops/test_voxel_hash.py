"""The voxel hash against a dictionary."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from spslam import ops
from tests.reference.voxel_hash import LIMIT, DictVolume

# Float32 points within a few meters and 4 cm voxels: local coordinates carry the rounding of p / voxel_size.
LOCAL_TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-12}


def coords(rows, device="cpu"):
    return torch.tensor(rows, dtype=torch.int32, device=device).reshape(-1, 3)


def table_of(voxel_coords, capacity=None, device="cpu"):
    capacity = capacity or 1 << (2 * len(voxel_coords) + 1).bit_length()
    keys, values = ops.new_voxel_hash(capacity, device)
    return keys, values, ops.voxel_hash_insert(keys, values, voxel_coords.to(device), 0)


def random_coords(count, extent, generator):
    return torch.randint(-extent, extent, (count, 3), generator=generator, dtype=torch.int32)


def test_insert_numbers_absent_voxels_in_sorted_order(device, generator):
    keys, values = ops.new_voxel_hash(1 << 14, device)
    reference = DictVolume()
    for extent in (3, 8, 14, 14):
        batch = random_coords(1500, extent, generator)
        first_id = len(reference.ids)
        want = reference.insert(batch.tolist())
        got = ops.voxel_hash_insert(keys, values, batch.to(device), first_id)
        assert torch.equal(got.cpu(), coords(want))
    probe = random_coords(4000, 20, generator)
    assert ops.voxel_hash_find(keys, values, probe.to(device)).tolist() == reference.find(probe.tolist())


@pytest.mark.parametrize("extent", [1, 30, LIMIT])
def test_many_are_numbered_in_sorted_order(extent, device, generator):
    """So many that they are not sorted by comparisons; every digit of a packed coordinate counts, or only some."""
    batch = random_coords(50_000, extent, generator)
    batch[:, 0] = batch[:, 0].clamp(min=0) if extent == 30 else batch[:, 0]
    keys, values = ops.new_voxel_hash(1 << 17, device)
    got = ops.voxel_hash_insert(keys, values, batch.to(device), 0)
    assert torch.equal(got.cpu(), batch.unique(dim=0))


COORD = st.one_of(st.integers(-3, 3), st.sampled_from([-LIMIT, -LIMIT + 1, LIMIT - 2, LIMIT - 1]))
BATCH = st.lists(st.tuples(COORD, COORD, COORD), max_size=40)


@settings(max_examples=100, deadline=None)
@given(batches=st.lists(BATCH, max_size=4), probes=BATCH)
def test_any_sequence_of_insertions_matches_a_dictionary(batches, probes):
    keys, values = ops.new_voxel_hash(512)
    corner_ids = coords([]).new_empty((0, 8))
    inserted = coords([])
    reference = DictVolume()
    for batch in batches:
        first_id = len(reference.ids)
        reference.insert(batch)
        new = ops.voxel_hash_insert(keys, values, coords(batch), first_id)
        inserted = torch.cat([inserted, new])
        corner_ids = torch.cat([corner_ids, corner_ids.new_full((len(new), 8), -7)])
        ops.voxel_hash_update_corner_ids(keys, values, inserted, corner_ids, first_id)
    assert [tuple(c) for c in inserted.tolist()] == list(reference.ids)
    assert corner_ids.tolist() == reference.corner_rows()
    assert ops.voxel_hash_find(keys, values, coords(probes)).tolist() == reference.find(probes)


def test_find_is_minus_one_out_of_range(device):
    keys, values, _ = table_of(coords([[LIMIT - 1, -LIMIT, 0], [-LIMIT, LIMIT - 1, -1]]), device=device)
    outside = coords([[LIMIT, -LIMIT, 0], [-LIMIT - 1, 0, 0], [LIMIT - 1, -LIMIT, 0], [2**31 - 1, 0, 0]], device)
    assert ops.voxel_hash_find(keys, values, outside).tolist() == [-1, -1, 1, -1]


def test_corner_rows_of_older_neighbors_are_completed(device, generator):
    reference = DictVolume()
    keys, values = ops.new_voxel_hash(1 << 12, device)
    buffer = torch.full((1000, 8), -1, dtype=torch.int32, device=device)
    inserted = coords([], device)
    for _ in range(5):
        batch = random_coords(300, 4, generator)
        first_id = len(reference.ids)
        reference.insert(batch.tolist())
        inserted = torch.cat([inserted, ops.voxel_hash_insert(keys, values, batch.to(device), first_id)])
        rows = buffer[: len(inserted)]
        ops.voxel_hash_update_corner_ids(keys, values, inserted, rows, first_id)
        assert rows.tolist() == reference.corner_rows()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lookup_matches_the_dictionary(device, dtype, generator):
    reference = DictVolume()
    batch = random_coords(8000, 7, generator)
    reference.insert(batch.tolist())
    keys, values, inserted = table_of(batch, device=device)
    rows = torch.full((len(inserted), 8), -1, dtype=torch.int32, device=device)
    ops.voxel_hash_update_corner_ids(keys, values, inserted, rows, 0)
    points = (torch.rand(2000, 3, generator=generator, dtype=dtype) - 0.5) * 0.6
    points[0, 1], points[1, 2], points[2, 0] = float("nan"), float("inf"), 3e38
    want_rows, want_local = reference.lookup(points, 0.04)
    got_rows, got_local = ops.voxel_hash_lookup(keys, values, rows, points.to(device), 0.04)
    assert torch.equal(got_rows.cpu(), want_rows)
    assert (want_rows[:, 0] >= 0).float().mean() > 0.2
    assert torch.allclose(got_local.cpu(), want_local, rtol=0, atol=LOCAL_TOLERANCE[dtype])


def test_vertices_without_a_row_of_corners_have_no_cell(device):
    grid = coords([[x, y, z] for x in range(40) for y in range(40) for z in range(40)])
    keys, values, inserted = table_of(grid, device=device)
    rows = torch.full((len(inserted), 8), -1, dtype=torch.int32, device=device)
    ops.voxel_hash_update_corner_ids(keys, values, inserted, rows, 0)
    points = (grid.to(device) + 0.5).float()
    known, _ = ops.voxel_hash_lookup(keys, values, rows[:10].clone(), points, 1.0)  # of before an insertion
    expected = torch.where(torch.arange(len(grid), device=device)[:, None] < 10, rows, -1)
    assert torch.equal(known, expected)


def test_lookup_gradient_reaches_points_inside_only(device):
    grid = coords([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    keys, values, inserted = table_of(grid, device=device)
    rows = torch.full((8, 8), -1, dtype=torch.int32, device=device)
    ops.voxel_hash_update_corner_ids(keys, values, inserted, rows, 0)
    points = torch.tensor([[0.3, 0.2, 0.1], [0.7, 0.2, 0.1]], dtype=torch.float64, device=device, requires_grad=True)
    _, local = ops.voxel_hash_lookup(keys, values, rows, points, 0.5)
    (grad,) = torch.autograd.grad((local * torch.tensor([1.0, 2.0, 3.0], device=device)).sum(), points)
    assert grad.tolist() == [[2.0, 4.0, 6.0], [0.0, 0.0, 0.0]]


def test_build_restores_ids(device, generator):
    voxel_coords = torch.unique(random_coords(500, 9, generator), dim=0)
    voxel_coords = voxel_coords[torch.randperm(len(voxel_coords), generator=generator)].to(device)
    keys, values, _ = table_of(random_coords(400, 5, generator), capacity=1024, device=device)
    ops.voxel_hash_build_(keys, values, voxel_coords)
    assert ops.voxel_hash_find(keys, values, voxel_coords).tolist() == list(range(len(voxel_coords)))
    assert (keys >= 0).sum() == len(voxel_coords)


def test_empty_inputs(device):
    keys, values, new = table_of(coords([]), device=device)
    assert new.shape == (0, 3)
    nothing = coords([], device)
    assert ops.voxel_hash_find(keys, values, nothing).shape == (0,)
    assert ops.voxel_hash_find(keys, values, coords([[0, 0, 0]], device)).tolist() == [-1]
    rows = torch.empty((0, 8), dtype=torch.int32, device=device)
    ops.voxel_hash_update_corner_ids(keys, values, nothing, rows, 0)
    ops.voxel_hash_build_(keys, values, nothing)
    got_rows, local = ops.voxel_hash_lookup(keys, values, rows, torch.zeros((0, 3), device=device), 0.04)
    assert got_rows.shape == (0, 8)
    assert local.shape == (0, 3)


def test_non_contiguous_coordinates_and_points(device, generator):
    dense = random_coords(300, 4, generator).to(device)
    strided = torch.stack([dense, dense + 1], 2)[:, :, 0]
    assert not strided.is_contiguous()
    keys, values, new = table_of(dense, device=device)
    keys2, values2, new2 = table_of(strided, capacity=len(keys), device=device)
    assert torch.equal(new, new2)
    assert torch.equal(ops.voxel_hash_find(keys2, values2, strided), ops.voxel_hash_find(keys, values, dense))
    rows = torch.full((len(new), 8), -1, dtype=torch.int32, device=device)
    ops.voxel_hash_update_corner_ids(keys, values, new, rows, 0)
    points = (torch.rand(3, 200, generator=generator) * 0.3 - 0.15).to(device)
    got = ops.voxel_hash_lookup(keys, values, rows, points.T, 0.04)
    want = ops.voxel_hash_lookup(keys, values, rows, points.T.contiguous(), 0.04)
    assert torch.equal(got[0], want[0])
    assert torch.equal(got[1], want[1])


def test_a_table_that_would_be_more_than_half_full_is_left_alone(device):
    keys, values, _ = table_of(coords([[0, 0, 0], [1, 0, 0]]), capacity=8, device=device)
    before = keys.clone()
    more = coords([[x, 5, 5] for x in range(3)], device)
    with pytest.raises(RuntimeError, match="voxel_hash_insert: hash table must stay at most half full, got 5 voxels"):
        ops.voxel_hash_insert(keys, values, more, 2)
    assert torch.equal(keys, before)
    assert ops.voxel_hash_insert(keys, values, more[:2], 2).shape == (2, 3)
    with pytest.raises(RuntimeError, match="voxel_hash_build_: hash table must stay at most half full, got 5"):
        ops.voxel_hash_build_(keys, values, coords([[x, 0, 0] for x in range(5)], device))


def test_absent_is_what_an_insertion_enters(device, generator):
    keys, values, inserted = table_of(random_coords(200, 4, generator), capacity=2048, device=device)
    batch = random_coords(400, 5, generator).to(device)
    before = keys.clone()
    absent = ops.voxel_hash_absent(keys, values, batch)
    assert torch.equal(keys, before)
    assert torch.equal(absent, ops.voxel_hash_insert(keys, values, batch, len(inserted)))
    assert ops.voxel_hash_absent(keys, values, batch).shape == (0, 3)


def full_table(device, capacity=64):
    """A table with a voxel in every slot, which the ops alone would never make: ids of (0, 0, z) for z >= 0."""
    keys, values = ops.new_voxel_hash(4 * capacity, device)
    inserted = ops.voxel_hash_insert(keys, values, coords([[0, 0, z] for z in range(capacity)], device), 0)
    packed = keys[keys >= 0].sort().values  # by (x, y, z), as ids are
    return packed.clone(), torch.arange(capacity, dtype=torch.int32, device=device), inserted


def test_a_full_table_is_searched_to_its_end(device):
    """No empty slot ends a probe: it ends where it began."""
    keys, values, inserted = full_table(device)
    found = ops.voxel_hash_find(keys, values, inserted)
    assert found.tolist() == list(range(64))
    absent = coords([[5, 5, z] for z in range(100)], device)
    assert ops.voxel_hash_find(keys, values, absent).tolist() == [-1] * 100
    assert torch.equal(ops.voxel_hash_absent(keys, values, torch.cat([absent, inserted])), absent)
    points = torch.full((10, 3), 7.5, device=device)
    rows = torch.full((64, 8), -1, dtype=torch.int32, device=device)
    assert (ops.voxel_hash_lookup(keys, values, rows, points, 1.0)[0] == -1).all()
    ops.voxel_hash_update_corner_ids(keys, values, inserted, rows, 0)
    assert (rows == -1).all()


@pytest.mark.parametrize("taken", [64, 63])
def test_an_insertion_without_a_slot_is_refused(taken, device):
    """Whatever the caller says of the voxels in the table; what is in it stays."""
    keys, values, _ = full_table(device)
    keys[taken:] = -1
    before = keys.clone()
    two = coords([[5, 5, 5], [6, 6, 6]], device)
    with pytest.raises(
        RuntimeError, match=f"first_id must be the number of voxels in the table, got 0 .* {64 - taken} "
    ):
        ops.voxel_hash_insert(keys, values, two, 0)
    assert torch.equal(keys, before)


def test_a_table_that_is_changed_is_contiguous(device):
    """One that is not, even one number seen as many, is refused before it is read."""
    keys, values = ops.new_voxel_hash(32, device)
    one = torch.full((1,), -1, device=device)
    for bad in (keys[::2], one.expand(16)):
        with pytest.raises(RuntimeError, match="spslam: an in-place argument must be contiguous"):
            ops.voxel_hash_insert(bad, values[:16], coords([[1, 2, 3]], device), 0)


def test_coordinates_out_of_range_leave_the_table_alone(device):
    keys, values = ops.new_voxel_hash(16, device)
    batch = coords([[0, 0, 0], [LIMIT, 0, 0], [0, -LIMIT - 1, 0]], device)
    with pytest.raises(RuntimeError, match=r"voxel_coords must lie in \[-2\^20, 2\^20 - 1\], got 2 rows outside"):
        ops.voxel_hash_insert(keys, values, batch, 0)
    with pytest.raises(RuntimeError, match=r"voxel_hash_absent: voxel_coords must lie in .*, got 2 rows outside"):
        ops.voxel_hash_absent(keys, values, batch)
    assert (keys == -1).all()
    with pytest.raises(ValueError, match=r"voxel_hash_build_: voxel_coords must lie in .*, got \[-1048577, 1048576\]"):
        ops.voxel_hash_build_(keys, values, batch)


@pytest.mark.parametrize("capacity", [0, 1, 3, 24])
def test_capacity_must_be_a_power_of_two(capacity):
    with pytest.raises(ValueError, match=f"new_voxel_hash: capacity must be a power of two, got {capacity}"):
        ops.new_voxel_hash(capacity)
    keys = torch.full((capacity,), -1)
    with pytest.raises(
        ValueError, match=f"voxel_hash_find: hash_keys must have a power of two of slots, got {capacity}"
    ):
        ops.voxel_hash_find(keys, torch.zeros(capacity, dtype=torch.int32), coords([[0, 0, 0]]))


def test_wrong_arguments_are_named():
    keys, values = ops.new_voxel_hash(16)
    one = coords([[0, 0, 0]])
    rows = torch.full((1, 8), -1, dtype=torch.int32)
    with pytest.raises(TypeError, match="voxel_hash_insert: voxel_coords must be int32, got int64"):
        ops.voxel_hash_insert(keys, values, one.long(), 0)
    with pytest.raises(ValueError, match=r"voxel_hash_insert: voxel_coords must have shape \[N, 3\], got \[3\]"):
        ops.voxel_hash_insert(keys, values, one[0], 0)
    with pytest.raises(ValueError, match="voxel_hash_insert: first_id must be at least 0, got -1"):
        ops.voxel_hash_insert(keys, values, one, -1)
    with pytest.raises(ValueError, match=r"voxel_hash_find: hash_values must have shape \[16\], got \[8\]"):
        ops.voxel_hash_find(keys, values[:8], one)
    with pytest.raises(ValueError, match=r"voxel_hash_update_corner_ids: first_new must be in \[0, 1\], got 2"):
        ops.voxel_hash_update_corner_ids(keys, values, one, rows, 2)
    with pytest.raises(ValueError, match="voxel_hash_lookup: voxel_size must be positive, got 0"):
        ops.voxel_hash_lookup(keys, values, rows, torch.zeros(1, 3), 0)
    with pytest.raises(TypeError, match="voxel_hash_lookup: points must be float32 or float64, got int32"):
        ops.voxel_hash_lookup(keys, values, rows, one, 0.04)


def test_opcheck(device, generator):
    keys, values, new = table_of(random_coords(60, 2, generator), device=device)
    rows = torch.full((len(new), 8), -1, dtype=torch.int32, device=device)
    points = (torch.rand(20, 3, generator=generator, dtype=torch.float64) * 0.1).to(device).requires_grad_()
    op = torch.ops.spslam
    torch.library.opcheck(op.voxel_hash_update_corner_ids, (keys, values, new, rows, 0))
    ops.voxel_hash_update_corner_ids(keys, values, new, rows, 0)
    torch.library.opcheck(op.voxel_hash_find, (keys, values, new))
    torch.library.opcheck(op.voxel_hash_build_, (keys, values, new))
    torch.library.opcheck(op.voxel_hash_lookup, (keys, values, rows, points, 0.04))
    more = random_coords(10, 4, generator).to(device)
    torch.library.opcheck(op.voxel_hash_absent, (keys, values, more))
    torch.library.opcheck(op.voxel_hash_insert, (keys, values, more, len(new)))
