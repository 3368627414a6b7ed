"""Files of named tensors with a JSON header: what maps, checkpoints and priors are stored in."""

import contextlib
import json
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch

from spslam.errors import OutputError, SpslamError, brief
from spslam.io import atomic_write
from spslam.reading import parse_json
from spslam.tensor_rules import Layout, TensorSchema

# A single metadata key: safetensors does not keep the order of several.
_HEADER = "spslam"
# Names, dtypes and shapes of all tensors, and our own header: 2 kB of a map, 4 kB of a checkpoint.
_MAX_HEADER_BYTES = 1 << 20
_MAX_WHOLE = 2**63 - 1
_DTYPES = {
    "BOOL": torch.bool,
    "F16": torch.float16,
    "F32": torch.float32,
    "F64": torch.float64,
    "I32": torch.int32,
    "I64": torch.int64,
    "U8": torch.uint8,
    "U16": torch.uint16,
}


@dataclass(frozen=True)
class TensorFile:
    """A kind of file.

    Attributes:
        what: what a file of the kind is, for messages.
        schema: what its tensors must be.
        version: what the header must say under `format`; None where it need not say anything.
        header: name of the header.
        error: what is raised about a file that isn't one.
    """

    what: str
    schema: TensorSchema
    version: str | None = None
    header: str = _HEADER
    error: type[SpslamError] = SpslamError


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


def load_header(path: str | Path, kind: TensorFile) -> dict[str, Any]:
    """The JSON header of a file, {} where it has none; reads no tensor.

    Args:
        path: the file.
        kind: what it must be.

    Raises:
        SpslamError: of class `kind.error`: no such file, not readable, or of another kind. One line that names it.
    """
    path = Path(path)
    if not path.is_file():
        raise kind.error(f"{path}: no such {kind.what} file")
    with _faults_of(path, kind):
        _check_header_size(path)
        with safetensors.safe_open(path, framework="pt") as file:
            header = parse_json((file.metadata() or {}).get(kind.header, "{}"), kind.header, ValueError)
    if kind.version is not None and header.get("format") != kind.version:
        raise kind.error(f"{path}: not a {kind.what} of format {kind.version}")
    return header


def load_tensors(
    path: str | Path, kind: TensorFile, sizes: Mapping[str, int], prefix: str = ""
) -> dict[str, torch.Tensor]:
    """Reads the tensors of a file whose header was read by `load_header`, and checks them.

    Names, dtypes and shapes are checked before any tensor is read, then all values.

    Args:
        path: the file.
        kind: what it must be.
        sizes: those of the schema that are known beforehand, by name.
        prefix: what the names in the file begin with, beside those of the schema.

    Returns:
        The schema's tensors by name, views of the file's memory: copy what must outlast a change of the file.

    Raises:
        SpslamError: of class `kind.error`: not readable, or a tensor is missing or not what the schema says. One line
            that names the file.
    """
    path, rules = Path(path), kind.schema.rules
    with _faults_of(path, kind), safetensors.safe_open(path, framework="pt") as file:
        inside = {name.removeprefix(prefix): name for name in file.keys() if name.startswith(prefix)}  # noqa: SIM118 - no dict
        layouts = {name: _layout(file.get_slice(inside[name])) for name in inside if name in rules}
        kind.schema.check_layouts(layouts, sizes)
        tensors = {name: file.get_tensor(inside[name]) for name in layouts}
        kind.schema.check(tensors, sizes)
    return tensors


def whole_number(values: Mapping[str, Any], name: str, low: int = 0, high: int = _MAX_WHOLE) -> int:
    """A whole number of a header; raises ValueError where it is missing, something else or out of range."""
    value = values.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ValueError(f"{name} must be a whole number from {low} to {high}, got {_shown(value)}")
    return value


def finite_number(values: Mapping[str, Any], name: str, low: float) -> float:
    """A number of a header; raises ValueError where it is missing, something else, below `low` or not finite."""
    value = values.get(name)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not low <= value < math.inf:
        raise ValueError(f"{name} must be a finite number of at least {low:g}, got {_shown(value)}")
    return float(value)


def _shown(value: Any) -> str:
    return repr(brief(value)) if isinstance(value, str) else brief(value)


@contextlib.contextmanager
def _faults_of(path: Path, kind: TensorFile) -> Iterator[None]:
    """Turns whatever is wrong with a file into one line that names it."""
    try:
        yield
    except (safetensors.SafetensorError, ValueError, OSError) as fault:
        raise kind.error(f"{path}: not a readable {kind.what} ({brief(str(fault), 200)})") from None
    except SpslamError as fault:
        raise kind.error(f"{path}: a damaged {kind.what} ({fault})") from None


def _check_header_size(path: Path) -> None:
    """The size comes first in the file; the parser would take any up to 100 MB."""
    with path.open("rb") as file:
        (size,) = struct.unpack("<Q", file.read(8).ljust(8, b"\0"))
    if size > _MAX_HEADER_BYTES:
        raise ValueError(f"its header must have at most {_MAX_HEADER_BYTES} bytes, got {size}")


def _layout(tensor: Any) -> Layout:
    """Dtype and shape of a tensor that has not been read."""
    dtype = tensor.get_dtype()
    if dtype not in _DTYPES:
        raise ValueError(f"it holds numbers of the unknown type {dtype}")
    return _DTYPES[dtype], tuple(tensor.get_shape())
