"""People on the camera's way: they stand, walk on, and let the camera pass; bodies of cylinders, boxes and a sphere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from spslam.camera import Camera
from spslam.datasets.furniture import upright
from spslam.datasets.places.caster import Caster, Rays
from spslam.datasets.places.finish import Finish
from spslam.datasets.places.motion import Motion
from spslam.datasets.places.pieces import cloth, color
from spslam.datasets.places.shading import Shader
from spslam.datasets.primitives import Box, Primitive, Sphere
from spslam.geometry import inverse, pose_from

MOST_PEOPLE = 8
# A walk to the next stand and the stand, s; a stand lies so far ahead of the camera on its way, m, and each third one
# behind it, so that the camera passes.
_CYCLE_S, _STANDING_S = 7.0, 2.0
_AHEAD_M, _BEHIND_M = (1.5, 3.2), (0.6, 1.4)
# Beside the camera's way; who passes leaves it this much room.
_BESIDE_M = (0.6, 0.9)
# The camera is carried at eye height, or a little lower.
_EYES_M, _HEIGHTS_M = 1.5, (1.55, 1.9)
# Legs swing this far to either side of the hip at 1 m/s and above, one stride of both in this length.
_SWING_M, _STRIDE_M = 0.22, 1.4
_STEP_S = 0.02  # directions and speeds are differences over it
# Around a body part in which nothing is seen.
_NOTHING = Box((0.0, 0.0, 0.0), 0.0, (2000.0, 2000.0, 2000.0))


@dataclass(frozen=True)
class _Part:
    """What moves as one: solids around the person's middle on the floor, looking along +x.

    Attributes:
        solids: of it.
        swing: 0, or the sign with which it swings as legs do.
        first: number of its first solid among all.
    """

    solids: tuple[Primitive, ...]
    swing: int
    first: int

    @cached_property
    def caster(self) -> Caster:
        """Of its solids."""
        return Caster(_NOTHING, self.solids)

    @cached_property
    def corners(self) -> np.ndarray:
        """Of its solids' boxes, [8 N, 3]."""
        return np.concatenate([solid.corners() for solid in self.solids])


class People:
    """People who move through a place, in time and image alone: they are no part of its surface.

    Each stands for a while, then walks to where it stands next, which lies ahead of the camera on its way or, each
    third time, behind it. Walls and furniture do not stop them. In an image with motion blur they are as sharp as if
    they stood.

    Args:
        count: of people, up to `MOST_PEOPLE`.
        motion: of the camera.
        seed: of their looks and ways.
        texture: contrast of their clothes, 0 to 1.
    """

    def __init__(self, count: int, motion: Motion, seed: int, texture: float) -> None:
        self._motion, self._seed = motion, seed
        self._people: list[tuple[_Part, ...]] = []
        finishes: list[tuple[Finish, ...]] = []
        for number in range(count):
            self._people.append(_body(np.random.default_rng([seed, 51, number]), finishes))
        self._look = finishes, seed, texture

    @cached_property
    def _shader(self) -> Shader:
        finishes, seed, texture = self._look
        solids = [solid for parts in self._people for part in parts for solid in part.solids]
        return Shader(_NOTHING, solids, [*finishes, (Finish("paint"),) * 6], seed, texture)

    def add(self, image: tuple[np.ndarray, np.ndarray], camera: Camera, times: np.ndarray) -> None:
        """Draws all who are seen over an image, where they are nearer than what is there.

        Args:
            image: color uint8 [H, W, 3] and depth float32 [H, W], m; both are changed.
            camera: of the image.
            times: seconds [1], or of each row [H].
        """
        views = self._motion.poses(times)
        for number, parts in enumerate(self._people):
            for part in parts:
                self._add(part, inverse(self._poses(number, part.swing, times)) @ views, camera, image)

    def _add(self, part: _Part, views: np.ndarray, camera: Camera, image: tuple[np.ndarray, np.ndarray]) -> None:
        """Draws one part; `views` [1 or H, 4, 4] are the camera's poses in its frame."""
        rows, columns = window = part.caster.window(camera, views)
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return
        size = columns.stop - columns.start, rows.stop - rows.start
        seen = replace(camera, width=size[0], height=size[1], cx=camera.cx - columns.start, cy=camera.cy - rows.start)
        rays = Rays.of(seen, views if len(views) == 1 else views[rows])
        depth, owner = part.caster.cast(seen, rays)
        nearer = (owner >= 0) & (depth < image[1][window])
        if not nearer.any():
            return
        colors = self._shader.colors(rays, depth, np.where(owner < 0, owner, owner + part.first), camera.fx)
        np.copyto(image[1][window], depth, where=nearer)
        np.copyto(image[0][window], colors, where=nearer[..., None])

    def _poses(self, number: int, swing: int, times: np.ndarray) -> np.ndarray:
        """T_world_part [N, 4, 4] of a person's part at times [N]."""
        effort = self._efforts(number, times)
        step = self._efforts(number, times + _STEP_S) - effort
        place, around = self._motion.way(effort), self._motion.way(effort + 0.05)
        direction = (around - place)[:, :2]
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
        beside = np.random.default_rng([self._seed, 52, number]).uniform(*_BESIDE_M) * (1 if number % 2 else -1)
        place[:, 0] -= beside * direction[:, 1]
        place[:, 1] += beside * direction[:, 0]
        place[:, 2] -= _EYES_M
        speed = np.clip(np.abs(step) / _STEP_S, 0, 1)
        place[:, :2] += (swing * _SWING_M * speed * np.sin(2 * np.pi * effort / _STRIDE_M))[:, None] * direction
        c, s = direction.T
        zero, one = np.zeros_like(c), np.ones_like(c)
        turn = np.stack((np.stack((c, -s, zero), 1), np.stack((s, c, zero), 1), np.stack((zero, zero, one), 1)), 1)
        return pose_from(turn, place)

    def _efforts(self, number: int, times: np.ndarray) -> np.ndarray:
        """Where a person is along the camera's way, in the way's parameter, at times [N]."""
        shifted = times + _CYCLE_S * number / len(self._people)
        cycle = np.floor(shifted / _CYCLE_S).astype(int)
        numbers, where = np.unique(cycle, return_inverse=True)
        stands = np.array([[self._stand(number, int(n)), self._stand(number, int(n) + 1)] for n in numbers])
        before, after = stands[where].T
        share = np.clip((shifted - cycle * _CYCLE_S) / (_CYCLE_S - _STANDING_S), 0, 1)
        return before + (after - before) * share**2 * (3 - 2 * share)

    def _stand(self, number: int, cycle: int) -> float:
        """Where a person stands at the end of the cycle before, along the camera's way."""
        generator = np.random.default_rng([self._seed, 53, number, cycle & 0xFFFFFFFF])
        is_passed = (cycle + number) % 3 == 2
        ahead = -generator.uniform(*_BEHIND_M) if is_passed else generator.uniform(*_AHEAD_M)
        middle = (cycle - 0.5 * _STANDING_S / _CYCLE_S) * _CYCLE_S - _CYCLE_S * number / len(self._people)
        return float(self._motion.effort(np.array([middle]))[0] + ahead)


def _body(generator: np.random.Generator, finishes: list[tuple[Finish, ...]]) -> tuple[_Part, ...]:
    """Trunk with arms and head, and two legs; appends a finish for each solid."""
    height, width = float(generator.uniform(*_HEIGHTS_M)), float(generator.uniform(0.3, 0.38))
    hip, head = 0.5 * height, 0.11
    shirt, trousers = cloth(generator), cloth(generator)
    skin = Finish("paint", (0.85, 0.66, 0.54), 0.5)
    hair = Finish("fabric", color(generator), 0.3)
    trunk: list[tuple[Primitive, Finish]] = [
        (Box((0.0, 0.0, (hip + 0.84 * height) / 2), 0.0, (0.22, width, 0.84 * height - hip)), shirt),
        (upright(0, 0, 0.05, 0.06 * height, 0.83 * height), skin),
        (Sphere((0.0, 0.0, height - head), 0.0, head), hair),
    ]
    for side in (-1, 1):
        trunk.append((upright(0.02, side * (width / 2 + 0.045), 0.05, 0.36 * height, 0.46 * height), shirt))
    leg = [(upright(0, 0, 0.075, hip, 0), trousers), (Box((0.06, 0.0, 0.04), 0.0, (0.26, 0.1, 0.08)), hair)]
    first = len(finishes)
    parts = [_Part(tuple(solid for solid, _ in trunk), 0, first)]
    finishes += [(finish,) * 6 for _, finish in trunk]
    for side in (-1, 1):
        at = tuple(replace(s, center=(s.center[0], side * 0.09, s.center[2])) for s, _ in leg)
        parts.append(_Part(at, side, len(finishes)))
        finishes += [(finish,) * 6 for _, finish in leg]
    return tuple(parts)
