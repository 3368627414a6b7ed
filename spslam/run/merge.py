"""Joins the maps of finished runs that share a place: one map, one mesh, and all trajectories in one world."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.config import Config, dump_config, load_config
from spslam.errors import ConfigError, OutputError
from spslam.io import atomic_write
from spslam.prior import load_prior
from spslam.run.device import explained_failures, resolve_device
from spslam.run.figures import graph_figures, origin, scene_figures
from spslam.run.output_folder import OutputFolder
from spslam.run.provenance import provenance
from spslam.run.recordings import write_map_mesh
from spslam.run.threads import kernel_threads_limited, library_threads_limited
from spslam.run_folder import RunFolder
from spslam.scene import Scene
from spslam.slam.graph.archive import KeyframeArchive
from spslam.slam.graph.joined import join_archives, registrar_of
from spslam.slam.graph.joining import MIN_LOOPS
from spslam.slam.mapper import Mapper
from spslam.slam.opened_map import (
    archive_of,
    check_settings,
    load_archive,
    map_settings,
    put_keyframes,
    remake_map,
)
from spslam.slam.state import SlamState


@dataclass(frozen=True)
class MergeRequest:
    """Runs to be joined.

    Attributes:
        folders: output folders of finished runs, two at least; the world is the first one's, and so are the options.
        output_dir: made; must not hold anything.
        mesh: whether to make the mesh.
        device: as of the configuration.
        command: the command line, for metrics.json; empty where there was none.
    """

    folders: Sequence[Path]
    output_dir: Path
    mesh: bool = True
    device: str = "auto"
    command: str = ""


def merge_runs(request: MergeRequest) -> dict[str, Any]:
    """Joins finished runs; their folders are not changed.

    Returns:
        What is written to metrics.json.

    Raises:
        OutputError: a folder is not that of a finished run with a keyframe graph, two hold the same recording, they
            share no place, or the output folder can't be used.
        ConfigError: an option by which the maps can't be one.
    """
    if len(request.folders) < 2:
        raise OutputError("spslam merge needs the output folders of two finished runs at least")
    config = _config_of(RunFolder(request.folders[0]))
    device = resolve_device(request.device)
    with library_threads_limited(), explained_failures(device), kernel_threads_limited(device):
        return _merge(request, config, device)


def _config_of(folder: RunFolder) -> Config:
    if not folder.config.is_file():
        raise OutputError(
            f"{folder.path}: must be the output folder of a finished run, but has no {folder.config.name}"
        )
    return load_config(folder.config)


def _merge(request: MergeRequest, config: Config, device: torch.device) -> dict[str, Any]:
    output = _output_of(request)
    archives = _archives(request, config)
    joined, order = _joined(request.folders, archives, config)
    state = joined_state(RunFolder(request.folders[0]), joined, config, device)
    make_map(state, config)
    archive = archive_of(state, None, joined.settings)
    temporary = OutputFolder(output.parent / f".{output.name}.merging")
    with temporary.locked():
        try:
            _empty(temporary.path)
            metrics = _write(temporary, request, config, state, archive, order)
            _rename(temporary.path, output)
        except BaseException:  # Ctrl-C among them: only a killed merge leaves its folder
            shutil.rmtree(temporary.path, ignore_errors=True)
            raise
    return metrics


def _rename(made: Path, output: Path) -> None:
    try:
        os.replace(made, output)
    except OSError as error:
        raise OutputError(f"{output}: can't be made: {error.strerror or error}") from None


def _output_of(request: MergeRequest) -> Path:
    """The folder that the results are renamed to, after symbolic links; it is empty or not there yet."""
    path = request.output_dir.resolve()
    if path == Path.cwd():
        raise OutputError(f"{request.output_dir}: is the working directory; use another --output")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise OutputError(f"{request.output_dir}: is not an empty folder; use another --output")
    return path


def _empty(path: Path) -> None:
    """Removes what a killed merge has left."""
    for each in path.iterdir():
        shutil.rmtree(each) if each.is_dir() else each.unlink()


def _archives(request: MergeRequest, config: Config) -> list[KeyframeArchive]:
    """Those of the runs, of different recordings and alike in what must be alike."""
    if not config.tracking.features:
        raise ConfigError(
            f"{request.folders[0]}: a merge has the first run's options, and maps are joined with "
            "tracking.features=true only; name another run first"
        )
    archives = [load_archive(RunFolder(folder), MIN_LOOPS) for folder in request.folders]
    settings = map_settings(config, load_prior(config.prior.weights, config.prior.neighborhood))
    for folder, archive in zip(request.folders, archives, strict=True):
        check_settings(folder, archive, settings)
    for (one, first), (other, second) in itertools.combinations(zip(request.folders, archives, strict=True), 2):
        for recording, each in itertools.product(first.recordings, second.recordings):
            times = recording.trajectory.timestamps, each.trajectory.timestamps
            common = np.isin(*times).sum() if recording.source == each.source else 0
            if common and common == min(map(len, times)):
                raise OutputError(f"{one} and {other}: hold the same frames of {each.name}; merge different recordings")
    return archives


def _joined(
    folders: Sequence[Path], archives: Sequence[KeyframeArchive], config: Config
) -> tuple[KeyframeArchive, list[int]]:
    """One map of all, and its recordings' numbers in the order of the runs.

    Each is joined as soon as it shares a place with those before, whose recordings then come first in the map.
    """
    joined, waiting = archives[0], dict(zip(folders[1:], archives[1:], strict=True))
    runs = [folders[0]] * len(joined.recordings)
    while waiting:
        reasons, before = {}, len(waiting)
        for folder, archive in list(waiting.items()):
            found = join_archives(joined, archive, registrar_of(joined, archive, config))
            if isinstance(found, str):
                reasons[folder] = found
            else:
                joined = found
                runs += [folder] * len(archive.recordings)
                del waiting[folder]
        if len(waiting) == before:
            break
    for folder, reason in reasons.items() if waiting else ():
        raise OutputError(f"{folder}: shares no place with {folders[0]}: {reason}")
    return joined, sorted(range(len(runs)), key=lambda recording: folders.index(runs[recording]))


def joined_state(folder: RunFolder, joined: KeyframeArchive, config: Config, device: torch.device) -> SlamState:
    """A state of all keyframes of several runs, with the map of the first one.

    Args:
        folder: of the first run.
        joined: keyframes of all runs.
        config: of the first run.
        device: to work on.
    """
    camera = joined.recordings[0].camera
    state = SlamState.start(config, camera, np.eye(4), None, device)
    state.scene.load_state_dict(Scene.load(folder.map, device).state_dict())
    put_keyframes(state, joined, joined.poses)
    return state


def make_map(state: SlamState, config: Config) -> None:
    """Makes the map of a state again from all keyframes, and optimizes it over all of them, some at a time.

    Without `mapping.first_iterations` it is as the keyframes are fused.
    """
    prior = load_prior(config.prior.weights, config.prior.neighborhood)
    remake_map(state, prior, config)
    if config.mapping.first_iterations == 0:
        return
    mapper = Mapper(config, state.frames.camera, prior)
    rows = state.usable.nonzero()[:, 0].to(state.scene.device)
    parts = -(-len(rows) // config.mapping.frames)
    for part in range(parts):
        task = mapper.begin_on(state, rows[part::parts].contiguous(), config.mapping.first_iterations)
        mapper.advance(state, task, task.iterations)


def _write(
    folder: OutputFolder,
    request: MergeRequest,
    config: Config,
    state: SlamState,
    archive: KeyframeArchive,
    order: Sequence[int],
) -> dict[str, Any]:
    """Writes all results; `order` says which recordings of the archive are the runs', in their order."""
    atomic_write(folder.config, dump_config(config, provenance(config, state.scene.device)))
    state.scene.save(folder.map)
    archive.save(folder.keyframes)
    recordings = [archive.recordings[number] for number in order]
    for number, recording in enumerate(recordings):
        recording.trajectory.save_tum(folder.trajectory_of(number))
    lost = [int(each.trajectory.lost.sum()) for each in recordings]
    metrics: dict[str, Any] = {
        **origin(config, state.scene.device, request.command),
        "merged": [str(folder) for folder in request.folders],
        "recordings": [each.name for each in recordings],
        "frames": sum(len(each.trajectory) for each in recordings),
        "lost_frames": sum(lost),
        **scene_figures(state.scene),
        **graph_figures(len(archive.keyframes), archive.edges),
    }
    if request.mesh:
        _, figures, missing = write_map_mesh(folder.mesh, state.scene, archive, config.mesh)
        metrics |= figures
        if missing:
            metrics["warnings"] = missing
    atomic_write(folder.metrics, json.dumps(metrics, indent=1) + "\n")
    return metrics
