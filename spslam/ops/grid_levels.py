"""What lies where in a feature grid of several resolutions, and tri-planes from images and back."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, NamedTuple

import torch

from spslam.ops._checks import FLOATING, check, check_tensor
from spslam.ops._public import public_op
from spslam.ops._stencils import PLANE_AXES

MAX_GRID_LEVELS = 16  # also csrc/include/spslam/grid_interpolation.h

_MAX_TABLE_ROWS = 2**31 - 1  # rows are numbered in 32 bits where second derivatives are taken
_MAX_SIZE = 2**20

Point = tuple[float, float, float]


class GridLevel(NamedTuple):
    """One level of a grid.

    Attributes:
        lower, upper: its bounds, meters.
        size: texels along x, y and z.
        first_row: where it begins in the table.
        num_rows: rows that it has there.
        hashed: whether its vertices share rows by a hash.
    """

    lower: Point
    upper: Point
    size: tuple[int, int, int]
    first_row: int
    num_rows: int
    hashed: bool


@dataclass(frozen=True)
class TriPlaneLevels:
    """Tri-planes of one or more resolutions, for `interpolate_tri_planes`.

    A level has three planes, xy, xz and yz, of its texels along each axis. With `align_corners` the first and the last
    texel lie on the bounds, else half a texel inside, as in `torch.nn.functional.grid_sample`.

    Attributes:
        levels: what lies where, coarse or fine in any order.
        align_corners: as above.
    """

    levels: tuple[GridLevel, ...]
    align_corners: bool

    @classmethod
    def from_sizes(
        cls, bounds: Sequence[Sequence[float]], sizes: Sequence[Sequence[int]], align_corners: bool = True
    ) -> "TriPlaneLevels":
        """Levels of given sizes.

        Args:
            bounds: (lower, upper), each (x, y, z), meters.
            sizes: texels of each level along (x, y, z).
            align_corners: whether the outermost texels lie on the bounds.

        Raises:
            ValueError: bounds that are empty or not finite, no or more than 16 levels, a size below 1.

        Example:
            >>> grid = TriPlaneLevels.from_sizes([(0, 0, 0), (4, 3, 2)], [(16, 12, 8), (64, 48, 32)])
            >>> grid.num_rows
            7072
        """
        name = "TriPlaneLevels.from_sizes"
        sizes = _list(name, "sizes", sizes)
        return cls(_levels(name, [_bounds(name, bounds)] * len(sizes), sizes, _plane_rows), align_corners)

    @classmethod
    def from_cell_size(
        cls,
        bounds: Sequence[Sequence[float]],
        cell_sizes: Sequence[float | Sequence[float]],
        align_corners: bool = True,
    ) -> "TriPlaneLevels":
        """Levels of given cell sizes; each grows beyond the upper bounds to a whole number of cells.

        Args:
            bounds: (lower, upper), each (x, y, z), meters.
            cell_sizes: of each level the distance between texels, meters: one number, or one for each axis.
            align_corners: whether the outermost texels lie on the bounds.

        Raises:
            ValueError: bounds that are empty or not finite, no or more than 16 levels, a cell size that is
                not positive.

        Example:
            >>> grid = TriPlaneLevels.from_cell_size([(0, 0, 0), (4, 3, 2)], [0.24, (0.06, 0.06, 0.03)])
            >>> [level.size for level in grid.levels]
            [(18, 14, 10), (68, 51, 68)]
        """
        name = "TriPlaneLevels.from_cell_size"
        grown, sizes = _whole_cells(name, bounds, cell_sizes, align_corners)
        return cls(_levels(name, grown, sizes, _plane_rows), align_corners)

    @property
    def num_rows(self) -> int:
        """Rows of the table that has all levels."""
        return self.levels[-1].first_row + self.levels[-1].num_rows

    def to_chw(self, table: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """The planes xy, xz and yz of each level as images [1, C, H, W], what `tri_planes_from_chw` takes.

        Raises:
            TypeError, ValueError: no table of as many rows.
        """
        check_tensor("TriPlaneLevels.to_chw", "table", table, (self.num_rows, "C"), FLOATING)
        result = []
        for level in self.levels:
            images, first = [], level.first_row
            for u, v in PLANE_AXES:
                rows = level.size[u] * level.size[v]
                images.append(table[first : first + rows].view(level.size[u], level.size[v], -1).permute(2, 1, 0)[None])
                first += rows
            result.append((images[0], images[1], images[2]))
        return result


@dataclass(frozen=True)
class VolumeLevels:
    """Volumes of one or more resolutions, dense or hashed, for `interpolate_volumes`.

    Attributes:
        levels: what lies where.
        align_corners: whether the outermost texels lie on the bounds, as in `torch.nn.functional.grid_sample`.
    """

    levels: tuple[GridLevel, ...]
    align_corners: bool

    @classmethod
    def from_sizes(
        cls,
        bounds: Sequence[Sequence[float]],
        sizes: Sequence[Sequence[int]],
        align_corners: bool = True,
        max_level_rows: int | None = None,
    ) -> "VolumeLevels":
        """Levels of given sizes.

        Args:
            bounds: (lower, upper), each (x, y, z), meters.
            sizes: vertices of each level along (x, y, z).
            align_corners: whether the outermost vertices lie on the bounds.
            max_level_rows: most rows of a level, a power of two: a level with more vertices shares rows by a hash
                (Mueller et al., "Instant Neural Graphics Primitives", 2022). None: all levels are dense.

        Raises:
            ValueError: bounds that are empty or not finite, no or more than 16 levels, a size below 1, or a
                `max_level_rows` that is no power of two.

        Example:
            >>> grid = VolumeLevels.from_sizes([(0, 0, 0), (1, 1, 1)], [(16,) * 3, (64,) * 3], max_level_rows=2**14)
            >>> [(level.num_rows, level.hashed) for level in grid.levels]
            [(4096, False), (16384, True)]
        """
        name = "VolumeLevels.from_sizes"
        if max_level_rows is not None:
            power = 1 <= max_level_rows <= 2**30 and max_level_rows & (max_level_rows - 1) == 0
            check(power, name, "max_level_rows", "be a power of two up to 2^30", max_level_rows)
        sizes = _list(name, "sizes", sizes)
        levels = _levels(name, [_bounds(name, bounds)] * len(sizes), sizes, lambda x, y, z: x * y * z, max_level_rows)
        return cls(levels, align_corners)

    @property
    def num_rows(self) -> int:
        """Rows of the table that has all levels."""
        return self.levels[-1].first_row + self.levels[-1].num_rows


@public_op()
def tri_planes_from_chw(
    xy: torch.Tensor | Sequence[torch.Tensor],
    xz: torch.Tensor | Sequence[torch.Tensor],
    yz: torch.Tensor | Sequence[torch.Tensor],
    bounds: Sequence[Sequence[float]],
    align_corners: bool = True,
) -> tuple[torch.Tensor, TriPlaneLevels]:
    """Tri-planes from images as `torch.nn.functional.grid_sample` takes them.

    Differentiable: gradients flow back to the images. To train, make the table a parameter of its own instead, and
    `TriPlaneLevels.to_chw` to go back.

    Args:
        xy, xz, yz: [C, H, W] or [1, C, H, W], or one of them for each level: W along the first axis of the name, H
            along the second, as a `grid` made of points[..., [0, 1]], [0, 2] and [1, 2] reads them.
        bounds: (lower, upper), each (x, y, z), meters: what is -1 and 1 in `grid`.
        align_corners: as given to `grid_sample`.

    Returns:
        table [P, C] and its levels, for `interpolate_tri_planes`.

    Raises:
        TypeError: wrong dtypes.
        ValueError: planes whose sizes or channels do not fit each other, as those of images [H, W, C] do not.

    Example:
        >>> planes = [torch.zeros(1, 8, h, w) for h, w in ((30, 40), (20, 40), (20, 30))]  # 40 x 30 x 20
        >>> table, grid = tri_planes_from_chw(*planes, bounds=[(0, 0, 0), (4, 3, 2)])
        >>> table.shape, grid.levels[0].size
        (torch.Size([2600, 8]), (40, 30, 20))
    """
    name = "tri_planes_from_chw"
    named = {"xy": xy, "xz": xz, "yz": yz}
    lists = {
        key: [value] if isinstance(value, torch.Tensor) else _list(name, key, value) for key, value in named.items()
    }
    counts = {len(images) for images in lists.values()}
    check(len(counts) == 1, name, "planes", "be of as many levels each", sorted(counts))
    rows, sizes = [], []
    for images in zip(*lists.values(), strict=True):
        planes = []
        for (key, _), image in zip(named.items(), images, strict=True):
            check_tensor(name, key, image, None, FLOATING)
            shape = list(image.shape)
            fits = image.ndim == 3 or (image.ndim == 4 and shape[0] == 1)
            check(fits, name, key, "have shape [C, H, W] or [1, C, H, W]", shape)
            planes.append(image.flatten(0, image.ndim - 3))
        (_, y, x), (_, z, _), _ = (tuple(plane.shape) for plane in planes)
        channels = planes[0].shape[0]
        shapes = ((channels, y, x), (channels, z, x), (channels, z, y))
        for key, plane, wanted in zip(named, planes, shapes, strict=True):
            check_tensor(name, key, plane, wanted, planes[0].dtype, like=planes[0])
            rows.append(plane.permute(2, 1, 0).reshape(-1, channels))
        sizes.append((x, y, z))
    channel_counts = {part.shape[1] for part in rows}
    check(len(channel_counts) == 1, name, "planes", "have as many channels on all levels", sorted(channel_counts))
    return torch.cat(rows), TriPlaneLevels.from_sizes(bounds, sizes, align_corners)


def _list(name: str, argument: str, value: Any) -> list:
    """What may be a list, a tuple or an array as a list."""
    if isinstance(value, torch.Tensor):
        return value.tolist()
    if not isinstance(value, Iterable) or isinstance(value, str):
        raise TypeError(f"{name}: {argument} must be a sequence, got {type(value).__name__}")
    return list(value)


def _bounds(name: str, bounds: Sequence[Sequence[float]]) -> tuple[Point, Point]:
    bounds = [_list(name, "each of bounds", corner) for corner in _list(name, "bounds", bounds)]
    shape = len(bounds) == 2 and all(len(corner) == 3 for corner in bounds)
    check(shape, name, "bounds", "be (lower, upper), each of 3 numbers", bounds)
    lower, upper = (tuple(float(number) for number in corner) for corner in bounds)
    fits = all(
        math.isfinite(low) and math.isfinite(high) and low < high for low, high in zip(lower, upper, strict=True)
    )
    check(fits, name, "bounds", "be finite and ascend along every axis", bounds)
    return lower, upper  # type: ignore[return-value]


def _whole_cells(name: str, bounds: Sequence[Sequence[float]], cell_sizes: Sequence, align_corners: bool) -> tuple:
    """Bounds and sizes of levels of whole cells."""
    lower, upper = _bounds(name, bounds)
    grown, sizes = [], []
    for cell_size in _list(name, "cell_sizes", cell_sizes):
        cells = tuple(cell_size) if isinstance(cell_size, Iterable) else (cell_size,) * 3
        fits = len(cells) == 3 and all(cell > 0 and math.isfinite(cell) for cell in cells)
        check(fits, name, "cell_sizes", "be positive, one or three of a level", cell_size)
        # Rounding must not make a cell of a multiple of the cell size.
        counts = [max(math.ceil((high - low) / c - 1e-6), 1) for low, high, c in zip(lower, upper, cells, strict=True)]
        grown.append((lower, tuple(low + n * c for low, n, c in zip(lower, counts, cells, strict=True))))
        sizes.append(tuple(n + int(align_corners) for n in counts))
    return grown, sizes


def _levels(
    name: str, bounds: Sequence, sizes: Sequence[Sequence[int]], rows_of: Callable, max_rows: int | None = None
) -> tuple:
    check(1 <= len(sizes) <= MAX_GRID_LEVELS, name, "sizes", f"be of 1 to {MAX_GRID_LEVELS} levels", len(sizes))
    levels: list[GridLevel] = []
    first = 0
    for (lower, upper), size in zip(bounds, sizes, strict=True):
        size = _list(name, "each of sizes", size)
        fits = len(size) == 3 and all(isinstance(n, Integral) and 1 <= int(n) <= _MAX_SIZE for n in size)
        check(fits, name, "sizes", "be three integers in [1, 2^20] per level", size)
        rows = rows_of(*map(int, size))
        hashed = max_rows is not None and rows > max_rows
        own = rows if max_rows is None else min(rows, max_rows)
        levels.append(GridLevel(lower, upper, (int(size[0]), int(size[1]), int(size[2])), first, own, hashed))
        first += levels[-1].num_rows
    check(first <= _MAX_TABLE_ROWS, name, "sizes", "make a table of at most 2^31 - 1 rows", first)
    return tuple(levels)


def _plane_rows(x: int, y: int, z: int) -> int:
    return x * y + x * z + y * z
