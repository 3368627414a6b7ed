"""The pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Axes are OpenCV's (x right, y down, z forward); pixel centers lie at whole numbers, so the image spans
    [-0.5, width - 0.5] x [-0.5, height - 0.5].

    Attributes:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.

    Raises:
        ValueError: a size or a focal length is not positive, or a number is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not 1 <= value < 2**31 or int(value) != value:
                raise ValueError(f"Camera: {name} must be a positive whole number, got {value}")
            object.__setattr__(self, name, int(value))
        for name in ("fx", "fy", "cx", "cy"):
            value = float(getattr(self, name))
            if not math.isfinite(value):
                raise ValueError(f"Camera: {name} must be finite, got {value}")
            if name in ("fx", "fy") and value <= 0:
                raise ValueError(f"Camera: {name} must be positive, got {value:g}")
            object.__setattr__(self, name, value)

    @classmethod
    def from_matrix(cls, matrix: np.ndarray, width: int, height: int) -> Camera:
        """Builds a camera from an intrinsic matrix.

        Args:
            matrix: [3, 3], or [4, 4] with the intrinsics in its upper left corner.
            width: image width in pixels.
            height: image height in pixels.

        Raises:
            ValueError: another shape, skew, or a last row other than (0, 0, 1).
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape not in ((3, 3), (4, 4)):
            raise ValueError(f"Camera.from_matrix: matrix must have shape (3, 3), got {matrix.shape}")
        if abs(matrix[0, 1]) > 1e-6 or matrix[1, 0] != 0 or tuple(matrix[2, :3]) != (0, 0, 1):
            raise ValueError(
                "Camera.from_matrix: matrix must have the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "
                f"got {matrix[:3, :3].tolist()}"
            )
        return cls(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])

    def matrix(self) -> np.ndarray:
        """The intrinsic matrix, float64 [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def resized(self, width: int, height: int) -> Camera:
        """The camera with the same field of view for another image size in pixels."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
        )

    def ray_directions(self) -> np.ndarray:
        """Directions through the pixel centers with z = 1, float32 [height, width, 3], camera axes."""
        directions = np.ones((self.height, self.width, 3), dtype=np.float32)
        directions[..., 0] = (np.arange(self.width) - self.cx) / self.fx
        directions[..., 1] = ((np.arange(self.height) - self.cy) / self.fy)[:, None]
        return directions

    def unproject(self, depth: np.ndarray) -> np.ndarray:
        """Back-projects a depth image to points.

        Args:
            depth: [height, width], meters along the optical axis; 0 where there is none.

        Returns:
            float32 [height, width, 3], camera axes, meters; (0, 0, 0) where the depth is 0.

        Raises:
            ValueError: `depth` of another shape.
        """
        depth = np.asarray(depth)
        if depth.shape != (self.height, self.width):
            raise ValueError(f"Camera.unproject: depth must have shape {(self.height, self.width)}, got {depth.shape}")
        return self.ray_directions() * depth[..., None].astype(np.float32, copy=False)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Projects points to pixel coordinates.

        Args:
            points: [..., 3], camera axes, meters.

        Returns:
            [..., 2] of the dtype of `points`: (u, v); NaN for points that are not in front of the camera (z <= 0).

        Raises:
            ValueError: `points` of another shape.
        """
        points = np.asarray(points)
        if points.ndim < 1 or points.shape[-1] != 3:
            raise ValueError(f"Camera.project: points must have shape (..., 3), got {points.shape}")
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        return np.stack((points[..., 0] / z * self.fx + self.cx, points[..., 1] / z * self.fy + self.cy), axis=-1)
