"""Frames of which some are brighter than others: their gains, known of earlier frames, found of the one tracked."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import pose7_to_matrix
from tests.ops.arguments import opcheck
from tests.ops.scenes import INTRINSICS, corner_pixels
from tests.ops.tracking_scene import (
    ONE_STEP,
    OPTIONS,
    POSE,
    camera_points,
    corner_depth,
    drawn_pixels,
    moved_points,
    moved_pose,
    noise_model,
    pose7,
    rotation_exp,
)

SHAPE = (48, 64)
UNIT = 1e-4
NOISE = 4e-6, 0.0, 1e-4, 0.05  # variances of depth, m^2, and of intensity
EARLIER = [moved_pose(POSE, np.array([0.01, -0.005, 0.0]), 0.02), moved_pose(POSE, np.array([-0.02, 0.0, 0.01]), -0.03)]


def _paint(points):
    return 0.4 + 0.15 * torch.sin(9 * points).sum(-1) / 3


def _image(pose):
    """Depth and intensity float64 [H, W] of the painted corner, as a camera at `pose` float64 [4, 4] sees them."""
    depth = corner_depth(pose, INTRINSICS, *SHAPE)
    v, u = torch.meshgrid(*(torch.arange(size) for size in SHAPE), indexing="ij")
    x, y = (u - INTRINSICS.cx) / INTRINSICS.fx, (v - INTRINSICS.cy) / INTRINSICS.fy
    rays = torch.stack([x, y, torch.ones(SHAPE)], -1)
    points = (rays.double() * depth[..., None]) @ torch.from_numpy(pose[:3, :3]).T + torch.from_numpy(pose[:3, 3])
    return depth, _paint(points)


def _keyframes(gains, device="cpu", frame=0.0, known=True):
    """Keyframes at EARLIER whose images have these gains; with the log gains, of which the frame's is guessed."""
    depths, intensities = zip(*(_image(pose) for pose in EARLIER), strict=True)
    grays = [(255 * gain * one).round().clamp(max=255) for gain, one in zip(gains, intensities, strict=True)]
    exposure = None
    if known:
        log_gains = torch.tensor(gains, device=device).log()[:, None]
        exposure = ops.Exposure(log_gains, torch.tensor([frame], device=device))
    return ops.DepthKeyframes(
        (torch.stack(depths) / UNIT).round().to(torch.int32).to(torch.uint16).to(device),
        UNIT,
        torch.stack([pose7(pose, device) for pose in EARLIER]),
        ((0, 0), (1, 1)),
        INTRINSICS,
        0.03,
        intensities=torch.stack(grays).to(torch.uint8).to(device),
        exposure=exposure,
    )


def _painted(records, gain):
    """The records with the colors that a camera at POSE sees, so much brighter."""
    gray = gain * _paint(moved_points(camera_points(records), torch.zeros(6, dtype=torch.float64)))
    level = (255 * gray).round().clamp(max=255).int()
    return torch.stack([records[:, 0], records[:, 1], level | level << 8 | level << 16], 1)


def _reference(pose, gain, device="cpu"):
    depth, intensity = _image(pose)
    cells = torch.stack([(gain * intensity).clamp(max=1), depth], -1).float().to(device)
    log_gain = torch.tensor([np.log(gain)], dtype=torch.float32, device=device)
    return ops.ReferenceImage(cells, pose7(pose, device), INTRINSICS, 0.3, 0.2, log_gain=log_gain)


def _sampled(image, points, pose):
    """Values float64 [P] of an image [H, W] where points fall, by torch's bilinear sampling."""
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).unbind(-1)
    uv = torch.stack([x / z * INTRINSICS.fx + INTRINSICS.cx, y / z * INTRINSICS.fy + INTRINSICS.cy], -1)
    size = torch.tensor([SHAPE[1] - 1, SHAPE[0] - 1], dtype=torch.float64)
    grid = (2 * uv / size - 1)[None, None]
    inside = ((uv >= 0) & (uv < size)).all(-1)
    return torch.nn.functional.grid_sample(image[None, None], grid, align_corners=True)[0, 0, 0], inside, z


@pytest.mark.parametrize("ratio", [1.0, 1.4])
def test_the_step_is_that_of_pose_and_gain_together(device, generator, ratio):
    """By autograd, of the reference image alone: seven unknowns in one system."""
    guess = 0.05
    reference = _reference(EARLIER[0], ratio, device)
    keyframes = _keyframes([1.0, 1.0], device, frame=guess)._replace(rows=())
    records = _painted(corner_pixels(POSE, generator, 400), 1.1)
    pose, stats, _ = ops.track_gauss_newton(
        ops.SceneView.empty(device=device), records.to(device), pose7(POSE, device), INTRINSICS, ONE_STEP,
        reference=reference, depth_keyframes=keyframes,
    )  # fmt: skip
    drawn = drawn_pixels(records)
    own, local = (drawn[:, 2] & 0xFF).double() / 255, camera_points(drawn)
    cells, at = reference.cells.cpu().double(), torch.from_numpy(EARLIER[0])

    def residuals(unknowns):
        seen, inside, z = _sampled(cells[..., 0], moved_points(local, unknowns[:6]), at)
        depth, *_ = _sampled(cells[..., 1], moved_points(local, unknowns[:6]), at)
        value = torch.exp(unknowns[6] + guess - np.log(ratio)) * seen - own
        return value, inside & ((depth - z).abs() < 0.05 * z)

    zero = torch.zeros(7, dtype=torch.float64)
    value, compared = residuals(zero)
    jacobian = torch.autograd.functional.jacobian(lambda unknowns: residuals(unknowns)[0], zero)
    weight = 0.3**2 * compared / (1 + (value / 0.2) ** 2) ** 2
    hessian = torch.einsum("n,ni,nj->ij", weight, jacobian, jacobian)
    gradient = torch.einsum("n,ni,n->i", weight, jacobian, value)
    delta = -torch.linalg.solve(hessian, gradient)
    assert compared.double().mean() > 0.5 and delta[:6].norm() > 1e-3
    found = torch.from_numpy(pose7_to_matrix(pose.cpu().double().numpy()))
    # A point that rounding moves over the border of a cell, or of its neighbors' depth, has other equations.
    near = 0.03 * float(delta[:6].norm())
    torch.testing.assert_close(found[:3, 3], torch.from_numpy(POSE[:3, 3]) + delta[:3], rtol=0, atol=near)
    want = rotation_exp(delta[3:6]) @ torch.from_numpy(POSE[:3, :3])
    torch.testing.assert_close(found[:3, :3], want, rtol=0, atol=near)
    assert float(stats[0, 5]) == pytest.approx(guess + float(delta[6]), abs=2e-3)


@pytest.mark.parametrize("gain", [0.7, 1.0, 1.5])
def test_a_frames_gain_and_pose_are_found(device, generator, gain):
    """By two keyframes of other gains, of which nothing is mapped, however far the guess."""
    records = _painted(corner_pixels(POSE, generator, 4000), gain).to(device)
    start = pose7(moved_pose(POSE, np.array([0.004, -0.003, 0.002]), 0.004), device)
    noise, options = noise_model(*NOISE, device=device), replace(OPTIONS, iterations=20, kernel_end=0.03)

    def error(keyframes):
        pose, stats, _ = ops.track_gauss_newton(
            ops.SceneView.empty(device=device), records, start, INTRINSICS, options, noise=noise,
            depth_keyframes=keyframes,
        )  # fmt: skip
        found = pose7_to_matrix(pose.cpu().double().numpy())
        return np.linalg.norm(found[:3, 3] - POSE[:3, 3]), stats[:, 5]

    meters, log_gains = error(_keyframes([1.2, 0.8], device))
    assert meters < 1e-3
    assert float(log_gains[-1]) == pytest.approx(np.log(gain), abs=0.01)
    assert not error(_keyframes([1.2, 0.8], device, known=False))[1].any()  # nothing is said of gains
    known, _ = error(_keyframes([gain, gain], device, known=False))
    assert meters < 2 * known + 2e-4


def test_gains_that_are_all_alike_change_nothing_but_by_the_unknown(device, generator):
    """The same factor in all gains, the frame's guess too: the same step."""
    records = _painted(corner_pixels(POSE, generator, 400), 1.0).to(device)
    noise, poses = noise_model(*NOISE, device=device), []
    for factor in (0.0, 0.7):
        keyframes = _keyframes([1.0, 1.0], device, frame=factor)
        exposure = keyframes.exposure._replace(log_gains=torch.full((2, 1), factor, device=device))
        keyframes = keyframes._replace(exposure=exposure)
        poses.append(
            ops.track_gauss_newton(
                ops.SceneView.empty(device=device), records, pose7(POSE, device), INTRINSICS, ONE_STEP, noise=noise,
                depth_keyframes=keyframes,
            )
        )  # fmt: skip
    torch.testing.assert_close(poses[0][0], poses[1][0], rtol=0, atol=1e-6)
    torch.testing.assert_close(poses[0][1][:, 5] + 0.7, poses[1][1][:, 5], rtol=0, atol=1e-5)


def test_gains_may_be_a_column_of_a_table(device, generator):
    """As the frames' are, which is not copied for each frame; the other columns are nothing to them."""
    records = _painted(corner_pixels(POSE, generator, 400), 1.0).to(device)
    keyframes = _keyframes([1.2, 0.8], device)
    table = torch.full((2, 3), 7.0, device=device)
    table[:, 1:2] = keyframes.exposure.log_gains
    strided = keyframes._replace(exposure=keyframes.exposure._replace(log_gains=table[:, 1:2]))
    for one, other in zip(_tracked(records, device, keyframes), _tracked(records, device, strided), strict=True):
        assert torch.equal(one, other)


def _tracked(records, device, keyframes, **changes):
    """Pose float32 [7] and statistics [iterations, 7] from a start that is off."""
    start = pose7(moved_pose(POSE, np.array([0.004, -0.003, 0.002]), 0.004), device)
    options = replace(OPTIONS, **{"iterations": 20, "kernel_end": 0.03, **changes})
    pose, stats, _ = ops.track_gauss_newton(
        ops.SceneView.empty(device=device), records, start, INTRINSICS, options,
        noise=noise_model(*NOISE, device=device), depth_keyframes=keyframes,
    )  # fmt: skip
    return pose, stats


def _expecting(keyframes, log_gain, variance):
    """The keyframes, the frame's gain being expected there with a variance of its step."""
    frame = torch.tensor([log_gain, variance], device=keyframes.poses.device)
    return keyframes._replace(exposure=keyframes.exposure._replace(frame=frame))


def test_an_expected_gain_of_no_variance_is_none_to_be_found(device, generator):
    records = _painted(corner_pixels(POSE, generator, 4000), 1.0).to(device)
    known, _ = _tracked(records, device, _keyframes([1.0, 1.0], device, known=False))
    free, free_stats = _tracked(records, device, _keyframes([1.0, 1.0], device))
    held, held_stats = _tracked(records, device, _expecting(_keyframes([1.0, 1.0], device), 0.0, 0.0))
    assert abs(float(held_stats[-1, 5])) < 0.1 * abs(float(free_stats[-1, 5])) + 1e-6
    assert (held - known).abs().max() < 0.2 * (free - known).abs().max() + 2e-6
    anything, stats = _tracked(records, device, _expecting(_keyframes([1.0, 1.0], device), 0.0, np.inf))
    torch.testing.assert_close(anything, free, rtol=0, atol=0)
    torch.testing.assert_close(stats[:, 5], free_stats[:, 5], rtol=0, atol=0)


@pytest.mark.parametrize("gain", [0.7, 1.3])
def test_a_gain_that_changes_at_once_is_found_though_none_was_expected(device, generator, gain):
    records = _painted(corner_pixels(POSE, generator, 4000), gain).to(device)
    pose, stats = _tracked(records, device, _expecting(_keyframes([1.0, 1.0], device), 0.0, 0.0))
    assert float(stats[-1, 5]) == pytest.approx(np.log(gain), abs=0.01)
    assert float(stats[-1, 6]) == pytest.approx(np.log(gain) ** 2 / 16, rel=0.1)
    found = pose7_to_matrix(pose.cpu().double().numpy())
    assert np.linalg.norm(found[:3, 3] - POSE[:3, 3]) < 1e-3


def test_the_variance_of_an_even_exposure_fades(device, generator):
    records = _painted(corner_pixels(POSE, generator, 4000), 1.0).to(device)
    variances = [1e-3]
    for _ in range(100):
        _, stats = _tracked(records, device, _expecting(_keyframes([1.0, 1.0], device), 0.0, variances[-1]))
        variances.append(float(stats[-1, 6]))
    assert variances[1] == pytest.approx(variances[0] * 15 / 16, rel=0.01)
    assert min(variances) >= 0.99e-8 and variances[-1] < 1e-5


def test_without_noise_nothing_is_expected(device, generator):
    """Nothing says how much pixels are worth against a variance."""
    records = _painted(corner_pixels(POSE, generator, 400), 1.1).to(device)
    reference, results = _reference(EARLIER[0], 1.0, device), []
    keyframes = _keyframes([1.0, 1.0], device)._replace(rows=())
    for each in (keyframes, _expecting(keyframes, 0.0, 0.01)):
        results.append(
            ops.track_gauss_newton(
                ops.SceneView.empty(device=device), records, pose7(POSE, device), INTRINSICS, OPTIONS,
                reference=reference, depth_keyframes=each,
            )
        )  # fmt: skip
    assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][1][:, :6], results[1][1][:, :6])
    assert (results[1][1][:, 6] == 0.01).all() and not results[0][1][:, 6].any()


def _poses_with_and_without(keyframes, records):
    """float32 [7] after one step, and the same without the images' brightness."""
    plain = keyframes._replace(intensities=None, exposure=None)
    device = records.device
    return [
        ops.track_gauss_newton(
            ops.SceneView.empty(device=device), records, pose7(POSE, device), INTRINSICS, ONE_STEP,
            noise=noise_model(*NOISE, device=device), depth_keyframes=each,
        )[0]
        for each in (keyframes, plain)
    ]  # fmt: skip


def test_white_is_no_darker_than_what_would_be_brighter(device, generator):
    """A white frame against images that would be brighter than white as it: no difference, whatever the place."""
    records = _painted(corner_pixels(POSE, generator, 400), 10.0).to(device)
    keyframes = _keyframes([1.0, 1.0], device, frame=float(np.log(10.0)))
    torch.testing.assert_close(*_poses_with_and_without(keyframes, records), rtol=0, atol=1e-6)


@pytest.mark.parametrize("frame", [200.0, -200.0])
def test_black_images_whose_gains_are_any_number_say_nothing(device, generator, frame):
    records = _painted(corner_pixels(POSE, generator, 400), 1.0).to(device)
    keyframes = _keyframes([1.0, 1.0], device, frame=frame)
    keyframes = keyframes._replace(intensities=torch.zeros_like(keyframes.intensities))
    torch.testing.assert_close(*_poses_with_and_without(keyframes, records), rtol=0, atol=1e-6)


def test_noise_is_measured_as_bright_as_the_frame(device, generator):
    records = _painted(corner_pixels(POSE, generator, 3000), 1.5).to(device)
    models = {}
    for name, keyframes in (
        ("known", _keyframes([1.0, 0.8], device, frame=float(np.log(1.5)))),
        ("unknown", _keyframes([1.0, 0.8], device, known=False)),
        ("alike", _keyframes([1.5, 1.5], device, known=False)),
    ):
        noise = ops.SensorNoise.unknown(device)
        ops.measure_noise_(noise, records, pose7(POSE, device), INTRINSICS, keyframes)
        models[name] = noise.model.cpu()
    assert torch.equal(models["known"][:2], models["unknown"][:2])  # of depth
    assert float(models["known"][2]) < 0.1 * float(models["unknown"][2])
    torch.testing.assert_close(models["known"], models["alike"], rtol=0.5, atol=2e-5)


def test_a_reference_is_of_when_its_color_was_taken(device, generator):
    """With a motion and a delay as at the pose to which these lead."""
    records = _painted(corner_pixels(POSE, generator, 400), 1.0).to(device)
    shift = np.array([0.02, -0.01, 0.01])
    onwards = EARLIER[0].copy()
    onwards[:3, 3] += 0.5 * shift  # half an interval later
    before = EARLIER[0].copy()
    before[:3, 3] -= shift
    keyframes = _keyframes([1.0, 1.0], device)._replace(rows=(), exposure=None)
    table = torch.stack([pose7(before, device), pose7(EARLIER[0], device)])
    timing = ops.ColorTiming(torch.tensor([0.015], device=device), (), ops.NO_MOTION)
    reference = _reference(EARLIER[0], 1.0, device)._replace(motion=ops.FrameMotion(0, 0.03))
    late = keyframes._replace(poses=table, timing=timing)
    poses = [
        ops.track_gauss_newton(
            ops.SceneView.empty(device=device), records, pose7(POSE, device), INTRINSICS, ONE_STEP, reference=one,
            depth_keyframes=of,
        )[0]
        for one, of in (
            (reference, late),
            (reference._replace(pose=pose7(onwards, device), motion=ops.NO_MOTION), keyframes),
            (reference, keyframes),  # without a timing all is of one moment
        )
    ]  # fmt: skip
    torch.testing.assert_close(poses[0], poses[1], rtol=0, atol=1e-5)
    assert (poses[0] - poses[2]).abs().max() > 1e-3


def test_devices_agree_on_gains(device, generator):
    records, start = _painted(corner_pixels(POSE, generator), 1.2), pose7(moved_pose(POSE, 0.002, 0.004))
    results = [
        ops.track_gauss_newton(
            ops.SceneView.empty(device=place), records.to(place), start.to(place), INTRINSICS,
            replace(OPTIONS, tf32=False), noise=noise_model(*NOISE, device=place),
            reference=_reference(EARLIER[0], 1.3, place), depth_keyframes=_keyframes([1.2, 0.8], place),
        )
        for place in ("cpu", device)
    ]  # fmt: skip
    # Other orders of float32 sums, and points that these move over the border of a pixel.
    torch.testing.assert_close(results[1][0].cpu(), results[0][0], rtol=0, atol=5e-5)
    torch.testing.assert_close(results[1][1][:, 5].cpu(), results[0][1][:, 5], rtol=0, atol=1e-4)


def test_bad_exposures_are_named(generator):
    scene, records, good = ops.SceneView.empty(), corner_pixels(POSE, generator), _keyframes([1.0, 1.0])
    exposure, reference = good.exposure, _reference(POSE, 1.0)
    for bad, message in (
        (good._replace(intensities=None), "depth_keyframes.exposure must come with intensities"),
        (
            good._replace(exposure=exposure._replace(log_gains=exposure.log_gains[:1])),
            r"depth_keyframes.exposure.log_gains must have shape \[2, 1\]",
        ),
        (
            good._replace(exposure=exposure._replace(frame=torch.zeros(3))),
            r"depth_keyframes.exposure.frame must have shape \[1\] or \[2\], got \[3\]",
        ),
        (
            good._replace(exposure=exposure._replace(frame=exposure.frame.double())),
            "depth_keyframes.exposure.frame must be float32",
        ),
    ):
        with pytest.raises((ValueError, TypeError), match=f"track_gauss_newton: {message}"):
            ops.track_gauss_newton(scene, records, pose7(POSE), INTRINSICS, OPTIONS, depth_keyframes=bad)
    for bad, message in (
        (reference._replace(log_gain=torch.zeros(2)), r"reference.log_gain must have shape \[1\]"),
        (
            reference._replace(motion=ops.FrameMotion(0, 0.0)),
            "reference.motion must name poses that are there and positive times",
        ),
    ):
        with pytest.raises((ValueError, TypeError), match=f"track_gauss_newton: {message}"):
            ops.track_gauss_newton(scene, records, pose7(POSE), INTRINSICS, OPTIONS, reference=bad)
    with pytest.raises(RuntimeError, match="reference must name a pose that is there"):
        ops.track_gauss_newton(
            scene, records, pose7(POSE), INTRINSICS, OPTIONS, depth_keyframes=good,
            reference=reference._replace(motion=ops.FrameMotion(2, 0.03)),
        )  # fmt: skip


def test_opcheck_with_gains(device, generator):
    options, keyframes = replace(OPTIONS, num_pixels=32, iterations=2), _keyframes([1.2, 0.8])
    arguments = [corner_pixels(POSE, generator, 50), pose7(POSE), noise_model(*NOISE)], *options.arguments(INTRINSICS)
    call = (*ops.SceneView.empty().arguments(), *arguments, *_reference(POSE, 1.1).arguments(), *keyframes.arguments())
    opcheck(torch.ops.spslam.track_gauss_newton.default, call, device)
