"""The surface of solids in a closed box: signed distance and samples of what faces free space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from spslam.datasets.primitives import Box, Primitive

# A sampled point this far inside another solid is hidden; double precision on coordinates of meters.
_HIDDEN_M = 1e-9


class SolidScene(ABC):
    """Free space is the inside of `shell` less all solids, which may overlap; world axes have z up.

    Args:
        shell: walls, floor and ceiling, seen from inside.
        solids: what stands in it.
    """

    def __init__(self, shell: Box, solids: Sequence[Primitive]) -> None:
        self._shell = shell
        self._solids = tuple(solids)

    @abstractmethod
    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """The surface as a mesh: vertices float64 [V,3] and faces int64 [F,3], which point into free space."""

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [N] in meters of points [N,3] to the nearest surface.

        Positive and exact in free space; negative inside furniture and behind the walls, where it is the distance
        to leave the solid the point is deepest in (a lower bound of the distance to free space).
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        distance = -self._shell.signed_distance(points)
        for solid in self._solids:
            np.minimum(distance, solid.signed_distance(points), out=distance)
        return distance

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [N] of points [N,3] to the nearest surface; exact in free space, see `signed_distance`."""
        return np.abs(self.signed_distance(points))

    def sample_surface(self, count: int, seed: int = 0) -> np.ndarray:
        """Points [count,3] spread evenly by area over the surfaces that face free space; float64, meters.

        The same count and seed give the same points. `count` 0 gives an empty array.
        """
        generator = np.random.default_rng([seed, 3])
        solids = [self._shell, *self._solids]
        areas = np.array([solid.area for solid in solids])
        kept: list[np.ndarray] = [np.zeros((0, 3))]
        missing = count
        while missing > 0:
            # Some are hidden, so a few more are drawn than needed.
            drawn = generator.multinomial(missing + missing // 2 + 16, areas / areas.sum())
            points = np.concatenate([solid.sample(generator, n) for solid, n in zip(solids, drawn, strict=True)])
            visible = points[~self._is_hidden(points, _HIDDEN_M)]
            kept.append(generator.permutation(visible)[:missing])
            missing -= len(kept[-1])
        return np.concatenate(kept)

    def _is_hidden(self, points: np.ndarray, deeper_than: float) -> np.ndarray:
        """Whether points [N,3] lie in furniture or behind a wall by more than a distance; bool [N]."""
        hidden = self._shell.signed_distance(points) > deeper_than
        if not len(points):
            return hidden
        lowest, highest = points.min(axis=0), points.max(axis=0)
        for solid in self._solids:
            corners = solid.corners()
            low, high = corners.min(axis=0), corners.max(axis=0)
            if np.any(highest < low) or np.any(lowest > high):
                continue
            near = np.flatnonzero(np.all((points > low) & (points < high), axis=1))
            hidden[near] |= solid.signed_distance(points[near]) < -deeper_than
        return hidden
