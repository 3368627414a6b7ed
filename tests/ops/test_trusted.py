"""Ops of a frame that are several public ones in one call: the same bits as those; what the bindings refuse."""

from dataclasses import replace

import pytest
import torch

from spslam import ops
from tests.ops.arguments import opcheck
from tests.ops.scene_cases import measure_noise, measure_timing, rectify_images, rectify_records, track

COUNTS = 50, 80  # of pixels, for times and for noise


def frames(device, rows=200):
    """Arguments by name: of a frame's measurement, with times or without, and of its rectification."""
    measured = [make(torch.Generator().manual_seed(1), device, rows) for make in (measure_timing, measure_noise)]
    rectified = [make(torch.Generator().manual_seed(2), device, rows) for make in (rectify_records, rectify_images)]
    return *measured, *rectified


@pytest.mark.parametrize("rows", [200, 60, 0])
@pytest.mark.parametrize("has_timing", [True, False])
def test_measuring_a_frame_is_measuring_times_and_then_noise(device, rows, has_timing):
    timed, plain, _, _ = frames(device, rows)
    pixels, pose, camera = plain["pixels"], plain["pose"], plain["intrinsics"]
    found = []
    for is_fused in (True, False):
        noise, timing = ops.SensorNoise.unknown(device), ops.CaptureTiming.unknown(device)
        keyframes = plain["depth_keyframes"]
        if has_timing:
            colors = timed["depth_keyframes"].timing._replace(delay=timing.color_delay)
            keyframes = keyframes._replace(timing=colors)
        for _ in range(3):
            if is_fused:
                ops.trusted.measure_frame_(noise, timing, pixels, pose, camera, keyframes, COUNTS)
                continue
            if has_timing:
                ops.measure_capture_timing_(timing, pixels[: COUNTS[0]], pose, camera, noise.model, keyframes)
            ops.measure_noise_(noise, pixels[: COUNTS[1]], pose, camera, keyframes)
        found.append((*noise, *timing))
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_rectifying_a_frame_is_rectifying_records_and_images(device):
    _, _, records, images = frames(device)
    motion = records["motion"]
    ops.rectify_shutter_records_(**records)
    ops.rectify_shutter_images_(**images)
    got = ops.trusted.rectify_shutter_frame(
        records["records"],
        images["depth"],
        images["intensity"],
        motion,
        records["intrinsics"],
        (records["height"], records["width"]),
        images["intrinsics"],
        images["unit"],
    )
    for one, other in zip(got, (records["out"], images["out_depth"], images["out_intensity"]), strict=True):
        assert one.dtype == other.dtype and torch.equal(one.cpu().float(), other.cpu().float())
    assert not torch.equal(got[0], records["records"])


@pytest.mark.parametrize("rows, steps", [(200, 1.0), (200, 2.5), (0, 1.0)])
def test_predicting_a_frame_is_predicting_its_pose_and_rectifying_its_records(device, rows, steps):
    _, _, call, _ = frames(device, rows)
    motion, size = call["motion"], (call["height"], call["width"])
    unused = torch.full((7,), torch.nan, device=device)
    table, readout = torch.stack([unused, motion.before, motion.pose, unused]), motion.readout + 0.01
    pose = ops.predict_pose(motion.before, motion.pose, steps)
    onwards = ops.ShutterMotion(motion.pose, pose, motion.seconds, readout)
    records = torch.empty_like(call["records"])
    ops.rectify_shutter_records_(**{**call, "out": records, "motion": onwards})
    got = ops.trusted.predict_frame(table, 2, readout, motion.seconds, steps, call["records"], call["intrinsics"], size)
    assert all(torch.equal(one, other) for one, other in zip(got, (pose, readout, records), strict=True))
    assert got[1].data_ptr() != readout.data_ptr()
    assert rows == 0 or not torch.equal(records, call["records"])


def test_what_tracking_finds_is_one_tensor(device):
    call = track(torch.Generator().manual_seed(3), device, 60)
    pose, stats, hessian = ops.track_gauss_newton(**call)
    others = [call.get(name) for name in ("noise", "reference", "depth_keyframes")]
    found = ops.trusted.track_gauss_newton(
        call["scene"], call["pixels"], call["pose"], call["intrinsics"], call["options"], *others
    )
    parts = torch.cat([call["pose"], pose, hessian.flatten(), stats.flatten()])
    assert torch.equal(found.nan_to_num(), parts.nan_to_num())


NEVER = 1e9
AGAIN = 3  # iterations of the second pass


def moving_frame(device, rows=60):
    """A frame of a moving camera, and what it is tracked by."""
    call = track(torch.Generator().manual_seed(3), device, rows)
    _, plain, records, images = frames(device)
    call["depth_keyframes"] = plain["depth_keyframes"]._replace(first_iteration=1)
    poses = torch.stack([records["motion"].before, records["motion"].pose])
    frame = ops.trusted.MovingFrame(
        call["pixels"],
        images["depth"],
        images["intensity"],
        poses,
        records["motion"].readout + 0.01,
        records["motion"].seconds,
        1.5,
        (records["height"], records["width"]),
        images["intrinsics"],
        images["unit"],
    )
    return frame, call


def followed(frame, call, limits):
    """Outcome, all that is found, and the tensors, by one call."""
    others = [call.get(name) for name in ("noise", "reference", "depth_keyframes")]
    found, *tensors = ops.trusted.track_frame(
        call["scene"], frame, limits, AGAIN, call["intrinsics"], call["options"], *others
    )
    return int(found[0]), found[1:], tensors


def step_by_step(frame, call, is_bent):
    """The same by the ops that the call is made of."""

    def tracked(records, start, options, keyframes):
        arguments = call["scene"], records, start, call["intrinsics"], options, call["noise"], call["reference"]
        return ops.trusted.track_gauss_newton(*arguments, keyframes)[7:]

    predicted, readout, records = ops.trusted.predict_frame(
        frame.poses, 1, frame.readout, frame.seconds, frame.steps, frame.records, call["intrinsics"], frame.size
    )
    motion = ops.ShutterMotion(frame.poses[1], predicted, frame.seconds, readout)
    first = tracked(records, predicted, call["options"], call["depth_keyframes"])
    found = torch.cat([first[:43], first[-7:].repeat(AGAIN)])
    if is_bent:
        bent, height, width = torch.empty_like(frame.records), *frame.size
        by_first = motion._replace(pose=first[:7])
        ops.trusted.rectify_shutter_records_(bent, frame.records, by_first, call["intrinsics"], height, width)
        near = replace(call["options"], iterations=AGAIN, kernel_start=call["options"].kernel_end)
        found = tracked(bent, first[:7].clone(), near, call["depth_keyframes"]._replace(first_iteration=0))
    images = ops.trusted.rectify_shutter_frame(
        frame.records, frame.depth, frame.intensity, motion._replace(pose=found[:7]), call["intrinsics"], frame.size,
        frame.image_intrinsics, frame.unit,
    )  # fmt: skip
    return torch.cat([predicted, readout, first, found]), [records, *images]


@pytest.mark.parametrize(
    ("limits", "outcome"),
    [((NEVER, NEVER, NEVER), 0), ((0.0, NEVER, NEVER), 1), ((0.0, 0.0, NEVER), 2), ((0.0, NEVER, 0.0), 2)],
)
def test_following_a_frame_is_predicting_rectifying_and_tracking_it(device, limits, outcome):
    frame, call = moving_frame(device)
    got, numbers, tensors = followed(frame, call, limits)
    assert got == outcome
    expected, others = step_by_step(frame, call, is_bent=outcome == 1)
    assert torch.equal(numbers.nan_to_num(), expected.nan_to_num())
    for one, other in zip(tensors, others, strict=True):
        assert one.dtype == other.dtype and torch.equal(one.cpu().float(), other.cpu().float())
    assert not torch.equal(tensors[0], frame.records) and not torch.equal(tensors[1], tensors[0])


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_limit_counts_from_the_predicted_pose(device, place):
    frame, call = moving_frame(device)
    _, numbers, _ = followed(frame, call, (NEVER, NEVER, NEVER))
    predicted, first = numbers[:7].double(), numbers[8:15].double()
    turn = 4 * torch.asin(min((first[:4] - predicted[:4]).norm(), (first[:4] + predicted[:4]).norm()) / 2)
    way = (first[4:] - predicted[4:]).norm()
    share = abs(float(frame.readout)) / frame.seconds  # of a turn that counts as bent
    exact = float((turn * min(share, 1), way, turn)[place])
    assert exact > 0
    for factor, outcome in ((0.999, 2 if place else 1), (1.001, 0)):
        limits = [NEVER] * 3
        limits[place] = factor * exact
        assert followed(frame, call, tuple(limits))[0] == outcome


def test_a_pose_of_nan_stands(device):
    frame, call = moving_frame(device)
    poses = frame.poses.clone()
    poses[0, 4] = torch.nan
    outcome, numbers, _ = followed(frame._replace(poses=poses), call, (0.0, 0.0, 0.0))
    assert outcome == 0 and bool(numbers[4].isnan())


def raw_calls(device):
    """The ops' own arguments."""
    timed, _, records, images = frames(device)
    noise, motion = ops.SensorNoise.unknown(device), records["motion"]
    keyframes, timing = timed["depth_keyframes"], timed["timing"]
    pixels, camera = timed["pixels"], list(timed["intrinsics"])
    measured = [noise.counts, noise.model, timing.state, timing.seconds, pixels, timed["pose"], camera, list(COUNTS)]
    rectified = [records["records"], images["depth"], images["intensity"], motion.before, motion.pose, motion.readout]
    numbers = [*records["intrinsics"], *images["intrinsics"], motion.seconds, images["unit"]]
    size, poses = [records["height"], records["width"]], torch.stack([motion.before, motion.pose])
    predicted = [poses, 1, motion.readout, records["records"], [*records["intrinsics"], motion.seconds], *size, 2.0]
    return (
        (torch.ops.spslam.measure_frame_.default, [*measured, *keyframes.arguments()]),
        (torch.ops.spslam.rectify_shutter_frame.default, [*rectified, numbers, *size]),
        (torch.ops.spslam.predict_frame.default, predicted),
        (torch.ops.spslam.track_frame.default, raw_tracking(device)),
    )


def raw_tracking(device):
    """Those of `track_frame`."""
    frame, call = moving_frame(device)
    scene, options = call["scene"].arguments(), call["options"].arguments(call["intrinsics"])
    tensors = [frame.records, frame.depth, frame.intensity, frame.poses, frame.readout, call["noise"]]
    numbers = [*frame.image_intrinsics, *frame.size, frame.seconds, frame.steps, frame.unit, NEVER, NEVER, NEVER, AGAIN]
    return [*scene, tensors, *options, *call["reference"].arguments(), *call["depth_keyframes"].arguments(), numbers]


def test_opcheck(device):
    for op, call in raw_calls(device):
        opcheck(op, call, device)


@pytest.mark.parametrize(
    ("place", "argument", "bad"),
    [
        (0, 4, lambda pixels: pixels[:, :2]),
        (0, 0, lambda counts: counts[:1]),
        (0, 5, lambda pose: pose[:6]),
        (0, 7, lambda counts: [-1, 3]),
        (0, 7, lambda counts: [3]),
        (1, 0, lambda records: records[:, :2]),
        (1, 1, lambda depth: depth[0]),
        (1, 2, lambda intensity: intensity[1:]),
        (1, 4, lambda pose: pose[:6]),
        (1, 6, lambda numbers: numbers[1:]),
        (2, 0, lambda poses: poses[:, :6]),
        (2, 1, lambda last: 0),
        (2, 1, lambda last: 2),
        (2, 2, lambda readout: readout[:0]),
        (2, 3, lambda records: records[:, :2]),
        (2, 4, lambda numbers: [*numbers[:4], 0.0]),
        (2, 5, lambda height: 1),
        (3, 3, lambda tensors: tensors[:4]),
        (3, 3, lambda tensors: [tensors[0][:, :2], *tensors[1:]]),
        (3, 3, lambda tensors: [tensors[0][:0], *tensors[1:]]),
        (3, 3, lambda tensors: [tensors[0], tensors[1][0], *tensors[2:]]),
        (3, 3, lambda tensors: [*tensors[:2], tensors[2][1:], *tensors[3:]]),
        (3, 3, lambda tensors: [*tensors[:3], tensors[3][:, :6], *tensors[4:]]),
        (3, 3, lambda tensors: [*tensors[:4], tensors[4][:0], tensors[5]]),
        (3, 3, lambda tensors: [*tensors[:5], tensors[5][:3]]),
        (3, 11, lambda numbers: numbers[1:]),
        (3, 11, lambda numbers: [*numbers[:4], 1, *numbers[5:]]),
        (3, 11, lambda numbers: [*numbers[:6], 0.0, *numbers[7:]]),
        (3, 11, lambda numbers: [*numbers[:7], 0.0, *numbers[8:]]),
        (3, 11, lambda numbers: [*numbers[:8], 0.0, *numbers[9:]]),
        (2, 7, lambda _: 0.0),
        (3, 3, lambda tensors: [*tensors[:3], tensors[3][:1], *tensors[4:]]),
    ],
)
def test_the_bindings_refuse_what_would_read_elsewhere(device, place, argument, bad):
    op, call = raw_calls(device)[place]
    call[argument] = bad(call[argument])
    with pytest.raises(RuntimeError, match="(measure_frame_|rectify_shutter_[a-z_]*|predict_frame|track_frame): "):
        op(*call)
