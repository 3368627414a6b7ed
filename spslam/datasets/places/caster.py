"""Ray casting of many solids: each is intersected in its window of the image alone, near ones first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spslam.camera import Camera
from spslam.datasets.primitives import Box, Primitive
from spslam.geometry import inverse

# Pixels around a solid's projection; with one pose per row, also this share of how far it moves in the image.
_MARGIN_PX = 1.0
_MOTION_MARGIN = 0.25
# Edges are cut where they pass the camera's plane.
_NEAR_M = 1e-3
# Rays along an axis would divide by zero.
_SMALLEST = np.float32(1e-9)
_EDGES = np.array([(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit])


@dataclass(frozen=True)
class Rays:
    """The rays of an image, in world axes.

    Attributes:
        origins: float64 [3, 1 or H, 1]; one for each row where the image is read row by row.
        directions: float32 [3, H, W]; their camera z is 1, so that distances along them are depth.
        poses: float64 [1 or H, 4, 4], of the rows.
    """

    origins: np.ndarray
    directions: np.ndarray
    poses: np.ndarray

    @classmethod
    def of(cls, camera: Camera, poses: np.ndarray) -> Rays:
        """The rays through all pixel centers.

        Args:
            camera: of the image.
            poses: [4, 4], or one for each row [H, 4, 4].
        """
        poses = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
        across, down, forward = np.moveaxis(poses[:, :3, :3], (2, 1), (0, 1))[..., None]
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
        directions = (across * x).astype(np.float32) + (down * y + forward).astype(np.float32)
        directions[np.abs(directions) < _SMALLEST] = _SMALLEST
        return cls(poses[:, :3, 3].T[:, :, None], directions, poses)

    def points(self, depth: np.ndarray) -> np.ndarray:
        """World points float32 [3, H, W] at depths [H, W]."""
        return self.directions * depth + self.origins.astype(np.float32)

    def within(self, window: tuple[slice, slice]) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions of the rays in a window of rows and columns."""
        rows = window[0] if self.origins.shape[1] > 1 else slice(None)
        return self.origins[:, rows], self.directions[(slice(None), *window)]


class Caster:
    """Finds what each ray meets first in a scene of solids within a shell.

    Args:
        shell: a box seen from inside; its yaw must be 0.
        solids: what stands in it.
    """

    def __init__(self, shell: Box, solids: Sequence[Primitive]) -> None:
        self._shell = shell
        self._solids = tuple(solids)
        self._corners = np.array([solid.corners() for solid in solids]).reshape(-1, 8, 3)

    def cast(self, camera: Camera, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
        """Depth float32 [H, W] and the solid's index int16 [H, W], -1 for the shell."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            inverses = 1 / rays.directions
            depth = self._shell_depth(rays, inverses)
            owner = np.full(depth.shape, -1, dtype=np.int16)
            for number, nearest, window in self._in_view(camera, rays.poses):
                visible = _shrink(window, depth, nearest)
                if visible is not None:
                    self._add(number, visible, (rays, inverses), (depth, owner))
        return depth, owner

    def window(self, camera: Camera, poses: np.ndarray) -> tuple[slice, slice]:
        """Rows and columns of the image in which all solids that are in view lie; empty ones where none is.

        Args:
            camera: of the image.
            poses: [1, 4, 4], or one for each row [H, 4, 4].
        """
        with np.errstate(invalid="ignore"):  # boxes behind the camera are infinite
            windows = [window for _, _, window in self._in_view(camera, poses)]
        if not windows:
            return slice(0, 0), slice(0, 0)
        rows, columns = zip(*windows, strict=True)
        first, last = ([pick(each) for each in (rows, columns)] for pick in (_first, _last))
        return slice(first[0], last[0]), slice(first[1], last[1])

    def _shell_depth(self, rays: Rays, inverses: np.ndarray) -> np.ndarray:
        low, high = _bounds(self._shell)
        exits = [
            np.where(inverses[axis] > 0, np.float32(high[axis]), np.float32(low[axis])) - _single(rays.origins[axis])
            for axis in range(3)
        ]
        for axis in range(3):
            exits[axis] *= inverses[axis]
        return np.minimum(np.minimum(exits[0], exits[1]), exits[2])

    def _add(
        self,
        number: int,
        window: tuple[slice, slice],
        rays: tuple[Rays, np.ndarray],
        image: tuple[np.ndarray, np.ndarray],
    ) -> None:
        solid, (depth, owner) = self._solids[number], image
        origins, directions = rays[0].within(window)
        if isinstance(solid, Box) and solid.yaw == 0:
            hit, nearer = _box_entry(solid, origins, rays[1][(slice(None), *window)])
        else:
            hit = solid.intersect(origins, directions)
            nearer = hit > 0
        nearer &= hit < depth[window]
        np.copyto(depth[window], hit, where=nearer)
        np.copyto(owner[window], np.int16(number), where=nearer)

    def _in_view(self, camera: Camera, poses: np.ndarray) -> list[tuple[int, float, tuple[slice, slice]]]:
        """Index, least depth and window of the solids that may be in the image, near ones first."""
        if not self._solids:
            return []
        some = poses[np.unique([0, len(poses) // 2, len(poses) - 1])]
        boxes = np.array([_image_box(camera, self._corners, pose) for pose in some])
        low, high, nearest = boxes[..., :2].min(axis=0), boxes[..., 2:4].max(axis=0), boxes[..., 4].min(axis=0)
        if len(poses) > 1:
            moved = np.maximum(np.ptp(boxes[..., :2], axis=0), np.ptp(boxes[..., 2:4], axis=0))
            moved = np.where(np.isfinite(moved), moved, 0) * _MOTION_MARGIN
            low, high = low - moved - _MARGIN_PX, high + moved + _MARGIN_PX
        size = np.array([camera.width, camera.height])
        first = np.clip(np.floor(low - _MARGIN_PX), 0, size).astype(int)
        last = np.clip(np.ceil(high + _MARGIN_PX) + 1, 0, size).astype(int)
        seen = np.flatnonzero((first < last).all(axis=1))
        return [
            (int(i), float(nearest[i]), (slice(first[i, 1], last[i, 1]), slice(first[i, 0], last[i, 0])))
            for i in seen[np.argsort(nearest[seen], kind="stable")]
        ]


def _first(slices: Sequence[slice]) -> int:
    return min(each.start for each in slices)


def _last(slices: Sequence[slice]) -> int:
    return max(each.stop for each in slices)


def _image_box(camera: Camera, corners: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Left, top, right, bottom (px) and least depth (m) [N, 5] of boxes with corners [N, 8, 3].

    Empty, with infinities, for a box behind the camera.
    """
    points = corners @ pose[:3, :3] + inverse(pose)[:3, 3]
    ends = points[:, _EDGES]
    z = ends[..., 2]
    crossing = (z[..., 0] > _NEAR_M) != (z[..., 1] > _NEAR_M)
    share = np.where(crossing, (_NEAR_M - z[..., 0]) / np.where(crossing, z[..., 1] - z[..., 0], 1), 0)
    cut = ends[..., 0, :] + share[..., None] * (ends[..., 1, :] - ends[..., 0, :])
    points = np.concatenate((points, cut), axis=1)
    valid = np.concatenate((points[:, :8, 2] > _NEAR_M, crossing), axis=1)
    depth = np.where(valid, np.maximum(points[..., 2], _NEAR_M), 1)
    u = points[..., 0] / depth * camera.fx + camera.cx
    v = points[..., 1] / depth * camera.fy + camera.cy
    low = [np.where(valid, c, np.inf).min(axis=1) for c in (u, v)]
    high = [np.where(valid, c, -np.inf).max(axis=1) for c in (u, v)]
    return np.stack((*low, *high, np.maximum(points[:, :8, 2].min(axis=1), 0)), axis=1)


def _shrink(window: tuple[slice, slice], depth: np.ndarray, nearest: float) -> tuple[slice, slice] | None:
    """The part of a window in which something is farther than `nearest`; None where nothing is."""
    rows, columns = window
    part = depth[window]
    far = np.flatnonzero(part.max(axis=1) > nearest)
    if not len(far):
        return None
    rows = slice(rows.start + far[0], rows.start + far[-1] + 1)
    across = np.flatnonzero(depth[rows, columns].max(axis=0) > nearest)
    return rows, slice(columns.start + across[0], columns.start + across[-1] + 1)


def _box_entry(box: Box, origins: np.ndarray, inverses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter a box without yaw, and whether they do; `inverses` [3, H, W] of the directions."""
    low, high = _bounds(box)
    enter: np.ndarray | None = None
    leave: np.ndarray | None = None
    for axis in range(3):
        to_low, to_high = _single(low[axis] - origins[axis]), _single(high[axis] - origins[axis])
        first, second = to_low * inverses[axis], to_high * inverses[axis]
        if to_low.min() > 0 or to_high.max() < 0:
            # Outside this slab, the near face can only be on this side; away from it, both are negative.
            near, far = (first, second) if to_low.min() > 0 else (second, first)
            enter = near if enter is None else np.maximum(enter, near, out=enter)
        else:
            far = np.maximum(first, second)
            if not (to_low.max() < 0 < to_high.min()):
                near = np.minimum(first, second)
                enter = near if enter is None else np.maximum(enter, near, out=enter)
        leave = far if leave is None else np.minimum(leave, far, out=leave)
    if enter is None or leave is None:
        return np.full(inverses.shape[1:], np.inf, np.float32), np.zeros(inverses.shape[1:], dtype=bool)
    return enter, (enter < leave) & (enter > 0)


def _bounds(box: Box) -> tuple[np.ndarray, np.ndarray]:
    center = np.asarray(box.center)
    return center - box.half_size, center + box.half_size


def _single(value: np.ndarray) -> np.ndarray:
    return np.asarray(value, dtype=np.float32)
