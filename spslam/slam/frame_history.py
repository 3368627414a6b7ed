"""What tracking asks of the frames before, where it is in doubt about a pose; a frame without doubt costs nothing."""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from spslam import ops
from spslam.camera import Camera
from spslam.geometry import compose, matrix_to_pose7, pose7_to_matrix
from spslam.slam.pixels import THUMBNAIL_STEP_PX, FramePixels
from spslam.slam.recovery.pose_confidence import UNKNOWN_CONFLICT
from spslam.slam.state import SlamState

VIEWS = 128  # most frames that a pose is held against: the recent and an even sample of the rest
RECENT_VIEWS = 16
BEST_VIEWS = 8  # of them, the ones that share most surface, are asked
TOLERANCE_M, TOLERANCE_SHARE = 0.05, 0.02  # of a depth
FREE = 1.5  # tolerances from a surface begins what is clearly before or behind it
FEW_POINTS = 50  # say as much as the knowledge before
# Likeness of two coarse depth images: difference of the logarithms, with a limit, and what one without a depth costs.
MOST_DIFFERENCE, NO_DEPTH_DIFFERENCE = 0.3, 0.15
APART = 5  # frames; a run of like frames gives one candidate
TURNED_CANDIDATES = 32  # the likest are also compared as if the camera had turned
TURN_COLUMNS, TURN_ROWS = 0.15, 0.2  # of the picture, by which it may have turned, or twice that to the side
LEAST_OVERLAP = 0.4  # of a picture, that can be compared
LEAST_DEPTH_M = 0.05


@dataclass(frozen=True)
class Keyframe:
    """A frame whose pose is known.

    Attributes:
        records: int32 [P, 3] its packed pixels in random order.
        pose: float32 [7] T_world_camera.
    """

    records: torch.Tensor
    pose: torch.Tensor


@dataclass(frozen=True)
class RelocalizationCandidate:
    """An earlier frame that a frame looks like, and the pose float32 [7] from where it would look most alike."""

    frame: Keyframe
    start: torch.Tensor


class FrameHistory:
    """The frames of a state, as they are when asked.

    Args:
        state: of the system; not changed.
        camera: of all frames.
    """

    def __init__(self, state: SlamState, camera: Camera):
        self._state, self._camera = state, camera

    @property
    def is_lost(self) -> bool:
        """Whether the last frame's pose isn't known."""
        return bool(self._state.frames.lost[-1])

    @property
    def consistent_frames(self) -> int:
        """How many of the last frames are lost, but have likely poses that agree with one another."""
        return int(self._state.frames.consistent_frames[-1])

    @property
    def consecutive_lost_frames(self) -> int:
        """How many frames at the end have no known pose."""
        known = (~self._state.frames.lost).nonzero()
        return len(self._state.frames) - (int(known[-1]) + 1 if len(known) else 0)

    def last(self) -> Keyframe | None:
        """The last frame with pixels and a pose to be trusted; None where there is none."""
        rows = self._rows()
        return self._frame(int(rows[-1])) if len(rows) else None

    def mapped(self, every: int) -> tuple[int, Keyframe] | None:
        """The newest frame, and its number, that was mapped if every n-th is and its pose is to be trusted."""
        has_pixels, lost = self._state.pixels.has_pixels, self._state.frames.lost
        for row in range((len(lost) - 1) // every * every, -1, -every):
            if has_pixels[row] and not lost[row]:
                return row, self._frame(row)
        return None

    def depth_keyframes(self) -> ops.DepthKeyframes | None:
        """Earlier depth images to hold the next frame against; None where there is none of known pose."""
        state = self._state
        if state.views is None:
            return None
        return state.views.views(len(state.frames), state.frames.lost, state.frames.poses)

    def similar(self, pixels: FramePixels, count: int) -> list[RelocalizationCandidate]:
        """Frames whose coarse depth is most like that of the given pixels, the likest first; at most `count`.

        Of frames that follow one another, only the likest is taken, so that a slow camera fills no list by itself. The
        likest are compared also as they would look if the camera had turned.
        """
        rows = self._rows().to(self._state.frames.depth_thumbnails.device)
        if len(rows) == 0 or count == 0:
            return []
        difference = thumbnail_difference(pixels.depth_thumbnail, self._state.frames.depth_thumbnails[rows])
        least = -F.max_pool1d(-difference[None, None], 2 * APART + 1, 1, APART)[0, 0]
        candidates = torch.where(difference == least, difference, torch.inf)
        order = candidates.argsort(stable=True)[:TURNED_CANDIDATES]
        rows = rows[order[candidates[order].isfinite()]]
        shifts, differences = turned_differences(pixels.depth_thumbnail, self._state.frames.depth_thumbnails[rows])
        smallest, turn = differences.min(0)
        order = smallest.argsort(stable=True)[:count]
        chosen = zip(rows[order].tolist(), turn[order].tolist(), strict=True)
        return [self._alike(row, shifts[of_shift]) for row, of_shift in chosen]

    def surface_counts(self, vertices: torch.Tensor, intrinsics: ops.Intrinsics, pose: torch.Tensor) -> torch.Tensor:
        """How much of the surface known from other frames a frame sees, looks through, and has hidden from it.

        Args:
            vertices: float32 [H, W, 3], m, what the frame sees of the surface, in its axes; z = 0 where unknown.
            intrinsics: of that map.
            pose: float32 [7].

        Returns:
            int64 [3] on the device, see `surface_counts`; for `surface_shares`.
        """
        rows, frames = self._views(), self._state.frames
        return surface_counts(
            vertices, intrinsics, pose, frames.poses[rows], frames.depth_thumbnails[rows], self._camera
        )

    def _rows(self) -> torch.Tensor:
        return self._state.usable.nonzero()[:, 0]

    def _views(self) -> torch.Tensor:
        rows = self._rows()
        if len(rows) > VIEWS:
            older = torch.linspace(0, len(rows) - RECENT_VIEWS - 1, VIEWS - RECENT_VIEWS).long()
            rows = torch.cat([rows[older], rows[-RECENT_VIEWS:]])
        device = self._state.frames.poses.device
        return rows if device.type == "cpu" else rows.pin_memory().to(device, non_blocking=True)

    def _alike(self, row: int, shift: tuple[int, int]) -> RelocalizationCandidate:
        frame = self._frame(row)
        return RelocalizationCandidate(frame, turned(frame.pose, shift, self._camera))

    def _frame(self, row: int) -> Keyframe:
        return Keyframe(self._state.pixels.records[row], self._state.frames.poses[row])


def thumbnail_difference(depth_thumbnail: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """How unlike coarse depth images are: mean difference of the depths' logarithms, of at most `MOST_DIFFERENCE`.

    Args:
        depth_thumbnail: float16 [h, w], m, 0 where unknown.
        others: float16 [F, h, w].

    Returns:
        float32 [F]; cells that neither image knows do not count.
    """
    one, known = depth_thumbnail.float().clamp(min=LEAST_DEPTH_M).log(), depth_thumbnail > 0
    other, others_known = others.float().clamp(min=LEAST_DEPTH_M).log(), others > 0
    difference = (one - other).abs().clamp(max=MOST_DIFFERENCE)
    difference = torch.where(known & others_known, difference, NO_DEPTH_DIFFERENCE)
    either = known | others_known
    return (difference * either).sum((1, 2)) / either.sum((1, 2)).clamp(min=1)


def turned_differences(
    depth_thumbnail: torch.Tensor, others: torch.Tensor
) -> tuple[list[tuple[int, int]], torch.Tensor]:
    """How unlike coarse depth images are if the first is shifted over the others by so many rows and columns.

    Args:
        depth_thumbnail: float16 [h, w], m.
        others: float16 [F, h, w].

    Returns:
        The S shifts, of which one is none; differences float32 [S, F] of where the images overlap.
    """
    height, width = depth_thumbnail.shape
    down, right = max(round(TURN_ROWS * height), 1), max(round(TURN_COLUMNS * width), 1)
    shifts = [(y, x) for y in (0, -down, down) for x in (0, -right, right, -2 * right, 2 * right)]
    shifts = [(y, x) for y, x in shifts if (height - abs(y)) * (width - abs(x)) >= LEAST_OVERLAP * height * width]
    differences = [thumbnail_difference(_part(depth_thumbnail, -y, -x), _part(others, y, x)) for y, x in shifts]
    return shifts, torch.stack(differences)


def _part(depth_thumbnails: torch.Tensor, down: int, right: int) -> torch.Tensor:
    """What is left of images [..., h, w] without the first rows and columns, or the last where negative."""
    height, width = depth_thumbnails.shape[-2:]
    rows = slice(max(down, 0), height + min(down, 0))
    return depth_thumbnails[..., rows, max(right, 0) : width + min(right, 0)]


def turned(pose: torch.Tensor, shift: tuple[int, int], camera: Camera) -> torch.Tensor:
    """The pose float32 [7] of a camera that has turned from `pose` so that its picture shifted by depth_thumbnail cells.

    Args:
        pose: float32 [7].
        shift: rows and columns; what is at a cell was that much further down and to the right.
        camera: of the picture.
    """
    down, right = (math.atan(n * THUMBNAIL_STEP_PX / f) / 2 for n, f in zip(shift, (camera.fy, camera.fx), strict=True))
    yaw = pose7_to_matrix(np.array([math.cos(right), 0, math.sin(right), 0, 0, 0, 0]))
    pitch = pose7_to_matrix(np.array([math.cos(down), -math.sin(down), 0, 0, 0, 0, 0]))
    matrix = compose(pose7_to_matrix(pose.cpu().double().numpy()), yaw, pitch)
    return torch.from_numpy(matrix_to_pose7(matrix)).to(pose)


def surface_shares(seen: float, through: float, occluded_share: float) -> tuple[float, float]:
    """Shares of known surface that a frame looks through, and that something hides from it, of `surface_counts`.

    Returns:
        Two numbers from 0 to 1. Where little is known, the first goes towards what it counts as unmeasured.
    """
    share = (through + UNKNOWN_CONFLICT * FEW_POINTS) / (seen + through + FEW_POINTS)
    return share, occluded_share / max(seen + occluded_share, 1)


def surface_counts(
    vertices: torch.Tensor,
    intrinsics: ops.Intrinsics,
    pose: torch.Tensor,
    poses: torch.Tensor,
    depth_thumbnails: torch.Tensor,
    camera: Camera,
) -> torch.Tensor:
    """How many points of other frames' surface a frame sees, looks through, and has hidden from it by something nearer.

    Points are counted in the frames that share most surface with it.

    Args:
        vertices: float32 [H, W, 3], m, what the frame sees of the surface; z = 0 where unknown.
        intrinsics: of that map.
        pose: float32 [7] of the frame.
        poses: float32 [F, 7] of the other frames.
        depth_thumbnails: float16 [F, h, w] their coarse depth (m).
        camera: of all of them.

    Returns:
        int64 [3].
    """
    points, known = _thumbnail_points(depth_thumbnails, camera)
    x, y, z = _in_camera(points, poses, pose).unbind(-1)
    rows, columns = vertices.shape[:2]
    column = (x / z * intrinsics.fx + intrinsics.cx + 0.5).floor()
    row = (y / z * intrinsics.fy + intrinsics.cy + 0.5).floor()
    inside = known & (z > LEAST_DEPTH_M) & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    cell = torch.where(inside, row * columns + column, 0).long()
    depth = torch.where(inside, vertices[..., 2].flatten()[cell], 0)
    tolerance = TOLERANCE_M + TOLERANCE_SHARE * z
    behind = (depth - z) / tolerance
    kinds = torch.stack([behind.abs() < 1, behind > FREE, behind < -FREE]) & (depth > 0)
    counts = kinds.sum(2)
    best = (counts[0] + counts[1]).argsort(descending=True, stable=True)[:BEST_VIEWS]
    return counts[:, best].sum(1)


def _thumbnail_points(depth_thumbnails: torch.Tensor, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Surface points [F, h w, 3] of coarse depth images in their cameras' axes, and which of them are known."""
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


def rotations(quaternions: torch.Tensor) -> torch.Tensor:
    """Matrices [F, 3, 3] of unit quaternions (w, x, y, z) [F, 4]: v + 2 w (q x v) + 2 q x (q x v) for the axes v."""
    w, q = quaternions[:, :1, None], quaternions[:, 1:]
    axes = torch.eye(3, dtype=q.dtype, device=q.device).expand(len(q), 3, 3)
    once = torch.linalg.cross(q[:, None].expand_as(axes), axes)
    twice = torch.linalg.cross(q[:, None].expand_as(axes), once)
    return (axes + 2 * (w * once + twice)).transpose(1, 2)
