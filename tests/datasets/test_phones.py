"""What phones' recordings leave out: odometry without values in some columns."""

import numpy as np
import pytest

from spslam.datasets.stray_scanner import open_stray_scanner
from tests.datasets.layouts import poses
from tests.datasets.recordings import START_S, write_stray_scanner

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
