"""Files of named tensors with a JSON header: what maps and checkpoints are stored in."""

import json
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch

from spslam.errors import OutputError, SpslamError
from spslam.io import atomic_write

# A single metadata key: safetensors does not keep the order of several.
_HEADER = "spslam"


def save_tensors(path: str | Path, tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> None:
    """Writes one safetensors file, atomically; the same content gives the same bytes.

    Args:
        path: the file.
        tensors: on the CPU, contiguous. They are not copied on the way to the file.
        header: JSON object; its key `format` says what the file is.

    Raises:
        OutputError: the file can't be written; what was there before is left as it was.
    """
    metadata = {_HEADER: json.dumps(header, sort_keys=True)}

    def write(temporary: Path) -> None:
        try:
            safetensors.torch.save_file(tensors, temporary, metadata=metadata)
        except safetensors.SafetensorError as error:
            raise OutputError(f"{path}: can't be written: {error}") from None

    atomic_write(path, write)


def load_tensors(path: str | Path, file_format: str, what: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Reads a file of `save_tensors`.

    Args:
        path: the file.
        file_format: what the header must say.
        what: what the file should be, for the message.

    Returns:
        Tensors by name, and the header.

    Raises:
        SpslamError: no such file, truncated, or of another format.
    """
    if not Path(path).is_file():
        raise SpslamError(f"{path}: no such {what} file")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get(_HEADER, "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    except (safetensors.SafetensorError, ValueError, OSError) as error:
        raise SpslamError(f"{path}: not a readable {what} ({error})") from None
    if not isinstance(header, dict) or header.get("format") != file_format:
        raise SpslamError(f"{path}: not a {what} of format {file_format}")
    return tensors, header
