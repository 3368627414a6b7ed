"""Plain TSDF fusion (Open3D's `VoxelBlockGrid`) of a run's frames at the run's own poses, with the same evaluation.

    python -m experiments.tsdf_baseline RUN --gt-mesh generated --voxel 0.01

Every frame, truncation of four voxels, weight 1 for every pixel; of the two weight thresholds 1 and 3 both are printed.
Needs `pip install 'spslam[open3d]'`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import RgbdDataset
from spslam.errors import SpslamError
from spslam.evaluation.finished_run import surface_figures
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.surface import Surface, TriangleSurface
from spslam.meshing import TriangleMesh, save_mesh
from spslam.meshing.mesh import vertex_normals
from spslam.run.mesh import posed_frames
from spslam.run_folder import RunFolder

TRUNCATION_VOXELS = 4.0
WEIGHT_THRESHOLDS = (1.0, 3.0)


def fuse(dataset: RgbdDataset, run: RunOutput, voxel_m: float, blocks: int = 60_000) -> list[TriangleMesh]:
    """Meshes of Open3D's fusion, one for each weight threshold."""
    try:
        import open3d
    except ImportError as error:
        raise SpslamError(f"the baseline needs Open3D: pip install 'spslam[open3d]' ({error})") from None
    core, image = open3d.core, open3d.t.geometry.Image
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (core.float32,) * 3, ((1), (1), (3)), voxel_m, 8, blocks, core.Device("CPU:0")
    )
    intrinsics = core.Tensor(dataset.camera.matrix())
    frames = posed_frames(dataset, run.trajectory)
    for position, frame in frames.read():
        depth = image(core.Tensor(np.ascontiguousarray(frame.depth)))
        color = image(core.Tensor(np.ascontiguousarray(frame.color.astype(np.float32) / 255)))
        view = intrinsics, core.Tensor(np.linalg.inv(frames.poses[position])), 1.0, 10.0, TRUNCATION_VOXELS
        grid.integrate(grid.compute_unique_block_coordinates(depth, *view), depth, color, *view)
    return [_mesh(grid.extract_triangle_mesh(weight_threshold=threshold)) for threshold in WEIGHT_THRESHOLDS]


def _mesh(extracted) -> TriangleMesh:
    vertices = extracted.vertex.positions.numpy().astype(np.float32)
    faces = extracted.triangle.indices.numpy().astype(np.int32)
    colors = (255 * extracted.vertex.colors.numpy()).clip(0, 255).astype(np.uint8)
    return TriangleMesh(vertices, faces, colors, vertex_normals(vertices, faces))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="output folder of a finished run")
    parser.add_argument("--gt-mesh", required=True, help="ground-truth mesh, or `generated`")
    parser.add_argument("--voxel", type=float, default=0.01, help="m")
    arguments = parser.parse_args()
    run = RunOutput.read(arguments.run)
    dataset = open_dataset(load_config(run.folder.config).dataset)
    truth = dataset.surface if arguments.gt_mesh == "generated" else TriangleSurface.load(Path(arguments.gt_mesh))
    for threshold, figures in zip(
        WEIGHT_THRESHOLDS, figures_of_baseline(run, dataset, truth, arguments.voxel), strict=True
    ):
        row = " ".join(f"{name} {value:.2f}" for name, value in figures.items())
        print(f"Open3D {arguments.voxel:g} m, weight from {threshold:g}: {row}", flush=True)


def figures_of_baseline(run: RunOutput, dataset: RgbdDataset, truth: Surface, voxel_m: float) -> list[dict[str, float]]:
    """Figures of Open3D's meshes, one for each weight threshold; the last one stays in `open3d`."""
    folder = run.folder.path / "open3d"
    folder.mkdir(exist_ok=True)
    rows = []
    for mesh in fuse(dataset, run, voxel_m):
        save_mesh(mesh, RunFolder(folder).mesh)
        rows.append(surface_figures(replace(run, folder=_WithMesh(run.folder.path, folder)), dataset, truth))
    return rows


class _WithMesh(RunFolder):
    """A run's folder with the mesh of another."""

    def __init__(self, path: Path, mesh_folder: Path):
        object.__setattr__(self, "path", path)
        object.__setattr__(self, "_mesh", RunFolder(mesh_folder).mesh)

    @property
    def mesh(self) -> Path:
        return self._mesh


if __name__ == "__main__":
    main()
