"""How a pixel and its depth become a point, with the numbers that a recording may have wrong."""

from __future__ import annotations

import numpy as np

from spslam.camera import Camera

# The numbers: log of a factor on the focal length, log of fx / fy, shift of the principal point (in focal lengths),
# radial distortion k1, depth * (1 + RAY r^2) where r is the tangent of the angle to the axis (about -0.5 for depth that
# is measured along the ray), and an offset of depth as a share of the median.
FOCAL, ASPECT, SHIFT_X, SHIFT_Y, RADIAL, RAY, OFFSET = range(7)
COUNT = 7


class Lens:
    """A camera whose numbers may be off.

    Args:
        camera: as a recording says.
        median_m: median depth, the unit of `OFFSET`.
        numbers: float64 [7] in the order above; None is the camera as it is.
    """

    def __init__(self, camera: Camera, median_m: float, numbers: np.ndarray | None = None) -> None:
        self.camera, self.median_m = camera, median_m
        self.numbers = np.zeros(COUNT) if numbers is None else numbers
        focal, aspect = self.numbers[FOCAL], self.numbers[ASPECT]
        self.focal = np.array([camera.fx * np.exp(focal + aspect / 2), camera.fy * np.exp(focal - aspect / 2)])
        self.center = np.array([camera.cx, camera.cy]) + camera.fx * self.numbers[[SHIFT_X, SHIFT_Y]]

    def with_numbers(self, numbers: np.ndarray) -> Lens:
        """The same camera with other numbers."""
        return Lens(self.camera, self.median_m, numbers)

    def points(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Camera points [N, 3] of pixels [N, 2] with depth [N]."""
        rays = (pixels - self.center) / self.focal
        rays = rays * (1 - self.numbers[RADIAL] * np.sum(rays * rays, axis=1))[:, None]
        square = np.sum(rays * rays, axis=1)
        corrected = depth * (1 + self.numbers[RAY] * square) + self.numbers[OFFSET] * self.median_m
        return np.column_stack((rays * corrected[:, None], corrected))

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] of camera points [N, 3]; of points behind the camera, some pixel far away."""
        rays = points[:, :2] / np.maximum(points[:, 2:], 1e-3 * self.median_m)
        rays = rays * (1 + self.numbers[RADIAL] * np.sum(rays * rays, axis=1))[:, None]
        return rays * self.focal + self.center
