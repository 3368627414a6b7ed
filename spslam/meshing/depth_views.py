"""Depth images of some of the frames that are fused: they tell which faces of the mesh a camera saw from the front.

A face that closes a gap between two surfaces, or the shadow of an edge, lies where frames look through it or see
something else, and turns its back or its edge to all of them. One that was measured is where a frame's depth is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from spslam.geometry import matrix_to_pose7
from spslam.ops.scene_view import Intrinsics

if TYPE_CHECKING:
    from spslam.meshing.frame_fusion import PosedFrames

# So far any two views of a part are apart, or turned by so much. Half and twice as much find nearly the same faces.
APART_M, APART_DEG = 0.08, 5.0
KEPT_BYTES = 1 << 27  # at most, of all views; fewer are taken where more would be needed
MAX_COLUMNS = 640  # of an image
# Depth that differs from a face's by more, m and deviations of the noise, is of another surface.
NEAR_M, NEAR_DEVIATIONS = 0.02, 3.0
# Depth agrees with a face up to so much, and half a pixel's size on the face, which may lie anywhere in the pixel.
AGREEING_M, AGREEING_DEVIATIONS, AGREEING_PIXELS = 0.005, 2.0, 0.5
# Faces times views that are looked at together: on a CPU as many as its cache holds, on a GPU for few steps.
_AT_ONCE_CPU, _AT_ONCE_CUDA = 1 << 18, 1 << 21
_VIEWS_AT_ONCE = 16  # at most: their images are copied for it
_LEAST_COSINE = 0.05  # flatter faces count as this steep for the size of a pixel
_NEAREST_M = 0.1


class Looks(NamedTuple):
    """What views saw of faces, bool [N] each.

    Attributes:
        agreed: one saw the face from its front where its depth is.
        near: one saw surface near it.
        through: one saw something farther.
        unknown: one has no depth there.
    """

    agreed: torch.Tensor
    near: torch.Tensor
    through: torch.Tensor
    unknown: torch.Tensor


class _View(NamedTuple):
    """Depth float16 [h, w], m, of pixels with these intrinsics; pose float64 [4, 4] T_world_camera; noise."""

    depth: torch.Tensor
    intrinsics: Intrinsics
    pose: np.ndarray
    noise: tuple[float, float]


class DepthViews:
    """The views of a fusion, chosen by where the camera was; their images come as they are fused.

    Args:
        parts: the frames that are fused.
        noises: of the depth of each part, floor (m^2) and growth (1/m^2) of the variance.
    """

    def __init__(self, parts: Sequence[PosedFrames], noises: Sequence[tuple[float, float]]):
        self._parts, self._noises = parts, noises
        chosen = [(number, row) for number, part in enumerate(parts) for row in _apart(part.poses)]
        sizes = [_bytes_of(parts[number]) for number, _ in chosen]
        most = max(KEPT_BYTES // max(sizes, default=1), 1)
        rows = np.unique(np.linspace(0, len(chosen) - 1, min(most, len(chosen))).round().astype(int)).tolist()
        self._wanted = {chosen[row] for row in rows}
        self._views: dict[tuple[int, int], _View] = {}

    def __len__(self) -> int:
        return len(self._views)

    def show(self, part: int, position: int, depth: torch.Tensor) -> None:
        """Keeps the depth image of a frame, if it is one of the views.

        Args:
            part: number of the part.
            position: of the frame in it.
            depth: float32 [H, W], m, 0 where unknown; the device on which faces are looked at.
        """
        if (part, position) not in self._wanted:
            return
        step, k = _step(self._parts[part]), self._parts[part].dataset.camera
        intrinsics = Intrinsics(k.fx / step, k.fy / step, k.cx / step, k.cy / step)
        image = depth[::step, ::step].half().contiguous()
        self._views[part, position] = _View(image, intrinsics, self._parts[part].poses[position], self._noises[part])

    def look_at(self, points: torch.Tensor, normals: torch.Tensor) -> Looks:
        """What the views saw of faces.

        Args:
            points: float32 [N, 3] on them, m, on the device of the images.
            normals: float32 [N, 3] of them, unit vectors to their front.
        """
        looks = Looks(*(torch.zeros(len(points), dtype=torch.bool, device=points.device) for _ in Looks._fields))
        points, normals = points.T.contiguous(), normals.T.contiguous()
        wanted = (_AT_ONCE_CUDA if points.is_cuda else _AT_ONCE_CPU) // max(len(looks.agreed), 1)
        count = min(max(wanted, 1), _VIEWS_AT_ONCE)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # the steps are short: where cores are shared, threads would wait for one another
        try:
            for views in self._alike():
                for first in range(0, len(views), count):
                    _look(views[first : first + count], points, normals, looks)
        finally:
            torch.set_num_threads(threads)
        return looks

    def _alike(self) -> list[list[_View]]:
        """The views in groups of one shape, of which a tensor can be made."""
        groups: dict[torch.Size, list[_View]] = {}
        for _, view in sorted(self._views.items(), key=lambda item: item[0]):
            groups.setdefault(view.depth.shape, []).append(view)
        return list(groups.values())


def _look(views: Sequence[_View], points: torch.Tensor, normals: torch.Tensor, looks: Looks) -> None:
    """Adds what views of one shape saw of points float32 [3, N], m, with unit normals float32 [3, N]."""
    of_views = [[*view.pose[:3].ravel().tolist(), *view.intrinsics, *view.noise] for view in views]
    columns = torch.tensor(of_views, dtype=torch.float32, device=points.device).T[..., None]  # [18, V, 1]
    pose, (fx, fy, cx, cy, floor, growth) = columns[:12].unflatten(0, (3, 4)), columns[12:]
    height, width = views[0].depth.shape
    ray = [points[axis] - pose[axis, 3] for axis in range(3)]  # float32 [V, N], as what follows
    # Not @, whose sums depend on how many points there are.
    x, y, z = (pose[0, i] * ray[0] + pose[1, i] * ray[1] + pose[2, i] * ray[2] for i in range(3))
    ahead = z.clamp(min=_NEAREST_M)
    u, v = (fx * x / ahead + cx).round(), (fy * y / ahead + cy).round()
    view, row = ((z >= _NEAREST_M) & (u >= 0) & (v >= 0) & (u < width) & (v < height)).nonzero().unbind(1)
    fx, floor, growth = (each[view, 0] for each in (fx, floor, growth))
    seen = view, row
    z, depths = z[seen], torch.stack([each.depth for each in views])
    measured = depths[view, v[seen].long(), u[seen].long()].float()
    deviation, behind = (floor + growth * z**4).sqrt(), measured - z
    near_m = NEAR_M + NEAR_DEVIATIONS * deviation
    toward = -sum(ray[axis][seen] * normals[axis][row] for axis in range(3))
    cosine = toward / sum(ray[axis][seen] ** 2 for axis in range(3)).sqrt()
    pixel_m = z / fx / cosine.clamp(min=_LEAST_COSINE)
    agreeing_m = AGREEING_M + AGREEING_DEVIATIONS * deviation + AGREEING_PIXELS * pixel_m
    known, off = measured > 0, behind.abs()
    looks.agreed[row[known & (cosine > 0) & (off <= torch.minimum(agreeing_m, near_m))]] = True
    looks.near[row[known & (off <= near_m)]] = True
    looks.through[row[known & (behind > near_m)]] = True
    looks.unknown[row[~known]] = True


def _apart(poses: np.ndarray) -> list[int]:
    """Rows of poses float64 [F, 4, 4] that are apart from all rows before them that are, the first among them."""
    numbers, rows = matrix_to_pose7(poses), list[int]()
    kept = np.zeros_like(numbers)
    least = np.cos(np.radians(APART_DEG) / 2)
    for row, pose in enumerate(numbers):
        others = kept[: len(rows)]
        is_near = np.linalg.norm(others[:, 4:] - pose[4:], axis=1) < APART_M
        # Not @: for such thin products BLAS would start threads on all cores.
        if not (is_near & (np.abs((others[:, :4] * pose[:4]).sum(1)) > least)).any():
            kept[len(rows)] = pose
            rows.append(row)
    return rows


def _step(part: PosedFrames) -> int:
    return -(-part.dataset.camera.width // MAX_COLUMNS)


def _bytes_of(part: PosedFrames) -> int:
    """Of a view's image."""
    step, camera = _step(part), part.dataset.camera
    return 2 * -(-camera.width // step) * -(-camera.height // step)
