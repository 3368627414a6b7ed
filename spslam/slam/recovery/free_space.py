"""Whether a pose would make the frame look through surface that other frames have seen."""

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam.pixels import THUMBNAIL_STEP_PX
from spslam.slam.poses import rotations

TOLERANCE_M, TOLERANCE_SHARE = 0.05, 0.02  # of a depth
CLEAR_TOLERANCES = 1.5  # what is this far before or behind the surface is clearly not on it
BEST_FRAMES = 8  # of the frames compared, those that share most surface are counted
ASSUMED_POINTS = 50  # number of points that `unknown_share` counts as in the average
MIN_DEPTH_M = 0.05


def surface_shares(seen: float, through: float, occluded: float, unknown_share: float) -> tuple[float, float]:
    """Shares of known surface that a frame looks through, and that something nearer occludes, of `surface_counts`.

    Args:
        seen, through, occluded: the counts.
        unknown_share: what the first share tends to where few points are known.

    Returns:
        Two numbers from 0 to 1.
    """
    share = (through + unknown_share * ASSUMED_POINTS) / (seen + through + ASSUMED_POINTS)
    return share, occluded / max(seen + occluded, 1)


def surface_counts(
    vertices: torch.Tensor,
    intrinsics: ops.Intrinsics,
    pose: torch.Tensor,
    poses: torch.Tensor,
    depth_thumbnails: torch.Tensor,
    camera: Camera,
) -> tuple[torch.Tensor, torch.Tensor]:
    """How many surface points of other frames a frame sees, looks through, and has occluded by something nearer that
    they do not know.

    A column before a wall hides another part of it from each frame, and is no occlusion. Points are counted in the
    `BEST_FRAMES` that share most surface with it.

    Args:
        vertices: float32 [H, W, 3], m, the frame's vertex map in its own axes; z = 0 where unknown.
        intrinsics: of that map.
        pose: float32 [7] of the frame.
        poses: float32 [F, 7] of the other frames.
        depth_thumbnails: float16 [F, h, w] their depth thumbnails (m).
        camera: of all frames.

    Returns:
        int64 [3] on the device; zeros where nothing is known. For `surface_shares`. And int64 [min(F, 8)], the frames
        that were counted, those that share most surface first.
    """
    points, known = _thumbnail_points(depth_thumbnails, camera)
    x, y, z = _in_camera(points, poses, pose).unbind(-1)
    rows, columns = vertices.shape[:2]
    column = (x / z * intrinsics.fx + intrinsics.cx + 0.5).floor()
    row = (y / z * intrinsics.fy + intrinsics.cy + 0.5).floor()
    inside = known & (z > MIN_DEPTH_M) & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    cell = torch.where(inside, row * columns + column, 0).long()
    depth = torch.where(inside, vertices[..., 2].flatten()[cell], 0)
    tolerance = TOLERANCE_M + TOLERANCE_SHARE * z
    behind = (depth - z) / tolerance
    is_seen = (behind.abs() < 1) & (depth > 0)
    before = behind < -CLEAR_TOLERANCES
    kinds = torch.stack([is_seen, behind > CLEAR_TOLERANCES, before & ~_is_known(is_seen, cell, (rows, columns))])
    counts = (kinds & (depth > 0)).sum(2)
    best = (counts[0] + counts[1]).argsort(descending=True, stable=True)[:BEST_FRAMES]
    return counts[:, best].sum(1), best


def _is_known(is_seen: torch.Tensor, cell: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Whether what the frame shows at each point's cell, or next to it, is surface that another point lies on.

    Args:
        is_seen: bool [F, N], points on the frame's surface.
        cell: int64 [F, N] in the frame's vertex map.
        size: rows and columns of that map.

    Returns:
        bool [F, N].
    """
    count = torch.zeros(size[0] * size[1], dtype=torch.int32, device=cell.device)
    count = count.scatter_add(0, cell.flatten(), is_seen.flatten().int()).view(1, 1, *size)
    near = torch.nn.functional.max_pool2d((count > 0).float(), 3, 1, 1)
    return near.flatten()[cell] > 0


def _thumbnail_points(depth_thumbnails: torch.Tensor, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Surface points [F, h w, 3] of depth thumbnails in their cameras' axes, and which of them are known."""
    rows, columns = (
        torch.arange(n, device=depth_thumbnails.device) * THUMBNAIL_STEP_PX for n in depth_thumbnails.shape[1:]
    )
    v, u = torch.meshgrid(rows + THUMBNAIL_STEP_PX // 2, columns + THUMBNAIL_STEP_PX // 2, indexing="ij")
    rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)], -1)
    depth = depth_thumbnails.flatten(1).float()
    return depth[..., None] * rays.view(-1, 3), depth > 0


def _in_camera(points: torch.Tensor, poses: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
    """Points [F, N, 3] of cameras at `poses` [F, 7] in the axes of the one at `pose` [7]."""
    world = points @ rotations(poses[:, :4]).transpose(1, 2) + poses[:, None, 4:]
    return (world - pose[4:]) @ rotations(pose[None, :4])
