"""A frame encoded into a volume in one call, against the single ops one after the other."""

import dataclasses

import pytest
import torch

from spslam import ops
from spslam.errors import SpslamError
from spslam.scene import SparseVolume
from tests.ops.test_prior_fusion import FEATURE_TOLERANCE, random_encoder, surface

FUSION = ops.FrameFusion(
    voxel_size=0.04,
    neighborhood=64,
    min_pair_weight=1e-4,
    max_points=8000,
    min_weight=0.006,
    kappa=2.5,
    max_weight=3.0,
)
# Factors rounded to 11 bits in three layers: 5e-4 each of hidden units and features of order 1.
TF32_TOLERANCE = 5e-3


def wall(count, generator, extent=3.0):
    """Points of a noisy wall of some meters, one in ten without a normal."""
    points = (torch.rand(count, 3, generator=generator) - 0.5) * extent
    points[:, 2] = 1.5 + 0.2 * points[:, 0] + 0.01 * torch.randn(count, generator=generator)
    _, normals = surface(count, generator)
    normals[torch.rand(count, generator=generator) < 0.1] = 0
    return points, normals


def encode(volume, points, normals, params, fusion=FUSION, tf32=False):
    """One call, with room made as needed; tf32 where asked."""
    while True:
        arguments = (x.to(volume.device) for x in (points, normals, params))
        encoded = ops.encode_frame_(volume.buffers, volume.num_voxels, volume.capacity, *arguments, fusion, tf32)
        if encoded.fits:
            volume.cells.num_voxels += encoded.new_voxels
            return encoded
        with volume._growth("encode"):
            volume.cells.reserve(volume.num_voxels + encoded.new_voxels)


def compose(volume, points, normals, params, fusion=FUSION):
    """The same from the single ops."""
    known = normals.any(1).nonzero()[: fusion.max_points, 0]
    coords, features, weights = ops.encode_points(
        points[known].to(volume.device),
        normals[known].to(volume.device),
        params.to(volume.device),
        fusion.voxel_size,
        fusion.neighborhood,
        fusion.min_pair_weight,
        tf32=False,
    )
    keep = weights > fusion.min_weight
    # On the CPU: torch's CUDA division by a number multiplies by its reciprocal.
    shares = (weights[keep].cpu() / fusion.kappa).clamp(max=1).to(volume.device)
    volume.fuse(coords[keep], features[keep], shares, fusion.max_weight)


def content(volume):
    """Tensors of the volume on the CPU."""
    names = ("voxel_coords", "corner_ids", "weights", "embeddings")
    return {name: getattr(volume, name).cpu() for name in names}


def check_same(volume, other, tolerance):
    """Vertices, their numbers and weights to the bit, embeddings up to rounding."""
    got, want = content(volume), content(other)
    assert torch.equal(got["voxel_coords"], want["voxel_coords"])
    assert torch.equal(got["corner_ids"], want["corner_ids"])
    assert torch.equal(got["weights"], want["weights"])
    assert torch.allclose(got["embeddings"], want["embeddings"], rtol=0, atol=tolerance)
    probe = torch.randint(-60, 60, (3000, 3), dtype=torch.int32)
    found = [ops.voxel_hash_find(v.hash_keys, v.hash_values, probe.to(v.device)).cpu() for v in (volume, other)]
    assert torch.equal(*found)


@pytest.mark.parametrize("neighborhood", [64, 8])
@pytest.mark.parametrize("capacity", [1 << 4, 1 << 16])
def test_it_is_the_single_ops_in_one(device, neighborhood, capacity, generator):
    params = random_encoder(generator)
    fusion = dataclasses.replace(FUSION, neighborhood=neighborhood)
    volume, want = (SparseVolume(0.04, device=device, capacity=capacity) for _ in range(2))
    for shift in (0.0, 0.3, 0.3, 0.9):
        points, normals = wall(6000, generator)
        points = points + shift
        before = volume.num_voxels
        encoded = encode(volume, points, normals, params, fusion)
        compose(want, points, normals, params, fusion)
        assert encoded.new_voxels == volume.num_voxels - before
        assert torch.equal(encoded.bounds, torch.stack([points.amin(0), points.amax(0)]))
        check_same(volume, want, FEATURE_TOLERANCE)
    assert volume.num_voxels > 10_000


@pytest.mark.cuda
@pytest.mark.parametrize("tf32, tolerance", [(False, FEATURE_TOLERANCE), (True, TF32_TOLERANCE)])
def test_devices_agree(tf32, tolerance, generator):
    params = random_encoder(generator)
    volumes = [SparseVolume(0.04, device=name, capacity=64) for name in ("cpu", "cuda")]
    for shift in (0.0, 0.4, 0.4):
        points, normals = wall(8000, generator)
        results = [encode(volume, points + shift, normals, params, tf32=tf32) for volume in volumes]
        assert results[0].new_voxels == results[1].new_voxels
        assert torch.equal(results[0].bounds, results[1].bounds)
        check_same(volumes[1], volumes[0], tolerance)


@pytest.mark.parametrize("tf32", [True, False])
def test_every_run_gives_the_same_bits(device, tf32, generator):
    params, runs = random_encoder(generator), []
    frames = [wall(5000, generator) for _ in range(3)]
    for _ in range(3):
        volume = SparseVolume(0.04, device=device)
        for points, normals in frames:
            encode(volume, points, normals, params, tf32=tf32)
        runs.append(content(volume))
    for run in runs[1:]:
        assert all(torch.equal(run[name], runs[0][name]) for name in run)


@pytest.mark.cuda
def test_on_cuda_the_order_of_points_does_not_matter(generator):
    params, (points, normals) = random_encoder(generator), wall(5000, generator)
    order = torch.randperm(5000, generator=generator)
    volumes = [SparseVolume(0.04, device="cuda") for _ in range(2)]
    encode(volumes[0], points, normals, params, tf32=True)
    encode(volumes[1], points[order], normals[order], params, tf32=True)
    check_same(volumes[1], volumes[0], 0.0)


def test_only_the_first_points_with_a_normal_count(device, generator):
    params, (points, normals) = random_encoder(generator), wall(3000, generator)
    known = normals.any(1)
    volume, want = SparseVolume(0.04, device=device), SparseVolume(0.04, device=device)
    for max_points in (1, 31, 32, 33, 1000):
        fusion = dataclasses.replace(FUSION, max_points=max_points)
        encode(volume, points, normals, params, fusion)
        encode(want, points[known][:max_points], normals[known][:max_points], params, fusion)
        check_same(volume, want, FEATURE_TOLERANCE)
    assert encode(volume, points, normals, params, dataclasses.replace(FUSION, max_points=0)).new_voxels == 0


def test_known_vertices_may_be_left_alone(device, generator):
    params, fusion = random_encoder(generator), dataclasses.replace(FUSION, fuse_known=False)
    volume, alone = SparseVolume(0.04, device=device), SparseVolume(0.04, device=device)
    first, second = wall(3000, generator), wall(3000, generator)
    encode(volume, *first, params, fusion)
    known, before = volume.num_voxels, content(volume)
    encode(volume, second[0] + 0.5, second[1], params, fusion)
    assert volume.num_voxels > known > 1000
    after = content(volume)
    for name in ("weights", "embeddings"):
        assert torch.equal(after[name][:known], before[name])
    encode(alone, second[0] + 0.5, second[1], params)
    ids = ops.voxel_hash_find(alone.hash_keys, alone.hash_values, volume.voxel_coords[known:]).long()
    assert torch.equal(volume.weights[known:], alone.weights[ids])
    assert torch.equal(volume.embeddings[known:], alone.embeddings[ids])


def test_points_far_apart_have_all_their_vertices_to_themselves(device, generator):
    params = random_encoder(generator)
    points = torch.cartesian_prod(*[torch.arange(13.0) * 0.4] * 3) + 0.02
    normals = torch.nn.functional.normalize(torch.randn(len(points), 3, generator=generator), dim=1)
    volume = SparseVolume(0.04, device=device, capacity=64)
    fusion = dataclasses.replace(FUSION, min_pair_weight=0.0, min_weight=0.0)
    assert encode(volume, points, normals, params, fusion).new_voxels == 64 * 13**3
    coords = volume.voxel_coords.cpu().long() + 2**20
    assert ((coords[:, 0] << 42 | coords[:, 1] << 21 | coords[:, 2]).diff() > 0).all()


def test_points_that_are_not_finite_or_too_far_are_skipped(device, generator):
    params, (points, normals) = random_encoder(generator), wall(100, generator)
    corrupted = points.clone()
    corrupted[:4, 1] = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e9])
    volume, want = SparseVolume(0.04, device=device), SparseVolume(0.04, device=device)
    encoded = encode(volume, corrupted, normals, params)
    normals[:4] = 0
    encode(want, points, normals, params)
    check_same(volume, want, 0.0)
    assert torch.equal(encoded.bounds, torch.stack([corrupted[3:].amin(0), corrupted[3:].amax(0)]))
    nothing = encode(volume, torch.full((5, 3), torch.nan), torch.ones(5, 3), params)
    assert nothing.new_voxels == 0
    assert (nothing.bounds[0] == torch.inf).all()
    assert (nothing.bounds[1] == -torch.inf).all()


def test_nothing_to_encode(device, generator):
    params, (points, normals) = random_encoder(generator), wall(40, generator)
    volume = SparseVolume(0.04, device=device)
    for case in ((points[:0], normals[:0]), (points, torch.zeros_like(normals))):
        assert encode(volume, *case, params).new_voxels == 0
    assert volume.num_voxels == 0


def test_without_room_nothing_changes(device, generator):
    params = random_encoder(generator)
    volume = SparseVolume(0.04, max_voxels=20_000, device=device, capacity=64)
    encode(volume, *wall(3000, generator), params)
    before = content(volume)
    keys, values = volume.hash_keys.clone(), volume.hash_values.clone()
    buffers = dataclasses.replace(volume.buffers, hash_keys=keys, hash_values=values)
    points, normals = (x.to(device) for x in wall(3000, generator))
    full = ops.encode_frame_(
        buffers, volume.num_voxels, volume.num_voxels, points + 1, normals, params.to(device), FUSION
    )
    assert not full.fits
    assert full.new_voxels > 1000
    volume.cells.max_voxels = volume.num_voxels + 10
    with pytest.raises(SpslamError, match=r"SparseVolume.encode: voxels must stay within scene.max_voxels = \d+, got"):
        volume.encode(points + 1, normals, params.to(device), FUSION)
    assert torch.equal(keys, volume.hash_keys)
    assert torch.equal(values, volume.hash_values)
    assert all(torch.equal(value, before[name]) for name, value in content(volume).items())


@pytest.mark.cuda
def test_a_broken_network_gives_nan_on_cuda(generator):
    points, normals = wall(500, generator)
    for value in (torch.nan, torch.inf, 1e9):
        params = random_encoder(generator)
        params[-1] = value
        volume = SparseVolume(0.04, device="cuda")
        encode(volume, points, normals, params)
        assert volume.embeddings.isnan().all()
        assert volume.weights.isfinite().all()


def test_wrong_arguments_are_named(generator):
    params, (points, normals) = random_encoder(generator), wall(4, generator)
    volume = SparseVolume(0.04, capacity=64)
    buffers = volume.buffers

    def call(buffers=buffers, used=0, limit=64, points=points, normals=normals, params=params, **change):
        ops.encode_frame_(buffers, used, limit, points, normals, params, dataclasses.replace(FUSION, **change))

    for change, message in (
        ({"limit": 65}, r"max_voxels must be in \[0, 64\], got 65"),
        ({"used": 9, "limit": 8}, r"num_voxels must be in \[0, 8\], got 9"),
        ({"normals": normals[1:]}, r"normals must have shape \[4, 3\], got \[3, 3\]"),
        ({"params": params[1:]}, r"encoder_params must have shape \[5128\], got \[5127\]"),
        ({"voxel_size": 0}, "voxel_size must be positive, got 0"),
        ({"neighborhood": 27}, "neighborhood must be 64 or 8, got 27"),
        ({"min_pair_weight": -1}, "min_pair_weight must be at least 0, got -1"),
        ({"max_points": -1}, "max_points must be at least 0, got -1"),
        ({"min_weight": -1}, "min_weight must be at least 0, got -1"),
        ({"kappa": 0}, "kappa must be positive, got 0"),
        ({"max_weight": 0}, "max_weight must be positive, got 0"),
        (
            {"buffers": dataclasses.replace(buffers, corner_ids=buffers.corner_ids[1:])},
            r"corner_ids must have shape \[64, 8\], got \[63, 8\]",
        ),
        (
            {"buffers": dataclasses.replace(buffers, hash_keys=buffers.hash_keys[1:])},
            "hash_keys must have a power of two of slots, got 127",
        ),
    ):
        with pytest.raises(ValueError, match=f"encode_frame_: {message}"):
            call(**change)
    with pytest.raises(TypeError, match="encode_frame_: points must be float32, got float64"):
        call(points=points.double())


def test_opcheck(device, generator):
    volume = SparseVolume(0.04, device=device)
    tensors = [getattr(volume.buffers, field.name) for field in dataclasses.fields(volume.buffers)]
    points, normals = (x.to(device) for x in wall(50, generator))
    scalars, integers = [0.04, 1e-4, 0.006, 2.5, 20.0], [0, 1 << 16, 64, 8000, 1, 1]
    torch.library.opcheck(
        torch.ops.spslam.encode_frame_,
        (tensors, points, normals, random_encoder(generator).to(device), scalars, integers, torch.empty(2, 3)),
        test_utils=("test_schema", "test_autograd_registration"),
    )
