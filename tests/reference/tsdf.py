"""Planes of a depth image and their integration into voxels, in plain NumPy: one pixel or voxel after another."""

import numpy as np

RADIUS = 2
GATE, GATE_DEVIATIONS, STEEPEST, PRIOR = 0.015, 4.0, 15.0, 0.005
LEAST_SUPPORT, FULL_SUPPORT, FULL_WEIGHT, LEAST_COSINE = 0.2, 0.5, 0.67, 0.06
SHAPE_VARIANCES, POSE_VARIANCE = 2.0, 0.003**2
FULL_WEIGHT_DEVIATIONS, MOST_FULL_WEIGHT = 1.2, 0.7
TRUNCATION_DEVIATIONS, MOST_NOISE_TRUNCATION, TOUCH_COSINE, BESIDE_VOXELS = 2.0, 0.2, 0.3, 3.0


def window_weight(du, dv):
    return 1 / (1 + 0.15 * (du * du + dv * dv))


WHOLE = sum(window_weight(du, dv) for du in range(-2, 3) for dv in range(-2, 3))


def planes(depth, camera, noise, shared=False):
    """float64 [H, W, 5] of a depth image [H, W]; camera is (fx, fy, cx, cy). Neighbors may share their noise."""
    height, width = depth.shape
    out = np.zeros((height, width, 5))
    for v in range(height):
        for u in range(width):
            if 0 < depth[v, u] < np.inf:
                out[v, u] = _plane(depth, camera, noise, u, v, shared)
    return out


def _slope(before, middle, after):
    near = [d for d in (middle - before if before else None, after - middle if after else None) if d is not None]
    return min(near, key=abs) if near else 0.0


def _plane(depth, camera, noise, u, v, shared):
    fx, fy, cx, cy = camera
    height, width = depth.shape

    def inverse(du, dv):
        inside = 0 <= u + du < width and 0 <= v + dv < height
        z = depth[v + dv, u + du] if inside else 0
        return 1 / z if 0 < z < np.inf else 0

    q = inverse(0, 0)
    variance = 0 if shared else noise[0] + noise[1] / q**4
    slopes = np.array(
        [_slope(inverse(-1, 0), q, inverse(1, 0)) * fx / q, _slope(inverse(0, -1), q, inverse(0, 1)) * fy / q]
    )
    slopes = np.where(np.abs(slopes) < STEEPEST, slopes, 0) * q / np.array([fx, fy])
    gate = (GATE + GATE_DEVIATIONS * np.sqrt(variance) * q) * q
    rows, values, weights = [], [], []
    for dv in range(-RADIUS, RADIUS + 1):
        for du in range(-RADIUS, RADIUS + 1):
            share = (inverse(du, dv) - q - slopes @ (du, dv)) / gate
            if inverse(du, dv) and abs(share) < 1:
                rows.append((1, du, dv))
                values.append(inverse(du, dv))
                weights.append((1 - share**2) ** 2 * window_weight(du, dv))
    weights = np.array(weights)
    total = weights.sum()
    # The prior as two more equations: slopes of 0.
    system = np.vstack((np.array(rows) * np.sqrt(weights)[:, None], np.sqrt(PRIOR * total) * np.eye(3)[1:]))
    target = np.concatenate((np.array(values) * np.sqrt(weights), [0, 0]))
    at, by_u, by_v = np.linalg.lstsq(system, target, rcond=None)[0]
    moments = np.average(np.column_stack((rows, values)), axis=0, weights=weights)
    centered = np.column_stack((rows, values)) - moments
    covariance = (centered * weights[:, None]).T @ centered / total
    spread = covariance[3, 3] - by_u * covariance[1, 3] - by_v * covariance[2, 3]
    support = total / WHOLE
    shape = max(spread, 0.5 * (at - q) ** 2) / (SHAPE_VARIANCES * variance * q**4 + 1e-20)
    share = np.clip((support - LEAST_SUPPORT) / (FULL_SUPPORT - LEAST_SUPPORT), 0, 1) / (1 + shape**2)
    q = q + share * (at - q)
    x, y = (u - cx) / fx, (v - cy) / fy
    m = np.array([by_u * fx, by_v * fy, q - by_u * fx * x - by_v * fy * y])
    cosine = q / np.linalg.norm(m) / np.linalg.norm((x, y, 1))
    if not (q > 0 and support > LEAST_SUPPORT and cosine > LEAST_COSINE):
        return np.zeros(5)
    weight = _certainty(noise, 1 / q) * cosine * min(support / FULL_WEIGHT, 1)
    return np.array([*(m / np.linalg.norm(m)), 1 / np.linalg.norm(m), weight])


def _certainty(noise, depth):
    return POSE_VARIANCE / (POSE_VARIANCE + noise[0] + noise[1] * depth**4)


def observe(point, plane_image, camera, pose, truncations, noise, voxel_size):
    """Distance and weight that a frame gives a world point; weight 0 where it says nothing."""
    fx, fy, cx, cy = camera
    x, y, z = np.linalg.inv(pose)[:3] @ np.append(point, 1)
    if z <= 0.05:
        return 0.0, 0.0, None
    u, v = int(np.floor(fx * x / z + cx + 0.5)), int(np.floor(fy * y / z + cy + 0.5))
    if not (0 <= u < plane_image.shape[1] and 0 <= v < plane_image.shape[0]):
        return 0.0, 0.0, None
    plane = plane_image[v, u]
    sdf = plane[3] - plane[:3] @ (x, y, z)
    deviation = np.sqrt(noise[0] + noise[1] * z**4)
    truncation = max(
        min(truncations[0], truncations[1] + deviation), min(TRUNCATION_DEVIATIONS * deviation, MOST_NOISE_TRUNCATION)
    )
    behind = z - plane[3] / (plane[:3] @ (x / z, y / z, 1)) if plane[4] else np.inf
    full = min(FULL_WEIGHT_DEVIATIONS * deviation, MOST_FULL_WEIGHT * truncation)
    if sdf <= -truncation or (behind >= truncation / TOUCH_COSINE and sdf <= -BESIDE_VOXELS * voxel_size):
        return 0.0, 0.0, None
    weight, seen = plane[4], min(z - behind, plane[3] / TOUCH_COSINE)
    if weight and seen > z + truncation:
        weight *= _certainty(noise, z + truncation) / _certainty(noise, seen)
    return min(sdf, truncation), weight * np.interp(sdf, [-truncation, -full], [0, 1]), (u, v)
