"""Boxes, spheres and cylinders: exact ray intersection, signed distance, normals and area-weighted sampling.

World axes have z up. A ray is an origin [3], or origins [3,...] that broadcast with the directions, and directions
[3,...] (structure of arrays); its parameter t is in units of the direction's length, so that directions with camera
z = 1 give depth. Points are [N,3] in meters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh

_NO_HIT = np.float32(np.inf)
_CYLINDER_SECTIONS = 96
_SPHERE_SUBDIVISIONS = 4


@dataclass(frozen=True)
class Primitive(ABC):
    """A convex solid, turned about the vertical by `yaw` radians and placed at `center`."""

    center: tuple[float, float, float]
    yaw: float = 0.0

    @property
    @abstractmethod
    def half_size(self) -> np.ndarray:
        """Half the edges [3] of the box around the solid, in its own axes."""

    @property
    @abstractmethod
    def area(self) -> float:
        """Surface in square meters."""

    @abstractmethod
    def local_distance(self, points: np.ndarray) -> np.ndarray:
        """Exact signed distance [N] of points in the solid's own axes, negative inside."""

    @abstractmethod
    def local_normals(self, points: np.ndarray) -> np.ndarray:
        """Outward unit normals [N,3] at points on the surface, own axes."""

    @abstractmethod
    def local_samples(self, generator: np.random.Generator, count: int) -> np.ndarray:
        """Points [count,3] spread evenly over the surface, own axes."""

    @abstractmethod
    def local_mesh(self) -> trimesh.Trimesh:
        """The surface in own axes, normals outward."""

    @abstractmethod
    def local_interval(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays [3,...] enter and leave the solid; they miss it where leaving isn't after entering."""

    def intersect(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances t [...], float32, at which rays from outside first meet the solid; infinite where they don't."""
        local_origin = np.moveaxis(self.to_local(np.moveaxis(origin, 0, -1)), -1, 0)
        enter, leave = self.local_interval(local_origin, self._directions_to_local(directions))
        return np.where((enter < leave) & (enter > 0), enter, _NO_HIT).astype(np.float32, copy=False)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Exact signed distance [N] of world points, negative inside."""
        return self.local_distance(self.to_local(points))

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward unit normals [N,3] at world points on the surface."""
        return self.local_normals(self.to_local(points)) @ self._rotation().T

    def sample(self, generator: np.random.Generator, count: int) -> np.ndarray:
        """World points [count,3] spread evenly over the surface."""
        return self.to_world(self.local_samples(generator, count))

    def corners(self) -> np.ndarray:
        """The eight corners [8,3] of a box around the solid."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return self.to_world(signs * self.half_size)

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Points [...,3] in the solid's own axes."""
        centered = points - np.asarray(self.center, dtype=points.dtype)
        return centered if self.yaw == 0 else centered @ self._rotation().astype(points.dtype)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """World points of points [...,3] in the solid's own axes."""
        return points @ self._rotation().T + np.asarray(self.center)

    def _rotation(self) -> np.ndarray:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def _directions_to_local(self, directions: np.ndarray) -> np.ndarray:
        if self.yaw == 0:
            return directions
        c, s = directions.dtype.type(np.cos(self.yaw)), directions.dtype.type(np.sin(self.yaw))
        x, y, z = directions
        return np.stack((c * x + s * y, c * y - s * x, z))


@dataclass(frozen=True)
class Box(Primitive):
    """A box of edge lengths `size`."""

    size: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def half_size(self) -> np.ndarray:
        return np.asarray(self.size) / 2

    @property
    def area(self) -> float:
        x, y, z = self.size
        return 2 * (x * y + y * z + z * x)

    def local_distance(self, points: np.ndarray) -> np.ndarray:
        return _box_distance(np.abs(points) - self.half_size)

    def local_normals(self, points: np.ndarray) -> np.ndarray:
        axis = np.argmin(np.abs(np.abs(points) - self.half_size), axis=1)
        normals = np.zeros_like(points)
        rows = np.arange(len(points))
        normals[rows, axis] = np.sign(points[rows, axis])
        return normals

    def local_samples(self, generator: np.random.Generator, count: int) -> np.ndarray:
        x, y, z = self.size
        faces = np.repeat([y * z, z * x, x * y], 2)
        face = generator.choice(6, size=count, p=faces / faces.sum())
        points = generator.uniform(-1, 1, (count, 3)) * self.half_size
        axis = face // 2
        points[np.arange(count), axis] = np.where(face % 2, 1, -1) * self.half_size[axis]
        return points

    def local_mesh(self) -> trimesh.Trimesh:
        from trimesh.creation import box

        return box(extents=self.size)

    def local_interval(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        intervals = [_slab(origin[axis], directions[axis], self.half_size[axis]) for axis in range(3)]
        enter = np.maximum(np.maximum(intervals[0][0], intervals[1][0]), intervals[2][0])
        leave = np.minimum(np.minimum(intervals[0][1], intervals[1][1]), intervals[2][1])
        return enter, leave


@dataclass(frozen=True)
class Sphere(Primitive):
    """A ball."""

    radius: float = 0.5

    @property
    def half_size(self) -> np.ndarray:
        return np.full(3, self.radius)

    @property
    def area(self) -> float:
        return 4 * np.pi * self.radius**2

    def local_distance(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points, axis=1) - self.radius

    def local_normals(self, points: np.ndarray) -> np.ndarray:
        return points / np.linalg.norm(points, axis=1, keepdims=True)

    def local_samples(self, generator: np.random.Generator, count: int) -> np.ndarray:
        directions = generator.normal(size=(count, 3))
        return self.radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def local_mesh(self) -> trimesh.Trimesh:
        from trimesh.creation import icosphere

        return icosphere(subdivisions=_SPHERE_SUBDIVISIONS, radius=self.radius)

    def local_interval(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _round_interval(origin, directions, self.radius)


@dataclass(frozen=True)
class Cylinder(Primitive):
    """An upright cylinder of `radius` and `height`."""

    radius: float = 0.5
    height: float = 1.0

    @property
    def half_size(self) -> np.ndarray:
        return np.array([self.radius, self.radius, self.height / 2])

    @property
    def area(self) -> float:
        return 2 * np.pi * self.radius * (self.radius + self.height)

    def local_distance(self, points: np.ndarray) -> np.ndarray:
        radial = np.hypot(points[:, 0], points[:, 1]) - self.radius
        return _box_distance(np.stack((radial, np.abs(points[:, 2]) - self.height / 2), axis=1))

    def local_normals(self, points: np.ndarray) -> np.ndarray:
        radial = np.hypot(points[:, 0], points[:, 1])
        on_cap = np.abs(np.abs(points[:, 2]) - self.height / 2) < np.abs(radial - self.radius)
        side = (
            np.stack((points[:, 0], points[:, 1], np.zeros(len(points))), axis=1) / np.maximum(radial, 1e-12)[:, None]
        )
        cap = np.stack((np.zeros(len(points)), np.zeros(len(points)), np.sign(points[:, 2])), axis=1)
        return np.where(on_cap[:, None], cap, side).astype(points.dtype, copy=False)

    def local_samples(self, generator: np.random.Generator, count: int) -> np.ndarray:
        angle = generator.uniform(0, 2 * np.pi, count)
        on_side = generator.uniform(size=count) < self.height / (self.height + self.radius)
        along = generator.uniform(-1, 1, count)
        radius = np.where(on_side, self.radius, self.radius * np.sqrt(np.abs(along)))
        z = np.where(on_side, along, np.sign(along)) * self.height / 2
        return np.stack((radius * np.cos(angle), radius * np.sin(angle), z), axis=1)

    def local_mesh(self) -> trimesh.Trimesh:
        from trimesh.creation import cylinder

        return cylinder(radius=self.radius, height=self.height, sections=_CYLINDER_SECTIONS)

    def local_interval(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        enter_side, leave_side = _round_interval(origin[:2], directions[:2], self.radius)
        enter_caps, leave_caps = _slab(origin[2], directions[2], self.height / 2)
        return np.maximum(enter_side, enter_caps), np.minimum(leave_side, leave_caps)


def _box_distance(excess: np.ndarray) -> np.ndarray:
    outside = np.linalg.norm(np.maximum(excess, 0), axis=1)
    return outside + np.minimum(excess.max(axis=1), 0)


def _slab(origin: float | np.ndarray, direction: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    inverse = 1 / direction
    middle = -np.asarray(origin, dtype=direction.dtype) * inverse
    half_length = direction.dtype.type(half) * np.abs(inverse)
    return middle - half_length, middle + half_length


def _round_interval(origin: np.ndarray, directions: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    # In single precision the discriminant loses a millimeter at grazing rays.
    origin, directions = origin.astype(np.float64), directions.astype(np.float64)
    a = np.sum(directions * directions, axis=0)
    half_b = np.tensordot(origin, directions, axes=1) if origin.ndim == 1 else np.sum(origin * directions, axis=0)
    discriminant = half_b * half_b - a * (np.sum(origin * origin, axis=0) - radius * radius)
    root = np.sqrt(np.maximum(discriminant, 0))
    missed = discriminant <= 0
    return np.where(missed, np.inf, (-half_b - root) / a), np.where(missed, -np.inf, (-half_b + root) / a)
