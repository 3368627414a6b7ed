"""Overlap of frames and the choice by it, in plain torch and lists."""

import torch

from spslam.geometry import pose7_to_matrix


def overlap(
    points: torch.Tensor, poses: torch.Tensor, depth_thumbnails: torch.Tensor, intrinsics, step: int
) -> torch.Tensor:
    """float64 [F]: the share of points [N, 3] that fall in each frame's depth_thumbnail within 0.1 m of its depth."""
    matrices = torch.from_numpy(pose7_to_matrix(poses.double().numpy()))
    fx, fy, cx, cy = intrinsics
    shares = []
    for matrix, depth_thumbnail in zip(matrices, depth_thumbnails.double(), strict=True):
        x, y, z = ((points.double() - matrix[:3, 3]) @ matrix[:3, :3]).unbind(1)
        front = z > 0.05
        safe = torch.where(front, z, 1.0)
        column, row = (((c / safe * f + p) + 0.5) // step for c, f, p in ((x, fx, cx), (y, fy, cy)))
        height, width = depth_thumbnail.shape
        inside = front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        seen = depth_thumbnail[row.clamp(0, height - 1).long(), column.clamp(0, width - 1).long()]
        shares.append((inside & (seen > 0) & ((seen - z).abs() < 0.1)).double().mean())
    return torch.stack(shares)


def select(shares: torch.Tensor, candidates: list[int], covisible: int, count: int, threshold: float) -> list[int]:
    """Rows of the first `covisible` candidates above the threshold and of the first others, `count` in all."""
    near = [c for c in candidates if shares[c] > threshold][: min(covisible, count)]
    others = [c for c in candidates if c not in near]
    return sorted(near + others[: count - len(near)])
