"""`held_pose` in plain NumPy, step by step."""

import numpy as np

from spslam.geometry import matrix_to_pose7, pose7_to_matrix, pose_from
from spslam.pose_graph import rotation_matrices, rotation_vectors
from spslam.slam.recovery.feature_equations import point_equations, ray_equations

ITERATIONS, SMALL_STEP = 6, 1e-5  # as in csrc/cpu/feature_pose.cpp


def held_pose(camera, points, rays, motion, pose, information, error_px, least):
    """As `spslam.slam.recovery.feature_equations.held_pose`."""
    at = before = pose7_to_matrix(pose)
    for _ in range(ITERATIONS):
        color_pose = at if motion is None else motion.color_pose(at)
        lever = 1.0 if color_pose is at else 1.0 + motion.share
        agreeing, features, toward = point_equations(camera, points, color_pose, error_px)
        if agreeing < least:
            return None
        for seen in rays:
            _, by_rays, toward_rays = ray_equations(camera, seen, color_pose, error_px, agreeing)
            features, toward = features + by_rays, toward + toward_rays
        change = np.r_[at[:3, 3] - before[:3, 3], rotation_vectors(at[:3, :3] @ before[:3, :3].T)]
        normal = information + lever**2 * features
        step = -np.linalg.solve(normal + np.eye(6), information @ change + lever * toward)
        at = pose_from(rotation_matrices(step[3:]) @ at[:3, :3], at[:3, 3] + step[:3])
        if np.abs(step).max() < SMALL_STEP:
            break
    return matrix_to_pose7(at)
