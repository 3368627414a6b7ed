"""Speed of the ops on the map: sparse optimizer, normal equations, voxel hash, marching cubes, mesh of a room.

python -m experiments.map_ops --device cpu --threads 2
"""

from collections.abc import Callable

import numpy as np
import torch
from skimage import measure

from experiments import room, timing
from spslam import ops
from spslam.meshing import extract_surface

ROWS, CHANNELS, TOUCHED = 300_000, 8, 20_000
RESIDUALS = 1024
POINTS, DISTINCT = 500_000, 60_000
SPHERE_SAMPLES, CUBES_PER_CELL = 257, 4
RESOLUTION_M = 0.01
Contenders = dict[str, Callable[[], object]]


def adam_on_rows(param, grad, exp_avg, exp_avg_sq, stamps, lr, step) -> None:
    """`sparse_adam_` in plain torch: gather the touched rows, update them, scatter them."""
    rows = (stamps == 1).nonzero()[:, 0]
    g, m, v = (x.index_select(0, rows) for x in (grad, exp_avg, exp_avg_sq))
    m.lerp_(g, 0.1)
    v.mul_(0.999).addcmul_(g, g, value=0.001)
    denominator = (v / (1 - 0.999**step)).sqrt_().add_(1e-8)
    param.index_add_(0, rows, m / denominator, alpha=-lr / (1 - 0.9**step))
    exp_avg.index_copy_(0, rows, m)
    exp_avg_sq.index_copy_(0, rows, v)
    grad.index_fill_(0, rows, 0.0)


def adam(generator: torch.Generator, device: torch.device) -> Contenders:
    """One step on the touched rows of a table; torch.optim.Adam can only update all rows."""
    tensors = [torch.rand(ROWS, CHANNELS, generator=generator).to(device) for _ in range(4)]
    stamps = torch.zeros(ROWS, dtype=torch.int32)
    stamps[torch.randperm(ROWS, generator=generator)[:TOUCHED]] = 1
    stamps = stamps.to(device)
    dense = torch.nn.Parameter(tensors[0].clone())
    dense.grad = tensors[1].clone()
    optimizer = torch.optim.Adam([dense], lr=1e-3, fused=True)
    return {
        "spslam": lambda: ops.sparse_adam_(*tensors, stamps, 1, lr=1e-3, step=10),
        "torch": lambda: adam_on_rows(*tensors, stamps, lr=1e-3, step=10),
        "torch.optim.Adam, all rows": optimizer.step,
    }


def gauss_newton_step(generator: torch.Generator, device: torch.device) -> Contenders:
    """Normal equations of one frame and their damped solution."""
    shapes = (1, RESIDUALS), (1, RESIDUALS, 6), (1, RESIDUALS)
    residuals, jacobians, weights = (torch.rand(shape, generator=generator).to(device) for shape in shapes)

    def own():
        hessian, gradient, _ = ops.normal_equations(residuals, jacobians, weights)
        return ops.solve_normal_equations(hessian, gradient, 1e-4)

    def plain():
        weighted = jacobians * weights[..., None]
        hessian = weighted.mT @ jacobians
        gradient = weighted.mT @ residuals[..., None]
        damped = hessian + 1e-4 * torch.diag_embed(hessian.diagonal(dim1=1, dim2=2))
        return -torch.linalg.solve(damped, gradient)

    return {"spslam": own, "torch": plain}


def packed(coords: torch.Tensor) -> torch.Tensor:
    """One sortable integer per voxel."""
    x, y, z = (coords.long() + 2**20).unbind(1)
    return x << 42 | y << 21 | z


def hash_contenders(generator: torch.Generator, device: torch.device) -> dict[str, Contenders]:
    """Finding the distinct voxels, looking voxels up, and both; torch does it by sorting and bisection."""
    distinct = torch.randint(-200, 200, (DISTINCT, 3), generator=generator, dtype=torch.int32)
    coords = distinct[torch.randint(0, DISTINCT, (POINTS,), generator=generator)].to(device)
    capacity = 1 << (4 * DISTINCT).bit_length()

    def insert():
        keys, values = ops.new_voxel_hash(capacity, device)
        ops.voxel_hash_insert(keys, values, coords, 0)
        return keys, values

    keys, values = insert()
    ordered = packed(coords).unique()

    def sort_and_bisect():
        words = packed(coords)
        return torch.searchsorted(words.unique(), words)

    return {
        "voxel_hash_insert": {"spslam": insert, "torch": lambda: packed(coords).unique()},
        "voxel_hash_insert + find": {
            "spslam": lambda: ops.voxel_hash_find(*insert(), coords),
            "torch": sort_and_bisect,
            "torch, inverse": lambda: packed(coords).unique(return_inverse=True),
        },
        "voxel_hash_find": {
            "spslam": lambda: ops.voxel_hash_find(keys, values, coords),
            "torch": lambda: torch.searchsorted(ordered, packed(coords)),
        },
    }


def sphere_cells(device: torch.device) -> tuple[np.ndarray, torch.Tensor, torch.Tensor]:
    """Signed distance of a sphere on a dense grid, and the same divided into cells."""
    axis = torch.linspace(-1, 1, SPHERE_SAMPLES)
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    field = (x * x + y * y + z * z).sqrt() - 0.7
    n = CUBES_PER_CELL
    values = field.unfold(0, n + 1, n).unfold(1, n + 1, n).unfold(2, n + 1, n)
    counts = [torch.arange(size, dtype=torch.int32) for size in values.shape[:3]]
    coords = torch.cartesian_prod(*counts)
    return field.numpy(), coords.to(device), values.reshape(-1, n + 1, n + 1, n + 1).to(device)


def marching_cubes(device: torch.device) -> Contenders:
    """A sphere in 256^3 cubes; a map only has the cells near its surface."""
    field, coords, values = sphere_cells(device)
    inside = (values < 0).flatten(1)
    crossed = inside.any(1) & ~inside.all(1)
    near = coords[crossed], values[crossed]
    return {
        "spslam": lambda: ops.marching_cubes(coords, values),
        "scikit-image": lambda: measure.marching_cubes(field, 0.0),
        "spslam, crossed cells": lambda: ops.marching_cubes(*near),
    }


def room_mesh(generator: torch.Generator, device: torch.device) -> Contenders:
    """The surface of a map with 325,000 vertices, from its decoder."""
    scene = room.make_scene(generator, device)
    vertices = scene.hash_keys[scene.hash_keys >= 0]
    mask = 2**21 - 1
    coords = torch.stack([(vertices >> shift & mask) - 2**20 for shift in (42, 21, 0)], 1).int()
    ids = ops.voxel_hash_find(scene.hash_keys, scene.hash_values, coords).long()
    cells = coords[scene.corner_ids[ids, 0] >= 0]

    def sdf(points):
        values, known = ops.query_sdf(scene, points)
        return values * room.TRUNCATION_M, known

    return {"spslam": lambda: extract_surface(cells, room.VOXEL_M, RESOLUTION_M, sdf)}


def main() -> None:
    args = timing.arguments("the map's ops against torch and scikit-image").parse_args()
    device = torch.device(args.device)
    timing.use_threads(args.threads)
    generator = torch.Generator().manual_seed(0)
    suites = {
        f"sparse_adam_, {TOUCHED} of {ROWS} rows": adam(generator, device),
        f"normal_equations + solve, {RESIDUALS}": gauss_newton_step(generator, device),
        **hash_contenders(generator, device),
        "marching_cubes, sphere in 256^3": marching_cubes(device),
        "extract_surface, room at 1 cm": room_mesh(generator, device),
    }
    rows: list[dict[str, object]] = []
    for name, contenders in suites.items():
        times = timing.compare(contenders, args.rounds, device)
        for contender, milliseconds in times.items():
            rows.append(
                {"op": name, "by": contender, "ms": milliseconds, "times spslam's": milliseconds / times["spslam"]}
            )
    timing.report("ops of the map", rows, device, args.json)


if __name__ == "__main__":
    main()
