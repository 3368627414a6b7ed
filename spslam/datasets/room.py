"""A closed furnished room of known shape: ray casting, colors, signed distance and surface samples."""

from __future__ import annotations

import numpy as np

from spslam.camera import Camera
from spslam.datasets.furniture import ROOM_SIZE, Material, Piece, furnish, make_material
from spslam.datasets.primitives import Box, Primitive
from spslam.datasets.solids import SolidScene
from spslam.geometry import inverse

# The shell's faces, two an axis (low, high): walls, floor and ceiling with colors of their own.
_SHELL_COLORS = (
    (0.82, 0.76, 0.64),
    (0.64, 0.71, 0.76),
    (0.68, 0.74, 0.62),
    (0.80, 0.66, 0.58),
    (0.60, 0.45, 0.31),
    (0.88, 0.87, 0.84),
)
_LIGHT = np.array([0.40, 0.29, 0.87])
_AMBIENT, _DIRECT = 0.76, 0.24
# How hard the pattern's edges are, and the share of the broad wave.
_SHARPNESS, _BROAD = 3.0, 0.12
# The middles of a round surface's triangles lie this much under it at most.
_SAGITTA_M = 5e-4


class Room(SolidScene):
    """The room of a seed: 5 x 4 x 2.6 m, floor at z = 0, z up, with the furniture of `spslam.datasets.furniture`."""

    def __init__(self, seed: int = 0) -> None:
        generator = np.random.default_rng([seed, 2])
        self.pieces = furnish(seed)
        shell = Box((0.0, 0.0, ROOM_SIZE[2] / 2), 0.0, ROOM_SIZE)
        super().__init__(shell, [piece.solid for piece in self.pieces])
        self._shell_materials = [make_material(generator, color, 0.2, 0.5) for color in _SHELL_COLORS]

    def render(self, camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What a camera inside sees: color uint8 [H,W,3] and exact depth float32 [H,W] in meters.

        One ray through each pixel center is intersected with every solid; `pose` is `T_world_camera` [4,4].
        """
        origin = pose[:3, 3]
        directions = np.tensordot(pose[:3, :3].astype(np.float32), camera.ray_directions(), axes=(1, 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            depth, owner = self._cast(camera, pose, origin, directions)
        points = (directions * depth).reshape(3, -1).T + origin.astype(np.float32)
        return self._colors(points, owner.reshape(-1)).reshape(camera.height, camera.width, 3), depth

    def mesh(self, longest_edge_m: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The room's surface as triangles: vertices float64 [V,3], faces int64 [F,3], colors uint8 [V,3].

        Faces point into free space. Triangles whose middle is hidden in another solid are left out, so that along
        contacts the mesh ends within one triangle of the true line. Round surfaces deviate by under 0.5 mm.
        """
        vertices, faces, colors = [], [], []
        first = 0
        for owner, solid in enumerate([self._shell, *(piece.solid for piece in self.pieces)], start=-1):
            points, triangles = self._visible_triangles(solid, longest_edge_m)
            vertices.append(points)
            faces.append(first + (triangles if owner >= 0 else triangles[:, ::-1]))
            colors.append(self._colors(points.astype(np.float32), np.full(len(points), owner)))
            first += len(points)
        return np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors)

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V,3] and faces [F,3] of `mesh`."""
        vertices, faces, _ = self.mesh()
        return vertices, faces

    def _visible_triangles(self, solid: Primitive, longest_edge_m: float) -> tuple[np.ndarray, np.ndarray]:
        from trimesh.remesh import subdivide_to_size

        surface = solid.local_mesh()
        points, triangles = subdivide_to_size(surface.vertices, surface.faces, longest_edge_m)
        points = solid.to_world(points)
        visible = triangles[~self._is_hidden(points[triangles].mean(axis=1), _SAGITTA_M)]
        used, renumbered = np.unique(visible, return_inverse=True)
        return points[used], renumbered.reshape(-1, 3)

    def _cast(
        self, camera: Camera, pose: np.ndarray, origin: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        depth = self._shell.local_interval(self._shell.to_local(origin), directions)[1].astype(np.float32)
        owner = np.full(depth.shape, -1, dtype=np.int16)
        for number, piece in enumerate(self.pieces):
            window = _window(piece, camera, pose)
            if window is None:
                continue
            hit = piece.solid.intersect(origin, directions[(slice(None), *window)])
            nearer = hit < depth[window]
            np.copyto(depth[window], hit, where=nearer)
            np.copyto(owner[window], np.int16(number), where=nearer)
        return depth, owner

    def _colors(self, points: np.ndarray, owner: np.ndarray) -> np.ndarray:
        colors = np.empty((len(points), 3), dtype=np.float32)
        order = np.argsort(owner, kind="stable")
        numbers, starts = np.unique(owner[order], return_index=True)
        for number, rows in zip(numbers, np.split(order, starts[1:]), strict=True):
            if number < 0:
                colors[rows] = self._shell_colors(points[rows])
            else:
                piece = self.pieces[number]
                colors[rows] = _shaded(points[rows], piece.solid.normals(points[rows]), piece.material)
        # A point on an edge may have no normal, hence no shade.
        return np.clip(np.nan_to_num(colors) * 255 + 0.5, 0, 255).astype(np.uint8)

    def _shell_colors(self, points: np.ndarray) -> np.ndarray:
        normals = -self._shell.normals(points)
        axis = np.argmax(np.abs(normals), axis=1)
        face = 2 * axis + (normals[np.arange(len(points)), axis] < 0)
        colors = np.empty((len(points), 3), dtype=np.float32)
        for number in np.unique(face):
            rows = face == number
            colors[rows] = _shaded(points[rows], normals[rows], self._shell_materials[number])
        return colors


def _window(piece: Piece, camera: Camera, pose: np.ndarray) -> tuple[slice, slice] | None:
    corners = piece.solid.corners() @ pose[:3, :3] + inverse(pose)[:3, 3]
    in_front = corners[:, 2] > 0
    if not in_front.any():
        return None
    if not in_front.all():
        return slice(None), slice(None)
    pixels = camera.project(corners)
    left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int), 0)
    right, bottom = np.ceil(pixels.max(axis=0)).astype(int) + 1
    if left >= camera.width or top >= camera.height or right <= 0 or bottom <= 0:
        return None
    return slice(top, bottom), slice(left, right)


def _shaded(points: np.ndarray, normals: np.ndarray, material: Material) -> np.ndarray:
    waves = np.sin(points @ material.waves.T.astype(np.float32) + material.phases.astype(np.float32))
    pattern = np.clip(np.float32(_SHARPNESS) * waves[:, 0] * waves[:, 1], -1, 1)
    brightness = _AMBIENT + _DIRECT * (normals @ _LIGHT.astype(np.float32))
    brightness = brightness * (1 + np.float32(material.contrast) * pattern + np.float32(_BROAD) * waves[:, 2])
    return brightness[:, None] * material.color.astype(np.float32)
