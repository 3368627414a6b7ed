"""Bringing the color image to the depth camera's view, or the depth image to the color camera's.

Both cameras are pinhole cameras here (`spslam.datasets.lens`). They differ in size, intrinsics and place, so what one
of them sees can be hidden from the other. Whether it is, a depth buffer of the color camera tells: of all points that
fall into a cell of it the nearest counts.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.image_kernels import ColorView, register_color, seen_depth
from spslam.datasets.images import resized_color
from spslam.datasets.lens import sample_depth
from spslam.geometry import inverse

# A point is hidden if the color camera has a surface in front of it that is nearer by this share: more than depth
# changes from pixel to pixel on any one surface, and less than what separates two.
_HIDDEN_SHARE = 0.05
# Farther depth is none that a sensor measures, and would overflow.
_FARTHEST_M = 1e6
# Of a depth image so many rows and columns, or up to twice as many, tell its typical depth.
_SAMPLE_SIDE = 64
_NEIGHBORS = np.ones((3, 3), dtype=np.uint8)
_SAME_VIEW_PX = 0.5


def is_same_view(color: Camera, depth: Camera, color_from_depth: np.ndarray) -> bool:
    """Whether two cameras differ in the number of pixels only, by up to half a pixel of the depth image.

    Args:
        color: the color camera.
        depth: the depth camera.
        color_from_depth: [4, 4], points of the depth camera to points of the color camera.
    """
    if not np.allclose(color_from_depth, np.eye(4), atol=1e-9):
        return False
    resized = color.resized(depth.width, depth.height)
    corners = np.array([[0, 0], [depth.width - 1, depth.height - 1]])
    rays = (corners - (depth.cx, depth.cy)) / (depth.fx, depth.fy)
    seen = rays * (resized.fx, resized.fy) + (resized.cx, resized.cy)
    return bool(np.abs(seen - corners).max() <= _SAME_VIEW_PX)


class _Projection:
    """Where points at given depths on one camera's rays lie in another camera's image.

    With the rays' directions d, and R and t that lead to the other camera, a point is z R d + t, so its pixel is a
    quotient of two linear functions of z, whose coefficients are known beforehand.

    Args:
        source: the camera whose rays they are.
        target: the camera of the image.
        target_from_source: [4, 4].
    """

    def __init__(self, source: Camera, target: Camera, target_from_source: np.ndarray) -> None:
        rotation, offset = target_from_source[:3, :3], target_from_source[:3, 3]
        matrix = target.matrix()
        slopes = source.ray_directions().reshape(-1, 3).astype(np.float64) @ (matrix @ rotation).T
        self._slopes = np.ascontiguousarray(slopes.T.astype(np.float32))
        self._offsets = (matrix @ offset).astype(np.float32)

    def depth(self, z: np.ndarray) -> np.ndarray:
        """Depth in the target camera, float32 [N], of depth z [N] in the source camera."""
        return z * self._slopes[2] + self._offsets[2]

    def pixels(self, z: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """u and v, float32 [N], of depth z [N], whose depth in the target camera is known; -9 behind that camera."""
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.float32(1) / depth
            u, v = ((z * self._slopes[axis] + self._offsets[axis]) * share for axis in (0, 1))
        behind = depth <= 0
        u[behind] = v[behind] = -9
        return u, v


class _DepthBuffer:
    """Nearest depth of the color camera's view, in cells about as large as the depth camera's pixels."""

    def __init__(self, color: Camera, depth: Camera) -> None:
        self.width, self.height = _buffer_size(color, depth)
        self._scale = np.float32(self.width / color.width), np.float32(self.height / color.height)

    def fill(self, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest depth of each cell, float32 [h, w], infinite where none; and the cell of each point, -1 outside.

        Args:
            u: [N], columns of the color image, px.
            v: [N], rows.
            z: [N], m, from the color camera; 0 for points that don't count.
        """
        half = np.float32(0.5)
        x, y = (u + half) * self._scale[0], (v + half) * self._scale[1]
        inside = (x > 0) & (y > 0) & (x < self.width) & (y < self.height)
        # Others may be farther outside than whole numbers reach.
        column, row = (np.where(inside, place, 0).astype(np.int32) for place in (x, y))
        cell = np.where(inside, row * self.width + column, -1)
        counts = np.flatnonzero(inside & (z > 0))
        nearest = np.full(self.height * self.width, np.inf, dtype=np.float32)
        np.minimum.at(nearest, cell[counts], z[counts])
        return nearest.reshape(self.height, self.width), cell


class ColorToDepth:
    """Gives each pixel of the depth image its color; depth stays as it was measured.

    Depth that the color camera does not see, because something nearer hides it or because it lies outside its image,
    comes as 0: it has no color. Pixels without depth get the color of what lies there at the image's median depth, or
    at 1 m where there is none.

    Args:
        color: the color camera.
        depth: the depth camera.
        color_from_depth: float64 [4, 4], points of the depth camera to points of the color camera, m.
        unseen: bool [Hc, Wc], pixels of the color image without content, such as lens distortion leaves; None for none.
    """

    def __init__(
        self, color: Camera, depth: Camera, color_from_depth: np.ndarray, unseen: np.ndarray | None = None
    ) -> None:
        self.camera = depth
        # Of a finer color image several pixels are averaged to one of the depth image.
        ratio = max(int(min(color.fx / depth.fx, color.fy / depth.fy) + 0.5), 1)
        self._size = max(color.width // ratio, 1), max(color.height // ratio, 1)
        color = color.resized(*self._size)
        self._unseen: np.ndarray | None = None
        if unseen is not None:
            self._unseen = cv2.resize(unseen.astype(np.uint8), self._size, interpolation=cv2.INTER_NEAREST)
        is_elsewhere = bool(color_from_depth[:3, 3].any())
        cells = _buffer_size(color, depth) if is_elsewhere else (0, 0)
        self._view = ColorView(
            self._size, (depth.width, depth.height), cells, _pixel_map(color, depth, color_from_depth)
        )

    def __call__(
        self, color: np.ndarray, depth: np.ndarray, *, in_place: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Both images in the depth camera's view.

        Args:
            color: uint8 [Hc, Wc, 3].
            depth: float32 [H, W], m, 0 where nothing was measured.
            in_place: whether `depth` may be written to.

        Returns:
            uint8 [H, W, 3], and float32 [H, W].
        """
        image = resized_color(color, *self._size)
        typical_m = typical_depth(depth)
        return register_color(self._view, image, depth, self._unseen, typical_m, _HIDDEN_SHARE, in_place)

    def depth(self, depth: np.ndarray, *, in_place: bool = False) -> np.ndarray:
        """The depth image, float32 [H, W], as a call returns it, without the color image."""
        return seen_depth(self._view, depth, self._unseen, _HIDDEN_SHARE, in_place)


def typical_depth(depth: np.ndarray) -> float:
    """Median, m, of a depth image [H, W], or of a sample of a large one; 1 where nothing was measured."""
    sample = depth[:: max(depth.shape[0] // _SAMPLE_SIDE, 1), :: max(depth.shape[1] // _SAMPLE_SIDE, 1)]
    measured = sample[sample > 0]
    return float(np.median(measured)) if measured.size else 1.0


def _buffer_size(color: Camera, depth: Camera) -> tuple[int, int]:
    """Width and height of the depth buffer of the color camera's view: cells about as large as depth's pixels."""
    share = min(1.0, depth.fx / color.fx)
    return max(round(share * color.width), 1), max(round(share * color.height), 1)


def _pixel_map(color: Camera, depth: Camera, color_from_depth: np.ndarray) -> np.ndarray:
    """float64 [3, 4]: times (z u, z v, z, 1) of a pixel (u, v) of depth z it gives (w x, w y, w) of the color image."""
    matrix = color.matrix() @ color_from_depth[:3]
    matrix[:, :3] = matrix[:, :3] @ np.linalg.inv(depth.matrix())
    return matrix


class DepthToColor:
    """Gives each pixel of the color image its depth; color stays as it was taken.

    Of several surfaces on the ray of a color pixel the nearest counts. Where the color image is the finer one, depth is
    interpolated on surfaces (`sample_depth`), so that there are no holes.

    Args:
        color: the color camera.
        depth: the depth camera.
        color_from_depth: float64 [4, 4], points of the depth camera to points of the color camera, m.
    """

    def __init__(self, color: Camera, depth: Camera, color_from_depth: np.ndarray) -> None:
        self.camera = color
        self._forward = _Projection(depth, color, color_from_depth)
        self._back = _Projection(color, depth, inverse(color_from_depth))
        self._buffer = _DepthBuffer(color, depth)
        self._offset_z = np.float32(color_from_depth[2, 3])

    def __call__(self, color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both images in the color camera's view.

        Args:
            color: uint8 [H, W, 3].
            depth: float32 [Hd, Wd], m, 0 where nothing was measured.

        Returns:
            uint8 [H, W, 3], and float32 [H, W].
        """
        return color, self.depth(depth)

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """The depth image, float32 [H, W], as a call returns it."""
        z = self._first_guess(depth)
        for sample in (_nearest_depth, sample_depth):
            found, seen = self._measured_there(z, depth, sample)
            agrees = (found > 0) & (np.abs(seen - z) <= np.float32(_HIDDEN_SHARE) * z)
            z = np.where(found > 0, seen, z)
        shape = self.camera.height, self.camera.width
        return np.where(agrees, z, np.float32(0)).reshape(shape)

    def _first_guess(self, depth: np.ndarray) -> np.ndarray:
        """Depth of the color camera's pixels to the nearest cell of the buffer, float32 [N], 0 unknown."""
        z = depth.reshape(-1)
        seen = self._forward.depth(z)
        seen[z <= 0] = 0
        nearest, _ = self._buffer.fill(*self._forward.pixels(z, seen), seen)
        filled = np.where(np.isfinite(nearest), nearest, cv2.erode(nearest, _NEIGHBORS))
        filled[~(filled < _FARTHEST_M)] = 0
        size = self.camera.width, self.camera.height
        return cv2.resize(filled, size, interpolation=cv2.INTER_NEAREST).reshape(-1)

    def _measured_there(self, z: np.ndarray, depth: np.ndarray, sample: _Sample) -> tuple[np.ndarray, np.ndarray]:
        """What the depth camera has on its ray to the points at depth z: its own depth, and that of the color camera.

        Both are float32 [N]. A point at depth z in the color camera and p in the depth camera lies on a ray of the
        latter along which the former's depth grows by (z - t) / p per meter, t being the offset of the cameras.
        """
        there = self._back.depth(z)
        u, v = self._back.pixels(z, there)
        shape = self.camera.height, self.camera.width
        found = sample(depth, u.reshape(shape), v.reshape(shape)).reshape(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = found / there * (z - self._offset_z) + self._offset_z
        seen[~(there > 0)] = 0
        return found, seen


_Sample = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def _nearest_depth(depth: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Depth [h, w] of the pixels nearest to points, 0 outside."""
    return cv2.remap(depth, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
