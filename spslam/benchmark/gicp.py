"""The classical rival: voxelized GICP odometry against a growing map of Gaussians (`small_gicp`).

No loop closure, no dense map, no color, no learning; what a neural map must beat to be worth its work.
"""

from __future__ import annotations

import numpy as np

from spslam.camera import Camera
from spslam.errors import SpslamError
from spslam.geometry import constant_speed, orthonormalize

# Four times the voxel: matches farther apart belong to other surfaces.
_REACH_VOXELS = 4
# Every second pixel both ways: a voxel of 2 cm still gets several.
_PIXEL_STEP = 2
_NEIGHBORS = 10
# A registration that matches less than this share of the frame's points holds on to nothing.
_MIN_MATCHED = 0.2
_MAX_ITERATIONS = 30
# A voxel that a room's camera saw once stays in the map.
_NEVER = 1 << 30


def gicp_off_reason() -> str:
    """Why the baseline can't run, empty if it can."""
    try:
        import small_gicp  # noqa: F401
    except ImportError:
        return "needs small_gicp: pip install 'spslam[bench]'"
    return ""


class GicpOdometry:
    """Registers each depth image against the voxel map of all before it, from a constant-speed prediction.

    Parameters
    ----------
    camera : of the depth images.
    first_pose : float64 [4,4] ``T_world_camera`` of the first frame.
    voxel_m : edge of the map's voxels, and of the grid that a frame's points are averaged over.
    threads : of the registration. More than one makes the averaging, and so the result, vary slightly.
    """

    def __init__(self, camera: Camera, first_pose: np.ndarray, voxel_m: float = 0.04, threads: int = 1) -> None:
        if reason := gicp_off_reason():
            raise SpslamError(f"the classical baseline {reason}")
        import small_gicp

        self._rays = camera.ray_directions()[::_PIXEL_STEP, ::_PIXEL_STEP].reshape(-1, 3).astype(np.float64)
        self._voxel_m, self._threads = voxel_m, threads
        self._map = small_gicp.GaussianVoxelMap(voxel_m)
        self._map.set_lru(_NEVER, _NEVER)
        self._first_pose = np.asarray(first_pose, np.float64)
        self.poses: list[np.ndarray] = []
        self.lost: list[bool] = []

    def process(self, depth: np.ndarray) -> np.ndarray:
        """The pose of the next frame, float64 [4,4], from its depth float32 [H,W] in meters, 0 where unknown.

        A frame without depth, or whose registration finds too little to hold on to, keeps the predicted pose, counts
        as lost and doesn't touch the map.
        """
        import small_gicp

        seen = depth[::_PIXEL_STEP, ::_PIXEL_STEP].reshape(-1)
        points = (self._rays * seen[:, None])[seen > 0]
        cloud, _ = small_gicp.preprocess_points(points, self._voxel_m, _NEIGHBORS, self._threads)
        pose, lost = self._register(cloud)
        if not lost:
            self._map.insert(cloud, pose)
        self.poses.append(pose)
        self.lost.append(lost)
        return pose

    def _register(self, cloud) -> tuple[np.ndarray, bool]:
        import small_gicp

        if not self.poses:
            return self._first_pose, cloud.size() == 0
        predicted = constant_speed(*self.poses[-2:]) if len(self.poses) > 1 else self.poses[-1]
        if cloud.size() == 0:
            return predicted, True
        found = small_gicp.align(
            self._map,
            cloud,
            predicted,
            max_correspondence_distance=_REACH_VOXELS * self._voxel_m,
            num_threads=self._threads,
            max_iterations=_MAX_ITERATIONS,
        )
        pose = found.T_target_source
        if not np.isfinite(pose).all() or found.num_inliers < _MIN_MATCHED * cloud.size():
            return predicted, True
        return _orthonormal(pose), False


def _orthonormal(pose: np.ndarray) -> np.ndarray:
    """The pose with its rotation projected back, so that rounding does not add up."""
    return np.block([[orthonormalize(pose[:3, :3]), pose[:3, 3:]], [np.array([[0.0, 0.0, 0.0, 1.0]])]])
