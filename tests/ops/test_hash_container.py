"""The hash as a container: removal, neighbors, look-up by distance, allocation around points, copies."""

import math

import pytest
import torch

from spslam import ops
from tests.ops.test_hash_table import cube

VOXEL = 0.1


def filled(generator, device, count=400, span=8, **options):
    cells = ops.VoxelHash(device=device, **options)
    cells.insert(torch.randint(-span, span, (count, 3), generator=generator).to(device))
    return cells


def is_consistent(cells):
    """Ids, table and corners are those of a set built anew."""
    again = ops.VoxelHash(device=cells.hash_keys.device)
    again.build(cells.voxel_coords.clone())
    ids = torch.arange(len(cells), device=cells.hash_keys.device)
    return torch.equal(cells.find(cells.voxel_coords).long(), ids) and torch.equal(cells.corner_ids, again.corner_ids)


def test_removal_closes_the_ids_up(device, generator):
    cells = filled(generator, device)
    coords, features = cells.voxel_coords.clone(), torch.arange(len(cells), device=device)
    mask = torch.rand(len(cells), generator=generator).to(device) < 0.6
    kept = cells.keep(mask)
    assert torch.equal(kept, features[mask])
    assert torch.equal(cells.voxel_coords, coords[mask])
    assert not (cells.find(coords[~mask]) >= 0).any()
    assert is_consistent(cells)
    gone = cells.voxel_coords[::3].clone()
    kept = cells.remove(torch.cat([gone, gone, gone.new_full((1, 3), 99)]).long())
    assert len(cells) == len(kept) == mask.sum() - len(gone)
    assert is_consistent(cells)
    ids, new = cells.insert(coords, return_new=True)
    assert new.sum() == len(coords) - len(kept)
    assert is_consistent(cells)
    cells.keep(torch.zeros(len(cells), dtype=torch.bool, device=device))
    assert len(cells) == 0


def test_new_rows_are_told(device):
    cells = ops.VoxelHash(device=device)
    cells.insert(cube(0, 2).to(device))
    ids, new = cells.insert(torch.tensor([[0, 0, 0], [5, 5, 5], [1, 1, 1], [5, 5, 5]], device=device), return_new=True)
    assert (ids.tolist(), new.tolist()) == ([0, 8, 7, 8], [False, True, False, True])


def test_coordinates_of_64_bits_and_leading_axes(device, generator):
    cells = filled(generator, device)
    coords = torch.randint(-9, 9, (4, 5, 3), generator=generator).to(device)
    want = torch.stack([cells.find(part.int()) for part in coords])
    assert torch.equal(cells.find(coords), want)
    assert cells.insert(coords).shape == (4, 5)
    assert cells.find(coords + 2**32).lt(0).all()  # the same numbers in 32 bits
    with pytest.raises(RuntimeError, match="VoxelHash.insert: voxel_coords must lie in"):
        cells.insert(coords + 2**32)


def test_neighbors_at_offsets(device, generator):
    cells = filled(generator, device)
    coords = torch.randint(-9, 9, (50, 3), generator=generator).to(device)
    offsets = torch.tensor([[0, 0, 0], [1, 0, 0], [0, -2, 3], [2**30, 0, 0], [2**40, 0, 0]], device=device)
    ids = cells.neighbors(coords, offsets)
    known = {tuple(c): i for i, c in enumerate(cells.voxel_coords.tolist())}
    want = [[known.get(tuple(c + o for c, o in zip(a, b, strict=True)), -1) for b in offsets.tolist()]
            for a in coords.tolist()]  # fmt: skip
    assert ids.tolist() == want
    far = torch.tensor([[2**31 - 1, 0, 0], [-(2**31), 5, 5]], device=device)
    assert cells.neighbors(far, torch.tensor([[1, 0, 0], [2**31 - 1, 0, 0]], device=device)).lt(0).all()
    assert cells.neighbors(coords.view(5, 10, 3), offsets).shape == (5, 10, 5)
    # Beyond the range and back into it.
    steps = torch.tensor([[-(2**21), 0, 0], [2**30, 0, 0], [-(2**31) + 1, 0, 0]], device=device)
    around = cells.voxel_coords[:3].long() - steps
    assert cells.neighbors(around, steps).diagonal().tolist() == [0, 1, 2]
    assert cells.neighbors(coords[:0], offsets).shape == (0, 5)


@pytest.mark.parametrize("radius", [0.0, 0.13, 0.35])
def test_look_up_by_distance(radius, device, generator):
    cells = filled(generator, device)
    points = (1.8 * torch.rand(40, 3, generator=generator, dtype=torch.float64) - 0.9).to(device)
    points[3] = float("nan")
    points[4] = 1e30
    points[5] = VOXEL * cells.voxel_coords[7].double()
    distances = torch.cdist(points, VOXEL * cells.voxel_coords.double(), compute_mode="donot_use_mm_for_euclid_dist")
    near = distances <= radius
    ids, found = cells.within_radius(points, VOXEL, radius)
    assert ids.shape[1] == near.sum(1).max()
    for n in range(40):
        own = ids[n][ids[n] >= 0].long()
        assert set(own.tolist()) == set(near[n].nonzero()[:, 0].tolist())
        torch.testing.assert_close(found[n][: len(own)], distances[n][own])
        assert found[n][: len(own)].diff().ge(0).all()
        assert found[n][len(own) :].isinf().all()
    for k in (1, 5, 10_000):
        nearest, far = cells.nearest(points, VOXEL, k, radius)
        width = min(k, ids.shape[1])
        assert nearest.shape == (40, k)
        assert torch.equal(nearest[:, :width], ids[:, :width])
        assert torch.equal(far[:, :width], found[:, :width])
        assert nearest[:, width:].lt(0).all()
    assert cells.within_radius(points[:0], VOXEL, radius)[0].shape == (0, 0)
    assert cells.nearest(points.view(4, 10, 3), VOXEL, 2, radius)[0].shape == (4, 10, 2)


@pytest.mark.parametrize("band", [0.0, 0.04, 0.25])
def test_vertices_around_points(band, device, generator):
    """All vertices of the cells that the cubes around the points touch, and no other."""
    points = (torch.rand(30, 3, generator=generator, dtype=torch.float64) - 0.5).to(device)
    cells = ops.VoxelHash(device=device)
    bad = points.new_tensor([[math.nan] * 3, [math.inf, 0, 0], [1e9, 0, 0]])
    new = cells.insert_points(torch.cat([points, bad]), VOXEL, band)
    want = set()
    for p in points.tolist():
        spans = [range(math.floor((c - band) / VOXEL), math.floor((c + band) / VOXEL) + 2) for c in p]
        want |= {(x, y, z) for x in spans[0] for y in spans[1] for z in spans[2]}
    assert [tuple(c) for c in cells.voxel_coords.tolist()] == sorted(want)
    assert new.tolist() == list(range(len(want)))
    assert (cells.lookup(points, VOXEL)[0][:, 0] >= 0).all()
    assert len(cells.insert_points(points, VOXEL, band)) == 0
    assert is_consistent(cells)
    limited = ops.VoxelHash(device=device, max_voxels=4)
    with pytest.raises(ops.VoxelLimitError):
        limited.insert_points(points, VOXEL, band)
    assert len(limited) == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("voxel_size", [0.01, 0.03, 0.04, 0.05])
def test_points_on_sides_of_voxels_are_in_the_cells_around_them(dtype, voxel_size, device):
    """Such as those of a wall at a round number: insertion and look-up must round alike."""
    sides = voxel_size * torch.arange(-200, 200, dtype=torch.float64)
    points = torch.stack([sides, sides.flip(0), 0.3 * sides], 1).to(device, dtype)
    for band in (0.0, voxel_size):
        cells = ops.VoxelHash(device=device)
        cells.insert_points(points, voxel_size, band)
        assert (cells.lookup(points, voxel_size)[0][:, 0] >= 0).all()


def test_copies_and_words(device, generator):
    cells = filled(generator, device, max_voxels=1000)
    assert tuple(cells.voxel_coords[3].tolist()) in cells
    assert cells.voxel_coords[3] in cells
    assert (99, 0, 0) not in cells
    assert cells.to(device) is cells
    state = cells.state_dict()
    other = ops.VoxelHash(device=device)
    other.load_state_dict(state)
    assert torch.equal(other.voxel_coords, cells.voxel_coords)
    assert torch.equal(other.corner_ids, cells.corner_ids)
    cells.remove(cells.voxel_coords[:5].clone())
    assert len(state["voxel_coords"]) == len(other) == len(cells) + 5
    text = repr(cells)
    assert text.startswith(f"VoxelHash({len(cells)} voxels from (-8, -8, -8) to (7, 7, 7), capacity=1024")
    assert "max_voxels=1000" in text
    assert repr(ops.VoxelHash()) == "VoxelHash(0 voxels, capacity=1024, device='cpu')"
    with pytest.raises(ValueError, match=r"VoxelHash.load_state_dict: state must have voxel_coords alone, got \[\]"):
        other.load_state_dict({})


@pytest.mark.cuda
def test_a_copy_on_the_other_device(generator):
    cells = filled(generator, "cpu")
    there = cells.to("cuda")
    assert there.hash_keys.is_cuda
    assert torch.equal(there.corner_ids.cpu(), cells.corner_ids)
    assert there.to("cuda") is there


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda c: c.keep(torch.ones(3)), TypeError, "keep: mask must be bool, got float32"),
        (lambda c: c.keep(torch.ones(3).bool()), ValueError, r"keep: mask must have shape \[8\], got \[3\]"),
        (lambda c: c.remove(torch.zeros(2, 2).int()), ValueError, r"remove: voxel_coords must have shape \[N, 3\]"),
        (lambda c: c.neighbors(torch.zeros(2, 3).int(), torch.zeros(3).int()), ValueError, "neighbors: offsets must"),
        (lambda c: c.insert_points(torch.zeros(2, 3), 0.0), ValueError, "insert_points: voxel_size must be positive"),
        (lambda c: c.insert_points(torch.zeros(2, 3), 0.1, -1.0), ValueError, "insert_points: band must be 0 to 64"),
        (lambda c: c.nearest(torch.zeros(2, 3), 0.1, 0, 1.0), ValueError, r"nearest: k must be in \[1, 2\^20\], got 0"),
        (lambda c: c.within_radius(torch.zeros(2, 3), 0.1, 9.0), ValueError, "within_radius: radius must be 0 to 64"),
        (lambda c: "a" in c, TypeError, r"__contains__: voxel must be \(x, y, z\), got str"),
        (
            lambda c: c.load_state_dict({"voxel_coords": [1]}),
            TypeError,
            "load_state_dict: voxel_coords must be a torch",
        ),
        (lambda c: (0.5, 1.0, 2.0) in c, TypeError, "__contains__: voxel must be int32 or int64, got float32"),
    ],
)
def test_wrong_argument_is_named(call, error, message):
    cells = ops.VoxelHash()
    cells.insert(cube(0, 2))
    with pytest.raises(error, match=f"^VoxelHash.{message}"):
        call(cells)


def test_a_set_is_built_of_its_own_rows(device, generator):
    cells = filled(generator, device)
    coords = cells.voxel_coords.clone()
    cells.build(cells.voxel_coords[3:])
    assert torch.equal(cells.voxel_coords, coords[3:])
    assert is_consistent(cells)
