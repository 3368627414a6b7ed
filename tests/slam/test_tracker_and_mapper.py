"""Tracker and mapper on a small map: prediction, lost frames, what moves and what is held."""

import numpy as np
import pytest
import torch

from spslam.prior import load_prior
from spslam.slam.frame_table import FrameTable
from spslam.slam.pixels import sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.state import Moments, SlamState
from spslam.slam.system import SlamSystem
from spslam.slam.tracker import Tracker, TrackingProblem
from tests.system.sequences import Recorded, settings

CPU = torch.device("cpu")


def shifted(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def table(camera, xs, lost=()):
    frames = FrameTable(camera)
    for row, x in enumerate(xs):
        frames.append(
            pose_tensor(shifted(x), CPU), row / 30, row, row in lost, torch.zeros(frames.depth_thumbnails.shape[1:])
        )
    return frames


@pytest.fixture(scope="module")
def dataset():
    return Recorded(12)


MOVING_POSES = ("mapping.optimize_poses=true", "mapping.pose_rate=0.001")


def processed(dataset, count, *overrides, preset=None):
    system = SlamSystem(settings(*overrides, preset=preset), dataset.camera, dataset.poses()[0])
    for i in range(count):
        system.process(dataset[i])
    return system


def test_frame_table_grows_and_keeps_its_rows(dataset):
    frames = table(dataset.camera, range(200), lost={7})
    assert len(frames) == len(frames.poses) == len(frames.depth_thumbnails) == 200
    assert frames.poses[:, 4].tolist() == list(range(200))
    assert frames.lost.nonzero()[:, 0].tolist() == [7]
    np.testing.assert_allclose(frames.matrices(-2), [shifted(198), shifted(199)])
    frames.poses[0, 4] = -1
    assert frames.poses[0, 4] == -1


@pytest.mark.parametrize(
    ("xs", "lost", "expected"),
    [([1.0], (), 1.0), ([1.0, 1.5], (), 2.0), ([1.0, 1.5, 1.6], {2}, 1.6), ([1.0, 1.5, 1.6], {1}, 1.6)],
)
def test_prediction_is_constant_speed_but_after_loss(dataset, xs, lost, expected):
    start = Tracker(settings(), dataset.camera, score_kernel_m=0.02).predict(table(dataset.camera, xs, lost))
    torch.testing.assert_close(start, pose_tensor(shifted(expected), CPU))


@pytest.mark.parametrize("preset", ["balanced", "paper"])
def test_a_pose_off_the_map_is_lost(dataset, preset):
    system = processed(dataset, 1, preset=preset)
    pixels = sample_frame(dataset[1], dataset.camera, system.config)
    away = dataset.poses()[0]
    away[:3, 3] += 50
    start = pose_tensor(away, CPU)
    estimate = system.tracker.track(TrackingProblem(system.state.scene, pixels.records, start, 1))
    assert system.recovery.judge(estimate).lost
    assert estimate.fit.inlier_share < 0.1


@pytest.mark.parametrize("preset", ["balanced", "paper"])
def test_a_frame_near_the_map_is_found(dataset, preset):
    system = processed(dataset, 1, preset=preset)
    pixels = sample_frame(dataset[1], dataset.camera, system.config)
    result = system.localize(pixels, pose_tensor(dataset.poses()[1], CPU), 1)
    assert not result.lost
    assert result.fit.inlier_share > 0.5
    assert result.fit.residual_cm < 2
    assert np.linalg.norm(result.pose[4:].numpy() - dataset.poses()[1][:3, 3]) < 0.01


def test_a_pose_that_is_measured_has_its_own_prediction_error_and_without_earlier_images_no_gain(dataset):
    system = processed(dataset, 1)
    pixels = sample_frame(dataset[1], dataset.camera, system.config)
    predicted = pose_tensor(dataset.poses()[1], CPU)
    problem = TrackingProblem(system.state.scene, pixels.records, predicted, 1)
    away = predicted.clone()
    away[4] += 0.03
    measured = system.tracker.measure(problem, away)
    assert measured.pose is away and measured.gain is None
    assert (measured.fit.prediction_error_cm, measured.fit.prediction_error_deg) == pytest.approx((3.0, 0.0), abs=1e-3)


@pytest.mark.parametrize(("shift_m", "goes_on"), [(0.0, False), (0.15, True)])
def test_tracking_goes_on_where_the_prediction_was_far_off(dataset, monkeypatch, shift_m, goes_on):
    system = processed(dataset, 1)
    tracker, truth = system.tracker, dataset.poses()[1]
    pixels = sample_frame(dataset[1], dataset.camera, system.config)

    def tracked():
        """What is found from starts off to all sides, and how far off that is, m."""
        found = []
        for side in np.concatenate([np.eye(3), -np.eye(3)]):
            start = pose_tensor(truth, CPU)
            start[4:] += torch.from_numpy(shift_m * side)
            frame = system.config.tracking.first_frames + 1
            found.append(tracker.track(TrackingProblem(system.state.scene, pixels.records, start, frame)))
        return found, [np.linalg.norm(each.pose[4:].numpy() - truth[:3, 3]) for each in found]

    (found, errors_m), once = tracked(), system.config.tracking.iterations
    assert {each.iterations for each in found} == {2 * once if goes_on else once}
    monkeypatch.setattr("spslam.slam.fit.FAR_CM", np.inf)
    monkeypatch.setattr("spslam.slam.fit.FAR_DEG", np.inf)
    at_once, errors_at_once_m = tracked()
    assert {each.iterations for each in at_once} == {once}
    if goes_on:
        assert max(errors_m) < 0.005
        assert np.mean(errors_m) < 0.5 * np.mean(errors_at_once_m)
    else:
        assert all(torch.equal(one.pose, other.pose) for one, other in zip(found, at_once, strict=True))


def test_a_pose_stays_as_it_was_found_where_tracking_on_leads_off_the_map(dataset, monkeypatch):
    system = processed(dataset, 1)
    tracker = system.tracker
    pixels = sample_frame(dataset[1], dataset.camera, system.config)
    start = pose_tensor(dataset.poses()[1], CPU)
    start[4] += 0.05
    problem = TrackingProblem(system.state.scene, pixels.records, start, 1)
    away = pose_tensor(shifted(50.0), CPU)
    monkeypatch.setattr(tracker, "track_from", lambda problem, _: tracker.measure(problem, away))
    found = tracker.track(problem)
    assert found.fit.is_far_from_prediction and found.fit.inlier_share > 0.5
    assert np.linalg.norm(found.pose[4:].numpy() - dataset.poses()[1][:3, 3]) < 0.01


@pytest.mark.parametrize("preset", ["balanced", "paper"])
def test_the_host_may_work_while_a_frame_is_tracked(dataset, preset):
    system, states = processed(dataset, 1, preset=preset), []
    system.while_tracking = lambda: states.append(len(system.state.frames))
    for i in range(1, 4):
        system.process(dataset[i])
    assert states == [1, 2, 3]


def test_little_depth_is_lost_without_a_try(dataset):
    system = processed(dataset, 1)
    frame = dataset[1]
    frame.depth[2:] = 0
    pixels = sample_frame(frame, dataset.camera, system.config)
    result = system.localize(pixels, pose_tensor(frame.pose, CPU), 1)
    assert result.lost
    assert result.iterations == 0
    assert np.isnan(result.fit.residual_cm)


def test_tracking_leaves_the_map_alone(dataset):
    system = processed(dataset, 1, preset="paper")
    before = {name: tensor.clone() for name, tensor in system.state.scene.state_dict().items()}
    pixels = sample_frame(dataset[1], dataset.camera, system.config)
    system.localize(pixels, pose_tensor(dataset.poses()[1], CPU), 1)
    assert all(torch.equal(tensor, before[name]) for name, tensor in system.state.scene.state_dict().items())


def test_a_lost_frame_does_not_touch_the_map(dataset):
    system = processed(dataset, 5)
    before, voxels = system.state.scene.volume.embeddings.clone(), system.state.scene.volume.num_voxels
    frame = dataset[5]
    frame.depth[:] = 0
    assert system.process(frame).mapping_iterations == 0
    assert system.state.scene.volume.num_voxels == voxels
    assert torch.equal(system.state.scene.volume.embeddings, before)
    assert not system.state.usable[5]
    assert system.state.unmapped


def test_the_first_pose_is_held_and_others_move(dataset):
    system = processed(dataset, 6, "mapping.every=100", *MOVING_POSES)
    before = system.state.frames.poses.clone()
    system.mapper.optimize(system.state, 3)
    after = system.state.frames.poses
    assert torch.equal(after[0], before[0])
    assert (after[1:] != before[1:]).any(1).all()
    torch.testing.assert_close(after[:, :4].norm(dim=1), torch.ones(6))


def test_poses_stay_where_they_are_not_optimized(dataset):
    system = processed(dataset, 4, "mapping.every=100", preset="fast")
    before = system.state.frames.poses.clone()
    geometry, texels = system.state.scene.volume.embeddings.clone(), system.state.scene.planes.texels.clone()
    assert system.mapper.optimize(system.state, 2) is not None
    assert torch.equal(system.state.frames.poses, before)
    assert torch.equal(system.state.scene.volume.embeddings, geometry)
    assert not torch.equal(system.state.scene.planes.texels, texels)


def test_nothing_to_optimize_is_no_error(dataset):
    system = SlamSystem(settings(), dataset.camera)
    assert system.mapper.optimize(system.state, 5) is None
    system.process(dataset[0])
    assert system.mapper.optimize(system.state, 0) is None


def test_moments_follow_the_map_as_it_grows(dataset):
    system = processed(dataset, 1, "mapping.reset_moments=false")
    state = system.state
    layout, texels = list(state.scene.planes.layout), state.scene.planes.texels.clone()
    first, touched = state.moments["texels"].first.clone(), state.moments["texels"].stamps.clone()
    far = dataset[1]
    pixels = sample_frame(far, dataset.camera, system.config)
    pose = dataset.poses()[0]
    pose[:3, 3] -= 3
    state.frames.append(pose_tensor(pose, CPU), 0.1, 1, False, pixels.depth_thumbnail)
    state.pixels.add(pixels.records)
    voxels = state.scene.volume.num_voxels
    system.mapper.integrate(state, pixels)
    assert state.scene.planes.layout != layout
    assert state.scene.volume.num_voxels > voxels
    for old, new in ((texels, state.scene.planes.texels), (first, state.moments["texels"].first)):
        for plane in range(3):
            row, u, v, size_u, size_v = layout[5 * plane : 5 * plane + 5]
            new_row, new_u, new_v, new_size_u, new_size_v = state.scene.planes.layout[5 * plane : 5 * plane + 5]
            grid = new[new_row : new_row + new_size_u * new_size_v].view(new_size_u, new_size_v, -1)
            kept = grid[u - new_u : u - new_u + size_u, v - new_v : v - new_v + size_v]
            assert torch.equal(kept.reshape(size_u * size_v, -1), old[row : row + size_u * size_v])
    assert len(state.moments["texels"].stamps) == len(state.scene.planes.texels)
    assert (state.moments["texels"].stamps > 0).sum() == (touched > 0).sum()
    system.mapper.optimize(state, 1)
    assert len(state.moments["embeddings"].first) >= state.scene.volume.num_voxels


@pytest.mark.parametrize(("reset", "expected"), [("true", 2), ("false", 6)])
def test_moments_start_anew_where_told_so(dataset, reset, expected):
    system = processed(dataset, 1, f"mapping.reset_moments={reset}", "mapping.first_iterations=4")
    system.mapper.optimize(system.state, 2)
    assert system.state.steps == expected
    assert system.state.stamp == 6


@pytest.mark.parametrize("kept", ["true", "false"])
def test_moments_of_colors_outlast_a_call_where_told_so(dataset, kept):
    system = processed(dataset, 1, f"mapping.keep_color_moments={kept}", "mapping.first_iterations=4")
    state = system.state
    before = {name: moments.first.clone() for name, moments in state.moments.items()}
    system.mapper.begin(state, 2)
    for name, moments in state.moments.items():
        is_kept = kept == "true" and name in ("texels", "color_decoder")
        assert torch.equal(moments.first, before[name] if is_kept else torch.zeros_like(before[name])), name


def test_gradients_are_spent_after_an_iteration(dataset):
    system = processed(dataset, 1)
    assert not any(moments.gradient.any() for moments in system.state.moments.values())


def test_moments_grow_with_zeros():
    moments = Moments.like(torch.ones(4, 2))
    moments.first += 1
    moments.fit(5)
    assert len(moments.first) == len(moments.stamps) >= 5
    assert moments.first[:4].eq(1).all()
    assert not moments.first[4:].any()


def test_a_state_without_frames_is_usable_for_nothing(dataset):
    state = SlamState.start(settings(), dataset.camera, np.eye(4), None, CPU)
    assert state.usable.shape == (0,)


def test_with_keyframes_mapping_moves_theirs_and_the_newest_pose_alone(dataset):
    system = processed(dataset, 10, "pixels.keyframe_every=4", "mapping.iterations=0", *MOVING_POSES)
    before = system.state.frames.poses.clone()
    system.mapper.optimize(system.state, 3)
    moved = (system.state.frames.poses != before).any(1)
    assert moved.nonzero()[:, 0].tolist() == [4, 8, 9]


@pytest.mark.parametrize("enabled", ["true", "false"])
def test_the_decoders_start_is_an_option_of_its_own(dataset, enabled):
    decoders = [
        SlamSystem(settings(f"prior.enabled={enabled}", f"prior.decoder={start}"), dataset.camera).state.scene
        for start in ("pretrained", "random")
    ]
    trained = load_prior().decoder_params
    assert torch.equal(decoders[0].geometry_decoder, trained)
    assert not torch.equal(decoders[1].geometry_decoder, trained)
