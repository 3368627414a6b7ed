"""Evaluation of a finished run, on a run whose output is exact by construction."""

import json
import shutil
from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest
import trimesh

from spslam.datasets.base import Subset
from spslam.datasets.generated import GeneratedDataset
from spslam.datasets.room import Room
from spslam.errors import DatasetError, OutputError
from spslam.evaluation import finished_run
from spslam.evaluation.finished_run import add_metrics, surface_figures, trajectory_figures, view_figures
from spslam.evaluation.run_output import RunOutput, match_times
from spslam.evaluation.surface import TriangleSurface
from spslam.geometry import pose_from
from spslam.scene import Scene, SceneSettings
from spslam.trajectory import Trajectory

QUICK = {"samples": 5_000, "novel_views": 5}  # enough for all that isn't about the figures' exactness
TURN = pose_from(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([1.0, 2.0, 3.0]))


class MeshedOnce(Room):
    """The room, whose mesh every evaluation asks for."""

    @cached_property
    def _meshed(self):
        return super().mesh()

    def mesh(self, longest_edge_m=0.05):
        assert longest_edge_m == 0.05
        return self._meshed


@pytest.fixture(scope="module")
def room():
    dataset = GeneratedDataset(frames=12, width=80, height=60)
    dataset.room = MeshedOnce()
    return dataset


@pytest.fixture(scope="module")
def perfect(tmp_path_factory, room):
    """The true trajectory and surface, in a world of their own."""
    folder = tmp_path_factory.mktemp("perfect")
    part = Subset(room, 0, 12, 2)
    poses = part.poses()
    Trajectory(part.timestamps(), TURN @ poses).save_tum(folder / "trajectory.txt")
    (folder / "previews").mkdir()
    Trajectory(part.timestamps(), poses).save_tum(folder / "previews" / "ground_truth.txt")
    (folder / "metrics.json").write_text('{"frames": 6}')
    vertices, faces, _ = room.room.mesh()
    moved = vertices @ TURN[:3, :3].T + TURN[:3, 3]
    trimesh.Trimesh(moved, faces, process=False).export(folder / "mesh.ply")
    return folder


@pytest.fixture
def output(tmp_path, perfect):
    """A copy of the perfect run that a test may corrupt."""
    return shutil.copytree(perfect, tmp_path / "out")


def test_a_perfect_run_has_perfect_metrics(output, room):
    run = RunOutput.read(output)
    figures = trajectory_figures(run)
    assert figures["ate_rmse_cm"] < 1e-4
    assert figures["rpe_cm"] < 1e-4
    figures = surface_figures(run, room, room.room, samples=20_000, novel_views=50)
    assert figures["f1_5cm"] > 99.9
    assert figures["accuracy_cm"] < 0.1
    assert figures["completeness_cm"] < 0.1
    assert figures["depth_l1_cm"] < 0.1
    assert figures["depth_l1_coverage"] > 99.9
    quick = surface_figures(run, room, room.room, samples=2000, novel_views=0)
    assert quick.keys() == {name for name in figures if not name.startswith("depth_l1")}
    assert quick["f1_5cm"] > 99.9


def test_figures_are_the_same_every_time(output, room):
    run = RunOutput.read(output)
    assert surface_figures(run, room, room.room, **QUICK) == surface_figures(run, room, room.room, **QUICK)


class WithoutSomeFrames(Subset):
    """A dataset with two unreadable frames."""

    def read(self, index):
        if index in (2, 6):
            raise DatasetError(f"frame {index} is broken")
        return super().read(index)


def test_unreadable_frames_are_skipped(output, room):
    broken = WithoutSomeFrames(room)
    assert surface_figures(RunOutput.read(output), broken, room.room, **QUICK)["f1_5cm"] > 99.9


def test_observed_is_what_frames_with_a_pose_saw(output, room, monkeypatch):
    """Of all frames evenly spread ones would be the first and the last, neither of which has a pose."""
    monkeypatch.setattr(finished_run, "_CULLING_FRAMES", 2)
    path = output / "previews" / "ground_truth.txt"
    known = Trajectory.load_tum(path)
    Trajectory(known.timestamps[1:-1], known.poses[1:-1]).save_tum(path)
    assert surface_figures(RunOutput.read(output), room, room.room, **QUICK)["f1_5cm"] > 99.9


class WithoutFrames(Subset):
    """A dataset of which no frame can be read."""

    def read(self, index):
        raise DatasetError(f"frame {index} is broken")


def test_figures_need_frames_that_saw_the_surface(output, room):
    run = RunOutput.read(output)
    with pytest.raises(OutputError, match=r"none of 6 frames can be read; restore the data \(frame 0 is broken\)"):
        surface_figures(run, WithoutFrames(room), room.room, **QUICK)
    vertices, faces = room.room.triangles()
    with pytest.raises(OutputError, match="nothing of the ground-truth surface is seen .* in their world"):
        surface_figures(run, room, TriangleSurface(vertices + 100, faces), **QUICK)
    ground_truth = np.where(np.arange(6)[:, None, None] < 3, run.ground_truth, np.nan)
    with pytest.raises(OutputError, match="none of the run's frames that are in generated has a known pose"):
        surface_figures(replace(run, ground_truth=ground_truth), Subset(room, 6, 12), room.room, **QUICK)
    mesh = trimesh.load(output / "mesh.ply", process=False)
    trimesh.Trimesh(0 * mesh.vertices, mesh.faces, process=False).export(output / "mesh.ply")
    with pytest.raises(OutputError, match="no face of its mesh has an area; `spslam mesh` makes another"):
        surface_figures(run, room, room.room, **QUICK)


def test_a_mesh_is_aligned_by_tracked_frames(output, room):
    path, lost = output / "trajectory.txt", np.arange(6) >= 2
    tracked = Trajectory.load_tum(path)
    Trajectory(tracked.timestamps, tracked.poses, lost).save_tum(path)
    known = Trajectory.load_tum(output / "previews" / "ground_truth.txt")
    Trajectory(known.timestamps[lost], known.poses[lost]).save_tum(output / "previews" / "ground_truth.txt")
    run = RunOutput.read(output)
    assert trajectory_figures(run, with_scale=True) == {}
    with pytest.raises(OutputError, match="no tracked frame has a ground-truth pose, so the mesh can't be aligned"):
        surface_figures(run, room, room.room, **QUICK)


def test_rendered_views_need_a_map_and_a_mesh(output, room):
    with pytest.raises(OutputError, match="has no map.safetensors to render"):
        view_figures(RunOutput.read(output), room)
    Scene(SceneSettings(0.04, 0.08, 0.04, 0.25, 1000), seed=0).save(output / "map.safetensors")
    figures = view_figures(RunOutput.read(output), room)
    # The mesh is that of the room, but the map has no colors.
    assert figures["view_coverage"] > 99.9
    assert 3 < figures["psnr_db"] < 20
    assert figures["ssim"] < 0.9
    (output / "mesh.ply").unlink()
    with pytest.raises(OutputError, match="has no mesh to evaluate"):
        view_figures(RunOutput.read(output), room)


def test_metrics_with_scale_have_their_own_names(output):
    figures = trajectory_figures(RunOutput.read(output), with_scale=True)
    assert figures["ate_scale"] == pytest.approx(1, abs=1e-6)
    assert {"ate_rmse_cm", "ate_scaled_rmse_cm"} <= figures.keys()


def test_a_straight_trajectory_determines_the_rotation(output, room):
    run = RunOutput.read(output)
    line = run.trajectory.poses[:1].repeat(6, axis=0)
    line[:, :3, 3] += np.outer(np.arange(6), [0.02, 0, 0])
    Trajectory(run.trajectory.timestamps, line).save_tum(output / "trajectory.txt")
    Trajectory(run.trajectory.timestamps, np.linalg.inv(TURN) @ line).save_tum(output / "previews" / "ground_truth.txt")
    assert surface_figures(RunOutput.read(output), room, room.room, **QUICK)["accuracy_cm"] < 0.1


def test_a_shifted_mesh_has_worse_metrics(output, room):
    mesh = trimesh.load(output / "mesh.ply", process=False)
    mesh.apply_translation([0.08, 0, 0])
    mesh.export(output / "mesh.ply")
    figures = surface_figures(RunOutput.read(output), room, room.room, **QUICK)
    assert figures["f1_5cm"] < 95
    assert figures["accuracy_cm"] > 1


def test_no_ground_truth_gives_no_trajectory_metrics(output):
    (output / "previews" / "ground_truth.txt").unlink()
    assert trajectory_figures(RunOutput.read(output)) == {}


def test_a_run_over_other_data_is_refused(output, room):
    Trajectory(np.array([1e3]), np.eye(4)[None]).save_tum(output / "trajectory.txt")
    with pytest.raises(OutputError, match="must be a run over generated, but has none of its frames"):
        surface_figures(RunOutput.read(output), room, room.room)


def test_a_run_without_mesh_is_refused(output, room):
    (output / "mesh.ply").unlink()
    with pytest.raises(OutputError, match="has no mesh to evaluate; `spslam mesh"):
        surface_figures(RunOutput.read(output), room, room.room)


def test_metrics_are_added_to_the_existing_ones(output):
    run = RunOutput.read(output)
    assert add_metrics(run, {"f1_5cm": 98.0}) == {"frames": 6, "f1_5cm": 98.0}
    assert json.loads((output / "metrics.json").read_text()) == {"frames": 6, "f1_5cm": 98.0}


@pytest.mark.parametrize(
    ("times", "wanted", "rows"),
    [
        ([], [1.0], [-1]),
        ([1.0], [1.0, 2.0], [0, -1]),
        ([1.0, 2.0, 3.0], [3.0000004, 0.9999996, 2.5], [2, 0, -1]),
        ([3.0, 1.0, 2.0], [1.0, 3.0], [1, 0]),
        ([1.0, 2.0], [], []),
    ],
)
def test_timestamps_are_matched_to_the_microsecond(times, wanted, rows):
    assert match_times(np.array(times), np.array(wanted)).tolist() == rows
