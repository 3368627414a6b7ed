"""The script that compares colors of meshes at views held out, on a wall of few triangles."""

import numpy as np
import pytest

from experiments.mesh_colors import compare, split
from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.meshing import TriangleMesh
from spslam.trajectory import Trajectory

CAMERA = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)


def wall(gray, half_m=(2.0, 2.0)):
    x, y = half_m
    vertices = np.array([(-x, -y, 1), (x, -y, 1), (x, y, 1), (-x, y, 1)], np.float32)
    colors, normals = np.full((4, 3), gray, np.uint8), np.tile(np.float32([0, 0, -1]), (4, 1))
    return TriangleMesh(vertices, np.array([(0, 1, 2), (0, 2, 3)], np.int32), colors, normals)


def view(color, depth_m=1.0):
    return RgbdFrame(0, 0.0, color, np.full(color.shape[:2], depth_m, np.float32)), np.eye(4)


def test_only_what_all_meshes_show_is_compared():
    """Right of the middle, where the second mesh ends, the first one is wrong."""
    color = np.full((30, 40, 3), 100, np.uint8)
    color[:, 30:] = 255
    whole, part = compare([wall(110), wall(105, (0.3, 2.0))], [view(color)] * 2, CAMERA)
    assert whole["psnr_db"] == pytest.approx(20 * np.log10(255 / 10))
    assert part["psnr_db"] == pytest.approx(20 * np.log10(255 / 5))
    assert whole["coverage"] == 100 and 40 < part["coverage"] < 50


def test_another_surface_than_the_frame_has_is_told_apart():
    color = np.full((30, 40, 3), 100, np.uint8)
    (whole,) = compare([wall(110)], [view(color), view(color, 1.2)], CAMERA)
    assert whole["psnr_db"] == whole["same_db"] == pytest.approx(20 * np.log10(255 / 10))
    (other,) = compare([wall(110)], [view(color, 0.0)], CAMERA)
    assert np.isnan(other["same_db"]) and not np.isnan(other["psnr_db"])


def test_frames_are_fused_or_held_out():
    trajectory = Trajectory(np.arange(10.0), np.tile(np.eye(4), (10, 1, 1)), np.arange(10) == 3)
    fused, held = split(trajectory, 4)
    assert np.flatnonzero(~held.lost).tolist() == [2, 7]
    assert np.flatnonzero(~fused.lost).tolist() == [0, 1, 4, 5, 6, 8, 9]
