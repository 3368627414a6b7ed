"""The sparse volume: allocation, fusion, lookup and restoring."""

import pytest
import torch

from spslam.errors import SpslamError
from spslam.scene.sparse_volume import SparseVolume, resize_rows
from tests.reference.voxel_hash import DictVolume


def random_coords(count, extent, generator, device="cpu"):
    return torch.randint(-extent, extent, (count, 3), generator=generator, dtype=torch.int32).to(device)


def test_growth_keeps_ids_embeddings_and_weights(device, generator):
    volume = SparseVolume(0.04, device=device, capacity=16)
    reference = DictVolume()
    for extent in (2, 5, 9, 9, 16):
        batch = random_coords(900, extent, generator, device)
        old = volume.num_voxels
        kept = volume.embeddings.clone(), volume.weights.clone()
        reference.insert(batch.tolist())
        ids = volume.insert(batch)
        assert ids.tolist() == reference.find(batch.tolist())
        assert torch.equal(volume.embeddings[:old], kept[0])
        assert torch.equal(volume.weights[:old], kept[1])
        assert not volume.embeddings[old:].any()
        assert not volume.weights[old:].any()
        volume.embeddings[old:] = torch.randn(volume.num_voxels - old, 8, generator=generator).to(device)
        volume.weights[old:] = 1.5
    assert volume.num_voxels == len(reference.ids) > 2000
    assert volume.capacity == 1 << (volume.num_voxels - 1).bit_length()
    assert [tuple(c) for c in volume.voxel_coords.tolist()] == list(reference.ids)
    assert volume.corner_ids.tolist() == reference.corner_rows()


def test_views_keep_their_memory_until_the_capacity_changes(device, generator):
    volume = SparseVolume(0.04, device=device, capacity=1024)
    volume.insert(random_coords(100, 5, generator, device))
    where = volume.embeddings.data_ptr()
    volume.insert(random_coords(100, 5, generator, device))
    assert volume.embeddings.data_ptr() == where
    assert volume.capacity == 1024


def test_fuse_is_a_weighted_mean(device):
    volume = SparseVolume(0.04, device=device)
    where = torch.tensor([[4, 5, 6], [1, 2, 3]], dtype=torch.int32, device=device)
    first, second = torch.full((2, 8), 1.0, device=device), torch.full((2, 8), 4.0, device=device)
    weight = torch.tensor([1.0, 0.5], device=device)
    ids = volume.fuse(where, first, weight, 2.0)
    assert ids.tolist() == [1, 0]
    volume.fuse(where, second, 2 * weight, 2.0)
    assert torch.allclose(volume.embeddings, torch.full((2, 8), 3.0, device=device))
    assert volume.weights.tolist() == [1.5, 2.0]


def test_lookup_returns_which_points_are_inside(device, generator):
    volume = SparseVolume(0.1, device=device)
    volume.insert(random_coords(500, 4, generator, device))
    reference = DictVolume()
    reference.insert(volume.voxel_coords.tolist())
    points = torch.rand(300, 3, generator=generator) - 0.5
    rows, local, valid = volume.lookup(points.to(device))
    want_rows, want_local = reference.lookup(points, 0.1)
    assert torch.equal(rows.cpu(), want_rows)
    assert torch.equal(valid.cpu(), want_rows[:, 0] >= 0)
    assert torch.allclose(local.cpu(), want_local, rtol=0, atol=2e-5)


def test_interpolation_is_exact_for_a_linear_field(device, generator):
    volume = SparseVolume(0.1, device=device)
    grid = torch.cartesian_prod(*[torch.arange(-3, 4, dtype=torch.int32)] * 3)
    volume.insert(grid.to(device))
    slope = torch.randn(3, 8, generator=generator).to(device)
    volume.embeddings.copy_(volume.voxel_coords.float() * 0.1 @ slope)
    points = (torch.rand(100, 3, generator=generator) - 0.5).to(device).mul_(0.58).requires_grad_()
    features, valid = volume.interpolate(points)
    assert valid.all()
    assert torch.allclose(features, points @ slope, atol=1e-5)
    (grad,) = torch.autograd.grad(features.sum(), points)
    assert torch.allclose(grad, slope.sum(1).expand_as(grad), atol=1e-4)


def test_restore_keeps_the_ids_of_a_grown_volume(device, generator):
    volume = SparseVolume(0.04, device=device, capacity=16)
    for extent in (3, 6, 10):
        ids = volume.insert(random_coords(400, extent, generator, device))
        volume.embeddings[ids.long()] = torch.randn(len(ids), 8, generator=generator).to(device)
    copy = SparseVolume(0.04, device=device, capacity=16)
    copy.insert(random_coords(50, 40, generator, device))
    copy.restore(volume.voxel_coords.cpu(), volume.embeddings.cpu(), volume.weights.cpu())
    for name in ("voxel_coords", "corner_ids", "embeddings", "weights"):
        assert torch.equal(getattr(copy, name), getattr(volume, name)), name
    more = random_coords(400, 14, generator, device)
    assert torch.equal(copy.insert(more), volume.insert(more))


def test_restore_refuses_inconsistent_tensors(device):
    volume = SparseVolume(0.04, device=device, max_voxels=2)
    twice = torch.zeros(2, 3, dtype=torch.int32)
    with pytest.raises(ValueError, match=r"voxel_coords must be distinct, got a repeated row"):
        volume.restore(twice, torch.zeros(2, 8), torch.zeros(2))
    with pytest.raises(ValueError, match=r"restore: embeddings must have shape \[2, 8\], got \[3, 8\]"):
        volume.restore(twice, torch.zeros(3, 8), torch.zeros(2))
    with pytest.raises(SpslamError, match=r"restore: voxels must stay within scene.max_voxels = 2, got 3"):
        volume.restore(torch.zeros(3, 3, dtype=torch.int32), torch.zeros(3, 8), torch.zeros(3))


def test_exceeding_the_limit_gives_a_one_line_error_and_no_change(device, generator):
    volume = SparseVolume(0.04, device=device, max_voxels=10)
    line = torch.arange(10, dtype=torch.int32, device=device)[:, None].expand(10, 3)
    volume.insert(line)
    volume.insert(line.repeat(3, 1))
    with pytest.raises(SpslamError, match="within scene.max_voxels = 10, got 13; raise it or choose a larger") as error:
        volume.insert(line.repeat(2, 1)[7:14] + 5)
    assert "\n" not in str(error.value)
    assert volume.num_voxels == 10


def test_empty_insert_and_lookup(device):
    volume = SparseVolume(0.04, device=device)
    assert volume.insert(torch.zeros((0, 3), dtype=torch.int32, device=device)).shape == (0,)
    rows, _, valid = volume.lookup(torch.zeros((5, 3), device=device))
    assert (rows == -1).all()
    assert not valid.any()


def test_resize_rows(generator):
    moments = torch.randn(3, 2, generator=generator)
    grown = resize_rows(moments, 5)
    assert torch.equal(grown[:3], moments)
    assert not grown[3:].any()
    assert resize_rows(grown, 5) is grown
    assert torch.equal(resize_rows(grown, 2), moments[:2])


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"voxel_size_m": 0}, "voxel_size_m must be positive, got 0"),
        ({"voxel_size_m": 0.04, "max_voxels": 0}, "max_voxels must be at least 1, got 0"),
        ({"voxel_size_m": 0.04, "capacity": 0}, "capacity must be at least 1, got 0"),
    ],
)
def test_wrong_sizes_are_refused(arguments, message):
    with pytest.raises(ValueError, match=f"SparseVolume: {message}"):
        SparseVolume(**arguments)


def test_the_volume_is_usable_after_a_failed_insertion(device, generator):
    """The capacity may have grown before the failure: all buffers must have the same number of rows."""
    volume = SparseVolume(0.04, device=device, capacity=4)
    coords = random_coords(300, 6, generator, device)
    with pytest.raises(RuntimeError, match="rows outside"):
        volume.insert(torch.cat([coords, torch.full_like(coords[:1], 2**20)]))
    assert volume.num_voxels == 0
    assert volume.buffers.rows == volume.capacity
    volume.fuse(coords[:1], torch.ones(1, 8, device=device), torch.ones(1, device=device), 2.0)
    assert volume.embeddings.tolist() == [[1.0] * 8]
