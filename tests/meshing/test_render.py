"""The rasterizer against analytic depth."""

import time

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.geometry import pose_from
from spslam.meshing.render import NEAREST_M, rasterize, render_colors, render_mesh
from spslam.meshing.shading import surface
from tests.meshing.ray_caster import cast

CAMERA = Camera(80, 60, 70.0, 65.0, 41.0, 28.5)
HALF_SIZE = np.array([3.0, 2.0, 2.5])
# float32 inverse depth, evaluated as an offset from a corner of the triangle's bounding box.
DEPTH_TOLERANCE = 1e-4
# Pixels on the edge of a face, and of faces seen edge-on, where float32 decides otherwise.
ROUNDED_SHARE = 2e-3
COLOR_TOLERANCE = 1e-3  # of 255: float32 shares of three corners; 2e-4 was the most of 16 meshes


def box(half_size=HALF_SIZE, center=(0, 0, 0)):
    """Twelve triangles, counter-clockwise seen from outside."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads]
    return corners * half_size + center, np.array(faces)


def rotated(angle, position):
    c, s = np.cos(angle), np.sin(angle)
    return pose_from(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.array(position, dtype=float))


def cast_inside(pose):
    """Analytic depth of the walls of the box, seen from inside."""
    directions = CAMERA.ray_directions().astype(np.float64) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        walls = (np.sign(directions) * HALF_SIZE - pose[:3, 3]) / directions
    return np.min(np.where(directions != 0, walls, np.inf), axis=-1)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.1, 2.5, -2.0])
def test_depth_from_inside_a_box_is_accurate(angle):
    # Triangles of the walls extend behind the camera, so this tests clipping too.
    vertices, faces = box()
    pose = rotated(angle, (0.7, -0.4, 0.9))
    raster = rasterize(vertices, faces, CAMERA, pose)
    np.testing.assert_allclose(raster.depth, cast_inside(pose), rtol=DEPTH_TOLERANCE)
    assert (raster.face_ids >= 0).all()


def test_the_nearest_face_is_visible_in_any_order():
    vertices, faces = np.concatenate([box()[0], box((0.2, 0.2, 0.2), (0, 0, 1.5))[0]]), box()[1]
    both = np.concatenate([faces, faces + 8])
    pose = np.eye(4)
    first = rasterize(vertices, both, CAMERA, pose)
    second = rasterize(vertices, both[::-1], CAMERA, pose)
    np.testing.assert_array_equal(first.depth, second.depth)
    assert first.depth[28, 41] == pytest.approx(1.3, rel=DEPTH_TOLERANCE)
    assert first.face_ids[28, 41] >= 12
    assert first.depth[0, 0] == pytest.approx(2.5, rel=DEPTH_TOLERANCE)


def test_back_face_culling_shows_the_inside_of_a_box():
    vertices, faces = box((1, 1, 1), (0, 0, 4))
    inward = faces[:, ::-1]
    near, far = 3.0, 5.0
    for facing, depth in ((faces, near), (inward, far)):
        raster = rasterize(vertices, facing, CAMERA, np.eye(4), cull_back=True)
        assert raster.depth[28, 41] == pytest.approx(depth, rel=DEPTH_TOLERANCE)
    assert rasterize(vertices, inward, CAMERA, np.eye(4)).depth[28, 41] == pytest.approx(near, rel=DEPTH_TOLERANCE)


def triangles(seed, count=60):
    """Triangles all around the camera, many of them through the plane of the lens, and their corners' colors."""
    random = np.random.default_rng(seed)
    corners = random.uniform(-2, 2, (count, 1, 3)) + random.normal(0, 0.7, (count, 3, 3))
    colors = random.integers(0, 256, (3 * count, 3), dtype=np.uint8)
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), colors


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("cull_back", [False, True])
def test_the_rasterizer_sees_what_rays_meet(seed, cull_back):
    points, faces, colors = triangles(seed)
    raster, hits = rasterize(points, faces, CAMERA, np.eye(4), cull_back), cast(points, faces, CAMERA, cull_back)
    same = raster.face_ids == hits.face_ids
    assert same.mean() > 1 - ROUNDED_SHARE
    np.testing.assert_allclose(raster.depth[same], hits.depth[same], rtol=DEPTH_TOLERANCE)
    normals, found = surface(points, faces, colors, CAMERA, raster)
    is_face = same & (hits.face_ids >= 0)
    np.testing.assert_allclose(normals[is_face], hits.normals[is_face], atol=1e-5)
    expected = np.einsum("nk,nkc->nc", hits.shares[is_face], colors[faces[hits.face_ids[is_face]]].astype(float))
    np.testing.assert_allclose(found[is_face], expected, atol=COLOR_TOLERANCE)
    assert not found[raster.face_ids < 0].any()
    if not cull_back:
        image, depth = render_colors(points, faces, colors, CAMERA, np.eye(4))
        np.testing.assert_array_equal(image, np.rint(found))
        np.testing.assert_array_equal(depth, raster.depth)


def test_of_faces_at_one_depth_the_last_is_visible():
    vertices, faces = box((1, 1, 1), (0, 0, 4))
    raster = rasterize(vertices, np.concatenate([faces, faces]), CAMERA, np.eye(4))
    assert (raster.face_ids[raster.face_ids >= 0] >= len(faces)).all()


def test_vertices_that_are_not_finite_show_nothing():
    vertices, faces = box((1, 1, 1), (0, 0, 4))
    for bad in (np.nan, np.inf, -np.inf, 1e300):
        for axis in range(3):
            moved = vertices.astype(float)
            moved[:, axis] = bad
            raster = rasterize(moved, faces, CAMERA, np.eye(4))
            assert (raster.face_ids == -1).all() and not raster.depth.any()


@pytest.mark.parametrize("index", [-1, 8])
def test_a_face_without_its_vertex_is_refused(index):
    vertices, faces = box()
    faces[3, 1] = index
    with pytest.raises(ValueError, match="faces must be indices of 8 vertices, got"):
        rasterize(vertices, faces, CAMERA, np.eye(4))


@pytest.mark.parametrize("shape", [(7, 3), (8, 2), (24,)])
def test_colors_of_other_vertices_are_refused(shape):
    vertices, faces = box()
    for render in (render_mesh, render_colors):
        with pytest.raises(ValueError, match=r"colors must be \[8, 3\], one for each vertex, got"):
            render(vertices, faces, np.zeros(shape, np.uint8), CAMERA, np.eye(4))


def test_color_interpolation_is_perspective_correct():
    # Two triangles of a floor, whose red increases with z.
    vertices = np.array([[-9, 1, 1], [9, 1, 1], [9, 1, 9], [-9, 1, 9]], dtype=float)
    colors = np.array([[0, 100, 0], [0, 100, 0], [200, 100, 0], [200, 100, 0]], dtype=np.uint8)
    image, depth = render_mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), colors, CAMERA, np.eye(4))
    hit = (depth > 1.1) & (depth < 8.9)
    ratio = image[hit][:, 0] / image[hit][:, 1].astype(float)
    np.testing.assert_allclose(ratio, 2 * (depth[hit] - 1) / 8, atol=0.04)  # of 8-bit colors


@pytest.mark.parametrize("colors", [None, np.zeros((0, 3), np.uint8)])
def test_an_empty_mesh_gives_a_white_image(colors):
    image, depth = render_mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), colors, CAMERA, np.eye(4))
    assert image.shape == (60, 80, 3)
    assert (image == 255).all()
    assert not depth.any()


def test_faces_behind_the_camera_out_of_view_or_without_area_are_skipped():
    vertices = np.array(
        [[0, 0, -1], [1, 0, -1], [0, 1, -1], [99, 0, 1], [98, 0, 1], [99, 1, 1], [0, 0, 1]], dtype=float
    )
    faces = np.array([[0, 1, 2], [3, 4, 5], [6, 6, 6]])
    assert not rasterize(vertices, faces, CAMERA, np.eye(4)).depth.any()


def test_depth_is_valid_for_a_camera_on_a_face():
    vertices, faces = box((1, 1, 1))
    raster = rasterize(vertices, faces, CAMERA, rotated(0.2, (0, 0, -1)))
    assert np.isfinite(raster.depth).all()
    assert raster.depth[raster.face_ids >= 0].min() >= NEAREST_M


def test_supersampling_keeps_size_and_depth():
    vertices, faces = box()
    image, depth = render_mesh(vertices, faces, None, CAMERA, rotated(0.4, (0, 0, 0)), supersampling=2)
    assert image.shape == (60, 80, 3)
    assert image.dtype == np.uint8
    np.testing.assert_allclose(depth, cast_inside(rotated(0.4, (0, 0, 0))), atol=0.05)  # half a pixel of offset


def test_a_million_faces_take_seconds():
    side = 708
    u, v = np.meshgrid(np.linspace(-1.5, 1.5, side), np.linspace(-1.2, 1.2, side))
    vertices = np.stack([u, v, 2 + 0.2 * np.sin(4 * u) * np.cos(5 * v)], axis=-1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1, 1)
    faces = np.concatenate([corner + [0, 1, side], corner + [1, side + 1, side]])
    camera = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
    colors = np.full((len(vertices), 3), 128, np.uint8)
    started = time.thread_time()
    _, depth = render_mesh(vertices, faces, colors, camera, np.eye(4))
    assert len(faces) > 999_000
    assert (depth > 0).mean() > 0.9
    assert time.thread_time() - started < 2  # 0.2 s on the machine it was written on
