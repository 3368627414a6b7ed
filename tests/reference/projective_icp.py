"""Point-to-plane ICP with projective association, step by step in float64."""

import torch


def twist(omega: torch.Tensor) -> torch.Tensor:
    """The matrix of the cross product with omega."""
    x, y, z = omega.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


def associate(
    moved: torch.Tensor, vertices: torch.Tensor, normals: torch.Tensor, intrinsics, max_distance: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Vertex and normal [N, 3] that each point's projection falls on, and whether there is such a pair."""
    fx, fy, cx, cy = intrinsics
    height, width = vertices.shape[:2]
    z = moved[:, 2].clamp_min(1e-9)
    u = (moved[:, 0] / z * fx + cx + 0.5).floor()
    v = (moved[:, 1] / z * fy + cy + 0.5).floor()
    inside = (moved[:, 2] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    row, column = v.clamp(0, height - 1).long(), u.clamp(0, width - 1).long()
    vertex, normal = vertices[row, column], normals[row, column]
    near = (moved - vertex).norm(dim=1) < max_distance
    return vertex, normal, inside & (vertex[:, 2] > 0) & (normal.norm(dim=1) > 0) & near


def icp(
    points: torch.Tensor,
    vertices: torch.Tensor,
    normals: torch.Tensor,
    pose: torch.Tensor,
    intrinsics,
    iterations: int,
    max_distance: float,
    kernel_start: float,
    kernel_end: float,
    damping: float,
) -> tuple[torch.Tensor, torch.Tensor, list[tuple[float, float]]]:
    """Pose [4, 4] T_target_source, the last H [6, 6], and share and mean weight of each iteration; all float64."""
    points, vertices, normals, pose = (t.double() for t in (points, vertices, normals, pose))
    fits = []
    for i in range(iterations):
        kernel = kernel_start * (kernel_end / kernel_start) ** min(i / max(iterations - 2, 1), 1)
        offset = points @ pose[:3, :3].T
        moved = offset + pose[:3, 3]
        vertex, normal, paired = associate(moved, vertices, normals, intrinsics, max_distance)
        residual = ((moved - vertex) * normal).sum(1)
        weight = paired / (1 + (residual / kernel) ** 2) ** 2
        jacobian = torch.cat([normal, torch.linalg.cross(offset, normal)], 1)
        h = torch.einsum("n,ni,nj->ij", weight, jacobian, jacobian)
        g = torch.einsum("n,n,ni->i", weight, residual, jacobian)
        damped = h + damping * h.diag().diag() + (1e-6 * h.trace() + 1e-8) * torch.eye(6, dtype=torch.float64)
        delta = -torch.linalg.solve(damped, g)
        delta *= min(1.0, 0.15 / max(float(delta.norm()), 1e-12))
        pose = pose.clone()
        pose[:3, :3] = torch.matrix_exp(twist(delta[3:])) @ pose[:3, :3]
        pose[:3, 3] += delta[:3]
        fits.append((float(paired.double().mean()), float(weight.mean())))
    return pose, h, fits
