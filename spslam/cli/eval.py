"""``spslam eval``: a finished run's trajectory and mesh against the truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from spslam.cli.arguments import add_run_folder, require_run_file
from spslam.cli.progress import print_summary
from spslam.config import load_config
from spslam.errors import DatasetError, OutputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_folder(parser)
    parser.add_argument("--gt-mesh", metavar="PLY", type=Path, help="the true surface, in the true trajectory's world")


def execute(args: argparse.Namespace) -> None:
    require_run_file(args.output, "trajectory.txt")

    from spslam.evaluation.finished_run import add_metrics, trajectory_figures
    from spslam.evaluation.report import write_report
    from spslam.evaluation.run_output import RunOutput

    run = RunOutput.read(args.output)
    figures: dict[str, Any] = trajectory_figures(run)
    if not figures and args.gt_mesh is None:
        raise OutputError(f"{args.output}: the data has no true poses to compare with; --gt-mesh compares the mesh")
    if args.gt_mesh is not None:
        figures |= _surface_figures(run, args.gt_mesh)
    metrics = add_metrics(run, figures)
    write_report(args.output)
    print_summary(metrics, args.output)


def _surface_figures(run: Any, gt_mesh: Path) -> dict[str, float]:
    from spslam.datasets import open_dataset
    from spslam.evaluation.finished_run import surface_figures
    from spslam.evaluation.surface import TriangleSurface

    vertices, faces = _load_surface(gt_mesh)
    dataset = open_dataset(load_config(require_run_file(run.folder, "config.yaml")).dataset)
    return surface_figures(run, dataset, TriangleSurface(vertices, faces))


def _load_surface(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    if not path.is_file():
        raise DatasetError(f"{path}: no such mesh file")
    try:
        mesh = trimesh.load(path, process=False, force="mesh")
    except Exception as error:  # trimesh raises whatever the parser stumbles over
        raise DatasetError(f"{path}: can't be read as a mesh: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise DatasetError(f"{path}: must be a mesh with faces, got none")
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
