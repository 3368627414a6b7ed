"""Ops of a frame that are several public ones in one call: the same bits as those; what the bindings refuse."""

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


@pytest.mark.parametrize("rows", [200, 0])
def test_predicting_a_frame_is_predicting_its_pose_and_rectifying_its_records(device, rows):
    _, _, call, _ = frames(device, rows)
    motion, size = call["motion"], (call["height"], call["width"])
    unused = torch.full((7,), torch.nan, device=device)
    table, readout = torch.stack([unused, motion.before, motion.pose, unused]), motion.readout + 0.01
    pose = ops.predict_pose(motion.before, motion.pose)
    onwards = ops.ShutterMotion(motion.pose, pose, motion.seconds, readout)
    records = torch.empty_like(call["records"])
    ops.rectify_shutter_records_(**{**call, "out": records, "motion": onwards})
    got = ops.trusted.predict_frame(table, 2, readout, motion.seconds, call["records"], call["intrinsics"], size)
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
    predicted = [poses, 1, motion.readout, records["records"], [*records["intrinsics"], motion.seconds], *size]
    return (
        (torch.ops.spslam.measure_frame_.default, [*measured, *keyframes.arguments()]),
        (torch.ops.spslam.rectify_shutter_frame.default, [*rectified, numbers, *size]),
        (torch.ops.spslam.predict_frame.default, predicted),
    )


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
    ],
)
def test_the_bindings_refuse_what_would_read_elsewhere(device, place, argument, bad):
    op, call = raw_calls(device)[place]
    call[argument] = bad(call[argument])
    with pytest.raises(RuntimeError, match="(measure_frame_|rectify_shutter_[a-z_]*|predict_frame): "):
        op(*call)
