"""Colors of a mesh's vertices from the frames it was fused from, with more vertices where images vary in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spslam.meshing.frame_fusion import PosedFrames
from spslam.meshing.mesh import TriangleMesh
from spslam.meshing.subdivision import MeshEdges, mesh_edges, midpoints, split_edges
from spslam.meshing.visible_points import SurfacePoints, read_seen

# Every so many-th frame gives colors, and every so many-th of these is surveyed for detail, as frames next to each
# other show the same; of short sequences more, up to all.
_COLORED_EVERY, _SURVEYED_EVERY = 5, 4
_LEAST_COLORED, _LEAST_SURVEYED = 120, 40
# An edge is divided where colors in its middle are so many levels from the mean of its ends, and so many times what
# noise makes of that.
DETAIL_LEVELS, _DETAIL_DEVIATIONS = 4.0, 3.0
# What the color that a vertex has counts, in pixels per m^2 of a frame: all where none sees it, else next to nothing.
_OWN_WEIGHT = 100.0


@dataclass(frozen=True)
class ColorOptions:
    """How vertices get the colors of frames.

    Attributes:
        noise: of depth where a part has none of its own, floor (m^2) and growth (1/m^2) of the variance.
        subdivisions: how many times edges are divided in two where images vary inside.
    """

    noise: tuple[float, float]
    subdivisions: int = 2


def color_mesh(
    mesh: TriangleMesh, parts: PosedFrames | Sequence[PosedFrames], options: ColorOptions
) -> tuple[TriangleMesh, int]:
    """Gives a mesh the colors of frames, and vertices in the middle of edges where these vary in between.

    A vertex has the mean of the colors with which frames see it, weighted by the pixels that they have for its surface,
    which has the least mean squared error. The surface stays where it is, see `split_edges`. Frames are read once for
    each subdivision and once for the colors, but not all of them.

    Args:
        mesh: of these frames. Its colors are kept where no frame sees it.
        parts: the frames, of one dataset or of several in one world.
        options: how.

    Returns:
        The mesh, and the number of frames that colors are of; frames that can't be read are left out. Memory beside the
        meshes: 30 bytes per vertex and 70 per edge. The same input gives the same bytes.
    """
    parts = [parts] if isinstance(parts, PosedFrames) else parts
    count = sum(len(part) for part in parts)
    colored = min(_COLORED_EVERY, max(count // _LEAST_COLORED, 1))
    surveyed = colored * min(_SURVEYED_EVERY, max(count // (colored * _LEAST_SURVEYED), 1))
    looked_at = 0
    for _ in range(options.subdivisions):
        edges = mesh_edges(mesh.faces, len(mesh.vertices))
        # Where no edge was divided before there is no detail for finer ones either.
        rows = np.flatnonzero(edges.ends[:, 1] >= looked_at)
        looked_at = len(mesh.vertices)
        chosen = rows[_has_detail(mesh, edges, rows, thinned(parts, surveyed), options.noise)]
        first, second = mesh.colors[edges.ends[chosen]].astype(np.uint16).transpose(1, 0, 2)
        mesh = split_edges(mesh, edges, chosen, ((first + second + 1) // 2).astype(np.uint8))
    views = thinned(parts, colored)
    return replace(mesh, colors=_mean_colors(mesh, views, options.noise)), sum(map(len, views))


def thinned(parts: Sequence[PosedFrames], every: int) -> list[PosedFrames]:
    """Every so many-th frame of all parts, counted through them."""
    kept, first = [], 0
    for part in parts:
        rows = slice(-first % every, None, every)
        kept.append(replace(part, indices=part.indices[rows], poses=part.poses[rows]))
        first += len(part)
    return kept


def _has_detail(
    mesh: TriangleMesh, edges: MeshEdges, rows: np.ndarray, parts: Sequence[PosedFrames], noise: tuple[float, float]
) -> np.ndarray:
    """Bool [M]: edges `rows` [M] in whose middle frames have another color than the mean of the ends.

    The difference is taken in each frame that sees all three points, so exposure plays no part, and averaged.
    """
    ends = edges.ends[rows]
    points, normals = midpoints(mesh, ends)
    surface = SurfacePoints(np.concatenate([mesh.vertices, points]), np.concatenate([mesh.normals, normals]))
    sums, squares, counts = np.zeros((len(rows), 3), np.float32), *np.zeros((2, len(rows)), np.float32)
    place = np.full(len(mesh.vertices) + len(rows), -1, np.int32)
    for seen in read_seen(surface, parts, noise):
        place[seen.ids] = np.arange(len(seen.ids), dtype=np.int32)
        middle = np.flatnonzero(seen.ids >= len(mesh.vertices))
        seen_rows = seen.ids[middle] - len(mesh.vertices)
        first, second = place[ends[seen_rows]].T
        whole = (first >= 0) & (second >= 0)
        middle, seen_rows, first, second = middle[whole], seen_rows[whole], first[whole], second[whole]
        place[seen.ids] = -1
        ends_sum = seen.colors[first].astype(np.float32) + seen.colors[second]
        off = seen.colors[middle] - np.float32(0.5) * ends_sum
        sums[seen_rows] += off
        squares[seen_rows] += np.einsum("ij,ij->i", off, off)
        counts[seen_rows] += 1
    mean = sums / np.maximum(counts, 1)[:, None]
    size = np.einsum("ij,ij->i", mean, mean)
    several = counts >= 2
    if not several.any():
        return np.zeros(len(rows), bool)
    spread = (squares - counts * size)[several] / (counts[several] - 1)
    variance = float(np.median(spread))
    return (counts > 0) & (size > DETAIL_LEVELS**2 + _DETAIL_DEVIATIONS**2 * variance / np.maximum(counts, 1))


def _mean_colors(mesh: TriangleMesh, parts: Sequence[PosedFrames], noise: tuple[float, float]) -> np.ndarray:
    """uint8 [V, 3]."""
    surface = SurfacePoints(mesh.vertices, mesh.normals)
    sums = np.empty((len(mesh.vertices), 4), np.float32)
    sums[:, :3], sums[:, 3] = mesh.colors, 1
    sums *= np.float32(_OWN_WEIGHT)
    for seen in read_seen(surface, parts, noise):
        added = np.empty((len(seen.ids), 4), np.float32)
        added[:, :3], added[:, 3] = seen.colors, 1
        added *= seen.weights[:, None]
        sums[seen.ids] += added
    return np.clip(np.rint(sums[:, :3] / sums[:, 3:]), 0, 255).astype(np.uint8)
