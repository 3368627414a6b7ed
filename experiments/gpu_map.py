"""GPU time of the map's ops: encoding and fusing a frame, inserting voxels, marching cubes.

python -m experiments.gpu_map --json gpu_map.json

The time of a call is measured by CUDA events and includes launches and the read-back; the time of its kernels is
measured by the profiler. Frames are encoded into a map that already has earlier frames, as in a run.
"""

import statistics
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile

from experiments import room, timing
from experiments.arguments import make_parser
from spslam import ops
from spslam.meshing import extract_surface
from spslam.prior import load_prior
from spslam.scene import SparseVolume

PIXELS_PER_FRAME, POINTS_PER_FRAME = 15000, 8000
FRAMES = 40
INSERTED, SPREAD = 200_000, 60
FUSION = ops.FrameFusion(room.VOXEL_M, 64, 1e-4, POINTS_PER_FRAME, min_weight=0.006, kappa=2.5, max_weight=20.0)
RESOLUTIONS_M = (0.02, 0.01)


def row(op: str, call_us: float, kernels_us: float | None = None, peak_mb: float | None = None) -> dict[str, object]:
    """A line of the table; None where not measured."""
    return {"op": op, "call us": call_us, "kernels us": kernels_us, "peak MB": peak_mb}


def event_ms(call: Callable[[], object]) -> float:
    """GPU time in milliseconds from the start of a call to its end."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    call()
    end.record()
    end.synchronize()
    return start.elapsed_time(end)


def kernel_us(call: Callable[[], object]) -> float:
    """GPU time of a call's kernels and copies in microseconds, without the gaps between them."""
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA]) as record:
        call()
        torch.cuda.synchronize()
    return sum(event.device_time_total for event in record.key_averages())


def frame_points(generator: torch.Generator, device: torch.device) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Surface points of each frame, with some millimeters of noise, and their normals."""
    rays = room.make_rays(generator, PIXELS_PER_FRAME * FRAMES, FRAMES, torch.device("cpu"))
    inward = torch.cat([torch.eye(3), -torch.eye(3)])
    frames = []
    for pose, pixels in zip(rays.poses, rays.pixels.split(PIXELS_PER_FRAME), strict=True):
        points, _ = ops.unproject_pixels(pixels, torch.zeros(len(pixels), 3), pose, *rays.intrinsics)
        gaps = torch.cat([points - torch.tensor(room.LOW), torch.tensor(room.HIGH) - points], 1).abs()
        normals = inward[gaps.argmin(1)].contiguous()
        frames.append((points.to(device), normals.to(device)))
    return frames


def encode_rows(generator: torch.Generator, device: torch.device) -> list[dict[str, object]]:
    """A map's first frame and the median of those after it, in tf32 and in float32."""
    params = load_prior().to(device).encoder_params
    frames = frame_points(generator, device)
    rows: list[dict[str, object]] = []
    for tf32 in (True, False):
        volume = SparseVolume(room.VOXEL_M, device=device)
        for points, normals in frames[:2]:
            SparseVolume(room.VOXEL_M, device=device).encode(points, normals, params, FUSION, tf32=tf32)
        calls, kernels = [], []
        for i, (points, normals) in enumerate(frames):

            def encode(points=points, normals=normals, tf32=tf32, volume=volume):
                volume.encode(points, normals, params, FUSION, tf32=tf32)

            if i % 2:
                kernels.append(kernel_us(encode))
            else:
                calls.append(1e3 * event_ms(encode))
        precision = "tf32" if tf32 else "float32"
        name = f"encode_frame_, {POINTS_PER_FRAME} of {PIXELS_PER_FRAME} points, {precision}"
        rows.append(row(f"{name}, a map's first", calls[0]))
        rows.append(row(name, statistics.median(calls[1:]), statistics.median(kernels)))
    return rows


def insert_row(generator: torch.Generator, device: torch.device, rounds: int) -> dict[str, object]:
    """Coordinates with repetitions into an empty table."""
    coords = torch.randint(-SPREAD, SPREAD, (INSERTED, 3), generator=generator, dtype=torch.int32).to(device)
    times = []
    for _ in range(rounds + 2):
        keys, values = ops.new_voxel_hash(1 << 19, device)
        times.append(1e3 * event_ms(partial(ops.voxel_hash_insert, keys, values, coords, 0)))
    return row(f"voxel_hash_insert, {INSERTED} coordinates", statistics.median(times[2:]))


def mesh_rows(scene: ops.SceneView, device: torch.device, rounds: int) -> list[dict[str, object]]:
    """The room's zero level from its voxels."""
    volume_coords = _cells(scene)

    def sdf(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        values, known = ops.query_sdf(scene, points)
        return values * room.TRUNCATION_M, known

    rows: list[dict[str, object]] = []
    for resolution_m in RESOLUTIONS_M:

        def extract(resolution_m=resolution_m):
            return extract_surface(volume_coords, room.VOXEL_M, resolution_m, sdf)

        vertices, faces = extract()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        times = [1e3 * event_ms(extract) for _ in range(max(rounds // 10, 3))]
        name = f"extract_surface, {len(volume_coords)} cells, {len(faces)} faces of {100 * resolution_m:.0f} cm"
        peak_mb = (torch.cuda.max_memory_allocated() - before) / 2**20
        rows.append(row(name, statistics.median(times), peak_mb=peak_mb))
        del vertices, faces
    return rows


def _cells(scene: ops.SceneView) -> torch.Tensor:
    """Coordinates of the scene's complete cells, from its table."""
    used = scene.hash_keys >= 0
    keys, ids = scene.hash_keys[used], scene.hash_values[used].long()
    mask, low = (1 << 21) - 1, 1 << 20
    coords = torch.stack([keys >> 42, keys >> 21 & mask, keys & mask], 1) - low
    return coords[scene.corner_ids[ids, 0] >= 0].int()


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=50, help="calls of each")
    parser.add_argument("--json", type=Path, help="file to write the results to")
    args = parser.parse_args()
    device, generator = torch.device("cuda"), torch.Generator().manual_seed(0)
    rows = encode_rows(generator, device)
    rows.append(insert_row(generator, device, args.rounds))
    rows += mesh_rows(room.make_scene(generator, device), device, args.rounds)
    timing.report("what grows a map and takes its mesh", rows, device, args.json)


if __name__ == "__main__":
    main()
