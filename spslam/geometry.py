"""Rotations and rigid transforms in NumPy, float64.

A pose `T_world_camera` is a [4, 4] matrix that maps camera points to world points. A quaternion is (w, x, y, z). Every
function takes leading batch dimensions unless it says otherwise, and raises ValueError for an argument of another
shape.
"""

from __future__ import annotations

import math

import numpy as np


def quaternion_to_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4].

    Quaternions are normalized first.

    Raises:
        ValueError: a quaternion of length 0.
    """
    quaternion = _as_floats("quaternion_to_matrix", "quaternion", quaternion, (4,))
    norm = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    if np.any(norm == 0):
        raise ValueError("quaternion_to_matrix: quaternion must have a length above 0, got 0")
    w, x, y, z = np.moveaxis(quaternion / norm, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternions [..., 4] with w >= 0 of rotation matrices [..., 3, 3].

    Of the four ways to divide, the one with the largest divisor is used (Shepperd 1978), so it is exact for rotations
    by 180 degrees too.
    """
    rotation = _as_floats("matrix_to_quaternion", "rotation", rotation, (3, 3))
    if rotation.ndim == 2:
        return _quaternion_of(*rotation.ravel().tolist())
    m = rotation
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    ww, xx, yy, zz = (
        1 + trace,
        1 - trace + 2 * m[..., 0, 0],
        1 - trace + 2 * m[..., 1, 1],
        1 - trace + 2 * m[..., 2, 2],
    )
    # Row i is 4 q_i q, the quaternion up to a factor. The row with the largest diagonal entry is the most accurate.
    outer = np.stack(
        [np.stack(row, -1) for row in ((ww, wx, wy, wz), (wx, xx, xy, xz), (wy, xy, yy, yz), (wz, xz, yz, zz))],
        axis=-2,
    )
    largest = np.argmax(np.stack((ww, xx, yy, zz), axis=-1), axis=-1)
    quaternion = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def _quaternion_of(
    xx: float, xy: float, xz: float, yx: float, yy: float, yz: float, zx: float, zy: float, zz: float
) -> np.ndarray:
    """`matrix_to_quaternion` of one matrix, by rows; a frame asks several times, as for `_matrix_of`."""
    trace, wx, wy, wz = xx + yy + zz, zy - yz, xz - zx, yx - xy
    outer = (
        (1 + trace, wx, wy, wz),
        (wx, 1 - trace + 2 * xx, yx + xy, xz + zx),
        (wy, yx + xy, 1 - trace + 2 * yy, yz + zy),
        (wz, xz + zx, yz + zy, 1 - trace + 2 * zz),
    )
    row = outer[max(range(4), key=lambda i: outer[i][i])]
    norm = math.sqrt(sum(number * number for number in row))
    sign = -norm if row[0] < 0 else norm
    return np.array([number / sign for number in row])


def orthonormalize(rotation: np.ndarray) -> np.ndarray:
    """The rotation matrices [..., 3, 3] nearest to given matrices in the Frobenius norm, by SVD."""
    rotation = _as_floats("orthonormalize", "rotation", rotation, (3, 3))
    u, _, vt = np.linalg.svd(rotation)
    u = u.copy()
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def compose(*poses: np.ndarray) -> np.ndarray:
    """The product [..., 4, 4] of poses [..., 4, 4], from left to right; the identity without any."""
    if not poses:
        return np.eye(4)
    product = _as_floats("compose", "poses", poses[0], (4, 4))
    for pose in poses[1:]:
        product = product @ _as_floats("compose", "poses", pose, (4, 4))
    return product


def inverse(pose: np.ndarray) -> np.ndarray:
    """The inverse [..., 4, 4] of rigid transforms [..., 4, 4]; their rotations must be orthonormal."""
    pose = _as_floats("inverse", "pose", pose, (4, 4))
    transposed = np.swapaxes(pose[..., :3, :3], -1, -2)
    return pose_from(transposed, -(transposed @ pose[..., :3, 3:])[..., 0])


def pose_from(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Poses [..., 4, 4] of rotations [..., 3, 3] and translations [..., 3]."""
    rotation = _as_floats("pose_from", "rotation", rotation, (3, 3))
    translation = _as_floats("pose_from", "translation", translation, (3,))
    pose = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = translation
    pose[..., 3, 3] = 1
    return pose


def pose7_to_matrix(pose7: np.ndarray) -> np.ndarray:
    """Poses [..., 4, 4] of rows [..., 7]: quaternion (w, x, y, z), then translation."""
    pose7 = _as_floats("pose7_to_matrix", "pose7", pose7, (7,))
    if pose7.ndim == 1:
        return _matrix_of(*pose7.tolist())
    return pose_from(quaternion_to_matrix(pose7[..., :4]), pose7[..., 4:])


def _matrix_of(w: float, x: float, y: float, z: float, *translation: float) -> np.ndarray:
    """`pose7_to_matrix` of one row, the same bits: a frame asks several times, and arrays of one number take longer."""
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm == 0:
        raise ValueError("quaternion_to_matrix: quaternion must have a length above 0, got 0")
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    tx, ty, tz = translation
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), tx),
            (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), ty),
            (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), tz),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def matrix_to_pose7(pose: np.ndarray) -> np.ndarray:
    """Rows [..., 7], quaternion (w, x, y, z) with w >= 0 and translation, of poses [..., 4, 4]."""
    pose = _as_floats("matrix_to_pose7", "pose", pose, (4, 4))
    return np.concatenate((matrix_to_quaternion(pose[..., :3, :3]), pose[..., :3, 3]), axis=-1)


def constant_speed(pose_before_last: np.ndarray, last_pose: np.ndarray) -> np.ndarray:
    """The next pose [4, 4] by the constant velocity model: `T1 T0^-1 T1` of the last two poses T0 and T1.

    The rotation is projected to SO(3), so that repeated prediction keeps it orthonormal.
    """
    predicted = compose(last_pose, inverse(pose_before_last), last_pose)
    return pose_from(orthonormalize(predicted[..., :3, :3]), predicted[..., :3, 3])


def interpolate_pose(pose_a: np.ndarray, pose_b: np.ndarray, fraction: np.ndarray | float) -> np.ndarray:
    """Poses [..., 4, 4] between two poses [..., 4, 4].

    The rotation is interpolated by slerp along the shorter arc, the translation linearly.

    Args:
        pose_a: pose at `fraction` 0.
        pose_b: pose at `fraction` 1.
        fraction: [...], where to interpolate.
    """
    a = _as_floats("interpolate_pose", "pose_a", pose_a, (4, 4))
    b = _as_floats("interpolate_pose", "pose_b", pose_b, (4, 4))
    fraction = np.asarray(fraction, dtype=np.float64)[..., None]
    qa, qb = matrix_to_quaternion(a[..., :3, :3]), matrix_to_quaternion(b[..., :3, :3])
    cosine = np.sum(qa * qb, axis=-1, keepdims=True)
    qb, cosine = np.where(cosine < 0, -qb, qb), np.minimum(np.abs(cosine), 1)
    angle = np.arccos(cosine)
    # Below this angle sin(angle) loses precision, and linear interpolation is exact to double precision.
    near = angle < 1e-7
    sine = np.where(near, 1, np.sin(angle))
    weight_a = np.where(near, 1 - fraction, np.sin((1 - fraction) * angle) / sine)
    weight_b = np.where(near, fraction, np.sin(fraction * angle) / sine)
    translation = (1 - fraction) * a[..., :3, 3] + fraction * b[..., :3, 3]
    return pose_from(quaternion_to_matrix(weight_a * qa + weight_b * qb), translation)


def rotation_angle(rotation: np.ndarray) -> np.ndarray:
    """Angles [...] in radians, 0 to pi, of rotation matrices [..., 3, 3]; exact for small angles too."""
    quaternion = matrix_to_quaternion(rotation)
    return 2 * np.arctan2(np.linalg.norm(quaternion[..., 1:], axis=-1), quaternion[..., 0])


def transform_points(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [N, 3] transformed by one pose [4, 4]; float64."""
    pose = _as_floats("transform_points", "pose", pose, (4, 4))
    points = _as_floats("transform_points", "points", points, (3,))
    return points @ pose[:3, :3].T + pose[:3, 3]


def umeyama(
    estimated: np.ndarray, reference: np.ndarray, with_scale: bool = False
) -> tuple[np.ndarray, np.ndarray, float]:
    """The rotation, translation and scale that align points with others in the least-squares sense (Umeyama 1991).

    Minimizes `sum |reference - (s R estimated + t)|^2` over rigid transforms (s = 1), or over similarity transforms
    with `with_scale`.

    Args:
        estimated: [N, 3], N >= 1. With fewer than three points, or points on one line, the rotation is not unique; one
            of the minimizers is returned.
        reference: [N, 3], paired with `estimated` by row.
        with_scale: estimate the scale too.

    Returns:
        R [3, 3], t [3] and s.

    Raises:
        ValueError: arrays of other or different shapes, or no point.
    """
    estimated = _as_floats("umeyama", "estimated", estimated, (3,))
    reference = _as_floats("umeyama", "reference", reference, (3,))
    if estimated.ndim != 2 or estimated.shape != reference.shape or len(estimated) == 0:
        raise ValueError(
            "umeyama: estimated and reference must both have shape (N, 3) with N >= 1, "
            f"got {estimated.shape} and {reference.shape}"
        )
    mean_estimated, mean_reference = estimated.mean(axis=0), reference.mean(axis=0)
    centered = estimated - mean_estimated
    covariance = (reference - mean_reference).T @ centered / len(estimated)
    u, singular, vt = np.linalg.svd(covariance)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    variance = np.mean(np.sum(centered * centered, axis=1))
    scale = float(np.sum(singular * signs) / variance) if with_scale and variance > 0 else 1.0
    return rotation, mean_reference - scale * rotation @ mean_estimated, scale


def _as_floats(function: str, argument: str, value: np.ndarray, trailing: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape[-len(trailing) :] != trailing:
        wanted = ", ".join(str(size) for size in trailing)
        raise ValueError(f"{function}: {argument} must have shape (..., {wanted}), got {array.shape}")
    return array
