"""Saving and restoring the system's state, so that a resumed run gives bit-identical results.

One safetensors file, written to a temporary file, synced and renamed: a kill at any moment leaves the last whole one.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from spslam.config import Config, read_shipped
from spslam.errors import OutputError, SpslamError
from spslam.scene.tensor_file import load_tensors, save_tensors
from spslam.slam.recovery.pose_confidence import MODEL_FILE
from spslam.slam.state import Moments, SlamState

FORMAT = "spslam-checkpoint-2"


def fingerprint(config: Config) -> str:
    """Identifies what decides a run's result; device, limits, checkpoint intervals and outputs do not take part."""
    content = config.model_dump(mode="json")
    for section in ("device", "preset", "run", "mesh"):
        content.pop(section)
    content["dataset"].pop("path")
    # A run that met a limit goes on when the limit is raised.
    for limit in ("max_voxels", "max_texels"):
        content["scene"].pop(limit)
    content["pose_confidence"] = read_shipped(MODEL_FILE)["constants"]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


# Rows of these are never changed once they are there, so a snapshot may share them.
_APPENDED_ONLY = ("scene.volume.voxel_coords", "frames.depth_thumbnails", "pixels.records")


@dataclass(frozen=True)
class Snapshot:
    """The state after a frame, on the device it was on.

    Attributes:
        tensors: by name.
        header: JSON object.
    """

    tensors: dict[str, torch.Tensor]
    header: dict[str, Any]


def take_snapshot(state: SlamState, config: Config, source: dict[str, Any], copy: bool) -> Snapshot:
    """The state as it will be when the device has done what it was given so far; the host waits for nothing.

    Args:
        state: after a whole frame.
        config: of the run.
        source: JSON object that names the data and where to go on, returned by `load_checkpoint`.
        copy: whether the snapshot must outlast further frames; else it shares the state's memory.
    """
    tensors = {
        **_prefixed("scene.", state.scene.tensors()),
        **_prefixed("frames.", state.frames.tensors()),
        **_prefixed("pixels.", {"records": state.pixels.records, "has_pixels": state.pixels.has_pixels}),
    }
    if state.depth_keyframes is not None:
        tensors.update(_prefixed("depth_keyframes.", state.depth_keyframes.tensors()))
    # Moments that the next mapping call resets anyway need no place.
    if not config.mapping.reset_moments:
        for name, moments in state.moments.items():
            tensors[f"moments.{name}.first"] = moments.first
            tensors[f"moments.{name}.second"] = moments.second
    if copy:
        tensors = {name: tensor if name in _APPENDED_ONLY else tensor.clone() for name, tensor in tensors.items()}
    header = {
        "format": FORMAT,
        "config": fingerprint(config),
        "steps": state.steps,
        "stamp": state.stamp,
        "unmapped": state.unmapped,
        "source": source,
    }
    return Snapshot(tensors, header)


def write_snapshot(path: Path, snapshot: Snapshot) -> None:
    """Writes a checkpoint; on CUDA it waits for the current stream.

    Raises:
        OutputError: the file can't be written; the checkpoint before is left as it was.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in snapshot.tensors.items()}
    save_tensors(path, tensors, snapshot.header)


def load_checkpoint(path: Path, state: SlamState, config: Config) -> dict[str, Any]:
    """Restores the state in place.

    Args:
        path: a file written by `write_snapshot`.
        state: a fresh state of the same configuration.
        config: of this run.

    Returns:
        The `source` object that was saved.

    Raises:
        OutputError: the file cannot be read, or belongs to a run with other options.
    """
    try:
        tensors, header = load_tensors(path, FORMAT, "checkpoint")
    except SpslamError as error:
        raise OutputError(str(error)) from None
    if header.get("config") != fingerprint(config):
        raise OutputError(f"{path}: belongs to a run with other options; use the same ones, or another --output")
    try:
        _restore(state, tensors, header)
        return header["source"]
    except (SpslamError, KeyError, TypeError, ValueError) as error:
        raise OutputError(f"{path}: a damaged checkpoint ({error})") from None


def _restore(state: SlamState, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
    state.scene.load_state_dict(_section(tensors, "scene."))
    state.frames.load_state_dict(_section(tensors, "frames."))
    state.pixels.load_state_dict(_section(tensors, "pixels."))
    if state.depth_keyframes is not None:
        state.depth_keyframes.load_state_dict(_section(tensors, "depth_keyframes."))
    device = state.scene.device
    state.moments = {
        name.removesuffix(".first"): Moments.of(
            first.to(device, copy=True), tensors[f"moments.{name.removesuffix('.first')}.second"].to(device, copy=True)
        )
        for name, first in _section(tensors, "moments.").items()
        if name.endswith(".first")
    }
    state.steps, state.stamp, state.unmapped = header["steps"], header["stamp"], header["unmapped"]


def _prefixed(prefix: str, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {prefix + name: tensor for name, tensor in tensors.items()}


def _section(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
