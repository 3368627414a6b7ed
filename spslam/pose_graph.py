"""Robust pose graphs: poses that agree best with measured relative poses (Grisetti et al. 2010).

An edge measures the pose M of a source in the axes of a target. With A = T_target^-1 T_source of the poses as they are,
its error is e = (t_A - t_M, log(R_A R_M^T)) in the target's axes, and what is minimized is the sum of e^T I e, I being
the edge's information. Edges that may be wrong count by Geman-McClure's weight (c / (c + e^T I e))^2, whose width c is
narrowed from one solution to the next (graduated non-convexity, Yang et al. 2020), so that what few edges want against
all others is found out late. Gauss-Newton steps are solved by a sparse factorization.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spslam.geometry import compose, inverse, matrix_to_quaternion

ERROR_WIDTH = 16.8  # c: 99 % of correct edges have a smaller e^T I e (chi-squared, six degrees of freedom)
_NARROWING = 2.0  # factor of the width from one step to the next
_MAX_STEPS, _SMALL_STEP = 50, 1e-6  # m and rad
_DAMPING = 1e-6  # share of the diagonal that is added to it
_WEAK = 1e-6  # information on every pose, so that what no edge holds stays where it is


@dataclass(frozen=True)
class PoseEdges:
    """E measured relative poses.

    Attributes:
        sources, targets: int64 [E], rows of the poses.
        measured: float64 [E, 4, 4] T_target_source.
        information: float64 [E, 6, 6], inverse covariances of (translation m, rotation rad) in the target's axes.
        may_be_wrong: bool [E], which count by a robust weight.
    """

    sources: np.ndarray
    targets: np.ndarray
    measured: np.ndarray
    information: np.ndarray
    may_be_wrong: np.ndarray

    def __len__(self) -> int:
        return len(self.sources)


@dataclass(frozen=True)
class PoseGraphSolution:
    """Poses and what became of the edges.

    Attributes:
        poses: float64 [N, 4, 4].
        weights: float64 [E] robust weights, 0 to 1; 1 of edges that can't be wrong.
        errors: float64 [E], e^T I e.
    """

    poses: np.ndarray
    weights: np.ndarray
    errors: np.ndarray


def optimize_pose_graph(poses: np.ndarray, edges: PoseEdges, fixed: np.ndarray) -> PoseGraphSolution:
    """Moves poses so that they agree with edges.

    Args:
        poses: float64 [N, 4, 4] T_world_camera to start from.
        edges: the measurements.
        fixed: bool [N], which poses stay as they are.

    Returns:
        The poses and the edges' weights and errors. Poses that no edge joins to another stay as they are.

    Raises:
        ValueError: arrays of other shapes, or an edge between rows that are not there.

    Example:
        >>> poses = np.tile(np.eye(4), (3, 1, 1))
        >>> ahead = np.eye(4); ahead[0, 3] = 1.0
        >>> two = compose(ahead, ahead)
        >>> edges = PoseEdges(np.array([1, 2, 2]), np.array([0, 1, 0]), np.stack([ahead, ahead, two]),
        ...     np.tile(np.eye(6), (3, 1, 1)), np.zeros(3, bool))
        >>> solved = optimize_pose_graph(poses, edges, np.array([True, False, False]))
        >>> solved.poses[:, 0, 3].round(3).tolist()
        [0.0, 1.0, 2.0]
    """
    _check(poses, edges, fixed)
    poses = np.array(poses, np.float64)
    column = np.where(fixed, -1, np.cumsum(~fixed) - 1)
    if not len(edges) or fixed.all():
        return PoseGraphSolution(poses, np.ones(len(edges)), _squares(_errors(poses, edges), edges))
    first = _squares(_errors(poses, edges), edges)[edges.may_be_wrong]
    width = ERROR_WIDTH * max(1.0, float(first.max(initial=0.0)) / ERROR_WIDTH)
    for _ in range(_MAX_STEPS):
        errors = _errors(poses, edges)
        weights = _weights(_squares(errors, edges), edges, width)
        step = _step(poses, edges, errors, weights, column)
        poses = _moved(poses, step, column)
        if width == ERROR_WIDTH and np.abs(step).max() < _SMALL_STEP:
            break
        width = max(width / _NARROWING, ERROR_WIDTH)
    squares = _squares(_errors(poses, edges), edges)
    return PoseGraphSolution(poses, _weights(squares, edges, ERROR_WIDTH), squares)


def squared_errors(poses: np.ndarray, edges: PoseEdges) -> np.ndarray:
    """e^T I e, float64 [E], of edges between poses float64 [N, 4, 4]."""
    return _squares(_errors(poses, edges), edges)


def rotation_matrices(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] (axis times angle, rad)."""
    if np.ndim(vectors) == 1:
        return _rotation_matrix(*np.asarray(vectors).tolist())
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    k = cross_matrices(vectors)
    sine = np.where(small, 1.0, np.sin(safe) / safe)
    cosine = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + sine * k + cosine * (k @ k)


def _rotation_matrix(x: float, y: float, z: float) -> np.ndarray:
    """`rotation_matrices` of one vector: a frame asks several times, and arrays of one number take longer."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    sine, cosine = (1.0, 0.5) if angle < 1e-8 else (math.sin(angle) / angle, (1 - math.cos(angle)) / square)
    xy, xz, yz = cosine * x * y, cosine * x * z, cosine * y * z
    return np.array(
        (
            (1 - cosine * (y * y + z * z), xy - sine * z, xz + sine * y),
            (xy + sine * z, 1 - cosine * (x * x + z * z), yz - sine * x),
            (xz - sine * y, yz + sine * x, 1 - cosine * (x * x + y * y)),
        )
    )


def rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Rotation vectors [..., 3] of rotation matrices [..., 3, 3]."""
    q = matrix_to_quaternion(rotations)
    if q.ndim == 1:
        length = math.sqrt(float(q[1:] @ q[1:]))
        return q[1:] * (2.0 if length < 1e-12 else 2 * math.atan2(length, float(q[0])) / length)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine < 1e-12, 2.0, angle / np.where(sine < 1e-12, 1.0, sine))


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """Matrices [..., 3, 3] with which to multiply is the cross product by vectors [..., 3] from the left."""
    x, y, z = np.moveaxis(np.asarray(vectors, np.float64), -1, 0)
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _check(poses: np.ndarray, edges: PoseEdges, fixed: np.ndarray) -> None:
    count, edge_count = len(poses), len(edges)
    shapes = {
        "poses": (poses, (count, 4, 4)),
        "fixed": (fixed, (count,)),
        "edges.targets": (edges.targets, (edge_count,)),
        "edges.measured": (edges.measured, (edge_count, 4, 4)),
        "edges.information": (edges.information, (edge_count, 6, 6)),
        "edges.may_be_wrong": (edges.may_be_wrong, (edge_count,)),
    }
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise ValueError(f"optimize_pose_graph: {name} must have shape {shape}, got {array.shape}")
    ends = np.concatenate([edges.sources, edges.targets])
    if len(ends) and not (ends.min() >= 0 and ends.max() < count):
        raise ValueError(f"optimize_pose_graph: edges must join rows below {count}, got {ends.min()} to {ends.max()}")


def _errors(poses: np.ndarray, edges: PoseEdges) -> np.ndarray:
    """e, float64 [E, 6]."""
    relative = compose(inverse(poses[edges.targets]), poses[edges.sources])
    turned = relative[:, :3, :3] @ np.swapaxes(edges.measured[:, :3, :3], 1, 2)
    return np.concatenate([relative[:, :3, 3] - edges.measured[:, :3, 3], rotation_vectors(turned)], 1)


def _squares(errors: np.ndarray, edges: PoseEdges) -> np.ndarray:
    return np.einsum("ei,eij,ej->e", errors, edges.information, errors)


def _weights(squares: np.ndarray, edges: PoseEdges, width: float) -> np.ndarray:
    return np.where(edges.may_be_wrong, (width / (width + squares)) ** 2, 1.0)


def _jacobians(poses: np.ndarray, edges: PoseEdges) -> np.ndarray:
    """Derivatives [E, 2, 6, 6] of e by a step (world translation, world rotation) of the source and of the target."""
    to_target = np.swapaxes(poses[edges.targets, :3, :3], 1, 2)
    between = poses[edges.sources, :3, 3] - poses[edges.targets, :3, 3]
    jacobians = np.zeros((len(edges), 2, 6, 6))
    jacobians[:, 0, :3, :3] = jacobians[:, 0, 3:, 3:] = to_target
    jacobians[:, 1] = -jacobians[:, 0]
    jacobians[:, 1, :3, 3:] = to_target @ cross_matrices(between)
    return jacobians


def _step(
    poses: np.ndarray, edges: PoseEdges, errors: np.ndarray, weights: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """The Gauss-Newton step [M, 6] of the M poses that are not fixed; `column` [N] is their number, -1 of others."""
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import splu

    count = int(column.max()) + 1
    jacobians = _jacobians(poses, edges)
    weighted = np.einsum("e,eij,ebjk->ebik", weights, edges.information, jacobians)
    blocks = np.einsum("eaji,ebjk->eabik", jacobians, weighted)
    ends = column[np.stack([edges.sources, edges.targets], 1)]
    gradient = np.zeros((count, 6))
    rows, columns, values = [], [], []
    places = np.arange(6)
    for one in range(2):
        free = ends[:, one] >= 0
        np.add.at(gradient, ends[free, one], np.einsum("eji,ej->ei", weighted[free, one], errors[free]))
        for other in range(2):
            both = free & (ends[:, other] >= 0)
            row = 6 * ends[both, one, None, None] + places[:, None]
            rows.append(np.broadcast_to(row, (len(row), 6, 6)).ravel())
            at = 6 * ends[both, other, None, None] + places
            columns.append(np.broadcast_to(at, (len(at), 6, 6)).ravel())
            values.append(blocks[both, one, other].ravel())
    pattern = np.concatenate(rows), np.concatenate(columns)
    normal = coo_matrix((np.concatenate(values), pattern), shape=(6 * count, 6 * count)).tocsc()
    damped = normal + diags(_DAMPING * normal.diagonal() + _WEAK, format="csc")
    solver = splu(damped, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return -solver.solve(gradient.ravel()).reshape(-1, 6)


def _moved(poses: np.ndarray, step: np.ndarray, column: np.ndarray) -> np.ndarray:
    free = column >= 0
    moved = poses.copy()
    moved[free, :3, 3] += step[:, :3]
    moved[free, :3, :3] = rotation_matrices(step[:, 3:]) @ poses[free, :3, :3]
    return moved
