"""The script that compares colors of meshes at views held out, on a wall of few triangles."""

import numpy as np
import pytest

from experiments.mesh_colors import compare, split
from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.meshing import TriangleMesh
from spslam.meshing.texture import TexturedMesh
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


def test_a_texture_is_compared_as_it_is_shown():
    """A gradient over 40 columns on two triangles: a texture has it, vertices can't have the checks on it."""
    color = np.tile(
        (40 + 4 * np.arange(40) + 20 * (np.arange(40) // 4 % 2)).astype(np.uint8)[None, :, None], (30, 1, 3)
    )
    # The wall that just fills the image, whose pixels are the texels.
    left, right = (-0.5 - CAMERA.cx) / CAMERA.fx, (39.5 - CAMERA.cx) / CAMERA.fx
    top, bottom = (-0.5 - CAMERA.cy) / CAMERA.fy, (29.5 - CAMERA.cy) / CAMERA.fy
    vertices = np.array([(left, top, 1), (right, top, 1), (right, bottom, 1), (left, bottom, 1)], np.float32)
    plain = wall(110)
    places = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    pages, page_of = color[None], np.zeros(2, np.int32)
    textured = TexturedMesh(vertices, plain.faces, plain.normals, places, page_of, pages, 0.03, 0.03)
    flat, shown = compare([plain, textured], [view(color)], CAMERA)
    assert shown["psnr_db"] > 40 > 20 > flat["psnr_db"]
    brighter = np.clip(1.2 * np.roll(color, 1, axis=1), 0, 255).astype(np.uint8)
    (moved,) = compare([textured], [view(brighter)], CAMERA)
    assert moved["corrected_db"] > moved["psnr_db"] + 1


def test_frames_are_fused_or_held_out():
    trajectory = Trajectory(np.arange(10.0), np.tile(np.eye(4), (10, 1, 1)), np.arange(10) == 3)
    fused, held = split(trajectory, 4)
    assert np.flatnonzero(~held.lost).tolist() == [2, 7]
    assert np.flatnonzero(~fused.lost).tolist() == [0, 1, 4, 5, 6, 8, 9]
