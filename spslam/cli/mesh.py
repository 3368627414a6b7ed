"""`spslam mesh`: extracts a mesh from the map of a finished run."""

from __future__ import annotations

import argparse

from spslam.cli.arguments import add_run_folder, positive_meters, require_run_file
from spslam.config import load_config
from spslam.run_folder import MESH_FORMATS, RunFolder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_folder(parser)
    parser.add_argument(
        "--resolution",
        metavar="M",
        type=positive_meters,
        help="edge length of a marching-cubes cell in meters; the run's mesh.resolution_m if not given",
    )
    parser.add_argument("--format", choices=MESH_FORMATS, default="ply", help="file format, ply if not given")


def execute(args: argparse.Namespace) -> None:
    folder = RunFolder(args.output)
    map_file = require_run_file(folder.map)
    resolution = args.resolution or load_config(require_run_file(folder.config)).mesh.resolution_m

    from spslam.evaluation.run_output import RunOutput
    from spslam.meshing import extract_mesh, save_mesh
    from spslam.scene import Scene

    run = RunOutput.read(args.output)
    poses = None if run.camera is None else run.trajectory.poses[~run.trajectory.lost]
    mesh = extract_mesh(Scene.load(map_file), resolution, run.camera, poses)
    path = folder.mesh_as(args.format)
    save_mesh(mesh, path)
    print(f"{path}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces")
