"""Other projects' published formulas, and what docs/port-to-ops.md puts in their place.

ESLAM: Johari et al., "ESLAM: Efficient Dense SLAM System Based on Hybrid Representation of Signed Distance Fields",
2023, equations 1 to 6. PIN-SLAM: Pan et al., "PIN-SLAM: LiDAR SLAM Using a Point-Based Implicit Neural Representation",
2024, section III. nerfacc: Li et al., 2023.
"""

import itertools

import torch
import torch.nn.functional as F  # noqa: N812

from spslam import ops

BOUNDS = [(-1.0, -0.8, -0.6), (1.2, 0.9, 0.7)]
BETA = 10.0


def planes_of(size, channels, generator, device):
    x, y, z = size
    shapes = ((y, x), (z, x), (z, y))
    return [torch.randn(1, channels, h, w, generator=generator, dtype=torch.float64).to(device) for h, w in shapes]


def test_eslam(device, generator):
    """Features of both resolutions, decoder, density, termination probabilities, color and depth; all gradients."""
    images = [planes_of(size, 4, generator, device) for size in ((9, 8, 7), (23, 18, 14))]
    network = torch.nn.Sequential(
        torch.nn.Linear(8, 16), torch.nn.ReLU(), torch.nn.Linear(16, 16), torch.nn.ReLU(), torch.nn.Linear(16, 1),
        torch.nn.Tanh(),
    ).to(device, torch.float64)  # fmt: skip
    t = torch.rand(6, 20, generator=generator, dtype=torch.float64).sort(1).values.to(device)
    direction = torch.randn(6, 1, 3, generator=generator, dtype=torch.float64).to(device)
    points = t[..., None] * F.normalize(direction, dim=2)
    color = torch.rand(6, 20, 3, generator=generator, dtype=torch.float64).to(device)
    table, grid = ops.tri_planes_from_chw(*zip(*images, strict=True), bounds=BOUNDS)
    leaves = [table.requires_grad_(), *network.parameters()]

    # Published: points normalized to the bounds, bilinear values of three planes added up, resolutions concatenated;
    # sigma = beta sigmoid(-beta phi); w_n = exp(-sum_{k < n} sigma_k) (1 - exp(-sigma_n)).
    lower, upper = (points.new_tensor(corner) for corner in BOUNDS)
    scaled = (2 * (points - lower) / (upper - lower) - 1).view(1, -1, 1, 3)
    features = []
    for level in grid.to_chw(table):
        sampled = [
            F.grid_sample(image, scaled[..., axes], padding_mode="border", align_corners=True)
            for image, axes in zip(level, ([0, 1], [0, 2], [1, 2]), strict=True)
        ]
        features.append(sum(sampled)[0, :, :, 0].T)
    phi = network(torch.cat(features, 1)).view(6, 20)
    sigma = BETA * torch.sigmoid(-BETA * phi)
    passed = torch.exp(-(sigma.cumsum(1) - sigma))
    weights = passed * (1 - torch.exp(-sigma))
    want = [(weights[..., None] * color).sum(1), (weights * t).sum(1)]
    want_grads = torch.autograd.grad(want[0].sum() + want[1].square().sum(), leaves)

    params, options = ops.mlp_params_from(network)
    inputs = ops.interpolate_tri_planes(table, points, grid, concatenate=True)
    sdf = ops.mlp(inputs, params, **options)[..., 0]
    density = BETA * torch.sigmoid(-BETA * sdf)
    got = ops.alpha_composite(density, color, t, torch.ones_like(t))
    torch.testing.assert_close([got.values, got.depth], want)
    got_grads = torch.autograd.grad(got.values.sum() + got.depth.square().sum(), leaves)
    torch.testing.assert_close(got_grads, want_grads)


def test_pin_slam(device, generator):
    """Neural points by voxel, one each; features by the inverse squared distance of those in the neighborhood."""
    voxel = 0.3
    positions = torch.rand(600, 3, generator=generator, dtype=torch.float64).to(device) * 4 - 2
    cells = ops.VoxelHash(device=device)
    ids, new = cells.insert(torch.floor(positions / voxel).long(), return_new=True)
    first = torch.full((len(cells),), len(ids), device=device).scatter_reduce(
        0, ids.long(), torch.arange(len(ids), device=device), "amin"
    )
    positions = positions[first]  # the first point of every voxel stays
    features = torch.randn(len(cells), 8, generator=generator, dtype=torch.float64).to(device)
    offsets = torch.tensor([o for o in itertools.product((-1, 0, 1), repeat=3)], device=device)
    points = torch.rand(50, 3, generator=generator, dtype=torch.float64).to(device) * 4 - 2

    near = cells.neighbors(torch.floor(points / voxel).int(), offsets)
    rows = near.clamp(min=0).long()
    squared = (points[:, None] - positions[rows]).square().sum(2).masked_fill(near < 0, float("inf"))
    weights = 1 / squared.clamp(min=1e-12)
    got = (weights[..., None] * features[rows]).sum(1) / weights.sum(1, keepdim=True)

    voxels = torch.floor(positions / voxel)
    for point, feature in zip(points, got, strict=True):
        around = ((voxels - torch.floor(point / voxel)).abs() <= 1).all(1)
        if around.any():
            w = 1 / (point - positions[around]).square().sum(1)
            torch.testing.assert_close(feature, (w[:, None] * features[around]).sum(0) / w.sum())
        else:
            assert feature.isnan().all()


def test_nerfacc(device, generator):
    """Weights of a list of intervals by density: alpha (1 - alpha) products along each ray, here by logarithms."""
    counts = torch.tensor([5, 0, 40, 1], device=device)
    indices = torch.arange(4, device=device).repeat_interleave(counts)
    starts = torch.rand(46, generator=generator, dtype=torch.float64).to(device)
    ends = starts + 0.1
    sigmas = (3 * torch.rand(46, generator=generator, dtype=torch.float64)).to(device)
    colors = torch.rand(46, 5, generator=generator, dtype=torch.float64).to(device)
    optical = sigmas * (ends - starts)
    before = torch.stack([optical[(indices == r) & (torch.arange(46, device=device) < i)].sum()
                          for i, r in enumerate(indices)])  # fmt: skip
    weights = torch.exp(-before) * (1 - torch.exp(-optical))
    accumulated = torch.zeros(4, 5, dtype=torch.float64, device=device).index_add(0, indices, weights[:, None] * colors)
    packed_info = ops.pack_rays(indices, 4)
    assert packed_info.tolist() == [[0, 5], [5, 0], [5, 40], [45, 1]]
    got = ops.alpha_composite(sigmas, colors, (starts + ends) / 2, ends - starts, packed_info)
    torch.testing.assert_close(got.weights, weights)
    torch.testing.assert_close(got.values, accumulated)
