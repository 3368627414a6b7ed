"""A triangle mesh with a texture, as NumPy arrays."""

from __future__ import annotations

import os
from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, repr=False)
class TexturedMesh:
    """Triangles with pages of texels; K corners, L faces, P pages.

    Attributes:
        vertices: float32 [K, 3], world, m; one where several faces of different charts meet is there for each chart.
        faces: int32 [L, 3], indices of vertices, counter-clockwise seen from free space.
        normals: float32 [K, 3], unit vectors towards free space.
        places: float32 [K, 2], texture coordinates: (0, 0) is the upper left corner of a page, (1, 1) the lower right
            one.
        page_of: int32 [L], the page of each face.
        pages: uint8 [P, H, W, 3] RGB.
        texel_m: edge of a texel on the surface, m.
        wanted_texel_m: the edge that was wanted; smaller where too many pages would have been needed.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    places: np.ndarray
    page_of: np.ndarray
    pages: np.ndarray
    texel_m: float
    wanted_texel_m: float

    def save(self, path: str | os.PathLike) -> None:
        """Writes the mesh as .glb or .obj; see `spslam.meshing.texture.save_textured_mesh`."""
        from spslam.meshing.texture.export import save_textured_mesh

        save_textured_mesh(self, path)

    def colors_at(self, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Colors of points of the surface, bilinear between texels, as a viewer shows them near by.

        Args:
            faces: integers [N], the faces that the points are on.
            weights: float [N, 3], barycentric coordinates in them.

        Returns:
            float32 [N, 3] RGB, 0 to 255.
        """
        size = np.array(self.pages.shape[2:0:-1], np.float32)
        at = np.einsum("nk,nkc->nc", weights, self.places[self.faces[faces]]) * size - 0.5
        colors = np.zeros((len(faces), 3), np.float32)
        for page, image in enumerate(self.pages):
            rows = np.flatnonzero(self.page_of[faces] == page)
            if len(rows):
                x, y = (np.ascontiguousarray(at[rows, axis : axis + 1], np.float32) for axis in (0, 1))
                colors[rows] = _bilinear(image, x, y)
        return colors

    def __repr__(self) -> str:
        pages, height, width = self.pages.shape[:3]
        return f"TexturedMesh({len(self.faces)} faces, {pages} x {width}x{height} px, {1e3 * self.texel_m:.2g} mm)"


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """float32 [N, 3] of an image at columns and rows float32 [N, 1]; beyond the border as at it."""
    parts = []
    for first in range(0, len(x), 16_384):  # OpenCV's images have at most 32,767 rows
        part = slice(first, first + 16_384)
        parts.append(cv2.remap(image, x[part], y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0])
    return np.concatenate(parts).astype(np.float32)
