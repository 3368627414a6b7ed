"""Renders meshes with a z-buffer rasterizer in NumPy, for reports and for depth images of a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.geometry import inverse
from spslam.meshing.shading import Raster, barycentric, cross, shade

NEAREST_M = 0.02
# Largest number of fragments in memory; some 40 bytes each.
_FRAGMENTS = 2_000_000


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
        image. Deterministic; a million small faces at 640x480 take about a second.
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
        Depth and face index of each pixel.
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
    image = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    hit = raster.face_ids >= 0
    shown = faces[raster.face_ids[hit]]
    corners = points.astype(np.float32)[shown]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weights = barycentric(corners, (camera.ray_directions() * raster.depth[..., None])[hit], normals)
    image[hit] = np.einsum("nk,nkc->nc", weights, np.asarray(colors)[shown, :3].astype(np.float32)).round()
    return image, raster.depth


def _rasterize(points: np.ndarray, faces: np.ndarray, camera: Camera, cull_back: bool) -> Raster:
    corners, ids = _clip(points, _in_view(points, faces, camera))
    setup = _Setup.of(corners, ids, camera, cull_back)
    inverse_depth = np.zeros(camera.height * camera.width, dtype=np.float32)
    winners = np.full(camera.height * camera.width, -1, dtype=np.int32)
    for chunk in setup.chunks():
        pixels, nearness, owners = setup.fragments(chunk, camera.width)
        np.maximum.at(inverse_depth, pixels, nearness)
        front = nearness == inverse_depth[pixels]
        winners[pixels[front]] = owners[front]
    depth = np.divide(1, inverse_depth, out=np.zeros_like(inverse_depth), where=inverse_depth > 0)
    shape = camera.height, camera.width
    return Raster(depth.reshape(shape), winners.reshape(shape))


@dataclass
class _Setup:
    """Triangle setup: bounding boxes (px), and functions a + b x + c y of the offset from the corner of the box."""

    ids: np.ndarray
    left: np.ndarray
    top: np.ndarray
    width: np.ndarray
    height: np.ndarray
    # [T, 3, 3]: two barycentric coordinates and the inverse depth; all three are linear in the image.
    planes: np.ndarray

    @classmethod
    def of(cls, corners: np.ndarray, ids: np.ndarray, camera: Camera, cull_back: bool) -> _Setup:
        inverse_z = 1 / corners[..., 2]
        u = corners[..., 0] * inverse_z * camera.fx + camera.cx
        v = corners[..., 1] * inverse_z * camera.fy + camera.cy
        du1, dv1, du2, dv2 = u[:, 1] - u[:, 0], v[:, 1] - v[:, 0], u[:, 2] - u[:, 0], v[:, 2] - v[:, 0]
        area = du1 * dv2 - du2 * dv1
        # Counter-clockwise in a world with y up is clockwise in an image with v down.
        visible = np.flatnonzero((area < 0) if cull_back else (area != 0))
        left, right = _pixel_range(u[visible], camera.width)
        top, bottom = _pixel_range(v[visible], camera.height)
        shown = np.flatnonzero((right >= left) & (bottom >= top))
        left, right, top, bottom = left[shown], right[shown], top[shown], bottom[shown]
        # Small triangles first, so that the triangles of a chunk are of similar size.
        order = np.argsort((right - left + 1) * (bottom - top + 1), kind="stable")
        left, right, top, bottom = left[order], right[order], top[order], bottom[order]
        keep = visible[shown[order]]
        scale = 1 / area[keep]
        x0, y0 = left - u[keep, 0], top - v[keep, 0]
        b1, c1 = dv2[keep] * scale, -du2[keep] * scale
        b2, c2 = -dv1[keep] * scale, du1[keep] * scale
        first = np.stack([b1 * x0 + c1 * y0, b1, c1], axis=-1)
        second = np.stack([b2 * x0 + c2 * y0, b2, c2], axis=-1)
        z0, z1, z2 = inverse_z[keep].T[..., None]
        depth = first * (z1 - z0) + second * (z2 - z0)
        depth[:, 0] += z0[:, 0]
        planes = np.stack([first, second, depth], axis=1).astype(np.float32)
        return cls(ids[keep], left, top, right - left + 1, bottom - top + 1, planes)

    def chunks(self) -> list[slice]:
        """Slices of triangles whose boxes have about `_FRAGMENTS` pixels in total."""
        if not len(self.ids):
            return []
        total = np.cumsum(self.width * self.height)
        bounds = np.searchsorted(total, np.arange(_FRAGMENTS, total[-1] + _FRAGMENTS, _FRAGMENTS), side="right")
        edges = np.unique(np.concatenate([[0], bounds, [len(self.ids)]]))
        return [slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]

    def fragments(self, chunk: slice, image_width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixel index, inverse depth and face id of all pixels inside the chunk's triangles."""
        width, counts = self.width[chunk], self.width[chunk] * self.height[chunk]
        owner = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        offset = np.arange(len(owner), dtype=np.int32) - np.repeat(
            (np.cumsum(counts) - counts).astype(np.int32), counts
        )
        y, x = np.divmod(offset, width.astype(np.int32)[owner])
        planes = self.planes[chunk].reshape(-1, 9)[owner]
        # float32 throughout, because the visible face of a pixel is found by equality.
        fx, fy = x.astype(np.float32), y.astype(np.float32)
        first = planes[:, 0] + planes[:, 1] * fx + planes[:, 2] * fy
        second = planes[:, 3] + planes[:, 4] * fx + planes[:, 5] * fy
        inside = np.flatnonzero((first >= 0) & (second >= 0) & (first + second <= 1))
        owner, x, y, planes = owner[inside], x[inside], y[inside], planes[inside, 6:]
        nearness = planes[:, 0] + planes[:, 1] * fx[inside] + planes[:, 2] * fy[inside]
        pixels = (self.top[chunk][owner] + y) * image_width + self.left[chunk][owner] + x
        # Rounding can give the edge of a thin triangle that is seen edge-on any inverse depth.
        return pixels, np.clip(nearness, 1e-6, 1 / NEAREST_M), self.ids[chunk][owner]


def _to_camera(points: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    T_camera_world = inverse(T_world_camera)
    # Not @: for such thin products BLAS would start threads on all cores.
    rotated = np.einsum("ij,kj->ik", points.reshape(-1, 3), T_camera_world[:3, :3])
    return rotated + T_camera_world[:3, 3]


def _in_view(points: np.ndarray, faces: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Faces, and their indices, that are not entirely outside one plane of the view frustum."""
    x, y, z = points.T
    sides = (
        z < NEAREST_M,
        x * camera.fx + (camera.cx + 0.5) * z < 0,
        x * camera.fx + (camera.cx + 0.5 - camera.width) * z > 0,
        y * camera.fy + (camera.cy + 0.5) * z < 0,
        y * camera.fy + (camera.cy + 0.5 - camera.height) * z > 0,
    )
    codes = np.zeros(len(points), dtype=np.uint8)
    for bit, outside in enumerate(sides):
        codes |= outside.astype(np.uint8) << bit
    kept = np.flatnonzero((codes[faces[:, 0]] & codes[faces[:, 1]] & codes[faces[:, 2]]) == 0).astype(np.int32)
    return faces[kept], kept


def _clip(points: np.ndarray, faces: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Clips faces at `NEAREST_M`: corners [T, 3, 3] of the resulting triangles, and their face indices."""
    corners, ids = points[faces[0]], faces[1]
    behind = corners[..., 2] < NEAREST_M
    count = behind.sum(axis=1)
    if not count.any():
        return corners, ids
    whole, one, two = (np.flatnonzero(count == number) for number in range(3))
    # Rotate the corners cyclically, which keeps the orientation, so that the corner alone on its side comes first.
    odd_one, odd_two = _rotated(corners[one], behind[one].argmax(1)), _rotated(corners[two], (~behind[two]).argmax(1))
    left, right = _clip_edge(odd_one[:, 0], odd_one[:, 1]), _clip_edge(odd_one[:, 0], odd_one[:, 2])
    tip = np.stack(
        [odd_two[:, 0], _clip_edge(odd_two[:, 1], odd_two[:, 0]), _clip_edge(odd_two[:, 2], odd_two[:, 0])], axis=1
    )
    parts = [
        corners[whole],
        np.stack([left, odd_one[:, 1], odd_one[:, 2]], axis=1),
        np.stack([left, odd_one[:, 2], right], axis=1),
        tip,
    ]
    return np.concatenate(parts), np.concatenate([ids[whole], ids[one], ids[one], ids[two]])


def _rotated(corners: np.ndarray, first: np.ndarray) -> np.ndarray:
    order = (first[:, None] + np.arange(3)) % 3
    return np.take_along_axis(corners, order[..., None], axis=1)


def _clip_edge(behind: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The points [N, 3] where the edges between points behind and before the near plane cross it."""
    share = (NEAREST_M - behind[:, 2:]) / (before[:, 2:] - behind[:, 2:])
    return behind + share * (before - behind)


def _pixel_range(coordinates: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last pixel center in the extent of a triangle, inside the image; first > last if there is none."""
    a, b, c = coordinates.T  # column by column: NumPy's reductions over three numbers take five times as long
    first = np.clip(np.ceil(np.minimum(np.minimum(a, b), c)), 0, size)
    last = np.clip(np.floor(np.maximum(np.maximum(a, b), c)), -1, size - 1)
    return first.astype(np.int64), last.astype(np.int64)
