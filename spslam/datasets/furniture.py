"""The layout of the generated room: what stands where, and how it is colored."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from spslam.datasets.primitives import Box, Cylinder, Primitive, Sphere

ROOM_SIZE = (5.0, 4.0, 2.6)
# Pieces sink this far into what carries them, so that no two surfaces coincide.
SINK_M = 0.01

Color = tuple[float, float, float]

_OAK = (0.66, 0.49, 0.32)
_WALNUT = (0.44, 0.31, 0.22)
_WHITE = (0.86, 0.84, 0.79)
_GRAY = (0.50, 0.51, 0.54)
_DARK = (0.22, 0.23, 0.26)
_TEAL = (0.20, 0.47, 0.48)
_NAVY = (0.22, 0.30, 0.50)
_MUSTARD = (0.82, 0.64, 0.25)
_BRICK = (0.70, 0.33, 0.25)
_ROSE = (0.78, 0.55, 0.53)
_LEAF = (0.33, 0.55, 0.30)
_LAMP = (0.95, 0.90, 0.72)
_BOOKS = (_TEAL, _NAVY, _MUSTARD, _BRICK, _ROSE, _LEAF, _WHITE, _DARK)


@dataclass(frozen=True)
class Material:
    """A color with a pattern through space, so that it needs no seams and no texture coordinates.

    Two waves, multiplied and sharpened, give checks or stripes between the color and a darker one; a third, longer
    wave varies the brightness. `color` is RGB in 0..1; `waves` [3,3] are wave vectors in radians a meter,
    `phases` [3]; `contrast` is the share of the color that the pattern takes.
    """

    color: np.ndarray
    waves: np.ndarray
    phases: np.ndarray
    contrast: float


@dataclass(frozen=True)
class Piece:
    """A solid with its material."""

    solid: Primitive
    material: Material


def furnish(seed: int) -> list[Piece]:
    """The furniture of the room; the seed decides on patterns, books and small turns."""
    generator = np.random.default_rng([seed, 1])
    groups: list[Iterable[tuple[Primitive, Color]]] = [
        _round_table(generator),
        _bookshelf(generator),
        _sofa(),
        _desk(),
        _chair(generator),
        _cupboard_and_lamp(),
        _plant_and_stool(generator),
        _on_the_walls(),
    ]
    return [Piece(solid, make_material(generator, color, 0.1, 0.25)) for group in groups for solid, color in group]


def make_material(generator: np.random.Generator, color: Color, shortest_m: float, longest_m: float) -> Material:
    """A random pattern of the given color, its waves between two lengths in meters."""
    lengths = np.exp(generator.uniform(np.log(shortest_m), np.log(longest_m), size=2))
    slant = generator.uniform(-0.25, 0.25)
    across, along = np.array([1, 1 + slant, slant]), np.array([slant, -slant, 1.2])
    broad = generator.normal(size=3)
    waves = np.stack((across / lengths[0], along / lengths[1], broad / np.linalg.norm(broad) / 0.7))
    return Material(
        color=np.asarray(color),
        waves=2 * np.pi * waves,
        phases=generator.uniform(0, 2 * np.pi, 3),
        contrast=float(generator.uniform(0.14, 0.24)),
    )


def standing(x: float, y: float, size: tuple[float, float, float], bottom: float = 0.0, yaw: float = 0.0) -> Box:
    """A box of a size (m) that stands at height `bottom`, sunk into what carries it."""
    height = size[2] + SINK_M
    return Box((x, y, bottom - SINK_M + height / 2), yaw, (size[0], size[1], height))


def upright(x: float, y: float, radius: float, height: float, bottom: float = 0.0) -> Cylinder:
    """A cylinder (m) that stands at height `bottom`, sunk into what carries it."""
    height += SINK_M
    return Cylinder((x, y, bottom - SINK_M + height / 2), 0.0, radius, height)


def _round_table(generator: np.random.Generator) -> Iterable[tuple[Primitive, Color]]:
    yaw = float(generator.uniform(0.2, 0.6))
    yield upright(0.0, 0.0, 0.26, 0.04), _WALNUT
    yield upright(0.0, 0.0, 0.045, 0.66, bottom=0.04), _WALNUT
    yield upright(0.0, 0.0, 0.38, 0.05, bottom=0.68), _OAK
    yield Sphere((0.16, 0.1, 0.84), 0.0, 0.12), _BRICK
    yield standing(-0.14, 0.08, (0.22, 0.16, 0.14), bottom=0.73, yaw=yaw), _TEAL
    yield upright(0.02, -0.19, 0.05, 0.12, bottom=0.73), _MUSTARD


def _bookshelf(generator: np.random.Generator) -> Iterable[tuple[Primitive, Color]]:
    x, y, width, depth = 2.36, -0.9, 1.4, 0.3
    levels = (0.05, 0.45, 0.9, 1.35, 1.8)
    for side in (y - width / 2, y + width / 2):
        yield standing(x, side, (depth, 0.04, 2.0)), _OAK
    for level in levels:
        yield Box((x, y, level), 0.0, (depth, width, 0.04)), _OAK
    for level in levels[:-1]:
        shelf_y = y - width / 2 + 0.05
        while shelf_y < y + width / 2 - 0.2:
            thickness, height = generator.uniform(0.06, 0.16), generator.uniform(0.18, 0.32)
            color = _BOOKS[generator.integers(len(_BOOKS))]
            if generator.uniform() < 0.8:
                size = (0.2, thickness, height)
                yield standing(x + 0.03, shelf_y + thickness / 2, size, bottom=level + 0.02), color
            shelf_y += thickness + 0.015


def _sofa() -> Iterable[tuple[Primitive, Color]]:
    yield standing(-2.05, 0.3, (0.85, 1.5, 0.42)), _NAVY
    yield standing(-2.4, 0.3, (0.2, 1.5, 0.85)), _NAVY
    yield standing(-2.05, -0.52, (0.87, 0.2, 0.6)), _NAVY
    yield standing(-2.05, 1.12, (0.87, 0.2, 0.6)), _NAVY
    yield Sphere((-2.15, -0.2, 0.56), 0.0, 0.19), _ROSE
    yield Box((-2.16, 0.72, 0.6), 0.35, (0.14, 0.42, 0.4)), _MUSTARD


def _desk() -> Iterable[tuple[Primitive, Color]]:
    yield Box((0.6, 1.67, 0.74), 0.0, (1.6, 0.7, 0.05)), _OAK
    yield standing(-0.15, 1.67, (0.06, 0.62, 0.73)), _WHITE
    yield standing(1.25, 1.67, (0.3, 0.6, 0.73)), _WHITE
    yield upright(0.5, 1.75, 0.03, 0.14, bottom=0.765), _DARK
    yield standing(0.5, 1.75, (0.62, 0.05, 0.36), bottom=0.88, yaw=0.12), _DARK
    yield standing(0.42, 1.48, (0.42, 0.14, 0.03), bottom=0.765, yaw=0.06), _GRAY
    yield upright(1.1, 1.6, 0.07, 0.16, bottom=0.765), _BRICK


def _chair(generator: np.random.Generator) -> Iterable[tuple[Primitive, Color]]:
    x, y, yaw = 0.55, 1.05, float(generator.uniform(0.3, 0.7))
    turned = yaw + np.pi / 4
    for leg in yaw + np.pi / 2 * np.arange(4):
        yield upright(x + 0.22 * float(np.cos(leg)), y + 0.22 * float(np.sin(leg)), 0.025, 0.44), _WALNUT
    yield standing(x, y, (0.42, 0.42, 0.05), bottom=0.43, yaw=turned), _MUSTARD
    back_x, back_y = x + 0.19 * float(np.sin(turned)), y - 0.19 * float(np.cos(turned))
    yield standing(back_x, back_y, (0.4, 0.05, 0.46), bottom=0.48, yaw=turned), _MUSTARD


def _cupboard_and_lamp() -> Iterable[tuple[Primitive, Color]]:
    yield standing(-0.5, -1.78, (1.3, 0.46, 0.95)), _WALNUT
    yield standing(-0.75, -1.75, (0.3, 0.22, 0.3), bottom=0.95, yaw=0.5), _TEAL
    yield Sphere((-0.2, -1.72, 1.09), 0.0, 0.15), _WHITE
    yield upright(0.75, -1.6, 0.17, 0.03), _DARK
    yield upright(0.75, -1.6, 0.022, 1.45, bottom=0.02), _DARK
    yield Sphere((0.75, -1.6, 1.58), 0.0, 0.2), _LAMP
    yield upright(1.5, -1.72, 0.16, 0.36), _GRAY


def _plant_and_stool(generator: np.random.Generator) -> Iterable[tuple[Primitive, Color]]:
    yaw = float(generator.uniform(0.3, 1.2))
    yield upright(-1.95, -1.45, 0.2, 0.4), _BRICK
    yield Sphere((-1.95, -1.45, 0.68), 0.0, 0.3), _LEAF
    yield Sphere((-2.1, -1.6, 1.0), 0.0, 0.24), _LEAF
    yield Sphere((-1.85, -1.55, 1.2), 0.0, 0.2), _LEAF
    yield standing(1.45, 0.15, (0.45, 0.45, 0.42), yaw=yaw), _TEAL
    yield standing(-1.6, 1.65, (0.5, 0.5, 1.6), yaw=0.25), _GRAY
    yield standing(2.2, 1.65, (0.45, 0.5, 2.65)), _WHITE


def _on_the_walls() -> Iterable[tuple[Primitive, Color]]:
    yield Box((0.6, 1.99, 1.65), 0.0, (0.9, 0.1, 0.6)), _TEAL
    yield Box((-0.45, -1.99, 1.75), 0.0, (1.0, 0.12, 0.7)), _MUSTARD
    yield Box((-2.49, 0.3, 1.6), 0.0, (0.1, 1.1, 0.7)), _ROSE
    yield Box((2.47, 0.6, 1.5), 0.0, (0.2, 0.9, 0.9)), _NAVY
    yield Cylinder((0.0, 0.0, 2.5), 0.0, 0.25, 0.25), _LAMP
