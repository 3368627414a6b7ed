"""Distorted images become those of the pinhole camera: held against the room rendered through both lenses."""

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.calibration_files import lens_model
from spslam.datasets.lens import Lens, Rectification, sample_depth
from tests.datasets.cameras import BROWN, FISHEYE, REALSENSE, camera, path, render

CAMERA = camera(160, 120)


@pytest.mark.parametrize(("model", "coefficients"), [("brown", BROWN), ("fisheye", FISHEYE), ("brown", REALSENSE)])
def test_rectified_images_are_the_pinhole_cameras(model, coefficients):
    lens = Lens(CAMERA, model, coefficients)
    pose = path(60)[50]
    color, depth = render(lens, pose)
    true_color, true_depth = render(Lens(CAMERA), pose)
    rectification = Rectification.of(lens)
    seen = ~rectification.unseen
    assert seen.mean() > 0.9
    found = rectification.depth(depth)
    error = np.abs(found - true_depth)[seen & (found > 0)]
    assert np.median(error) < 1e-4
    assert (error < 0.01).mean() > 0.95  # the rest lies beside depth edges, where the nearest value is taken
    assert (found[seen] > 0).mean() > 0.999
    assert not found[rectification.unseen & (found == 0)].any()
    difference = np.abs(rectification.color(color).astype(int) - true_color)[seen]
    assert np.median(difference) <= 2
    as_it_was = np.abs(depth - true_depth)[seen]
    assert np.median(as_it_was) > 10 * np.median(error)


def sdk_pixels(camera, coefficients):
    """Where librealsense's projection has the pixels' rays, by its modified and its inverse Brown-Conrady model."""
    x, y = np.moveaxis(camera.ray_directions()[..., :2].astype(np.float64), -1, 0)
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    scale = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x, y = x * scale, y * scale
    u, v = x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return camera.fx * u + camera.cx, camera.fy * v + camera.cy


@pytest.mark.parametrize("name", ["distortion.inverse_brown_conrady", "Modified Brown Conrady", "brown_conrady"])
def test_pixels_are_where_librealsense_projects_to(name):
    large = Camera(1280, 720, 636, 635, 640.5, 362)
    maps = Lens(large, lens_model(name, "a file"), REALSENSE).maps()
    moved = large.fx * (large.ray_directions()[..., 0]) + large.cx - maps[0]
    assert np.abs(moved).max() > 5
    for found, expected in zip(maps, sdk_pixels(large, REALSENSE), strict=True):
        assert np.abs(found - expected).max() < 0.05


def test_depth_is_exact_on_planes_and_never_between_surfaces():
    plane = 1 / (0.5 + 0.001 * np.arange(40) + 0.002 * np.arange(30)[:, None]).astype(np.float32)
    u, v = (np.float32(offset) + np.indices((20, 20), dtype=np.float32)[axis] for offset, axis in ((3.25, 1), (2.5, 0)))
    np.testing.assert_allclose(sample_depth(plane, u, v), 1 / (0.5 + 0.001 * u + 0.002 * v), rtol=1e-5)
    step = np.full((30, 40), 1.0, np.float32)
    step[:, 20:] = 2
    step[:, 30:] = 0
    across = sample_depth(step, np.linspace(0, 39, 157, dtype=np.float32)[None], np.full((1, 157), 9.4, np.float32))
    assert set(np.unique(across)) == {0, 1, 2}
    outside = sample_depth(step, np.array([[-3.0, 60.0, 5.0]], np.float32), np.array([[5.0, 5.0, 99.0]], np.float32))
    assert not outside.any()


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("wide", (), "model must be one of pinhole, brown, fisheye, got 'wide'"),
        ("brown", (0.1,), "a brown lens must have 4 or 5 or 8 or 12 or 14 coefficients, got 1"),
        ("fisheye", (0, 0, 0, 0, 0), "a fisheye lens must have 4 coefficients, got 5"),
        ("brown", (0, 0, 0, np.nan), "coefficients must be finite"),
        ("pinhole", (0.1, 0, 0, 0), "a pinhole lens must have no coefficients"),
    ],
)
def test_wrong_lenses_are_refused(model, coefficients, message):
    with pytest.raises(ValueError, match=message):
        Lens(CAMERA, model, coefficients)


def test_a_fisheye_without_coefficients_is_distorted_a_brown_lens_is_not():
    assert Lens(CAMERA, "fisheye", (0, 0, 0, 0)).is_distorted
    assert not Lens(CAMERA, "brown", (0, 0, 0, 0, 0)).is_distorted
    assert not Lens(Camera(4, 4, 4, 4, 1, 1)).is_distorted
