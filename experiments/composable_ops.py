"""Speed of the composable ops compared with plain torch, forward and backward, at the sizes of a mapping iteration.

python -m experiments.composable_ops --device cpu --threads 2
"""

from collections.abc import Callable, Sequence

import torch

from experiments import room, timing
from experiments.compose import TORCH, unpack_pixels, world_points
from spslam import ops

RAYS, UNIFORM, SURFACE = 2048, 32, 11
# Name, spslam's function, torch's, their arguments, which of these are differentiable.
Case = tuple[str, Callable, Callable, list, Sequence[int]]


def grid_sample(texels: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
    """`bilinear_interpolate` as `torch.nn.functional.grid_sample`."""
    height, width = texels.shape[:2]
    scaled = uv * uv.new_tensor([2 / (width - 1), 2 / (height - 1)]) - 1
    image = texels.permute(2, 0, 1)[None]
    sampled = torch.nn.functional.grid_sample(image, scaled[None, None], align_corners=True, padding_mode="border")
    return sampled[0, :, 0].T


def sample_and_sort(depth: torch.Tensor) -> torch.Tensor:
    """`sample_along_rays` with torch's random generator."""
    u = torch.rand(len(depth), UNIFORM + SURFACE, device=depth.device)
    i, j = torch.arange(UNIFORM, device=depth.device), torch.arange(SURFACE, device=depth.device)
    uniform = depth[:, None] * (0.2 + 0.82 * (i + u[:, :UNIFORM]) / UNIFORM)
    surface = depth[:, None] + room.TRUNCATION_M * (2 * (j + u[:, UNIFORM:]) / SURFACE - 1)
    return torch.cat([uniform, surface], 1).sort(1).values


def cases(generator: torch.Generator, device: torch.device) -> list[Case]:
    """Every op with its inputs in a mapping iteration of the room."""
    scene = room.make_scene(generator, device)
    rays = room.make_rays(generator, RAYS, room.FRAMES, device)
    seen = unpack_pixels(rays.pixels, rays.intrinsics, torch.float32)
    key = (0, ops.RandomStream.MAPPING_RAYS, 0, 0)

    def sample(depth):
        return ops.sample_along_rays(depth, UNIFORM, SURFACE, 0.2, 1.02, room.TRUNCATION_M, *key)

    t = sample(seen.depth)
    points = world_points(rays, seen.directions, t, None).view(-1, 3)
    ids, local = ops.voxel_hash_lookup(scene.hash_keys, scene.hash_values, scene.corner_ids, points, scene.voxel_size)
    valid = (ids[:, 0] >= 0).view(t.shape)
    sdf = torch.where(valid, room.wall_distance(points).view(t.shape) / room.TRUNCATION_M, 1).clamp(-1, 1)
    color = torch.rand(*t.shape, 3, generator=generator).to(device)
    image = torch.randn(300, 300, 32, generator=generator).to(device)
    uv = (torch.rand(len(points), 2, generator=generator) * 299).to(device)
    rendered = torch.rand(RAYS, 3, generator=generator).to(device)
    loss_inputs = [rendered, seen.depth + 0.01, sdf, t, valid, valid.any(1), seen.color, seen.depth, seen.cosine]
    planes = [scene.texels, points, scene.plane_cell_size, scene.plane_layout]
    return [
        ("sample_along_rays", sample, sample_and_sort, [seen.depth], ()),
        (
            "trilinear_interpolate",
            ops.trilinear_interpolate,
            TORCH.trilinear_interpolate,
            [scene.embeddings, ids, local],
            (0, 2),
        ),
        ("bilinear_interpolate", ops.bilinear_interpolate, grid_sample, [image, uv], (0, 1)),
        ("tri_plane_interpolate", ops.tri_plane_interpolate, TORCH.tri_plane_interpolate, planes, (0, 1)),
        ("volume_render", ops.volume_render, TORCH.volume_render, [sdf, color, t, valid, room.TRUNCATION_M], (0, 1)),
        (
            "rendering_losses",
            ops.rendering_losses,
            TORCH.rendering_losses,
            [*loss_inputs, room.TRUNCATION_M, True],
            (0, 1, 2),
        ),
    ]


def forward(function: Callable, inputs: list) -> Callable[[], object]:
    """The function alone, without autograd."""

    def run():
        with torch.no_grad():
            return function(*inputs)

    return run


def forward_and_backward(function: Callable, inputs: list, differentiable: Sequence[int]) -> Callable[[], object]:
    """The function and the gradient of the sum of its results."""
    leaves = [x.detach().requires_grad_() if i in differentiable else x for i, x in enumerate(inputs)]

    def run():
        out = function(*leaves)
        total = sum(o.sum() for o in (out[:2] if isinstance(out, tuple) else (out,)))
        return torch.autograd.grad(total, [leaves[i] for i in differentiable])

    return run


def main() -> None:
    args = timing.arguments("composable ops against plain torch").parse_args()
    device = torch.device(args.device)
    timing.use_threads(args.threads)
    rows: list[dict[str, object]] = []
    for name, ours, theirs, inputs, differentiable in cases(torch.Generator().manual_seed(0), device):
        passes = {"forward": (forward(ours, inputs), forward(theirs, inputs))}
        if differentiable:
            passes["forward + backward"] = tuple(
                forward_and_backward(f, inputs, differentiable) for f in (ours, theirs)
            )
        for direction, (own, other) in passes.items():
            times = timing.compare({"spslam": own, "torch": other}, args.rounds, device)
            ratio = times["torch"] / times["spslam"]
            rows.append({"op": name, "pass": direction, **{f"{k} ms": v for k, v in times.items()}, "ratio": ratio})
    timing.report(f"{RAYS} rays of {UNIFORM + SURFACE} samples", rows, device, args.json)


if __name__ == "__main__":
    main()
