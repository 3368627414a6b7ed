"""Export of meshes as PLY, GLB or OBJ."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from spslam.errors import OutputError
from spslam.io import atomic_write
from spslam.meshing.glb import encode_glb
from spslam.meshing.mesh import TriangleMesh
from spslam.meshing.ply import encode_ply

if TYPE_CHECKING:
    import trimesh

FORMATS = (".ply", ".glb", ".obj")


def save_mesh(mesh: TriangleMesh, path: str | os.PathLike) -> None:
    """Writes a mesh with vertex colors and normals, atomically; the same mesh gives the same bytes.

    Args:
        mesh: the mesh. A mesh without faces can be written as PLY only.
        path: `.ply` (binary), `.glb` (glTF; axes are not changed, colors are linear there) or `.obj` (vertex colors
            after the coordinates, as most programs read them). The folder must exist.

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
        atomic_write(path, encode_ply(mesh))
        return
    if len(mesh.faces) == 0:
        raise OutputError(f"{path}: a mesh without faces can be written as .ply only")
    if suffix == ".glb":
        atomic_write(path, encode_glb(mesh))
        return
    atomic_write(path, str(_as_trimesh(mesh).export(file_type="obj", include_normals=True)))


def _as_trimesh(mesh: TriangleMesh) -> trimesh.Trimesh:
    import trimesh

    # Without processing, which would merge vertices that are close and tear the surface.
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=mesh.normals, vertex_colors=mesh.colors, process=False
    )
