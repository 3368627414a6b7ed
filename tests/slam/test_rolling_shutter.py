"""Late colors and rolling shutters through the whole system: their times are found, and poses are those of depth."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import load_config
from spslam.datasets.clock import CaptureOffsets
from spslam.datasets.registry import open_sequence
from spslam.evaluation.trajectory_metrics import ate
from spslam.geometry import inverse
from spslam.pose_graph import rotation_matrices
from spslam.slam import fit, rolling_shutter, tracker
from spslam.slam.color_motion import ColorMotion
from spslam.slam.depth_keyframes import depth_image_intrinsics
from spslam.slam.frame_history import COLOR_MOTION_S
from spslam.slam.image_features import extract_features
from spslam.slam.pixels import sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.feature_alignment import FeatureAlignment
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.system import SlamSystem
from spslam.slam.tracker import FrameOutcome
from tests.system.sequences import Recorded, settings

CPU = torch.device("cpu")
INTERVAL = 1 / 30


def pose_of(turn, way):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_matrices(np.array(turn)), way
    return pose


BEFORE = pose_of((0.02, -0.3, 0.1), (1.0, 2.0, -0.5))
POSE = BEFORE @ pose_of((0.03, 0.06, -0.01), (0.02, -0.01, 0.03))


@pytest.mark.parametrize("share", [0.4, -0.3])
def test_colors_move_on_and_back(share):
    motion = ColorMotion(BEFORE, share)
    color = motion.color_pose(POSE)
    np.testing.assert_allclose(motion.depth_pose(color), POSE, atol=1e-12)
    step = inverse(BEFORE) @ POSE
    further = inverse(BEFORE) @ color
    np.testing.assert_allclose(further[:3, 3], (1 + share) * step[:3, 3], atol=1e-12)
    far = POSE.copy()
    far[0, 3] += 3.0
    np.testing.assert_array_equal(motion.color_pose(far), far)  # it has jumped


def test_features_of_late_colors_give_the_pose_of_depth():
    """A frame that has the depth of frame 4 and, as late as frame 0 is before, the color of frame 8."""
    dataset = Recorded(9)
    first, last = (
        extract_features(sample_frame(dataset[i], dataset.camera, settings()), dataset.camera, 8.0) for i in (0, 8)
    )
    truth = dataset.poses()
    plain = FeatureAlignment(last, dataset.camera)
    late = FeatureAlignment(last, dataset.camera, ColorMotion(truth[0], 1.0))
    matches = plain.matches(first.with_depth(), pose_tensor(truth[0], CPU))
    at_color, at_depth = plain.pose(matches, CPU), late.pose(matches, CPU)
    errors = [np.linalg.norm(pose[4:].numpy() - truth[4][:3, 3]) for pose in (at_color, at_depth)]
    assert errors[1] < 0.5 * errors[0]
    agreeing = late.inliers(matches, late.color_pose(at_depth)), plain.inliers(matches, plain.color_pose(at_color))
    assert agreeing[0] == agreeing[1] > plain.inliers(matches, plain.color_pose(at_depth))


def test_features_are_rectified_as_records_are():
    dataset = Recorded(3)
    pixels = sample_frame(dataset[2], dataset.camera, settings())
    rectifier = ShutterRectifier(dataset.camera, 8.0)
    motion = ops.ShutterMotion(pose_tensor(BEFORE, CPU), pose_tensor(POSE, CPU), INTERVAL, torch.tensor([0.02]))
    features = extract_features(pixels, dataset.camera, 8.0)
    points = features.points.copy()
    points[::3] = 0  # as if their depth were unknown
    features = replace(features, points=points)
    moved = rectifier.features(features, motion)
    shares = 0.02 * (features.positions[:, 1] / (dataset.camera.height - 1) - 0.5) / INTERVAL
    known = features.points[:, 2] > 0
    step = inverse(BEFORE) @ POSE
    for i in np.flatnonzero(known)[::40]:
        along = np.eye(4)
        along[:3, :3] = rotation_matrices(shares[i] * np.array((0.03, 0.06, -0.01)))
        along[:3, 3] = shares[i] * (step[:3, :3].T @ step[:3, 3])
        wanted = along[:3, :3] @ features.points[i] + along[:3, 3]
        np.testing.assert_allclose(moved.points[i], wanted, atol=0.002)
    k = depth_image_intrinsics(dataset.camera)
    projected = moved.points[known, :2] / moved.points[known, 2:] * (k.fx, k.fy) + (k.cx, k.cy)
    np.testing.assert_allclose(moved.positions[known], projected, atol=0.01)
    assert not moved.points[~known].any()
    # Where the depth is unknown they turn as what is far away does.
    for i in np.flatnonzero(~known)[::20]:
        ray = np.array([(features.positions[i, 0] - k.cx) / k.fx, (features.positions[i, 1] - k.cy) / k.fy, 1.0])
        x, y, z = rotation_matrices(shares[i] * np.array((0.03, 0.06, -0.01))) @ ray
        np.testing.assert_allclose(moved.positions[i], (x / z * k.fx + k.cx, y / z * k.fy + k.cy), atol=0.01)
    far = pose_tensor(BEFORE @ pose_of((0, 0, 0), (1.0, 0, 0)), CPU)
    for unmoved in (motion._replace(readout=torch.zeros(1)), motion._replace(pose=far)):
        same = rectifier.features(features, unmoved)
        assert np.array_equal(same.positions, features.positions) and np.array_equal(same.points, features.points)


def test_unknown_motion_is_not_made_up():
    system = SlamSystem(settings("device=cpu", preset="fast"), Recorded(5).camera)
    for i in range(4):
        system.process(Recorded(5)[i])
    history, frames = system.history, system.state.frames
    assert history.motion(2, float(frames.timestamps[2])).row == 1
    assert history.motion(0, 0.0) == history.motion(4, None) == ops.NO_MOTION
    assert history.motion(4, float(frames.timestamps[3])) == ops.NO_MOTION  # time stands still
    assert history.motion(4, float(frames.timestamps[3]) + 1.0) == ops.NO_MOTION
    frames.lost[-1] = True
    assert history.motion(4, 4 * INTERVAL) == ops.NO_MOTION


@pytest.mark.parametrize(("rate_hz", "before"), [(30, 3), (60, 2), (90, 1), (200, 0)])
def test_colors_are_moved_by_the_way_since_a_frame_that_is_old_enough(rate_hz, before):
    """25 ms: over less, a pose that is off would throw the next one off by more, where color comes before depth. But
    not past a frame that is lost, nor before the first."""
    system = SlamSystem(settings("device=cpu", preset="fast"), Recorded(5).camera)
    for i in range(4):
        system.process(replace(Recorded(5)[i], timestamp=i / rate_hz))
    history, frames = system.history, system.state.frames
    assert history.motion(4, 4 / rate_hz).row == 3
    assert history.motion(4, 4 / rate_hz, least_s=COLOR_MOTION_S).row == before
    assert history.own_motion(3).row == max(before - 1, 0)
    frames.lost[2] = True
    assert history.motion(4, 4 / rate_hz, least_s=COLOR_MOTION_S).row == 3


def test_times_of_images_come_from_their_offsets(tmp_path):
    """Not from the frames' time stamps: these may be of neither image."""
    dataset, system = Recorded(6), SlamSystem(settings("device=cpu", preset="fast"), Recorded(6).camera)
    offsets = [CaptureOffsets(0.002 * (i % 2), -0.003 * i) for i in range(6)]
    for i in range(5):
        system.process(replace(dataset[i], offsets=offsets[i]))
    history, times = system.history, dataset.timestamps()
    motion = history.own_motion(3)
    assert motion.seconds == pytest.approx(times[3] - times[2] + 0.002)
    assert motion.color_offset == pytest.approx(-0.009)
    keyframes = history.depth_keyframes(times[5], -0.02)
    assert keyframes.timing.keyframes[0] == history.own_motion(4)
    assert keyframes.timing.frame.color_offset == -0.02
    # What is measured comes on top.
    system.state.noise.color_delay[0] = 0.0
    assert history.color_motion(motion).share == pytest.approx(-0.009 / motion.seconds)
    system.state.noise.color_delay[0] = 0.009 + 1e-3
    assert history.color_motion(motion).share == pytest.approx(1e-3 / motion.seconds, rel=1e-3)
    system.save(tmp_path / "saved")
    frames = SlamSystem.load(tmp_path / "saved").state.frames
    np.testing.assert_allclose(frames.color_offsets, [each.color for each in offsets[:5]])
    np.testing.assert_array_equal(frames.depth_times, system.state.frames.depth_times)
    np.testing.assert_allclose(system.trajectory().timestamps, times[:5])


def test_a_known_readout_is_compensated_for_and_a_resumed_system_goes_on_alike(tmp_path):
    dataset = Recorded(12)
    system = SlamSystem(settings("device=cpu", preset="fast"), dataset.camera, dataset.poses()[0])
    timing = system.state.noise.tensors()
    timing["timing"][1], timing["timing_state"][1] = 0.02, torch.tensor([0.02, 1e6], dtype=torch.float64)
    for i in range(12):
        if i == 8:
            system.save(tmp_path / "half")
        system.process(dataset[i])
    read = sample_frame(dataset[11], dataset.camera, system.config)
    assert not torch.equal(system.state.pixels.records[11], read.records)
    assert not torch.equal(system.state.depth_keyframes.images[0].int(), read.depth_image.int())
    resumed = SlamSystem.load(tmp_path / "half")
    for i in range(8, 12):
        resumed.process(dataset[i])
    assert torch.equal(resumed.state.frames.poses, system.state.frames.poses)
    assert torch.equal(resumed.state.pixels.records, system.state.pixels.records)


@pytest.mark.parametrize(
    ("bent_px", "far_cm", "outcome"),
    [(1e6, 1e6, FrameOutcome.SETTLED), (1e-3, 1e6, FrameOutcome.BENT), (1e-3, 0.0, FrameOutcome.FAR)],
)
def test_a_frame_that_is_followed_in_one_call_is_tracked_as_step_by_step(bent_px, far_cm, outcome, monkeypatch):
    """The same bytes, whatever the first pass says of it."""
    monkeypatch.setattr(rolling_shutter, "BENT_PX", bent_px)
    for module in (fit, tracker):
        monkeypatch.setattr(module, "FAR_CM", far_cm)
    follow, outcomes, dataset, found = tracker.Tracker.follow, [], Recorded(16), []

    def followed(*arguments):
        frame = follow(*arguments)
        outcomes.append(frame.outcome)
        return frame

    monkeypatch.setattr(tracker.Tracker, "follow", followed)
    for in_one_call in (True, False):
        if not in_one_call:
            monkeypatch.setattr(tracker.Tracker, "can_follow", lambda self, frames: False)
        system = SlamSystem(settings("device=cpu", preset="fast"), dataset.camera, dataset.poses()[0])
        timing = system.state.noise.tensors()
        timing["timing"][1], timing["timing_state"][1] = 0.02, torch.tensor([0.02, 1e6], dtype=torch.float64)
        for i in range(len(dataset)):
            system.process(dataset[i])
        state = system.state
        found.append((state.frames.poses, state.frames.gains, state.pixels.records, state.depth_keyframes.images.int()))
    assert len(outcomes) > 3 and set(outcomes) == {outcome}
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def turning(delay_ms, readout_ms, *overrides):
    """A generated apartment seen by a turning camera: the system after 75 frames, and its error, cm."""
    options = ["place=apartment", "motion=fast_turns", "seed=41", "width=240", "height=180", "frames=75"]
    options += [f"color_delay_ms={delay_ms}", f"rolling_shutter_ms={readout_ms}"]
    changed = [
        *(f"dataset.{option}" for option in options),
        "device=cpu",
        "graph.enabled=false",
        "mapping.first_iterations=50",
        *overrides,
    ]
    config = load_config("places", None, changed)
    dataset = open_sequence(config.dataset)
    system = SlamSystem(config, dataset.camera, dataset.poses()[0])
    for i in range(len(dataset)):
        system.process(dataset[i])
    trajectory = system.trajectory()
    assert not trajectory.lost.any()
    return SimpleNamespace(system=system, ate_cm=ate(trajectory.poses, dataset.poses())["ate_rmse_cm"])


@pytest.mark.slow
def test_times_are_found_and_heeded():
    heeded, ignored = turning(15, 20), turning(15, 20, "tracking.capture_timing=false")
    noise = heeded.system.state.noise
    assert float(noise.color_delay) == pytest.approx(0.015, abs=0.004)
    assert float(noise.readout) == pytest.approx(0.020, abs=0.005)
    assert heeded.ate_cm < 0.7 * ignored.ate_cm
    assert not ignored.system.state.noise.tensors()["timing_state"].any()


@pytest.mark.slow
def test_a_camera_of_one_moment_is_found_to_be_one():
    noise = turning(0, 0).system.state.noise
    assert float(noise.color_delay) == float(noise.readout) == 0.0


@pytest.mark.parametrize(
    ("turn_deg", "readout_s", "is_bent"),
    [(1, 0.02, True), (1, -0.02, True), (0.2, 0.02, False), (1, 0.002, False), (1, 0, False), (math.nan, 0.02, False)],
)
def test_a_frame_is_bent_by_a_turn_that_was_not_predicted(turn_deg, readout_s, is_bent):
    """A degree in 33 ms turns the first row of 20 ms by 0.3 degrees, that is 0.7 px of this camera."""
    rectifier = ShutterRectifier(Camera(160, 120, 138.0, 138.0, 79.5, 59.5), 10.0)
    still, readout = torch.tensor([1.0, 0, 0, 0, 0, 0, 0]), torch.tensor([float(readout_s)])
    assert rectifier.bends(ops.ShutterMotion(still, still, 1 / 30, readout), turn_deg) == is_bent
