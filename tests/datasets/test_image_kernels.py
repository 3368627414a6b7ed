"""The compiled registration of color against the same in NumPy."""

import pickle

import cv2
import numpy as np
import pytest

from spslam import image_library
from spslam.camera import Camera
from spslam.datasets.image_kernels import ColorView, register_color
from spslam.datasets.registration import ColorToDepth, typical_depth
from spslam.geometry import pose_from
from tests.datasets.registration_reference import color_to_depth

# Places between two pixels are known to 1/64 px, by rounding, along either axis; colors are whole numbers, and those
# between the rows quarters.
LEVELS = 2 * 255 / 128 + 0.5 + 0.125
# Points on the border between two cells may fall into either by the rounding of float32.
ROUNDED_SHARE = 1e-3


def cameras(color_size, depth_size):
    """A color camera that sees a little more than the depth camera."""
    (color_width, color_height), (width, height) = color_size, depth_size
    focal = 0.9 * width
    by_u, by_v = color_width / width, color_height / height
    color = Camera(
        color_width, color_height, 0.87 * focal * by_u, 0.87 * focal * by_v, color_width / 2, color_height / 2
    )
    return color, Camera(width, height, focal, 1.02 * focal, 0.48 * width, 0.52 * height)


def images(color_size, depth_size, seed=0):
    """Noise for color, and boxes before a slanted wall, with pixels that were not measured."""
    random = np.random.default_rng(seed)
    color = random.integers(0, 256, (color_size[1], color_size[0], 3), dtype=np.uint8)
    rows, columns = np.indices(depth_size[::-1])
    depth = (3 + columns / depth_size[0] - rows / depth_size[1]).astype(np.float32)
    depth[(columns // 9 + rows // 7) % 5 == 0] = 0.8
    depth[random.random(depth.shape) < 0.1] = 0
    return color, depth


BESIDE = np.eye(4)
BESIDE[:3, 3] = -0.026, 0.002, 0.01
TURN = cv2.Rodrigues(np.array([0.02, -0.03, 0.05]))[0]
TURNED = pose_from(TURN, np.array([0.1, 0.02, -0.05]))
ROTATED = pose_from(TURN, np.zeros(3))


def check(color_size, depth_size, place, seed=0, unseen=None):
    both = cameras(color_size, depth_size)
    color, depth = images(color_size, depth_size, seed)
    registration = ColorToDepth(*both, place, unseen)
    found, kept = registration(color, depth)
    np.testing.assert_array_equal(registration.depth(depth), kept)
    expected, expected_kept = color_to_depth(both, place, color, depth, unseen)
    assert found.dtype == np.uint8 and kept.dtype == np.float32
    assert np.abs(found - expected).max() <= LEVELS
    assert np.mean(kept != expected_kept) <= ROUNDED_SHARE
    return kept, depth


@pytest.mark.parametrize("place", [BESIDE, TURNED, ROTATED], ids=["beside", "turned", "rotated"])
@pytest.mark.parametrize(
    ("color_size", "depth_size"),
    [((160, 120), (160, 120)), ((131, 67), (97, 61)), ((64, 48), (130, 97)), ((67, 5), (65, 3))],
    ids=["same size", "odd", "coarser", "flat"],
)
def test_as_in_numpy(color_size, depth_size, place):
    kept, depth = check(color_size, depth_size, place)
    if place is BESIDE and depth.shape[0] > 50:
        assert 0.005 < np.mean((kept == 0) & (depth > 0)) < 0.35


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 2), (3, 2), (2, 9)])
def test_color_images_of_few_pixels(size):
    check(size, (70, 20), BESIDE)


def test_what_a_lens_left_empty_is_not_kept():
    unseen = np.zeros((120, 160), bool)
    unseen[:, :40] = True
    kept, depth = check((160, 120), (160, 120), TURNED, unseen=unseen)
    assert not kept[:, :15].any() and depth[:, :15].any()


def test_depth_that_is_no_number():
    both = cameras((160, 120), (160, 120))
    color, depth = images((160, 120), (160, 120))
    expected = ColorToDepth(*both, BESIDE)(color, depth)[1]
    odd = depth.copy()
    holes = np.argwhere(depth == 0)[:4]
    odd[tuple(holes.T)] = np.nan, -1, -np.inf, np.inf
    found = ColorToDepth(*both, BESIDE)(color, odd)[1]
    np.testing.assert_array_equal(found, expected)


def test_depth_may_be_written_where_it_was():
    both = cameras((160, 120), (160, 120))
    color, depth = images((160, 120), (160, 120))
    expected = ColorToDepth(*both, BESIDE)(color, depth)
    found = ColorToDepth(*both, BESIDE)(color, depth, in_place=True)
    assert found[1] is depth
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_camera_that_looks_the_other_way_sees_nothing():
    both = cameras((160, 120), (160, 120))
    around = pose_from(np.diag([-1.0, 1.0, -1.0]), np.array([0.1, 0, 0]))
    assert not ColorToDepth(*both, around)(*images((160, 120), (160, 120)))[1].any()


def test_nothing_turns_black_where_depth_or_color_is_missing():
    """Neither without depth, nor hidden, nor outside the color image: tracking takes intensities beside depth too."""
    color_camera, depth_camera = cameras((160, 120), (160, 120))
    narrow = Camera(160, 120, 2 * color_camera.fx, 2 * color_camera.fy, color_camera.cx, color_camera.cy)
    _, depth = images((160, 120), (160, 120))
    color, kept = ColorToDepth(narrow, depth_camera, TURNED)(np.full((120, 160, 3), 100, np.uint8), depth)
    assert np.mean(kept > 0) < 0.5
    assert (color == 100).all()


def test_an_image_without_pixels_and_one_without_depth():
    color = np.full((4, 5, 3), 9, np.uint8)
    view = ColorView((5, 4), (0, 0), (0, 0), np.eye(3, 4))
    found, kept = register_color(view, color, np.zeros((0, 0), np.float32), None, 1.0, 0.05)
    assert found.shape == (0, 0, 3) and kept.shape == (0, 0)
    assert typical_depth(np.zeros((3, 4), np.float32)) == 1


@pytest.mark.parametrize(
    ("color", "depth", "unseen", "message"),
    [
        ((4, 6, 3), (3, 2), None, r"color must be uint8 \[4, 5, 3\], got uint8 \[4, 6, 3\]"),
        ((4, 5, 3), (2, 3), None, r"depth must be float32 \[3, 2\], got float32 \[2, 3\]"),
        ((4, 5, 3), (3, 2), (5, 4), r"unseen must be uint8 \[4, 5\], got uint8 \[5, 4\]"),
    ],
)
def test_other_shapes_are_refused(color, depth, unseen, message):
    view = ColorView((5, 4), (2, 3), (0, 0), np.eye(3, 4))
    unseen = None if unseen is None else np.zeros(unseen, np.uint8)
    with pytest.raises(ValueError, match=f"register_color: {message}"):
        register_color(view, np.zeros(color, np.uint8), np.zeros(depth, np.float32), unseen, 1.0, 0.05)
    with pytest.raises(ValueError, match="register_color: depth must be float32"):
        register_color(view, np.zeros((4, 5, 3), np.uint8), np.zeros((3, 2)), None, 1.0, 0.05)


def test_a_library_that_is_missing_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(image_library, "_FOLDER", tmp_path)
    monkeypatch.setenv("SPSLAM_CPU_ISA", "avx2")
    with pytest.raises(ImportError, match="no compiled image functions for avx2 in .*; install the wheel, or build"):
        image_library.image_library.__wrapped__()


def test_a_registration_can_be_sent_to_another_process():
    both = cameras((160, 120), (160, 120))
    pair = images((160, 120), (160, 120))
    registration = ColorToDepth(*both, BESIDE)
    again = pickle.loads(pickle.dumps(registration))
    for found, expected in zip(again(*pair), registration(*pair), strict=True):
        np.testing.assert_array_equal(found, expected)
