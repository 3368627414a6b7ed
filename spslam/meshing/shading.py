"""Light and colors of a mesh's pixels, from which face each of them sees."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.image_library import image_library

_BACKGROUND = 255
# A headlight slightly above the camera, and ambient light.
_LIGHT = np.array([0.25, -0.5, -1.0]) / np.linalg.norm([0.25, -0.5, -1.0])
_AMBIENT, _DIFFUSE = 0.55, 0.55
_GRAY = 200


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
        raster: what is visible of these faces.
    """
    if colors is None:
        colors = np.full((len(points), 3), _GRAY, np.uint8)
    normals, base = surface(points, faces, colors, camera, raster)
    # Blurred slightly, to hide facets.
    smooth = np.ascontiguousarray(cv2.GaussianBlur(normals, (0, 0), 1.0))
    light = np.array([*_LIGHT, _AMBIENT, _DIFFUSE], np.float32)
    face_ids, image = np.ascontiguousarray(raster.face_ids), np.empty(base.shape, np.uint8)
    image_library().spslam_light_pixels(
        light.ctypes.data,
        face_ids.size,
        face_ids.ctypes.data,
        smooth.ctypes.data,
        base.ctypes.data,
        _BACKGROUND,
        image.ctypes.data,
    )
    return image


def surface(
    points: np.ndarray, faces: np.ndarray, colors: np.ndarray, camera: Camera, raster: Raster
) -> tuple[np.ndarray, np.ndarray]:
    """Normals and colors of what is visible, without light; arguments as of `shade`.

    Returns:
        Unit normals towards the camera, and colors between those of the vertices, float32 [H, W, 3] each; 0 for
        background.

    Raises:
        ValueError: not a color for each vertex.
    """
    if np.ndim(colors) != 2 or len(colors) != len(points) or np.shape(colors)[1] < 3:
        raise ValueError(f"colors must be [{len(points)}, 3], one for each vertex, got {list(np.shape(colors))}")
    points, faces = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(faces, np.int32)
    colors = np.ascontiguousarray(np.asarray(colors)[:, :3], np.uint8)
    depth, face_ids = np.ascontiguousarray(raster.depth), np.ascontiguousarray(raster.face_ids)
    size = np.array([camera.width, camera.height], np.int32)
    numbers = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    normals, found = (np.empty((camera.height, camera.width, 3), np.float32) for _ in range(2))
    mesh = points.ctypes.data, faces.ctypes.data, len(faces), colors.ctypes.data
    arrays = size, numbers, depth, face_ids, normals, found
    image_library().spslam_rastered_surface(*mesh, *(array.ctypes.data for array in arrays))
    return normals, found


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products [N, 3] of vectors [N, 3], of which `np.cross` makes more copies."""
    out = np.empty(a.shape, np.result_type(a, b))
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        out[:, axis] = a[:, first] * b[:, second] - a[:, second] * b[:, first]
    return out
