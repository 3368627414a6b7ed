"""A place: solids with finishes in a closed box, and a camera's way through it."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spslam.camera import Camera
from spslam.datasets.places.builder import Builder
from spslam.datasets.places.caster import Caster, Rays
from spslam.datasets.places.shading import Shader
from spslam.datasets.solids import SolidScene

_MESH_EDGE_M = 0.2


class Place(SolidScene):
    """Exact shape, colors and route of a generated place.

    Args:
        plan: what stands where.
        seed: of textures.
        texture: contrast of all textures, 0 to 1.

    Attributes:
        route: the closed way through it.
        pace: factor on speeds.
    """

    def __init__(self, plan: Builder, seed: int, texture: float) -> None:
        super().__init__(plan.shell, plan.solids)
        self.route = plan.route
        self.pace = plan.pace
        corners = np.array([solid.corners() for solid in plan.solids])
        self._extents = corners.min(axis=1), corners.max(axis=1)
        self._caster = Caster(plan.shell, plan.solids)
        self._look = ([*plan.finishes, plan.shell_finishes], seed, texture)

    @cached_property
    def _shader(self) -> Shader:
        """Made when colors are first asked for; textures take half a second."""
        return Shader(self._shell, self._solids, *self._look)

    def render(self, camera: Camera, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Color uint8 [H, W, 3] and exact depth float32 [H, W], m.

        Args:
            camera: of the image; its rays pass through the pixel centers.
            poses: T_world_camera [4, 4], or one for each row [H, 4, 4] of a rolling shutter.
        """
        rays = Rays.of(camera, poses)
        depth, owner = self._caster.cast(camera, rays)
        return self._shader.colors(rays, depth, owner, camera.fx), depth

    def depth(self, camera: Camera, poses: np.ndarray) -> np.ndarray:
        """Exact depth float32 [H, W], m, alone; arguments as in `render`."""
        return self._caster.cast(camera, Rays.of(camera, poses))[0]

    def mesh(self, longest_edge_m: float = _MESH_EDGE_M) -> tuple[np.ndarray, np.ndarray]:
        """The surface as triangles: vertices float64 [V, 3] and faces int64 [F, 3], which point into free space.

        Triangles that lie wholly in another solid are left out; of those that do in part, the rest can't be seen from
        free space. Round surfaces deviate by under 0.5 mm.

        Args:
            longest_edge_m: triangles are divided until no edge is longer.
        """
        from trimesh.remesh import subdivide_to_size

        vertices, faces, first = [], [], 0
        for number, solid in enumerate([self._shell, *self._solids]):
            surface = solid.local_mesh()
            points, triangles = subdivide_to_size(surface.vertices, surface.faces, longest_edge_m)
            points = solid.to_world(points)
            triangles = triangles[~self._are_covered(points, triangles, number - 1)]
            vertices.append(points)
            faces.append(first + (triangles if number else triangles[:, ::-1]))
            first += len(points)
        return np.concatenate(vertices), np.concatenate(faces)

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V, 3] and faces [F, 3] of `mesh`."""
        return self.mesh()

    def _are_covered(self, points: np.ndarray, triangles: np.ndarray, owner: int) -> np.ndarray:
        """Whether triangles lie in one solid, which is convex, or behind one plane of the shell; bool [F]."""
        half, center = self._shell.half_size, np.asarray(self._shell.center)
        beyond = np.concatenate((points - center > half + 1e-6, center - points > half + 1e-6), axis=1)
        covered = beyond[triangles].all(axis=1).any(axis=1)
        low, high = self._extents
        near = np.all((points.max(axis=0) > low) & (points.min(axis=0) < high), axis=1)
        for number in np.flatnonzero(near):
            if number != owner:
                covered |= (self._solids[number].signed_distance(points) < -1e-6)[triangles].all(axis=1)
        return covered
