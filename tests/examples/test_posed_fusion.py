"""The example reconstructs the generated room from its true poses."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import trimesh

from spslam.datasets.room import Room

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "examples" / "posed_fusion.py"


def run(*arguments):
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)


def test_room_is_reconstructed(tmp_path):
    path = tmp_path / "mesh.ply"
    finished = run(path, "--frames", 10)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.startswith("10 frames, ")
    distance = np.abs(Room().signed_distance(np.asarray(trimesh.load(path, process=False).vertices)))
    # Depth is noisy and voxels are 4 cm: what is left is the prior's exactness, and fringes at depth jumps.
    assert np.median(distance) < 0.003
    assert np.mean(distance < 0.02) > 0.95


def test_poses_are_needed(tmp_path):
    finished = run(tmp_path / "mesh.ply", "--data", tmp_path)
    assert finished.returncode != 0
    assert not (tmp_path / "mesh.ply").exists()
