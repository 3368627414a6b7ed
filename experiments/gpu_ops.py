"""GPU time of the fused ops of the frame loop: medians over replays of a CUDA graph, timed by CUDA events.

python -m experiments.gpu_ops --json gpu_ops.json
"""

import statistics
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from experiments import room, timing
from experiments.arguments import make_parser
from spslam import ops
from spslam.camera import Camera
from spslam.slam.pixels import FramePixels, unpack_points
from spslam.slam.recovery.icp_alignment import POINTS, surface_maps

PIXELS_PER_FRAME = 15000
TRACKING = ops.GaussNewtonOptions(
    num_pixels=1024,
    iterations=8,
    truncation=room.TRUNCATION_M,
    kernel_start=0.08,
    kernel_end=0.02,
    damping=1e-4,
    seed=0,
    stream=ops.RandomStream.TRACKING_PIXELS,
    frame=0,
)


def median_us(call: Callable[[], object], rounds: int) -> float:
    """GPU time of one call in microseconds, without launches."""
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
    """A tracking call of 8 iterations, and the time per further iteration: from the difference of 16 and 8."""
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
                        replace(TRACKING, num_pixels=pixels, iterations=iterations, tf32=tf32),
                    ),
                    rounds,
                )
                for iterations in (8, 16)
            }
            name = f"track_gauss_newton, 8 x {pixels} pixels, {'tf32' if tf32 else 'float32'}"
            rows.append({"op": name, "call us": times[8], "iteration us": (times[16] - times[8]) / 8})
    return rows


def icp_rows(rays: ops.RayBatch, rounds: int) -> list[dict[str, object]]:
    """ICP of 15 iterations over 4096 points against maps of 80 x 60, and what one more iteration costs."""
    camera = Camera(room.WIDTH, room.HEIGHT, *rays.intrinsics)
    normals = torch.tensor([0.0, 0.0, -1.0], device=rays.pixels.device).expand(len(rays.pixels), 3)
    buffer = torch.cat([rays.pixels.flatten(), normals.contiguous().view(torch.int32).flatten()])
    pixels = FramePixels(buffer, len(rays.pixels), (0, 0), (0, 0), 1.0)
    vertices, map_normals, intrinsics = surface_maps(pixels, camera)
    points = unpack_points(rays.pixels[:POINTS], camera)
    start = torch.tensor([1.0, 0, 0, 0, 0, 0, 0.05], device=points.device)
    times = {
        iterations: median_us(
            lambda iterations=iterations: ops.projective_icp(
                points, vertices, map_normals, start, intrinsics, iterations=iterations
            ),
            rounds,
        )
        for iterations in (15, 30)
    }
    name = f"projective_icp, 15 x {len(points)} points"
    return [{"op": name, "call us": times[15], "iteration us": (times[30] - times[15]) / 15}]


def selection_rows(rays: ops.RayBatch, rounds: int) -> list[dict[str, object]]:
    """The choice of 180 frames among as many as a run has after 10 seconds, and after 5 minutes."""
    rows: list[dict[str, object]] = []
    device = rays.pixels.device
    for frames in (300, 9000):
        poses = rays.poses.repeat(-(-frames // len(rays.poses)), 1)[:frames]
        depth_thumbnails = torch.full((frames, 30, 40), 2.0, dtype=torch.float16, device=device)
        candidates = torch.randperm(frames - 20, generator=torch.Generator().manual_seed(0)).to(device)
        time = median_us(
            lambda poses=poses, depth_thumbnails=depth_thumbnails, candidates=candidates: ops.select_covisible_frames(
                rays.pixels,
                len(poses) - 1,
                poses,
                depth_thumbnails,
                candidates,
                rays.intrinsics,
                thumbnail_step=16,
                num_points=256,
                num_covisible=90,
                count=180,
                threshold=0.1,
                seed=0,
                frame=0,
            ),
            rounds,
        )
        rows.append({"op": f"select_covisible_frames, 180 of {frames}", "call us": time, "iteration us": ""})
    return rows


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=100, help="replays of each")
    parser.add_argument("--json", type=Path, help="file to write the results to")
    args = parser.parse_args()
    device, generator = torch.device("cuda"), torch.Generator().manual_seed(0)
    scene = room.make_scene(generator, device)
    rays = room.make_rays(generator, PIXELS_PER_FRAME, 1, device)
    rows = [
        *tracking_rows(scene, rays, args.rounds),
        *icp_rows(rays, args.rounds),
        *selection_rows(rays, args.rounds),
    ]
    timing.report(f"room of {len(scene.embeddings)} vertices", rows, device, args.json)


if __name__ == "__main__":
    main()
