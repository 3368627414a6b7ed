"""Arrays and meshes in the text of a web page: quantized, deflated and encoded in base64.

`web/unpack.js` is the other side.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from spslam.meshing import Mesh

# The types of a page's arrays by those of NumPy.
_ARRAY_TYPES = {"uint8": "Uint8Array", "uint32": "Uint32Array", "float32": "Float32Array"}
_MAX_STEPS = (1 << 16) - 1
_MAX_VERTICES = 1 << 24
_LEVEL = 4  # of zlib; 6 takes more than twice as long, for 2.4 % of a mesh's size


def encode_bytes(data: bytes) -> str:
    """Deflates bytes (zlib's format, `deflate` of `DecompressionStream`) and encodes them in base64."""
    return base64.b64encode(zlib.compress(data, _LEVEL)).decode()


def encode_json(value: Any) -> str:
    """JSON for a script element: no part of it can end the element or begin a comment."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Packs arrays into one text.

    Args:
        arrays: of uint8, uint32 or float32; any shape, flattened.

    Returns:
        `arrays`: [name, type in JavaScript, number of elements] of each, those of larger elements first, so that each
        is aligned. `data`: all of them, little-endian, by `encode_bytes`.

    Raises:
        ValueError: an array of another type.
    """
    for name, array in arrays.items():
        if array.dtype.name not in _ARRAY_TYPES:
            raise ValueError(f"pack_arrays: {name} must be of {', '.join(_ARRAY_TYPES)}, got {array.dtype.name}")
    ordered = sorted(arrays.items(), key=lambda item: -item[1].dtype.itemsize)
    content = b"".join(array.astype(array.dtype.newbyteorder("<")).tobytes() for _, array in ordered)
    names = [[name, _ARRAY_TYPES[array.dtype.name], int(array.size)] for name, array in ordered]
    return {"arrays": names, "data": encode_bytes(content)}


def pack_mesh(mesh: Mesh) -> dict[str, Any]:
    """Packs a mesh: positions of 16 bits per axis, colors, and faces, about 6 bytes of text per face.

    Vertices are numbered by their first use in faces that are sorted in space, so that what is stored are small
    differences: to the vertex before (zigzag-coded, modulo 2^16 and 2^8), and from the highest index so far down to
    each corner of a face. Bytes of the same significance are next to each other.

    Args:
        mesh: with at least one face, all vertices used or not.

    Returns:
        `vertices`, `faces`: numbers of them. `origin` [3] and `step`: meters of the corner and of a step of the grid
        that positions are on. `arrays` and `data` as of `pack_arrays`: `positions` [3, 2, V], `colors` [3, V],
        `corners` [3, 3 F], bytes.

    Raises:
        ValueError: no face, or more vertices than 24 bits number.
    """
    if not len(mesh.faces) or len(mesh.vertices) >= _MAX_VERTICES:
        raise ValueError(f"pack_mesh: must have a face and fewer than {_MAX_VERTICES} vertices")
    origin = mesh.vertices.min(axis=0)
    step = max(float(np.ptp(mesh.vertices, axis=0).max()) / _MAX_STEPS, 1e-9)
    grid = np.rint((mesh.vertices - origin) / step).astype(np.int64)
    faces, order = _in_order_of_use(mesh.faces, _morton_rank(grid))
    positions = _zigzag(np.diff(grid[order], axis=0, prepend=0), 16).T
    colors = _zigzag(np.diff(mesh.colors[order].astype(np.int64), axis=0, prepend=0), 8).T
    highest = np.concatenate([[-1], np.maximum.accumulate(faces.reshape(-1))[:-1]])
    corners = highest + 1 - faces.reshape(-1)
    arrays = {
        "positions": np.stack([positions & 255, positions >> 8], axis=1).astype(np.uint8),
        "colors": colors.astype(np.uint8),
        "corners": np.stack([corners & 255, corners >> 8 & 255, corners >> 16]).astype(np.uint8),
    }
    counts = {"vertices": len(order), "faces": len(faces)}
    return {**counts, "origin": origin.tolist(), "step": step, **pack_arrays(arrays)}


def _zigzag(differences: np.ndarray, bits: int) -> np.ndarray:
    """Differences modulo 2^bits as numbers from 0: 0, -1, 1, -2, ... become 0, 1, 2, 3, ..."""
    half = 1 << (bits - 1)
    signed = (differences + half) % (2 * half) - half
    return np.where(signed < 0, -2 * signed - 1, 2 * signed)


def _morton_rank(grid: np.ndarray) -> np.ndarray:
    """Rank of each vertex on a space-filling curve, from grid positions [V, 3] of 16 bits."""
    code = np.zeros(len(grid), dtype=np.int64)
    for bit in range(16):
        for axis in range(3):
            code |= (grid[:, axis] >> bit & 1) << (3 * bit + axis)
    rank = np.empty(len(grid), dtype=np.int64)
    rank[np.argsort(code, kind="stable")] = np.arange(len(grid))
    return rank


def _in_order_of_use(faces: np.ndarray, rank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces sorted by the ranks of their vertices, with vertices numbered by first use, and the old number of each."""
    ranks = np.sort(rank[faces], axis=1)
    faces = faces[np.lexsort((ranks[:, 2], ranks[:, 1], ranks[:, 0]))]
    used, first, inverse = np.unique(faces.reshape(-1), return_index=True, return_inverse=True)
    by_use = np.argsort(first, kind="stable")
    number = np.empty(len(used), dtype=np.int64)
    number[by_use] = np.arange(len(used))
    return number[inverse.reshape(-1)].reshape(-1, 3), used[by_use]
