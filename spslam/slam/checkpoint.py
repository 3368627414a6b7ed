"""Saving and restoring the system's state, so that a resumed run gives bit-identical results.

One safetensors file, written to a temporary file, synced and renamed: a kill at any moment leaves the last whole one.
"""

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.config import Config
from spslam.errors import OutputError, SpslamError, brief
from spslam.scene.scene import TENSOR_SIZES
from spslam.slam.depth_history import cell_shape
from spslam.slam.depth_keyframes import depth_image_shape
from spslam.slam.device_events import host_copy
from spslam.slam.recovery.pose_confidence import shipped_constants
from spslam.slam.state import Moments, Segment, SlamState, UnjoinedFrames, keeps_moments
from spslam.tensor_file import TensorFile, finite_number, load_header, load_tensors, save_tensors, whole_number
from spslam.tensor_schema import CHECKPOINT

FORMAT = "spslam-checkpoint-11"
_FILE = TensorFile("checkpoint", CHECKPOINT, FORMAT, error=OutputError)
# The ops number iterations up to 2^30; this many leave room to continue.
_MOST_ITERATIONS = 2**29


def fingerprint(config: Config) -> str:
    """Identifies what decides a run's result; device, limits, checkpoint intervals and outputs do not take part."""
    content = config.model_dump(mode="json")
    for section in ("device", "preset", "run", "mesh"):
        content.pop(section)
    content["dataset"].pop("path")
    weights = content["prior"]["weights"]
    content["prior"]["weights"] = None if weights is None else os.path.abspath(weights)  # as config.yaml has it
    # A run that reached a limit can continue when the limit is raised.
    for limit in ("max_voxels", "max_texels"):
        content["scene"].pop(limit)
    content["pose_confidence"] = dict(shipped_constants())
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


_SEGMENT = "segment."  # before the names of a segment's tensors

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
        source: JSON object that names the data and where to continue, returned by `load_checkpoint`.
        copy: whether the snapshot must outlast further frames; else it shares the state's memory.
    """
    tensors = {
        **_prefixed("scene.", state.scene.tensors()),
        **_prefixed("frames.", state.frames.tensors()),
        **_prefixed("pixels.", {"records": state.pixels.records, "has_pixels": state.pixels.has_pixels}),
    }
    tensors.update(_prefixed("unjoined.", _unjoined_tensors(state.unjoined)))
    tensors.update(_prefixed("noise.", state.noise.tensors()))
    tensors.update(_prefixed("features.", state.features.tensors()))
    if state.newest is not None:
        tensors.update(_prefixed("newest.", state.newest.tensors()))
    if state.depth_keyframes is not None:
        tensors.update(_prefixed("depth_keyframes.", state.depth_keyframes.tensors()))
    if state.depth_history is not None:
        tensors.update(_prefixed("depth_history.", state.depth_history.tensors()))
    if state.graph is not None:
        tensors.update(_prefixed("graph.", state.graph.tensors()))
    # Moments that the next mapping call resets anyway need no place.
    for name, moments in state.moments.items():
        if keeps_moments(config, name):
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
        "opened": state.frames.opened,
        "source": source,
    }
    if state.segment is not None:
        inner = take_snapshot(state.segment.state, config, {}, copy)
        tensors.update(_prefixed(_SEGMENT, inner.tensors))
        header["segment"] = {"first": state.segment.first, "before": state.segment.before, **inner.header}
    return Snapshot(tensors, header)


def write_snapshot(path: Path, snapshot: Snapshot) -> None:
    """Writes a checkpoint; on CUDA it waits for the current stream.

    Raises:
        OutputError: the file can't be written; the checkpoint before is left as it was.
    """
    tensors = {name: host_copy(tensor.detach()) for name, tensor in snapshot.tensors.items()}
    save_tensors(path, tensors, snapshot.header)


def read_source(path: Path) -> dict[str, Any]:
    """The `source` object of a checkpoint, not checked; raises OutputError where there is no readable checkpoint."""
    source = load_header(path, _FILE).get("source")
    return source if isinstance(source, dict) else {}


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
    header = load_header(path, _FILE)
    # First: the shapes of a run with other settings differ as well.
    if header.get("config") != fingerprint(config):
        raise OutputError(f"{path}: belongs to a run with other options; use the same ones, or another --output")
    tensors = load_tensors(path, _FILE, _sizes(state))
    try:
        opened = whole_number(header, "opened", high=len(tensors["frames.poses"]))
        source = _checked_source(header, len(tensors["frames.poses"]) - opened)
        _restore(state, tensors, header)
        if "segment" in header:
            _restore_segment(path, state, config, header["segment"])
        return source
    except (SpslamError, KeyError, TypeError, ValueError) as error:
        raise OutputError(f"{path}: a damaged checkpoint ({brief(str(error), 300)})") from None


def _restore(state: SlamState, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
    state.scene.load_state_dict(_section(tensors, "scene."))
    state.frames.load_state_dict(_section(tensors, "frames."))
    state.frames.opened = whole_number(header, "opened", high=len(state.frames))
    state.pixels.load_state_dict(_section(tensors, "pixels."))
    state.unjoined = _unjoined(_section(tensors, "unjoined."), len(tensors["frames.poses"]))
    state.noise.load_state_dict(_section(tensors, "noise."))
    state.features.load_state_dict(_section(tensors, "features."))
    if state.newest is not None:
        state.newest.load_state_dict(_section(tensors, "newest."))
    if state.depth_keyframes is not None:
        state.depth_keyframes.load_state_dict(_section(tensors, "depth_keyframes."))
    if state.depth_history is not None:
        state.depth_history.load_state_dict(_section(tensors, "depth_history."))
    if state.graph is not None:
        state.graph.load_state_dict(_section(tensors, "graph."))
    device = state.scene.device
    state.moments = {
        name.removesuffix(".first"): Moments.of(
            first.to(device, copy=True), tensors[f"moments.{name.removesuffix('.first')}.second"].to(device, copy=True)
        )
        for name, first in _section(tensors, "moments.").items()
        if name.endswith(".first")
    }
    state.steps, state.stamp = (whole_number(header, name, high=_MOST_ITERATIONS) for name in ("steps", "stamp"))
    if not isinstance(header.get("unmapped"), bool):
        raise ValueError(f"unmapped must be true or false, got {brief(header.get('unmapped'))}")
    state.unmapped = header["unmapped"]


def _restore_segment(path: Path, state: SlamState, config: Config, header: Any) -> None:
    """The segment of a state whose frames were restored; raises SpslamError or ValueError."""
    if not isinstance(header, dict):
        raise ValueError(f"segment must be an object, got {brief(header)}")
    inner = SlamState.start(config, state.frames.camera, np.eye(4), None, state.scene.device)
    tensors = load_tensors(path, _FILE, _sizes(inner), _SEGMENT)
    first = whole_number(header, "first", high=len(state.frames))
    before = whole_number(header, "before", high=first)
    if first - before + len(tensors["frames.poses"]) != len(state.frames):
        raise ValueError("a segment must end with the newest frame")
    _restore(inner, tensors, header)
    state.segment = Segment(first, inner, before)


def _unjoined_tensors(unjoined: list[UnjoinedFrames]) -> dict[str, torch.Tensor]:
    none = UnjoinedFrames(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 7))
    return {
        "rows": torch.cat([each.rows for each in (none, *unjoined)]),
        "poses": torch.cat([each.poses for each in (none, *unjoined)]),
        "counts": torch.tensor([len(each.rows) for each in unjoined], dtype=torch.int64),
    }


def _unjoined(tensors: dict[str, torch.Tensor], frames: int) -> list[UnjoinedFrames]:
    """Of a run of so many frames; raises ValueError where the tensors do not fit together."""
    counts, rows = tensors["counts"].tolist(), tensors["rows"]
    if sum(counts) != len(rows) or bool((rows >= frames).any()):
        raise ValueError("unjoined.counts must add up to the unjoined frames, and these must be frames of the run")
    parts = (tensors[name].clone().split(counts) for name in ("rows", "poses"))
    return [UnjoinedFrames(*each) for each in zip(*parts, strict=True)]


def _sizes(state: SlamState) -> dict[str, int]:
    """The sizes that `CHECKPOINT` leaves open."""
    _, rows, columns = state.frames.depth_thumbnails.shape
    cells = 0 if state.depth_history is None else len(state.depth_history.cells)
    cell_rows, cell_columns = cell_shape(state.frames.camera)
    images = 0 if state.depth_keyframes is None else len(state.depth_keyframes.images)
    image_rows, image_columns = depth_image_shape(state.frames.camera)
    return {
        **TENSOR_SIZES,
        "width": state.frames.camera.width,
        "height": state.frames.camera.height,
        "thumbnail_rows": rows,
        "thumbnail_columns": columns,
        "depth_histories": cells,
        "depth_cell_rows": cell_rows,
        "depth_cell_columns": cell_columns,
        "depth_images": images,
        "depth_image_rows": image_rows,
        "depth_image_columns": image_columns,
    }


def _checked_source(header: dict[str, Any], frames: int) -> dict[str, Any]:
    """What names the data and where to continue; raises ValueError."""
    source = header.get("source")
    clock = source.get("clock") if isinstance(source, dict) else None
    if not isinstance(source, dict) or not isinstance(clock, dict) or not isinstance(source.get("data"), dict):
        raise ValueError("source must contain data, next and clock")
    position = whole_number(source, "next", low=frames)
    whole_number(source["data"], "frames", low=position)
    whole_number(clock, "frames")
    for name in ("wall_s", "decode_s"):
        finite_number(clock, name, low=0)
    finite_number({"start_s": 0.0, **clock}, "start_s", low=0)
    if clock.keys() - {"frames", "wall_s", "decode_s", "start_s"}:
        raise ValueError("clock must contain frames, wall_s, decode_s and start_s alone")
    return source


def _prefixed(prefix: str, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {prefix + name: tensor for name, tensor in tensors.items()}


def _section(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
