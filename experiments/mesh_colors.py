"""Colors of fused meshes at views that were held out: spslam's beside Open3D's fusion of the same frames and poses.

    python -m experiments.mesh_colors RUN [RUN ...] --every 8 --voxel 0.01

Of the tracked frames of a finished run every so many-th is held out; the others are fused at the run's poses by both,
without the map's filling. Both meshes are rendered at the poses of the frames held out, the colors of their vertices
interpolated, and compared with the images over the pixels that both show: PSNR in dB, mean over the views, and SSIM;
and PSNR over those of them where both have the frame's depth to 3 cm, as elsewhere the surface is wrong, not its color.
Coverage is the share of all pixels that a mesh shows. Of Open3D's weight thresholds the one with the better PSNR
counts. Needs `pip install 'spslam[open3d]'`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.arguments import make_parser
from experiments.tsdf_baseline import fuse
from spslam.camera import Camera
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import RgbdFrame
from spslam.evaluation.image_metrics import psnr_db, ssim
from spslam.evaluation.run_output import RunOutput
from spslam.meshing import TriangleMesh
from spslam.meshing.frame_fusion import FusionOptions, fuse_frames
from spslam.meshing.fused_mesh import extract_fused_mesh
from spslam.meshing.render import render_colors
from spslam.ops.depth_planes import DEFAULT_NOISE
from spslam.run.mesh import measured_noise, posed_frames
from spslam.trajectory import Trajectory

MOST_VIEWS, MEMORY_MB = 40, 4000
SAME_M = 0.03
FIGURES = ("psnr_db", "ssim", "same_db", "coverage")


def main() -> None:
    """Parses the arguments; prints a row per run."""
    args = _parser().parse_args()
    print("| run | views | PSNR dB | SSIM | PSNR of the same surface | coverage % |\n|---|---|---|---|---|---|")
    for folder in args.runs:
        views, own, other = measure(RunOutput.read(folder), args)
        cells = [f"{own[name]:.2f} / {other[name]:.2f}" for name in FIGURES]
        print(f"| {folder.name} | {views} | {' | '.join(cells)} |", flush=True)


def measure(run: RunOutput, args: argparse.Namespace) -> tuple[int, dict[str, float], dict[str, float]]:
    """The number of views, and the figures of spslam's mesh and of Open3D's at them."""
    dataset = open_dataset(load_config(run.folder.config).dataset)
    fused, held = split(run.trajectory, args.every)
    frames = posed_frames(dataset, fused)
    options = FusionOptions(args.voxel, MEMORY_MB, measured_noise(run.metrics) or DEFAULT_NOISE)
    own = extract_fused_mesh(fuse_frames(frames, options))
    others = fuse(dataset, replace(run, trajectory=fused), args.voxel)
    views = list(posed_frames(dataset, held).read())
    views = views[:: max(-(-len(views) // MOST_VIEWS), 1)]
    pairs = [compare([own, other], views, dataset.camera) for other in others]
    return len(views), *max(pairs, key=lambda pair: pair[1]["psnr_db"])


def split(trajectory: Trajectory, every: int) -> tuple[Trajectory, Trajectory]:
    """The trajectory of the frames to be fused and of those held out; what is not in one of them is lost there.

    Args:
        trajectory: of a run.
        every: of its tracked frames each so many-th is held out, from the middle of the first so many on.
    """
    tracked = np.flatnonzero(~trajectory.lost)
    out = np.zeros(len(trajectory), dtype=bool)
    out[tracked[every // 2 :: every]] = True
    return replace(trajectory, lost=trajectory.lost | out), replace(trajectory, lost=~out)


def compare(
    meshes: Sequence[TriangleMesh], views: Sequence[tuple[RgbdFrame, np.ndarray]], camera: Camera
) -> list[dict[str, float]]:
    """`FIGURES` of each mesh, means over the views, PSNR and SSIM over the pixels that all of them show."""
    figures: list[list[tuple[float, ...]]] = [[] for _ in meshes]
    for frame, pose in views:
        images = [render_colors(each.vertices, each.faces, each.colors, camera, pose) for each in meshes]
        shown = np.all([depth > 0 for _, depth in images], axis=0)
        same = shown & np.all([np.abs(depth - frame.depth) < SAME_M for _, depth in images], axis=0)
        for rows, (color, depth) in zip(figures, images, strict=True):
            ratios = psnr_db(color, frame.color, shown), psnr_db(color, frame.color, same)
            rows.append((ratios[0], ssim(color, frame.color, shown), ratios[1], 100 * float(np.mean(depth > 0))))
    return [{name: _mean([row[i] for row in rows]) for i, name in enumerate(FIGURES)} for rows in figures]


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="output folder of a finished run")
    parser.add_argument("--every", type=int, default=8, help="of so many tracked frames one is held out")
    parser.add_argument("--voxel", type=float, default=0.01, help="m")
    return parser


if __name__ == "__main__":
    main()
