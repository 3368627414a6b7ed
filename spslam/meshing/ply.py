"""The one kind of PLY that is written here: binary, triangles, vertices with normals and colors."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from spslam.meshing.mesh import TriangleMesh

_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
_FACE = np.dtype([("count", "u1"), ("indices", "<i4", 3)])
_CORNERS = 3
_PROPERTIES = (
    *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
    *(f"property uchar {name}" for name in ("red", "green", "blue")),
)
_HEADER = "\n".join(
    (
        "ply",
        "format binary_little_endian 1.0",
        "element vertex {vertices}",
        *_PROPERTIES,
        "element face {faces}",
        "property list uchar int vertex_indices",
        "end_header\n",
    )
)
_MAX_DIGITS = 12  # of a count
_OWN_HEADER = re.compile(
    re.escape(_HEADER)
    .replace(re.escape("{vertices}"), rf"(\d{{1,{_MAX_DIGITS}}})")
    .replace(re.escape("{faces}"), rf"(\d{{1,{_MAX_DIGITS}}})")
    .encode()
)


def encode_ply(mesh: TriangleMesh) -> bytes:
    """Binary PLY. Not by trimesh: this takes 0.5 s for two million faces, and supports a mesh without faces."""
    vertices = np.empty(len(mesh.vertices), dtype=_VERTEX)
    vertices["position"], vertices["normal"], vertices["color"] = mesh.vertices, mesh.normals, mesh.colors
    faces = np.empty(len(mesh.faces), dtype=_FACE)
    faces["count"], faces["indices"] = _CORNERS, mesh.faces
    header = _HEADER.format(vertices=len(vertices), faces=len(faces))
    return header.encode() + vertices.tobytes() + faces.tobytes()


def decode_own_ply(content: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Reads what `encode_ply` made, without trimesh, whose import alone takes longer than writing a report's charts.

    Args:
        content: of a PLY file of any origin.

    Returns:
        Vertices float64 [V, 3], faces int64 [F, 3] and colors uint8 [V, 3], unchecked; None for any other PLY, or for
        one that is damaged.
    """
    header = _OWN_HEADER.match(content)
    if header is None:
        return None
    num_vertices, num_faces = map(int, header.groups())
    begin = header.end()
    middle = begin + num_vertices * _VERTEX.itemsize
    if len(content) != middle + num_faces * _FACE.itemsize:
        return None
    vertices = np.frombuffer(content, _VERTEX, num_vertices, begin)
    faces = np.frombuffer(content, _FACE, num_faces, middle)
    if not (faces["count"] == _CORNERS).all():
        return None
    return (
        vertices["position"].astype(np.float64),
        faces["indices"].astype(np.int64),
        np.ascontiguousarray(vertices["color"]),
    )
