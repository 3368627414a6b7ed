"""The noise of depth along rays, between frames that saw the same surface from known poses.

While tracking, noise is measured as distances from the surface of earlier frames (`ops.measure_noise_`), each along the
normal that four pixels give. Noise that varies from pixel to pixel has steep slopes of its own there, so that these
distances are a third of what a stereo camera's depth is off. A fused surface needs to know that: within a truncation
that is short beside the noise, the means of voxels cross 0 in many places.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from spslam.camera import Camera
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.meshing.reading import reading_threads

if TYPE_CHECKING:
    from spslam.meshing.frame_fusion import PosedFrames

# Pairs of frames, spread over a recording, and the pixels compared of each.
_PAIRS, _PIXELS = 8, 20_000
# The second of a pair comes so many frames later: the first number by which enough of its pixels fall on known ones.
_STEPS = (10, 5, 2, 1)
_LEAST_SHARE = 0.2
# Farther apart, as a share of depth, are two surfaces; a larger spread of inverse depth in four pixels is an edge.
_OTHER_SURFACE, _EDGE_SPREAD = 0.1, 0.05
# Depth is divided into quarter octaves; those with fewer residuals say nothing. One with so many has half a weight.
_BINS_PER_OCTAVE, _LEAST_RESIDUALS, _HALF_WEIGHT = 4, 500, 2000
# Growth is known where bins span this factor of depth.
_LEAST_SPAN = 1.5
_DEVIATIONS_PER_MEDIAN = 1.4826
# Distances along normals have this share of it where neighbors' noise is alike (structured light: 0.76), and the
# constants of `ops.tsdf_integrate_` were chosen in their terms.
_SHARE_ALONG_NORMALS = 0.75


def noise_along_rays(frames: PosedFrames, noise: tuple[float, float]) -> tuple[float, float]:
    """Measures the noise of depth along rays.

    Of some pairs of frames, the first one's pixels are projected into the second. 1.48 times the median size of the
    differences in depth, divided by the root of 2, is the deviation at a depth. Floor and growth are the least-squares
    fit, relative and not negative, to 0.75 times it, which is what distances along normals have of noise that is alike
    for neighbors. Errors of the poses between the two frames add to it.

    Args:
        frames: of one recording; those that can't be read don't count.
        noise: floor (m^2) and growth (1/m^2) of the variance of depth, as it was measured while tracking; see
            `ops.measure_planes`.

    Returns:
        Floor and growth, neither below those given, and these where too few pixels can be compared. The same frames
        and poses give the same numbers.
    """
    count = min(_PAIRS, len(frames) - 1)
    if count < 1:
        return noise
    firsts = np.unique(np.linspace(0, max(len(frames) - 1 - _STEPS[0], 0), count).round().astype(int))
    with prefetch(_Pairs(frames, firsts), *reading_threads(frames.dataset.readers)) as pairs:
        found = [each for each in pairs if not isinstance(each, DatasetError)]
    if not found:
        return noise
    depth, difference = np.concatenate(found, axis=1)
    floor, growth = _fit(depth, difference, noise)
    return max(floor, noise[0]), max(growth, noise[1])


@dataclass(frozen=True)
class _Pairs:
    """Differences in depth of each pair, worked out on the threads that read."""

    frames: PosedFrames
    firsts: np.ndarray

    def __len__(self) -> int:
        return len(self.firsts)

    def __getitem__(self, index: int) -> np.ndarray:
        """Float64 [2, N]: depth and its difference from the second frame's, m."""
        first = int(self.firsts[index])
        depth, pose = self.frames.depth(first), self.frames.poses[first]
        found = np.zeros((2, 0))
        for step in _STEPS:
            second = first + step
            if second >= len(self.frames):
                continue
            motion = np.linalg.inv(self.frames.poses[second]) @ pose
            found, share = depth_differences(depth, self.frames.depth(second), motion, self.frames.dataset.camera)
            if share >= _LEAST_SHARE:
                break
        return found


def depth_differences(
    depth: np.ndarray, other: np.ndarray, motion: np.ndarray, camera: Camera
) -> tuple[np.ndarray, float]:
    """How far pixels of a depth image are from those of another one, along its rays.

    Args:
        depth: float32 [H, W], m, 0 where unknown.
        other: float32 [H, W], of another view with the same camera.
        motion: float64 [4, 4], from the first camera's axes to the other's.
        camera: intrinsics of both.

    Returns:
        Float64 [2, N]: depth in the other camera, and that less the other image's depth, bilinear in inverse depth, m,
        of at most 20,000 pixels that fall on the same surface. And the share of all that were projected, 0 to 1.
    """
    rows, columns = np.nonzero((depth > 0) & (depth < np.inf))
    chosen = slice(None, None, max(-(-len(rows) // _PIXELS), 1))
    rows, columns = rows[chosen], columns[chosen]
    if not len(rows):
        return np.zeros((2, 0)), 0.0
    z = depth[rows, columns].astype(np.float64)
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z])
    x, y, z = motion[:3, :3] @ points + motion[:3, 3:]
    ahead = z > 1e-3
    u, v = (np.where(ahead, f * a / np.where(ahead, z, 1) + c, -1)
            for f, a, c in ((camera.fx, x, camera.cx), (camera.fy, y, camera.cy)))  # fmt: skip
    inside = ahead & (u >= 0) & (v >= 0) & (u < other.shape[1] - 1) & (v < other.shape[0] - 1)
    u, v, z = u[inside], v[inside], z[inside]
    left, top = u.astype(int), v.astype(int)
    corners = np.stack([other[top + j, left + i] for j in (0, 1) for i in (0, 1)]).astype(np.float64)
    known = (corners > 0).all(0)
    inverse = 1 / np.where(corners > 0, corners, 1)
    known &= np.ptp(inverse, axis=0) < _EDGE_SPREAD * inverse.max(0)
    by_u, by_v = u - left, v - top
    weights = np.stack([(1 - by_u) * (1 - by_v), by_u * (1 - by_v), (1 - by_u) * by_v, by_u * by_v])
    difference = z - 1 / (weights * inverse).sum(0)
    same = known & (np.abs(difference) < _OTHER_SURFACE * z)
    return np.stack([z[same], difference[same]]), float(same.sum()) / len(rows)


def _fit(depth: np.ndarray, difference: np.ndarray, noise: tuple[float, float]) -> tuple[float, float]:
    """Floor and growth that fit the differences at all depths; those given where the differences do not say."""
    bins = np.floor(_BINS_PER_OCTAVE * np.log2(depth)).astype(int)
    rows = []
    for each in np.unique(bins):
        members = bins == each
        size = np.median(np.abs(difference[members])) * _DEVIATIONS_PER_MEDIAN
        if members.sum() >= _LEAST_RESIDUALS and size > 0:
            rows.append((np.median(depth[members]), (_SHARE_ALONG_NORMALS * size) ** 2 / 2, members.sum()))
    if not rows:
        return noise
    at, variance, residuals = np.array(rows).T
    if at.max() < _LEAST_SPAN * at.min():
        return float(np.average(variance - noise[1] * at**4, weights=residuals)), noise[1]
    weight = np.sqrt(residuals / (residuals + _HALF_WEIGHT))
    return _not_negative(np.stack([weight / variance, weight * at**4 / variance], axis=1), weight)


def _not_negative(matrix: np.ndarray, right: np.ndarray) -> tuple[float, float]:
    """The numbers from 0 on, of two, with the least squared error of `matrix` [N, 2] times them from `right` [N].

    What SciPy's nnls finds, which takes 0.2 s to load: if one is negative, the best lies where it or the other is 0.
    """
    best = np.linalg.lstsq(matrix, right, rcond=None)[0]
    if (best < 0).any():
        alone = np.maximum(right @ matrix / (matrix * matrix).sum(0), 0)
        best = min(np.diag(alone), key=lambda numbers: float(((matrix @ numbers - right) ** 2).sum()))
    return float(best[0]), float(best[1])
