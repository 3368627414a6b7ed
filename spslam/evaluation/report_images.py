"""Images of the report: the mesh from above with the trajectory, and depth in color."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.evaluation.run_output import Mesh
from spslam.geometry import pose_from
from spslam.meshing.render import rasterize, render_mesh
from spslam.meshing.shading import cross

_ELEVATION = np.radians(48)
_OVERVIEW = Camera(1200, 750, 1350.0, 1350.0, 599.5, 374.5)
_TRAJECTORY_COLOR = (220, 38, 38)
# A page has up to 13 images and a limit of its size; noise has 3 bytes per pixel in PNG and 1 in JPEG.
_MAX_PNG_BYTES_PER_PIXEL, _JPEG_QUALITY = 1.2, 90


def image_uri(image: np.ndarray, max_width: int = 480) -> str:
    """Encodes an RGB image [H, W, 3] as a data URI: PNG, or JPEG where PNG would need more than 1.2 bytes per pixel.

    Images wider than `max_width` px are downscaled to it.
    """
    height, width = image.shape[:2]
    if width > max_width:
        size = max_width, max(round(height * max_width / width), 1)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    kind, data = "png", cv2.imencode(".png", image)[1]
    if data.nbytes > _MAX_PNG_BYTES_PER_PIXEL * image.shape[0] * image.shape[1]:
        kind, data = "jpeg", cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"


def colorize_depth(depth: np.ndarray, near_m: float, far_m: float) -> np.ndarray:
    """Colors depth [H, W] from near (yellow) to far (violet), uint8 RGB [H, W, 3]; white where there is none."""
    share = np.clip((depth - near_m) / max(far_m - near_m, 1e-6), 0, 1)
    image = cv2.applyColorMap((255 * (1 - share)).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    image[depth <= 0] = 255
    return image


def depth_limits(*depths: np.ndarray) -> tuple[float, float]:
    """The 2nd and 98th percentile of the known depths; (0, 1) without any."""
    known = np.concatenate([depth[depth > 0] for depth in depths])
    return tuple(np.percentile(known, (2, 98))) if len(known) else (0.0, 1.0)  # type: ignore[return-value]


def outward_faces(mesh: Mesh, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """The faces of a mesh, all flipped if most faces that the camera sees show it their back."""
    small = camera.resized(camera.width // 2, camera.height // 2)
    seen = rasterize(mesh.vertices, mesh.faces, small, pose).face_ids
    corners = mesh.vertices[mesh.faces[seen[seen >= 0]]]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    towards = np.einsum("nk,nk->n", normals, pose[:3, 3] - corners[:, 0])
    return mesh.faces if (towards >= 0).sum() >= (towards < 0).sum() else mesh.faces[:, ::-1]


def render_overview(mesh: Mesh, faces: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Renders the mesh from above, without the walls nearest to the viewer, and the trajectory.

    Args:
        mesh: the mesh.
        faces: its faces, with the front towards the observed space.
        poses: [F, 4, 4], the trajectory; the up direction is estimated from it.

    Returns:
        uint8 RGB [H, W, 3], cropped.
    """
    right, up, back = upright_axes(poses)
    low, high = np.percentile(mesh.vertices, (1, 99), axis=0)
    center = (low + high) / 2
    away = np.cos(_ELEVATION) * back + np.sin(_ELEVATION) * up
    down = np.cross(-away, right)
    pose = pose_from(np.stack([right, down, -away], axis=1), center)
    inside = mesh.vertices[np.all((mesh.vertices >= low) & (mesh.vertices <= high), axis=1)][::7]
    distance = _fitting_distance(np.concatenate([inside, poses[:, :3, 3]]), pose)
    pose[:3, 3] = center + distance * away
    image, _ = render_mesh(mesh.vertices, faces, mesh.colors, _OVERVIEW, pose, cull_back=True, supersampling=2)
    pixels = _OVERVIEW.project((poses[:, :3, 3] - pose[:3, 3]) @ pose[:3, :3])
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    points = np.rint(16 * np.clip(pixels, -4000, 4000)).astype(np.int32).reshape(-1, 1, 2)
    return _cropped(cv2.polylines(image, [points], False, _TRAJECTORY_COLOR, 2, cv2.LINE_AA, shift=4))


def top_axes(poses: np.ndarray) -> np.ndarray:
    """[3, 2]: two horizontal axes, right and forward of the first camera, for a top view."""
    right, _, back = upright_axes(poses)
    return np.stack([right, -back], axis=1)


def upright_axes(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and backward, orthonormal; up is the mean up direction (negative y axis) of the cameras."""
    up = -poses[:, :3, 1].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-3 else -poses[0, :3, 1]
    # Where the first camera looks straight up or down, its own right axis is used.
    right = np.cross(poses[0, :3, 2], up)
    if np.linalg.norm(right) < 1e-3:
        right = poses[0, :3, 0] - (poses[0, :3, 0] @ up) * up
    right = right / np.linalg.norm(right)
    return right, up, np.cross(right, up)


def _cropped(image: np.ndarray, margin: int = 20) -> np.ndarray:
    """The image without its white border, except for a margin in px."""
    rows, columns = (np.flatnonzero((image != 255).any(axis=(axis, 2))) for axis in (1, 0))
    if not len(rows):
        return image
    top, left = max(rows[0] - margin, 0), max(columns[0] - margin, 0)
    return np.ascontiguousarray(image[top : rows[-1] + margin, left : columns[-1] + margin])


def _fitting_distance(points: np.ndarray, pose: np.ndarray) -> float:
    """How far to move the overview camera backward from `pose` so that all points [N, 3] are in view, in meters."""
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    half_width, half_height = 0.46 * _OVERVIEW.width / _OVERVIEW.fx, 0.46 * _OVERVIEW.height / _OVERVIEW.fy
    return float(max((np.abs(x) / half_width - z).max(), (np.abs(y) / half_height - z).max(), 0.1))
