"""The classical baseline."""

import sys

import numpy as np
import pytest

from spslam.benchmark.gicp import GicpOdometry
from spslam.errors import SpslamError
from spslam.evaluation.trajectory_metrics import ate
from tests.system.sequences import Recorded

FRAMES = 12
VOXEL_M = 0.04
# Measured: 0.01 cm. Flat walls at this image size leave a millimeter.
ATE_CM = 0.1

pytest.importorskip("small_gicp")


def run(dataset, depths):
    odometry = GicpOdometry(dataset.camera, dataset.poses()[0], VOXEL_M)
    for depth in depths:
        odometry.process(depth)
    return odometry


def test_trajectory_is_accurate():
    dataset = Recorded(FRAMES)
    odometry = run(dataset, (frame.depth for frame in dataset))
    poses = np.array(odometry.poses)
    assert not any(odometry.lost)
    np.testing.assert_array_equal(poses[0], dataset.poses()[0])
    assert ate(poses, dataset.poses())["ate_rmse_cm"] < ATE_CM
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (FRAMES, 3, 3)),
                               atol=1e-12)  # fmt: skip


def test_one_thread_is_deterministic():
    dataset = Recorded(5)
    first, second = (run(dataset, (frame.depth for frame in dataset)) for _ in range(2))
    np.testing.assert_array_equal(first.poses, second.poses)


def test_frame_without_depth_is_lost_and_predicted():
    dataset = Recorded(6)
    odometry = run(dataset, (0 * frame.depth if frame.index == 3 else frame.depth for frame in dataset))
    assert odometry.lost == [False, False, False, True, False, False]
    assert ate(np.array(odometry.poses), dataset.poses())["ate_rmse_cm"] < 1.0


def test_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(SpslamError, match=r"needs small_gicp: pip install 'spslam\[bench\]'"):
        GicpOdometry(Recorded(1).camera, np.eye(4))
