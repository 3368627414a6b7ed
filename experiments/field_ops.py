"""Speed of the ops that other people's fields are made of, compared with their best alternatives.

python -m experiments.field_ops --device cpu --threads 2
python -m experiments.field_ops --cpu-time     on a machine with other load: the CPU time of one thread
python -m experiments.field_ops --device cuda  wall-clock time, launches included, and GPU time
python -m experiments.field_ops --op eikonal   one of them
"""

import itertools
import time
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F  # noqa: N812

from experiments import timing
from experiments.alternatives import clocks_of, rows_of
from experiments.composable_ops import forward, forward_and_backward
from spslam import ops

RAYS, SAMPLES, POINTS = 2048, 64, 50_000
BOUNDS = [(0.0, 0.0, 0.0), (4.0, 3.0, 2.0)]
PLANE_SIZES = [(24, 18, 12), (96, 72, 48)]
HASH_SIZES = [(16, 12, 8), (32, 24, 16), (64, 48, 32), (128, 96, 64)]
HASH_ROWS = 2**15
Suite = tuple[str, dict[str, tuple[Callable, list]], Sequence[int]]  # name, contenders with arguments, differentiable


def torch_composite(opacities, values, t, lengths):
    """`alpha_composite` by cumulative sums over dense rays."""
    optical = opacities * lengths
    weights = torch.exp(-(optical.cumsum(1) - optical)) * (1 - torch.exp(-optical))
    return torch.bmm(weights[:, None], values)[:, 0], (weights * t).sum(1), weights.sum(1), weights


def torch_packed_composite(opacities, values, t, lengths, indices, packed_info):
    """The same over a list: sums of the whole list, less those up to the beginning of the ray; index_add."""
    optical = opacities * lengths
    before = optical.cumsum(0) - optical
    starts = before[packed_info[:, 0].clamp(max=len(optical) - 1)]
    weights = torch.exp(starts[indices] - before) * (1 - torch.exp(-optical))
    rays = len(packed_info)
    summed = values.new_zeros(rays, values.shape[1]).index_add(0, indices, weights[:, None] * values)
    depth = t.new_zeros(rays).index_add(0, indices, weights * t)
    return summed, depth, t.new_zeros(rays).index_add(0, indices, weights), weights


def compositing(generator: torch.Generator, device: torch.device) -> list[Suite]:
    t = torch.rand(RAYS, SAMPLES, generator=generator).sort(1).values.to(device)
    sigma = 20 * torch.rand(RAYS, SAMPLES, generator=generator).to(device)
    lengths = torch.full_like(t, 1 / SAMPLES)
    indices = torch.arange(RAYS, device=device).repeat_interleave(SAMPLES)
    info = ops.pack_rays(indices, RAYS)
    suites: list[Suite] = []
    for channels in (3, 32):
        values = torch.rand(RAYS, SAMPLES, channels, generator=generator).to(device)
        dense = [sigma, values, t, lengths]
        flat = [part.flatten(0, 1) for part in dense]
        torch.testing.assert_close(tuple(ops.alpha_composite(*dense)), torch_composite(*dense), rtol=1e-4, atol=1e-4)
        suites += [
            (
                f"alpha_composite, {RAYS} x {SAMPLES}, {channels} channels",
                {"spslam": (ops.alpha_composite, dense), "torch sums": (torch_composite, dense)},
                (0, 1),
            ),
            (
                f"alpha_composite, packed, {channels} channels",
                {
                    "spslam": (lambda *a: ops.alpha_composite(*a[:4], a[5]), [*flat, indices, info]),
                    "torch sums and index_add": (torch_packed_composite, [*flat, indices, info]),
                },
                (0, 1),
            ),
        ]
    return suites


def sampled_planes(table, points, grid):
    """Tri-planes of all levels by grid_sample, concatenated."""
    lower, upper = (points.new_tensor(corner) for corner in BOUNDS)
    scaled = (2 * (points - lower) / (upper - lower) - 1).view(1, -1, 1, 3)
    levels = []
    for images in grid.to_chw(table):
        parts = [
            F.grid_sample(image, scaled[..., axes], padding_mode="border", align_corners=True)
            for image, axes in zip(images, ([0, 1], [0, 2], [1, 2]), strict=True)
        ]
        levels.append((parts[0] + parts[1] + parts[2])[0, :, :, 0].T)
    return torch.cat(levels, 1)


def gathered(table, points, grid, kind):
    """All levels by indexing and gathering, concatenated."""
    integers, numbers = ops.grids._packed(grid, kind)
    parts = []
    for i in range(len(grid.levels)):
        stencil = ops.grids._level_stencil(points, integers[7 * i : 7 * i + 7], numbers[6 * i : 6 * i + 6], kind)
        rows = table.index_select(0, stencil.rows.flatten()).view(*stencil.rows.shape, -1)
        parts.append(torch.bmm(stencil.weights[:, None], rows)[:, 0])
    return torch.cat(parts, 1)


def grids(generator: torch.Generator, device: torch.device) -> list[Suite]:
    points = (torch.rand(POINTS, 3, generator=generator) * torch.tensor(BOUNDS[1])).to(device)
    planes = ops.TriPlaneLevels.from_sizes(BOUNDS, PLANE_SIZES)
    texels = torch.randn(planes.num_rows, 32, generator=generator).to(device)
    volume = ops.VolumeLevels.from_sizes(BOUNDS, HASH_SIZES, max_level_rows=HASH_ROWS)
    codes = torch.randn(volume.num_rows, 2, generator=generator).to(device)

    def ours(table, points):
        return ops.interpolate_tri_planes(table, points, planes, True)

    torch.testing.assert_close(ours(texels, points), sampled_planes(texels, points, planes), rtol=1e-3, atol=1e-3)
    return [
        (
            f"interpolate_tri_planes, 2 levels x 32, {POINTS} points",
            {
                "spslam": (ours, [texels, points]),
                "grid_sample": (lambda a, b: sampled_planes(a, b, planes), [texels, points]),
                "gather": (lambda a, b: gathered(a, b, planes, 0), [texels, points]),
            },
            (0, 1),
        ),
        (
            f"interpolate_volumes, hashed, 4 levels x 2, {POINTS} points",
            {
                "spslam": (lambda a, b: ops.interpolate_volumes(a, b, volume, True), [codes, points]),
                "gather": (lambda a, b: gathered(a, b, volume, 1), [codes, points]),
            },
            (0, 1),
        ),
    ]


def eikonal(function: Callable) -> Callable:
    """The mean of (|d f / d x| - 1)^2 of a field f(parameters, points)."""

    def loss(parameters, points):
        points = points.detach().requires_grad_()
        with torch.enable_grad():
            (slope,) = torch.autograd.grad(function(parameters, points).sum(), points, create_graph=True)
            return (slope.norm(dim=1) - 1).square().mean()

    return loss


def second_derivatives(generator: torch.Generator, device: torch.device) -> list[Suite]:
    count = POINTS // 5
    points = (torch.rand(count, 3, generator=generator) * torch.tensor(BOUNDS[1])).to(device)
    planes = ops.TriPlaneLevels.from_sizes(BOUNDS, PLANE_SIZES)
    texels = torch.randn(planes.num_rows, 32, generator=generator).to(device)
    params = ops.mlp_init_params(3, 64, 1, generator=generator).to(device)
    network = ops.mlp_to_sequential(params, 3, 64, 1).requires_grad_(False)
    names = list(dict(network.named_parameters()))

    def module(params, points):
        parts, first = {}, 0
        for name, part in network.named_parameters():
            parts[name] = params[first : first + part.numel()].view_as(part)
            first += part.numel()
        return torch.func.functional_call(network, parts, (points,))

    assert len(names) == 6
    return [
        (
            f"eikonal loss of interpolate_tri_planes, {count} points",
            {
                "spslam": (eikonal(lambda a, b: ops.interpolate_tri_planes(a, b, planes, True)), [texels, points]),
                "gather": (eikonal(lambda a, b: gathered(a, b, planes, 0)), [texels, points]),
            },
            (0,),
        ),
        (
            f"eikonal loss of mlp 3-64-64-1, {count} points",
            {
                "spslam": (eikonal(lambda a, b: ops.mlp(b, a, 64, 1)), [params, points]),
                "torch.nn": (eikonal(module), [params, points]),
            },
            (0,),
        ),
    ]


def networks(generator: torch.Generator, device: torch.device) -> list[Suite]:
    suites: list[Suite] = []
    for hidden, layers, activation, name in (
        (64, 2, ops.Activation.RELU, "ReLU"),
        (256, 2, ops.Activation.RELU, "ReLU"),
        (64, 3, ops.Activation.SOFTPLUS, "softplus"),
    ):
        options = dict(hidden=hidden, output=4, layers=layers, hidden_activation=activation)
        params = ops.mlp_init_params(32, hidden, 4, layers, activation, generator=generator).to(device)
        x = torch.randn(20_000, 32, generator=generator).to(device)
        sizes = [32, *[hidden] * layers, 4]

        def by_linear(x, params, sizes=sizes, activation=activation):
            first = 0
            for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
                weight = params[first : first + inputs * outputs].view(outputs, inputs)
                bias = params[first + inputs * outputs : first + inputs * outputs + outputs]
                first += inputs * outputs + outputs
                x = F.linear(x, weight, bias)
                if i < len(sizes) - 2:
                    x = x.relu() if activation == ops.Activation.RELU else F.softplus(x)
            return x

        suites.append(
            (
                f"mlp {'-'.join(map(str, sizes))}, {name}",
                {
                    "spslam": (lambda x, p, options=options: ops.mlp(x, p, **options), [x, params]),
                    "linear": (by_linear, [x, params]),
                },
                (0, 1),
            )
        )
    return suites


def without_gradient(generator: torch.Generator, device: torch.device) -> dict[str, dict[str, Callable]]:
    cells = ops.VoxelHash(device=device)
    surface = torch.randint(-60, 60, (40_000, 3), generator=generator).to(device)
    cells.insert(surface)
    coords = surface[:20_000].int()
    offsets = torch.tensor([o for o in itertools.product(range(-2, 3), repeat=3) if sum(map(abs, o)) <= 2])
    offsets = offsets.to(device)
    from spslam.ops._voxel_queries import pack

    keys, order = pack(cells.voxel_coords).sort()

    def searched():
        wanted = pack(coords[:, None] + offsets)
        place = torch.searchsorted(keys, wanted).clamp(max=len(keys) - 1)
        return torch.where(keys[place] == wanted, order[place], -1)

    assert torch.equal(cells.neighbors(coords, offsets).long(), searched())
    found = {
        f"VoxelHash.neighbors, {len(coords)} x {len(offsets)}": {
            "spslam": lambda: cells.neighbors(coords, offsets),
            "searchsorted": searched,
        }
    }
    if device.type == "cpu":
        from scipy.spatial import cKDTree

        points = 120 * torch.rand(5000, 3, generator=generator, dtype=torch.float64) - 60
        tree = cKDTree(cells.voxel_coords.numpy())
        found["VoxelHash.nearest, 5000 points, 8 within 3 voxels"] = {
            "spslam": lambda: cells.nearest(points, 1.0, 8, 3.0),
            "SciPy's k-d tree": lambda: tree.query(points.numpy(), 8, distance_upper_bound=3.0),
        }
    return found


def main() -> None:
    parser = timing.arguments("ops of other people's fields against their best alternatives")
    parser.add_argument(
        "--cpu-time", action="store_true", help="time of one CPU thread, whatever else the machine does"
    )
    parser.add_argument("--op", default="", help="only rows whose name contains this")
    args = parser.parse_args()
    device = torch.device(args.device)
    timing.use_threads(1 if args.cpu_time else args.threads)
    clocks = clocks_of(device, args.rounds, time.process_time if args.cpu_time else time.perf_counter)
    rows: list[dict[str, object]] = []
    for make in (compositing, grids, second_derivatives, networks):
        for name, contenders, differentiable in make(torch.Generator().manual_seed(0), device):
            if args.op not in name:
                continue
            if "eikonal" not in name:
                alone = {key: forward(*pair) for key, pair in contenders.items()}
                rows += rows_of(name, "forward", alone, clocks)
            both = {key: forward_and_backward(*pair, differentiable) for key, pair in contenders.items()}
            rows += rows_of(name, "forward + backward", both, clocks)
    for name, functions in without_gradient(torch.Generator().manual_seed(0), device).items():
        if args.op in name:
            rows += rows_of(name, "forward", functions, clocks)
    if not rows:
        parser.error(f"argument --op: no row's name contains {args.op}")
    timing.report("ops of other people's fields", rows, device, args.json)


if __name__ == "__main__":
    main()
