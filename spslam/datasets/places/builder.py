"""Puts a place together: the shell, walls with doors, furniture that leaves the camera's way free, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spslam.datasets.furniture import SINK_M
from spslam.datasets.places.finish import Color, Finish
from spslam.datasets.places.route import Gaze, Route
from spslam.datasets.places.textures import POSTERS
from spslam.datasets.primitives import Box, Primitive

# Nothing is put closer to the camera's way; its shake and steps take up to 4 cm of it.
CLEARANCE_M = 0.32
# Between pieces of furniture, and to the walls.
_GAP_M = 0.03
_WAY_STEP_M = 0.1

Part = tuple[Primitive, Finish]
Point = Sequence[float] | np.ndarray


@dataclass(frozen=True)
class Group:
    """A piece of furniture: parts around (0, 0, 0) on the floor, its back at y = 0 and its front towards +y.

    Attributes:
        parts: solids with finishes.
        width: along x, m.
        depth: along y, m.
    """

    parts: tuple[Part, ...]
    width: float
    depth: float


class Builder:
    """Collects the parts of a place.

    Args:
        generator: decides on all that is random.
        low: corner [3] of the shell, m.
        high: opposite corner [3], m.
        shell_finishes: six: low x, high x, low y, high y, floor, ceiling.

    Attributes:
        route: the camera's way; set by `set_route` before furniture is placed.
        pace: factor on the camera's speed.
    """

    route: Route

    def __init__(
        self,
        generator: np.random.Generator,
        low: Point,
        high: Point,
        shell_finishes: Sequence[Finish],
    ) -> None:
        self.generator = generator
        self.shell = _box(low, high)
        self.shell_finishes = tuple(shell_finishes)
        self.solids: list[Primitive] = []
        self.finishes: list[tuple[Finish, ...]] = []
        self.pace = 1.0
        self._occupied: list[tuple[np.ndarray, np.ndarray]] = []
        self._way = np.zeros((0, 3))

    def set_route(self, points: np.ndarray, gaze: Gaze, pace: float = 1.0, rounding_m: float = 0.8) -> None:
        """The camera's way through points [N, 3]; what is placed afterwards leaves it free."""
        self.route = Route(points, gaze, rounding_m, float(self.generator.uniform()))
        self.pace = pace
        self._way = self.route.at(np.arange(0, self.route.effort_m, _WAY_STEP_M))[0]

    def box(self, low: Point, high: Point, finish: Finish) -> None:
        """A box between two corners."""
        self.add(_box(low, high), finish)

    def add(self, solid: Primitive, *finishes: Finish) -> None:
        """A solid with one finish or with one for each of its six faces."""
        self.solids.append(solid)
        self.finishes.append(finishes if len(finishes) > 1 else finishes * 6)

    def wall(
        self,
        axis: int,
        at: tuple[float, float],
        span: tuple[float, float],
        finish: Finish,
        doors: Sequence[tuple[float, float]] = (),
    ) -> None:
        """A wall up to the ceiling, with door openings.

        Args:
            axis: along which it runs, 0 or 1.
            at: where it begins and ends across.
            span: where it begins and ends along.
            finish: of all its parts.
            doors: center and width of each opening, ascending; 2.1 m high.
        """
        top = self.shell.size[2] + SINK_M
        start = span[0] - SINK_M
        for center, width in doors:
            low, high = center - width / 2, center + width / 2
            self._wall_part(axis, at, (start, low, -SINK_M, top), finish)
            self._wall_part(axis, at, (low - 1e-4, high + 1e-4, 2.1, top), finish)
            start = high
        self._wall_part(axis, at, (start, span[1] + SINK_M, -SINK_M, top), finish)

    def put(self, group: Group, x: float, y: float, yaw: float, bottom: float = 0.0, spacing: float = _GAP_M) -> bool:
        """Places furniture with the middle of its back at (x, y), its front towards yaw + 90 degrees.

        Returns:
            Whether there was room: not within the shell, walls or other furniture, and away from the camera's way.
        """
        parts = [(_moved(solid, x, y, bottom, yaw), finish) for solid, finish in group.parts]
        corners = np.concatenate([solid.corners() for solid, _ in parts])
        low, high = corners.min(axis=0), corners.max(axis=0)
        if not self._is_free(low, high, spacing) or self._blocks_way(parts):
            return False
        self._occupied.append((low, high))
        for solid, finish in parts:
            self.add(solid, finish)
        return True

    def occupy(self, low: Point, high: Point) -> None:
        """Keeps furniture out of a box, for example a wall or the swing of a door."""
        self._occupied.append((np.asarray(low, dtype=float), np.asarray(high, dtype=float)))

    def picture(self, axis: int, at: float, sign: int, center: tuple[float, float], size: tuple[float, float]) -> None:
        """A picture 2 cm before a wall whose face is at `at` along an axis; none where there is a door or the way.

        Args:
            axis: the wall's normal, 0 or 1.
            at: the wall's face, m.
            sign: 1 where free space lies at larger coordinates, else -1.
            center: along the wall and height, m.
            size: width and height, m.
        """
        middle, half = np.zeros(3), np.zeros(3)
        middle[axis], half[axis] = at + sign * 0.005, 0.015
        middle[1 - axis], half[1 - axis] = center[0], size[0] / 2
        middle[2], half[2] = center[1], size[1] / 2
        poster = Finish(f"poster{int(self.generator.integers(POSTERS))}", tint(self.generator, 0.8), None)
        solid = _box(middle - half, middle + half)
        behind = solid.corners()
        behind[:, axis] = at - sign * SINK_M
        if self._are_solid(behind) and not self._blocks_way([(solid, poster)]):
            self.add(solid, poster)

    def _wall_part(
        self, axis: int, at: tuple[float, float], extent: tuple[float, float, float, float], finish: Finish
    ) -> None:
        start, stop, bottom, top = extent
        if stop - start < 1e-3:
            return
        low, high = [start, at[0], bottom], [stop, at[1], top]
        if axis == 1:
            low[:2], high[:2] = [at[0], start], [at[1], stop]
        self.box(low, high, finish)
        self.occupy(low, high)

    def _are_solid(self, points: np.ndarray) -> bool:
        """Whether all points lie in walls or behind the shell."""
        covered = self.shell.signed_distance(points) > 0
        for solid in self.solids:
            covered |= solid.signed_distance(points) < 0
        return bool(covered.all())

    def _is_free(self, low: np.ndarray, high: np.ndarray, spacing: float) -> bool:
        center, half = np.asarray(self.shell.center), self.shell.half_size
        inside = center - half + [spacing, spacing, -2 * SINK_M], center + half - [spacing, spacing, 0.05]
        if np.any(low < inside[0]) or np.any(high > inside[1]):
            return False
        return not any(np.all(low < b + spacing) and np.all(high > a - spacing) for a, b in self._occupied)

    def _blocks_way(self, parts: Sequence[Part]) -> bool:
        return any((solid.signed_distance(self._way) < CLEARANCE_M).any() for solid, _ in parts if len(self._way))


def tint(generator: np.random.Generator, low: float = 0.55, spread: float = 0.12) -> Color:
    """A random color, not too dark: brightness from `low` to 1."""
    base = generator.uniform(low, 1.0) + generator.uniform(-spread, spread, 3)
    red, green, blue = (float(c) for c in np.clip(base, 0.15, 1.0))
    return red, green, blue


def _box(low: Point, high: Point) -> Box:
    center = (np.asarray(low, dtype=float) + np.asarray(high, dtype=float)) / 2
    size = np.asarray(high, dtype=float) - np.asarray(low, dtype=float)
    return Box(_triple(center), 0.0, _triple(size))


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _moved(solid: Primitive, x: float, y: float, bottom: float, yaw: float) -> Primitive:
    c, s = np.cos(yaw), np.sin(yaw)
    cx, cy, cz = solid.center
    center = (float(x + c * cx - s * cy), float(y + s * cx + c * cy), float(bottom + cz))
    if not isinstance(solid, Box):
        return replace(solid, center=center)
    quarters = (solid.yaw + yaw) / (np.pi / 2)
    if abs(quarters - round(quarters)) > 1e-9:
        return replace(solid, center=center, yaw=float(solid.yaw + yaw))
    width, depth, height = solid.size
    return Box(center, 0.0, (depth, width, height) if round(quarters) % 2 else (width, depth, height))
