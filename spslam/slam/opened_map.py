"""A finished map put into a new system's state: its keyframes become earlier frames, and its graph goes on."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.errors import ConfigError, OutputError
from spslam.options.needs import in_yaml
from spslam.prior import Prior
from spslam.run_folder import RunFolder
from spslam.scene import Scene
from spslam.slam.graph.archive import RECORDS, KeyframeArchive, Recording, same_length
from spslam.slam.graph.joined import moved_recordings
from spslam.slam.graph.keyframe import MIN_DEPTH_M, Keyframe
from spslam.slam.graph.keyframe_graph import GraphContent
from spslam.slam.graph.keyframe_store import KeyframeStore
from spslam.slam.graph.remap import empty_volume, encode_keyframe
from spslam.slam.pixels import THUMBNAIL_STEP_PX, unpack_points
from spslam.slam.poses import pose_tensor
from spslam.slam.state import SlamState

SMOOTH_SHARE = 0.05  # of depth; neighbors that differ more are not of one surface


def map_settings(config: Config, prior: Prior) -> dict[str, Any]:
    """What must be alike in maps that are joined, by option."""
    weights = hashlib.sha256(prior.encoder_params.cpu().numpy().tobytes()).hexdigest()[:16]
    scene = config.scene
    return {
        "scene.voxel_size_m": scene.voxel_size_m,
        "scene.truncation_m": scene.truncation,
        "scene.plane_cell_m": scene.plane_cell_m,
        "scene.position_scale": scene.position_scale,
        "prior.neighborhood": prior.neighborhood,
        "prior.weights": weights,
    }


def check_settings(path: Path, archive: KeyframeArchive, settings: dict[str, Any]) -> None:
    """Raises ConfigError for an option by which a map in folder `path` can't be joined with one of other settings."""
    for option, value in settings.items():
        if archive.settings.get(option) == value:
            continue
        if option == "prior.weights":
            raise ConfigError(f"prior.weights must be the file that the map {path} was made with")
        known = archive.settings.get(option)
        raise ConfigError(f"{option} must be {in_yaml(known)}, that of the map {path}, got {in_yaml(value)}")


def load_archive(folder: RunFolder, least: int = 1) -> KeyframeArchive:
    """The keyframes of a finished run; raises OutputError where it has fewer than so many, or they can't be read."""
    if not folder.path.is_dir():
        raise OutputError(f"{folder.path}: must be the output folder of a finished run, but is no folder")
    for required in (folder.metrics, folder.map):
        if not required.is_file():
            raise OutputError(f"{folder.path}: must be the output folder of a finished run, but has no {required.name}")
    if not folder.keyframes.is_file():
        raise OutputError(
            f"{folder.path}: has no {folder.keyframes.name}, which runs with graph.enabled=true and prior.enabled=true "
            "write; run it again"
        )
    archive = KeyframeArchive.load(folder.keyframes)
    if not archive.keyframes:
        raise OutputError(f"{folder.path}: its map has no keyframes")
    if len(archive.keyframes) < least:
        raise OutputError(
            f"{folder.path}: its map has one keyframe, and a place is known by two that agree; let the camera move more"
        )
    return archive


def open_map(state: SlamState, scene: Scene, archive: KeyframeArchive) -> None:
    """Puts a finished map into a state without frames.

    Args:
        state: new, with a keyframe graph; changed.
        scene: the map, on the state's device.
        archive: its keyframes.
    """
    state.scene.load_state_dict(scene.state_dict())
    put_keyframes(state, archive, archive.poses)


def put_keyframes(state: SlamState, archive: KeyframeArchive, poses: np.ndarray) -> None:
    """Makes keyframes at poses float64 [K, 4, 4] the first frames of a state without frames; changes no map."""
    store, camera, device = state.graph, state.frames.camera, state.scene.device
    if store is None or len(state.frames):
        raise ValueError("put_keyframes: state must have a keyframe graph and no frames")
    timestamps = archive.timestamps()
    for i, (keyframe, link) in enumerate(zip(archive.keyframes, archive.links, strict=True)):
        own = archive.recordings[archive.recording_of(i)].camera
        numbered = keyframe.changed(frame=i)
        thumbnail = _thumbnail(numbered, camera).to(device)
        state.frames.append(pose_tensor(poses[i], device), float(timestamps[i]), 0, False, thumbnail)
        state.pixels.add(seen_by(archive.records[i], own, numbered, camera).to(device))
        store.add(numbered, link)
        state.features.add(i, store.keyframes[-1].features)
    state.frames.opened = len(archive.keyframes)
    store.content = GraphContent(list(archive.edges), set(archive.tried), len(archive.keyframes))
    store.opened_noise, store.opened = dict(archive.noise), archive


def remake_map(state: SlamState, prior: Prior, config: Config) -> None:
    """Makes the volume again from all keyframes of a state at their poses; the colors stay in their planes.

    Args:
        state: changed.
        prior: makes the map.
        config: of the run.
    """
    store, volume = state.graph, empty_volume(state.scene)
    if store is None:
        raise ValueError("remake_map: state must have a keyframe graph")
    on_device = prior.to(state.scene.device)
    for keyframe, pose in zip(store.keyframes, state.frames.matrices()[store.rows], strict=True):
        encode_keyframe(volume, keyframe, pose, on_device, config)
    state.replace_volume(volume)


def archive_of(state: SlamState, recording: Recording | None, settings: Mapping[str, Any]) -> KeyframeArchive:
    """What a finished run keeps: its own keyframes, and those of the map that it opened, as they were moved.

    Args:
        state: after the last frame, with a keyframe graph.
        recording: the run's; None where it has no frames of its own.
        settings: of the map.
    """
    store, first = state.graph, state.frames.opened
    if store is None:
        raise ValueError("archive_of: state must have a keyframe graph")
    # Keyframes are left out where they show nothing new, those of the opened map too.
    opened, own = store.rows[store.rows < first], store.rows[store.rows >= first]
    records = state.pixels.records[torch.from_numpy(own).to(state.scene.device), :RECORDS].cpu()
    poses, rows = state.frames.matrices(), own - first
    recordings: list[Recording] = []
    if store.opened is not None:
        recordings += moved_recordings(store.opened, poses[:first])
        records = same_length([*store.opened.records[torch.from_numpy(opened)], *records])
        rows = np.concatenate([store.opened.rows[opened], rows + store.opened.ends[-1]])
    if recording is not None:
        recordings.append(recording)
    keyframes = [each.changed(frame=int(row)) for row, each in zip(rows, store.keyframes, strict=True)]
    noise = {**store.noises, store.camera: state.noise.model.cpu()} if recording is not None else store.opened_noise
    content, anchors = store.content, _anchors(store, first)
    return KeyframeArchive(
        recordings, keyframes, store.links, records, content.edges, content.tried, noise, settings, anchors
    )


def _anchors(store: KeyframeStore, first: int) -> np.ndarray:
    """int64 [N, 2] as `KeyframeArchive` has them: of the opened map, whose frames come first, and of the run.

    Args:
        store: of the state.
        first: number of the state's first frame of the run; those before are the opened map's keyframes.
    """
    own = [(anchor.frame, anchor.reference) for anchor in store.anchors]
    if store.opened is None:
        return np.array(own, np.int64).reshape(-1, 2)
    # Of the opened map's keyframes, those that are kept, by their numbers now, and those that are not.
    references = {int(row): number for number, row in enumerate(store.rows) if row < first} | dict(own)
    before = [(frame, references[keyframe]) for frame, keyframe in store.opened.anchors.tolist()]
    rows, shift = store.opened.rows, int(store.opened.ends[-1]) - first
    now = [(rows[frame] if frame < first else frame + shift, reference) for frame, reference in own]
    return np.array(sorted([*before, *now]), np.int64).reshape(-1, 2)


def seen_by(records: torch.Tensor, own: Camera, keyframe: Keyframe, camera: Camera) -> torch.Tensor:
    """Pixels of a keyframe as another camera at the same place would have them.

    Args:
        records: int32 [P, 3] packed pixels of the keyframe's frame.
        own: its camera.
        keyframe: with the depth image.
        camera: the other camera.

    Returns:
        int32 [P', 3]: those that the other camera sees, at whole pixels of it with the depth there.
    """
    if own == camera:
        return records
    points = unpack_points(records, own)
    z = points[:, 2]
    safe = z.clamp(min=MIN_DEPTH_M)
    u = (points[:, 0] / safe * camera.fx + camera.cx).round()
    v = (points[:, 1] / safe * camera.fy + camera.cy).round()
    inside = (z > MIN_DEPTH_M) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v, z, words = u[inside], v[inside], z[inside], records[inside, 2]
    depth = _depth_at(keyframe, (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, z)
    places = u.to(torch.int32) | (v.to(torch.int32) << 16)
    return torch.stack([places, depth.view(torch.int32), words], 1)


def _depth_at(keyframe: Keyframe, x: torch.Tensor, y: torch.Tensor, otherwise: torch.Tensor) -> torch.Tensor:
    """Depth float32 [P] along rays (x, y, 1): inverse depth is linear on planes, so that is what is interpolated.

    Where the four pixels around are not of one surface, it is `otherwise`.
    """
    k, depth = keyframe.camera.camera, keyframe.depth_m
    height, width = depth.shape
    u, v = x * k.fx + k.cx, y * k.fy + k.cy
    inside = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    u, v = torch.where(inside, u, 0), torch.where(inside, v, 0)
    left, top = u.floor(), v.floor()
    a, b = u - left, v - top
    at, flat = (top * width + left).long(), depth.flatten()
    corners = torch.stack([flat[(at + step).clamp(max=len(flat) - 1)] for step in (0, 1, width, width + 1)])
    low, high = corners.amin(0), corners.amax(0)
    smooth = inside & (low > 0) & (high - low < SMOOTH_SHARE * high)
    inverse = 1 / corners.clamp(min=MIN_DEPTH_M)
    upper, lower = (1 - a) * inverse[0] + a * inverse[1], (1 - a) * inverse[2] + a * inverse[3]
    return torch.where(smooth, 1 / ((1 - b) * upper + b * lower), otherwise)


def _thumbnail(keyframe: Keyframe, camera: Camera) -> torch.Tensor:
    """float16 [h, w] depth (m) at every `THUMBNAIL_STEP_PX`-th pixel of a camera at the keyframe's place, 0 unknown."""
    offset, k, depth = THUMBNAIL_STEP_PX // 2, keyframe.camera.camera, keyframe.depth_m
    v, u = (torch.arange(offset, size, THUMBNAIL_STEP_PX) for size in (camera.height, camera.width))
    row = ((v - camera.cy) / camera.fy * k.fy + k.cy).round().long()
    column = ((u - camera.cx) / camera.fx * k.fx + k.cx).round().long()
    rows_inside, columns_inside = (row >= 0) & (row < k.height), (column >= 0) & (column < k.width)
    seen = depth[row.clamp(0, k.height - 1)][:, column.clamp(0, k.width - 1)]
    return (seen * (rows_inside[:, None] & columns_inside[None])).half()
