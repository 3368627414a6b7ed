"""Poses as tensors: float32 [7], unit quaternion (w, x, y, z) and translation (m), T_world_camera."""

import numpy as np
import torch

from spslam.errors import DatasetError
from spslam.geometry import matrix_to_pose7, pose7_to_matrix

MAX_DISTANCE_M = 10_000.0  # a float32 still resolves a millimeter there
# Of a rotation times its transpose: some digits may be missing, but a scale or the matrix of an image is none.
_ROTATION_TOLERANCE, _LAST_ROW_TOLERANCE = 0.1, 1e-6


def check_first_pose(pose: np.ndarray) -> None:
    """Raises an error where a system can't begin at a pose float64 [4, 4].

    Raises:
        ValueError: another shape, or no rigid motion.
        DatasetError: too far from the world's origin.
    """
    if pose.shape != (4, 4):
        raise ValueError(f"SlamSystem: first_pose must have shape (4, 4), got {pose.shape}")
    distance = float(np.linalg.norm(pose[:3, 3]))
    if not distance <= MAX_DISTANCE_M:
        raise DatasetError(
            f"the first pose must lie within {MAX_DISTANCE_M / 1000:.0f} km of the world's origin, got "
            f"{distance / 1000:.0f} km; scene.first_pose=identity starts at the origin instead"
        )
    rotation = pose[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    is_motion = off <= _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
    if not is_motion or not np.abs(pose[3] - [0, 0, 0, 1]).max() <= _LAST_ROW_TOLERANCE:
        raise ValueError(
            "SlamSystem: first_pose must be a rotation and a translation, camera to world, above the row (0, 0, 0, 1), "
            f"got {pose.tolist()}"
        )


def pose_tensor(matrix: np.ndarray, device: torch.device) -> torch.Tensor:
    """float32 [7] of a float64 [4, 4] pose."""
    return torch.from_numpy(matrix_to_pose7(matrix)).to(device, torch.float32)


def pose_matrix(pose: torch.Tensor) -> np.ndarray:
    """float64 [4, 4] of a pose [7]; waits for the device."""
    return pose7_to_matrix(pose.cpu().numpy().astype(np.float64))


def rotations(quaternions: torch.Tensor) -> torch.Tensor:
    """Matrices [F, 3, 3] of unit quaternions (w, x, y, z) [F, 4]: v + 2 w (q x v) + 2 q x (q x v) for the axes v."""
    w, q = quaternions[:, :1, None], quaternions[:, 1:]
    axes = torch.eye(3, dtype=q.dtype, device=q.device).expand(len(q), 3, 3)
    once = torch.linalg.cross(q[:, None].expand_as(axes), axes)
    twice = torch.linalg.cross(q[:, None].expand_as(axes), once)
    return (axes + 2 * (w * once + twice)).transpose(1, 2)
