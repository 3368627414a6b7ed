"""Light and colors of a mesh's pixels, from which face each of them sees."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.camera import Camera

_BACKGROUND = 255
# A headlight slightly above the camera, and ambient light.
_LIGHT = np.array([0.25, -0.5, -1.0]) / np.linalg.norm([0.25, -0.5, -1.0])
_AMBIENT, _DIFFUSE = 0.55, 0.55


@dataclass(frozen=True)
class Raster:
    """Depth and visible face of each pixel.

    Attributes:
        depth: float32 [H, W], meters along the optical axis; 0 for background.
        face_ids: int32 [H, W], -1 for background.
    """

    depth: np.ndarray
    face_ids: np.ndarray


def shade(
    points: np.ndarray, faces: np.ndarray, colors: np.ndarray | None, camera: Camera, raster: Raster
) -> np.ndarray:
    """The image of what is visible, uint8 [H, W, 3] RGB on white.

    Args:
        points: [V, 3], vertices in camera axes, m.
        faces: integers [L, 3].
        colors: uint8 [V, 3] RGB of the vertices; None is plain gray.
        camera: intrinsics of the view.
        raster: what is visible.
    """
    hit = raster.face_ids >= 0
    image = np.full((*hit.shape, 3), _BACKGROUND, dtype=np.uint8)
    if not hit.any():
        return image
    shown = faces[raster.face_ids[hit]]
    corners = points.astype(np.float32)[shown]
    places = (camera.ray_directions() * raster.depth[..., None])[hit]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    light = _lighting(normals, places, hit)
    if colors is None:
        base: np.ndarray | float = 200.0
    else:
        weights = barycentric(corners, places, normals)
        base = np.einsum("nk,nkc->nc", weights, np.asarray(colors)[shown, :3].astype(np.float32))
    image[hit] = np.clip(base * light[:, None], 0, 255).astype(np.uint8)
    return image


def _lighting(normals: np.ndarray, points: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Brightness of each foreground pixel; normals face the viewer and are blurred slightly, to hide facets."""
    length = np.sqrt(_dot(normals, normals))[:, None]
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    normals = np.where((_dot(normals, points) > 0)[:, None], -normals, normals)
    image = np.zeros((*hit.shape, 3), dtype=np.float32)
    image[hit] = normals
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)[hit]
    smooth /= np.maximum(np.sqrt(_dot(smooth, smooth)), 1e-6)[:, None]
    return _AMBIENT + _DIFFUSE * np.clip(smooth @ _LIGHT.astype(np.float32), 0, 1)


def barycentric(corners: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Barycentric weights [N, 3] of points in the planes of triangles."""
    area = np.maximum(_dot(normals, normals), 1e-30)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    wb = _dot(cross(points - a, c - a), normals) / area
    wc = _dot(cross(b - a, points - a), normals) / area
    weights = [np.clip(weight, 0, 1) for weight in (1 - wb - wc, wb, wc)]
    total = np.maximum(weights[0] + weights[1] + weights[2], 1e-12)
    return np.stack([weight / total for weight in weights], axis=1).astype(np.float32)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products [N] of vectors [N, 3]; a sum over so short an axis takes NumPy several times as long."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products [N, 3] of vectors [N, 3], of which `np.cross` makes more copies."""
    out = np.empty(a.shape, np.result_type(a, b))
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        out[:, axis] = a[:, first] * b[:, second] - a[:, second] * b[:, first]
    return out
