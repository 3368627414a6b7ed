"""GPU time of the fused ops of the frame loop: medians over replays of a CUDA graph, timed by CUDA events.

python -m benchmarks.gpu_ops --json gpu_ops.json
"""

import argparse
import statistics
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks import room, timing
from spslam import ops

PIXELS_PER_FRAME = 15000
TRACKING = dict(
    truncation=room.TRUNCATION_M, kernel_start=0.08, kernel_end=0.02, damping=1e-4, seed=0, stream=1, frame=0
)


def median_us(call: Callable[[], object], rounds: int) -> float:
    """Microseconds of device time of one call, without the host's share."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        call()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    times = []
    for _ in range(rounds + 2):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        graph.replay()
        end.record()
        end.synchronize()
        times.append(1e3 * start.elapsed_time(end))
    return statistics.median(times[2:])


def tracking_rows(scene: ops.SceneView, rays: ops.RayBatch, rounds: int) -> list[dict[str, object]]:
    """A tracking call of 8 iterations, and what one more costs: the difference of 16 and 8."""
    rows: list[dict[str, object]] = []
    for pixels in (1024, 4096):
        for tf32 in (True, False):
            times = {
                iterations: median_us(
                    lambda iterations=iterations, pixels=pixels, tf32=tf32: ops.track_gauss_newton(
                        scene,
                        rays.pixels,
                        rays.poses[0],
                        rays.intrinsics,
                        num_pixels=pixels,
                        iterations=iterations,
                        tf32=tf32,
                        **TRACKING,
                    ),
                    rounds,
                )
                for iterations in (8, 16)
            }
            name = f"track_gauss_newton, 8 x {pixels} pixels, {'tf32' if tf32 else 'float32'}"
            rows.append({"op": name, "call us": times[8], "iteration us": (times[16] - times[8]) / 8})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=100, help="replays of each")
    parser.add_argument("--json", type=Path, help="file to write the results to")
    args = parser.parse_args()
    device, generator = torch.device("cuda"), torch.Generator().manual_seed(0)
    scene = room.make_scene(generator, device)
    rays = room.make_rays(generator, PIXELS_PER_FRAME, 1, device)
    rows = tracking_rows(scene, rays, args.rounds)
    timing.report(f"room of {len(scene.embeddings)} vertices", rows, device, args.json)


if __name__ == "__main__":
    main()
