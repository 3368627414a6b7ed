"""Random solids with known signed distance, as training data of the prior.

All lengths are in voxels. A batch has B solids of one kind, each with its own size, rotation and position, and with a
part of its surface near the origin. All random numbers come from the generator that the caller passes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Generator, Tensor

from spslam.prior import signed_distance as sd

Parameters = dict[str, Tensor]
FINE_STEP = 1e-2
"""Step of finite differences, in voxels; large compared with float32 rounding."""
_ITERATED = (sd.superquadric, sd.wavy_sheet)


class Solid(ABC):
    """A batch of B solids. Distances are negative inside; that of a composition is a lower bound of its magnitude."""

    @abstractmethod
    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distances [B, N] at points [B, N, 3]."""

    def march_distance(self, points: Tensor) -> Tensor:
        """A cheaper distance for sphere tracing, equal to first order near the surface."""
        return self.signed_distance(points)

    def normals(self, points: Tensor, step: float | Tensor = FINE_STEP) -> Tensor:
        """Unit gradients of the signed distance by central differences.

        Args:
            points: [B, N, 3].
            step: step of the differences, a number or [B, 1, 1].

        Returns:
            [B, N, 3].
        """
        axes = torch.eye(3, dtype=points.dtype)
        shifted = torch.cat([points + step * axis for axis in (*axes, *-axes)], dim=1)
        ahead, behind = self.signed_distance(shifted).reshape(points.shape[0], 2, 3, points.shape[1]).unbind(1)
        return torch.nn.functional.normalize((ahead - behind).transpose(1, 2), dim=-1)


@dataclass(frozen=True)
class Primitive(Solid):
    """B solids of one kind, placed so that `anchor` (in the frame of the solid) is at `position` (in the patch frame).

    Attributes:
        distance: signed distance function, see `spslam.prior.signed_distance`.
        parameters: its parameters.
        rotation: [B, 3, 3], from the axes of the solid to those of the patch.
        anchor: [B, 3].
        position: [B, 3].
        orientation: [B, 1], -1 for solids with inside and outside swapped.
    """

    distance: Callable[..., Tensor]
    parameters: Parameters
    rotation: Tensor
    anchor: Tensor
    position: Tensor
    orientation: Tensor

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.orientation * self.distance(self._own_frame(points), **self.parameters)

    def march_distance(self, points: Tensor) -> Tensor:
        if self.distance in _ITERATED:
            return self.orientation * self.distance(self._own_frame(points), **self.parameters, iterations=1)
        return self.signed_distance(points)

    def _own_frame(self, points: Tensor) -> Tensor:
        return (points - self.position[:, None]) @ self.rotation + self.anchor[:, None]


@dataclass(frozen=True)
class Composition(Solid):
    """Union or intersection of two batches of solids; `operation` is "union" or "intersection"."""

    first: Solid
    second: Solid
    operation: str

    def signed_distance(self, points: Tensor) -> Tensor:
        return self._combine(self.first.signed_distance(points), self.second.signed_distance(points))

    def march_distance(self, points: Tensor) -> Tensor:
        return self._combine(self.first.march_distance(points), self.second.march_distance(points))

    def _combine(self, first: Tensor, second: Tensor) -> Tensor:
        return torch.minimum(first, second) if self.operation == "union" else torch.maximum(first, second)


@dataclass(frozen=True)
class _Kind:
    """A kind of solid: its distance, how its sizes are drawn, and the share of solids observed from inside."""

    distance: Callable[..., Tensor]
    draw: Callable[[int, Generator], Parameters] = field(default=lambda count, generator: {})
    concave_share: float = 0.0


def _between(low: float, high: float, shape: tuple[int, ...], generator: Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator)


def _log_between(low: float, high: float, shape: tuple[int, ...], generator: Generator) -> Tensor:
    return low * (high / low) ** torch.rand(shape, generator=generator)


def _slab_sizes(count: int, generator: Generator) -> Parameters:
    wide = _log_between(3, 20, (count, 2), generator)
    return {"half_size": torch.cat([wide, _log_between(0.5, 1.5, (count, 1), generator)], 1)}


def _torus_sizes(count: int, generator: Generator) -> Parameters:
    radius = _log_between(4, 15, (count, 1), generator)
    return {"radius": radius, "tube_radius": radius * _between(0.2, 0.5, (count, 1), generator)}


_KINDS = {
    "plane": _Kind(sd.plane),
    "sphere": _Kind(sd.sphere, lambda n, g: {"radius": _log_between(2, 30, (n, 1), g)}, 0.3),
    "cylinder": _Kind(sd.cylinder, lambda n, g: {"radius": _log_between(1.5, 30, (n, 1), g)}, 0.3),
    "box": _Kind(sd.box, lambda n, g: {"half_size": _log_between(1.5, 20, (n, 3), g)}),
    "room": _Kind(sd.box, lambda n, g: {"half_size": _log_between(4, 40, (n, 3), g)}, 1.0),
    "slab": _Kind(sd.box, _slab_sizes),
    "superquadric": _Kind(
        sd.superquadric,
        lambda n, g: {"half_size": _log_between(2, 10, (n, 3), g), "exponent": _between(2, 5, (n, 1), g)},
    ),
    "torus": _Kind(sd.torus, _torus_sizes),
    "wavy_sheet": _Kind(
        sd.wavy_sheet,
        lambda n, g: {"amplitude": _between(0.3, 1, (n, 1), g), "wave_number": _between(0.2, 0.7, (n, 1), g)},
    ),
}
_COMPOSITIONS = {
    "box_on_plane": ("union", "box", "plane"),
    "cylinder_on_plane": ("union", "cylinder", "plane"),
    "box_on_box": ("union", "box", "box"),
    "cut_sphere": ("intersection", "sphere", "plane"),
    "sphere_on_plane": ("union", "sphere", "plane"),
}
TRAINING_KINDS = (
    "plane",
    "sphere",
    "cylinder",
    "box",
    "room",
    "slab",
    "superquadric",
    "box_on_plane",
    "cylinder_on_plane",
    "box_on_box",
    "cut_sphere",
)
HELD_OUT_KINDS = ("torus", "wavy_sheet", "sphere_on_plane")


def random_solid(kind: str, count: int, generator: Generator) -> Solid:
    """Draws a batch of solids of one kind with surface near the origin; for a composition, surface of both parts.

    Args:
        kind: one of TRAINING_KINDS or HELD_OUT_KINDS.
        count: batch size B, at least 1.
        generator: a CPU generator, the only source of randomness; the same state gives the same solids.

    Raises:
        ValueError: another kind.
    """
    if kind in _COMPOSITIONS:
        operation, first, second = _COMPOSITIONS[kind]
        parts = [_random_primitive(part, count, generator, spread=1.0) for part in (first, second)]
        return Composition(parts[0], parts[1], operation)
    if kind not in _KINDS:
        raise ValueError(f"random_solid: kind must be one of {', '.join(TRAINING_KINDS + HELD_OUT_KINDS)}, got {kind}")
    return _random_primitive(kind, count, generator, spread=0.0)


def nearest_surface(solid: Solid, points: Tensor, iterations: int = 12) -> Tensor:
    """Projects points [B, N, 3] onto the surface by steps along the gradient of the distance."""
    for _ in range(iterations):
        points = points - solid.march_distance(points)[..., None] * solid.normals(points)
    return points


def _random_primitive(kind: str, count: int, generator: Generator, spread: float) -> Primitive:
    entry = _KINDS[kind]
    parameters = entry.draw(count, generator)
    unplaced = Primitive(
        entry.distance, parameters, torch.eye(3).expand(count, 3, 3), torch.zeros(count, 3), torch.zeros(count, 3),
        torch.ones(count, 1),
    )  # fmt: skip
    start = _start_points(parameters, count, generator)
    return Primitive(
        entry.distance,
        parameters,
        _random_rotations(count, generator),
        nearest_surface(unplaced, start[:, None])[:, 0],
        spread * torch.randn(count, 3, generator=generator),
        torch.where(torch.rand(count, 1, generator=generator) < entry.concave_share, -1.0, 1.0),
    )


def _start_points(parameters: Parameters, count: int, generator: Generator) -> Tensor:
    """Initial points [B, 3] of the projection to the anchor: uniform in solids with half sizes, to include edges."""
    if "half_size" in parameters:
        return 1.1 * parameters["half_size"] * _between(-1, 1, (count, 3), generator)
    return 4 * torch.randn(count, 3, generator=generator)


def _random_rotations(count: int, generator: Generator) -> Tensor:
    """Uniform rotations [B, 3, 3], from normalized Gaussian quaternions."""
    quaternion = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(count, 3, 3)
