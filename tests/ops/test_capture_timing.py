"""When images were taken, measured; frames of a rolling shutter rectified; poses by colors that are late."""

import pytest
import torch

from spslam import ops
from tests.ops.arguments import opcheck
from tests.ops.tracking_scene import noise_model

CAMERA = ops.Intrinsics(120.0, 120.0, 79.5, 50.0)  # its principal point is not the middle of the image
SHAPE = (120, 160)
UNIT = 1e-4
INTERVAL = 1 / 30
WALLS = torch.tensor([1.4, 1.0, 2.0], dtype=torch.float64)  # m, of a corner: x, y and z are at most so much
NOISE = (1e-6, 1e-7, 1e-5, 0.01)


def _path(seconds):
    """float64 [..., 4, 4] T_world_camera at times [...] of a camera that turns and moves, faster and slower."""
    t = torch.as_tensor(seconds, dtype=torch.float64)
    angles = torch.stack([0.10 * torch.sin(9 * t), 0.16 * torch.sin(7 * t + 1), 0.05 * torch.sin(5 * t)], -1)
    zero, (x, y, z) = torch.zeros_like(t), angles.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(*t.shape, 3, 3)
    pose = torch.eye(4, dtype=torch.float64).expand(*t.shape, 4, 4).clone()
    pose[..., :3, :3] = torch.linalg.matrix_exp(skew)
    pose[..., :3, 3] = 0.08 * torch.stack([torch.sin(6 * t), torch.cos(8 * t), torch.sin(4 * t + 2)], -1)
    return pose


def _view(seconds, readout):
    """Depth (m) and brightness in [0, 1], float64 [H, W], of a corner with a pattern on its walls; the middle row at a
    time."""
    v, u = torch.meshgrid(*(torch.arange(size, dtype=torch.float64) for size in SHAPE), indexing="ij")
    rows = _path(seconds + readout * (torch.arange(SHAPE[0]) / (SHAPE[0] - 1) - 0.5))
    rays = torch.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, torch.ones_like(u)], -1)
    directions = torch.einsum("hij,hwj->hwi", rows[:, :3, :3], rays)
    distances = torch.where(directions > 1e-6, (WALLS - rows[:, None, :3, 3]) / directions, torch.inf)
    depth = distances.min(-1).values
    points = rows[:, None, :3, 3] + depth[..., None] * directions
    pattern = torch.sin(19 * points[..., 0]) + torch.sin(23 * points[..., 1] + 1) + torch.sin(17 * points[..., 2])
    return depth, 0.5 + pattern / 8


def _pose7(matrix):
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    w = torch.sqrt(1 + trace) / 2
    axes = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
    return torch.cat([torch.stack([w, *(a / (4 * w) for a in axes)]), matrix[:3, 3]]).float()


class Recording:
    """Frames of a camera with late colors and a rolling shutter, and their true poses."""

    def __init__(self, frames, delay=0.0, readout=0.0, device="cpu", offsets=()):
        """Colors are late by `delay` and, of the first frames, by their own `offsets`, as these frames' stamps say."""
        self.device, depths, intensities = device, [], []
        self.offsets = [*offsets, *[0.0] * (frames - len(offsets))]
        for i, offset in enumerate(self.offsets):
            depths.append(_view(i * INTERVAL, readout)[0])
            intensities.append(_view(i * INTERVAL + delay + offset, readout)[1])
        self.depth, self.intensity = torch.stack(depths), torch.stack(intensities)
        self.images = (self.depth / UNIT).round().to(torch.int32).to(torch.uint16).to(device)
        self.grays = (255 * self.intensity).round().to(torch.uint8).to(device)
        self.poses = torch.stack([_pose7(_path(torch.tensor(i * INTERVAL))) for i in range(frames)]).to(device)

    def records(self, frame, step=3):
        v, u = torch.meshgrid(*(torch.arange(1, size - 1, step) for size in SHAPE), indexing="ij")
        u, v = u.reshape(-1), v.reshape(-1)
        gray = self.grays[frame].cpu()[v, u].int()
        depth = (self.images[frame].cpu().int()[v, u] * UNIT).float()
        words = [u.int() | v.int() << 16, depth.view(torch.int32), gray | gray << 8 | gray << 16]
        return torch.stack(words, 1).to(self.device)

    def motion(self, frame):
        return ops.FrameMotion(frame - 1, INTERVAL, self.offsets[frame]) if frame else ops.NO_MOTION

    def keyframes(self, frame, others, delay):
        motions = tuple(self.motion(other) for other in others)
        timing = ops.ColorTiming(delay, motions, self.motion(frame))
        rows = tuple((other, other) for other in others)
        return ops.DepthKeyframes(self.images, UNIT, self.poses, rows, CAMERA, 0.01, 0, self.grays, timing)

    def shutter(self, frame, readout):
        return ops.ShutterMotion(self.poses[frame - 1], self.poses[frame], INTERVAL, readout)


def _rectified(recording, frame, readout):
    """Its images, and its records."""
    motion = recording.shutter(frame, readout)
    images = recording.images[frame].clone(), recording.grays[frame].clone()
    ops.rectify_shutter_images_(*images, *(one.clone() for one in images), motion, CAMERA, unit=UNIT)
    records = recording.records(frame)
    ops.rectify_shutter_records_(records, records, motion, CAMERA, height=SHAPE[0], width=SHAPE[1])
    return *images, records


def _measured(recording, noise, rounds=3):
    """The timing after all frames, each rectified by what is known of the readout when it comes."""
    timing = ops.CaptureTiming.unknown(recording.device)
    read = recording.images.clone(), recording.grays.clone()
    for _ in range(rounds):
        for frame in range(14, len(recording.poses)):
            others = frame - 1, frame - 6, frame - 12
            for one in (*others, frame):
                recording.images[one], recording.grays[one] = (part[one] for part in read)
                images = _rectified(recording, one, timing.seconds[1:])
                recording.images[one], recording.grays[one] = images[:2]
            keyframes = recording.keyframes(frame, others, timing.color_delay)
            ops.measure_capture_timing_(
                timing, recording.records(frame), recording.poses[frame], CAMERA, noise, keyframes
            )
    return timing


@pytest.mark.parametrize(("delay", "readout"), [(0.0, 0.0), (0.012, 0.0), (-0.008, 0.0), (0.0, 0.02), (0.01, -0.015)])
def test_times_are_found(delay, readout, device):
    recording = Recording(30, delay, readout, device)
    timing = _measured(recording, noise_model(*NOISE, device=device))
    found = timing.state[:, 0].cpu()
    # Between two frames the camera does not move evenly, which is what both ops take it to do.
    torch.testing.assert_close(found, torch.tensor([delay, readout], dtype=torch.float64), rtol=0.15, atol=0.001)
    assert timing.seconds.cpu().tolist() == [
        float(one.float()) if abs(one) >= least else 0.0 for one, least in zip(found, (0.0015, 0.003), strict=True)
    ]


def test_a_long_readout_is_found_within_six_frames(device):
    timing = _measured(Recording(20, readout=0.03, device=device), noise_model(*NOISE, device=device), rounds=1)
    assert 0.022 < float(timing.state[1, 0]) < 0.033


def test_keyframes_may_be_rectified_by_another_readout(device):
    recording, noise = Recording(18, readout=0.03, device=device), noise_model(*NOISE, device=device)
    read = recording.images.clone(), recording.grays.clone()
    known, found = torch.tensor([0.0, 0.03], device=device), []
    records = _rectified(recording, 17, known[1:])[2]
    for by, is_said in ((0.03, False), (0.01, True), (0.01, False)):
        readouts = torch.full((18,), by, device=device)
        for one in (11, 16):
            recording.images[one], recording.grays[one] = (part[one] for part in read)
            recording.images[one], recording.grays[one] = _rectified(recording, one, readouts[:1])[:2]
        state = torch.tensor([[0.0, 1e5], [0.03, 1e5]], dtype=torch.float64, device=device)
        timing = ops.CaptureTiming(known.clone(), state)
        keyframes = recording.keyframes(17, (11, 16), timing.color_delay)
        times = keyframes.timing._replace(readouts=readouts if is_said else None)
        keyframes = keyframes._replace(timing=times)
        ops.measure_capture_timing_(timing, records, recording.poses[17], CAMERA, noise, keyframes)
        found.append(float(timing.state[1, 0]))
    assert found[:2] == pytest.approx([0.03, 0.03], abs=0.0005)  # the camera does not move quite evenly
    assert abs(found[2] - 0.03) > 0.004  # where nobody says by which they were


def test_the_delay_beyond_what_stamps_say_is_found(device):
    offsets = [0.01 * (i % 3 - 1) for i in range(30)]
    noise = noise_model(*NOISE, device=device)
    stamped = _measured(Recording(30, 0.008, device=device, offsets=offsets), noise)
    even = _measured(Recording(30, 0.008, device=device), noise)
    torch.testing.assert_close(stamped.state[0, 0].cpu(), torch.tensor(0.008).double(), rtol=0.15, atol=0.001)
    assert abs(float(stamped.state[0, 0] - even.state[0, 0])) < 0.001


def test_a_camera_that_stands_still_tells_nothing(device):
    recording, noise = Recording(4, 0.02, device=device), noise_model(*NOISE, device=device)
    recording.poses[:] = recording.poses[:1].clone()
    timing = ops.CaptureTiming.unknown(device)
    keyframes = recording.keyframes(3, (1, 2), timing.color_delay)
    ops.measure_capture_timing_(timing, recording.records(3), recording.poses[3], CAMERA, noise, keyframes)
    assert not timing.state.any()


@pytest.mark.parametrize("unknown", ["frame", "keyframes", "pixels"])
def test_unknown_motion_and_no_pixels_tell_nothing(unknown, device):
    recording, noise = Recording(14, 0.02, device=device), noise_model(*NOISE, device=device)
    found = []
    for leave_out in (False, True):
        timing = ops.CaptureTiming.unknown(device)
        keyframes = recording.keyframes(13, (1, 6), timing.color_delay)
        records, known = recording.records(13), keyframes.timing
        if leave_out and unknown == "frame":
            known = known._replace(frame=ops.NO_MOTION)
        elif leave_out and unknown == "keyframes":
            known = known._replace(keyframes=(ops.NO_MOTION,) * 2)
        elif leave_out:
            records = records[:0]
        keyframes = keyframes._replace(timing=known)
        ops.measure_capture_timing_(timing, records, recording.poses[13], CAMERA, noise, keyframes)
        found.append(bool(timing.state.any()))
    assert found == [True, False]


@pytest.mark.parametrize("where", ["pixels", "pose", "before"])
def test_pixels_and_poses_that_are_not_finite_tell_nothing(where, device):
    recording, noise = Recording(4, 0.02, device=device), noise_model(*NOISE, device=device)
    timing = ops.CaptureTiming.unknown(device)
    keyframes, records = recording.keyframes(3, (1,), timing.color_delay), recording.records(3)
    pose = recording.poses[3].clone()
    if where == "pixels":
        records[:, 1] = torch.tensor([torch.nan], device=device).view(torch.int32)
    else:
        recording.poses[2 if where == "before" else 3, 4] = torch.nan
        pose = recording.poses[3]
    ops.measure_capture_timing_(timing, records, pose, CAMERA, noise, keyframes)
    assert not timing.state.any()


def test_records_and_poses_that_are_not_finite_stay(device):
    recording = Recording(3, readout=0.02, device=device)
    motion, records = recording.shutter(2, torch.tensor([0.02], device=device)), recording.records(2)
    records[::2, 1] = torch.tensor([torch.nan], device=device).view(torch.int32)
    records[1::2, 1] = torch.tensor([torch.inf], device=device).view(torch.int32)
    out = torch.zeros_like(records)
    ops.rectify_shutter_records_(out, records, motion, CAMERA, height=SHAPE[0], width=SHAPE[1])
    assert torch.equal(out, records)
    nowhere = motion._replace(pose=torch.full((7,), torch.nan, device=device))
    records, read = recording.records(2), (recording.images[2], recording.grays[2])
    images = tuple(torch.zeros_like(one) for one in read)
    ops.rectify_shutter_records_(out, records, nowhere, CAMERA, height=SHAPE[0], width=SHAPE[1])
    ops.rectify_shutter_images_(*images, *read, nowhere, CAMERA, unit=UNIT)
    assert torch.equal(out, records)
    assert all(torch.equal(one.int(), other.int()) for one, other in zip(images, read, strict=True))


def test_devices_agree(device, generator):
    if torch.device(device).type == "cpu":
        pytest.skip("compares with the CPU")
    found = []
    for place in ("cpu", device):
        recording = Recording(20, 0.01, 0.01, place)
        found.append(_measured(recording, noise_model(*NOISE, device=place), rounds=1).state.cpu())
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("readout", [0.02, -0.02])
def test_rectified_images_are_those_of_one_moment(readout, device):
    read, wanted = Recording(12, readout=readout, device=device), Recording(12, device=device)
    frame = 11
    depth, intensity, records = _rectified(read, frame, torch.tensor([readout], device=device))
    inner = slice(12, -12), slice(12, -12)

    def off(image, of):
        """Median difference; of the nearest pixel's depth, and at the corner's edges, single pixels are off by more."""
        return float((image[inner].cpu().double() - of[frame][inner].cpu().double()).abs().median())

    assert off(depth, wanted.images) < 0.25 * off(read.images[frame], wanted.images)
    assert off(intensity, wanted.grays) < 0.25 * off(read.grays[frame], wanted.grays)
    u, v = (records[:, 0] & 0xFFFF).long().cpu(), (records[:, 0] >> 16).long().cpu()
    of_records = records[:, 1].contiguous().view(torch.float32).cpu().double()
    error = (of_records - wanted.depth[frame][v, u]).abs()
    assert float(error.median()) < 0.5 * float((read.depth[frame] - wanted.depth[frame]).abs().median())


def test_without_a_readout_or_after_a_jump_a_frame_stays(device):
    recording = Recording(3, readout=0.02, device=device)
    none, long = torch.zeros(1, device=device), torch.tensor([0.02], device=device)
    far = recording.poses[1].clone()
    far[4] += 1.0
    for motion in (recording.shutter(2, none), recording.shutter(2, long)._replace(before=far)):
        images = torch.zeros_like(recording.images[2]), torch.zeros_like(recording.grays[2])
        ops.rectify_shutter_images_(*images, recording.images[2], recording.grays[2], motion, CAMERA, unit=UNIT)
        assert torch.equal(images[0].int(), recording.images[2].int())
        assert torch.equal(images[1], recording.grays[2])
        records, out = recording.records(2), torch.zeros_like(recording.records(2))
        ops.rectify_shutter_records_(out, records, motion, CAMERA, height=SHAPE[0], width=SHAPE[1])
        assert torch.equal(out, records)


def test_unknown_depth_stays_unknown(device):
    recording = Recording(3, readout=0.02, device=device)
    recording.images[2] = 0
    motion = recording.shutter(2, torch.tensor([0.02], device=device))
    depth, intensity = torch.full_like(recording.images[2], 7), recording.grays[2].clone()
    ops.rectify_shutter_images_(depth, intensity, recording.images[2], recording.grays[2], motion, CAMERA, unit=UNIT)
    assert not depth.int().any()


def test_late_colors_bend_a_pose_unless_their_delay_is_known(device):
    """Brightness is worth far more than depth here."""
    delay, frame = 0.015, 20
    recording = Recording(frame + 1, delay, device=device)
    noise = noise_model(1e-2, 0.0, 1e-6, 0.0, device=device)
    options = ops.GaussNewtonOptions(
        num_pixels=2048, iterations=20, truncation=0.08, kernel_start=0.5, kernel_end=0.5, damping=1e-6, seed=0,
        stream=ops.RandomStream.TRACKING_PIXELS, frame=0,
    )  # fmt: skip
    errors = {}
    for known in (0.0, delay):
        heeded = torch.tensor([known], device=device)
        keyframes = recording.keyframes(frame, (frame - 6, frame - 12), heeded)
        pose, _, _ = ops.track_gauss_newton(
            ops.SceneView.empty(device=device), recording.records(frame), recording.poses[frame], CAMERA, options,
            noise=noise, depth_keyframes=keyframes,
        )  # fmt: skip
        turn = 2 * (pose[1:4] - recording.poses[frame, 1:4]).norm()
        errors[known] = float(turn + (pose[4:] - recording.poses[frame, 4:]).norm())
    assert errors[delay] < 0.3 * errors[0.0]
    assert errors[0.0] > 0.003


def test_an_offset_of_all_stamps_is_a_delay(device):
    noise, poses = noise_model(*NOISE, device=device), []
    options = ops.GaussNewtonOptions(
        num_pixels=512, iterations=4, truncation=0.08, kernel_start=0.5, kernel_end=0.5, damping=1e-6, seed=0,
        stream=ops.RandomStream.TRACKING_PIXELS, frame=0,
    )  # fmt: skip
    for delay, offset in ((0.0125, 0.0), (0.0, 0.0125), (0.0, 0.0), (0.0125, -0.0125)):
        recording = Recording(15, delay + offset, device=device)
        recording.offsets = [offset] * 15
        keyframes = recording.keyframes(14, (8, 2), torch.tensor([delay], device=device))
        tracked = ops.track_gauss_newton(
            ops.SceneView.empty(device=device), recording.records(14), recording.poses[14], CAMERA, options,
            noise=noise, depth_keyframes=keyframes,
        )  # fmt: skip
        poses.append(tracked[0])
    torch.testing.assert_close(poses[0], poses[1], rtol=0, atol=1e-6)
    torch.testing.assert_close(poses[2], poses[3], rtol=0, atol=1e-6)
    assert (poses[0] - poses[2]).abs().max() > 1e-5


def test_opcheck(device):
    recording, noise = Recording(4, 0.01), noise_model(*NOISE)
    timing = ops.CaptureTiming.unknown()
    keyframes = recording.keyframes(3, (1, 2), timing.color_delay)
    opcheck(
        torch.ops.spslam.measure_capture_timing_,
        (
            timing.state,
            timing.seconds,
            recording.records(3),
            recording.poses[3],
            noise,
            list(CAMERA),
            *keyframes.arguments(),
        ),
        device,
    )
    motion = recording.shutter(3, torch.tensor([0.01]))
    poses = motion.before, motion.pose, motion.readout
    records = recording.records(3)
    opcheck(
        torch.ops.spslam.rectify_shutter_records_,
        (records.clone(), records, *poses, [*CAMERA, INTERVAL], *SHAPE),
        device,
    )
    images = recording.images[3], recording.grays[3]
    opcheck(
        torch.ops.spslam.rectify_shutter_images_,
        (*(one.clone() for one in images), *images, *poses, [*CAMERA, INTERVAL, UNIT]),
        device,
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(motions=1), "have 2 motions"),
        (dict(row=99), "name poses that are there and positive times"),
        (dict(seconds=0.0), "name poses that are there and positive times"),
        (dict(offset=float("nan")), "have finite color offsets"),
        (dict(delay=torch.zeros(2)), "depth_keyframes.timing.delay"),
        (dict(intensities=None), "come with intensities"),
        (dict(timing=None), "have a timing"),
    ],
)
def test_errors(change, message):
    recording, timing = Recording(4), ops.CaptureTiming.unknown()
    motion = ops.FrameMotion(change.get("row", 1), change.get("seconds", INTERVAL), change.get("offset", 0.0))
    own = ops.ColorTiming(change.get("delay", timing.color_delay), (motion,) * change.get("motions", 2), motion)
    keyframes = recording.keyframes(3, (1, 2), timing.color_delay)._replace(timing=change.get("timing", own))
    keyframes = keyframes._replace(intensities=change.get("intensities", recording.grays))
    with pytest.raises((TypeError, ValueError), match=message):
        ops.measure_capture_timing_(
            timing, recording.records(3), recording.poses[3], CAMERA, noise_model(*NOISE), keyframes
        )


def test_errors_of_rectification():
    recording = Recording(3)
    motion, records = recording.shutter(2, torch.zeros(1)), recording.records(2)
    with pytest.raises(ValueError, match=r"motion\.seconds must be positive"):
        ops.rectify_shutter_records_(records, records, motion._replace(seconds=0.0), CAMERA, height=9, width=9)
    with pytest.raises(ValueError, match="height must be above 1"):
        ops.rectify_shutter_records_(records, records, motion, CAMERA, height=1, width=9)
    row = torch.zeros(1, 5, dtype=torch.uint16), torch.zeros(1, 5, dtype=torch.uint8)
    with pytest.raises(ValueError, match="at least two rows and columns"):
        ops.rectify_shutter_images_(*row, *row, motion, CAMERA, unit=UNIT)


def test_what_would_lie_behind_the_camera_has_no_depth(device):
    """A pixel 1 mm away, read by a camera that moves by centimeters until the middle row is read."""
    depth = torch.full((8, 8), 1, dtype=torch.uint16, device=device)
    poses = torch.tensor([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0, 0.1]], device=device)
    motion = ops.ShutterMotion(poses[0], poses[1], 0.1, torch.tensor([0.1], device=device))
    moved = torch.zeros_like(depth), torch.zeros(8, 8, dtype=torch.uint8, device=device)
    ops.rectify_shutter_images_(
        *moved, depth, torch.zeros_like(moved[1]), motion, ops.Intrinsics(8, 8, 3.5, 3.5), unit=1e-3
    )
    rows = moved[0].cpu().int()[:, 0].tolist()
    assert rows[:4] == [0] * 4 and max(rows) < 100
