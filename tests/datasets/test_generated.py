import time

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from spslam.camera import Camera
from spslam.datasets.depth_noise import kinect_depth
from spslam.datasets.generated import FRAMES_PER_ROUND, GeneratedDataset, camera_path
from spslam.datasets.room import Room
from spslam.errors import DatasetError
from spslam.geometry import inverse, rotation_angle, transform_points

# Single-precision rays over at most 6 m.
DEPTH_TOLERANCE_M = 5e-6


@pytest.fixture(scope="module")
def round_trip():
    """A whole round in small images."""
    return GeneratedDataset(frames=FRAMES_PER_ROUND, width=80, height=60)


def world_points(dataset, frame):
    return transform_points(frame.pose, dataset.camera.unproject(frame.depth).reshape(-1, 3))


def test_depth_is_exact(round_trip):
    for index in range(0, FRAMES_PER_ROUND, 50):
        points = world_points(round_trip, round_trip[index])
        assert np.abs(round_trip.room.signed_distance(points)).max() < DEPTH_TOLERANCE_M


def test_nothing_lies_before_the_surface(round_trip):
    frame = round_trip[40]
    for share in (0.2, 0.5, 0.9, 0.99):
        points = (1 - share) * frame.pose[:3, 3] + share * world_points(round_trip, frame)
        assert (round_trip.room.signed_distance(points) > 0).all()


def test_same_arguments_same_bytes_and_seeds_differ():
    def bytes_of(**options):
        frame = GeneratedDataset(frames=5, width=64, height=48, noise=1, **options)[3]
        return frame.color.tobytes(), frame.depth.tobytes(), frame.pose.tobytes()

    assert bytes_of(seed=4) == bytes_of(seed=4)
    assert all(a != b for a, b in zip(bytes_of(seed=4), bytes_of(seed=5), strict=True))


def test_the_path_does_not_depend_on_the_number_of_frames():
    np.testing.assert_array_equal(camera_path(20), camera_path(400)[:20])


def test_the_path_is_smooth_closed_and_free():
    poses = camera_path(FRAMES_PER_ROUND + 1)
    steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = np.degrees(rotation_angle(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]))
    assert steps_m.max() < 0.035
    assert turns.max() < 2.5
    closing = inverse(poses[0]) @ poses[-1]
    assert np.linalg.norm(closing[:3, 3]) < 0.1
    assert np.degrees(rotation_angle(closing[:3, :3])) < 8
    assert Room().signed_distance(poses[:, :3, 3]).min() > 0.35
    np.testing.assert_allclose(
        poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), np.tile(np.eye(3), (301, 1, 1)), atol=1e-12
    )
    assert (poses[:, 2, 1] < 0).all()  # the camera's y axis points down


@pytest.mark.parametrize("seed", [0, 1])
def test_every_view_is_well_constrained(seed):
    dataset = GeneratedDataset(frames=FRAMES_PER_ROUND, width=80, height=60, seed=seed)
    for index in range(0, FRAMES_PER_ROUND, 10):
        frame = dataset[index]
        points = dataset.camera.unproject(frame.depth)
        normals = np.cross(points[:-1, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, :-1]).reshape(-1, 3)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # The share of the least seen direction of normals; a single plane has 0, a cube's corner 1/3.
        assert np.linalg.eigvalsh(normals.T @ normals / len(normals))[0] > 0.05
        on_furniture = np.abs(dataset.room._shell.signed_distance(world_points(dataset, frame))) > 0.01
        assert on_furniture.mean() > 0.1
        assert frame.depth.min() > 0.4
        assert frame.depth.max() < 6


def test_colors_are_textured(round_trip):
    for index in range(0, FRAMES_PER_ROUND, 60):
        gray = cv2.cvtColor(round_trip[index].color, cv2.COLOR_RGB2GRAY).astype(float)
        assert np.mean(np.abs(np.diff(gray, axis=1)) > 3) > 0.2
        assert gray.std() > 20


def test_the_same_point_has_the_same_color_from_everywhere():
    dataset = GeneratedDataset(frames=10, width=320, height=240)
    first, second = dataset[0], dataset[9]
    points = transform_points(inverse(second.pose), world_points(dataset, first))
    pixels = np.round(dataset.camera.project(points))
    inside = (pixels >= 0).all(axis=1) & (pixels < (320, 240)).all(axis=1)
    columns, rows = pixels[inside].astype(int).T
    seen = np.abs(second.depth[rows, columns] - points[inside, 2]) < 0.01
    difference = first.color.reshape(-1, 3)[inside][seen].astype(int) - second.color[rows, columns][seen]
    assert seen.sum() > 30000
    assert np.median(np.abs(difference)) <= 2
    assert np.mean(np.abs(difference).max(axis=1) > 25) < 0.05  # half a pixel at the patterns' edges


def test_frame_metadata():
    dataset = GeneratedDataset(frames=4, width=64, height=48)
    assert len(dataset) == 4
    assert dataset.camera == Camera(64, 48, dataset.camera.fx, dataset.camera.fx, 31.5, 23.5)
    assert np.degrees(2 * np.arctan(32 / dataset.camera.fx)) == pytest.approx(60)
    frame = dataset[2]
    assert frame.color.dtype == np.uint8
    assert frame.depth.dtype == np.float32
    assert frame.color.shape == (48, 64, 3)
    np.testing.assert_array_equal(frame.pose, dataset.poses()[2])
    assert frame.timestamp == dataset.timestamps()[2] == 2 / 30


def test_noise_is_a_kinect_s():
    exact = GeneratedDataset(frames=60, width=320, height=240)
    noisy = GeneratedDataset(frames=60, width=320, height=240, noise=1)
    ground_truth = np.stack([exact[i].depth for i in (0, 30, 59)])
    measured = np.stack([noisy[i].depth for i in (0, 30, 59)])
    known = measured > 0
    assert 0.01 < np.mean(~known) < 0.08
    error = np.where(known, measured - ground_truth, np.nan)
    error[np.abs(error) > 0.3] = np.nan
    for low, high, expected_cm in ((0.8, 1.2, 0.2), (2.3, 2.7, 0.8), (3.3, 3.7, 1.6)):
        part = error[(ground_truth > low) & (ground_truth < high)]
        assert np.nanmedian(np.abs(part)) * 100 == pytest.approx(expected_cm * 0.67, rel=0.5)
    assert abs(np.nanmean(error)) < 0.002
    # Neighbors err alike, because the sensor matches windows.
    left, right = error[..., :-1].ravel(), error[..., 1:].ravel()
    both = np.isfinite(left) & np.isfinite(right)
    assert np.corrcoef(left[both], right[both])[0, 1] > 0.2


def test_noise_level_zero_is_exact_and_range_is_limited():
    depth = np.full((12, 16), 9.0, np.float32)
    depth[:, :8] = 2
    np.testing.assert_array_equal(kinect_depth(depth, 14.0, 0.0, np.random.default_rng(0)), depth)
    measured = kinect_depth(depth, 14.0, 1.0, np.random.default_rng(0))
    assert not measured[:, 12:].any()
    assert measured[:, :5].any()


def test_surface_samples(round_trip):
    points = round_trip.room.sample_surface(20000, seed=1)
    assert points.shape == (20000, 3)
    assert np.abs(round_trip.room.signed_distance(points)).max() < 1e-9
    np.testing.assert_array_equal(points, round_trip.room.sample_surface(20000, seed=1))
    assert not np.array_equal(points, round_trip.room.sample_surface(20000, seed=2))
    assert round_trip.room.sample_surface(0).shape == (0, 3)
    # The walls' share of the area, less what stands before or on them.
    on_shell = np.abs(round_trip.room._shell.signed_distance(points)) < 1e-9
    assert 0.5 < on_shell.mean() < 0.75


def test_mesh_is_the_surface(round_trip):
    vertices, faces, colors = round_trip.room.mesh(longest_edge_m=0.1)
    distance = round_trip.room.signed_distance(vertices)
    # Round surfaces are off by the chords' sagitta; what lies deeper belongs to triangles that a contact line cuts.
    assert np.mean(np.abs(distance) < 5e-4) > 0.93
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    generator = np.random.default_rng(0)
    some = generator.choice(len(faces), 3000, replace=False)
    before = round_trip.room.signed_distance(corners[some].mean(axis=1) + 0.004 * normals[some])
    assert np.mean(before > 0.002) > 0.97
    assert colors.dtype == np.uint8
    assert colors.shape == vertices.shape
    samples = round_trip.room.sample_surface(2000)
    assert cKDTree(vertices).query(samples)[0].max() < 0.12


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 0}, "dataset.frames must be at least 1, got 0"),
        ({"width": 8}, "dataset.width must be at least 16, got 8"),
        ({"noise": -1}, "dataset.noise must be at least 0, got -1"),
        ({"noise": float("nan")}, "dataset.noise must be at least 0, got nan"),
        ({"seed": -1}, "dataset.seed must be at least 0, got -1"),
    ],
)
def test_errors(options, message):
    with pytest.raises(DatasetError, match=message):
        GeneratedDataset(**options)


def test_a_frame_takes_few_milliseconds():
    dataset = GeneratedDataset(frames=10, width=320, height=240)
    seconds = []
    for index in range(7):
        started = time.thread_time()
        dataset[index]
        seconds.append(time.thread_time() - started)
    # About 25 ms of one core; the limit leaves room for a slower one.
    assert min(seconds) < 0.06
