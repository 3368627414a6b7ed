"""Points of a surface in a frame, in plain NumPy: the depth buffer point by point, its gaps by loops over neighbors."""

import numpy as np

NEAREST_M = 0.05
APART_M, APART_PX, LEAST_COSINE, SLANTED_COSINE = 0.004, 2.0, 0.02, 0.15
BEHIND_M, BEHIND_DEVIATIONS = 0.02, 3.0


def neighbors(image, outside):
    """[9, H, W], the 3 x 3 pixels around each."""
    height, width = image.shape
    padded = np.pad(image, 1, constant_values=outside)
    return np.stack([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)])


def see_points(points, normals, depth, color, pose, camera, noise):
    """Colors float64 [N, 3], before they are rounded, and weights float64 [N]; pose is T_world_camera [4, 4]."""
    height, width = depth.shape
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    z = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        inside = (z > NEAREST_M) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    ids = np.flatnonzero(inside)
    u, v, z = u[ids], v[ids], z[ids]
    rows, columns = np.floor(v + 0.5).astype(int), np.floor(u + 0.5).astype(int)
    drawn = np.full((height, width), np.inf)
    for row, column, each in zip(rows, columns, z, strict=True):
        drawn[row, column] = min(drawn[row, column], each)
    closed = neighbors(neighbors(drawn, np.inf).min(0), -np.inf).max(0)
    front = np.minimum(drawn, closed)[rows, columns]
    rays = points[ids] - pose[:3, 3]
    cosine = -(rays * normals[ids]).sum(1) / np.linalg.norm(rays, axis=1)
    pixel_m = 2 * z / (camera.fx + camera.fy)
    bounded = np.clip(cosine, SLANTED_COSINE, 1)
    slope = pixel_m * np.sqrt(1 - bounded**2) / bounded
    measured = depth[rows, columns]
    behind = BEHIND_M + BEHIND_DEVIATIONS * np.sqrt(noise[0] + noise[1] * z**4) + slope
    hidden = (measured > 0) & (z > measured + behind) | (z >= front + APART_M + APART_PX * slope)
    seen = ~hidden & (cosine > LEAST_COSINE)
    colors, weights = np.zeros((len(points), 3)), np.zeros(len(points))
    weights[ids[seen]] = (cosine / pixel_m**2)[seen]
    colors[ids[seen]] = bilinear(color.astype(np.float64), u[seen], v[seen])
    return colors, weights


def bilinear(image, u, v):
    """Values [N, 3] of an image at places in it."""
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    right, below = np.minimum(column + 1, image.shape[1] - 1), np.minimum(row + 1, image.shape[0] - 1)
    across, down = (u - column)[:, None], (v - row)[:, None]
    upper = (1 - across) * image[row, column] + across * image[row, right]
    return (1 - down) * upper + down * ((1 - across) * image[below, column] + across * image[below, right])
