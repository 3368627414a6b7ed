"""What tracking asks of the frames before, where it is in doubt about a pose; a frame without doubt costs nothing."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from spslam.camera import Camera
from spslam.slam.pixels import LATTICE_STEP_PX, FramePixels, unpack_points
from spslam.slam.state import SlamState

POINTS = 512  # of a frame, held against what other frames saw
VIEWS = 256  # most of those others, the recent and an even sample of the rest
RECENT_VIEWS = 16
BEST_VIEWS = 8  # of them, the ones that saw most of the points, are asked
TOLERANCE_M, TOLERANCE_SHARE = 0.05, 0.02  # of a depth in a lattice
FREE = 1.5  # tolerances in front of a surface begins what was seen to be free
# Likeness of two coarse depth images: difference of the logarithms, with a limit, and what one without a depth costs.
MOST_DIFFERENCE, NO_DEPTH_DIFFERENCE = 0.3, 0.15
APART = 5  # frames; a run of like frames gives one candidate
LEAST_DEPTH_M = 0.05


@dataclass(frozen=True)
class EarlierFrame:
    """A frame whose pose is known.

    Attributes:
        records: int32 [P, 3] its packed pixels in random order.
        pose: float32 [7] T_world_camera.
    """

    records: torch.Tensor
    pose: torch.Tensor


class Past:
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

    def last(self) -> EarlierFrame | None:
        """The last frame with pixels and a pose to be trusted; None where there is none."""
        rows = self._rows()
        return self._frame(int(rows[-1])) if len(rows) else None

    def mapped(self, every: int) -> tuple[int, EarlierFrame] | None:
        """The newest frame, and its number, that was mapped if every n-th is and its pose is to be trusted."""
        has_pixels, lost = self._state.pixels.has_pixels, self._state.frames.lost
        for row in range((len(lost) - 1) // every * every, -1, -every):
            if has_pixels[row] and not lost[row]:
                return row, self._frame(row)
        return None

    def similar(self, pixels: FramePixels, count: int) -> list[EarlierFrame]:
        """Frames whose coarse depth is most like that of the given pixels, the likest first; at most `count`.

        Of frames that follow one another, only the likest is taken, so that a slow camera fills no list by itself.
        """
        rows = self._rows().to(self._state.frames.lattices.device)
        if len(rows) == 0 or count == 0:
            return []
        difference = lattice_difference(pixels.lattice, self._state.frames.lattices[rows])
        least = -F.max_pool1d(-difference[None, None], 2 * APART + 1, 1, APART)[0, 0]
        candidates = torch.where(difference == least, difference, torch.inf)
        order = candidates.argsort(stable=True)[:count]
        return [self._frame(row) for row in rows[order[candidates[order].isfinite()]].tolist()]

    def conflict(self, pixels: FramePixels, pose: torch.Tensor) -> float:
        """Share of the frame's points that lie where other frames saw free space, of all whose surroundings they saw.

        Args:
            pixels: of the frame.
            pose: float32 [7] that it is held to have.

        Returns:
            0 to 1; 0 where no frame saw any of the points.
        """
        rows = self._views()
        points = unpack_points(pixels.records[:POINTS], self._camera)
        frames = self._state.frames
        return float(free_space_conflict(points, pose, frames.poses[rows], frames.lattices[rows], self._camera))

    def _rows(self) -> torch.Tensor:
        return self._state.usable.nonzero()[:, 0]

    def _views(self) -> torch.Tensor:
        rows = self._rows()
        if len(rows) > VIEWS:
            older = torch.linspace(0, len(rows) - RECENT_VIEWS - 1, VIEWS - RECENT_VIEWS).long()
            rows = torch.cat([rows[older], rows[-RECENT_VIEWS:]])
        return rows.to(self._state.frames.poses.device)

    def _frame(self, row: int) -> EarlierFrame:
        return EarlierFrame(self._state.pixels.records[row], self._state.frames.poses[row])


def lattice_difference(lattice: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """How unlike coarse depth images are: mean difference of the depths' logarithms, of at most `MOST_DIFFERENCE`.

    Args:
        lattice: float16 [h, w], m, 0 where unknown.
        others: float16 [F, h, w].

    Returns:
        float32 [F]; cells that neither image knows do not count.
    """
    one, known = lattice.float().clamp(min=LEAST_DEPTH_M).log(), lattice > 0
    other, others_known = others.float().clamp(min=LEAST_DEPTH_M).log(), others > 0
    difference = (one - other).abs().clamp(max=MOST_DIFFERENCE)
    difference = torch.where(known & others_known, difference, NO_DEPTH_DIFFERENCE)
    either = known | others_known
    return (difference * either).sum((1, 2)) / either.sum((1, 2)).clamp(min=1)


def free_space_conflict(
    points: torch.Tensor, pose: torch.Tensor, poses: torch.Tensor, lattices: torch.Tensor, camera: Camera
) -> torch.Tensor:
    """Share of points in what other frames saw to be free, of those free or on a surface, in the frames that saw most.

    Args:
        points: float32 [N, 3], m, in the axes of a camera.
        pose: float32 [7] of that camera.
        poses: float32 [F, 7] of the other frames.
        lattices: float16 [F, h, w] their coarse depth (m).
        camera: of all of them.

    Returns:
        float32 []; 0 for no points or frames.
    """
    x, y, z = _in_cameras(points, pose, poses).unbind(-1)
    rows, columns = lattices.shape[1:]
    column = ((x / z * camera.fx + camera.cx + 0.5) / LATTICE_STEP_PX).floor()
    row = ((y / z * camera.fy + camera.cy + 0.5) / LATTICE_STEP_PX).floor()
    inside = (z > LEAST_DEPTH_M) & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    cell = torch.where(inside, row * columns + column, 0).long()
    depth = torch.where(inside, lattices.flatten(1).float().gather(1, cell), 0)
    tolerance = TOLERANCE_M + TOLERANCE_SHARE * z
    on_surface = (depth > 0) & ((depth - z).abs() < tolerance)
    in_free_space = (depth > 0) & (depth - z > FREE * tolerance)
    free, seen = in_free_space.sum(1), (on_surface | in_free_space).sum(1)
    best = seen.argsort(descending=True, stable=True)[:BEST_VIEWS]
    return free[best].sum() / seen[best].sum().clamp(min=1)


def _in_cameras(points: torch.Tensor, pose: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
    """Points [N, 3] of one camera in the axes of others, [F, N, 3]."""
    world = points @ _rotations(pose[None, :4])[0].T + pose[4:]
    return (world - poses[:, None, 4:]) @ _rotations(poses[:, :4])


def _rotations(quaternions: torch.Tensor) -> torch.Tensor:
    """Matrices [F, 3, 3] of unit quaternions [F, 4]: v + 2 w (q x v) + 2 q x (q x v) for the axes v."""
    w, q = quaternions[:, :1, None], quaternions[:, 1:]
    axes = torch.eye(3, dtype=q.dtype, device=q.device).expand(len(q), 3, 3)
    once = torch.linalg.cross(q[:, None].expand_as(axes), axes)
    twice = torch.linalg.cross(q[:, None].expand_as(axes), once)
    return (axes + 2 * (w * once + twice)).transpose(1, 2)
