"""Meshes from files of any origin: counts are held against the file's size before they are believed."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spslam.errors import DatasetError, brief
from spslam.meshing.glb import decode_own_glb
from spslam.meshing.ply import decode_own_ply
from spslam.notebook import mesh_html
from spslam.reading import read_bytes

if TYPE_CHECKING:
    import trimesh

_OWN = {".ply": decode_own_ply, ".glb": decode_own_glb}
READ_FORMATS = (".ply", ".obj", ".glb", ".stl", ".off")
MAX_MESH_BYTES = 2 << 30
_HEADER_BYTES = 1 << 16
# Farther from the origin lies no scene in meters, and squares of lengths still are numbers there.
MAX_COORDINATE_M = 1e6
_SCALAR_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "float16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}
_GRAY = 102  # trimesh's, of meshes without colors
_TEXT_BYTES = 2  # of a number in a text: a digit and what separates it from the next


@dataclass(frozen=True)
class Mesh:
    """Triangles of a file.

    Attributes:
        vertices: float64 [V, 3], finite; m if the file is.
        faces: int64 [F, 3], indices of vertices.
        colors: uint8 [V, 3] RGB; gray where the file has none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray

    def _repr_html_(self) -> str:
        """What a notebook shows: the mesh, to be turned around with the mouse."""
        return mesh_html(self.vertices, self.faces, self.colors)


def load_mesh(path: Path) -> Mesh:
    """Reads a mesh; what else a file holds (materials, textures, other files that it names) is left alone.

    Args:
        path: one of `READ_FORMATS`.

    Returns:
        The mesh; an empty one where the file has no faces.

    Raises:
        DatasetError: no such file, another format, damaged, a count beyond what the file can hold, a face that names no
            vertex, or a coordinate that isn't finite or lies beyond `MAX_COORDINATE_M`. One line that names the file.
    """
    suffix = path.suffix.lower()
    if suffix not in READ_FORMATS:
        raise DatasetError(f"{path}: a mesh must be one of {', '.join(READ_FORMATS)}, got {suffix or 'no suffix'}")
    content = read_bytes(path, MAX_MESH_BYTES, DatasetError)
    try:
        own = _OWN[suffix](content) if suffix in _OWN else None
        vertices, faces, colors = own or _decode(content, suffix)
        if not len(faces):
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8))
        _check(vertices, faces)
        return Mesh(vertices, faces, colors)
    except Exception as error:  # trimesh raises whatever the parser stumbles over
        text = brief(str(error) or type(error).__name__, 200)
        raise DatasetError(f"{path}: can't be read as a mesh: {text}") from error


def _decode(content: bytes, suffix: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and colors of a file of any origin."""
    import trimesh

    if suffix == ".ply":
        _check_ply_counts(content)
    loaded = trimesh.load(io.BytesIO(content), file_type=suffix[1:], process=False, skip_materials=True)
    mesh = _as_one(loaded, len(content))
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    return vertices, faces, _vertex_colors(mesh) if len(faces) else np.zeros((0, 3), np.uint8)


def _check_ply_counts(content: bytes) -> None:
    """Raises ValueError where the elements that a PLY announces need more bytes than it has."""
    head, end, _ = content[:_HEADER_BYTES].partition(b"end_header")
    if not end:
        raise ValueError("its header has no end")
    is_text, count, needed = b"format ascii" in head, 0, 0
    for line in head.decode("ascii", "replace").splitlines():
        match line.split():
            case ["element", _, number]:
                count = int(number[:20])
                if count < 0:
                    raise ValueError(f"it announces {count} elements")
            case ["property", "list", of_count, *_]:
                needed += count * (_TEXT_BYTES if is_text else _SCALAR_BYTES[of_count])
            case ["property", kind, *_]:
                needed += count * (_TEXT_BYTES if is_text else _SCALAR_BYTES[kind])
    if needed > len(content):
        raise ValueError(f"it announces {needed} bytes or more and has {len(content)}")


def _as_one(loaded: trimesh.Geometry, file_bytes: int) -> trimesh.Trimesh:
    """The one mesh of what was loaded; a scene may name a mesh many times, but not more often than its file is long."""
    import trimesh

    if isinstance(loaded, trimesh.Scene):
        nodes = (loaded.geometry[loaded.graph[node][1]] for node in loaded.graph.nodes_geometry)
        faces = sum(len(geometry.faces) for geometry in nodes if isinstance(geometry, trimesh.Trimesh))
        if faces > file_bytes:
            raise ValueError(f"it has {file_bytes} bytes and {faces} faces")
        loaded = loaded.to_mesh()
    return loaded if isinstance(loaded, trimesh.Trimesh) else trimesh.Trimesh()


def _check(vertices: np.ndarray, faces: np.ndarray) -> None:
    if vertices.shape != (len(vertices), 3) or faces.shape != (len(faces), 3):
        raise ValueError(f"vertices and faces must have three columns, got {vertices.shape} and {faces.shape}")
    if not (np.abs(vertices) <= MAX_COORDINATE_M).all():
        raise ValueError(f"coordinates must be finite and within {MAX_COORDINATE_M:g} m of the origin")
    if not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(f"faces must index {len(vertices)} vertices, got {faces.min()} to {faces.max()}")


def _vertex_colors(mesh: trimesh.Trimesh) -> np.ndarray:
    # Textures are left alone.
    if mesh.visual.kind == "texture":  # type: ignore[union-attr]
        return np.full((len(mesh.vertices), 3), _GRAY, np.uint8)
    return np.array(mesh.visual.vertex_colors, np.uint8).reshape(-1, 4)[:, :3]  # type: ignore[union-attr]
