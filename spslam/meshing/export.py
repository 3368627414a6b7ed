"""Export of meshes as PLY, GLB or OBJ."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spslam.errors import OutputError
from spslam.io import atomic_write
from spslam.meshing.mesh import TriangleMesh

if TYPE_CHECKING:
    import trimesh

FORMATS = (".ply", ".glb", ".obj")


def save_mesh(mesh: TriangleMesh, path: str | os.PathLike) -> None:
    """Writes a mesh with vertex colors and normals, atomically; the same mesh gives the same bytes.

    Args:
        mesh: the mesh. A mesh without faces can be written as PLY only.
        path: `.ply` (binary), `.glb` (glTF; axes are not changed) or `.obj` (vertex colors after the coordinates, as
            most programs read them). The folder must exist.

    Raises:
        OutputError: another suffix, a mesh without faces as GLB or OBJ, or the operating system refuses.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise OutputError(
            f"{path}: a mesh must be written as {', '.join(FORMATS)}, got {suffix or 'a file without suffix'}"
        )
    if suffix == ".ply":
        atomic_write(path, _ply(mesh))
        return
    if len(mesh.faces) == 0:
        raise OutputError(f"{path}: a mesh without faces can be written as .ply only")
    exported = _as_trimesh(mesh).export(file_type=suffix[1:], include_normals=True)
    atomic_write(path, exported if isinstance(exported, bytes) else str(exported))


def _as_trimesh(mesh: TriangleMesh) -> trimesh.Trimesh:
    import trimesh

    # Without processing, which would merge vertices that are close and tear the surface.
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=mesh.normals, vertex_colors=mesh.colors, process=False
    )


def _ply(mesh: TriangleMesh) -> bytes:
    """Binary PLY. Not by trimesh: this takes 0.5 s for two million faces, and supports a mesh without faces."""
    vertex = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
    face = np.dtype([("count", "u1"), ("indices", "<i4", 3)])
    vertices = np.empty(len(mesh.vertices), dtype=vertex)
    vertices["position"], vertices["normal"], vertices["color"] = mesh.vertices, mesh.normals, mesh.colors
    faces = np.empty(len(mesh.faces), dtype=face)
    faces["count"], faces["indices"] = 3, mesh.faces
    properties = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()
