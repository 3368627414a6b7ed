"""Relative camera pose by point-to-plane ICP with projective association. Not differentiable.

A source point x is associated with the vertex v and normal n at the pixel pi(T x) of the target maps. The residual is
r = n . (T x - v) with the robust weight 1 / (1 + (r / k)^2)^2. Point-to-plane ICP is by Chen and Medioni 1992,
association by projection by Blais and Levine 1995.
"""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_count, check_tensor
from spslam.ops._public import public_op
from spslam.ops.scene_view import Intrinsics, check_intrinsics


@public_op()
def projective_icp(
    points: torch.Tensor,
    vertices: torch.Tensor,
    normals: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    *,
    iterations: int = 15,
    max_distance: float = 0.3,
    kernel_start: float = 0.1,
    kernel_end: float = 0.03,
    damping: float = 1e-4,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Aligns a point cloud with the vertex and normal maps of a camera, or several with the same, each by itself.

    All iterations run in one call, on CUDA in one kernel. Each iteration updates the associations, solves
    (H + damping diag(H) + (1e-6 tr(H) + 1e-8) I) delta = -g, and limits the norm of the step to 0.15 (m and rad). The
    kernel width k decreases geometrically from `kernel_start` to `kernel_end`, which it reaches one iteration before
    the last.

    Args:
        points: float32 [N, 3] source points, m, in the source camera's axes; or [B, N, 3], of several.
        vertices: float32 [H, W, 3] target points, m, in the target camera's axes; z = 0 where there is none.
        normals: float32 [H, W, 3] their unit normals; pixels with normal 0 are ignored.
        pose: float32 [7] initial pose, unit quaternion (w, x, y, z) and translation (m), T_target_source; [B, 7] for
            points [B, N, 3].
        intrinsics: of the maps, in their pixels: a map of every s-th pixel has focal lengths f / s and principal point
            (c + 1/2) / s - 1/2.
        iterations: number of iterations.
        max_distance: largest distance between a point and its vertex, m.
        kernel_start: initial width k of the robust kernel, m.
        kernel_end: final width, m.
        damping: relative Levenberg-Marquardt damping.

    Returns:
        float32 [7] pose; float32 [iterations, 5] with the weighted mean squared residual (m^2), the share of points
        with an association, the norms of the step in translation (m) and rotation (rad), and the mean weight over all
        points, each before the step of the iteration; float32 [6, 6] H of the last iteration; each [B, ...] for points
        [B, N, 3]. The same bits in every run on one device, for any number of CPU threads, alone or among others. N = 0
        or an empty map does not change the pose. Points, vertices and normals that are not finite are ignored; all are
        ignored if the pose is not finite.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> rows, columns = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
        >>> wall = torch.stack([(columns - 3.5) / 8, (rows - 2.5) / 8, torch.ones(6, 8)], -1)
        >>> normals = torch.tensor([0.0, 0.0, -1.0]).expand(6, 8, 3)
        >>> start = torch.tensor([1.0, 0, 0, 0, 0, 0, 0.1])
        >>> pose, _, _ = projective_icp(wall.reshape(-1, 3), wall, normals, start, Intrinsics(8.0, 8.0, 3.5, 2.5))
        >>> bool(pose[6].abs() < 1e-3)
        True
    """
    name = "projective_icp"
    several = torch.is_tensor(points) and points.dim() == 3
    check_tensor(name, "points", points, ("B", "N", 3) if several else ("N", 3), torch.float32)
    check_tensor(name, "vertices", vertices, ("H", "W", 3), torch.float32, like=points)
    check_tensor(name, "normals", normals, tuple(vertices.shape), torch.float32, like=points)
    check_tensor(name, "pose", pose, (len(points), 7) if several else (7,), torch.float32, like=points)
    check_intrinsics(name, intrinsics)
    check_count(name, "iterations", iterations)
    check(max_distance > 0, name, "max_distance", "be positive", max_distance)
    kernels = (kernel_start, kernel_end)
    check(min(kernels) > 0, name, "kernel_start and kernel_end", "be positive", kernels)
    check(damping >= 0, name, "damping", "be at least 0", damping)
    found = torch.ops.spslam.projective_icp(
        points if several else points[None],
        vertices,
        normals,
        pose if several else pose[None],
        list(intrinsics),
        iterations,
        max_distance,
        kernel_start,
        kernel_end,
        damping,
    )
    return found if several else tuple(each[0] for each in found)


@torch.library.register_fake("spslam::projective_icp")
def _(points, vertices, normals, pose, intrinsics, iterations, *_):
    count = len(pose)
    return pose.new_empty((count, 7)), pose.new_empty((count, iterations, 5)), pose.new_empty((count, 6, 6))
