"""Furniture of random sizes and colors, each a group of boxes, cylinders and spheres."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spslam.datasets.furniture import SINK_M, standing, upright
from spslam.datasets.places.builder import Group, Part, tint
from spslam.datasets.places.finish import Color, Finish
from spslam.datasets.places.textures import POSTERS
from spslam.datasets.primitives import Box, Sphere

Random = np.random.Generator
_COLORS: tuple[Color, ...] = (
    (0.25, 0.55, 0.56),
    (0.26, 0.36, 0.62),
    (0.90, 0.72, 0.30),
    (0.78, 0.38, 0.28),
    (0.85, 0.62, 0.60),
    (0.40, 0.64, 0.36),
    (0.90, 0.88, 0.84),
    (0.32, 0.33, 0.37),
)
_WOODS: tuple[Color, ...] = ((0.80, 0.60, 0.40), (0.56, 0.40, 0.29), (0.92, 0.80, 0.62), (0.42, 0.31, 0.26))


def color(generator: Random) -> Color:
    """One of the palette's colors, slightly changed."""
    base = np.array(_COLORS[int(generator.integers(len(_COLORS)))]) * generator.uniform(0.85, 1.1, 3)
    red, green, blue = (float(c) for c in np.clip(base, 0.05, 1))
    return red, green, blue


def wood(generator: Random) -> Finish:
    """Wood of a random tone."""
    return Finish("wood", _WOODS[int(generator.integers(len(_WOODS)))], float(generator.uniform(0.5, 1.0)))


def cloth(generator: Random) -> Finish:
    """Fabric of a random color."""
    return Finish("fabric", color(generator), float(generator.uniform(0.5, 0.9)))


def paint(generator: Random) -> Finish:
    """Painted surface of a random color."""
    return Finish("paint", color(generator), float(generator.uniform(0.5, 1.0)))


def printed(generator: Random) -> Finish:
    """Cardboard or a cover with print on it."""
    return Finish("print", tint(generator, 0.7, 0.2), float(generator.uniform(0.3, 0.6)))


def small_things(
    generator: Random, low: tuple[float, float], high: tuple[float, float], bottom: float, count: int
) -> list[Part]:
    """Books, boxes, mugs and balls on a surface between two corners."""
    parts: list[Part] = []
    for _ in range(count):
        x, y = (float(generator.uniform(a + 0.1, b - 0.1)) for a, b in zip(low, high, strict=True))
        if any(np.hypot(x - p[0].center[0], y - p[0].center[1]) < 0.17 for p in parts):
            continue
        kind = generator.uniform()
        if kind < 0.35:
            sizes = (float(generator.uniform(0.1, 0.2)), float(generator.uniform(0.1, 0.2)))
            height = float(generator.uniform(0.02, 0.16))
            yaw = float(generator.uniform(0, np.pi))
            parts.append((standing(x, y, (*sizes, height), bottom, yaw), printed(generator)))
        elif kind < 0.65:
            radius, height = float(generator.uniform(0.03, 0.07)), float(generator.uniform(0.08, 0.2))
            parts.append((upright(x, y, radius, height, bottom), paint(generator)))
        else:
            radius = float(generator.uniform(0.04, 0.08))
            parts.append((Sphere((x, y, bottom + radius - SINK_M / 2), 0.0, radius), paint(generator)))
    return parts


def table(generator: Random) -> Group:
    """A table with things on it."""
    width, depth = float(generator.uniform(1.0, 1.7)), float(generator.uniform(0.7, 0.95))
    height, finish = float(generator.uniform(0.7, 0.78)), wood(generator)
    parts: list[Part] = [(Box((0, depth / 2, height - 0.02), 0.0, (width, depth, 0.04)), finish)]
    for x in (0.06 - width / 2, width / 2 - 0.06):
        for y in (0.06, depth - 0.06):
            parts.append((standing(x, y, (0.06, 0.06, height - 0.03)), finish))
    corners = (-width / 2, 0.0), (width / 2, depth)
    return Group((*parts, *small_things(generator, *corners, height, 7)), width, depth)


def desk(generator: Random) -> Group:
    """A desk with drawers, a screen, a keyboard and things."""
    width, depth, top = float(generator.uniform(1.2, 1.7)), 0.7, 0.74
    finish, dark = wood(generator), Finish("paint", (0.25, 0.26, 0.3), 0.6)
    screen_x = float(generator.uniform(-0.2, 0.2))
    screen = Box((screen_x, 0.2, top + 0.33), float(generator.uniform(-0.2, 0.2)), (0.6, 0.05, 0.36))
    parts: list[Part] = [
        (Box((0, depth / 2, top - 0.025), 0.0, (width, depth, 0.05)), finish),
        (standing(0.05 - width / 2, depth / 2, (0.05, depth - 0.06, top - 0.04)), finish),
        (standing(width / 2 - 0.22, depth / 2, (0.4, depth - 0.06, top - 0.04)), paint(generator)),
        (upright(screen_x, 0.2, 0.1, 0.015, top), dark),
        (upright(screen_x, 0.2, 0.025, 0.2, top), dark),
        (screen, Finish(f"poster{int(generator.integers(POSTERS))}", (0.9, 0.9, 0.9), None)),
        (standing(screen_x, 0.48, (0.42, 0.14, 0.03), top, 0.05), printed(generator)),
    ]
    for low, high in (((-width / 2, 0.05), (screen_x - 0.3, 0.65)), ((screen_x + 0.3, 0.05), (width / 2, 0.65))):
        if high[0] - low[0] > 0.25:
            parts += small_things(generator, low, high, top, 4)
    return Group(tuple(parts), width, depth)


def bookshelf(generator: Random) -> Group:
    """A shelf with books and boxes."""
    width, depth, height = float(generator.uniform(0.8, 1.5)), 0.3, float(generator.uniform(1.5, 2.0))
    finish, levels = wood(generator), np.linspace(0.06, height - 0.02, int(generator.integers(4, 6)))
    parts: list[Part] = [(standing(0, 0.01, (width, 0.02, height)), finish)]
    parts += [(standing(x, depth / 2, (0.04, depth, height)), finish) for x in (-width / 2, width / 2)]
    parts += [(Box((0, depth / 2, float(z)), 0.0, (width, depth, 0.03)), finish) for z in levels]
    room = float(levels[1] - levels[0]) - 0.06
    for level in levels[:-1]:
        x = 0.04 - width / 2
        while x < width / 2 - 0.2:
            thickness = float(generator.uniform(0.05, 0.16))
            size = (thickness, float(generator.uniform(0.15, 0.25)), room * float(generator.uniform(0.55, 1)))
            if generator.uniform() < 0.75:
                place = (x + thickness / 2, 0.03 + size[1] / 2)
                parts.append((standing(*place, size, float(level) + 0.015), printed(generator)))
            x += thickness + 0.012
    return Group(tuple(parts), width + 0.04, depth)


def sofa(generator: Random) -> Group:
    """A sofa with cushions."""
    width, finish = float(generator.uniform(1.4, 2.0)), cloth(generator)
    parts: list[Part] = [
        (standing(0, 0.43, (width, 0.84, 0.42)), finish),
        (standing(0, 0.11, (width, 0.2, 0.85)), finish),
    ]
    parts += [(standing(x, 0.43, (0.2, 0.85, 0.6)), finish) for x in (0.09 - width / 2, width / 2 - 0.09)]
    parts.append((Sphere((0.25 - width / 2 + 0.15, 0.42, 0.58), 0.0, 0.18), cloth(generator)))
    parts.append((Box((width / 2 - 0.42, 0.4, 0.58), 0.4, (0.4, 0.14, 0.4)), cloth(generator)))
    return Group(tuple(parts), width, 0.86)


def cupboard(generator: Random) -> Group:
    """A low or high cupboard; things on the low one."""
    width, depth = float(generator.uniform(0.7, 1.4)), float(generator.uniform(0.4, 0.55))
    height = float(generator.choice([0.85, 1.9]))
    parts: list[Part] = [(standing(0, depth / 2, (width, depth, height)), wood(generator))]
    for x in (-width / 4, width / 4):
        knob = Sphere((x, depth + 0.01, height * 0.6), 0.0, 0.025)
        parts.append((knob, Finish("paint", (0.3, 0.3, 0.3), 0.5)))
    if height < 1:
        parts += small_things(generator, (-width / 2, 0.0), (width / 2, depth), height, 5)
    return Group(tuple(parts), width, depth + 0.03)


def bed(generator: Random) -> Group:
    """A bed with pillow and blanket."""
    width, frame = float(generator.uniform(0.9, 1.5)), wood(generator)
    parts: list[Part] = [
        (standing(0, 1.0, (width, 2.0, 0.3)), frame),
        (standing(0, 0.03, (width, 0.06, 0.9)), frame),
        (standing(0, 1.02, (width - 0.06, 1.9, 0.2), 0.3), cloth(generator)),
        (standing(0, 0.35, (width * 0.7, 0.4, 0.12), 0.5, 0.06), cloth(generator)),
        (standing(0, 1.45, (width - 0.02, 1.08, 0.04), 0.5), Finish("carpet", color(generator), 1.2)),
    ]
    return Group(tuple(parts), width, 2.05)


def chair(generator: Random) -> Group:
    """A chair."""
    frame, seat = wood(generator), cloth(generator)
    parts: list[Part] = [(standing(0, 0.22, (0.42, 0.42, 0.05), 0.42), seat)]
    parts += [(standing(x, y, (0.04, 0.04, 0.43)), frame) for x in (-0.18, 0.18) for y in (0.04, 0.4)]
    parts.append((standing(0, 0.04, (0.4, 0.04, 0.45), 0.46), seat))
    return Group(tuple(parts), 0.44, 0.44)


def plant(generator: Random) -> Group:
    """A plant in a pot."""
    radius = float(generator.uniform(0.15, 0.22))
    pot: Part = (upright(0, 0.3, radius, 0.38), paint(generator))
    leaves: list[Part] = [(upright(0, 0.3, 0.03, 0.3, 0.38), Finish("wood", (0.4, 0.3, 0.2), 0.4))]
    for height, size in ((0.72, 0.26), (0.98, 0.22), (1.2, 0.16)):
        x, y = (float(c) for c in generator.uniform(-0.08, 0.08, 2))
        leaves.append((Sphere((x, 0.3 + y, height), 0.0, size), Finish("terrazzo", (0.42, 0.68, 0.36), 0.8)))
    return Group((pot, *leaves), 0.66, 0.66)


def lamp(generator: Random) -> Group:
    """A standing lamp."""
    height, dark = float(generator.uniform(1.3, 1.7)), Finish("paint", (0.3, 0.3, 0.33), 0.4)
    shade = Sphere((0, 0.2, height + 0.12), 0.0, 0.18)
    parts = ((upright(0, 0.2, 0.16, 0.03), dark), (upright(0, 0.2, 0.022, height, 0.02), dark))
    return Group((*parts, (shade, Finish("fabric", (0.98, 0.93, 0.78), 0.4))), 0.4, 0.4)


def crates(generator: Random) -> Group:
    """A pile of cardboard boxes."""
    parts: list[Part] = []
    top = 0.0
    for _ in range(int(generator.integers(2, 5))):
        size = tuple(float(s) for s in generator.uniform(0.3, 0.55, 3))
        brown = Finish("print", (0.78, 0.62, 0.44), float(generator.uniform(0.4, 0.8)))
        yaw = float(generator.uniform(-0.3, 0.3))
        parts.append((standing(0, 0.4, (size[0], size[1], size[2]), top, yaw), brown))
        top += size[2]
        if top > 1.3:
            break
    return Group(tuple(parts), 0.8, 0.8)


FURNITURE: tuple[Callable[[Random], Group], ...] = (
    table,
    desk,
    bookshelf,
    sofa,
    cupboard,
    bed,
    chair,
    plant,
    lamp,
    crates,
)
