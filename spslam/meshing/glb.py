"""Binary glTF 2.0: the file of any content, and that of a mesh with colors of vertices."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from spslam.meshing.mesh import TriangleMesh

# Numbers of the glTF 2.0 specification.
FLOAT, UINT, VERTEX_DATA, INDICES = 5126, 5125, 34962, 34963
_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", 2, b"JSON", b"BIN\0"
_HEAD = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_MAX_OWN_HEADER = 4096  # bytes; a mesh's has some 1,000
_LEVELS = np.arange(256) / 255
# Colors of vertices are linear in glTF, those of images and of other formats are as sRGB has them. As floats, since 8
# bits of linear colors have too few dark ones, and some programs take 16 bits for 8.
_LINEAR = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype("<f4")


class GlbBinary:
    """The binary part of a GLB as it grows, and what says where its arrays are.

    Attributes:
        parts: its bytes, in order.
        size: number of them.
        views: JSON of the views so far.
        accessors: JSON of the accessors so far.
    """

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        """The number of the view of new content."""
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(content)}
        self.views.append(view if target is None else view | {"target": target})
        self.parts.append(content + b"\0" * (-len(content) % 4))
        self.size += len(self.parts[-1])
        return len(self.views) - 1

    def accessor(self, array: np.ndarray, component: int, kind: str, target: int) -> int:
        """The number of the accessor of a new array."""
        view = self.view(np.ascontiguousarray(array).tobytes(), target)
        self.accessors.append({"bufferView": view, "componentType": component, "count": len(array), "type": kind})
        return len(self.accessors) - 1

    def positions(self, vertices: np.ndarray) -> int:
        """The number of the accessor of vertices float32 [V, 3], with their bounds, which positions must have."""
        number = self.accessor(vertices.astype("<f4"), FLOAT, "VEC3", VERTEX_DATA)
        self.accessors[number] |= {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
        return number


def encode_document(primitives: list[dict[str, Any]], binary: GlbBinary, more: dict[str, Any]) -> bytes:
    """A binary glTF 2.0 of one mesh.

    Args:
        primitives: of the mesh.
        binary: what they refer to.
        more: what else the document has, such as materials.
    """
    document = {
        "asset": {"version": "2.0", "generator": "spslam"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "accessors": binary.accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": binary.size}],
        **more,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = [(_JSON_CHUNK, text + b" " * (-len(text) % 4)), (_BINARY_CHUNK, b"".join(binary.parts))]
    body = b"".join(_CHUNK.pack(len(content), kind) + content for kind, content in chunks)
    return _HEAD.pack(_MAGIC, _VERSION, _HEAD.size + len(body)) + body


def encode_glb(mesh: TriangleMesh) -> bytes:
    """Binary glTF of a mesh with at least one face: its vertices with normals and colors, which glTF has linear."""
    return _encoded(mesh.vertices, mesh.normals, _LINEAR[mesh.colors], mesh.faces)


def _encoded(vertices: np.ndarray, normals: np.ndarray, linear: np.ndarray, faces: np.ndarray) -> bytes:
    binary = GlbBinary()
    attributes = {
        "POSITION": binary.positions(vertices),
        "NORMAL": binary.accessor(normals.astype("<f4"), FLOAT, "VEC3", VERTEX_DATA),
        "COLOR_0": binary.accessor(linear, FLOAT, "VEC3", VERTEX_DATA),
    }
    indices = binary.accessor(faces.astype("<u4").reshape(-1, 1), UINT, "SCALAR", INDICES)
    return encode_document([{"attributes": attributes, "indices": indices}], binary, {})


def decode_own_glb(content: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Reads what `encode_glb` made; other readers take its linear colors, rounded to 8 bits, for those of images.

    Args:
        content: of a GLB file of any origin.

    Returns:
        Vertices float64 [V, 3], faces int64 [L, 3] and colors uint8 [V, 3], unchecked; None for any other GLB, or for
        one that is damaged.
    """
    begin = _HEAD.size + _CHUNK.size
    if len(content) < begin or content[:4] != _MAGIC:
        return None
    length, _ = _CHUNK.unpack_from(content, _HEAD.size)
    if length > _MAX_OWN_HEADER:
        return None
    try:
        accessors = json.loads(content[begin : begin + length])["accessors"]
        num_vertices, num_indices = (int(accessors[number]["count"]) for number in (0, 3))
    except (ValueError, LookupError, TypeError, OverflowError, RecursionError):
        return None
    begin += length + _CHUNK.size
    if min(num_vertices, num_indices) < 1 or len(content) != begin + 36 * num_vertices + 4 * num_indices:
        return None
    vertices, normals, linear = np.frombuffer(content, "<f4", 9 * num_vertices, begin).reshape(3, num_vertices, 3)
    indices = np.frombuffer(content, "<u4", num_indices, begin + 36 * num_vertices)
    if num_indices % 3 or _encoded(vertices, normals, linear, indices) != content:
        return None
    colors = np.searchsorted(_LINEAR, linear).clip(max=255).astype(np.uint8)
    return vertices.astype(np.float64), indices.reshape(-1, 3).astype(np.int64), colors
