"""Saving and restoring the system's state, so that an interrupted run goes on to the same bytes.

One safetensors file, written to a temporary file, synced and renamed: a kill at any moment leaves the last whole one.
"""

import hashlib
import json
from pathlib import Path

import safetensors
import safetensors.torch
import torch

from spslam.config import Config
from spslam.errors import OutputError
from spslam.io import atomic_write
from spslam.slam.state import Moments, SlamState

FORMAT = "spslam-checkpoint-1"
_FRAME_COLUMNS = ("poses", "timestamps", "indices", "lost", "lattices")


def fingerprint(config: Config) -> str:
    """Identifies what decides a run's result; devices, threads and checkpoint intervals do not take part."""
    content = config.model_dump(mode="json")
    content["dataset"].pop("path", None)
    for section in ("run", "mesh"):
        content.pop(section, None)
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def save_checkpoint(path: Path, state: SlamState, config: Config, source: dict) -> None:
    """Writes the state.

    Args:
        path: the file.
        state: after a whole frame.
        config: of the run.
        source: JSON object that names the data and where to go on, returned by `load_checkpoint`.
    """
    tensors = {f"scene.{name}": tensor for name, tensor in state.scene.state_dict().items()}
    tensors |= {f"frames.{name}": getattr(state.frames, name).cpu().contiguous() for name in _FRAME_COLUMNS}
    tensors |= {f"pixels.{name}": tensor for name, tensor in state.pixels.state_dict().items()}
    for name, moments in state.moments.items():
        tensors[f"moments.{name}.first"] = moments.first.cpu()
        tensors[f"moments.{name}.second"] = moments.second.cpu()
    header = {
        "format": FORMAT,
        "config": fingerprint(config),
        "steps": state.steps,
        "stamp": state.stamp,
        "source": source,
    }
    atomic_write(path, safetensors.torch.save(tensors, metadata={"spslam": json.dumps(header, sort_keys=True)}))


def load_checkpoint(path: Path, state: SlamState, config: Config) -> dict:
    """Restores the state in place.

    Args:
        path: a file written by `save_checkpoint`.
        state: a fresh state of the same configuration.
        config: of this run.

    Returns:
        The `source` object that was saved.

    Raises:
        OutputError: the file cannot be read, or belongs to a run with other settings.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("spslam", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    except (safetensors.SafetensorError, ValueError, OSError) as error:
        raise OutputError(f"{path}: not a readable checkpoint ({error})") from None
    if header.get("format") != FORMAT:
        raise OutputError(f"{path}: not a checkpoint of format {FORMAT}")
    if header["config"] != fingerprint(config):
        raise OutputError(f"{path}: belongs to a run with other settings; use the same options, or another --output")
    device = state.scene.device
    state.scene.load_state_dict(_section(tensors, "scene."))
    for name, tensor in _section(tensors, "frames.").items():
        setattr(state.frames, name, tensor.to(getattr(state.frames, name).device))
    state.pixels.load_state_dict(_section(tensors, "pixels."))
    for name in sorted({key.split(".")[1] for key in tensors if key.startswith("moments.")}):
        moments = Moments.like(tensors[f"moments.{name}.first"].to(device))
        moments.first.copy_(tensors[f"moments.{name}.first"])
        moments.second.copy_(tensors[f"moments.{name}.second"])
        state.moments[name] = moments
    state.steps, state.stamp = header["steps"], header["stamp"]
    return header["source"]


def _section(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
