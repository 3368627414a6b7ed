"""Image features of a frame (ORB) with the surface points under them: places known by how they look, not where.

ORB: Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011, as OpenCV implements it, compiled
(`csrc/cpu/orb_features.cpp`): a third of the time.
"""

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch

from spslam.camera import Camera
from spslam.image_library import check_memory, image_library
from spslam.slam.depth_keyframes import depth_image_intrinsics, depth_unit
from spslam.slam.pixels import FramePixels

DESCRIPTOR_BYTES = 32
COUNT = 1000  # features of a frame at most
DETECTED = 2000  # of which the strongest of each cell are taken first, so that they cover the image
CELL_COLUMNS = 20  # of the grid over the image
RANGE_COLUMNS = 160  # of the image that the range of depth is looked for in
FARTHEST = 0.98  # quantile of known depth that is taken for its range
HOLE_SHARE = 1 / 24  # of the image's width: features nearer to known depth may be on a hole's rim
FAR_SHARE = 0.6  # of the range, where the rim lies
EDGE_PX = 16  # without keypoints at the image's edge; half a patch, as OpenCV's 31 px leave little of a small image
FAST_THRESHOLD = 7  # gray levels; ORB-SLAM's lower one: plain walls have faint corners too


@dataclass(frozen=True)
class ImageFeatures:
    """Features of one frame; of any prefix of them those of the strongest response cover the image.

    Attributes:
        descriptors: uint8 [N, 32], compared by Hamming distance.
        positions: float32 [N, 2] in px of the intensity image.
        points: float32 [N, 3] surface points in camera axes, m; 0 where the depth is unknown.
        beyond_m: float32 [N], the range of depth beyond which a feature lies, m; 0 where its depth is known, or may be
            a hole's. None where that was not found out.
    """

    descriptors: np.ndarray
    positions: np.ndarray
    points: np.ndarray
    beyond_m: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.descriptors)

    def where_known(self, depth: np.ndarray) -> "ImageFeatures":
        """Without those with a depth that an image [h, w] of the same size does not have."""
        columns, rows = np.floor(self.positions + 0.5).astype(np.int64).T
        rows, columns = np.clip(rows, 0, len(depth) - 1), np.clip(columns, 0, depth.shape[1] - 1)
        kept = (self.points[:, 2] == 0) | (depth[rows, columns] > 0)
        beyond_m = None if self.beyond_m is None else self.beyond_m[kept]
        return ImageFeatures(self.descriptors[kept], self.positions[kept], self.points[kept], beyond_m)

    def with_depth(self) -> "ImageFeatures":
        """Those of which the depth is known."""
        known = self.points[:, 2] > 0
        return ImageFeatures(self.descriptors[known], self.positions[known], self.points[known])


class FrameFeatures:
    """The image features of one frame, extracted where they are first asked for.

    Args:
        pixels: see the attribute.
        camera: of all frames.
        max_depth_m: the largest depth that images hold.

    Attributes:
        pixels: of the frame as it was read: features are rectified by themselves, not their images.
    """

    def __init__(self, pixels: FramePixels, camera: Camera, max_depth_m: float):
        self.pixels, self._camera, self._max_depth_m = pixels, camera, max_depth_m
        self._whole: FrameFeatures | None = None  # with what was left out of the pixels

    def having(self, views: Mapping[str, torch.Tensor]) -> "FrameFeatures":
        """The same of pixels whose views of some names are others, with less depth: without the features there."""
        less = FrameFeatures(self.pixels.having(**views), self._camera, self._max_depth_m)
        less._whole = self
        return less

    @property
    def whole(self) -> "FrameFeatures":
        """The same of the pixels as they were read, with nothing left out."""
        return self if self._whole is None else self._whole

    @cached_property
    def extracted(self) -> ImageFeatures:
        """The features; waits for the device."""
        if self._whole is None:
            return extract_features(self.pixels, self._camera, self._max_depth_m)
        return self._whole.extracted.where_known(self.pixels.depth_image.cpu().numpy())


def extract_features(pixels: FramePixels, camera: Camera, max_depth_m: float) -> ImageFeatures:
    """Features of a frame, strongest of each part of the image first; deterministic, waits for the device.

    Those that were extracted ahead are there at once.

    Args:
        pixels: of the frame, with images.
        camera: of all frames.
        max_depth_m: the largest depth that images hold.
    """
    if isinstance(pixels.features, Future):
        return pixels.features.result()
    if pixels.features is not None:
        return pixels.features
    return features_of_images(
        pixels.intensity_image.cpu().numpy(), pixels.depth_image.cpu().numpy(), camera, max_depth_m
    )


def features_of_images(intensity: np.ndarray, depth: np.ndarray, camera: Camera, max_depth_m: float) -> ImageFeatures:
    """Features of a frame of which the images are at hand.

    Args:
        intensity: uint8 [h, w].
        depth: uint16 [h, w] in units of `depth_unit(max_depth_m)`, 0 where unknown.
        camera: of all frames.
        max_depth_m: the largest depth that images hold.
    """
    positions, descriptors = detect(intensity)
    points = _points(positions, depth, camera, max_depth_m)
    beyond = np.where(points[:, 2] > 0, 0, _beyond_m(positions, depth, max_depth_m))
    return ImageFeatures(descriptors, positions, points, beyond.astype(np.float32))


def detect(intensity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of an image and their descriptors.

    Args:
        intensity: uint8 [h, w].

    Returns:
        positions float32 [N, 2] in px and descriptors uint8 [N, 32] of the strongest corner of each cell of a grid over
        the image, the strongest first, then of the second ones, and so on.

    Raises:
        MemoryError: there is not enough.
    """
    intensity = np.ascontiguousarray(intensity)
    size = np.array(intensity.shape, np.int32)
    options = np.array([DETECTED, COUNT, CELL_COLUMNS, EDGE_PX, FAST_THRESHOLD], np.int32)
    positions, descriptors = np.empty((COUNT, 2), np.float32), np.empty((COUNT, DESCRIPTOR_BYTES), np.uint8)
    arrays = (intensity, size, options, positions, descriptors)
    count = check_memory(image_library().spslam_orb_features(*(array.ctypes.data for array in arrays)))
    # Copies: what is kept of a frame has only what it holds.
    return positions[:count].copy(), descriptors[:count].copy()


def _beyond_m(positions: np.ndarray, depth: np.ndarray, max_depth_m: float) -> np.ndarray:
    """The range of depth in an image, m, at positions [N, 2] well inside an area without depth whose nearest rim is
    about as far as anything; 0 elsewhere: what is too near, and holes on surfaces and at edges, have nearer rims."""
    step = max(depth.shape[1] // RANGE_COLUMNS, 1)
    coarse = depth[::step, ::step]
    known = coarse > 0
    if known.all() or not known.any():
        return np.zeros(len(positions))
    farthest = float(np.quantile(coarse[known], FARTHEST))
    unknown = (~known).astype(np.uint8)
    distance, rims = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    depth_of_rim = np.zeros(int(rims.max()) + 1)
    depth_of_rim[rims[known]] = coarse[known]
    is_beyond = (distance > HOLE_SHARE * coarse.shape[1]) & (depth_of_rim[rims] > FAR_SHARE * farthest)
    column, row = np.minimum((positions / step).astype(np.int64), (coarse.shape[1] - 1, coarse.shape[0] - 1)).T
    return np.where(is_beyond[row, column], farthest * depth_unit(max_depth_m), 0)


def _points(positions: np.ndarray, depth: np.ndarray, camera: Camera, max_depth_m: float) -> np.ndarray:
    """Surface points [N, 3] at positions [N, 2] of the images, by the nearest pixel's depth."""
    k = depth_image_intrinsics(camera)
    column, row = np.minimum((positions + 0.5).astype(np.int64), (depth.shape[1] - 1, depth.shape[0] - 1)).T
    z = depth[row, column] * np.float32(depth_unit(max_depth_m))
    rays = (positions - np.array([k.cx, k.cy], np.float32)) / np.array([k.fx, k.fy], np.float32)
    return np.concatenate([rays * z[:, None], z[:, None]], 1).astype(np.float32)
