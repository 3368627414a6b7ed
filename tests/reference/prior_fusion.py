"""The scene prior by its formulas, one pixel, pair or voxel at a time, in double precision."""

import itertools

import numpy as np
import torch

from tests.reference.ray_sampling import philox4x32


def smoothed_depth(depth: np.ndarray, u: int, v: int) -> float:
    """Bilateral mean over 5x5 pixels: Gaussian of 2 px, biweight of 6 cm; 0 at an invalid pixel."""
    height, width = depth.shape
    center = float(depth[v, u])
    if not center > 0:
        return 0.0
    weights = total = 0.0
    for y, x in itertools.product(range(v - 2, v + 3), range(u - 2, u + 3)):
        if not (0 <= x < width and 0 <= y < height and depth[y, x] > 0):
            continue
        z = float(depth[y, x])
        closeness = max(0.0, 1 - ((z - center) / 0.06) ** 2)
        weight = closeness**2 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8)
        weights += weight
        total += weight * z
    return total / weights


def depth_normal(depth: np.ndarray, u: int, v: int, fx, fy, cx, cy, step: int, max_jump: float) -> np.ndarray:
    height, width = depth.shape
    if not (step <= u < width - step and step <= v < height - step):
        return np.zeros(3)

    def point(x, y):
        z = smoothed_depth(depth, x, y)
        return np.array([(x - cx) / fx * z, (y - cy) / fy * z, z])

    center = point(u, v)
    neighbors = [point(u + step, v), point(u - step, v), point(u, v + step), point(u, v - step)]
    if center[2] <= 0 or any(p[2] <= 0 for p in neighbors):
        return np.zeros(3)
    if max(abs(p[2] - center[2]) for p in neighbors) >= max_jump * center[2]:
        return np.zeros(3)
    normal = np.cross(neighbors[0] - neighbors[1], neighbors[2] - neighbors[3])
    length = np.linalg.norm(normal)
    return normal / length * (-1 if normal @ center > 0 else 1) if length > 0 else np.zeros(3)


def encoder(params: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
    """The perceptron 6 -> 64 -> 64 -> 8 of flat parameters."""
    sizes = [(64, 6), (64,), (64, 64), (64,), (8, 64), (8,)]
    w1, b1, w2, b2, w3, b3 = (
        part.reshape(size)
        for part, size in zip(params.double().split([int(np.prod(s)) for s in sizes]), sizes, strict=True)
    )
    return torch.relu(torch.relu(inputs.double() @ w1.T + b1) @ w2.T + b2) @ w3.T + b3


def encode_points(points, normals, params, voxel_size, neighborhood, min_pair_weight):
    """Coordinates, mean features and weights of every vertex reached, sorted by (x, y, z)."""
    usable = torch.isfinite(points).all(1) & normals.any(1)
    points, normals = points[usable].double() / voxel_size, normals[usable].double()
    span, reach = (range(-1, 3), 2) if neighborhood == 64 else (range(2), 1)
    vertices = points.floor()[:, None] + torch.tensor(list(itertools.product(span, repeat=3)))
    relative = (points[:, None] - vertices) / reach
    weights = (1 - relative.abs()).prod(2) ** 3
    features = encoder(params, torch.cat([relative, normals[:, None].expand_as(relative)], 2))
    columns = vertices.reshape(-1, 3).long().tolist(), weights.flatten().tolist(), features.reshape(-1, 8).numpy()
    sums = {}
    for vertex, weight, feature in zip(*columns, strict=True):
        if weight > 0 and weight >= min_pair_weight:
            total, weighted = sums.get(tuple(vertex), (0.0, 0.0))
            sums[tuple(vertex)] = (total + weight, weighted + weight * feature)
    order = sorted(sums)
    coords = torch.tensor(order, dtype=torch.int32).reshape(-1, 3)
    totals = torch.tensor([sums[c][0] for c in order], dtype=torch.float64)
    return coords, torch.tensor(np.array([sums[c][1] / sums[c][0] for c in order]).reshape(-1, 8)), totals


def random_embedding(seed: int, coord: tuple[int, int, int], scale: float) -> np.ndarray:
    """Box and Muller over the words of two Philox counters (x, y, z, 8), the second under another key."""
    numbers = []
    for key in (seed, seed ^ 0x9E3779B97F4A7C15):
        counter = np.array([[coord[0] & 0xFFFFFFFF, coord[1] & 0xFFFFFFFF, coord[2] & 0xFFFFFFFF, 8]], np.uint32)
        words = (philox4x32(counter, (key & 0xFFFFFFFF, key >> 32))[0] >> 8) / 2.0**24
        for a, b in words.reshape(2, 2):
            radius = scale * np.sqrt(-2 * np.log(1 - a))
            numbers += [radius * np.cos(2 * np.pi * b), radius * np.sin(2 * np.pi * b)]
    return np.array(numbers)
