"""The images that the viewer shows of a frame: color and depth, beside the map's rendering from the same pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError
from spslam.evaluation.renders import render_view
from spslam.meshing import Mesh
from spslam.scene import Scene

WIDTH_PX = 320
# The map is rendered by a z-buffer in NumPy, whose time goes with the pixels.
RENDERED_WIDTH_PX = 160
_MISSING = 40  # gray of pixels without depth or surface
_GAP_PX = 4


@dataclass(frozen=True)
class FrameImages:
    """Images of one frame, all of one size.

    Attributes:
        row: of the frame.
        color: uint8 [h, w, 3] RGB.
        depth: float32 [h, w], m, 0 where unknown; None where it is not known.
        map_color: uint8 [h, w, 3], the map's rendering; None without a map.
        map_depth: float32 [h, w], m, likewise.
    """

    row: int
    color: np.ndarray
    depth: np.ndarray | None = None
    map_color: np.ndarray | None = None
    map_depth: np.ndarray | None = None

    def with_map(self, scene: Scene, mesh: Mesh, camera: Camera, pose: np.ndarray) -> FrameImages:
        """The same, with the map rendered from `pose` (float64 [4, 4] T_world_camera)."""
        height, width = self.color.shape[:2]
        small = camera.resized(RENDERED_WIDTH_PX, max(round(RENDERED_WIDTH_PX * height / width), 1))
        color, depth = render_view(scene, mesh, small, pose)
        color[depth == 0] = _MISSING
        size = width, height
        return replace(
            self,
            map_color=cv2.resize(color, size, interpolation=cv2.INTER_LINEAR),
            map_depth=cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST),
        )

    def colors(self) -> np.ndarray:
        """The color image beside the map's, uint8 [h, 2 w + gap, 3]."""
        return _beside(self.color, self.map_color)

    def depths(self, range_m: tuple[float, float]) -> np.ndarray:
        """The depth image beside the map's, in the same false colors over a range of depths."""
        shown = [None if depth is None else colored_depth(depth, range_m) for depth in (self.depth, self.map_depth)]
        blank = np.full_like(self.color, _MISSING)
        return _beside(blank if shown[0] is None else shown[0], shown[1])

    def depth_range(self, limits_m: tuple[float, float]) -> tuple[float, float]:
        """Nearest and farthest depth (m) worth telling apart: of the image, within the limits."""
        known = self.depth[self.depth > 0] if self.depth is not None else np.zeros(0)
        if not len(known):
            return limits_m[0], min(limits_m[1], 5.0)
        near, far = (float(value) for value in np.percentile(known, (1, 99)))
        return near, max(far, near + 0.1)


def read_images(dataset: RgbdDataset, index: int, row: int) -> FrameImages | None:
    """Reads a frame again, reduced; None where it can't be read."""
    try:
        frame = dataset[index]
    except (DatasetError, IndexError):
        return None
    return reduced(row, frame.color, frame.depth)


def reduced(row: int, color: np.ndarray, depth: np.ndarray | None) -> FrameImages:
    """Images of at most `WIDTH_PX`."""
    height, width = color.shape[:2]
    if width > WIDTH_PX:
        size = WIDTH_PX, max(round(height * WIDTH_PX / width), 1)
        color = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        depth = None if depth is None else cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    return FrameImages(row, color, depth)


def colored_depth(depth: np.ndarray, range_m: tuple[float, float]) -> np.ndarray:
    """Depth [h, w] (m) in false colors, near red and far blue, uint8 [h, w, 3] RGB; gray where unknown."""
    near, far = range_m
    share = np.clip((far - depth) / max(far - near, 1e-6), 0, 1)
    shown = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    shown[~(depth > 0)] = _MISSING
    return shown


def _beside(left: np.ndarray, right: np.ndarray | None) -> np.ndarray:
    gap = np.full((left.shape[0], _GAP_PX, 3), 255, np.uint8)
    return np.concatenate([left, gap, np.full_like(left, _MISSING) if right is None else right], axis=1)
