"""Ways to spoil JSON values and files of named tensors that know how these are built."""

from __future__ import annotations

import copy
import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any

import numpy as np

from tests.fuzz.mutations import INTERESTING, NUMBERS, WORDS, any_integer, mutate_bytes, mutate_text

VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        0.5,
        1e308,
        -1e308,
        1e-320,
        math.nan,
        math.inf,
        -math.inf,
        2**31,
        2**63,
        2**64,
        10**30,
    ),
    *(
        "",
        "0",
        "text",
        "1e5",
        "\0",
        "\ud800",
        "A" * 1000,
        [],
        {},
        [[]],
        [0, 1, 2],
        {"a": 1},
        {"format": "spslam-map-1"},
    ),
)
TYPES = {"BOOL": 1, "U8": 1, "I8": 1, "U16": 2, "I16": 2, "F16": 2, "BF16": 2, "U32": 4, "I32": 4, "F32": 4, "I64": 8}
TYPES |= {"U64": 8, "F64": 8}
_NUMPY = {"BOOL": "u1", "U8": "u1", "U16": "<u2", "F16": "<f2", "I32": "<i4", "F32": "<f4", "I64": "<i8", "F64": "<f8"}


def mutate_value(random: Random, value: Any, times: int | None = None) -> Any:
    """A copy of a JSON value, spoiled at a few places: other values, keys more or less, deep nesting."""
    value = copy.deepcopy(value)
    for _ in range(times or random.choice((1, 1, 1, 2, 3))):
        value = _spoil(random, value)
    return value


def mutate_json(random: Random, value: Any) -> str:
    """The text of a JSON value that was spoiled as a value, as a text, or as both."""
    kind = random.random()
    if kind < 0.7:
        value = mutate_value(random, value)
    text = json.dumps(value) if random.random() < 0.7 else json.dumps(value, indent=1, ensure_ascii=False)
    if kind < 0.05:
        opening = random.choice(("[", '{"a":', "[[0,"))
        text = text.replace(random.choice(("1", "0", '"', "{")), opening * random.choice((10, 900, 5000, 100_000)), 1)
    return mutate_text(random, text) if kind >= 0.6 else text


def _spoil(random: Random, value: Any) -> Any:
    if isinstance(value, dict) and value and random.random() < 0.9:
        key = random.choice(list(value))
        kind = random.random()
        if kind < 0.1:
            del value[key]
        elif kind < 0.15:
            value[random.choice(("a", "", "format", "settings", "next", key + "_"))] = _any_value(random)
        elif kind < 0.2:
            value[random.choice(list(value))] = copy.deepcopy(value[key])
        else:
            value[key] = _spoil(random, value[key])
        return value
    if isinstance(value, list) and value and random.random() < 0.8:
        place = random.randrange(len(value))
        if random.random() < 0.2:
            value[place : place + 1] = copy.deepcopy(random.choice(([], value * random.choice((2, 50)), [value])))
        else:
            value[place] = _spoil(random, value[place])
        return value
    if isinstance(value, (int, float)) and not isinstance(value, bool) and random.random() < 0.6:
        return random.choice((value + 1, value - 1, -value, _scaled(random, value), random.choice(INTERESTING)))
    return _any_value(random)


def _scaled(random: Random, value: float) -> float:
    factor = random.choice((0.5, 2, 10, 1000, 1e-3))
    # A whole number too large for a float has no half.
    return value * factor if isinstance(factor, int) or abs(value) < 1e300 else value * 10


def _any_value(random: Random) -> Any:
    return copy.deepcopy(random.choice(random.choice((VALUES, VALUES, NUMBERS, WORDS))))


@dataclass
class StoredTensor:
    """A tensor as a file has it.

    Attributes:
        dtype: safetensors' name.
        shape: what the header says.
        content: bytes; little-endian.
        shift: added to where the header says that it begins and ends.
    """

    dtype: str
    shape: list[int]
    content: bytes
    shift: tuple[int, int] = (0, 0)


@dataclass
class TensorFileContent:
    """A safetensors file in parts: tensors by name, metadata by key, and what the size of the header is off by."""

    tensors: dict[str, StoredTensor] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)
    header_shift: int = 0

    @classmethod
    def parse(cls, content: bytes) -> TensorFileContent:
        """The parts of a good file whose metadata are JSON texts."""
        (size,) = struct.unpack_from("<Q", content)
        header = json.loads(content[8 : 8 + size])
        metadata = {key: json.loads(text) for key, text in header.pop("__metadata__", {}).items()}
        tensors = {
            name: StoredTensor(entry["dtype"], entry["shape"], content[8 + size :][slice(*entry["data_offsets"])])
            for name, entry in header.items()
        }
        return cls(tensors, metadata)

    def build(self, random: Random) -> bytes:
        """The file; `random` may spoil the texts of its metadata."""
        header: dict[str, Any] = {
            "__metadata__": {
                key: mutate_json(random, value) if random.random() < 0.05 else json.dumps(value)
                for key, value in self.metadata.items()
            }
        }
        place = 0
        for name, tensor in self.tensors.items():
            end = place + len(tensor.content)
            header[name] = {
                "dtype": tensor.dtype,
                "shape": tensor.shape,
                "data_offsets": [place + tensor.shift[0], end + tensor.shift[1]],
            }
            place = end
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 8)
        body = b"".join(tensor.content for tensor in self.tensors.values())
        return struct.pack("<Q", (len(text) + self.header_shift) % 2**64) + text + body


def mutate_tensors(random: Random, content: bytes, others: Sequence[bytes] = ()) -> bytes:
    """A file of named tensors, spoiled in its bytes, its header, its shapes or its values."""
    if random.random() < 0.2:
        return mutate_bytes(random, content, others)
    parts = TensorFileContent.parse(content)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        random.choice(_TENSOR_MUTATIONS)(random, parts)
    built = parts.build(random)
    return mutate_bytes(random, built, others, 1) if random.random() < 0.05 else built


def _any_tensor(random: Random, parts: TensorFileContent) -> StoredTensor:
    """One of them; empty where there is none left."""
    return random.choice(list(parts.tensors.values()) or [StoredTensor("F32", [0], b"")])


def _edit_metadata(random: Random, parts: TensorFileContent) -> None:
    parts.metadata = {key: mutate_value(random, value) for key, value in parts.metadata.items()}
    if random.random() < 0.05:
        parts.metadata = {"other": {}}


def _edit_header(random: Random, parts: TensorFileContent) -> None:
    tensor = _any_tensor(random, parts)
    match random.randrange(6):
        case 0:
            tensor.dtype = random.choice(list(TYPES))
        case 1 if tensor.shape:
            tensor.shape[random.randrange(len(tensor.shape))] = random.choice(INTERESTING)
        case 2:
            tensor.shape = [random.choice((0, 1, 2, 3, 2**32, 2**63 - 1)) for _ in range(random.randrange(6))]
        case 3:
            tensor.shift = random.choice(INTERESTING), random.choice(INTERESTING)
        case 4:
            tensor.shift = (0, random.choice((-8, -4, -1, 1, 4, 8)))
        case _:
            parts.header_shift = random.choice((-8, -1, 1, 8, *INTERESTING))


def _edit_names(random: Random, parts: TensorFileContent) -> None:
    if not parts.tensors:
        return
    name = random.choice(list(parts.tensors))
    tensor = parts.tensors[name]
    if random.random() < 0.5:
        del parts.tensors[name]
    if random.random() < 0.7:
        parts.tensors[random.choice((name + "_", "", "\0", "__metadata", *parts.tensors, name))] = copy.deepcopy(tensor)


def _resize(random: Random, parts: TensorFileContent) -> None:
    """Fewer or more rows, and a shape that says so."""
    tensor = _any_tensor(random, parts)
    width = TYPES.get(tensor.dtype, 4) * math.prod(tensor.shape[1:])
    if not tensor.shape or not 0 < width * tensor.shape[0] <= 2 * len(tensor.content):
        return
    rows = max(tensor.shape[0] + random.choice((-1, 1, -tensor.shape[0], 2, 100, -(tensor.shape[0] // 2))), 0)
    tensor.content = (tensor.content * 2 + bytes(rows * width))[: rows * width]
    tensor.shape[0] = rows


def _edit_values(random: Random, parts: TensorFileContent) -> None:
    """Other numbers at a few places, or everywhere."""
    tensor = _any_tensor(random, parts)
    if tensor.dtype not in _NUMPY or not tensor.content or len(tensor.content) % TYPES[tensor.dtype]:
        return
    values = np.frombuffer(tensor.content, _NUMPY[tensor.dtype]).copy()
    count = random.choice((1, 1, 2, 15, len(values)))
    places = [random.randrange(len(values)) for _ in range(min(count, 1000))]
    with np.errstate(all="ignore"):
        if values.dtype.kind == "f":
            new = random.choice((0.0, -1.0, 1.0, 1e-38, 1e4, 1e38, -1e38, math.nan, math.inf, random.gauss(0, 1)))
            if count < len(values):
                values[places] = new
            else:
                values *= values.dtype.type(random.choice((new, 0.0, -1.0, 10.0, 1e10, 1e-10)))
        else:
            bits, signed = 8 * values.itemsize, values.dtype.kind == "i"
            values[places] = np.array([any_integer(random, bits, signed) for _ in places]).astype(values.dtype)
            if random.random() < 0.2 and values.itemsize > 1:
                values += values.dtype.type(random.choice((1, 2, 1000)))
    tensor.content = values.tobytes()


_TENSOR_MUTATIONS = (_edit_metadata, _edit_metadata, _edit_header, _edit_names, _resize, *(_edit_values,) * 4)
