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
        numbers: float64 [7] in the order above; None is the camera as it is. [K, 7] is K cameras at once: what they
            give, and what points they are given, has K in front.
    """

    def __init__(self, camera: Camera, median_m: float, numbers: np.ndarray | None = None) -> None:
        self.camera, self.median_m = camera, median_m
        self.numbers = np.zeros(COUNT) if numbers is None else numbers
        focal, aspect = self.numbers[..., FOCAL], self.numbers[..., ASPECT]
        factors = np.stack((np.exp(focal + aspect / 2), np.exp(focal - aspect / 2)), axis=-1)
        self.focal = np.array([camera.fx, camera.fy]) * factors
        self.center = np.array([camera.cx, camera.cy]) + camera.fx * self.numbers[..., [SHIFT_X, SHIFT_Y]]

    def with_numbers(self, numbers: np.ndarray) -> Lens:
        """The same camera with other numbers."""
        return Lens(self.camera, self.median_m, numbers)

    def points(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Camera points [N, 3] of pixels [N, 2] with depth [N]."""
        rays = (pixels - self.center[..., None, :]) / self.focal[..., None, :]
        rays = rays * (1 - self._each(RADIAL) * _square(rays))[..., None]
        corrected = depth * (1 + self._each(RAY) * _square(rays)) + self._each(OFFSET) * self.median_m
        return np.concatenate((rays * corrected[..., None], corrected[..., None]), axis=-1)

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] of camera points [N, 3]; of points behind the camera, some pixel far away."""
        rays = points[..., :2] / np.maximum(points[..., 2:], 1e-3 * self.median_m)
        rays = rays * (1 + self._each(RADIAL) * _square(rays))[..., None]
        return rays * self.focal[..., None, :] + self.center[..., None, :]

    def pixels_and_derivatives(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `pixels`, and the derivatives [N, 2, 3] by the points."""
        least = 1e-3 * self.median_m
        depth = np.maximum(points[..., 2:], least)
        rays = points[..., :2] / depth
        radial, focal = self._each(RADIAL), self.focal[..., None, :]
        factor = (1 + radial * _square(rays))[..., None]
        by_ray = factor[..., None] * np.eye(2) + 2 * radial[..., None, None] * rays[..., :, None] * rays[..., None, :]
        by_ray = by_ray * focal[..., None]
        by_depth = -(by_ray @ rays[..., None]) * (depth > least)[..., None]
        by_point = np.concatenate((by_ray, by_depth), axis=-1) / depth[..., None]
        return rays * factor * focal + self.center[..., None, :], by_point

    def _each(self, number: int) -> np.ndarray:
        """One of the numbers, to be combined with points."""
        return self.numbers[..., number, None]


def _square(rays: np.ndarray) -> np.ndarray:
    return rays[..., 0] * rays[..., 0] + rays[..., 1] * rays[..., 1]
