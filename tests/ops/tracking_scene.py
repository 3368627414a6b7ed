"""What the tests of tracking share: a pose before the corner, and the equations that autograd finds there."""

from dataclasses import replace

import numpy as np
import torch

from spslam import ops
from spslam.geometry import matrix_to_pose7, pose7_to_matrix
from tests.ops.scenes import INTRINSICS, POSES, TRUNCATION

POSE = POSES[0]  # all three walls of the corner fill the view
OPTIONS = ops.GaussNewtonOptions(
    num_pixels=1024,
    iterations=8,
    truncation=0.16,
    kernel_start=0.08,
    kernel_end=0.02,
    damping=1e-4,
    seed=3,
    stream=ops.RandomStream.TRACKING_PIXELS,
    frame=4,
)
# A single undamped step, whose kernel and pixels are known.
ONE_STEP = replace(
    OPTIONS, num_pixels=600, iterations=1, truncation=TRUNCATION, kernel_start=0.03, kernel_end=0.03, damping=0.0
)


def drawn_pixels(records):
    """The pixels that the first iteration of ONE_STEP takes."""
    key = ONE_STEP.seed, ONE_STEP.stream, ONE_STEP.frame
    return records[ops.sample_indices(*key, 0, ONE_STEP.num_pixels, len(records))]


def pose7(matrix, device="cpu"):
    return torch.from_numpy(matrix_to_pose7(matrix)).float().to(device)


def moved_pose(matrix, shift, angle):
    axis = np.array([0.3, -0.8, 0.52])
    axis /= np.linalg.norm(axis)
    quaternion = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
    moved = matrix.copy()
    moved[:3, :3] = pose7_to_matrix(np.concatenate([quaternion, np.zeros(3)]))[:3, :3] @ matrix[:3, :3]
    moved[:3, 3] += shift
    return moved


def rotation_exp(omega):
    x, y, z = omega
    zero = torch.zeros((), dtype=omega.dtype)
    return torch.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3))


def camera_points(records, camera=INTRINSICS):
    """float64 [P, 3] surface points in camera axes."""
    u, v = (records[:, 0] & 0xFFFF).double(), (records[:, 0] >> 16).double()
    depth = records[:, 1].contiguous().view(torch.float32).double()
    rays = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)]
    return torch.stack(rays, 1) * depth[:, None]


def moved_points(local, increment, pose=POSE):
    rotation, translation = torch.from_numpy(pose[:3, :3]), torch.from_numpy(pose[:3, 3])
    return local @ (rotation_exp(increment[3:]) @ rotation).T + translation + increment[:3]


def corner_depth(pose, camera, rows, columns):
    """float64 [rows, columns] depth (m) of the corner's walls as a camera at `pose` (float64 [4, 4]) sees them."""
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones(rows, columns)], -1)
    directions = rays.double() @ torch.from_numpy(pose[:3, :3]).T
    walls = torch.tensor([0.9, 0.5, 1.1], dtype=torch.float64) - torch.from_numpy(pose[:3, 3])
    return torch.where(directions > 1e-6, walls / directions, torch.inf).min(-1).values


def surface_equations(scene, records, kernel):
    """Residual [P], Jacobian [P, 6] through the SDF's own gradient, weight [P] and inliers [P] at POSE, all float64."""
    local, zero = camera_points(records), torch.zeros(6, dtype=torch.float64)
    points_by_increment = torch.func.jacfwd(lambda increment: moved_points(local, increment))(zero)
    points = moved_points(local, zero).float().to(scene.embeddings.device)
    sdf, valid, gradient = (t.cpu() for t in ops.query_sdf_gradient(scene, points))
    inlier = valid & (sdf.abs() < 0.98)
    residual = TRUNCATION * sdf.double()
    jacobian = TRUNCATION * torch.einsum("ni,nij->nj", gradient.double(), points_by_increment)
    return residual, jacobian, (1 / (1 + (residual / kernel) ** 2)) ** 2 * inlier, inlier


def noise_model(depth_floor, depth_growth, intensity_floor=1.0, intensity_growth=0.0, device="cpu"):
    """`SensorNoise.model` of these variances."""
    return torch.tensor([depth_floor, depth_growth, intensity_floor, intensity_growth], device=device)


def certainties(noise, depth):
    """Weights of residuals against the map and against keyframes, by depth (m); 1 without noise."""
    if noise is None:
        return torch.ones_like(depth), torch.ones_like(depth)
    floor, growth = noise.cpu().double()[:2]
    variance, most = floor + growth * depth**4, 0.003**2
    surface = torch.clamp(1e-8 + floor, max=most)
    return most / (most + variance), surface / torch.clamp(1e-8 + variance, min=surface)
