"""The classical baseline: voxelized GICP odometry against a growing voxel map of Gaussians (`small_gicp`).

No loop closure, dense map, color or learning: a neural map is worth its cost only where it is better than this.
"""

from __future__ import annotations

import numpy as np

from spslam.camera import Camera
from spslam.errors import SpslamError
from spslam.geometry import constant_speed, orthonormalize

# Maximum correspondence distance in voxels: pairs farther apart belong to different surfaces.
_REACH_VOXELS = 4
# Every second pixel in both directions: a voxel of 2 cm still gets several.
_PIXEL_STEP = 2
_NEIGHBORS = 10
# With a smaller share of matched points, the registration counts as failed.
_MIN_MATCHED = 0.2
_MAX_ITERATIONS = 30
# Voxels never expire from the map.
_NEVER = 1 << 30


def gicp_off_reason() -> str:
    """Why the baseline can't run; empty if it can."""
    try:
        import small_gicp  # noqa: F401
    except ImportError:
        return "needs small_gicp: pip install 'spslam[bench]'"
    return ""


class GicpOdometry:
    """Registers each depth image against the voxel map of all earlier ones, starting at a constant-speed prediction.

    Args:
        camera: intrinsics of the depth images.
        first_pose: float64 [4, 4] T_world_camera of the first frame.
        voxel_m: edge of the map's voxels and of the grid that downsamples a frame's points, in meters.
        threads: of the registration. With more than one, the downsampling and so the result vary slightly.

    Raises:
        SpslamError: small_gicp is not installed.
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
        """Tracks the next frame.

        A frame without depth, or whose registration fails, gets the predicted pose, counts as lost and is not added to
        the map.

        Args:
            depth: float32 [H, W] in meters, 0 where unknown.

        Returns:
            float64 [4, 4] T_world_camera.
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
    """The pose with an exactly orthonormal rotation, so that rounding errors don't accumulate."""
    return np.block([[orthonormalize(pose[:3, :3]), pose[:3, 3:]], [np.array([[0.0, 0.0, 0.0, 1.0]])]])
