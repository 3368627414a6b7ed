"""Tracking and mapping calls on a GPU, one CUDA graph each: GPU time per iteration, host time per call.

    python -m experiments.gpu_step --json gpu_step.json

GPU times are measured by CUDA events around a call that is queued behind a sleeping kernel, which hides launches; host
times are those of the Python call alone.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from experiments import room, timing
from experiments.step import OPTIONS
from spslam import ops

TRACKING_RAYS, TRACKING_ITERATIONS = 1024, 6
MAPPING_RAYS, MAPPING_ITERATIONS = 2048, 20
RECORDS = 2000  # of each frame
SLEEP_CYCLES = 2_000_000  # about a millisecond
RATE = 1e-4  # small, so that the scene is the same in all rounds


class TrackingCall:
    """Adam on one frame's pose."""

    iterations = TRACKING_ITERATIONS

    def __init__(self, scene: ops.SceneView, generator: torch.Generator, options: ops.RenderOptions):
        rays = room.make_rays(generator, RECORDS, 1, scene.embeddings.device)
        self.scene, self.records, self.pose, self.options = scene, rays.pixels, rays.poses[0].contiguous(), options
        self.graph = ops.LaunchGraph()

    def __call__(self) -> torch.Tensor:
        return ops.track_adam(
            self.scene,
            self.records,
            self.pose,
            room.INTRINSICS,
            self.options,
            num_pixels=TRACKING_RAYS,
            iterations=self.iterations,
            rotation_rate=1e-3,
            translation_rate=2e-3,
            graph=self.graph,
        )[1]


class MappingCall:
    """Joint optimization over all frames."""

    iterations = MAPPING_ITERATIONS

    def __init__(self, scene: ops.SceneView, generator: torch.Generator, options: ops.RenderOptions):
        device = scene.embeddings.device
        rays = room.make_rays(generator, room.FRAMES * RECORDS, room.FRAMES, device)
        self.scene, self.options = scene, options
        self.records, self.poses = rays.pixels.view(room.FRAMES, RECORDS, 3), rays.poses.contiguous()
        self.frames = torch.arange(room.FRAMES)
        self.moments = ops.MapMoments(
            embeddings=_table(scene.embeddings),
            texels=_table(scene.texels),
            geometry_params=_tensor(scene.geometry_params),
            color_params=_tensor(scene.color_params),
            poses=_tensor(self.poses),
        )
        self.graph = ops.LaunchGraph()
        self.steps = 0

    def __call__(self) -> torch.Tensor:
        first = self.steps + 1
        self.steps += self.iterations
        return ops.optimize_map_(
            self.scene,
            self.records,
            self.poses,
            self.frames,
            room.INTRINSICS,
            self.options,
            self.moments,
            num_pixels=MAPPING_RAYS,
            iterations=self.iterations,
            fixed_frame=0,
            first_step=first,
            first_stamp=first,
            graph=self.graph,
        )


def _tensor(param: torch.Tensor) -> ops.AdamMoments:
    return ops.AdamMoments(torch.zeros_like(param), torch.zeros_like(param), RATE)


def _table(param: torch.Tensor) -> ops.AdamTable:
    stamps = torch.zeros(len(param), dtype=torch.int32, device=param.device)
    zeros = torch.zeros_like(param), torch.zeros_like(param)
    return ops.AdamTable(*zeros, RATE, ops.new_gradient_sums(param), stamps)


def measure(call: Callable[[], object], rounds: int) -> tuple[list[float], list[float]]:
    """Device and host microseconds of each round."""
    device_us, host_us = [], []
    for turn in range(rounds + 3):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        torch.cuda.synchronize()
        torch.cuda._sleep(SLEEP_CYCLES)
        begin.record()
        start = time.perf_counter()
        call()
        host = time.perf_counter() - start
        end.record()
        torch.cuda.synchronize()
        if turn >= 3:
            device_us.append(1e3 * begin.elapsed_time(end))
            host_us.append(1e6 * host)
    return device_us, host_us


def main() -> None:
    args = timing.arguments("whole tracking and mapping calls on a GPU").parse_args()
    device = torch.device("cuda", torch.cuda.current_device())
    rows: list[dict[str, object]] = []
    for precision in ("tf32", "fp32"):
        for color in (True, False):
            options = replace(OPTIONS, precision=precision, weight_rgb=OPTIONS.weight_rgb * color)
            for name, kind in (("tracking", TrackingCall), ("mapping", MappingCall)):
                generator = torch.Generator().manual_seed(0)
                scene = room.make_scene(generator, device)
                call = kind(scene, generator, options)
                device_us, host_us = measure(call, args.rounds)
                median = statistics.median(device_us)
                rows.append(
                    {
                        "call": name,
                        "rays": TRACKING_RAYS if kind is TrackingCall else MAPPING_RAYS,
                        "precision": precision,
                        "color": color,
                        "iterations": call.iterations,
                        "call us": median,
                        "p10": statistics.quantiles(device_us, n=10)[0],
                        "p90": statistics.quantiles(device_us, n=10)[-1],
                        "iteration us": median / call.iterations,
                        "host us": statistics.median(host_us),
                        "graphs": call.graph.builds,
                    }
                )
    samples = OPTIONS.num_uniform + OPTIONS.num_surface
    title = f"{len(scene.embeddings)} vertices, {len(scene.texels)} texels, {samples} samples per ray, all gradients"
    timing.report(title, rows, device, args.json)


if __name__ == "__main__":
    main()
