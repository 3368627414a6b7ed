"""Places of few and repeated parts: a stairwell, an arcade of columns, and a hall."""

from __future__ import annotations

import numpy as np

from spslam.datasets.furniture import SINK_M
from spslam.datasets.places.builder import Builder, tint
from spslam.datasets.places.finish import Finish
from spslam.datasets.places.interiors import furnish, wall_finish
from spslam.datasets.places.pieces import chair, crates, table
from spslam.datasets.places.route import Gaze
from spslam.datasets.primitives import Cylinder

Random = np.random.Generator
_STEPS, _RISE_M, _TREAD_M, _STOREYS = 9, 0.165, 0.27, 3
_SLAB_M = 0.2


def stairwell(generator: Random) -> Builder:
    """Stairs of three storeys around a wall; the way leads up and down again."""
    width, landing = float(generator.uniform(1.25, 1.5)), float(generator.uniform(1.4, 1.6))
    core, climb, run = float(generator.uniform(0.2, 0.4)), _STEPS * _RISE_M, _STEPS * _TREAD_M
    length, across, flights = 2 * landing + run, 2 * width + core, 2 * _STOREYS
    walls = [Finish("plaster", tint(generator, 0.8, 0.08), 2.7) for _ in range(4)]
    stone = Finish(str(generator.choice(["terrazzo", "concrete", "tiles"])), tint(generator, 0.65, 0.06), 1.3)
    shell = [*walls, stone, Finish("plaster", (0.95, 0.95, 0.93), 3.1)]
    plan = Builder(generator, (0, 0, 0), (length, across, flights * climb + 2.6), shell)
    top = plan.shell.size[2] + SINK_M
    plan.box((landing, width, -SINK_M), (landing + run, width + core, top), wall_finish(generator))
    for flight in range(flights):
        _flight(plan, flight, (landing, width, core), stone)
    plan.set_route(
        _stairs_way(flights, (landing, width, core)), Gaze(pitch=-0.12, glance=0.3, glance_m=4.0), 0.6, rounding_m=0.7
    )
    for level in range(flights + 1):
        at, sign = (0.0, 1) if level % 2 == 0 else (length, -1)
        for y in (width / 2, width * 1.5 + core):
            size = (float(generator.uniform(0.5, 0.9)), float(generator.uniform(0.5, 0.9)))
            plan.picture(0, at, sign, (y, level * climb + 1.5), size)
    for level in range(2 * flights):
        side, x = int(generator.integers(2)), float(generator.uniform(0.5, length - 0.5))
        size = (float(generator.uniform(0.3, 0.8)), float(generator.uniform(0.3, 0.6)))
        plan.picture(1, across * side, 1 - 2 * side, (x, level * climb / 2 + 1.7), size)
    return plan


def _flight(plan: Builder, flight: int, sizes: tuple[float, float, float], stone: Finish) -> None:
    """Nine steps up, and the landing that they lead to."""
    landing, width, core = sizes
    climb, run, back = _STEPS * _RISE_M, _STEPS * _TREAD_M, flight % 2 == 1
    low_y, high_y = (width + core, 2 * width + core + SINK_M) if back else (-SINK_M, width)
    for step in range(_STEPS):
        along = landing + (run - (step + 1) * _TREAD_M if back else step * _TREAD_M)
        top = flight * climb + (step + 1) * _RISE_M
        low = (along - SINK_M, low_y, max(top - 0.3, -SINK_M))
        plan.box(low, (along + _TREAD_M + SINK_M, high_y, top), stone)
    top = (flight + 1) * climb
    edge = (-SINK_M, landing) if back else (landing + run, 2 * landing + run + SINK_M)
    plan.box((edge[0], -SINK_M, top - _SLAB_M), (edge[1], 2 * width + core + SINK_M, top), stone)


def _stairs_way(flights: int, sizes: tuple[float, float, float]) -> np.ndarray:
    landing, width, core = sizes
    climb, run, eye, aside = _STEPS * _RISE_M, _STEPS * _TREAD_M, 1.55, 0.13

    def way(flight: int, y: float) -> list[tuple[float, float, float]]:
        """From the middle of one landing to the middle of the next, upward."""
        x = [landing / 2, landing - 0.1, landing + run + 0.1, 1.5 * landing + run]
        rise = np.array([0, 0, 1, 1]) * climb + flight * climb + eye
        return list(zip(x if flight % 2 == 0 else [2 * landing + run - c for c in x], [y] * 4, rise, strict=True))

    lanes = width / 2, 1.5 * width + core
    up = [
        point for flight in range(flights) for point in way(flight, lanes[flight % 2] + aside * (2 * (flight % 2) - 1))
    ]
    down = [
        point
        for flight in reversed(range(flights))
        for point in reversed(way(flight, lanes[flight % 2] - aside * (2 * (flight % 2) - 1)))
    ]
    # Turn around at either end on the side of the other lane.
    last = (landing / 2, lanes[0], flights * climb + eye)
    first = (landing / 2, lanes[1], eye)
    return np.array([*up, last, *down, first])


def arcade(generator: Random) -> Builder:
    """A vaulted walk around a block, its columns and bays all alike; a round is some 70 m."""
    bay, aisle = float(generator.uniform(2.8, 3.2)), float(generator.uniform(1.5, 1.8))
    width, height = float(generator.uniform(5.6, 6.2)), float(generator.uniform(3.8, 4.6))
    bays = 6, int(generator.integers(3, 5))
    # The columns stand on the corners of a rectangle of whole bays.
    inner = np.array(bays) * bay
    edge = width - aisle
    size = inner + 2 * edge
    floor = Finish(str(generator.choice(["tiles", "terrazzo", "concrete"])), tint(generator, 0.7), 2.4)
    wall = Finish(str(generator.choice(["plaster", "bricks", "concrete"])), tint(generator, 0.78), 2.2)
    plan = Builder(
        generator, (0, 0, 0), (*size, height), [wall] * 4 + [floor, Finish("plaster", (0.92, 0.9, 0.86), 2.9)]
    )
    plan.box((edge + aisle, edge + aisle, -SINK_M), (*(size - edge - aisle), height + SINK_M), wall)
    stone = Finish("concrete", tint(generator, 0.75, 0.05), 1.4)
    radius = float(generator.uniform(0.2, 0.3))
    for x, y in _column_places(bays, bay, edge):
        _column(plan, (x, y), radius, height, stone)
    _beams_and_pilasters(plan, bay, edge, stone)
    off = width * 0.42
    corners = [(off, off), (size[0] - off, off), (size[0] - off, size[1] - off), (off, size[1] - off)]
    plan.set_route(
        np.array([(x, y, 1.55) for x, y in corners]), Gaze(pitch=-0.14, glance=0.6, glance_m=9.0), rounding_m=2.6
    )
    for axis in (0, 1):
        for side in (0, 1):
            along = np.arange(edge + bay / 2, size[1 - axis] - edge, bay)
            for center in along[generator.uniform(size=len(along)) < 0.7]:
                panel = (float(generator.uniform(0.6, 1.5)), float(generator.uniform(0.6, 1.3)))
                at = float(size[axis] * side)
                plan.picture(axis, at, 1 - 2 * side, (float(center), float(generator.uniform(1.5, 2.0))), panel)
    return plan


def _column_places(bays: tuple[int, int], bay: float, edge: float) -> list[tuple[float, float]]:
    ring = [(i, j) for i in range(bays[0] + 1) for j in range(bays[1] + 1) if i in (0, bays[0]) or j in (0, bays[1])]
    return [(edge + i * bay, edge + j * bay) for i, j in ring]


def _column(plan: Builder, at: tuple[float, float], radius: float, height: float, stone: Finish) -> None:
    x, y = at
    block = radius + 0.1
    plan.box((x - block, y - block, -SINK_M), (x + block, y + block, 0.3), stone)
    plan.add(Cylinder((x, y, height / 2 - 0.15), 0.0, radius, height - 0.7), stone)
    plan.box((x - block, y - block, height - 0.75), (x + block, y + block, height - 0.5), stone)


def _beams_and_pilasters(plan: Builder, bay: float, edge: float, stone: Finish) -> None:
    """Beams over the columns and across to the outer wall, and pilasters where those meet it."""
    (length, depth, height), half = plan.shell.size, 0.18
    low, top = height - 0.5, height + SINK_M
    for y in (edge, depth - edge):
        plan.box((edge - half, y - half, low), (length - edge + half, y + half, top), stone)
    for x in (edge, length - edge):
        plan.box((x - half, edge - half, low), (x + half, depth - edge + half, top), stone)
    for axis, extent in ((0, length), (1, depth)):
        across = (depth, length)[axis]
        for along in np.arange(edge, extent - edge + bay / 2, bay):
            for ends in ((-SINK_M, edge), (across - edge, across + SINK_M)):
                corners = [[along - 0.12, ends[0], low + 0.1], [along + 0.12, ends[1], top]]
                foot = (ends[0], ends[0] + 0.25) if ends[0] < 0 else (ends[1] - 0.25, ends[1])
                pilaster = [[along - 0.2, foot[0], -SINK_M], [along + 0.2, foot[1], top]]
                for a, b in (corners, pilaster):
                    order = slice(None) if axis == 0 else [1, 0, 2]
                    plan.box(np.array(a)[order], np.array(b)[order], stone)


def hall(generator: Random) -> Builder:
    """A hall of about 15 x 12 m, 5 to 7 m high, with rows of chairs, tables, boxes and beams under the ceiling."""
    size = np.array([generator.uniform(14.4, 15.6), generator.uniform(11, 13), generator.uniform(5.0, 7.0)])
    wall = Finish(str(generator.choice(["plaster", "bricks", "concrete"])), tint(generator, 0.75), 2.8)
    floor = Finish(str(generator.choice(["planks", "tiles", "terrazzo"])), tint(generator, 0.6), 2.6)
    plan = Builder(generator, (0, 0, 0), size, [wall] * 4 + [floor, Finish("concrete", (0.9, 0.9, 0.9), 3.3)])
    steel = Finish("paint", tint(generator, 0.5), 1.1)
    for x in np.arange(2.5, size[0] - 1, 3.0):
        plan.box((x - 0.15, -SINK_M, size[2] - 0.5), (x + 0.15, size[1] + SINK_M, size[2] + SINK_M), steel)
        for y in ((-SINK_M, 0.3), (size[1] - 0.3, size[1] + SINK_M)):
            plan.box((x - 0.2, y[0], -SINK_M), (x + 0.2, y[1], size[2] - 0.45), steel)
            plan.occupy((x - 0.2, y[0], 0), (x + 0.2, y[1], 1))
    inset = 2.7
    corners = [(inset, inset), (size[0] - inset, inset), (size[0] - inset, size[1] - inset), (inset, size[1] - inset)]
    points = np.array([(x, y, 1.5) for x, y in corners])
    plan.set_route(points, Gaze(pitch=-0.14, glance=0.7, glance_m=8.0, side=-0.3), rounding_m=2.4)
    _seats(plan, size)
    furnish(plan, np.zeros(2), size[:2], 12)
    for axis in (0, 1):
        for center in np.arange(1.2, size[1 - axis] - 0.8, 1.5):
            for side in (0, 1):
                panel = (float(generator.uniform(0.8, 1.3)), float(generator.uniform(0.8, 2.0)))
                at = float(size[axis] * side)
                plan.picture(axis, at, 1 - 2 * side, (float(center), float(generator.uniform(1.8, 3.2))), panel)
    return plan


def _seats(plan: Builder, size: np.ndarray) -> None:
    generator = plan.generator
    for y in np.arange(4.2, size[1] - 4.2, 1.2):
        for x in np.arange(4.3, size[0] - 4.3, 0.75):
            if generator.uniform() < 0.7:
                plan.put(chair(generator), float(x), float(y), float(generator.uniform(-0.3, 0.3)))
    for _ in range(12):
        x, y = (float(generator.uniform(3.9, extent - 3.9)) for extent in size[:2])
        make = table if generator.uniform() < 0.4 else crates
        plan.put(make(generator), x, y, float(generator.uniform(0, 6)))
