"""A triangle mesh as NumPy arrays."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from spslam.image_library import check_memory, image_library
from spslam.notebook import mesh_html


@dataclass(frozen=True, repr=False)
class TriangleMesh:
    """Triangles with a color and a normal at each vertex; K vertices, L faces, both may be 0.

    Attributes:
        vertices: float32 [K, 3], world, m.
        faces: int32 [L, 3], indices of vertices, counter-clockwise seen from free space.
        colors: uint8 [K, 3] RGB.
        normals: float32 [K, 3] unit vectors towards free space; 0 where all adjacent faces are degenerate.

    Raises:
        ValueError: an array of another dtype or shape.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    normals: np.ndarray

    def __post_init__(self) -> None:
        rows = self.vertices.shape[0]
        for name, array, shape, dtype in (
            ("vertices", self.vertices, (rows, 3), np.float32),
            ("faces", self.faces, (self.faces.shape[0], 3), np.int32),
            ("colors", self.colors, (rows, 3), np.uint8),
            ("normals", self.normals, (rows, 3), np.float32),
        ):
            if array.shape != shape or array.dtype != dtype:
                wanted = f"{np.dtype(dtype).name} {list(shape)}"
                raise ValueError(f"TriangleMesh: {name} must be {wanted}, got {array.dtype} {list(array.shape)}")

    def save(self, path: str | os.PathLike) -> None:
        """Writes the mesh as .ply, .glb or .obj; see `spslam.meshing.save_mesh`."""
        from spslam.meshing.export import save_mesh

        save_mesh(self, path)

    def __repr__(self) -> str:
        return f"TriangleMesh({len(self.vertices)} vertices, {len(self.faces)} faces)"

    def _repr_html_(self) -> str:
        """What a notebook shows: the mesh, to be turned around with the mouse."""
        return mesh_html(self.vertices, self.faces, self.colors)


def compact(faces: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Renumbers faces over the vertices they use.

    Args:
        faces: integers [L, 3].
        num_vertices: number of vertices that they index.

    Returns:
        int32 faces [L, 3] over the used vertices, and the old indices of these vertices, ascending.
    """
    is_used = np.zeros(num_vertices, dtype=bool)
    is_used[faces] = True
    renumbered = np.cumsum(is_used, dtype=np.int32) - 1
    return renumbered[faces].astype(np.int32, copy=False), np.flatnonzero(is_used)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals [L, 3] of faces with counter-clockwise vertices; their length is twice the area of the face."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def indexed(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """Faces as compiled functions read them: int32 [L, 3], contiguous.

    Raises:
        ValueError: a face of other indices than those of `num_vertices` vertices.
    """
    faces = np.asarray(faces).reshape(-1, 3)
    if faces.size and not 0 <= faces.min() <= faces.max() < num_vertices:
        raise ValueError(f"faces must be indices of {num_vertices} vertices, got {faces.min()}, {faces.max()}")
    return np.ascontiguousarray(faces, np.int32)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals float32 [K, 3] of vertices: area-weighted means over the adjacent faces; 0 where there is none.

    Raises:
        ValueError: a face of other indices than those of vertices.
        MemoryError: there is not enough.
    """
    points, faces = np.ascontiguousarray(vertices, np.float32), indexed(faces, len(vertices))
    normals = np.empty(points.shape, np.float32)
    check_memory(
        image_library().spslam_vertex_normals(
            faces.ctypes.data, len(faces), len(points), points.ctypes.data, normals.ctypes.data
        )
    )
    return normals


def component_areas(vertices: np.ndarray, faces: np.ndarray, counted: np.ndarray | None = None) -> np.ndarray:
    """The area, float64 [L], m^2, of the connected component of each face; faces that share a vertex are connected.

    Args:
        vertices: float32 [K, 3], m.
        faces: integers [L, 3].
        counted: bool [L]; the area of other faces does not count. None counts all.

    Raises:
        ValueError: a face of other indices than those of vertices, or `counted` of another length.
        MemoryError: there is not enough.
    """
    points, faces = np.ascontiguousarray(vertices, np.float32), indexed(faces, len(vertices))
    if counted is not None and np.shape(counted) != (len(faces),):
        raise ValueError(f"component_areas: counted must have shape ({len(faces)},), got {np.shape(counted)}")
    areas = np.empty(len(faces))
    flags = None if counted is None else np.ascontiguousarray(counted, bool)
    check_memory(
        image_library().spslam_component_areas(
            faces.ctypes.data,
            len(faces),
            len(points),
            points.ctypes.data,
            None if flags is None else flags.ctypes.data,
            areas.ctypes.data,
        )
    )
    return areas
