"""Lenses with distortion, and the maps by which their images become those of a pinhole camera.

Distortion is undone once, when an image is read: everything behind the datasets knows pinhole cameras only. Color is
interpolated linearly. Of depth the inverse is interpolated, which is exact on planes, and only where the four neighbors
belong to one surface; elsewhere the nearest value is taken, so that no depth is made up between two surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from spslam.camera import Camera

LensModel = Literal["pinhole", "brown", "fisheye"]
LENS_MODELS: tuple[str, ...] = get_args(LensModel)
# How many coefficients a model may have: OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6[, s1..s4[, tau_x, tau_y]]]] for
# Brown's, and k1, k2, k3, k4 of Kannala-Brandt for a fisheye.
COEFFICIENT_COUNTS: dict[str, tuple[int, ...]] = {
    "pinhole": (0, 4, 5, 8, 12, 14),
    "brown": (4, 5, 8, 12, 14),
    "fisheye": (4,),
}
# Neighbors whose depth differs by a larger share belong to two surfaces. On a plane that is seen under 87 degrees depth
# changes by 3 % from pixel to pixel.
ONE_SURFACE_SHARE = 0.03
_NOWHERE_PX = 32000.0
_PAIR = np.ones((2, 2), dtype=np.uint8)


@dataclass(frozen=True)
class Lens:
    """A camera whose images are distorted.

    Attributes:
        camera: size, focal lengths and principal point.
        model: `pinhole` has no distortion. `brown` is Brown-Conrady's model as OpenCV has it (ROS: plumb_bob and
            rational_polynomial), `fisheye` is Kannala-Brandt's with four coefficients (ROS: equidistant).
        coefficients: as OpenCV orders them.

    Raises:
        ValueError: an unknown model, another count of coefficients, or one that isn't finite.
    """

    camera: Camera
    model: LensModel = "pinhole"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in LENS_MODELS:
            raise ValueError(f"Lens: model must be one of {', '.join(LENS_MODELS)}, got {self.model!r}")
        counts = COEFFICIENT_COUNTS[self.model]
        if len(self.coefficients) not in counts:
            wanted = " or ".join(map(str, counts))
            raise ValueError(f"Lens: a {self.model} lens must have {wanted} coefficients, got {len(self.coefficients)}")
        if not np.isfinite(self.coefficients).all():
            raise ValueError(f"Lens: coefficients must be finite, got {list(self.coefficients)}")
        if self.model == "pinhole" and any(self.coefficients):
            raise ValueError(f"Lens: a pinhole lens must have no coefficients, got {list(self.coefficients)}")

    @property
    def is_distorted(self) -> bool:
        """Whether images differ from the pinhole camera's. A fisheye's do even if its coefficients are 0."""
        return self.model == "fisheye" or any(self.coefficients)

    def maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each pixel of the pinhole camera lies in the distorted image: u and v, float32 [H, W]."""
        camera = self.camera
        matrix, size = camera.matrix(), (camera.width, camera.height)
        coefficients = np.asarray(self.coefficients, dtype=np.float64)
        if self.model == "fisheye":
            return cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
        return cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, size, cv2.CV_32FC1)


@dataclass(frozen=True)
class Rectification:
    """Turns the images of a lens into those of its pinhole camera.

    Attributes:
        map_u: float32 [H, W], where each pixel lies in the distorted image, px.
        map_v: float32 [H, W].
        fixed: the same in the form in which `cv2.remap` is fastest.
        unseen: bool [H, W], pixels that lie outside the distorted image.
    """

    map_u: np.ndarray
    map_v: np.ndarray
    fixed: tuple[np.ndarray, np.ndarray]
    unseen: np.ndarray

    @classmethod
    def of(cls, lens: Lens) -> Rectification:
        """The maps of a lens."""
        # Coefficients far out of range lead to points that no image has; OpenCV counts pixels in 16 bits.
        u, v = (np.clip(np.nan_to_num(axis, nan=-_NOWHERE_PX), -_NOWHERE_PX, _NOWHERE_PX) for axis in lens.maps())
        camera = lens.camera
        inside = (u > -0.5) & (u < camera.width - 0.5) & (v > -0.5) & (v < camera.height - 0.5)
        return cls(u, v, cv2.convertMaps(u, v, cv2.CV_16SC2), ~inside)

    def color(self, image: np.ndarray) -> np.ndarray:
        """A color image without distortion, by linear interpolation; pixels from outside repeat the border.

        Args:
            image: uint8 [H, W, 3].
        """
        return cv2.remap(image, *self.fixed, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """A depth image without distortion; 0 where nothing was measured, and for pixels from outside.

        Args:
            depth: float32 [H, W], m.
        """
        return sample_depth(depth, self.map_u, self.map_v)


def sample_depth(depth: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Depth at points between the pixels.

    Args:
        depth: float32 [H, W], m, 0 where nothing was measured.
        u: float32 [h, w], columns, px.
        v: float32 [h, w], rows, px.

    Returns:
        float32 [h, w], m: interpolated where the four pixels around are of one surface, else that of the nearest pixel;
        0 outside the image.
    """
    lowest, highest = (apply(depth, _PAIR, anchor=(0, 0)) for apply in (cv2.erode, cv2.dilate))
    is_surface = ((lowest > 0) & (highest - lowest <= ONE_SURFACE_SHARE * lowest)).astype(np.uint8)
    is_surface[-1], is_surface[:, -1] = 0, 0
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    sampled = cv2.remap(depth, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    half = np.float32(0.5)
    interpolates = cv2.remap(is_surface, u - half, v - half, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT).astype(
        bool
    )
    between = cv2.remap(inverse, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    np.divide(1, between, out=sampled, where=interpolates & (between > 0))
    return sampled
