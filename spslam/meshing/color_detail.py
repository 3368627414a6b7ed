"""Colors of a mesh's vertices from the frames it was fused from, with more vertices where images vary in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from spslam import ops
from spslam.meshing.frame_fusion import PosedFrames, on_device
from spslam.meshing.mesh import TriangleMesh
from spslam.meshing.subdivision import MeshEdges, mesh_edges, midpoints, split_edges
from spslam.meshing.visible_points import KeptFrames, read_seen

# Every so many-th frame gives colors, and every so many-th of these is surveyed for detail, as frames next to each
# other show the same; of short sequences more, up to all.
_COLORED_EVERY, _SURVEYED_EVERY = 5, 8
_LEAST_COLORED, _LEAST_SURVEYED = 120, 20
# An edge is divided where colors in its middle are so many levels from the mean of its ends, and so many times what
# noise makes of that.
DETAIL_LEVELS, _DETAIL_DEVIATIONS = 4.0, 3.0
# What the color that a vertex has counts, in pixels per m^2 of a frame: all where none sees it, else next to nothing.
_OWN_WEIGHT = 100.0
# So many bytes of the frames that give colors are kept, as these are looked at again.
_KEPT_BYTES, _PIXEL_BYTES = 1 << 28, 7


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
    mesh: TriangleMesh,
    parts: PosedFrames | Sequence[PosedFrames],
    options: ColorOptions,
    device: torch.device | str = "cpu",
) -> tuple[TriangleMesh, int]:
    """Gives a mesh the colors of frames, and vertices in the middle of edges where these vary in between.

    A vertex has the mean of the colors with which frames see it, weighted by the pixels that they have for its surface,
    which has the least mean squared error. The surface stays where it is, see `split_edges`. Frames are looked at once
    for each subdivision and once for the colors, but not all of them.

    Args:
        mesh: of these frames. Its colors are kept where no frame sees it.
        parts: the frames, of one dataset or of several in one world; of `keep_colored`, where they were read before.
        options: how.
        device: where frames are looked at.

    Returns:
        The mesh, and the number of frames that colors are of, without those that can't be read. Memory beside the
        meshes: 50 bytes per vertex and 90 per edge, and at most 256 MiB of frames. The same input gives the same bytes.
    """
    parts = keep_colored([parts] if isinstance(parts, PosedFrames) else parts)
    device, survey, looked_at = torch.device(device), thinned(parts, _surveyed_every(parts)), 0
    for _ in range(options.subdivisions):
        edges = mesh_edges(mesh.faces, len(mesh.vertices))
        # Where no edge was divided before there is no detail for finer ones either.
        rows = np.flatnonzero(edges.ends[:, 1] >= looked_at)
        looked_at = len(mesh.vertices)
        chosen = rows[_has_detail(mesh, edges, rows, (survey, options.noise, device))]
        first, second = mesh.colors[edges.ends[chosen]].astype(np.uint16).transpose(1, 0, 2)
        mesh = split_edges(mesh, edges, chosen, ((first + second + 1) // 2).astype(np.uint8))
    views = thinned(parts, colored_every(sum(map(len, parts))))
    colors, read = _mean_colors(mesh, (views, options.noise, device))
    return replace(mesh, colors=colors), read


def colored_every(count: int) -> int:
    """Every how many-th of `count` frames vertices get colors from."""
    return min(_COLORED_EVERY, max(count // _LEAST_COLORED, 1))


def _surveyed_every(parts: Sequence[PosedFrames]) -> int:
    """Every how many-th frame of all parts is surveyed for detail."""
    count = sum(map(len, parts))
    colored = colored_every(count)
    return colored * min(_SURVEYED_EVERY, max(count // (colored * _LEAST_SURVEYED), 1))


def keep_colored(parts: Sequence[PosedFrames]) -> list[KeptFrames]:
    """The parts, whose frames that `color_mesh` looks at are kept once they were read, as far as 256 MiB go.

    The surveyed ones first, at which it looks once more than at others. What is kept already stays so.
    """
    if all(isinstance(part, KeptFrames) for part in parts):
        return [part for part in parts if isinstance(part, KeptFrames)]
    wanted: list[set[int]] = [set() for _ in parts]
    left = _KEPT_BYTES
    for every in (_surveyed_every(parts), colored_every(sum(map(len, parts)))):
        for chosen, part in zip(wanted, thinned(parts, every), strict=True):
            more = [index for index in part.indices.tolist() if index not in chosen]
            frame_bytes = part.dataset.camera.width * part.dataset.camera.height * _PIXEL_BYTES
            more = more[: left // frame_bytes]
            left -= len(more) * frame_bytes
            chosen.update(more)
    return [
        KeptFrames(part.dataset, part.indices, part.poses, part.noise, part.readout, frozenset(chosen))
        for part, chosen in zip(parts, wanted, strict=True)
    ]


def thinned(parts: Sequence[PosedFrames], every: int) -> list[PosedFrames]:
    """Every so many-th frame of all parts, counted through them."""
    kept, first = [], 0
    for part in parts:
        rows = slice(-first % every, None, every)
        kept.append(replace(part, indices=part.indices[rows], poses=part.poses[rows]))
        first += len(part)
    return kept


def _has_detail(
    mesh: TriangleMesh,
    edges: MeshEdges,
    rows: np.ndarray,
    views: tuple[Sequence[PosedFrames], tuple[float, float], torch.device],
) -> np.ndarray:
    """Bool [M]: edges `rows` [M] in whose middle frames have another color than the mean of the ends.

    The difference is taken in each frame that sees all three points, so exposure plays no part, and averaged.
    """
    parts, noise, device = views
    ends = edges.ends[rows]
    points, normals = midpoints(mesh, ends)
    surface = _surface(np.concatenate([mesh.vertices, points]), np.concatenate([mesh.normals, normals]), device)
    on_edges = torch.from_numpy(ends).to(device)
    sums = torch.zeros(len(rows), 5, device=device)
    for colors, weights in read_seen(surface, parts, noise):
        ops.add_color_detail_(sums, colors, weights, on_edges)
        del colors, weights  # before the next frame's are made
    off, (squares, counts) = sums[:, :3].cpu().numpy(), sums[:, 3:].T.cpu().numpy()
    several = counts >= 2
    if not several.any():
        return np.zeros(len(rows), bool)
    seen = np.maximum(counts, 1)
    size = np.einsum("ij,ij->i", off, off) / seen**2
    spread = (squares - counts * size)[several] / (counts[several] - 1)
    variance = float(np.median(spread))
    return (counts > 0) & (size > DETAIL_LEVELS**2 + _DETAIL_DEVIATIONS**2 * variance / seen)


def _mean_colors(
    mesh: TriangleMesh, views: tuple[Sequence[PosedFrames], tuple[float, float], torch.device]
) -> tuple[np.ndarray, int]:
    """uint8 [V, 3], and the number of frames that could be read."""
    parts, noise, device = views
    read = 0
    own = torch.from_numpy(mesh.colors).to(device, torch.float32)
    sums = torch.nn.functional.pad(own, (0, 1), value=1.0) * _OWN_WEIGHT
    for colors, weights in read_seen(_surface(mesh.vertices, mesh.normals, device), parts, noise):
        ops.add_seen_colors_(sums, colors, weights)
        del colors, weights
        read += 1
    return (sums[:, :3] / sums[:, 3:]).round().clamp(0, 255).to(torch.uint8).cpu().numpy(), read


def _surface(points: np.ndarray, normals: np.ndarray, device: torch.device) -> ops.SurfacePoints:
    return ops.SurfacePoints.of(on_device(points, device), on_device(normals, device))
