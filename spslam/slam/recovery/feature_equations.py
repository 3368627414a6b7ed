"""What image features want of a pose: normal equations of their reprojection errors, with robust weights."""

import math
from dataclasses import dataclass

import numpy as np

INDEPENDENT_FEATURES = 50  # as many a frame's are worth: those of one earlier frame are off by the same
WIDE = 3.0  # times the error of an inlier, the width of the robust kernel
MIN_DEPTH_M = 0.05
# Of what was seen without depth, by its expected inverse depth: what seems to lie beyond the range may be nearer.
INVERSE_DEPTH_DEVIATION = 4.0
DEPTH_DEVIATIONS = 3.0  # of a point's depth, by which it may be off, as an inlier's error is of its position


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


def point_equations(
    matrix: np.ndarray, seen: SeenPoints, pose: np.ndarray, error_px: float
) -> tuple[int, np.ndarray, np.ndarray]:
    """How many points agree with a pose, and what all want of it.

    As the camera moves away from where a point was measured, the error of its depth shows: it moves the point along its
    epipolar line by d for each deviation, and errors there count by e / sqrt(e^2 + (3 d)^2), e being `error_px`.

    Args:
        matrix: float64 [3, 3] of the camera.
        seen: the points.
        pose: float64 [4, 4] T_world_camera.
        error_px: of a position that agrees.

    Returns:
        How many; float64 [6, 6] and [6]: matrix and gradient of a step of the pose (m, rad) in world axes.
    """
    local, positions, along = _before(pose, matrix, seen)
    residuals, jacobians = _reprojected(matrix, local, 1 / local[2], positions)
    return _weighted(residuals, jacobians, along, pose, error_px)


def agreeing_points(matrix: np.ndarray, seen: SeenPoints, pose: np.ndarray, error_px: float) -> int:
    """How many points agree with a pose; as `point_equations`."""
    local, positions, along = _before(pose, matrix, seen)
    residuals = _errors(matrix, local, positions)
    unit, less = _less_along(along, error_px)
    residuals -= less * (unit * residuals).sum(0)
    return int(np.count_nonzero((residuals**2).sum(0) < error_px**2))


def ray_equations(
    matrix: np.ndarray, seen: SeenRays, pose: np.ndarray, error_px: float, least: int = 0
) -> tuple[int, np.ndarray, np.ndarray]:
    """`point_equations` of what lies beyond the range z of depth: at an inverse depth n = 1/2z, give or take 4 n.

    The derivative d of a position by the inverse depth says how far it may be off along its epipolar line: errors there
    count by e / sqrt(e^2 + (4 n |d|)^2) of those across it, e being `error_px`. So rays tell how the camera has turned,
    and, the farther it has moved, the more where to, but not how far.

    Args:
        matrix, pose, error_px: as there.
        seen: the rays.
        least: each weighs at most as one of so many that agree.
    """
    to_camera, inverse_depth = pose[:3, :3].T, 0.5 / seen.beyond_m
    moved = to_camera @ (seen.origin - pose[:3, 3])
    local = to_camera @ seen.directions.T + inverse_depth * moved[:, None]
    front, positions = local[2] > MIN_DEPTH_M, seen.positions
    if not front.all():
        local, inverse_depth, positions = local[:, front], inverse_depth[front], positions[front]
    residuals, jacobians = _reprojected(matrix, local, inverse_depth / local[2], positions)
    along = INVERSE_DEPTH_DEVIATION * inverse_depth * _shown_motion(matrix, local, moved[:, None])
    return _weighted(residuals, jacobians, along, pose, error_px, least)


def _shown_motion(matrix: np.ndarray, local: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """How far positions [2, M] px move, to first order, where points [3, M] in camera axes move by [3, M]."""
    return matrix[:2, :2] @ ((moved[:2] - local[:2] / local[2] * moved[2]) / local[2])


def _before(pose: np.ndarray, matrix: np.ndarray, seen: SeenPoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points before the camera at a pose, [3, M] in its axes, their positions, [M, 2], and by how much these may be off
    for the noise of depth, [2, M] px."""
    to_camera = pose[:3, :3].T
    local, positions, moved = to_camera @ (seen.points - pose[:3, 3]).T, seen.positions, to_camera @ seen.deviations.T
    front = local[2] > MIN_DEPTH_M
    if not front.all():
        local, positions, moved = local[:, front], positions[front], moved[:, front]
    return local, positions, DEPTH_DEVIATIONS * _shown_motion(matrix, local, moved)


def _less_along(along: np.ndarray, error_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Of positions that may be off by `along`, [2, M] px, beside `error_px`: its direction, and what times the part of
    an error in that direction is to be taken from the error, [2, M] each."""
    length = np.sqrt((along**2).sum(0))
    unit = along / np.maximum(length, np.finfo(float).tiny)
    return unit, unit * (1 - error_px / np.sqrt(error_px**2 + length**2))


def _errors(matrix: np.ndarray, local: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Errors [2, M] px of points [3, M] in camera axes, which may be scaled, and where they are shown, [M, 2]."""
    return matrix[:2, :2] @ (local[:2] / local[2]) + matrix[:2, 2:] - positions.T


def _reprojected(
    matrix: np.ndarray, local: np.ndarray, inverse_depth: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors [2, M] px of points [3, M] in camera axes, and their derivatives [2, 6, M] by a step of the pose.

    With a = x/z and b = y/z, a point's derivatives by a step (m, rad) in camera axes are
    f_x (-1/z, 0, a/z, ab, -(1 + a^2), b) and f_y (0, -1/z, b/z, 1 + b^2, -ab, -a).

    Args:
        matrix: of the camera.
        local: the points, which may be scaled.
        inverse_depth: [M] of the points, 1/m.
        positions: [M, 2] where they are shown.
    """
    (a, b), (fx, fy) = local[:2] / local[2], np.diag(matrix)[:2]
    residuals = _errors(matrix, local, positions)
    zero, ab = np.zeros_like(a), a * b
    rows = (
        (-inverse_depth, zero, a * inverse_depth, ab, -(1 + a**2), b),
        (zero, -inverse_depth, b * inverse_depth, 1 + b**2, -ab, -a),
    )
    return residuals, np.stack([focal * np.stack(row) for focal, row in zip((fx, fy), rows, strict=True)])


def _weighted(
    residuals: np.ndarray, jacobians: np.ndarray, along: np.ndarray, pose: np.ndarray, error_px: float, least: int = 0
) -> tuple[int, np.ndarray, np.ndarray]:
    """How many errors are below `error_px`, matrix and gradient; of errors [2, M], derivatives [2, 6, M], and by how
    much positions may be off beside, [2, M]."""
    unit, less = _less_along(along, error_px)
    residuals = residuals - less * (unit * residuals).sum(0)
    jacobians = jacobians - less[:, None] * (unit[:, None] * jacobians).sum(0)
    ratio = (residuals**2).sum(0) / error_px**2
    agreeing = int((ratio < 1).sum())
    share = min(1.0, INDEPENDENT_FEATURES / max(agreeing, least, 1)) / error_px**2
    root = math.sqrt(share) / (1 + ratio / WIDE**2)  # of Geman-McClure's weight
    weighted = np.concatenate([*(root * jacobians)], 1)
    to_world = np.kron(np.eye(2), pose[:3, :3])
    normal, gradient = weighted @ weighted.T, weighted @ (root * residuals).ravel()
    return agreeing, to_world @ normal @ to_world.T, to_world @ gradient
