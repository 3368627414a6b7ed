"""A second start by ICP: the maps it is held against, what it recovers, and that it keeps out of clean runs."""

import numpy as np
import pytest
import torch

from spslam.geometry import pose7_to_matrix, rotation_angle
from spslam.slam.frame_history import EarlierFrame, FrameHistory
from spslam.slam.pixels import sample_frame, unpack_points
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.icp_alignment import IcpAlignment, surface_maps
from spslam.slam.system import SlamSystem
from spslam.slam.tracker import TrackingProblem
from tests.system.sequences import Recorded, settings


@pytest.fixture(scope="module")
def dataset():
    return Recorded(12)


@pytest.fixture(scope="module")
def system(dataset):
    system = SlamSystem(settings(), dataset.camera, dataset.poses()[0])
    system.reports = [system.process(dataset[i]) for i in range(10)]
    return system


@pytest.fixture(scope="module")
def pixels(dataset, system):
    return sample_frame(dataset[10], dataset.camera, system.config)


def moved(pose, shift_m, angle_deg):
    axis = np.array([0.3, -0.8, 0.52]) / np.linalg.norm([0.3, -0.8, 0.52])
    half = np.radians(angle_deg) / 2
    turn = pose7_to_matrix(np.concatenate([[np.cos(half)], np.sin(half) * axis, np.zeros(3)]))
    out = pose.copy()
    out[:3, :3] = turn[:3, :3] @ pose[:3, :3]
    out[:3, 3] += shift_m * np.array([0.6, -0.64, 0.48])
    return pose_tensor(out, torch.device("cpu"))


def earlier(system):
    return EarlierFrame(system.state.pixels.records[-1], system.state.frames.poses[-1])


def assert_near(found, ground_truth, distance_m=0.01, angle_deg=0.5):
    found = pose7_to_matrix(found.double().numpy())
    assert np.linalg.norm(found[:3, 3] - ground_truth[:3, 3]) < distance_m
    assert np.degrees(rotation_angle(found[:3, :3].T @ ground_truth[:3, :3])) < angle_deg


def test_maps_hold_the_first_record_of_each_cell(dataset, pixels, device):
    *maps, k = surface_maps(pixels.to(device), dataset.camera)
    vertices, normals = (tensor.cpu() for tensor in maps)
    rows, columns = vertices.shape[:2]
    assert columns <= 80
    step = -(-dataset.camera.width // columns)
    points = unpack_points(pixels.records, dataset.camera)
    expected = torch.zeros(rows, columns, 3), torch.zeros(rows, columns, 3)
    taken = set()
    for i, (u, v) in enumerate(zip(pixels.records[:, 0] & 0xFFFF, pixels.records[:, 0] >> 16, strict=True)):
        cell = int(v) // step, int(u) // step
        if cell not in taken and pixels.normals[i].any():
            taken.add(cell)
            expected[0][cell], expected[1][cell] = points[i], pixels.normals[i]
    assert torch.equal(normals, expected[1])
    # Devices round a division differently.
    torch.testing.assert_close(vertices, expected[0], rtol=1e-6, atol=1e-6)
    row, column = (vertices[..., 2] > 0).nonzero().T
    x, y, z = vertices[row, column].T
    assert (x / z * k.fx + k.cx + 0.5).floor().eq(column).all()
    assert (y / z * k.fy + k.cy + 0.5).floor().eq(row).all()


def test_a_frame_without_normals_has_empty_maps(dataset, pixels):
    blank = pixels.holding(torch.zeros_like(pixels.buffer))
    vertices, normals, _ = surface_maps(blank, dataset.camera)
    assert not vertices.any()
    assert not normals.any()


@pytest.mark.parametrize(("shift_m", "angle_deg"), [(0.0, 0.0), (0.05, 5.0), (0.1, 10.0)])
def test_icp_leads_to_where_tracking_finds_the_pose(dataset, system, pixels, shift_m, angle_deg):
    ground_truth = dataset.poses()[10]
    alignment, start = IcpAlignment(pixels, dataset.camera), moved(ground_truth, shift_m, angle_deg)
    found = alignment.poses(
        [(earlier(system), start), (earlier(system), pose_tensor(ground_truth, torch.device("cpu")))]
    )
    for pose in found:
        assert_near(pose, ground_truth, distance_m=0.02, angle_deg=2.0)
    assert torch.equal(alignment.poses([(earlier(system), start)])[0], found[0])
    assert alignment.poses([]) == []


@pytest.mark.parametrize(("shift_m", "angle_deg"), [(0.15, 12.0), (50.0, 90.0)])
def test_a_wrong_start_is_recovered(dataset, system, pixels, shift_m, angle_deg):
    ground_truth = dataset.poses()[10]
    start = moved(ground_truth, shift_m, angle_deg)
    alone = system.recovery.judge(system.tracker.track(TrackingProblem(system.state.scene, pixels.records, start, 10)))
    result = system.localize(pixels, start, 10)
    assert alone.lost or alone.fit.mean_robust_weight < system.config.tracking.recovery_min_robust_weight
    assert result.recovered and not result.lost
    assert result.fit.mean_robust_weight > alone.fit.mean_robust_weight
    assert result.iterations > alone.iterations
    assert_near(result.pose, ground_truth)


class Elsewhere(FrameHistory):
    """Frames that were seen in another place."""

    def frame(self, row):
        return EarlierFrame(self._state.pixels.records[row], moved(np.eye(4), 50.0, 90.0))

    def features(self, row):
        return None


def test_what_cannot_be_recovered_stays_lost(dataset, system, pixels):
    """The view of another place: no start helps."""
    start = moved(dataset.poses()[10], 50.0, 90.0)
    problem = TrackingProblem(system.state.scene, pixels.records, start, 10)
    estimate = system.tracker.track(problem)
    features = system.features.of(pixels)
    result = system.recovery.resolve(problem, estimate, pixels, Elsewhere(system.state), False, features)
    assert result.lost and not result.relocalized
    assert torch.equal(result.pose, start)


def test_recovery_can_be_turned_off(dataset, pixels):
    off = ("tracking.recovery=false", "tracking.relocalization_candidates=0")
    plain = SlamSystem(settings(*off), dataset.camera, dataset.poses()[0])
    plain.process(dataset[0])
    result = plain.localize(pixels, moved(dataset.poses()[10], 50.0, 90.0), 10)
    assert result.lost and not result.recovered


def test_a_clean_run_needs_no_recovery(system):
    assert not any(report.recovered or report.lost for report in system.reports)
    assert (
        min(report.fit.mean_robust_weight for report in system.reports[1:])
        > system.config.tracking.recovery_min_robust_weight
    )
    assert max(report.error_probability for report in system.reports[1:]) < system.config.tracking.verify_threshold
