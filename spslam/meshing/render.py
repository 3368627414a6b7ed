"""Renders meshes with a z-buffer rasterizer, for reports and for depth images of a mesh."""

from __future__ import annotations

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.geometry import inverse
from spslam.image_library import image_library
from spslam.meshing.mesh import indexed
from spslam.meshing.shading import Raster, shade, surface

NEAREST_M = 0.02
_MOST_FACES = 2**31 - 1  # their indices are 32-bit numbers


def render_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray | None,
    camera: Camera,
    T_world_camera: np.ndarray,
    cull_back: bool = False,
    supersampling: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Renders a shaded image of a mesh, and its depth.

    Args:
        vertices: [V, 3], meters, world axes.
        faces: integers [L, 3].
        colors: uint8 [V, 3] RGB of the vertices; None is plain gray.
        camera: intrinsics of the view.
        T_world_camera: [4, 4], pose of the view.
        cull_back: back-face culling (the front is counter-clockwise), to look into a room from outside.
        supersampling: samples per pixel along each axis, for anti-aliasing.

    Returns:
        uint8 [H, W, 3] RGB on white, and float32 [H, W] depth in meters, 0 for background. An empty mesh gives a white
        image. Deterministic; a million small faces at 640x480 take about a tenth of a
        second.
    """
    fine = camera.resized(camera.width * supersampling, camera.height * supersampling)
    points, faces = _to_camera(np.asarray(vertices), T_world_camera), np.asarray(faces).reshape(-1, 3)
    raster = _rasterize(points, faces, fine, cull_back)
    image = shade(points, faces, colors, fine, raster)
    if supersampling == 1:
        return image, raster.depth
    size = camera.width, camera.height
    smooth = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    middle = supersampling // 2
    return smooth, np.ascontiguousarray(raster.depth[middle::supersampling, middle::supersampling])


def rasterize(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, T_world_camera: np.ndarray, cull_back: bool = False
) -> Raster:
    """Finds the nearest face at each pixel center; faces are clipped at 2 cm in front of the camera.

    Of faces at the same depth the one with the highest index is visible.

    Args:
        vertices: [V, 3], meters, world axes.
        faces: integers [L, 3].
        camera: intrinsics of the view.
        T_world_camera: [4, 4], pose of the view.
        cull_back: back-face culling.

    Returns:
        Depth and face index of each pixel. Deterministic; instruction sets differ by rounding. Python's lock is
        released meanwhile.

    Raises:
        ValueError: a face of other indices than those of vertices.
        ImportError: there is no compiled library for this processor.
    """
    points = _to_camera(np.asarray(vertices), T_world_camera)
    return _rasterize(points, np.asarray(faces).reshape(-1, 3), camera, cull_back)


def render_colors(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, camera: Camera, T_world_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Renders the colors of a mesh's vertices as they are, without light.

    Args:
        vertices: [V, 3], meters, world axes.
        faces: integers [L, 3].
        colors: uint8 [V, 3] RGB of the vertices.
        camera: intrinsics of the view.
        T_world_camera: [4, 4], pose of the view.

    Returns:
        uint8 [H, W, 3] RGB, black for background, and float32 [H, W] depth in meters, 0 there. Deterministic.
    """
    points, faces = _to_camera(np.asarray(vertices), T_world_camera), np.asarray(faces).reshape(-1, 3)
    raster = _rasterize(points, faces, camera, cull_back=False)
    image = np.rint(surface(points, faces, colors, camera, raster)[1]).astype(np.uint8)
    return image, raster.depth


def _rasterize(points: np.ndarray, faces: np.ndarray, camera: Camera, cull_back: bool) -> Raster:
    if len(faces) > _MOST_FACES:
        raise ValueError(f"rasterize: at most {_MOST_FACES} faces, got {len(faces)}")
    faces = indexed(faces, len(points))
    shape = camera.height, camera.width
    raster = Raster(np.empty(shape, np.float32), np.empty(shape, np.int32))
    corners = np.ascontiguousarray(points, np.float64)
    size = np.array(shape[::-1], np.int32)
    numbers = np.array([camera.fx, camera.fy, camera.cx, camera.cy, NEAREST_M])
    image_library().spslam_rasterize(
        corners.ctypes.data,
        faces.ctypes.data,
        len(faces),
        size.ctypes.data,
        numbers.ctypes.data,
        cull_back,
        raster.depth.ctypes.data,
        raster.face_ids.ctypes.data,
    )
    return raster


def _to_camera(points: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    T_camera_world = inverse(T_world_camera)
    # Not @: for such thin products BLAS would start threads on all cores.
    rotated = np.einsum("ij,kj->ik", points.reshape(-1, 3), T_camera_world[:3, :3])
    return rotated + T_camera_world[:3, 3]
