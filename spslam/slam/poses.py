"""Poses as tensors: float32 [7], unit quaternion (w, x, y, z) and translation (m), T_world_camera."""

import numpy as np
import torch

from spslam.errors import DatasetError
from spslam.geometry import matrix_to_pose7, pose7_to_matrix

MAX_DISTANCE_M = 10_000.0  # a float32 still resolves a millimeter there


def check_first_pose(pose: np.ndarray) -> None:
    """Raises DatasetError where a system can't begin at a pose float64 [4, 4]: too far from the world's origin."""
    distance = float(np.linalg.norm(pose[:3, 3]))
    if not distance <= MAX_DISTANCE_M:
        raise DatasetError(
            f"the first pose must lie within {MAX_DISTANCE_M / 1000:.0f} km of the world's origin, got "
            f"{distance / 1000:.0f} km; scene.first_pose=identity starts at the origin instead"
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
