"""Exact frames of the generated room by cameras of any lens and place, for the tests of what readers put right."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.generated import camera_path
from spslam.datasets.lens import Lens
from spslam.datasets.room import Room
from spslam.geometry import pose_from

BROWN = (0.12, -0.24, 0.003, -0.002, 0.06)
FISHEYE = (-0.03, 0.012, -0.008, 0.002)
REALSENSE = (-0.055, 0.066, -0.0004, 0.0006, -0.021)
ROOM = Room(0)


@dataclass(frozen=True)
class RayCamera:
    """What `Room.render` needs of a camera, for any directions of its pixels."""

    width: int
    height: int
    directions: np.ndarray

    def ray_directions(self) -> np.ndarray:
        return self.directions

    def project(self, points: np.ndarray) -> np.ndarray:
        """The corners of the image, so that every solid is looked for in all of it."""
        corners = np.array([[0.0, 0.0], [self.width, self.height]])
        return np.resize(corners, (len(points), 2))


def lens_rays(lens: Lens) -> np.ndarray:
    """The direction with z = 1 that each pixel of a lens sees, by OpenCV's inverse of the model."""
    camera = lens.camera
    pixels = np.indices((camera.height, camera.width), dtype=np.float64)[::-1].reshape(2, -1).T
    normal = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    if lens.model == "brown":
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        points = normal.reshape(-1, 1, 2)
        normal = cv2.undistortPoints(points, np.eye(3), np.array(lens.coefficients), criteria=criteria).reshape(-1, 2)
    elif lens.model == "fisheye":
        points = normal.reshape(-1, 1, 2)
        normal = cv2.fisheye.undistortPoints(points, np.eye(3), np.array(lens.coefficients)).reshape(-1, 2)
    rays = np.ones((camera.height, camera.width, 3), dtype=np.float32)
    rays[..., :2] = normal.reshape(camera.height, camera.width, 2)
    return rays


def render(lens: Lens, pose: np.ndarray, room: Room = ROOM) -> tuple[np.ndarray, np.ndarray]:
    """Color and exact depth that a lens sees from a pose."""
    camera = lens.camera
    if not lens.is_distorted:
        return room.render(camera, pose)
    return room.render(RayCamera(camera.width, camera.height, lens_rays(lens)), pose)


def extrinsics(offset=(0.05, -0.004, 0.01), angle=(0.01, -0.02, 0.015)) -> np.ndarray:
    """`color_from_depth` of cameras a few centimeters and a degree apart."""
    return pose_from(cv2.Rodrigues(np.array(angle))[0], np.array(offset))


def camera(width: int, height: int, focal_per_width: float = 0.9) -> Camera:
    focal = focal_per_width * width
    return Camera(width, height, focal, 1.01 * focal, 0.49 * width, 0.51 * height)


def path(frames: int = 300) -> np.ndarray:
    """Poses of the generated sequence."""
    return camera_path(frames)
