"""Ops that compare a frame whose pose is in doubt with earlier ones; unchecked, as those of `trusted.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch

from spslam.ops import _library  # noqa: F401

if TYPE_CHECKING:
    from spslam.ops.scene_view import Intrinsics


class ComparedGrid(NamedTuple):
    """Cells of `step` x `step` px over the image of a frame that is compared.

    Attributes:
        step: px.
        rows, columns: of cells.
    """

    step: int
    rows: int
    columns: int


def count_known_surface(
    pixels: tuple[torch.Tensor, torch.Tensor],
    pose: torch.Tensor,
    frames: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    intrinsics: Intrinsics,
    thumbnail_step: int,
    grid: ComparedGrid,
    tolerance: tuple[float, float, float],
    most: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """How many surface points of other frames a frame sees, looks through, and has hidden by something nearer.

    The points are those of the others' depth thumbnails. Of the frame's pixels the first one with a normal in each cell
    counts. What is nearer hides a point only if it is no known surface itself, there or in a cell beside. Computed in
    float64: the same on every device.

    Args:
        pixels: int32 [P, 3] packed, and their normals, float32 [P, 3], 0 where unknown.
        pose: float32 [7] of the frame.
        frames: poses float32 [F, 7], depth thumbnails float16 [F, h, w] (m), and int64 [M] which of these to compare.
        intrinsics, thumbnail_step: of all frames, as of `frame_overlap`.
        grid: cells over the frame's image.
        tolerance: m, and as a share of the depth, within which a depth is that of a point; how many such tolerances
            before or behind it are clearly not.
        most: frames that are counted, those that share most surface with it.

    Returns:
        int64 [3] the counts, zeros where nothing is known; int64 [min(M, most)] places of the frames counted among the
        M, those that share most first.
    """
    records, normals = pixels
    poses, thumbnails, rows = frames
    # The enums in csrc/bindings/known_surface.cpp.
    return torch.ops.spslam.count_known_surface(
        records, normals, pose, poses, thumbnails, rows, list(intrinsics), list(tolerance),
        [thumbnail_step, *grid, most],
    )  # fmt: skip


class DepthCells(NamedTuple):
    """How depth images are looked at in cells, and when depths differ.

    Attributes:
        intrinsics: of the depth images, px.
        unit: of their depth, m.
        step: every how many pixels there is a cell.
        margin: m.
        turn: radians.
        deviations: of depth; depths z differ if they do by more than margin + turn z and so many.
    """

    intrinsics: Intrinsics
    unit: float
    step: int
    margin: float
    turn: float
    deviations: float


def find_moving_cells(
    depth: torch.Tensor,
    pose: torch.Tensor,
    earlier: tuple[torch.Tensor, torch.Tensor, Sequence[tuple[int, int]]],
    noise: torch.Tensor,
    cells: DepthCells,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where a frame shows what moves, by what earlier frames saw there.

    A cell moves if an earlier frame saw something clearly behind its surface, there and around. It does, too, if an
    earlier one saw surface that the frame sees through, there and around, and no earlier one saw the cell's own. And
    more than half of it and the cells around it must. Computed in float64: the same on every device.

    Args:
        depth: uint16 [H, W] of the frame, 0 where unknown.
        pose: float32 [7] of the frame.
        earlier: cells uint16 [S, h, w] of earlier frames, poses float32 [F, 7], and rows of both for each, at most 16.
        noise: float32 [2 or more] a^2 (m^2) and c^2 (1/m^2) of the variance of a depth z, a^2 + c^2 z^4.
        cells: how images are looked at.

    Returns:
        uint8 [h, w], 1 in cells that move and those around; int32 [2], how many move, those around not counted, and how
        many have depth.
    """
    grids, poses, rows = earlier
    # The enums in csrc/bindings/moving_objects.cpp.
    return torch.ops.spslam.find_moving_cells(
        depth, pose, grids, poses, noise, [*cells.intrinsics, cells.unit, cells.margin, cells.turn, cells.deviations],
        cells.step, [number for row in rows for number in row],
    )  # fmt: skip


class SampleSteps(NamedTuple):
    """Of which pixels of a frame its images are.

    Attributes:
        image: every how many pixels of the frame the depth image has one.
        thumbnail: the depth thumbnail, the middle of so many.
        cells: every how many pixels of the depth image there is a cell.
    """

    image: int
    thumbnail: int
    cells: int


def leave_out_moving(
    samples: tuple[torch.Tensor, ...],
    cells: torch.Tensor,
    counts: torch.Tensor,
    steps: SampleSteps,
    shares: tuple[float, float],
    fewest: int,
) -> tuple[torch.Tensor, ...]:
    """A frame's pixels without those in cells that move: there is no depth there, and their records are other pixels'.

    The k-th record there becomes the k-th outside, counted round. All is as it was where the share of cells that move
    does not lie between two limits, or too few records are left; the device decides.

    Args:
        samples: records int32 [P, 3], normals float32 [P, 3], depth image uint16 [H, W], and depth thumbnail float16.
        cells, counts: of `find_moving_cells`.
        steps: of which pixels these are.
        shares: of the cells with depth, the limits.
        fewest: records that must be left.

    Returns:
        The same four, as tensors of their own.
    """
    # The enums in csrc/bindings/moving_objects.cpp.
    return torch.ops.spslam.leave_out_moving(*samples, cells, counts, list(shares), [*steps, fewest])


class ShownImages(NamedTuple):
    """A frame's small images.

    Attributes:
        depth: uint16 [h, w] in `unit` m, 0 where unknown.
        intensity: uint8 [h, w] in 1/255.
        intrinsics: of these images.
        unit: m.
    """

    depth: torch.Tensor
    intensity: torch.Tensor
    intrinsics: Intrinsics
    unit: float


def brightness_sums(
    frames: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    points: int,
    intrinsics: Intrinsics,
    size: tuple[int, int],
    cells: int,
    pose: torch.Tensor,
    shown: ShownImages,
    tolerance: float,
) -> torch.Tensor:
    """Sums of the brightness that frames have seen and of what another one's images show there.

    A point counts where the images show it inside of them and its depth is that of the nearest pixel. Brightness is
    summed as whole numbers of 1/65535, and geometry computed in float64: the same on every device.

    Args:
        frames: records int32 [F, P, 3] and poses float32 [F, 7] of frames, and int64 [M] which of these to compare.
        points: how many records of each count.
        intrinsics: of the images that the records are of.
        size: rows and columns of these.
        cells: in a row and in a column, of the images that the records are of.
        pose: float32 [7] of the frame shown.
        shown: its images.
        tolerance: of a point's depth, as a share of it.

    Returns:
        float64 [5]: sums of 1, of b, and of the squares and products m m, b b and m b of the deviations from the means
        of each cell of each frame, for the brightness m in [0, 1] that was seen and b that is shown.
    """
    records, poses, rows = frames
    # The enums in csrc/bindings/brightness_sums.cpp.
    return torch.ops.spslam.brightness_sums(
        records, poses, rows, pose, shown.depth, shown.intensity,
        [*intrinsics, *shown.intrinsics, shown.unit, tolerance], [size[1], size[0], cells, points],
    )  # fmt: skip


@torch.library.register_fake("spslam::find_moving_cells")
def _(depth, pose, earlier, *_):
    return depth.new_empty(earlier.shape[1:], dtype=torch.uint8), depth.new_empty(2, dtype=torch.int32)


@torch.library.register_fake("spslam::leave_out_moving")
def _(records, normals, depth, thumbnail, *_):
    return tuple(torch.empty_like(each) for each in (records, normals, depth, thumbnail))


@torch.library.register_fake("spslam::brightness_sums")
def _(records, poses, *_):
    return poses.new_empty(5, dtype=torch.float64)


@torch.library.register_fake("spslam::count_known_surface")
def _(records, normals, pose, poses, depth_thumbnails, rows, intrinsics, scalars, integers):
    return rows.new_empty(3), rows.new_empty(min(rows.shape[0], integers[-1]))
