"""Registration of keyframes: poses found, how far off they say they may be, and what shows that they are wrong."""

import numpy as np
import pytest
import torch

from spslam.geometry import compose, pose_from, rotation_angle
from spslam.pose_graph import rotation_matrices, rotation_vectors
from spslam.slam.graph.keyframe import MAX_COLUMNS, Keyframe, KeyframeCamera
from spslam.slam.graph.registration import Registrar
from spslam.slam.poses import pose_tensor
from tests.slam.graph.worlds import NOISE, keyframes, place, registrar, relative

PLACE, FRAMES, NUMBERS = "apartment", 60, (0, 12, 24, 36, 48)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def made():
    return keyframes(PLACE, FRAMES, NUMBERS)


def moved(pose, seed, distance=0.02, angle=0.01):
    random = np.random.default_rng(seed)
    step = pose_from(rotation_matrices(random.normal(0, angle, 3)), random.normal(0, distance, 3))
    return compose(pose, step)


def error(found, truth):
    return np.r_[found[:3, 3] - truth[:3, 3], rotation_vectors(found[:3, :3] @ truth[:3, :3].T)]


def test_keyframe_holds_what_the_frame_shows(made):
    (config, dataset), (one, *_) = place(PLACE, FRAMES), made[0]
    frame, k = dataset[0], one.camera
    step = dataset.camera.width // k.camera.width
    assert one.depth.shape == (k.camera.height, k.camera.width) and k.camera.width <= MAX_COLUMNS
    np.testing.assert_allclose(one.depth_m.numpy(), frame.depth[::step, ::step], atol=k.unit)
    records, normals = one.sample(500, config.seed)
    points = k.points(records)
    u, v = (records[:, 0] & 0xFFFF).numpy(), (records[:, 0] >> 16).numpy()
    np.testing.assert_allclose(points[:, 2].numpy(), one.depth_m.numpy()[v, u], atol=1e-6)
    assert normals.shape == (500, 3) and float((normals * points).sum(1).max()) <= 0


def test_keyframes_of_large_images_are_small():
    _, dataset = place(PLACE, FRAMES)
    large = type(dataset.camera)(1280, 720, 900.0, 900.0, 639.5, 359.5)
    camera = KeyframeCamera.of(large, 10.0, 4, 0.05)
    assert (camera.camera.width, camera.camera.height) == (320, 180)
    assert camera.camera.fx == pytest.approx(225.0)


@pytest.mark.parametrize(("source", "target"), [(1, 0), (2, 1), (3, 2), (4, 3), (3, 0)])
def test_pose_is_found_and_its_covariance_is_honest(made, source, target):
    frames, poses = made
    truth = relative(poses, source, target)
    for seed in range(3):
        start = pose_tensor(moved(truth, seed), CPU)
        found = registrar(frames[0]).register(frames[source], frames[target], start)
        off = error(found.pose, truth)
        assert np.linalg.norm(off[:3]) < 0.015 and np.linalg.norm(off[3:]) < 0.004
        assert off @ found.information @ off < 30  # of six degrees of freedom
        assert found.through < 0.1 and found.correlation > 0.5


def test_what_is_measured_at_the_truth_fits(made):
    frames, poses = made
    truth = pose_tensor(relative(poses, 1, 0), CPU)
    right = registrar(frames[0]).measure(frames[1], frames[0], truth)
    wrong = registrar(frames[0]).measure(frames[1], frames[0], truth + torch.tensor([0, 0, 0, 0, 0.3, 0, 0.3]))
    assert right.on_surface > 0.8 and right.through < 0.05 and right.correlation > 0.8
    assert right.shortcoming() is None
    assert wrong is None or wrong.shortcoming() is not None
    values = np.linalg.eigvalsh(right.information)
    assert values.min() > 0


def test_two_places_do_not_register(made):
    other, _ = keyframes("stairwell", FRAMES, (0,))
    frames, _ = made
    origin = pose_tensor(np.eye(4), CPU)
    found = registrar(frames[0]).register(other[0], frames[0], origin)
    assert found is None or found.shortcoming() is not None


def test_without_surface_there_is_no_registration(made):
    one = made[0][0]
    blind = Keyframe(7, torch.zeros_like(one.depth), one.intensity, one.camera)
    origin = pose_tensor(np.eye(4), CPU)
    for pair in ((blind, one), (one, blind)):
        assert registrar(one).register(*pair, origin) is None
        assert registrar(one).measure(*pair, origin) is None
    assert registrar(one).measure(one, one, origin * float("nan")) is None
    assert len(blind.features) == 0


def test_the_same_bytes_every_time(made):
    frames, poses = made
    start = pose_tensor(moved(relative(poses, 2, 1), 0), CPU)
    once, again = (registrar(frames[0]).register(frames[2], frames[1], start) for _ in range(2))
    assert once.pose.tobytes() == again.pose.tobytes()
    assert once.information.tobytes() == again.information.tobytes()
    assert float(rotation_angle(once.pose[:3, :3])) > 0


def test_brightness_is_left_out_where_it_is_switched_off(made):
    frames, poses = made
    start = pose_tensor(relative(poses, 1, 0), CPU)
    with_it, without = (Registrar({frames[0].camera: NOISE}, 0, brightness) for brightness in (True, False))
    bright, plain = (one.measure(frames[1], frames[0], start) for one in (with_it, without))
    assert np.isnan(plain.correlation) and bright.correlation > 0.5
    # What brightness tells is missing in every direction.
    assert np.linalg.eigvalsh(bright.information - plain.information).min() > -1e-6 * np.trace(bright.information)
