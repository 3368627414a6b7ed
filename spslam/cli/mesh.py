"""`spslam mesh`: makes a mesh of a finished run, fused from its frames or extracted from its map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spslam.cli.arguments import add_run_folder, positive_meters, require_run_file
from spslam.config import Config, load_config
from spslam.errors import DatasetError, OutputError
from spslam.run_folder import MESH_FORMATS, RunFolder, is_merged

if TYPE_CHECKING:
    from spslam.datasets.base import RgbdDataset
    from spslam.evaluation.run_output import RunOutput
    from spslam.meshing import TriangleMesh
    from spslam.run.mesh import EarlierFrames

SOURCES = ("tsdf", "neural")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_folder(parser)
    parser.add_argument(
        "--source",
        choices=SOURCES,
        help="tsdf reads the frames again and fuses them, neural extracts the map; as the run itself if not given",
    )
    parser.add_argument(
        "--resolution",
        metavar="M",
        type=positive_meters,
        help="edge length of a voxel or marching-cubes cell in meters; the run's mesh.resolution_m if not given",
    )
    parser.add_argument("--format", choices=MESH_FORMATS, default="ply", help="file format, ply if not given")


def execute(args: argparse.Namespace) -> None:
    folder = RunFolder(args.output)
    map_file = require_run_file(folder.map)
    config = load_config(require_run_file(folder.config))
    if is_merged(folder):
        _execute_merged(args, folder, config)
        return

    from spslam.evaluation.finished_run import add_metrics
    from spslam.evaluation.run_output import RunOutput
    from spslam.run.mesh import MeshJob, measured_noise, write_mesh
    from spslam.scene import Scene

    run = RunOutput.read(args.output)
    source = args.source or ("neural" if _is_live(run) else config.mesh.source)
    changes = {"source": source, "resolution_m": args.resolution or config.mesh.resolution_m}
    options = config.mesh.model_copy(update=changes)
    dataset = _open_again(run, config) if source == "tsdf" else None
    earlier = _earlier(folder) if "map" in run.metrics else []
    job = MeshJob(Scene.load(map_file), run.trajectory, run.camera, options, measured_noise(run.metrics), earlier)
    path = folder.mesh_as(args.format)
    mesh, figures = write_mesh(path, job, dataset)
    if path == folder.mesh:
        add_metrics(run, figures)
    _print_mesh(path, mesh, figures)


def _execute_merged(args: argparse.Namespace, folder: RunFolder, config: Config) -> None:
    from spslam.run.recordings import write_map_mesh
    from spslam.scene import Scene
    from spslam.slam.graph.archive import KeyframeArchive

    changes = {
        "source": args.source or config.mesh.source,
        "resolution_m": args.resolution or config.mesh.resolution_m,
    }
    archive = KeyframeArchive.load(require_run_file(folder.keyframes))
    path, options = folder.mesh_as(args.format), config.mesh.model_copy(update=changes)
    mesh, figures, missing = write_map_mesh(path, Scene.load(folder.map), archive, options)
    for line in missing:
        print(f"! {line}")
    _print_mesh(path, mesh, figures)


def _print_mesh(path: Path, mesh: TriangleMesh, figures: dict[str, Any]) -> None:
    size = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
    made_of = f", {figures['mesh_mb']:.0f} MB of voxels" if "mesh_mb" in figures else ""
    made_at = f"{figures['mesh_source']} at {figures['mesh_resolution_m']:g} m"
    print(f"{path}: {size}; {made_at}{made_of}, {figures['mesh_s']:.1f} s")


def _is_live(run: RunOutput) -> bool:
    """Whether it was a live run, whose own mesh is of the map alone: its frames came once."""
    return "received_frames" in run.metrics


def _earlier(folder: RunFolder) -> list[EarlierFrames]:
    """The recordings that the map of a run with `--map` is of beside the run's; says which can't be read again."""
    from spslam.run.recordings import read_again
    from spslam.slam.graph.archive import KeyframeArchive

    archive = KeyframeArchive.load(require_run_file(folder.keyframes))
    earlier, missing = read_again(archive, archive.recordings[:-1])
    for line in missing:
        print(f"! {line}")
    return earlier


def _open_again(run: RunOutput, config: Config) -> RgbdDataset:
    from spslam.datasets import open_dataset

    try:
        return open_dataset(config.dataset)
    except DatasetError as error:
        if not _is_live(run):
            raise
        raise OutputError(
            f"{run.folder.path}: the frames of a live run can't be read again; --source neural needs none ({error})"
        ) from None
