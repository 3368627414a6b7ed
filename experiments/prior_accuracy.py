"""Accuracy of the surface after encoding alone, before any mapping iteration.

    python -m experiments.prior_accuracy [--weights FILE] [--output FILE.json] [--report PAGE.md]

Three frames of a generated room that is not in the prior's training data get Gaussian noise or a Kinect's noise on
their depth, and are encoded and fused. The first zero crossing of the decoded field is then searched along rays
through pixels of the three frames; its true distance to the room's surface is the error.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from spslam.benchmark.environment import describe_environment
from spslam.benchmark.suite_report import fill_regions
from spslam.benchmark.tables import Table, to_markdown, to_text
from spslam.config import Config, load_config
from spslam.datasets.base import RgbdFrame
from spslam.datasets.depth_noise import kinect_depth
from spslam.datasets.generated import GeneratedDataset
from spslam.io import atomic_write
from spslam.prior import Prior, load_prior
from spslam.prior.validation import first_zero_crossing
from spslam.scene import Scene, SceneSettings
from spslam.slam.encode_frame import encode_frame
from spslam.slam.pixels import sample_frame, unpack_points

NOISE_MM = (0.0, 2.0, 5.0, 10.0)
KINECT = "kinect"
# Three frames within a third of a second, as mapping fuses them, from four sides of the room.
TRIPLES = ((0, 5, 10), (75, 80, 85), (150, 155, 160), (225, 230, 235))
RAYS = 4000
SEARCH_M, SEARCH_STEP_M = 0.12, 0.005
ROOM_SEED = 11


def measure(prior: Prior, noise: float | str, triples=TRIPLES, seed: int = 0, config: Config | None = None) -> dict:
    """Measures the errors of zero crossings over all triples of frames.

    Args:
        prior: the networks.
        noise: standard deviation of the depth in mm, or "kinect".
        triples: indices of the frames of the generated room that are fused.
        seed: of the noise and the rays.
        config: None for the demo's; only its section `prior` matters.

    Returns:
        `mean_mm`, `median_mm` and `p95_mm` of the distance from zero crossings to the true surface; `bias_mm`
        (negative: too deep); `found`, the share of rays with a crossing. In free space within one voxel of the surface:
        `band_mm`, the mean error of the field, and `covered`, the share with all eight corners. `voxels`, and
        `encode_ms` per frame.
    """
    config = config or load_config("demo", overrides=[("prior.neighborhood", prior.neighborhood)])
    dataset = GeneratedDataset(frames=max(map(max, triples)) + 1, width=640, height=480, seed=ROOM_SEED)
    parts = [_measure_triple(prior, dataset, triple, noise, seed, config) for triple in triples]
    crossing, band, covered, found = (
        torch.cat([part[name] for part in parts]) for name in ("crossing", "band", "covered", "found")
    )
    size = crossing.abs()
    return {
        "mean_mm": size.mean().item(),
        "median_mm": size.median().item(),
        "p95_mm": size.quantile(0.95).item(),
        "bias_mm": crossing.mean().item(),
        "found": found.float().mean().item(),
        "band_mm": band.mean().item(),
        "covered": covered.float().mean().item(),
        "voxels": sum(part["voxels"] for part in parts) / len(parts),
        "encode_ms": float(np.median([ms for part in parts for ms in part["encode_ms"]])),
    }


def _measure_triple(
    prior: Prior, dataset: GeneratedDataset, triple: tuple[int, ...], noise: float | str, seed: int, config: Config
) -> dict:
    scene = Scene(_scene_settings(config), seed, geometry_decoder=prior.decoder_params)
    origins, directions, depths, times = [], [], [], []
    for index in triple:
        frame = dataset[index]
        generator = np.random.default_rng([seed, index])
        noisy = replace(frame, depth=_with_noise(frame.depth, noise, dataset.camera.fx, generator))
        times.append(_integrate(scene, prior, noisy, dataset, config))
        origin, direction, depth = _true_rays(frame, dataset, generator)
        origins.append(origin), directions.append(direction), depths.append(depth)
    figures = _crossings(scene, dataset, *map(torch.cat, (origins, directions, depths)))
    return figures | {"voxels": scene.volume.num_voxels, "encode_ms": times}


def _scene_settings(config: Config) -> SceneSettings:
    names = ("voxel_size_m", "plane_cell_m", "position_scale", "max_voxels")
    same = {name: getattr(config.scene, name) for name in names}
    return SceneSettings(truncation_m=config.scene.truncation, **same)


def _with_noise(depth: np.ndarray, noise: float | str, focal_px: float, generator: np.random.Generator) -> np.ndarray:
    if noise == KINECT:
        return kinect_depth(depth, focal_px, 1.0, generator)
    return depth + np.float32(1e-3 * float(noise)) * generator.standard_normal(depth.shape, dtype=np.float32)


def _integrate(scene: Scene, prior: Prior, frame: RgbdFrame, dataset: GeneratedDataset, config: Config) -> float:
    """Encodes and fuses a frame; returns the milliseconds, without sampling of pixels and normals."""
    pixels = sample_frame(frame, dataset.camera, config)
    pose = torch.from_numpy(frame.pose).float()
    points = unpack_points(pixels.records, dataset.camera) @ pose[:3, :3].T + pose[:3, 3]
    normals = pixels.normals @ pose[:3, :3].T
    start = time.perf_counter()
    encode_frame(scene.volume, points, normals, prior, config.prior)
    return 1e3 * (time.perf_counter() - start)


def _true_rays(frame: RgbdFrame, dataset: GeneratedDataset, generator: np.random.Generator) -> tuple[torch.Tensor, ...]:
    """Origins [R,3], directions [R,3] of length 1 and distances [R] to the true surface, of random pixels."""
    chosen = generator.integers(0, frame.depth.size, RAYS)
    direction = dataset.camera.ray_directions().reshape(-1, 3)[chosen] @ frame.pose[:3, :3].T
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    distance = frame.depth.reshape(-1)[chosen] * length[:, 0]
    origin = np.broadcast_to(frame.pose[:3, 3], direction.shape)
    return tuple(torch.from_numpy(np.ascontiguousarray(a)).float() for a in (origin, direction / length, distance))


def _crossings(
    scene: Scene, dataset: GeneratedDataset, origin: torch.Tensor, direction: torch.Tensor, distance: torch.Tensor
) -> dict[str, torch.Tensor]:
    offset = torch.arange(-SEARCH_M, SEARCH_M + SEARCH_STEP_M / 2, SEARCH_STEP_M)
    along = distance[:, None] + offset
    places = (origin[:, None] + along[..., None] * direction[:, None]).reshape(-1, 3)
    sdf, valid = scene.sdf(places)
    true = torch.from_numpy(dataset.room.signed_distance(places.numpy())).float()
    # The room's signed distance is exact in free space only.
    seen = (offset <= 0).expand(along.shape).reshape(-1)
    near = seen & (true >= 0) & (true < scene.settings.voxel_size_m)
    error = (sdf * scene.settings.truncation_m - true).abs()
    crossing, found = first_zero_crossing(sdf.where(valid, torch.nan).view(along.shape), along)
    surface = (origin + crossing[:, None] * direction)[found]
    return {
        "crossing": 1e3 * torch.from_numpy(dataset.room.signed_distance(surface.numpy())).float(),
        "found": found,
        "band": 1e3 * error[near & valid],
        "covered": valid[near],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Surface error after encoding three frames, without any iteration.")
    parser.add_argument("--weights", metavar="FILE", help="weights to measure; the shipped ones if not given")
    parser.add_argument("--output", metavar="FILE", type=Path, help="also write the figures as JSON")
    parser.add_argument("--report", metavar="PAGE", type=Path, help="put the tables into a page's regions, too")
    parser.add_argument("--noise", metavar="MM", nargs="+", default=[*NOISE_MM, KINECT], help="depth noise, or kinect")
    args = parser.parse_args()
    prior = load_prior(args.weights)
    rows = {}
    for noise in args.noise:
        rows[str(noise)] = measure(prior, noise if noise == KINECT else float(noise))
        print(f"noise {noise}: {rows[str(noise)]['mean_mm']:.2f} mm", file=sys.stderr, flush=True)
    tables = {"accuracy": accuracy_table(rows), "validation": validation_table(prior)}
    print(to_text(tables["accuracy"]))
    if args.output:
        atomic_write(args.output, json.dumps(_record(args.weights, rows), indent=1) + "\n")
    if args.report:
        fill_regions(args.report, "one-shot", {name: to_markdown(table) for name, table in tables.items()})


def accuracy_table(rows: dict[str, dict]) -> Table:
    """One row per noise level, from the results of `measure`."""
    header = ("noise mm", "mean mm", "median mm", "95 % mm", "bias mm", "field mm", "found", "covered", "voxels")
    lengths = ("mean_mm", "median_mm", "p95_mm", "bias_mm", "band_mm")
    lines = [
        (
            noise,
            *(f"{row[name]:.2f}" for name in lengths),
            f"{row['found']:.1%}",
            f"{row['covered']:.1%}",
            f"{row['voxels']:.0f}",
        )
        for noise, row in rows.items()
    ]
    return Table("accuracy", "Surface error before any iteration", "", header, tuple(lines))


def validation_table(prior: Prior) -> Table:
    """Validation figures stored with the weights: kinds of solids not trained on, 2 mm of noise."""
    header = ("held out", "0-4 cm mm", "4-8 cm mm", "sign", "crossing mm")
    lines = [
        (
            kind.replace("_", " "),
            f"{row['near_mae_mm']:.2f}",
            f"{row['far_mae_mm']:.2f}",
            f"{row['sign_accuracy']:.2%}",
            f"{row['zero_crossing_mm']:.2f}",
        )
        for kind, row in prior.metadata["validation"].items()
    ]
    return Table("validation", "Held-out solids", "", header, tuple(lines))


def _record(weights: str | None, rows: dict[str, dict]) -> dict:
    return {
        "benchmark": "prior_accuracy",
        "weights": str(weights or "shipped"),
        "noise_mm": rows,
        "environment": describe_environment(torch.device("cpu")),
    }


if __name__ == "__main__":
    main()
