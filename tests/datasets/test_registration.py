"""Color and depth from two cameras become one camera's: held against the room rendered from where each of them is."""

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.lens import Lens
from spslam.datasets.recording import Calibration, FrameGeometry
from spslam.datasets.registration import ColorToDepth, DepthToColor, is_same_view
from spslam.errors import DatasetError
from spslam.geometry import inverse
from tests.datasets.cameras import BROWN, FISHEYE, camera, extrinsics, path, render

COLOR, DEPTH = camera(320, 180, 0.5), camera(160, 120, 0.8)
POSE = path(60)[50]


def both(color_lens, depth_lens, color_from_depth, pose=POSE):
    """The images of two cameras, of which the depth camera has the pose."""
    color, _ = render(color_lens, pose @ inverse(color_from_depth))
    return color, render(depth_lens, pose)[1]


def visible_to_color(depth, color_from_depth):
    """The truth by the renderer: whether the color camera's own exact depth is that of each pixel's point."""
    points = DEPTH.unproject(depth).reshape(-1, 3).astype(float) @ color_from_depth[:3, :3].T + color_from_depth[:3, 3]
    u, v = COLOR.project(points).T
    inside = (u > 0) & (u < COLOR.width - 1) & (v > 0) & (v < COLOR.height - 1)
    _, seen = render(Lens(COLOR), POSE @ inverse(color_from_depth))
    at_point = seen[np.rint(np.where(inside, v, 0)).astype(int), np.rint(np.where(inside, u, 0)).astype(int)]
    share = points[:, 2] / at_point
    return (
        inside.reshape(depth.shape),
        (inside & (share < 1.02)).reshape(depth.shape),
        (share > 1.3).reshape(depth.shape),
    )


def overlap(truth, source, target, target_from_source):
    """Share of the pixels of a camera whose true points lie in another camera's image."""
    points = source.unproject(truth).reshape(-1, 3) @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    u, v = target.project(points).T
    return ((u > 0) & (u < target.width - 1) & (v > 0) & (v < target.height - 1)).mean()


@pytest.mark.parametrize("far", [False, True])
def test_color_comes_to_depth(far):
    color_from_depth = extrinsics((0.25, 0.02, 0.03) if far else (0.05, -0.004, 0.01))
    color, depth = both(Lens(COLOR), Lens(DEPTH), color_from_depth)
    found, kept = ColorToDepth(COLOR, DEPTH, color_from_depth)(color, depth)
    true_color, _ = render(Lens(DEPTH), POSE)
    inside, visible, hidden = visible_to_color(depth, color_from_depth)
    assert set(np.unique(kept[kept != depth])) <= {0}
    assert not kept[inside & hidden].any()
    assert hidden[inside].sum() > (200 if far else 20)
    assert (kept[visible] > 0).mean() > (0.9 if far else 0.95)
    difference = np.abs(found.astype(int) - true_color).max(axis=-1)
    assert np.median(difference[kept > 0]) <= 3
    assert (difference[kept > 0] < 25).mean() > 0.97


@pytest.mark.parametrize("far", [False, True])
def test_depth_comes_to_color(far):
    color_from_depth = extrinsics((0.25, 0.02, 0.03) if far else (0.05, -0.004, 0.01))
    color, depth = both(Lens(COLOR), Lens(DEPTH), color_from_depth)
    same, found = DepthToColor(COLOR, DEPTH, color_from_depth)(color, depth)
    _, truth = render(Lens(COLOR), POSE @ inverse(color_from_depth))
    assert same is color
    known = found > 0
    error = np.abs(found - truth)[known]
    assert np.median(error) < 2e-4
    assert (error < 0.02).mean() > (0.92 if far else 0.96)
    assert known.mean() > (0.93 if far else 0.97) * overlap(truth, COLOR, DEPTH, inverse(color_from_depth))


def test_nearest_surface_counts():
    """A near square before a wall, seen by cameras side by side: the wall behind it must not come through."""
    depth = np.full((120, 160), 3.0, np.float32)
    depth[40:80, 60:100] = 0.8
    shift = np.eye(4)
    shift[0, 3] = 0.15
    color = np.zeros((180, 320, 3), np.uint8)
    _, found = DepthToColor(COLOR, DEPTH, shift)(color, depth)
    u = (0.15 + 0.8 * (80 - DEPTH.cx) / DEPTH.fx) / 0.8 * COLOR.fx + COLOR.cx
    v = (60 - DEPTH.cy) / DEPTH.fy * COLOR.fy + COLOR.cy
    square = found[int(v) - 20 : int(v) + 20, int(u) - 20 : int(u) + 20]
    np.testing.assert_allclose(square, 0.8, rtol=1e-4)
    assert (np.isclose(found, 0) | np.isclose(found, 0.8, rtol=1e-4) | np.isclose(found, 3, rtol=1e-4)).all()
    _, kept = ColorToDepth(COLOR, DEPTH, shift)(color, depth)
    assert (kept[40:80, 60:100] > 0).all()
    behind = slice(
        100, 100 + int(0.15 * DEPTH.fx * (1 / 0.8 - 1 / 3)) - 2
    )  # the square hides this from the color camera
    assert not kept[45:75, behind].any()
    assert (kept[:, :55] > 0).all()
    assert (kept[:30] > 0)[:, :140].all()


def test_images_without_depth_have_none_afterwards():
    color, depth = np.full((180, 320, 3), 7, np.uint8), np.zeros((120, 160), np.float32)
    for kind in (ColorToDepth, DepthToColor):
        image, found = kind(COLOR, DEPTH, extrinsics())(color, depth)
        assert image.any()
        assert not found.any()


PHONE = Camera(1920, 1440, 1590.0, 1590.0, 958.0, 722.0)


def test_a_phones_color_is_brought_to_the_size_of_its_depth():
    """1920x1440 with 256x192 of the same view."""
    small = PHONE.resized(256, 192)
    assert is_same_view(PHONE, small, np.eye(4))
    color, _ = render(Lens(PHONE.resized(960, 720)), POSE)
    color = color.repeat(2, axis=0).repeat(2, axis=1)
    true_color, depth = render(Lens(small), POSE)
    geometry = FrameGeometry(Calibration.of_one_view(Lens(PHONE), (256, 192)))
    assert geometry.camera == small
    found, kept = geometry(color, depth, "frame")
    assert kept is depth
    assert np.median(np.abs(found.astype(int) - true_color)) <= 2
    wide = FrameGeometry(Calibration.of_one_view(Lens(PHONE), (256, 192)), "color")
    assert wide.camera == PHONE
    _, large = wide(color, depth, "frame")
    _, truth = render(Lens(PHONE.resized(960, 720)), POSE)
    error = np.abs(large[::2, ::2] - truth)[large[::2, ::2] > 0]
    assert np.median(error) < 5e-3  # rows 0, 2, ... lie a quarter of a pixel beside the smaller camera's
    assert (large > 0).mean() > 0.97


@pytest.mark.parametrize("view", ["depth", "color"])
@pytest.mark.parametrize(
    ("color_lens", "depth_lens"),
    [
        (Lens(COLOR, "brown", BROWN), Lens(DEPTH)),
        (Lens(COLOR, "fisheye", FISHEYE), Lens(DEPTH, "brown", BROWN)),
    ],
    ids=["brown", "fisheye and brown"],
)
def test_lenses_and_places_together(color_lens, depth_lens, view):
    color_from_depth = extrinsics()
    color, depth = both(color_lens, depth_lens, color_from_depth)
    geometry = FrameGeometry(Calibration(color_lens, depth_lens, color_from_depth), view)
    found, kept = geometry(color, depth, "frame")
    np.testing.assert_array_equal(geometry.depth(depth, "frame"), kept)
    pose = POSE @ inverse(color_from_depth) @ geometry.color_from_camera
    true_color, truth = render(Lens(geometry.camera), pose)
    known = kept > 0
    to_other = inverse(color_from_depth) if view == "color" else color_from_depth
    assert known.mean() > 0.93 * overlap(truth, geometry.camera, DEPTH if view == "color" else COLOR, to_other)
    error = np.abs(kept - truth)[known]
    assert np.median(error) < 3e-4
    assert (error < 0.02).mean() > 0.94
    difference = np.abs(found.astype(int) - true_color).max(axis=-1)[known]
    assert np.median(difference) <= 4


def test_one_camera_without_distortion_is_left_alone():
    geometry = FrameGeometry(Calibration(Lens(DEPTH), Lens(DEPTH)))
    color, depth = np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32)
    same_color, same_depth = geometry(color, depth, "frame")
    assert same_color is color
    assert same_depth is depth


def test_an_image_of_another_size_is_named():
    geometry = FrameGeometry(Calibration(Lens(COLOR), Lens(DEPTH), extrinsics()))
    color, depth = np.zeros((180, 320, 3), np.uint8), np.ones((60, 80), np.float32)
    with pytest.raises(DatasetError, match="frame 3: the depth image must be as large as its camera, 160x120, got 80x"):
        geometry(color, depth, "frame 3")
    with pytest.raises(DatasetError, match="frame 3: the depth image must be as large as its camera, 160x120, got 80x"):
        geometry.depth(depth, "frame 3")
    with pytest.raises(DatasetError, match="frame 3: the color image must be as large as its camera, 320x180, got 160"):
        geometry(color[:, ::2], depth, "frame 3")


PINCUSHION = (0.3, 0.05, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("view", ["depth", "color"])
@pytest.mark.parametrize("depth_camera", [DEPTH, COLOR, COLOR.resized(160, 90)], ids=["beside", "same", "smaller"])
def test_depth_where_a_lens_leaves_no_color_is_missing(depth_camera, view):
    color_lens, place = Lens(COLOR, "brown", PINCUSHION), extrinsics() if depth_camera is DEPTH else np.eye(4)
    geometry = FrameGeometry(Calibration(color_lens, Lens(depth_camera), place), view)
    color = np.full((COLOR.height, COLOR.width, 3), 90, np.uint8)
    depth = np.full((depth_camera.height, depth_camera.width), 2.0, np.float32)
    _, plain = FrameGeometry(Calibration(Lens(COLOR), Lens(depth_camera), place), view)(color, depth, "frame")
    _, kept = geometry(color, depth, "frame")
    np.testing.assert_array_equal(geometry.depth(depth, "frame"), kept)
    assert (kept > 0).sum() < (plain > 0).sum()
    middle = slice(geometry.camera.height // 3, 2 * geometry.camera.height // 3)
    across = slice(geometry.camera.width // 3, 2 * geometry.camera.width // 3)
    np.testing.assert_array_equal(kept[middle, across], plain[middle, across])


def test_points_just_before_the_color_camera_are_off_its_image():
    """Their columns are beyond 32 bits."""
    color_from_depth = extrinsics((0.0, 0.0, -0.5))
    depth = np.full((DEPTH.height, DEPTH.width), 2.0, np.float32)
    depth[::2, ::3] = np.nextafter(np.float32(0.5), np.float32(1))
    color = np.zeros((COLOR.height, COLOR.width, 3), np.uint8)
    _, kept = ColorToDepth(COLOR, DEPTH, color_from_depth)(color, depth)
    assert not kept[::2, ::3][:, :10].any() and (kept > 1).any()
