"""Speed of one tracking and one mapping iteration: the fused `render_step` against a composition of ops with autograd.

python -m experiments.step --device cpu --threads 2
"""

from collections.abc import Callable
from dataclasses import replace

import torch

from experiments import room, timing
from experiments.compose import OPS, TORCH, compose_render_step
from spslam import ops

OPTIONS = ops.RenderOptions(
    num_uniform=32,
    num_surface=11,
    near=0.2,
    far=1.02,
    truncation=room.TRUNCATION_M,
    cosine_targets=True,
    weight_rgb=10.0,
    weight_depth=0.1,
    weight_free_space=20.0,
    weight_sdf=1000.0,
    seed=0,
    stream=ops.RandomStream.MAPPING_RAYS,
    frame=0,
    iteration=0,
)
# name, rays, frames, whether the scene is optimized
WORKLOADS = (("tracking", 1024, 1, False), ("mapping", 2048, room.FRAMES, True))


def zero_gradients(scene: ops.SceneView) -> ops.SceneGradients:
    """Buffers for a scene's gradients; all contenders add to them, so their content does not affect the time."""
    new = scene.embeddings.new_zeros
    rows, texels = len(scene.embeddings), len(scene.texels)
    return ops.SceneGradients(
        new(rows, 8), new(rows, dtype=torch.int32), new(texels, 32), new(texels, dtype=torch.int32), 1
    )


def contenders(
    scene: ops.SceneView, rays: ops.RayBatch, options: ops.RenderOptions, mapping: bool
) -> dict[str, Callable[[], ops.RenderStep]]:
    """The fused step and its compositions, with the same arguments."""
    gradients = zero_gradients(scene) if mapping else None
    compositions = {
        "composed of torch, all samples": (TORCH, False),
        "composed of torch, samples inside": (TORCH, True),
        "composed of spslam.ops, all samples": (OPS, False),
        "composed of spslam.ops, samples inside": (OPS, True),
    }
    out: dict[str, Callable[[], ops.RenderStep]] = {"fused": lambda: ops.render_step(scene, rays, options, gradients)}
    for name, (parts, compact) in compositions.items():
        out[name] = lambda parts=parts, compact=compact: compose_render_step(
            scene, rays, options, gradients, parts, compact
        )
    return out


def main() -> None:
    parser = timing.arguments("fused against composed tracking and mapping iterations")
    args = parser.parse_args()
    device = torch.device(args.device)
    timing.use_threads(args.threads)
    generator = torch.Generator().manual_seed(0)
    scene = room.make_scene(generator, device)
    rows: list[dict[str, object]] = []
    for name, count, frames, mapping in WORKLOADS:
        rays = room.make_rays(generator, count, frames, device)
        for color in (True, False):
            options = replace(OPTIONS, weight_rgb=OPTIONS.weight_rgb * color)
            times = timing.compare(contenders(scene, rays, options, mapping), args.rounds, device)
            for contender, milliseconds in times.items():
                rows.append(
                    {
                        "iteration": name,
                        "rays": count,
                        "color": color,
                        "step": contender,
                        "ms": milliseconds,
                        "times the fused": milliseconds / times["fused"],
                    }
                )
    samples = OPTIONS.num_uniform + OPTIONS.num_surface
    title = f"{len(scene.embeddings)} vertices, {len(scene.texels)} texels, {samples} samples per ray"
    timing.report(title, rows, device, args.json)


if __name__ == "__main__":
    main()
