"""The generated places by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from spslam.datasets.places.builder import Builder
from spslam.datasets.places.interiors import apartment, desk_corner, room
from spslam.datasets.places.place import Place
from spslam.datasets.places.structures import arcade, hall, stairwell

_PLANS: dict[str, Callable[[np.random.Generator], Builder]] = {
    "room": room,
    "apartment": apartment,
    "stairwell": stairwell,
    "arcade": arcade,
    "desk": desk_corner,
    "hall": hall,
}
PLACES = tuple(_PLANS)


@lru_cache(maxsize=4)
def make_place(name: str, seed: int = 0, texture: float = 1.0) -> Place:
    """The place of a name and seed.

    Args:
        name: one of `PLACES`.
        seed: decides on layout, sizes, furniture and colors; the same seed gives the same place.
        texture: contrast of all patterns and pictures, 0 to 1; at 0 every surface has one plain color.

    Raises:
        ValueError: an unknown name, or `texture` outside 0 to 1.
    """
    if name not in _PLANS:
        raise ValueError(f"make_place: name must be one of {', '.join(PLACES)}, got {name}")
    if not 0 <= texture <= 1:
        raise ValueError(f"make_place: texture must be from 0 to 1, got {texture}")
    return Place(_PLANS[name](np.random.default_rng([seed, 31, PLACES.index(name)])), seed, texture)
