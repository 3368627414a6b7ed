"""Grids of several resolutions by torch's own grid_sample, and hashed volumes vertex by vertex."""

import itertools

import torch
import torch.nn.functional as F  # noqa: N812


def normalized(points, bounds):
    lower, upper = (torch.tensor(corner, dtype=points.dtype, device=points.device) for corner in bounds)
    return 2 * (points - lower) / (upper - lower) - 1


def tri_planes(levels, points, bounds, align_corners):
    """Sums of three images [1, C, H, W] on each level, a list of [N, C]."""
    p = normalized(points, bounds)
    results = []
    for images in levels:
        total = 0
        for image, axes in zip(images, ([0, 1], [0, 2], [1, 2]), strict=True):
            sampled = F.grid_sample(
                image, p[None, None, :, axes], mode="bilinear", padding_mode="border", align_corners=align_corners
            )
            total = total + sampled[0, :, 0].T
        results.append(total)
    return results


def volume(values, points, bounds, align_corners):
    """values [X, Y, Z, C] -> [N, C]."""
    p = normalized(points, bounds)
    images = values.permute(3, 2, 1, 0)[None]
    sampled = F.grid_sample(
        images, p[None, None, None], mode="bilinear", padding_mode="border", align_corners=align_corners
    )
    return sampled[0, :, 0, 0].T


def hashed_volume(rows, size, points, bounds):
    """A level of `size` whose vertices share the rows by the hash of instant-NGP; corners aligned."""
    lower, upper = (torch.tensor(corner, dtype=points.dtype, device=points.device) for corner in bounds)
    scale = torch.tensor(size, dtype=points.dtype, device=points.device) - 1
    results = []
    for point in (points - lower) / (upper - lower) * scale:
        low = point.detach().floor().minimum(scale - 1)
        local, total = point - low, 0
        for corner in itertools.product((0, 1), repeat=3):
            x, y, z = (int(value) + step for value, step in zip(low, corner, strict=True))
            h = (x ^ (y * 2654435761) ^ (z * 805459861)) % 2**32
            weight = 1
            for axis, step in enumerate(corner):
                weight = weight * (local[axis] if step else 1 - local[axis])
            total = total + weight * rows[h % len(rows)]
        results.append(total)
    return torch.stack(results)
