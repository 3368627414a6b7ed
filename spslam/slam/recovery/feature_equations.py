"""What image features want of a pose: weighted reprojection errors, compiled (`csrc/cpu/feature_pose.cpp`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spslam.geometry import matrix_to_pose7
from spslam.image_library import check_memory, image_library
from spslam.slam.color_motion import ColorMotion


class Addresses:
    """Where arrays lie, as a compiled function takes several, and the arrays as long as that lives.

    Attributes:
        first: where the addresses themselves lie.
    """

    def __init__(self, arrays: Sequence[np.ndarray | None]):
        self._arrays = arrays
        self._addresses = np.array([0 if array is None else array.ctypes.data for array in arrays], np.uintp)
        self.first = self._addresses.ctypes.data


@dataclass(frozen=True)
class SeenRays:
    """What an earlier frame saw beyond the range of its depth, and where the frame shows it.

    Attributes:
        origin: float64 [3], where the earlier frame's camera stood, in the world, m.
        directions: float64 [M, 3] in the world, 1 along the camera's axis.
        positions: float64 [M, 2] in px of the intensity image.
        beyond_m: float64 [M], the range beyond which it lies, m.
    """

    origin: np.ndarray
    directions: np.ndarray
    positions: np.ndarray
    beyond_m: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """As compiled functions take them."""
        return tuple(map(_row_major, (self.origin, self.directions, self.positions, self.beyond_m)))

    @cached_property
    def addresses(self) -> Addresses:
        """Where these lie."""
        return Addresses(self.arrays)


@dataclass(frozen=True)
class SeenPoints:
    """Surface points of earlier frames, and where the frame shows them.

    Attributes:
        points: float64 [M, 3] in the world, m.
        positions: float64 [M, 2] in px of the intensity image.
        deviations: float64 [M, 3], the standard deviations of their depths along their lines of sight, m.
    """

    points: np.ndarray
    positions: np.ndarray
    deviations: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """As compiled functions take them."""
        return tuple(map(_row_major, (self.points, self.positions, self.deviations)))

    @cached_property
    def addresses(self) -> Addresses:
        """Where these lie."""
        return Addresses(self.arrays)


def point_equations(
    camera: np.ndarray, seen: SeenPoints, pose: np.ndarray, error_px: float
) -> tuple[int, np.ndarray, np.ndarray]:
    """How many points agree with a pose, and what all want of it, by Geman-McClure's weights.

    As the camera moves away from where a point was measured, the error of its depth shows: it moves the point along its
    epipolar line by d for each deviation, and errors there count by e / sqrt(e^2 + (3 d)^2), e being `error_px`.

    Args:
        camera: float64 [4], fx, fy, cx, cy.
        seen: the points.
        pose: float64 [4, 4] T_world_camera.
        error_px: of a position that agrees.

    Returns:
        How many; float64 [6, 6] and [6]: matrix and gradient of a step of the pose (m, rad) in world axes.
    """
    equations, pose = np.empty(42), _row_major(pose)
    count = image_library().spslam_point_equations(
        seen.addresses.first, len(seen), camera.ctypes.data, pose.ctypes.data, error_px, equations.ctypes.data
    )
    return count, equations[:36].reshape(6, 6), equations[36:]


def agreeing_points(camera: np.ndarray, seen: SeenPoints, pose: np.ndarray, error_px: float) -> np.ndarray:
    """Bool [M]: which points agree with a pose; as `point_equations`."""
    agrees, pose = np.empty(len(seen), bool), _row_major(pose)
    image_library().spslam_agreeing_points(
        seen.addresses.first, len(seen), camera.ctypes.data, pose.ctypes.data, error_px, agrees.ctypes.data
    )
    return agrees


def ray_equations(
    camera: np.ndarray, seen: SeenRays, pose: np.ndarray, error_px: float, least: int = 0
) -> tuple[int, np.ndarray, np.ndarray]:
    """`point_equations` of what lies beyond the range z of depth: at an inverse depth n = 1/2z, give or take 4 n.

    The derivative d of a position by the inverse depth says how far it may be off along its epipolar line: errors there
    count by e / sqrt(e^2 + (4 n |d|)^2) of those across it, e being `error_px`. So rays tell how the camera has turned,
    and, the farther it has moved, the more where to, but not how far.

    Args:
        camera, pose, error_px: as there.
        seen: the rays.
        least: each weighs at most as one of so many that agree.
    """
    equations, pose = np.empty(42), _row_major(pose)
    count = image_library().spslam_ray_equations(
        seen.addresses.first, len(seen), camera.ctypes.data, pose.ctypes.data, error_px, least, equations.ctypes.data
    )
    return count, equations[:36].reshape(6, 6), equations[36:]


def held_pose(
    camera: np.ndarray,
    points: SeenPoints,
    rays: Sequence[SeenRays],
    motion: ColorMotion | None,
    pose: np.ndarray,
    information: np.ndarray,
    error_px: float,
    least: int,
) -> np.ndarray | None:
    """The pose that surface and image features agree on best, by Gauss-Newton.

    Args:
        camera: as of `point_equations`.
        points: of earlier frames.
        rays: of each of these.
        motion: from the frame's depth to its color image; None where they are of one moment.
        pose: float64 [7], where surface has put the camera.
        information: float64 [6, 6] of that pose.
        error_px: as of `point_equations`.
        least: points that must agree.

    Returns:
        float64 [7] with w >= 0; None where fewer agree.

    Raises:
        MemoryError: there is not enough.
    """
    before = None if motion is None else matrix_to_pose7(motion.before)
    numbers = np.array([0.0 if motion is None else motion.share, error_px])
    seen = Addresses([*points.arrays, *(array for one in rays for array in one.arrays)])
    frame = Addresses([camera, pose, _row_major(information), before, numbers])
    counts, held = np.array([len(points), *map(len, rays)], np.int64), np.empty(7)
    agreeing = image_library().spslam_hold_pose(
        seen.first, counts.ctypes.data, len(rays), frame.first, least, held.ctypes.data
    )
    if agreeing == -1:
        return None
    check_memory(agreeing)
    return held


def _row_major(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float64)
