"""The recordings that a map is of: what a run's folder says of them, and their frames read again."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pydantic

from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset
from spslam.errors import SpslamError
from spslam.evaluation.run_data import is_same_camera
from spslam.evaluation.run_output import match_times
from spslam.meshing import TriangleMesh
from spslam.options import DatasetOptions, MeshOptions
from spslam.run.mesh import EarlierFrames, MeshJob, TextureWish, noise_of_model, write_mesh
from spslam.run.request import RunRequest
from spslam.run.session import with_absolute_path
from spslam.scene import Scene
from spslam.slam.graph.archive import KeyframeArchive, Recording


def source_of(request: RunRequest) -> dict[str, Any]:
    """JSON object by which the frames of a request are read again."""
    dataset = with_absolute_path(request.config).dataset.model_dump(mode="json")
    if request.data_dir is not None:
        dataset["path"] = os.path.abspath(request.data_dir)
    return {"dataset": dataset}


def read_again(archive: KeyframeArchive, recordings: Sequence[Recording]) -> tuple[list[EarlierFrames], list[str]]:
    """The frames of recordings, and in words which of them can't be read again.

    Args:
        archive: of the map, for the noise of its sensors.
        recordings: all of the map's, or the first ones, with their trajectories as they are now.
    """
    frames, missing = [], []
    noise = {archive.recording_of(i): archive.noise[each.camera] for i, each in enumerate(archive.keyframes)}
    for number, recording in enumerate(recordings):
        found = _open_again(recording)
        if isinstance(found, str):
            missing.append(f"the mesh is of the map alone where {recording.name} was: {found}")
        dataset = None if isinstance(found, str) else found
        model = noise.get(number)
        frames.append(EarlierFrames(recording.trajectory, dataset, None if model is None else noise_of_model(model)))
    return frames, missing


def write_map_mesh(
    path: Path,
    scene: Scene,
    archive: KeyframeArchive,
    options: MeshOptions,
    texture: TextureWish | None = None,
) -> tuple[TriangleMesh, dict[str, Any], list[str]]:
    """Makes the mesh of a map of any recordings and writes it.

    Args:
        path: of the mesh.
        scene: the map.
        archive: its keyframes and trajectories.
        options: of the mesh.
        texture: as of `MeshJob`.

    Returns:
        The mesh, what metrics.json says of it, and in words which frames can't be read again.

    Raises:
        OutputError, SpslamError: as `write_mesh`.
    """
    frames, missing = read_again(archive, archive.recordings) if options.source == "tsdf" or texture else ([], [])
    readable = [i for i, each in enumerate(frames) if each.dataset is not None and not each.trajectory.lost.all()]
    own = readable[0] if readable else 0
    earlier = frames or [EarlierFrames(each.trajectory, None) for each in archive.recordings]
    dataset, noise = earlier[own].dataset, earlier[own].noise
    camera = archive.recordings[own].camera
    rest = [each for i, each in enumerate(earlier) if i != own]
    job = MeshJob(scene, earlier[own].trajectory, camera, options, noise, earlier=rest, texture=texture)
    return (*write_mesh(path, job, dataset), missing)


def _open_again(recording: Recording) -> RgbdDataset | str:
    """The dataset of a recording; in words why it can't be read, or is another one now."""
    options = recording.source.get("dataset")
    if not isinstance(options, dict):
        return "its frames came once"
    try:
        dataset = open_sequence(DatasetOptions(**options))
    except (SpslamError, pydantic.ValidationError, TypeError) as error:
        return f"its frames can't be read again ({' '.join(str(error).split())[:200]})"
    if not is_same_camera(recording.camera, dataset.camera):
        return f"{dataset.name} is of another camera now"
    known = recording.trajectory.timestamps[~recording.trajectory.lost]
    if len(known) and bool((match_times(dataset.timestamps(), known) < 0).all()):
        return f"none of its frames is in {dataset.name} any more"
    return dataset
