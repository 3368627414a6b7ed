"""Speed of each op compared with its alternatives: how many times slower the fastest alternative is.

python -m experiments.alternatives --device cpu --threads 2
python -m experiments.alternatives --cpu-time     on a machine with other load: the CPU time of one thread
python -m experiments.alternatives --device cuda  wall-clock time, launches included, and GPU time
python -m experiments.alternatives --op mlp       one of them
"""

import functools
import time
from collections.abc import Callable, Sequence

import cv2
import torch

from experiments import composable_ops, map_ops, room, timing
from experiments.compose import TORCH
from spslam import ops

SIDE, POINTS, CHANNELS = 64, 88_064, 8  # a dense volume, and as many points in it as a mapping iteration has samples
DECODER = (11, 32, 1)
DESCRIPTORS, DESCRIPTOR_BYTES = 1000, 32
Contenders = dict[str, Callable]


def dense_volume(generator: torch.Generator, device: torch.device) -> tuple[list, Contenders]:
    """A dense volume, for which grid_sample can be used; the time of the op includes its hash lookups."""
    cells = ops.VoxelHash(SIDE**3, device)
    cells.insert(torch.cartesian_prod(*[torch.arange(SIDE, dtype=torch.int32)] * 3).to(device))
    x, y, z = cells.voxel_coords.long().unbind(1)
    embeddings = torch.randn(SIDE**3, CHANNELS, generator=generator).to(device)
    points = (torch.rand(POINTS, 3, generator=generator) * (SIDE - 1)).to(device)
    order = torch.empty_like(x)
    order[(x * SIDE + y) * SIDE + z] = torch.arange(len(x), device=device)

    def hashed(embeddings, points):
        return ops.trilinear_interpolate(embeddings, *cells.lookup(points, 1.0))

    def grid_sample(embeddings, points):
        grid = embeddings.index_select(0, order).view(SIDE, SIDE, SIDE, CHANNELS).permute(3, 0, 1, 2)[None]
        return _grid_sample(grid, points.flip(1), SIDE - 1)

    def sampled(grid, points):
        return _grid_sample(grid, points.flip(1), SIDE - 1)

    grid = embeddings[order].view(SIDE, SIDE, SIDE, CHANNELS).permute(3, 0, 1, 2)[None].contiguous()
    torch.testing.assert_close(hashed(embeddings, points), grid_sample(embeddings, points), rtol=1e-4, atol=1e-4)
    return [(embeddings, points), (grid, points)], {"spslam": hashed, "grid_sample": sampled}


def _grid_sample(grid: torch.Tensor, points: torch.Tensor, last: int) -> torch.Tensor:
    scaled = (points * (2 / last) - 1)[None, None, None]
    sampled = torch.nn.functional.grid_sample(grid, scaled, align_corners=True, padding_mode="border")
    return sampled[0, :, 0, 0].T


def gather_bilinear(texels: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
    """`bilinear_interpolate` by indexing and gathering."""
    height, width, channels = texels.shape
    u, v = uv[:, 0].clamp(0, width - 1), uv[:, 1].clamp(0, height - 1)
    iu, iv = u.detach().floor().clamp(max=width - 2), v.detach().floor().clamp(max=height - 2)
    row = (iv * width + iu).long()
    rows = torch.stack([row, row + 1, row + width, row + width + 1], 1).flatten()
    fu, fv = u - iu, v - iv
    weights = torch.stack([(1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv], 1)
    gathered = texels.view(-1, channels).index_select(0, rows).view(-1, 4, channels)
    return torch.bmm(weights[:, None], gathered)[:, 0]


def sampled_planes(texels: torch.Tensor, points: torch.Tensor, cell_size: float, layout: Sequence[int]) -> torch.Tensor:
    """`tri_plane_interpolate` by a call of grid_sample for each plane, and one of addmm for where to sample them."""
    planes = [layout[5 * plane : 5 * plane + 5] for plane in range(3)]
    scale, shift = torch.zeros(3, 6), torch.zeros(6)
    for plane, (_, origin_u, origin_v, size_u, size_v) in enumerate(planes):
        u, v = ((0, 1), (0, 2), (1, 2))[plane]
        # In [-1, 1] from the first texel to the last, the last axis of the image first.
        for column, axis, origin, size in ((2 * plane, v, origin_v, size_v), (2 * plane + 1, u, origin_u, size_u)):
            scale[axis, column] = 2 / (size - 1) / cell_size
            shift[column] = -2 / (size - 1) * origin - 1
    grids = torch.addmm(shift.to(points), points, scale.to(points))
    total = None
    for plane, (offset, _, _, size_u, size_v) in enumerate(planes):
        image = texels[offset : offset + size_u * size_v].view(size_u, size_v, -1).permute(2, 0, 1)[None]
        grid = grids[:, 2 * plane : 2 * plane + 2][None, None]
        sampled = torch.nn.functional.grid_sample(image, grid, align_corners=True, padding_mode="border")
        total = sampled if total is None else total.add_(sampled)
    return total[0, :, 0].T


def decoder(generator: torch.Generator, device: torch.device) -> tuple[list, Contenders]:
    """The geometry decoder on a mapping iteration's samples."""
    inputs, hidden, outputs = DECODER
    x = torch.randn(POINTS, inputs, generator=generator).to(device)
    params = (torch.randn(ops.mlp_num_params(*DECODER), generator=generator) / 6).to(device)
    return [x, params], {
        "spslam": lambda x, params: ops.mlp(x, params, hidden, outputs, ops.Activation.TANH),
        "torch.nn.functional.linear": lambda x, params: TORCH.mlp(x, params, outputs, ops.Activation.TANH),
    }


Suite = tuple[str, dict[str, tuple[Callable, list]], Sequence[int]]  # name, contenders with arguments, differentiable


def suites(generator: torch.Generator, device: torch.device) -> list[Suite]:
    """All differentiable ops with their alternatives."""
    (own, other), dense = dense_volume(generator, device)
    found: list[Suite] = [
        (
            f"trilinear, dense {SIDE}^3, lookup included",
            {"spslam": (dense["spslam"], list(own)), "grid_sample": (dense["grid_sample"], list(other))},
            (0, 1),
        )
    ]
    for name, ours, theirs, inputs, differentiable in composable_ops.cases(generator, device):
        contenders = {"spslam": (ours, inputs), "torch": (theirs, inputs)}
        if name == "bilinear_interpolate":
            torch.testing.assert_close(ours(*inputs), gather_bilinear(*inputs), rtol=1e-4, atol=1e-4)
            contenders = {
                "spslam": (ours, inputs),
                "grid_sample": (theirs, inputs),
                "gather": (gather_bilinear, inputs),
            }
        if name == "tri_plane_interpolate":
            torch.testing.assert_close(ours(*inputs), sampled_planes(*inputs), rtol=1e-4, atol=1e-4)
            contenders = {
                "spslam": (ours, inputs),
                "three grid_sample": (sampled_planes, inputs),
                "gather": (theirs, inputs),
            }
        found.append((name, contenders, differentiable))
    inputs, contenders = decoder(generator, device)
    found.append(("mlp 11-32-32-1", {name: (function, inputs) for name, function in contenders.items()}, (0, 1)))
    return found


Clocks = dict[str, Callable[[dict[str, Callable]], dict[str, float]]]


def rows_of(name: str, direction: str, contenders: dict[str, Callable], clocks: Clocks) -> list[dict[str, object]]:
    """A row per clock and spslam contender."""
    measured = {clock: compare(contenders) for clock, compare in clocks.items()}
    return [
        row(name + own.removeprefix("spslam"), f"{direction}{clock}", times, own)
        for clock, times in measured.items()
        for own in times
        if own.startswith("spslam")
    ]


def row(name: str, direction: str, times: dict[str, float], own: str) -> dict[str, object]:
    """The time of spslam, and the fastest alternative with its time and their ratio."""
    others = {key: value for key, value in times.items() if not key.startswith("spslam")}
    best = min(others, key=others.__getitem__)
    return {
        "op": name,
        "pass": direction,
        "spslam ms": times[own],
        "best alternative": best,
        "its ms": others[best],
        "ratio": others[best] / times[own],
    }


def clocks_of(device: torch.device, rounds: int, clock: Callable[[], float]) -> Clocks:
    """The clocks to measure with: wall clock or CPU time, and on CUDA also GPU time."""
    clocks: Clocks = {"": functools.partial(timing.compare, rounds=rounds, device=device, clock=clock)}
    if device.type == "cuda":
        clocks[", GPU clock"] = functools.partial(timing.compare_on_gpu, rounds=rounds, device=device)
    return clocks


def measured(generator: torch.Generator, device: torch.device, clocks: Clocks, op: str) -> list[dict[str, object]]:
    """The rows of all ops whose name contains `op`."""
    rows: list[dict[str, object]] = []
    for name, contenders, differentiable in suites(generator, device):
        if op not in name:
            continue
        forward = {key: composable_ops.forward(*pair) for key, pair in contenders.items()}
        rows += rows_of(name, "forward", forward, clocks)
        if differentiable:
            both = {key: composable_ops.forward_and_backward(*pair, differentiable) for key, pair in contenders.items()}
            rows += rows_of(name, "forward + backward", both, clocks)
    for name, functions in without_gradient(generator, device).items():
        if op in name:
            rows += rows_of(name, "forward", functions, clocks)
    return rows


def without_gradient(generator: torch.Generator, device: torch.device) -> dict[str, dict[str, Callable]]:
    """The ops that are not differentiable, with their alternatives."""
    return {
        f"sparse_adam_, {map_ops.TOUCHED} of {map_ops.ROWS} rows": map_ops.adam(generator, device),
        "normal equations and solution": map_ops.gauss_newton_step(generator, device),
        **map_ops.hash_contenders(generator, device),
        "marching_cubes, sphere in 256^3": map_ops.marching_cubes(device),
        f"nearest_descriptors, {DESCRIPTORS} x {DESCRIPTORS}": descriptors(generator, device),
    }


def descriptors(generator: torch.Generator, device: torch.device) -> dict[str, Callable]:
    """ORB descriptors of two images; OpenCV has those of a GPU on the host as well."""
    one, other = (
        torch.randint(0, 256, (DESCRIPTORS, DESCRIPTOR_BYTES), generator=generator).to(torch.uint8) for _ in range(2)
    )
    arrays, tensors = (one.numpy(), other.numpy()), (one.to(device), other.to(device))
    return {
        "spslam": lambda: ops.nearest_descriptors(*tensors),
        "cv2.batchDistance": lambda: cv2.batchDistance(*arrays, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2),
    }


def main() -> None:
    parser = timing.arguments("ops against their best alternatives")
    parser.add_argument(
        "--cpu-time", action="store_true", help="time of one CPU thread, whatever else the machine does"
    )
    parser.add_argument("--op", default="", help="only ops whose name contains this")
    args = parser.parse_args()
    device = torch.device(args.device)
    timing.use_threads(1 if args.cpu_time else args.threads)
    clocks = clocks_of(device, args.rounds, time.process_time if args.cpu_time else time.perf_counter)
    rows = measured(torch.Generator().manual_seed(0), device, clocks, args.op)
    if not rows:
        parser.error(f"argument --op: no op's name contains {args.op}")
    timing.report(f"{room.FRAMES} frames, {composable_ops.RAYS} rays", rows, device, args.json)


if __name__ == "__main__":
    main()
