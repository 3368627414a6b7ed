"""Furnished places: a room, an apartment along a corridor, and a desk seen from near."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spslam.datasets.places.builder import Builder, tint
from spslam.datasets.places.finish import Finish
from spslam.datasets.places.pieces import FURNITURE, bookshelf, chair, desk, lamp, plant, table
from spslam.datasets.places.route import Gaze

Random = np.random.Generator
_EYE_M = 1.45
_WALLS = ("plaster", "plaster", "wallpaper", "bricks")
_FLOORS = ("planks", "tiles", "carpet", "terrazzo")
_WALL_GAP_M = 0.04
_DOOR_M = 0.95

# West, east, south, north: where the back of furniture is, and how it is turned to face inward.
_SIDES = ((0, 0, -np.pi / 2), (0, 1, np.pi / 2), (1, 0, 0.0), (1, 1, np.pi))


def room(generator: Random) -> Builder:
    """A room of 16 to 38 m2 with furniture along the walls and a table in the middle."""
    size = np.array([generator.uniform(4.6, 6.8), generator.uniform(4.0, 5.6), generator.uniform(2.4, 3.0)])
    plan = Builder(generator, (0, 0, 0), size, shell_finishes(generator))
    center, around = size[:2] / 2, np.maximum(size[:2] / 2 - 1.35, (0.95, 0.8))
    turn = 2 * np.pi * np.arange(48) / 48
    height = _EYE_M + 0.12 * np.sin(2 * turn + 1)
    points = np.stack((center[0] + around[0] * np.cos(turn), center[1] + around[1] * np.sin(turn), height), axis=1)
    plan.set_route(points, Gaze((*center, 0.75), glance=0.3, glance_m=3.0, pitch=0.1), pace=0.8)
    plan.put(table(generator), center[0], center[1] - 0.4, float(generator.uniform(-0.1, 0.1)))
    furnish(plan, np.zeros(2), size[:2], 14)
    hang_pictures(plan, np.zeros(2), size[:2], 6)
    return plan


def apartment(generator: Random) -> Builder:
    """Seven rooms along a corridor; the way leads through all of them and is over 60 m long.

    The rooms to the north are joined by doors and make a loop with the corridor; those to the south have one door.
    """
    corridor, wall = float(generator.uniform(1.7, 2.1)), 0.12
    depths = generator.uniform(3.8, 4.6, 2)
    north, south = generator.uniform(4.2, 5.1, 4), generator.uniform(4.6, 6.0, 3)
    length = float(north.sum())
    south = south * length / south.sum()
    low, high = (0.0, -corridor / 2 - depths[1]), (length, corridor / 2 + depths[0])
    height = float(generator.uniform(2.4, 2.7))
    plan = Builder(generator, (*low, 0), (*high, height), shell_finishes(generator))
    north_edges, south_edges = np.concatenate(([0], north.cumsum())), np.concatenate(([0], south.cumsum()))
    north_doors = north_edges[:-1] + north * generator.uniform(0.4, 0.6, 4)
    south_doors = south_edges[:-1] + south * generator.uniform(0.42, 0.58, 3)
    between = corridor / 2 + depths[0] * float(generator.uniform(0.42, 0.52))
    finish = wall_finish(generator)
    for at, doors in (
        ((corridor / 2, corridor / 2 + wall), north_doors),
        ((-corridor / 2 - wall, -corridor / 2), south_doors),
    ):
        plan.wall(0, at, (0, length), finish, [(float(x), _DOOR_M) for x in doors])
    for x in north_edges[1:-1]:
        span = (corridor / 2 + wall, high[1])
        plan.wall(1, (x - wall / 2, x + wall / 2), span, wall_finish(generator), [(between, _DOOR_M)])
    for x in south_edges[1:-1]:
        plan.wall(1, (x - wall / 2, x + wall / 2), (low[1], -corridor / 2 - wall), wall_finish(generator))
    points = _apartment_way(generator, (corridor, between), (north_doors, south_doors), (south, depths[1]))
    plan.set_route(points, Gaze(pitch=-0.2, glance=0.45, glance_m=5.0), pace=0.9)
    for edges, y in ((north_edges, (corridor / 2 + wall, high[1])), (south_edges, (low[1], -corridor / 2 - wall))):
        for left, right in zip(edges[:-1], edges[1:], strict=True):
            area = np.array([left + wall / 2, y[0]]), np.array([right - wall / 2, y[1]])
            furnish(plan, *area, 9)
            hang_pictures(plan, *area, 4)
    hang_pictures(plan, np.array([0.0, -corridor / 2]), np.array([length, corridor / 2]), 14)
    return plan


def _apartment_way(
    generator: Random,
    corridor: tuple[float, float],
    doors: tuple[np.ndarray, np.ndarray],
    south: tuple[np.ndarray, float],
) -> np.ndarray:
    """Along the corridor with a round through each southern room, then back through the northern rooms."""
    (width, between), (north_doors, south_doors), (widths, depth) = corridor, doors, south
    eye, far, near = _EYE_M + float(generator.uniform(-0.05, 0.1)), -width / 2 - depth * 0.62, -width / 2 - depth * 0.34
    points = [(north_doors[0], 0.0)]
    for x, room_width in zip(south_doors, widths, strict=True):
        reach = room_width * 0.22
        points += [(x, 0.0), (x, near + 0.45), (x - reach, near - 0.3), (x - reach, far), (x + reach, far)]
        points += [(x + reach, near - 0.3), (x, near + 0.45), (x, 0.0)]
    points += [(north_doors[-1], 0.0), (north_doors[-1], between)]
    points += [(x, between) for x in north_doors[-2:0:-1]]
    points += [(north_doors[0], between)]
    return np.array([(x, y, eye) for x, y in points])


def desk_corner(generator: Random) -> Builder:
    """A desk in the corner of a room, seen from 0.4 to 1 m."""
    size = (3.2, 2.8, 2.5)
    plan = Builder(generator, (-1.6, 0, 0), (1.6, size[1], size[2]), shell_finishes(generator))
    turn = 2 * np.pi * np.arange(48) / 48
    eye = np.stack(
        (0.42 * np.cos(turn), 0.82 + 0.2 * np.sin(turn), 1.22 + 0.08 * np.sin(2 * turn + generator.uniform(0, 6))),
        axis=1,
    )
    plan.set_route(eye, Gaze((0.0, 0.28, 0.85), pitch=0.0, glance=0.25, glance_m=1.6), pace=0.35, rounding_m=0.2)
    for _ in range(30):
        if plan.put(desk(generator), 0.0, _WALL_GAP_M, 0.0):
            break
    furnish(plan, np.array([-1.6, 0.0]), np.array([1.6, size[1]]), 3)
    for x in (-0.55, 0.1, 0.7):
        plan.picture(1, 0.0, 1, (x, float(generator.uniform(1.35, 1.6))), (0.4, float(generator.uniform(0.3, 0.5))))
    hang_pictures(plan, np.array([-1.6, 0.0]), np.array([1.6, size[1]]), 6)
    return plan


def shell_finishes(generator: Random) -> list[Finish]:
    """Finishes of four walls, the floor and the ceiling."""
    walls = [wall_finish(generator) for _ in range(4)]
    floor = _FLOORS[int(generator.integers(len(_FLOORS)))]
    tone = (0.82, 0.66, 0.5) if floor == "planks" else tint(generator, 0.6)
    return [*walls, Finish(floor, tone, 2.4), Finish("plaster", (0.97, 0.97, 0.95), 3.1)]


def wall_finish(generator: Random) -> Finish:
    """A wall's finish: plaster, wallpaper or bricks of a light color."""
    texture = _WALLS[int(generator.integers(len(_WALLS)))]
    return Finish(texture, tint(generator, 0.72), 1.6 if texture == "bricks" else 2.7)


def furnish(plan: Builder, low: np.ndarray, high: np.ndarray, count: int) -> None:
    """Puts up to so many pieces of furniture along the walls of an area between two corners."""
    generator, placed = plan.generator, 0
    wanted = [bookshelf, desk, chair, plant, lamp]
    for attempt in range(8 * count):
        make = wanted[attempt] if attempt < len(wanted) else FURNITURE[int(generator.integers(len(FURNITURE)))]
        group = make(generator)
        axis, end, yaw = _SIDES[int(generator.integers(4))]
        span = low[1 - axis] + group.width / 2 + 0.05, high[1 - axis] - group.width / 2 - 0.05
        if span[0] >= span[1]:
            continue
        along = float(generator.uniform(*span))
        across = float(high[axis] - _WALL_GAP_M if end else low[axis] + _WALL_GAP_M)
        x, y = (across, along) if axis == 0 else (along, across)
        placed += plan.put(group, x, y, yaw)
        if placed == count:
            return


def hang_pictures(
    plan: Builder, low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray, count: int
) -> None:
    """Hangs pictures on the walls of an area, where they fit."""
    generator = plan.generator
    for _ in range(count):
        axis, end = (int(n) for n in generator.integers(0, 2, 2))
        size = (float(generator.uniform(0.4, 1.1)), float(generator.uniform(0.4, 0.8)))
        span = low[1 - axis] + size[0] / 2 + 0.1, high[1 - axis] - size[0] / 2 - 0.1
        along, height = float(generator.uniform(min(span), max(span))), float(generator.uniform(1.4, 1.75))
        plan.picture(axis, float(high[axis] if end else low[axis]), -1 if end else 1, (along, height), size)
