"""The mesh of a run: fused from its frames at their final poses, or extracted from the map alone."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset
from spslam.errors import OutputError
from spslam.evaluation.run_output import match_times
from spslam.meshing import TriangleMesh, extract_mesh, save_mesh
from spslam.meshing.color_detail import ColorOptions, color_mesh, colored_every, keep_colored
from spslam.meshing.depth_views import DepthViews
from spslam.meshing.extract import cubes_per_cell
from spslam.meshing.frame_fusion import FusionOptions, PosedFrames, fuse_frames
from spslam.meshing.fused_mesh import extract_fused_mesh
from spslam.meshing.rolling_shutter import FrameReadout
from spslam.meshing.texture.export import check_textured_format
from spslam.ops.depth_planes import DEFAULT_NOISE
from spslam.options import MeshOptions
from spslam.run.image_readers import shared_out
from spslam.run.memory import keep_freed_memory
from spslam.run.threads import library_threads_limited
from spslam.scene import Scene
from spslam.slam.interpreter import interpreter_shared
from spslam.trajectory import Trajectory


@dataclass(frozen=True)
class EarlierFrames:
    """A recording that a map is of beside the run's own.

    Attributes:
        trajectory: in the map's world.
        dataset: its frames, or a dataset that contains them; None where they can't be read again.
        noise: of depth, as of `MeshJob`.
    """

    trajectory: Trajectory
    dataset: RgbdDataset | None
    noise: tuple[float, float] | None = None


@dataclass(frozen=True)
class TextureWish:
    """That a mesh is to have a texture.

    Attributes:
        texel_m: edge of a texel, m; None is as finely as the frames saw the surface.
    """

    texel_m: float | None = None


@dataclass(frozen=True)
class MeshJob:
    """What a mesh is made of.

    Attributes:
        scene: the map.
        trajectory: of the run.
        camera: intrinsics of the frames; None leaves surface in that no view sees, of a mesh from the map alone.
        options: of the mesh.
        noise: of depth, see `ops.measure_planes`; where it was not measured, None.
        readout_s: of the run's frames, from the first row that is read to the last; 0 where they are of one moment.
        earlier: recordings that the map is of beside the run's.
        texture: whether the frames' colors are baked into a texture; None for colors of vertices.
        needs_frames: a mesh is fused only where a frame can be read; else the map fills in for all of them.
    """

    scene: Scene
    trajectory: Trajectory
    camera: Camera | None
    options: MeshOptions
    noise: tuple[float, float] | None = None
    readout_s: float = 0.0
    earlier: Sequence[EarlierFrames] = ()
    texture: TextureWish | None = None
    needs_frames: bool = False


def measured_noise(metrics: Mapping[str, Any]) -> tuple[float, float] | None:
    """The depth noise that a run measured, from its metrics.json; None where it says nothing.

    Args:
        metrics: content of metrics.json.
    """
    floor, growth = metrics.get("depth_noise_floor_m2"), metrics.get("depth_noise_growth_m2")
    if not isinstance(floor, float) or not isinstance(growth, float) or not (0 <= floor < 1 and 0 <= growth < 1):
        return None
    return floor, growth


def measured_readout_s(metrics: Mapping[str, Any]) -> float:
    """The readout of frames that a run measured, from its metrics.json; 0 where it says nothing."""
    readout_ms = metrics.get("readout_ms")
    return 1e-3 * readout_ms if isinstance(readout_ms, float) and abs(readout_ms) < 1e3 else 0.0


def write_mesh(path: Path, job: MeshJob, dataset: RgbdDataset | None) -> tuple[TriangleMesh, dict[str, Any]]:
    """Makes the mesh of a run and writes it.

    Args:
        path: of the mesh.
        job: what it is made of.
        dataset: the run's frames, or a dataset that contains them; not read for a mesh from the map alone without a
            texture.

    Returns:
        The mesh, and what metrics.json says of it.

    Raises:
        OutputError: a mesh is to be fused or textured and no frame of the run is in the dataset, or none can be read
            and the job needs frames, there is no surface and the file is to be another than a PLY, or the file can't be
            written.
        SpslamError: the surface does not fit into `mesh.max_memory_mb` at any voxel size.
    """
    started = time.perf_counter()
    if job.texture is not None:
        check_textured_format(path)
        if dataset is None:
            raise OutputError(f"{path}: a texture is made of frames, and none can be read again")
    is_fused = dataset is not None and job.options.source != "neural"
    is_shared = job.scene.device.type == "cuda" and (is_fused or job.texture is not None)
    with shared_out(dataset) if dataset is not None and is_shared else nullcontext(dataset) as readable:
        mesh, figures = _fused(job, readable) if readable is not None and is_fused else _extracted(job)
        if not len(mesh.faces) and (job.texture is not None or path.suffix != ".ply"):
            raise OutputError(no_surface(path, figures["mesh_resolution_m"]))
        if job.texture is None or readable is None:
            save_mesh(mesh, path)
        else:
            figures |= _write_textured(path, mesh, job, readable, job.texture.texel_m)
    return mesh, {**figures, "mesh_s": time.perf_counter() - started}


def no_surface(path: Path, resolution_m: float) -> str:
    """Why a mesh is not written that has no faces.

    Args:
        path: of the mesh.
        resolution_m: edge of its voxels, m.
    """
    return (
        f"{path}: no surface at a resolution of {resolution_m:g} m, so no mesh was written; choose a smaller "
        "--resolution, or a run whose map has surface"
    )


def _extracted(job: MeshJob) -> tuple[TriangleMesh, dict[str, Any]]:
    """The mesh of the map alone, and figures."""
    wanted_m, voxel_m = job.options.resolution_m, job.scene.volume.voxel_size_m
    mesh = extract_mesh(job.scene, wanted_m, job.camera, None if job.camera is None else _tracked_poses(job))
    blocks, per_block = cubes_per_cell(voxel_m, wanted_m)
    return mesh, {"mesh_source": "neural", "mesh_resolution_m": voxel_m / (blocks * per_block)}


def _fused(job: MeshJob, dataset: RgbdDataset) -> tuple[TriangleMesh, dict[str, Any]]:
    """The mesh of the frames, and figures. If it is to have a texture, its vertices have the voxels' colors."""
    frames, noise = frames_of(job, dataset), job.noise or DEFAULT_NOISE
    if job.texture is None:
        frames = list(keep_colored(frames))
    # Colors of voxels are for a texture, or else for vertices that no frame that gives colors sees.
    color_every = colored_every(sum(map(len, frames))) if job.texture is None else 1
    fusion = FusionOptions(job.options.resolution_m, job.options.max_memory_mb, noise, color_every)
    views = DepthViews(frames, [part.noise or noise for part in frames])
    keep_freed_memory()
    with library_threads_limited(), interpreter_shared():
        volume = fuse_frames(frames, fusion, job.scene, job.scene.device, views)
    if job.needs_frames and not volume.integrated:
        raise OutputError(
            f"{dataset.name}: none of the {sum(map(len, frames))} frames to fuse can be read: restore the data, or use "
            "--source neural, which needs no frames"
        )
    mesh = extract_fused_mesh(volume, job.scene, dataset.camera, _tracked_poses(job), views=views)
    figures = {
        "mesh_source": "tsdf",
        "mesh_frames": volume.integrated,
        "mesh_mb": volume.nbytes / 2**20,
        "mesh_resolution_m": volume.voxel_size,
    }
    del volume, views  # the largest of what is held, not needed for colors
    if job.texture is None:
        options = ColorOptions(noise, job.options.color_subdivisions)
        with library_threads_limited(), interpreter_shared():
            mesh, figures["mesh_color_frames"] = color_mesh(mesh, frames, options, job.scene.device)
    return mesh, figures


def _tracked_poses(job: MeshJob) -> np.ndarray:
    trajectories = [*(each.trajectory for each in job.earlier), job.trajectory]
    return np.concatenate([each.poses[~each.lost] for each in trajectories])


def _write_textured(
    path: Path, mesh: TriangleMesh, job: MeshJob, dataset: RgbdDataset, texel_m: float | None
) -> dict[str, Any]:
    """Bakes the texture of a mesh, writes both, and says how large it is."""
    from spslam.meshing.texture import TextureOptions, texture_mesh

    options = TextureOptions(job.noise or DEFAULT_NOISE, texel_m)
    textured = texture_mesh(mesh, frames_of(job, dataset), options)
    textured.save(path)
    pages, height, width = textured.pages.shape[:3]
    return {
        "texel_m": textured.texel_m,
        "wanted_texel_m": textured.wanted_texel_m,
        "texture_size": (pages, width, height),
        "most_pages": options.most_pages,
    }


def frames_of(job: MeshJob, dataset: RgbdDataset) -> list[PosedFrames]:
    """All frames of a job that can be read: of recordings before, and of the run.

    Raises:
        OutputError: there is none of the run.
    """
    return [*_earlier_frames(job.earlier), posed_frames(dataset, job.trajectory, job.readout_s)]


def _earlier_frames(earlier: Sequence[EarlierFrames]) -> list[PosedFrames]:
    known = [(each, each.dataset) for each in earlier if each.dataset is not None and not each.trajectory.lost.all()]
    return [replace(posed_frames(dataset, each.trajectory), noise=each.noise) for each, dataset in known]


def posed_frames(dataset: RgbdDataset, trajectory: Trajectory, readout_s: float = 0.0) -> PosedFrames:
    """The dataset's frames that a trajectory has a pose for.

    Args:
        dataset: that they are read from.
        trajectory: of them.
        readout_s: as of `MeshJob`.

    Raises:
        OutputError: there is none.
    """
    indices = match_times(dataset.timestamps(), trajectory.timestamps)
    rows = np.flatnonzero((indices >= 0) & ~trajectory.lost)
    if not len(rows):
        raise OutputError(f"{dataset.name}: has none of the run's frames to fuse; --source neural needs no frames")
    readout = FrameReadout(readout_s, trajectory, indices) if readout_s else None
    return PosedFrames(dataset, indices[rows], trajectory.poses[rows], readout=readout)


def noise_of_model(model: torch.Tensor) -> tuple[float, float]:
    """Floor and growth of the depth variance, of `SensorNoise.model`."""
    floor, growth = model[:2].tolist()
    return floor, growth
