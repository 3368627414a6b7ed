"""One frame encoded into the volume: what is allocated, and how exact the surface is before any optimization."""

import math

import pytest
import torch

from spslam import ops
from spslam.errors import ConfigError, SpslamError
from spslam.options import PriorOptions
from spslam.prior import load_prior
from spslam.scene.sparse_volume import SparseVolume
from spslam.slam.encode_frame import encode_frame

VOXEL_M = 0.04
TRUNCATION_M = 0.08
NOISE_M = 0.002
# The prior is trained to a mean error of 3 to 4 mm between one and two voxels from a surface.
FIELD_TOLERANCE_M = TRUNCATION_M / 10
OPTIONS = PriorOptions(
    enabled=True,
    fusion=True,
    weights=None,
    decoder="pretrained",
    neighborhood=64,
    points_per_frame=8000,
    min_weight=0.006,
    kappa=2.5,
    max_weight=20,
    normal_step_px=4,
    max_jump=0.05,
)


def changed(**options):
    return OPTIONS.model_copy(update=options)


def rays(count, generator, half_width=0.4):
    uv = (torch.rand(count, 2, generator=generator) - 0.5) * 2 * half_width
    return torch.cat([uv, torch.ones(count, 1)], 1)


def plane(count, generator):
    """Points seen from the origin, their normals, and the noise-free points."""
    normal = torch.nn.functional.normalize(torch.tensor([0.4, -0.3, -0.85]), dim=0)
    directions = rays(count, generator)
    exact = directions * (-1.2 / (directions @ normal))[:, None]
    return directions, exact, normal.expand_as(exact)


def sphere(count, generator, radius=0.4):
    center = torch.tensor([0.1, -0.05, 1.5])
    directions = rays(8 * count, generator)
    a, b = directions.square().sum(1), directions @ center
    root = b.square() - a * (center.square().sum() - radius**2)
    # Not the outermost rim, where a pixel of noise is a long way along the surface.
    seen = (root > (0.3 * radius) ** 2 * a).nonzero()[:count, 0]
    directions = directions[seen]
    exact = directions * ((b - root.clamp(min=0).sqrt()) / a)[seen, None]
    return directions, exact, (exact - center) / radius


SURFACES = {"plane": plane, "sphere": sphere}


def observe(name, generator, count=6000):
    directions, exact, normals = SURFACES[name](count, generator)
    points = exact + NOISE_M * torch.randn(len(exact), 1, generator=generator) * directions
    return points, normals, exact


def distance(volume, prior, points):
    """Signed distance (m) by the prior's decoder, and where all corners exist."""
    features, valid = volume.interpolate(points)
    inputs = torch.cat([torch.zeros_like(points), features], 1)
    decoder = prior.decoder_params.to(points.device)
    return ops.mlp(inputs, decoder, 32, 1, ops.Activation.TANH)[:, 0] * TRUNCATION_M, valid


def crossing_offset(volume, prior, exact, normals):
    """Where the field crosses zero along the normal of each exact point, m; NaN where it doesn't."""
    steps = torch.linspace(-0.03, 0.03, 61, device=exact.device)
    line = exact[:, None] + steps[:, None] * normals[:, None]
    sdf, valid = distance(volume, prior, line.reshape(-1, 3))
    sdf, valid = sdf.view(len(exact), -1), valid.view(len(exact), -1)
    crosses = (sdf[:, :-1] < 0) & (sdf[:, 1:] >= 0) & valid[:, :-1] & valid[:, 1:]
    found, first = crosses.max(1)
    low, high = (sdf.gather(1, (first + i)[:, None])[:, 0] for i in (0, 1))
    offset = steps[first] - low / (high - low) * (steps[1] - steps[0])
    return offset.where(found, math.nan)


@pytest.mark.parametrize("name", SURFACES)
def test_one_look_at_a_surface_places_it_within_three_millimeters(device, name, generator):
    points, normals, exact = (x.to(device) for x in observe(name, generator))
    prior = load_prior()
    volume = SparseVolume(VOXEL_M, device=device)
    encode_frame(volume, points, normals, prior, OPTIONS)
    inner = (exact - exact.mean(0)).norm(dim=1) < 0.3  # away from the edge of what was seen
    offset = crossing_offset(volume, prior, exact[inner][:1500], normals[inner][:1500])
    found = ~offset.isnan()
    assert found.float().mean() > 0.99
    assert offset[found].abs().median() < 0.003
    assert offset[found].abs().quantile(0.95) < 0.008


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize(
    "min_weight, reach_m, least_valid", [(OPTIONS.min_weight, 0.5 * VOXEL_M, 0.95), (0.0, 0.7 * TRUNCATION_M, 0.95)]
)
def test_the_field_is_right_around_the_surface(device, name, min_weight, reach_m, least_valid, generator):
    points, normals, exact = (x.to(device) for x in observe(name, generator))
    prior = load_prior()
    volume = SparseVolume(VOXEL_M, device=device)
    encode_frame(volume, points, normals, prior, changed(min_weight=min_weight))
    inner = (exact - exact.mean(0)).norm(dim=1) < 0.3
    for offset_m in (-reach_m, -0.4 * reach_m, 0.4 * reach_m, reach_m):
        sdf, valid = distance(volume, prior, exact[inner] + offset_m * normals[inner])
        assert valid.float().mean() > least_valid
        assert ((sdf > 0) == (offset_m > 0))[valid].float().mean() > 0.99
        assert (sdf[valid] - offset_m).abs().median() < FIELD_TOLERANCE_M


def test_light_pairs_left_out_are_worth_less_than_a_tenth_of_a_millimeter(generator):
    points, normals, exact = observe("sphere", generator)
    prior = load_prior()
    offset_m = (torch.rand(len(exact), 1, generator=generator) * 2 - 1) * 0.06
    fused, exact_sum = SparseVolume(VOXEL_M), SparseVolume(VOXEL_M)
    encode_frame(fused, points, normals, prior, OPTIONS)
    coords, features, weights = ops.encode_points(points, normals, prior.encoder_params, VOXEL_M, 64, 0.0)
    keep = weights > OPTIONS.min_weight
    exact_sum.fuse(coords[keep], features[keep], (weights[keep] / OPTIONS.kappa).clamp(max=1), OPTIONS.max_weight)
    fields = [distance(volume, prior, exact + offset_m * normals) for volume in (fused, exact_sum)]
    both = fields[0][1] & fields[1][1]
    assert (fields[0][0] - fields[1][0])[both].abs().quantile(0.99) < 1e-4
    assert both.sum() > 0.95 * fields[1][1].sum()


def test_weights_are_shares_of_kappa_capped_at_one_and_at_the_total(device, generator):
    points, normals, _ = (x.to(device) for x in observe("plane", generator))
    prior = load_prior()
    volume = SparseVolume(VOXEL_M, device=device)
    encode_frame(volume, points, normals, prior, OPTIONS)
    sums = ops.encode_points(points, normals, prior.encoder_params.to(device), VOXEL_M, 64, OPTIONS.min_weight / 60)[2]
    want = (sums[sums > OPTIONS.min_weight].cpu() / OPTIONS.kappa).clamp(max=1)
    assert torch.equal(volume.weights.cpu(), want)
    for _ in range(3):
        encode_frame(volume, points, normals, prior, changed(max_weight=2.5))
    assert volume.weights.max() == 2.5


def test_without_fusion_only_new_voxels_are_filled(device, generator):
    points, normals, _ = (x.to(device) for x in observe("plane", generator))
    prior, half = load_prior(), len(points) // 2
    left = points[:, 0].argsort()[:half]
    volume, want = SparseVolume(VOXEL_M, device=device), SparseVolume(VOXEL_M, device=device)
    encode_frame(volume, points[left], normals[left], prior, OPTIONS)
    before, weights, known = volume.embeddings.clone(), volume.weights.clone(), volume.num_voxels
    moved = points + 0.01 * normals
    assert encode_frame(volume, moved, normals, prior, changed(fusion=False)).new_voxels > 0
    assert torch.equal(volume.embeddings[:known], before)
    assert torch.equal(volume.weights[:known], weights)
    encode_frame(want, moved, normals, prior, OPTIONS)
    ids = ops.voxel_hash_find(want.hash_keys, want.hash_values, volume.voxel_coords[known:]).long()
    assert torch.equal(volume.embeddings[known:], want.embeddings[ids])
    assert torch.equal(volume.weights[known:], want.weights[ids])


def test_only_the_first_points_with_a_normal_are_taken(device, generator):
    points, normals, _ = (x.to(device) for x in observe("plane", generator, count=400))
    normals = normals.clone()
    normals[::2] = 0
    prior = load_prior()
    volume, want = SparseVolume(VOXEL_M, device=device), SparseVolume(VOXEL_M, device=device)
    encode_frame(volume, points, normals, prior, changed(points_per_frame=50))
    encode_frame(want, points[1:100:2], normals[1:100:2], prior, OPTIONS)
    assert torch.equal(volume.voxel_coords, want.voxel_coords)
    assert torch.equal(volume.weights, want.weights)
    # The unit of CUDA's integer sums depends on the number of points given.
    assert torch.allclose(volume.embeddings, want.embeddings, rtol=0, atol=1e-6)


def test_nothing_to_encode(device, generator):
    points, normals, _ = (x.to(device) for x in observe("plane", generator, count=10))
    volume = SparseVolume(VOXEL_M, device=device)
    for prior in (load_prior(), None):
        encoded = encode_frame(volume, points, torch.zeros_like(normals), prior, OPTIONS)
        assert encoded.new_voxels == 0
        assert torch.equal(encoded.bounds, torch.stack([points.amin(0), points.amax(0)]).cpu())
        encoded = encode_frame(volume, points[:0], normals[:0], prior, OPTIONS)
        assert encoded.new_voxels == 0
        assert (encoded.bounds[0] > encoded.bounds[1]).all()
    assert volume.num_voxels == 0


def test_without_a_prior_the_same_voxels_start_at_random(device, generator):
    points, normals, _ = (x.to(device) for x in observe("plane", generator))
    with_prior, without = SparseVolume(VOXEL_M, device=device), SparseVolume(VOXEL_M, device=device)
    encode_frame(with_prior, points, normals, load_prior(), OPTIONS)
    encode_frame(without, points[:3000], normals[:3000], None, OPTIONS, seed=5)
    before = without.embeddings.clone()
    encode_frame(without, points, normals, None, OPTIONS, seed=5)
    assert torch.equal(without.embeddings[: len(before)], before)
    assert set(map(tuple, without.voxel_coords.tolist())) >= set(map(tuple, with_prior.voxel_coords.tolist()))
    assert torch.equal(without.embeddings, ops.random_embeddings(without.voxel_coords, 5))
    assert not without.weights.any()


def test_weights_of_another_neighborhood_are_refused(generator):
    points, normals, _ = observe("plane", generator, count=10)
    with pytest.raises(ConfigError, match="prior.neighborhood must be 64, that of the weights, got 8"):
        encode_frame(SparseVolume(VOXEL_M), points, normals, load_prior(), changed(neighborhood=8))


def test_the_limit_of_voxels_is_reported(generator):
    points, normals, _ = observe("plane", generator)
    volume = SparseVolume(VOXEL_M, max_voxels=100)
    with pytest.raises(SpslamError, match="voxels must stay within scene.max_voxels = 100"):
        encode_frame(volume, points, normals, load_prior(), OPTIONS)
    assert volume.num_voxels == 0
