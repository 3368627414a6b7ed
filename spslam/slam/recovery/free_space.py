"""Whether a pose would make the frame look through surface that other frames have seen."""

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam.cell_grid import CellGrid
from spslam.slam.pixels import THUMBNAIL_STEP_PX, FramePixels

TOLERANCE_M, TOLERANCE_SHARE = 0.05, 0.02  # of a depth
CLEAR_TOLERANCES = 1.5  # what is this far before or behind the surface is clearly not on it
BEST_FRAMES = 8  # of the frames compared, those that share most surface are counted
ASSUMED_POINTS = 50  # number of points that `unknown_share` counts as in the average


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
    pixels: FramePixels,
    pose: torch.Tensor,
    poses: torch.Tensor,
    depth_thumbnails: torch.Tensor,
    rows: torch.Tensor,
    camera: Camera,
) -> tuple[torch.Tensor, torch.Tensor]:
    """How many surface points of other frames a frame sees, looks through, and has occluded by something nearer that
    they do not know.

    A column before a wall hides another part of it from each frame, and is no occlusion. Points are counted in the
    `BEST_FRAMES` that share most surface with it.

    Args:
        pixels: of the frame.
        pose: float32 [7] of the frame.
        poses: float32 [F, 7] of frames.
        depth_thumbnails: float16 [F, h, w] their depth thumbnails (m).
        rows: int64 [M] of those to compare it with, on the device.
        camera: of all frames.

    Returns:
        int64 [3] on the device; zeros where nothing is known. For `surface_shares`. And int64 [min(M, 8)], the places
        among `rows` of the frames that were counted, those that share most surface first.
    """
    grid = CellGrid.of(camera)
    return ops.comparison.count_known_surface(
        (pixels.records, pixels.normals),
        pose,
        (poses, depth_thumbnails, rows),
        ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy),
        THUMBNAIL_STEP_PX,
        ops.comparison.ComparedGrid(grid.step, grid.rows, grid.columns),
        (TOLERANCE_M, TOLERANCE_SHARE, CLEAR_TOLERANCES),
        BEST_FRAMES,
    )
