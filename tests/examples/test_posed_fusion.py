"""The example reconstructs the generated room from its ground-truth poses."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from spslam.datasets.room import Room
from tests.examples.recordings import write_with_gaps

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "examples" / "posed_fusion.py"


def run(*arguments):
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)


def test_room_is_reconstructed(tmp_path):
    path = tmp_path / "mesh.ply"
    finished = run(path, "--frames", 10)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.startswith("10 frames, ")
    distance = np.abs(Room().signed_distance(np.asarray(trimesh.load(path, process=False).vertices)))
    # The tolerance covers noisy depth, the accuracy of the prior at 4 cm voxels, and fringes at depth discontinuities.
    assert np.median(distance) < 0.003
    assert np.mean(distance < 0.02) > 0.95


def test_poses_are_needed(tmp_path):
    finished = run(tmp_path / "mesh.ply", "--data", tmp_path)
    assert finished.returncode != 0
    assert not (tmp_path / "mesh.ply").exists()


def test_frames_without_pose_or_depth_are_left_out(tmp_path):
    write_with_gaps(tmp_path / "recording", 4)
    finished = run(tmp_path / "mesh.ply", "--data", tmp_path / "recording")
    assert finished.returncode == 0, finished.stderr
    assert (tmp_path / "mesh.ply").exists()


@pytest.mark.cuda
def test_voxels_are_the_same_on_a_gpu(tmp_path):
    """Vertices and their weights are equal on every device; the surface differs by rounding."""
    finished = [run(tmp_path / f"{name}.ply", "--frames", 3, "--device", name) for name in ("cpu", "cuda")]
    assert [one.returncode for one in finished] == [0, 0], [one.stderr for one in finished]
    lines = [one.stdout.split(", ") for one in finished]
    assert lines[0][:2] == lines[1][:2]
    counts = [int(line[3].split()[0]) for line in lines]
    assert abs(counts[0] - counts[1]) < 0.01 * counts[0]
