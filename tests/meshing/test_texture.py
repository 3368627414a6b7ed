"""Textures baked from frames of a known pattern: what is recovered, at borders of charts, at edges, at exposures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from spslam.errors import DatasetError, SpslamError
from spslam.meshing import TriangleMesh
from spslam.meshing.texture import TextureOptions, atlas, bake, texture_mesh, texturing
from spslam.meshing.texture.bake import Corrections, ViewWeights
from spslam.meshing.texture.registration import register
from spslam.meshing.texture.sharpness import _slope, sharpness
from spslam.meshing.texture.views import BestViews, ColorView, read_views
from tests.meshing.painted import CAMERA, FLOOR, GRAY, NOISE, SIGN, WALL, Painted, frames, mesh_of, pattern

TEXEL_M = 0.008
CORNER = WALL, FLOOR
OPTIONS = TextureOptions(NOISE, TEXEL_M)


@pytest.fixture(scope="module")
def corner():
    return texture_mesh(mesh_of(*CORNER), frames(*CORNER), OPTIONS)


def surface_colors(textured, seed=0):
    """Random points of all faces, and the texture's colors there."""
    weights = np.random.default_rng(seed).dirichlet(np.ones(3), len(textured.faces)).astype(np.float32)
    points = np.einsum("nk,nkc->nc", weights, textured.vertices[textured.faces])
    return points, textured.colors_at(np.arange(len(textured.faces)), weights)


def rms(colors, points, inset_m=0.1):
    """Against the pattern, of points that frames must have seen."""
    inside = (np.abs(points[:, 0]) < 1.2 - inset_m) & (points[:, 1] > -0.8 + inset_m) & (points[:, 2] > 1.1)
    assert inside.sum() > 1000
    return float(np.sqrt(np.mean((colors - pattern(points))[inside] ** 2)))


def test_the_pattern_is_recovered(corner):
    points, colors = surface_colors(corner)
    assert rms(colors, points) < 2.5
    assert corner.texel_m == corner.wanted_texel_m == TEXEL_M


def test_both_sides_of_a_border_have_the_same_colors(corner):
    """The wall and the floor are charts of their own; the vertices between them are in both."""
    points = corner.vertices.round(5)
    corners = np.eye(3, dtype=np.float32)
    colors = np.zeros((len(points), 3))
    for corner_number in range(3):
        shown = corner.colors_at(np.arange(len(corner.faces)), np.tile(corners[corner_number], (len(corner.faces), 1)))
        colors[corner.faces[:, corner_number]] = shown
    _, group, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    starts = np.cumsum(counts) - counts
    doubled = np.flatnonzero(counts == 2)
    assert len(doubled) > 50
    first, second = colors[order[starts[doubled]]], colors[order[starts[doubled] + 1]]
    assert np.abs(first - second).max() < 4 and np.abs(first - second).mean() < 0.5


def test_smaller_copies_of_the_pages_do_not_bleed(corner):
    """A texel of half the size mixes four; beyond a chart there is its own color."""
    half = np.stack([cv2.resize(page, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for page in corner.pages])
    points, colors = surface_colors(replace(corner, pages=half))
    assert rms(colors, points) < 5
    inside = (np.abs(points[:, 0]) < 1.1) & (points[:, 1] > -0.7) & (points[:, 2] > 1.1)
    assert np.abs(colors - pattern(points))[inside].max() < 16


@pytest.mark.parametrize("without_depth", [False, True])
def test_what_stands_before_a_wall_does_not_color_it(without_depth):
    scene = (WALL, SIGN)
    textured = texture_mesh(mesh_of(*scene), frames(*scene, without_depth=without_depth), OPTIONS)
    points, colors = surface_colors(textured)
    on_wall = (points[:, 2] > 1.9) & (np.abs(points[:, 0]) < 1.0) & (np.abs(points[:, 1]) < 0.6)
    off = np.abs(colors - pattern(points)).max(1)[on_wall]
    # All of the wall was seen past the sign.
    assert np.mean(off > 30) < (0.01 if not without_depth else 0.04)
    on_sign = (points[:, 2] < 1.6) & (np.abs(points[:, 0]) < 0.15) & (points[:, 1] > -0.25) & (points[:, 1] < 0.05)
    assert np.abs(colors[on_sign] - (250, 20, 20)).max() < 3


def test_exposures_are_compensated():
    gains = np.where(np.arange(12) < 6, 0.7, 1.2)
    plain = texture_mesh(mesh_of(WALL), frames(WALL), OPTIONS)
    exposed = texture_mesh(mesh_of(WALL), frames(WALL, gains=gains), OPTIONS)
    points, colors = surface_colors(exposed)
    inside = (np.abs(points[:, 0]) < 1.1) & (np.abs(points[:, 1]) < 0.6)
    ratio = colors[inside] / surface_colors(plain)[1][inside]
    # One factor everywhere, though the left half was seen by other frames than the right one.
    assert ratio.std() < 0.03 * ratio.mean()
    assert 0.8 < ratio.mean() < 1.05


def test_surface_that_no_frame_saw_has_its_own_color_without_a_step():
    far = (np.array([1.2, -0.8, 2.0]), np.array([0, 1.6, 0.0]), np.array([6.0, 0, 0.0]), False)
    textured = texture_mesh(mesh_of(WALL, far), frames(WALL, far), OPTIONS)
    points, colors = surface_colors(textured)
    assert np.abs(colors[points[:, 0] > 6.5] - GRAY).max() < 8
    # From one face to the next nothing jumps.
    level = np.abs(points[:, 1]) < 0.3
    order = np.argsort(points[level, 0])
    smooth = cv2.blur(colors[level][order][None], (41, 1))[0]
    assert np.abs(np.diff(smooth, axis=0)).max() < 8


def test_the_same_input_gives_the_same_bytes(corner):
    again = texture_mesh(mesh_of(*CORNER), frames(*CORNER), OPTIONS)
    assert all(np.array_equal(getattr(corner, name), getattr(again, name)) for name in vars(corner))


def test_frames_that_cannot_be_read_are_left_out():
    textured = texture_mesh(mesh_of(WALL), frames(WALL, broken=(0, 5)), OPTIONS)
    points, colors = surface_colors(textured)
    assert rms(colors, points) < 3
    with pytest.raises(DatasetError, match="painted: a texture is made of frames, none of which can be read"):
        texture_mesh(mesh_of(WALL), frames(WALL, broken=range(12)), TextureOptions(NOISE))


def test_texels_are_as_fine_as_the_images_saw():
    textured = texture_mesh(mesh_of(WALL), frames(WALL), TextureOptions(NOISE))
    assert 1.9 / 130 / 2 < textured.texel_m < 1.9 / 130


def test_larger_texels_where_pages_are_full(monkeypatch):
    monkeypatch.setattr(atlas, "MOST_PAGE_PX", 128)
    monkeypatch.setattr(atlas, "TILE_PX", 48)
    textured = texture_mesh(mesh_of(*CORNER), frames(*CORNER), TextureOptions(NOISE, 0.004, most_pages=2))
    assert textured.wanted_texel_m == 0.004 < textured.texel_m
    assert textured.pages.shape[0] == 2 and max(textured.pages.shape[1:3]) <= 128
    points, colors = surface_colors(textured)
    assert rms(colors, points) < 6


def test_finer_texels_wanted_are_no_coarser_ones(monkeypatch):
    """Of a rough surface, which squares of few texels cut into single faces, each with a border of its own."""
    monkeypatch.setattr(atlas, "MOST_PAGE_PX", 1024)
    even = mesh_of(*CORNER)
    rough = even.vertices + np.random.default_rng(0).normal(scale=0.02, size=even.vertices.shape).astype(np.float32)
    mesh = replace(even, vertices=rough)
    made = [atlas.make_atlas(mesh, texel_m, 1).texel_m for texel_m in (2e-3, 1e-4, 1e-6)]
    assert made[0] > 2e-3 and max(made) < 1.1 * made[0]


def test_a_face_is_on_one_page_however_fine_the_texels_wanted():
    vertices = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]], np.float32)
    blank = np.zeros((3, 3))
    mesh = TriangleMesh(vertices, np.array([[0, 1, 2]], np.int32), blank.astype(np.uint8), blank.astype(np.float32))
    made = atlas.make_atlas(mesh, 1e-5, 4)
    assert 1e-5 < made.texel_m < 2e-5 and made.pages == 1
    assert made.corners_px.min() >= 0 and made.corners_px.max() < atlas.MOST_PAGE_PX
    assert atlas.find_texels(made).places.max() < made.size[0] * made.size[1]


def test_large_faces_are_looked_at_in_parts(monkeypatch):
    """By bands of rows, and texels by some hundred: memory follows neither, and the same face has each texel."""
    mesh, views = mesh_of(WALL, step_m=2), [frames(WALL)]
    made = atlas.make_atlas(mesh, 0.02, 1)
    weights, corrections = (
        ViewWeights(BestViews(len(mesh.vertices), 2)),
        Corrections(np.ones((12, 3)), [np.eye(3)] * 12),
    )
    monkeypatch.setattr(weights, "of", lambda number: np.linspace(0.5, 1, len(mesh.vertices), dtype=np.float32))
    results = []
    for count in (1 << 20, 700):
        monkeypatch.setattr(atlas, "_FRAGMENTS", count)
        monkeypatch.setattr(bake, "_CHUNK", count)
        texels = atlas.find_texels(made)
        assert np.diff(texels.starts).min() > 3 * 700
        (sums,) = bake.accumulate(mesh, [texels], read_views(views, NOISE), weights, corrections)
        results.append((texels.places, texels.faces, texels.weights, sums))
    assert results[0][3][:, 3].max() > 6
    assert all(np.array_equal(one, other) for one, other in zip(*results, strict=True))
    _, _, extent = atlas._bands(made.corners_px[made.charts.faces].astype(np.float64))
    assert len(extent) > 6 and extent.prod(1).max() <= 700


@pytest.mark.parametrize(
    "corners", [np.eye(3), -np.eye(3), np.eye(3)[::-1], np.diag([1, 1, -1]), np.diag([1, 1, 1.01])]
)
def test_a_plane_keeps_its_size_whatever_its_normal(corners):
    """Also where its coordinates are equal, so that in any other order they are the same normal."""
    vertices, blank = corners.astype(np.float32), np.zeros((3, 3))
    mesh = TriangleMesh(vertices, np.array([[0, 1, 2]], np.int32), blank.astype(np.uint8), blank.astype(np.float32))
    charts = atlas.make_atlas(mesh, 0.01, 1).charts
    places, own = charts.places_m[charts.faces[0]], vertices[charts.vertices[charts.faces[0]]]
    sides = [np.linalg.norm(each - np.roll(each, 1, axis=0), axis=1) for each in (places, own)]
    assert sides[0] == pytest.approx(sides[1], rel=1e-4)


def test_views_that_are_equally_good_count_equally():
    best = BestViews(2, 3)
    for number in range(5):
        best.add(number, np.array([0]), np.array([4.0], np.float32))
    weights = ViewWeights(best)
    # One that no frame saw counts nothing.
    assert sorted(tuple(weights.of(number)) for number in range(5)) == [(0, 0)] * 3 + [(1, 0)] * 2
    best = BestViews(1, 3)
    for number, score in enumerate((4.0, 2.0, 3.0, 1.0)):
        best.add(number, np.array([0]), np.array([score], np.float32))
    weights = ViewWeights(best)
    assert [float(weights.of(number)[0]) for number in range(4)] == [1, 0, 0.5, 0]


def test_more_charts_than_pages_have_room_for_are_refused(monkeypatch):
    monkeypatch.setattr(atlas, "MOST_PAGE_PX", 8)
    with pytest.raises(SpslamError, match="more than 1 pages .* charts; a coarser mesh"):
        atlas.make_atlas(mesh_of(*CORNER), 0.004, 1)


def test_layers_over_each_other_have_their_own_texels():
    """A sheet that is rolled up twice: all of it faces the axis, and half of it lies over the other half."""
    turns, rows = np.linspace(0, 4 * np.pi, 400), np.linspace(0, 0.4, 12)
    angle, along = (each.ravel() for each in np.meshgrid(turns, rows, indexing="ij"))
    radius = 0.5 + 0.03 * angle
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), along], 1).astype(np.float32)
    first = (np.arange(399)[:, None] * 12 + np.arange(11)).ravel()
    faces = np.concatenate([np.stack([first, first + 13, first + 12], 1), np.stack([first, first + 1, first + 13], 1)])
    blank = np.zeros((len(vertices), 3))
    mesh = TriangleMesh(vertices, faces.astype(np.int32), blank.astype(np.uint8), blank.astype(np.float32))
    made = atlas.make_atlas(mesh, 0.005, 1)
    texels = atlas.find_texels(made)
    corners = made.corners_px[made.charts.faces]
    sides = corners[:, 1:] - corners[:, :1]
    areas = 0.5 * np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    own = np.diff(texels.starts)
    # With two faces at one place one of them would have none.
    assert np.mean(own[areas > 3] == 0) == 0
    assert len(np.unique(texels.places)) == len(texels.places)


class Moved(Painted):
    """Color images that are off by some pixels and turned by a degree, each in its own way."""

    def read(self, index):
        frame = super().read(index)
        motion = cv2.getRotationMatrix2D((80, 60), (-1) ** index * 0.8, 1.0)
        motion[:, 2] += (3 * (-1) ** (index // 2), 2 * (-1) ** (index // 3))
        size = frame.color.shape[1::-1]
        return replace(frame, color=cv2.warpAffine(frame.color, motion, size, borderMode=cv2.BORDER_REPLICATE))


def test_images_that_are_off_are_brought_to_each_other(monkeypatch):
    plain = frames(WALL)
    moved = replace(plain, dataset=Moved((WALL,), plain.poses))
    mesh = mesh_of(WALL)
    mesh = replace(mesh, colors=np.rint(pattern(mesh.vertices)).clip(0, 255).astype(np.uint8))
    points, colors = surface_colors(texture_mesh(mesh, moved, OPTIONS))
    registered = rms(colors, points)
    monkeypatch.setattr(texturing, "register", lambda view, places, gray, start: start)
    points, colors = surface_colors(texture_mesh(mesh, moved, OPTIONS))
    assert registered < 6 and 1.5 * registered < rms(colors, points)


def test_nothing_to_register_by_leaves_images_where_they_are():
    frame = frames(WALL)[6]
    view = ColorView(0, frame, CAMERA, np.eye(4), NOISE)
    v, u = (each.ravel() for each in np.mgrid[20:100:2, 20:140:2])
    places = np.stack([u, v, np.ones_like(u)], 1).astype(np.float32)
    start = np.eye(3) + [[0, 0, 0.5], [0, 0, 0], [0, 0, 0]]
    assert register(view, places, np.full(len(u), 90, np.float32), start) is start
    assert register(view, places[:50], np.arange(50, dtype=np.float32), start) is start
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)[v, u].astype(np.float32)
    middle = np.array([79.5, 59.5, 1])
    assert np.abs(register(view, places, gray, start) @ middle - middle).max() < 0.2


def test_slopes_do_not_depend_on_where_images_are_in_memory():
    gray = np.random.default_rng(0).normal(size=(120, 160)).astype(np.float32)
    held = [(np.empty(100 * count + 1, np.uint8), _slope(gray)) for count in range(100)]
    assert len({slope.tobytes() for _, slope in held}) == 1


def test_sharpness_tells_blur_and_not_contrast():
    image = np.kron(np.random.default_rng(0).integers(40, 200, (12, 16, 3)), np.ones((10, 10, 1))).astype(np.uint8)
    blurred = cv2.GaussianBlur(image, (0, 0), 2.0)
    assert sharpness(image) > 1.3 * sharpness(blurred)
    assert sharpness((image // 2).astype(np.uint8)) == pytest.approx(sharpness(image), rel=0.02)
    assert sharpness(np.zeros((20, 30, 3), np.uint8)) == 1
