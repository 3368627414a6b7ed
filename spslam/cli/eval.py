"""`spslam eval`: evaluates trajectory, mesh and rendered views of a finished run against ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from spslam.cli.arguments import add_run_folder, require_run_file
from spslam.cli.progress import print_summary
from spslam.config import load_config
from spslam.errors import OutputError
from spslam.run_folder import RunFolder

# Given for --gt-mesh, the surface that the frames were rendered from.
GENERATED = "generated"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_folder(parser)
    parser.add_argument(
        "--gt-mesh",
        metavar="PLY",
        type=Path,
        help=f"ground-truth mesh, in the ground-truth world; `{GENERATED}` is the exact surface of generated data",
    )
    parser.add_argument("--views", action="store_true", help="PSNR and SSIM of the rendered map against the input")
    parser.add_argument("--scale", action="store_true", help="also compute ATE after alignment with scale")


def execute(args: argparse.Namespace) -> None:
    require_run_file(RunFolder(args.output).trajectory)

    from spslam.evaluation.finished_run import SCALE_KEYS, SURFACE_KEYS, VIEW_KEYS, add_metrics, trajectory_figures
    from spslam.evaluation.html_report import write_report
    from spslam.evaluation.run_output import RunOutput

    run = RunOutput.read(args.output)
    figures: dict[str, Any] = trajectory_figures(run, args.scale)
    if not figures and args.gt_mesh is None and not args.views:
        raise OutputError(f"{args.output}: {_nothing_to_compare(run)}")
    doubts: list[str] = []
    if args.gt_mesh is not None or args.views:
        of_map, doubts = _map_figures(run, args.gt_mesh, args.views)
        figures |= of_map
    measured = ((args.scale, SCALE_KEYS), (args.gt_mesh is not None, SURFACE_KEYS), (args.views, VIEW_KEYS))
    metrics = add_metrics(run, figures, {key for asked, keys in measured if asked for key in keys})
    write_report(args.output)
    print_summary(metrics, args.output)
    for line in doubts:
        print(f"! {line}")


def _nothing_to_compare(run: Any) -> str:
    """Why a trajectory has no figures, and what can be evaluated instead."""
    if run.ground_truth is None:
        others = "--gt-mesh evaluates the mesh, --views rendered views of the map"
        return f"there are no ground-truth poses to compare with; {others}"
    return "no tracked frame has a ground-truth pose to compare with; --views evaluates rendered views of the map"


def _map_figures(run: Any, gt_mesh: Path | None, views: bool) -> tuple[dict[str, float], list[str]]:
    """Figures of mesh and views, and in words what is missing of the run's data."""
    from spslam.datasets import open_dataset
    from spslam.evaluation.finished_run import surface_figures, view_figures
    from spslam.evaluation.run_data import data_of_run
    from spslam.evaluation.surface import Surface, TriangleSurface

    dataset, doubts = data_of_run(run, open_dataset(load_config(require_run_file(run.folder.config)).dataset))
    ground_truth: Surface | None
    if str(gt_mesh) != GENERATED:
        ground_truth = None if gt_mesh is None else TriangleSurface.load(gt_mesh)
    elif dataset.surface is None:
        raise OutputError(f"{run.folder.path}: --gt-mesh {GENERATED} needs a run over generated data")
    else:
        ground_truth = dataset.surface
    figures = {} if ground_truth is None else surface_figures(run, dataset, ground_truth)
    if views:
        figures = {**figures, **view_figures(run, dataset)}
    return figures, [*doubts, *dataset.unreadable_in_words()]
