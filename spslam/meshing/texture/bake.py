"""Colors of texels: each is a smooth mean of what the frames that saw the surface there best have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.meshing.mesh import TriangleMesh
from spslam.meshing.texture.atlas import Texels
from spslam.meshing.texture.views import NEAREST_M, BestViews, ColorView

# What the mesh's own color counts beside the best view's 1: all where no frame saw the surface, next to nothing else.
_OWN_WEIGHT = 1e-3
# Texels looked at at once; some 100 bytes each.
_CHUNK = 1 << 19
_ROW = 512  # of the images that points are handed to OpenCV as


@dataclass(frozen=True)
class Corrections:
    """By what the colors of frames are made to agree.

    Attributes:
        gains: float64 [F, 3], what the colors of each frame are multiplied by.
        warps: float64 [F, 3, 3], from (u, v, 1) by the pose to (u, v, 1) in the color image.
    """

    gains: np.ndarray
    warps: np.ndarray


class ViewWeights:
    """What each frame counts at each vertex.

    Of the K best views of a vertex each counts by how much better it is than the next one that is left out, so none
    comes or goes at once; the best has 1, and so have all where the one left out is as good. Between vertices weights
    are interpolated, so colors are continuous across faces and charts.

    Args:
        best: with one view more than are to be used.
    """

    def __init__(self, best: BestViews) -> None:
        order = np.argsort(-best.scores, axis=1, kind="stable")
        scores = np.take_along_axis(best.scores, order, 1)
        numbers = np.take_along_axis(best.numbers, order, 1)[:, :-1]
        spread = scores[:, :1] - scores[:, -1:]
        weights = (scores[:, :-1] - scores[:, -1:]) / np.maximum(spread, np.float32(1e-20))
        weights[(spread == 0)[:, 0]] = 1
        weights[numbers < 0] = 0
        by_number = np.argsort(numbers, axis=None, kind="stable")
        self._numbers = numbers.ravel()[by_number]
        self._vertices = by_number // numbers.shape[1]
        self._weights = weights.ravel()[by_number]
        self._count = len(numbers)

    def of(self, number: int) -> np.ndarray:
        """float32 [V], of one frame at all vertices."""
        first, end = np.searchsorted(self._numbers, [number, number + 1])
        dense = np.zeros(self._count, np.float32)
        dense[self._vertices[first:end]] = self._weights[first:end]
        return dense


def accumulate(
    mesh: TriangleMesh,
    sets: Sequence[Texels],
    views: Iterable[ColorView],
    weights: ViewWeights,
    corrections: Corrections,
) -> list[np.ndarray]:
    """Sums of the views' colors at texels.

    Args:
        mesh: of the texels.
        sets: texels.
        views: all frames.
        weights: what frames count.
        corrections: of the frames' colors.

    Returns:
        float32 [N, 4] for each set: RGB times weights, and weights. Deterministic.
    """
    sums = [np.zeros((len(texels.faces), 4), np.float32) for texels in sets]
    for view in views:
        dense = weights.of(view.number)
        faces = np.flatnonzero((dense > 0)[mesh.faces].any(1))
        places = warped(view.homogeneous(mesh.vertices), corrections.warps[view.number])
        seen, gain = np.concatenate([places, dense[:, None]], axis=1), corrections.gains[view.number]
        for texels, total in zip(sets, sums, strict=True):
            for part, counts, rows in _texels_of(texels, faces):
                corners = seen[mesh.faces[part]]
                _add(total, rows, _spread(corners, counts, texels.weights[rows]), view.frame.color, gain)
    return sums


def mixed_colors(mesh: TriangleMesh, own: np.ndarray, texels: Texels, sums: np.ndarray) -> np.ndarray:
    """Colors uint8 [N, 3] of texels: the mean of the views and, where there is none, the mesh's own.

    Args:
        mesh: of the texels.
        own: float32 [V, 3], colors of its vertices, 0 to 255.
        texels: N of them.
        sums: float32 [N, 4] of `accumulate`.
    """
    colors = np.empty((len(sums), 3), np.uint8)
    for first in range(0, len(sums), _CHUNK):
        part = slice(first, first + _CHUNK)
        inner = np.clip(_corner_weights(texels.weights[part]), 0, 1)
        inner /= inner.sum(1, keepdims=True)
        plain = _mixed(own, mesh.faces[texels.faces[part]], inner)
        mean = (sums[part, :3] + _OWN_WEIGHT * plain) / (sums[part, 3:] + np.float32(_OWN_WEIGHT))
        colors[part] = np.clip(np.rint(mean), 0, 255)
    return colors


def corner_texels(mesh: TriangleMesh) -> Texels:
    """A texel at each vertex that a face has, in one of its faces."""
    corners = mesh.faces.ravel()
    first = np.unique(corners, return_index=True)[1]
    first.sort()
    faces, corner = np.divmod(first, 3)
    weights = np.stack([corner == 1, corner == 2], axis=1).astype(np.float32)
    starts = np.searchsorted(faces, np.arange(len(mesh.faces) + 1))
    return Texels(np.arange(len(first)), faces.astype(np.int32), weights, starts)


def _texels_of(texels: Texels, faces: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Some faces at a time, or parts of large ones: the faces, how many texels each has, and the rows of these."""
    counts = texels.starts[faces + 1] - texels.starts[faces]
    parts = np.maximum(-(-counts // _CHUNK), 1)
    number = np.arange(int(parts.sum())) - np.repeat(np.cumsum(parts) - parts, parts)
    starts = np.repeat(texels.starts[faces], parts) + number * _CHUNK
    counts = np.minimum(np.repeat(counts, parts) - number * _CHUNK, _CHUNK)
    faces = np.repeat(faces, parts)
    ends = np.cumsum(counts)
    bounds = np.searchsorted(ends, np.arange(_CHUNK, (ends[-1] if len(ends) else 0) + _CHUNK, _CHUNK))
    first = 0
    for bound in np.unique(np.minimum(bounds + 1, len(faces))):
        part = slice(first, int(bound))
        own = counts[part]
        begin = np.cumsum(own) - own
        rows = np.repeat(starts[part] - begin, own) + np.arange(int(own.sum()))
        yield faces[part], own, rows
        first = int(bound)


def _spread(corners: np.ndarray, counts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Values [N, C] at texels of faces, linear between their corners [M, 3, C], and beyond; `counts` texels each."""
    first = corners[:, 0]
    values = np.repeat(first, counts, axis=0)
    for corner in (1, 2):
        values += np.repeat(corners[:, corner] - first, counts, axis=0) * weights[:, corner - 1 : corner]
    return values


def _add(total: np.ndarray, rows: np.ndarray, seen: np.ndarray, image: np.ndarray, gain: np.ndarray) -> None:
    """Adds a frame's colors to the texels in `rows`, which it sees at pixels (u z, v z, z) with weights [N, 4]."""
    z, counts = seen[:, 2], seen[:, 3]
    height, width = image.shape[:2]
    scale = 1 / np.maximum(z, np.float32(NEAREST_M))
    u, v = seen[:, 0] * scale, seen[:, 1] * scale
    inside = (counts > 0) & (z > NEAREST_M) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    if not inside.all():
        rows, u, v, counts = rows[inside], u[inside], v[inside], counts[inside]
    added = np.empty((len(rows), 4), np.float32)
    np.multiply(sample(image, u, v), gain.astype(np.float32), out=added[:, :3])
    added[:, 3] = 1
    added *= counts[:, None]
    total[rows] += added


def warped(places: np.ndarray, warp: np.ndarray) -> np.ndarray:
    """Homogeneous pixel coordinates float32 [N, 3] after a warp [3, 3]."""
    warp = warp.astype(np.float32)
    return np.stack(
        [warp[row, 0] * places[:, 0] + warp[row, 1] * places[:, 1] + warp[row, 2] * places[:, 2] for row in range(3)],
        axis=1,
    )


def sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear colors [N, C] of an image [H, W, C] at float32 pixel coordinates [N]."""
    if not len(u):  # which OpenCV refuses
        return np.empty((0, image.shape[2]), image.dtype)
    short = -len(u) % _ROW
    columns, rows = (np.pad(each, (0, short)).reshape(-1, _ROW) for each in (u, v))
    return cv2.remap(image, columns, rows, cv2.INTER_LINEAR).reshape(-1, image.shape[2])[: len(u)]


def _corner_weights(weights: np.ndarray) -> np.ndarray:
    return np.concatenate([1 - weights.sum(1, keepdims=True), weights], axis=1)


def _mixed(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """float32 [N, 3], values [V, 3] of vertices, mixed by barycentric weights [N, 3] of corners [N, 3]."""
    mixed = weights[:, :1] * values[corners[:, 0]]
    for corner in (1, 2):
        mixed += weights[:, corner : corner + 1] * values[corners[:, corner]]
    return mixed.astype(np.float32, copy=False)
