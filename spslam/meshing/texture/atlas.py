"""Places charts on the pages of a texture atlas, and finds the texels of each face."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.errors import SpslamError
from spslam.meshing.mesh import TriangleMesh, face_normals
from spslam.meshing.texture.charts import Charts, make_charts

# Edge of a page at most, px: what graphics cards of any kind take.
MOST_PAGE_PX = 4096
# Texels around each chart that hold what would be there if it went on; two charts are twice as far from each other.
GUTTER_PX = 3
# Edge of the squares that charts are cut into, px.
TILE_PX = 256
# How far a face is thought to go on: barycentric coordinates of its gutter. A steep face would lead far off its chart.
_LEAST_WEIGHT, _MOST_WEIGHT = -1.0, 2.0
# Texels that faces are looked for in at once; some 100 bytes each.
_FRAGMENTS = 2_000_000
_SPARE, _STEP_PX, _ATTEMPTS = 1.05, 64, 8
# Texels of this share of those by which a mesh fills all pages are too many. From smaller ones, whose tiles cut it into
# single faces, larger ones than needed would come out.
_FINEST_SHARE = 0.5


@dataclass(frozen=True)
class Atlas:
    """Where the faces of a mesh are on pages of texels.

    Attributes:
        charts: of the mesh.
        texel_m: edge of a texel, m.
        size: width and height of each of the pages, px.
        pages: their number.
        page_of: int64 [C], the page of each chart.
        corners_px: float32 [K, 2], x and y of the charts' corners on their pages; the first texel is [0, 1] x [0, 1].
    """

    charts: Charts
    texel_m: float
    size: tuple[int, int]
    pages: int
    page_of: np.ndarray
    corners_px: np.ndarray

    def face_pages(self) -> np.ndarray:
        """int64 [L], the page of each face."""
        return self.page_of[self.charts.of_faces]


def make_atlas(mesh: TriangleMesh, texel_m: float, most_pages: int) -> Atlas:
    """Cuts a mesh into charts and places these on pages.

    Args:
        mesh: with at least one face.
        texel_m: edge of a texel wanted, m.
        most_pages: with more pages of `MOST_PAGE_PX` squared, or a chart larger than one, larger texels are taken.

    Returns:
        The atlas. Deterministic.

    Raises:
        SpslamError: even large texels need more pages, as of a mesh in very many pieces.
    """
    area_m2 = float(np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1).sum(dtype=np.float64)) / 2
    texel_m = max(texel_m, _FINEST_SHARE * float(np.sqrt(area_m2 / most_pages)) / MOST_PAGE_PX)
    for _ in range(_ATTEMPTS):
        charts = make_charts(mesh, texel_m * TILE_PX)
        sizes = np.ceil(charts.sizes_m / texel_m).astype(np.int64) + 1 + 2 * GUTTER_PX
        if sizes.max() > MOST_PAGE_PX:  # a face that fits on no page
            texel_m = float(charts.sizes_m.max()) / max(MOST_PAGE_PX - 2 - 2 * GUTTER_PX, 1)
            continue
        page_of, offsets, size = _packed(sizes)
        pages = int(page_of.max()) + 1
        if pages <= most_pages:
            break
        full = (pages - 1) * MOST_PAGE_PX**2 + size[0] * size[1]
        texel_m *= max(float(np.sqrt(full / (most_pages * MOST_PAGE_PX**2))), 1.02)
    else:
        raise SpslamError(
            f"a texture of this mesh needs more than {most_pages} pages of {MOST_PAGE_PX} x {MOST_PAGE_PX} texels of "
            f"any size, as it has {len(charts.sizes_m)} charts; a coarser mesh (--resolution) has fewer"
        )
    corner_chart = np.zeros(len(charts.vertices), np.int64)
    corner_chart[charts.faces] = charts.of_faces[:, None]
    corners = charts.places_m / np.float32(texel_m) + offsets[corner_chart] + np.float32(GUTTER_PX + 0.5)
    return Atlas(charts, texel_m, size, pages, page_of, corners.astype(np.float32))


def _packed(sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Page [C] and offset [C, 2] (px) of rectangles [C, 2] on shelves, highest first, and the size of the pages."""
    area = float(sizes.prod(1).sum())
    width = int(np.clip(np.sqrt(area) * _SPARE, sizes[:, 0].max(), MOST_PAGE_PX))
    width = min(-(-width // _STEP_PX) * _STEP_PX, MOST_PAGE_PX)
    pages, offsets = np.zeros(len(sizes), np.int64), np.zeros((len(sizes), 2), np.int64)
    page = left = top = shelf = highest = 0
    for chart in np.lexsort((-sizes[:, 0], -sizes[:, 1])):
        x, y = (int(length) for length in sizes[chart])
        if left + x > width:
            left, top, shelf = 0, top + shelf, 0
        if top + y > MOST_PAGE_PX:
            page, left, top, shelf = page + 1, 0, 0, 0
        pages[chart], offsets[chart] = page, (left, top)
        left, shelf = left + x, max(shelf, y)
        highest = max(highest, top + y)
    return pages, offsets, (width, min(-(-highest // _STEP_PX) * _STEP_PX, MOST_PAGE_PX))


@dataclass(frozen=True)
class Texels:
    """The texels of an atlas that hold colors; N of them, in the order of their faces.

    Attributes:
        places: int64 [N], where they are in the flattened pages [pages, height, width].
        faces: int32 [N], the face that each is of.
        weights: float32 [N, 2], barycentric coordinates of the second and third corner; beyond [0, 1], up to one face
            off, outside the face.
        starts: int64 [L + 1], the first texel of each face.
    """

    places: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    starts: np.ndarray


def find_texels(atlas: Atlas) -> Texels:
    """The texels whose centers lie in a face, and the gutter around each chart, whose faces are thought to go on."""
    width, height = atlas.size
    owners = np.full(atlas.pages * height * width, -1, np.int32)
    corners = atlas.corners_px[atlas.charts.faces].astype(np.float64)
    base = atlas.face_pages() * (height * width)
    boxes, low, extent = _bands(corners)
    for chunk in _chunks(extent):
        faces = boxes[chunk]
        x, y, rows = _inside(corners[faces], low[chunk], extent[chunk])
        faces = faces[rows]
        owners[base[faces] + y * width + x] = faces
    owners = _with_gutter(owners.reshape(atlas.pages, height, width)).reshape(-1)
    places = np.flatnonzero(owners >= 0)
    order = np.argsort(owners[places], kind="stable")
    places = places[order]
    faces = owners[places]
    starts = np.searchsorted(faces, np.arange(len(corners) + 1))
    y, x = np.divmod(places % (height * width), width)
    weights = np.empty((len(places), 2), np.float32)
    for first in range(0, len(places), _FRAGMENTS):
        part = slice(first, first + _FRAGMENTS)
        weights[part] = _barycentric(corners[faces[part]], x[part] + 0.5, y[part] + 0.5)
    return Texels(places, faces, weights.clip(_LEAST_WEIGHT, _MOST_WEIGHT), starts)


def _bands(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes of texels that faces are in, or bands of rows of those with more than `_FRAGMENTS`.

    Returns:
        Faces int64 [B], ascending, and column and row of the first texel and numbers of columns and rows, int64 [B, 2].
    """
    low = np.ceil(corners.min(1) - 0.5).astype(np.int64)
    extent = (np.floor(corners.max(1) - 0.5).astype(np.int64) - low + 1).clip(min=0)
    height = np.maximum(_FRAGMENTS // extent[:, 0].clip(min=1), 1)
    counts = -(-extent[:, 1] // height)
    faces = np.repeat(np.arange(len(corners)), counts)
    first = (np.arange(len(faces)) - np.repeat(np.cumsum(counts) - counts, counts)) * height[faces]
    rows = np.minimum(extent[faces, 1] - first, height[faces])
    return faces, np.stack([low[faces, 0], low[faces, 1] + first], axis=1), np.stack([extent[faces, 0], rows], axis=1)


def _chunks(extent: np.ndarray) -> list[slice]:
    """Slices of boxes [B, 2] that have about `_FRAGMENTS` texels."""
    ends = np.cumsum(extent.prod(1))
    bounds = np.searchsorted(ends, np.arange(_FRAGMENTS, ends[-1] if len(ends) else 0, _FRAGMENTS))
    edges = np.unique(np.concatenate([[0], bounds, [len(extent)]]))
    return [slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def _inside(corners: np.ndarray, low: np.ndarray, extent: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows of the texels of boxes whose centers lie in the boxes' faces, and rows of these."""
    counts = extent.prod(1)
    boxes = np.repeat(np.arange(len(corners)), counts)
    offset = np.arange(len(boxes)) - np.repeat(np.cumsum(counts) - counts, counts)
    y, x = np.divmod(offset, extent[boxes, 0])
    x, y = x + low[boxes, 0], y + low[boxes, 1]
    second, third = _barycentric(corners[boxes], x + 0.5, y + 0.5).T
    inside = np.flatnonzero((second >= 0) & (third >= 0) & (second + third <= 1))
    return x[inside], y[inside], boxes[inside]


def _barycentric(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Barycentric coordinates [N, 2] of the second and third corner; those of faces without an area are (1/3, 1/3)."""
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    px, py = x - a[:, 0], y - a[:, 1]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    scale = np.divide(1.0, area, out=np.zeros_like(area), where=np.abs(area) > 1e-9)
    second, third = (px * c[:, 1] - py * c[:, 0]) * scale, (b[:, 0] * py - b[:, 1] * px) * scale
    return np.where((scale == 0)[:, None], 1 / 3, np.stack([second, third], axis=1))


def _with_gutter(owners: np.ndarray) -> np.ndarray:
    """Owners int32 [P, H, W] where the texels around charts, -1 before, have a neighbor's."""
    # OpenCV's dilation knows no int32; float32 has whole numbers up to 2^24.
    kind = np.float32 if owners.max() < 1 << 24 else np.float64
    pages = []
    for page in owners:
        grown = page.astype(kind)
        for _ in range(GUTTER_PX):
            grown = np.where(grown < 0, cv2.dilate(grown, np.ones((3, 3), np.uint8)), grown)
        pages.append(grown.astype(np.int32))
    return np.stack(pages)
