"""What phones' recordings leave out: values of some columns of the odometry, and poses of some frames."""

import json

import numpy as np
import pytest

from spslam.datasets.scannetpp import open_scannetpp
from spslam.datasets.stray_scanner import open_stray_scanner
from tests.datasets.layouts import poses
from tests.datasets.recordings import START_S, write_scannetpp, write_stray_scanner

COUNT = 4


def test_a_stray_scanner_odometry_may_have_columns_without_values(tmp_path):
    pytest.importorskip("av")
    recording = write_stray_scanner(tmp_path, COUNT)
    names, *rows = (recording / "odometry.csv").read_text().splitlines()
    names += ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    lines = [names, *(f"{row}, 120, 124, 63.5, 47.5, , " for row in rows)]
    (recording / "odometry.csv").write_text("\n".join(lines) + "\n")
    dataset = open_stray_scanner(recording)
    np.testing.assert_allclose(dataset.poses(), poses(COUNT), atol=1e-6)
    np.testing.assert_allclose(dataset.timestamps(), START_S + np.arange(COUNT) / 60, atol=1e-6)
    lines[2] = lines[2].replace(rows[1].split(", ")[3], "")
    (recording / "odometry.csv").write_text("\n".join(lines) + "\n")
    assert np.isfinite(open_stray_scanner(recording).poses()).all(axis=(1, 2)).tolist() == [True, False, True, True]


def test_scannetpp_poses_are_of_one_world(tmp_path):
    recording = write_scannetpp(tmp_path, COUNT)
    file = recording / "iphone" / "pose_intrinsic_imu.json"
    frames = json.loads(file.read_text())
    del frames["frame_000001"]["aligned_pose"]
    frames["frame_000002"]["aligned_pose"] = None
    file.write_text(json.dumps(frames))
    found = open_scannetpp(recording).poses()
    assert np.isnan(found[1:3]).all()
    np.testing.assert_allclose(found[[0, 3]], poses(COUNT)[[0, 3]], atol=1e-9)
    for values in frames.values():
        values.pop("aligned_pose", None)
    file.write_text(json.dumps(frames))
    np.testing.assert_array_equal(open_scannetpp(recording).poses(), np.tile(np.eye(4), (COUNT, 1, 1)))
