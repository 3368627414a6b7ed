"""Brightness that frames have seen and an image shows: point by point in NumPy and by the op; what the op refuses."""

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import inverse, pose7_to_matrix, transform_points
from spslam.slam.depth_keyframes import depth_image_intrinsics, depth_unit
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.appearance import CELLS, MAX_DEPTH_DIFFERENCE
from tests.ops.arguments import opcheck
from tests.slam.compared_frames import moved, poses_of, sampled
from tests.system.sequences import Recorded, settings

FRAMES = 6
POINTS = 1000
MIN_DEPTH_M = 0.05
LEVELS = 65535
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def recorded():
    return Recorded(FRAMES)


@pytest.fixture(scope="module")
def pixels(recorded):
    return sampled(recorded)


def known(recorded, pixels, device):
    """Records and poses of all frames."""
    count = min(len(each.records) for each in pixels)
    return torch.stack([each.records[:count] for each in pixels]).to(device), poses_of(recorded, device)


def shown_of(frame, camera):
    unit = depth_unit(settings().dataset.max_depth_m)
    intrinsics = depth_image_intrinsics(camera)
    return ops.comparison.ShownImages(frame.depth_image, frame.intensity_image, intrinsics, unit)


def sums_by_op(frame, pose, records, poses, rows, camera, points=POINTS):
    intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
    size, shown = (camera.height, camera.width), shown_of(frame, camera)
    frames = records, poses, torch.tensor(rows, dtype=torch.int64, device=records.device)
    return ops.comparison.brightness_sums(frames, points, intrinsics, size, CELLS, pose, shown, MAX_DEPTH_DIFFERENCE)


def expected(frame, pose, records, poses, rows, camera, points=POINTS):
    shown = shown_of(frame, camera)
    depth, intensity, k = shown.depth.cpu().numpy() * shown.unit, shown.intensity.cpu().numpy().astype(float), shown[2]
    into = inverse(pose7_to_matrix(pose.cpu().double().numpy()))
    pairs = {}
    for row in rows:
        words = records[row, :points].cpu().numpy().view(np.uint32)
        to_frame = into @ pose7_to_matrix(poses[row].cpu().double().numpy())
        for place, z, color in zip(words[:, 0], words[:, 1].view(np.float32).astype(float), words[:, 2], strict=True):
            column, line = place & 0xFFFF, place >> 16
            point = z * np.array([(column - camera.cx) / camera.fx, (line - camera.cy) / camera.fy, 1])
            x, y, z = transform_points(to_frame, point[None])[0]
            u, v = x / z * k.fx + k.cx, y / z * k.fy + k.cy
            if z <= MIN_DEPTH_M or not (0 <= u < depth.shape[1] - 1 and 0 <= v < depth.shape[0] - 1):
                continue
            if abs(depth[int(v + 0.5), int(u + 0.5)] - z) >= MAX_DEPTH_DIFFERENCE * z:
                continue
            i, j, a, b = int(v), int(u), u - int(u), v - int(v)
            corners = intensity[i : i + 2, j : j + 2]
            value = np.array([1 - b, b]) @ corners @ np.array([1 - a, a]) / 255
            seen = np.dot([color & 255, color >> 8 & 255, color >> 16 & 255], [299, 587, 114]) / 255000
            cell = row, line * CELLS // camera.height, column * CELLS // camera.width
            pairs.setdefault(cell, []).append((round(seen * LEVELS) / LEVELS, round(value * LEVELS) / LEVELS))
    sums = np.zeros(5)
    for m, b in (np.array(cell).T for cell in pairs.values()):
        m0, b0 = m - m.mean(), b - b.mean()
        sums += len(m), b.sum(), m0 @ m0, b0 @ b0, m0 @ b0
    return sums


@pytest.mark.parametrize("seed", range(4))
def test_sums_by_the_formula(recorded, pixels, device, seed):
    records, poses = known(recorded, pixels, device)
    frame, camera = pixels[seed].to(device), recorded.camera
    pose = pose_tensor(moved(recorded.poses()[seed], seed) if seed else recorded.poses()[1], device)
    for rows in ([5, 0, 3], [2]):
        found = sums_by_op(frame, pose, records, poses, rows, camera).tolist()
        like = expected(frame, pose, records, poses, rows, camera)
        assert like[0] > 20
        # A point at a border may fall on either side, as quaternions of float32 are no unit ones to the last bit, and
        # brightness half-way between two levels too.
        np.testing.assert_allclose(found, like, rtol=1e-2 if found[0] != like[0] else 1e-4)
        assert abs(found[0] - like[0]) <= 1


def test_frames_add_up_and_rows_out_of_range_add_nothing(recorded, pixels, device):
    records, poses = known(recorded, pixels, device)
    call = pixels[2].to(device), poses[2], records, poses
    alone = [sums_by_op(*call, [row], recorded.camera) for row in (1, 4)]
    both = sums_by_op(*call, [1, -1, 4, FRAMES], recorded.camera)  # in another order, so to rounding
    torch.testing.assert_close(both, alone[0] + alone[1], rtol=1e-12, atol=0)
    assert sums_by_op(*call, [], recorded.camera).tolist() == [0.0] * 5
    assert sums_by_op(*call, [1], recorded.camera, points=0).tolist() == [0.0] * 5
    most = sums_by_op(*call, [1], recorded.camera, points=10**6)
    assert torch.equal(most, sums_by_op(*call, [1], recorded.camera, points=records.shape[1]))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_poses_that_are_not_finite_add_nothing(recorded, pixels, device, bad):
    records, poses = known(recorded, pixels, device)
    frame = pixels[2].to(device)
    for own, others in ((torch.full_like(poses[2], bad), poses), (poses[2], torch.full_like(poses, bad))):
        assert sums_by_op(frame, own, records, others, [1, 3], recorded.camera).tolist() == [0.0] * 5


def test_depth_that_is_not_finite_adds_nothing(recorded, pixels, device):
    records, poses = known(recorded, pixels, device)
    records = records.clone()
    records[..., 1] = torch.tensor(float("nan")).view(torch.int32).item()
    assert sums_by_op(pixels[2].to(device), poses[2], records, poses, [2], recorded.camera).tolist() == [0.0] * 5


@pytest.mark.cuda
def test_cuda_sums_the_same(recorded, pixels):
    for seed in range(6):
        found = []
        for device in (CPU, torch.device("cuda")):
            records, poses = known(recorded, pixels, device)
            pose = pose_tensor(moved(recorded.poses()[seed], seed), device)
            found.append(sums_by_op(pixels[seed].to(device), pose, records, poses, range(FRAMES), recorded.camera))
        assert found[0][0] == found[1][0].cpu()
        # Of the same whole numbers, but for fused multiply-adds at the end.
        torch.testing.assert_close(found[0], found[1].cpu(), rtol=1e-12, atol=0)


def raw_call(recorded, pixels, device):
    records, poses = known(recorded, pixels, device)
    camera, frame = recorded.camera, pixels[2].to(device)
    shown = shown_of(frame, camera)
    scalars = [camera.fx, camera.fy, camera.cx, camera.cy, *shown.intrinsics, shown.unit, 0.05]
    rows = torch.arange(FRAMES, device=device)
    integers = [camera.width, camera.height, CELLS, POINTS]
    return [records, poses, rows, poses[2], shown.depth, shown.intensity, scalars, integers]


def test_opcheck(recorded, pixels, device):
    opcheck(torch.ops.spslam.brightness_sums.default, raw_call(recorded, pixels, device), device)


@pytest.mark.parametrize(
    ("argument", "bad"),
    [
        (0, lambda records: records[..., :2]),
        (1, lambda poses: poses[1:]),
        (2, lambda rows: rows[None]),
        (3, lambda pose: pose[:6]),
        (4, lambda depth: depth[1:]),
        (5, lambda intensity: intensity[0]),
        (6, lambda scalars: scalars[1:]),
        (7, lambda integers: [0, *integers[1:]]),
        (7, lambda integers: [*integers[:2], 17, integers[3]]),
        (7, lambda integers: [*integers[:3], -1]),
    ],
)
def test_bad_arguments_are_refused(recorded, pixels, device, argument, bad):
    call = raw_call(recorded, pixels, device)
    call[argument] = bad(call[argument])
    with pytest.raises(RuntimeError, match="brightness_sums: "):
        torch.ops.spslam.brightness_sums(*call)


@pytest.mark.parametrize("argument", range(6))
def test_other_dtypes_are_refused(recorded, pixels, device, argument):
    call = raw_call(recorded, pixels, device)
    call[argument] = call[argument].double()
    with pytest.raises(RuntimeError, match="another dtype"):
        torch.ops.spslam.brightness_sums(*call)
