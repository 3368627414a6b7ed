import numpy as np
import pytest

from spslam.camera import Camera

CAMERA = Camera(64, 48, 50.0, 52.0, 31.5, 23.5)


def test_matrix_round_trip():
    assert Camera.from_matrix(CAMERA.matrix(), 64, 48) == CAMERA
    padded = np.eye(4)
    padded[:3, :3] = CAMERA.matrix()
    assert Camera.from_matrix(padded, 64, 48) == CAMERA


def test_project_inverts_unproject():
    depth = np.random.default_rng(0).uniform(0.5, 4, (48, 64)).astype(np.float32)
    points = CAMERA.unproject(depth)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points[..., 2], depth)
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    # float32 coordinates of at most 64 px
    np.testing.assert_allclose(CAMERA.project(points), np.stack((u, v), -1), atol=2e-5)


def test_points_without_depth_and_behind_the_camera():
    assert not CAMERA.unproject(np.zeros((48, 64), np.float32)).any()
    assert np.isnan(CAMERA.project(np.array([[0.0, 0, 0], [0, 0, -1]]))).all()
    assert CAMERA.project(np.zeros((0, 3))).shape == (0, 2)


def test_resized_keeps_the_field_of_view():
    half = CAMERA.resized(32, 24)
    corner = CAMERA.project(np.array([0.3, -0.2, 1.0]))
    np.testing.assert_allclose(half.project(np.array([0.3, -0.2, 1.0])), (corner + 0.5) / 2 - 0.5)
    assert half.resized(64, 48) == CAMERA


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 48, 1, 1, 0, 0), "Camera: width must be a positive whole number, got 0"),
        ((64, 48.5, 1, 1, 0, 0), "Camera: height must be a positive whole number, got 48.5"),
        ((float("inf"), 48, 1, 1, 0, 0), "Camera: width must be a positive whole number, got inf"),
        ((64, 48, 0, 1, 0, 0), "Camera: fx must be positive, got 0"),
        ((64, 48, 1, float("nan"), 0, 0), "Camera: fy must be finite, got nan"),
    ],
)
def test_wrong_numbers(arguments, message):
    with pytest.raises(ValueError, match=message):
        Camera(*arguments)


def test_wrong_shapes():
    with pytest.raises(ValueError, match=r"matrix must have shape \(3, 3\), got \(2, 3\)"):
        Camera.from_matrix(np.ones((2, 3)), 64, 48)
    with pytest.raises(ValueError, match="matrix must have the form"):
        Camera.from_matrix(np.ones((3, 3)), 64, 48)
    with pytest.raises(ValueError, match=r"depth must have shape \(48, 64\), got \(64, 48\)"):
        CAMERA.unproject(np.zeros((64, 48)))
    with pytest.raises(ValueError, match=r"points must have shape \(..., 3\), got \(2,\)"):
        CAMERA.project(np.zeros(2))
