"""Colors of vertices from frames of known walls: what is seen, where edges are divided, what it is worth."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.meshing import color_detail
from spslam.meshing.color_detail import ColorOptions, color_mesh, keep_colored, thinned
from spslam.meshing.render import render_colors
from spslam.meshing.subdivision import mesh_edges
from spslam.meshing.texture.views import read_views, seen_vertices
from spslam.meshing.visible_points import read_seen
from tests.meshing.painted import CAMERA, FLOOR, GRAY, NOISE, RED, SIGN, WALL, frames, mesh_of, pattern

STEP_M, SQUARE_M = 0.08, 0.12
OPTIONS = ColorOptions(NOISE, 1)


def checkerboard(points):
    """Squares on the left, plain on the right."""
    x, y, _ = np.floor(points / SQUARE_M + 1e-4).T.astype(int)
    light = (x + y) % 2 == 0
    return np.where((points[:, :1] < 0) & light[:, None], 200.0, 60.0).repeat(3, axis=1)[:, :3]


@pytest.fixture(scope="module")
def board():
    return mesh_of(WALL, step_m=STEP_M), frames(WALL, paint=checkerboard, count=24)


def divided_bare(mesh, count):
    """New vertices on the plain half, away from the outline of the wall, where pixels are mixed with what is behind."""
    added = mesh.vertices[count:]
    return added[(added[:, 0] > STEP_M) & (added[:, 0] < 1.1) & (np.abs(added[:, 1]) < 0.7)]


def error(mesh, views):
    """Root mean square of rendered against input images, levels."""
    off = []
    for view in read_views(views, NOISE):
        image, depth = render_colors(mesh.vertices, mesh.faces, mesh.colors, CAMERA, view.pose)
        shown = (depth > 0) & (view.frame.depth > 0)
        off.append(((image.astype(float) - view.frame.color) ** 2)[shown].mean())
    return float(np.sqrt(np.mean(off)))


def test_a_checkerboard_becomes_sharper(board):
    mesh, views = board
    errors = [error(color_mesh(mesh, views, ColorOptions(NOISE, n))[0], [views]) for n in (0, 1, 2)]
    assert errors[1] < 0.8 * errors[0] and errors[2] < 0.8 * errors[1]


def test_a_bare_surface_is_not_divided(board):
    mesh, views = board
    divided, _ = color_mesh(mesh, views, ColorOptions(NOISE, 2))
    noisy, _ = color_mesh(mesh, _Noisy.of(views), ColorOptions(NOISE, 2))
    for each in (divided, noisy):
        assert len(each.vertices) > len(mesh.vertices) + 1000
        assert not len(divided_bare(each, len(mesh.vertices)))


class _Noisy(type(frames(WALL).dataset)):
    """With noise of four levels in each pixel."""

    @classmethod
    def of(cls, views):
        dataset = cls(views.dataset.rectangles, views.poses, paint=views.dataset.paint)
        return replace(views, dataset=dataset)

    def read(self, index):
        frame = super().read(index)
        noise = np.random.default_rng(index).normal(0, 4, frame.color.shape)
        return replace(frame, color=np.clip(np.rint(frame.color + noise), 0, 255).astype(np.uint8))


def test_changes_of_exposure_are_no_detail(board):
    mesh, views = board
    gains = np.linspace(0.8, 1.2, 24)
    divided, _ = color_mesh(mesh, frames(WALL, paint=checkerboard, count=24, gains=gains), OPTIONS)
    assert len(divided.vertices) > len(mesh.vertices) + 300
    assert not len(divided_bare(divided, len(mesh.vertices)))


def test_the_surface_stays_as_it_is(board):
    mesh, views = board
    divided, _ = color_mesh(mesh, views, ColorOptions(NOISE, 2))
    assert np.array_equal(divided.vertices[: len(mesh.vertices)], mesh.vertices)
    before, after = (mesh_edges(each.faces, len(each.vertices)) for each in (mesh, divided))
    for each, edges in ((mesh, before), (divided, after)):
        assert len(each.vertices) - len(edges.ends) + len(each.faces) == 1  # Euler's number of a disk
    outline = [np.bincount(edges.of_faces.ravel()) for edges in (before, after)]
    assert all(set(counts) == {1, 2} for counts in outline)
    lengths = [
        np.linalg.norm(np.diff(each.vertices[edges.ends[counts == 1]], axis=1), axis=2).sum()
        for each, edges, counts in zip((mesh, divided), (before, after), outline, strict=True)
    ]
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-5)


def test_the_same_frames_give_the_same_colors(board):
    one, two = (color_mesh(*board, OPTIONS)[0] for _ in range(2))
    assert all(np.array_equal(getattr(one, name), getattr(two, name)) for name in vars(one))


@pytest.mark.parametrize("without_depth", [False, True])
def test_what_stands_before_a_wall_does_not_color_it(without_depth):
    scene = WALL, SIGN
    colored, _ = color_mesh(mesh_of(*scene, step_m=0.02), frames(*scene, without_depth=without_depth), OPTIONS)
    x, y, z = np.abs(colored.vertices.T)
    wall = (z > 1.9) & (x < 1.0) & (y < 0.6)
    off = np.abs(colored.colors[wall] - pattern(colored.vertices[wall])).max(1)
    assert off.max() < 40 and (off < 10).mean() > 0.98  # a pixel at the sign's outline has both
    sign = (z < 1.6) & (x < 0.17) & (colored.vertices[:, 1] > -0.27) & (colored.vertices[:, 1] < 0.07)
    assert sign.sum() > 100 and (colored.colors[sign] == RED).all()


def test_seen_points_are_those_that_no_rectangle_hides():
    scene = WALL, FLOOR, SIGN
    mesh = mesh_of(*scene, step_m=0.02)
    surface = ops.SurfacePoints.of(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.normals))
    views = frames(*scene)
    for view, (_, weights) in zip(read_views([views], NOISE), read_seen(surface, [views], NOISE), strict=True):
        seen = weights.numpy() > 0
        wanted = plainly_seen(mesh, view, scene)
        wanted[mesh.vertices[:, 1] > 0.79] = -1  # between wall and floor
        assert seen[wanted == 1].mean() > 0.995
        assert not seen[wanted == 0].any()


def test_pixels_that_are_left_out_color_nothing():
    """Something moves along before the camera there: what lies behind is not seen, as it is where depth is unknown."""
    mesh, views, left_out = mesh_of(WALL, step_m=0.02), frames(WALL), np.zeros((CAMERA.height, CAMERA.width), bool)
    left_out[:, : CAMERA.width // 2] = True
    surface = ops.SurfacePoints.of(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.normals))
    before = [weights.numpy() for _, weights in read_seen(surface, [views], NOISE)]
    views.dataset.left_out = left_out
    after = [weights.numpy() for _, weights in read_seen(surface, [views], NOISE)]
    for view, one, other in zip(read_views([views], NOISE), before, after, strict=True):
        column = view.project(mesh.vertices)[0]
        is_out, is_left = column < CAMERA.width // 2 - 0.6, column > CAMERA.width // 2 - 0.4
        assert (one[is_out] > 0).any()
        assert not other[is_out].any()
        np.testing.assert_array_equal(other[is_left], one[is_left])
        assert not is_out[seen_vertices(mesh, view).ids].any()


def plainly_seen(mesh, view, rectangles):
    """For each vertex 1 where it is seen, 0 where it is far outside or far behind something, -1 between."""
    points = mesh.vertices.astype(np.float64)
    local = (points - view.pose[:3, 3]) @ view.pose[:3, :3]
    u, v = (local[:, :2] / local[:, 2:] * CAMERA.fx).T + np.array([[CAMERA.cx], [CAMERA.cy]])
    margin = np.minimum.reduce([u, v, CAMERA.width - 1 - u, CAMERA.height - 1 - v])
    margin[local[:, 2] < 0.05] = -1
    seen = np.where(margin >= 1, 1, np.where(margin < 0, 0, -1))
    for corner, a, b, _ in rectangles:
        normal = np.cross(a, b)
        rays = points - view.pose[:3, 3]
        along = rays @ normal
        share = ((corner - view.pose[:3, 3]) @ normal) / np.where(along == 0, 1e-9, along)
        at = view.pose[:3, 3] + share[:, None] * rays
        inset = np.minimum.reduce([each for s in (a, b) for each in _insets((at - corner) @ s / np.linalg.norm(s), s)])
        before = (share > 0) & (share < 1 - 1e-3)
        seen[before & (inset > -0.1)] = np.where((inset > 0.08) & (share < 0.9), 0, -1)[before & (inset > -0.1)]
    return seen


def _insets(along, side):
    return along, np.linalg.norm(side) - along


def test_vertices_that_no_frame_sees_keep_their_color():
    mesh = mesh_of(WALL, (np.array([-1.2, -0.8, 2.5]), np.array([0, 1.6, 0.0]), np.array([2.4, 0, 0.0]), False))
    colored, used = color_mesh(mesh, frames(WALL, broken=(3,)), OPTIONS)
    hidden = colored.vertices[:, 2] > 2.4
    assert hidden.any() and (colored.colors[hidden] == GRAY).all() and used == 11
    unread, used = color_mesh(mesh, frames(WALL, broken=range(12)), OPTIONS)
    assert np.array_equal(unread.faces, mesh.faces) and (unread.colors == GRAY).all() and used == 0


def test_frames_that_are_looked_at_again_are_read_once(board, monkeypatch):
    mesh, views = board
    meshes, reads = [], []
    for kept_bytes in (1 << 27, 0):
        monkeypatch.setattr(color_detail, "_KEPT_BYTES", kept_bytes)
        counting = _Counting.of(views)
        meshes.append(color_mesh(mesh, counting, ColorOptions(NOISE, 2))[0])
        reads.append(len(counting.dataset.indices))
    assert reads == [24, 3 * 24]
    assert np.array_equal(meshes[0].colors, meshes[1].colors)
    assert np.array_equal(meshes[0].vertices, meshes[1].vertices)


def test_frames_that_fusion_has_read_are_not_read_again(board):
    mesh, views = board
    counting = _Counting.of(views)
    kept = keep_colored([counting])
    for position in range(len(views)):
        assert np.array_equal(kept[0].depth(position), kept[0][position].depth)
    before = len(counting.dataset.indices)
    colored, _ = color_mesh(mesh, kept, OPTIONS)
    assert len(counting.dataset.indices) == before
    assert np.array_equal(colored.colors, color_mesh(mesh, _Counting.of(views), OPTIONS)[0].colors)


def test_surveyed_frames_are_kept_first(board, monkeypatch):
    views = board[1]
    many = replace(views, indices=np.arange(960), poses=views.poses[[0]].repeat(960, axis=0))
    image = CAMERA.width * CAMERA.height * 7
    monkeypatch.setattr(color_detail, "_KEPT_BYTES", 50 * image)
    wanted = keep_colored([many])[0].wanted
    assert len(wanted) == 50 and {index for index in range(960) if index % 40 == 0} <= wanted


class _Counting(_Noisy):
    """Tells what was read."""

    def read(self, index):
        self.__dict__.setdefault("indices", []).append(index)
        return super().read(index)


def test_every_so_many_th_frame_through_all_parts():
    parts = [frames(WALL, count=7), frames(WALL, count=8)]
    kept = thinned(parts, 5)
    assert [part.indices.tolist() for part in kept] == [[0, 5], [3]]
    assert np.array_equal(kept[1].poses, parts[1].poses[[3]])


def test_an_empty_mesh_stays_empty():
    mesh = mesh_of(WALL)
    empty = replace(
        mesh, vertices=mesh.vertices[:0], faces=mesh.faces[:0], colors=mesh.colors[:0], normals=mesh.normals[:0]
    )
    colored, _ = color_mesh(empty, frames(WALL, count=2), OPTIONS)
    assert len(colored.vertices) == len(colored.faces) == 0
