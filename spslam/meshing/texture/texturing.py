"""The texture of a mesh, baked from the frames that it was fused from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.errors import DatasetError, SpslamError
from spslam.meshing.frame_fusion import PosedFrames
from spslam.meshing.mesh import TriangleMesh
from spslam.meshing.texture.atlas import Atlas, Texels, find_texels, make_atlas
from spslam.meshing.texture.bake import Corrections, ViewWeights, accumulate, corner_texels, mixed_colors, warped
from spslam.meshing.texture.exposure import Exposures
from spslam.meshing.texture.registration import MeanGray, register
from spslam.meshing.texture.sharpness import sharpness
from spslam.meshing.texture.textured_mesh import TexturedMesh
from spslam.meshing.texture.unseen import fitted_to_seen
from spslam.meshing.texture.views import BestViews, read_views, seen_vertices

# Views that make a texel's color: as many as see it about as well and as sharp. See
# docs/experiments/2026-11-texture-atlas.md for both numbers.
VIEWS = 12
# Power of a frame's sharpness beside its other merits.
_SHARPNESS_POWER = 4.0
# Of the finest pixels that saw each vertex, this quantile counts; so many texels per axis are taken for one of them.
_FINEST_SHARE, _TEXELS_PER_PIXEL = 0.25, 1.5
# Edges of a texel that can be asked for, m: texels of less are too many to be counted, those of more show nothing.
TEXEL_RANGE_M = (1e-6, 1.0)
# A texel is at most this share of the mean edge of a face.
_EDGE_SHARE = 0.7
# Pages of 4096 x 4096 texels at most, in three quarters of which texels are: some 0.8 GB beside them while baking.
MOST_PAGES = 2


@dataclass(frozen=True)
class TextureOptions:
    """How a texture is made.

    Attributes:
        noise: of depth where a part has none of its own, floor (m^2) and growth (1/m^2) of the variance.
        texel_m: edge of a texel, m; None is as finely as the images saw the surface.
        most_pages: pages of 4096 x 4096 texels at most; larger texels are taken where more would be needed.
    """

    noise: tuple[float, float]
    texel_m: float | None = None
    most_pages: int = MOST_PAGES


def texture_mesh(
    mesh: TriangleMesh, parts: PosedFrames | Sequence[PosedFrames], options: TextureOptions
) -> TexturedMesh:
    """Bakes the colors of frames into an atlas of a mesh. All frames are read three times.

    Args:
        mesh: of these frames, with at least one face. Its colors are taken where no frame saw it.
        parts: the frames, of one dataset or of several in one world.
        options: how.

    Returns:
        The textured mesh. The same input gives the same bytes.

    Raises:
        SpslamError: the edge of a texel is outside `TEXEL_RANGE_M`.
        DatasetError: none of the frames can be read.
    """
    if options.texel_m is not None:
        check_texel(options.texel_m)
    parts = [parts] if isinstance(parts, PosedFrames) else parts
    survey = _survey(mesh, parts, options.noise)
    texel_m = options.texel_m or _fine_enough(survey.finest_m, mesh)
    atlas = make_atlas(mesh, texel_m, options.most_pages)
    texels, corners = find_texels(atlas), corner_texels(mesh)
    sets, views = (texels, corners), read_views(parts, options.noise)
    sums, at_vertices = accumulate(mesh, sets, views, survey.weights, survey.corrections)
    own = fitted_to_seen(mesh, corners, at_vertices)
    return _textured(mesh, atlas, _pages(atlas, texels, mixed_colors(mesh, own, texels, sums)), texel_m)


def check_texel(texel_m: float) -> None:
    """Raises SpslamError where no texture has texels of this edge, m."""
    least_m, most_m = TEXEL_RANGE_M
    if not least_m <= texel_m <= most_m:
        raise SpslamError(
            f"a texel of a texture (--texel) must have an edge from {least_m:g} to {most_m:g} m, got {texel_m:g} m"
        )


@dataclass(frozen=True)
class _Survey:
    """What frames saw.

    Attributes:
        weights: what each counts at each vertex.
        corrections: of their colors.
        finest_m: float32 [V], edge of the finest pixel on the surface, m; infinite where none saw it.
    """

    weights: ViewWeights
    corrections: Corrections
    finest_m: np.ndarray


def _survey(mesh: TriangleMesh, parts: Sequence[PosedFrames], noise: tuple[float, float]) -> _Survey:
    """Reads all frames: which are best where, how bright they are, and where their colors are."""
    count = sum(len(part) for part in parts)
    best, exposures = BestViews(len(mesh.vertices), VIEWS + 1), Exposures(len(mesh.vertices), count)
    finest = np.full(len(mesh.vertices), np.float32(np.inf))
    warps = np.tile(np.eye(3), (count, 1, 1))
    mean = MeanGray(mesh.colors)
    read = 0
    for view in read_views(parts, noise):
        seen = seen_vertices(mesh, view)
        best.add(view.number, seen.ids, seen.scores * np.float32(sharpness(view.frame.color) ** _SHARPNESS_POWER))
        finest[seen.ids] = np.minimum(finest[seen.ids], seen.footprints_m)
        exposures.add(view, seen)
        places = view.homogeneous(mesh.vertices[seen.ids])
        warps[view.number] = register(view, places, mean.gray[seen.ids], warps[view.number])
        mean.add(view, seen.ids, warped(places, warps[view.number]), seen.scores)
        read += 1
    if not read:
        names = ", ".join(part.dataset.name for part in parts)
        raise DatasetError(f"{names}: a texture is made of frames, none of which can be read")
    weights, gray = ViewWeights(best), mean.of_views()
    for view in read_views(parts, noise):
        ids = np.flatnonzero(weights.of(view.number))
        places = view.homogeneous(mesh.vertices[ids])
        warps[view.number] = register(view, places, gray[ids], warps[view.number])
    return _Survey(weights, Corrections(exposures.gains(), warps), finest)


def _fine_enough(finest: np.ndarray, mesh: TriangleMesh) -> float:
    """Edge of a texel, m, that shows what the images saw, and no less than colors of the mesh's vertices do."""
    edges = np.linalg.norm(mesh.vertices[mesh.faces[:, 1]] - mesh.vertices[mesh.faces[:, 0]], axis=1)
    texel_m = _EDGE_SHARE * float(edges.mean())
    seen = finest[np.isfinite(finest)]
    return min(texel_m, float(np.quantile(seen, _FINEST_SHARE)) / _TEXELS_PER_PIXEL) if len(seen) else texel_m


def _pages(atlas: Atlas, texels: Texels, colors: np.ndarray) -> np.ndarray:
    """uint8 [P, H, W, 3]; where no chart is, the color of the nearest texel, for small copies of the pages."""
    width, height = atlas.size
    flat, unfilled = (
        np.zeros((atlas.pages * height * width, 3), np.uint8),
        np.ones(atlas.pages * height * width, np.uint8),
    )
    flat[texels.places], unfilled[texels.places] = colors, 0
    pages, empty = flat.reshape(atlas.pages, height, width, 3), unfilled.reshape(atlas.pages, height, width)
    for page, holes in zip(list(pages), list(empty), strict=True):
        _, nearest = cv2.distanceTransformWithLabels(holes, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        color_of = np.zeros((int(nearest.max()) + 1, 3), np.uint8)
        color_of[nearest[holes == 0]] = page[holes == 0]
        page[holes > 0] = color_of[nearest[holes > 0]]
    return pages


def _textured(mesh: TriangleMesh, atlas: Atlas, pages: np.ndarray, wanted_texel_m: float) -> TexturedMesh:
    charts = atlas.charts
    places = atlas.corners_px / np.array(atlas.size, np.float32)
    return TexturedMesh(
        mesh.vertices[charts.vertices],
        charts.faces,
        mesh.normals[charts.vertices],
        places,
        atlas.face_pages().astype(np.int32),
        pages,
        atlas.texel_m,
        wanted_texel_m,
    )
