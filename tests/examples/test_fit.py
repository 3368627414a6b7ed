"""The examples fit fields whose surfaces are where they belong, and the page that explains them shows their code."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from spslam.datasets.room import Room
from tests.examples.recordings import write_with_gaps

ROOT = Path(__file__).parents[2]


def run(name, *arguments):
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_sphere_is_fitted(tmp_path, device):
    path = tmp_path / "ball.obj"
    finished = run("fit_sphere.py", "--mesh", path, "--device", device)
    assert finished.returncode == 0, finished.stderr
    distance = np.abs(np.linalg.norm(trimesh.load(path, process=False).vertices, axis=1) - 0.5)
    assert np.mean(distance < 0.01) > 0.97
    assert np.median(distance) < 0.002
    assert re.match(r"\d+ voxels, \d+ vertices, [\d.]+ % within 1 cm, median [\d.]+ mm\n$", finished.stdout)


def test_room_is_fitted(tmp_path):
    path = tmp_path / "room.obj"
    finished = run("fit_rgbd.py", path, "--frames", 8, "--steps", 150)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.startswith("8 frames, ")
    distance = np.abs(Room().signed_distance(np.asarray(trimesh.load(path, process=False).vertices)))
    # Voxels of 8 cm with a smooth field in them: edges of furniture are rounded.
    assert np.median(distance) < 0.005
    assert np.mean(distance < 0.02) > 0.85


def test_frames_without_pose_or_depth_are_left_out(tmp_path):
    write_with_gaps(tmp_path / "recording", 4)
    finished = run("fit_rgbd.py", tmp_path / "room.obj", "--data", tmp_path / "recording", "--steps", 5)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.startswith("3 frames, ")


def test_poses_are_needed(tmp_path):
    finished = run("fit_rgbd.py", tmp_path / "room.obj", "--data", tmp_path)
    assert finished.returncode != 0
    assert not (tmp_path / "room.obj").exists()


def test_the_page_shows_the_example():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/fit-your-field.md").read_text("utf-8"), re.DOTALL)
    script = (ROOT / "examples/fit_sphere.py").read_text("utf-8")
    assert len(blocks) >= 4
    assert all(block.rstrip() in script for block in blocks)
