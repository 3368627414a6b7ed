"""Maps opened again and joined: poses in the first run's world, and one line where two places are not one."""

import json
import os
import shutil

import numpy as np
import pytest

from spslam.config import dump_config, load_config
from spslam.datasets import open_dataset
from spslam.errors import ConfigError, OutputError, SpslamError
from spslam.evaluation.run_output import match_times
from spslam.run import merge
from spslam.run.merge import MergeRequest, merge_runs
from spslam.run.sequence import RunRequest, run_sequence
from spslam.run_folder import RunFolder
from spslam.slam.graph.archive import KeyframeArchive
from spslam.slam.system import SlamSystem
from spslam.trajectory import Trajectory
from tests.cli.command import assert_refused, spslam

SETTINGS = (
    "dataset.frames=240",
    "dataset.width=160",
    "dataset.height=120",
    "dataset.color_noise=0",
    "mapping.first_iterations=30",
    "mesh.resolution_m=0.04",
    "graph.every=20",
    "graph.max_translation_m=0.08",
    "graph.max_rotation_deg=5",
    "run.previews=0",
    "run.prefetch_workers=1",
    "run.data_check=skip",
)
FIRST, SECOND = slice(0, 40), slice(36, 70)


def settings(*overrides):
    return load_config("places", None, [*SETTINGS, *overrides])


def run(output, frames, *overrides, **request):
    run_sequence(RunRequest(settings(*overrides), None, output, frames, **{"mesh": False, **request}))
    return output


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs over different stretches of a room, each in a world of its own, and one over another room."""
    folder = tmp_path_factory.mktemp("runs")
    run(folder / "first", FIRST)
    run(folder / "second", SECOND, "scene.first_pose=identity")
    run(folder / "elsewhere", slice(0, 20), "dataset.seed=5")
    return folder


@pytest.fixture(scope="module")
def opened(runs, tmp_path_factory):
    """The second stretch, in the first run's map."""
    return run(tmp_path_factory.mktemp("opened") / "run", SECOND, map=runs / "first", mesh=True)


def error_cm(trajectory, dataset):
    """RMS distance of the known poses from the true ones, without any alignment."""
    rows = match_times(dataset.timestamps(), trajectory.timestamps)
    off = trajectory.poses[:, :3, 3] - dataset.poses()[rows][:, :3, 3]
    return 100 * float(np.sqrt((off[~trajectory.lost] ** 2).sum(1).mean()))


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


def test_second_run_is_in_the_world_of_the_first(runs, opened):
    dataset = open_dataset(settings().dataset)
    trajectory = Trajectory.load_tum(RunFolder(opened).trajectory)
    assert len(trajectory) == SECOND.stop - SECOND.start and not trajectory.lost.any()
    assert error_cm(trajectory, dataset) < 1.0
    archive, before = (KeyframeArchive.load(RunFolder(each).keyframes) for each in (opened, runs / "first"))
    assert len(archive.recordings) == 2 and len(archive.keyframes) > len(before.keyframes) > 2
    assert error_cm(archive.recordings[0].trajectory, dataset) < 1.0
    # Old and new keyframes are joined by edges.
    count = len(before.keyframes)
    assert any(edge.source >= count > edge.target for edge in archive.edges if edge.kind == "covisible")


def test_results_are_those_of_the_whole(runs, opened):
    metrics = json.loads(RunFolder(opened).metrics.read_text())
    assert metrics["found_frame"] == 0 and metrics["frames"] == SECOND.stop - SECOND.start
    assert metrics["mesh_frames"] == FIRST.stop + SECOND.stop - SECOND.start
    lines = [json.loads(line) for line in RunFolder(opened).log.read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(len(lines)))
    mesh = RunFolder(opened).mesh.read_bytes()
    assert spslam("mesh", opened, cwd=opened.parent).returncode == 0
    assert RunFolder(opened).mesh.read_bytes() == mesh


@pytest.mark.slow
def test_it_changes_nothing_of_the_map_and_gives_the_same_bytes_again(runs, opened, tmp_path):
    before = contents(runs / "first")
    again = run(tmp_path / "again", SECOND, map=runs / "first")
    assert contents(runs / "first") == before
    for name in ("trajectory.txt", "map.safetensors", "keyframes.safetensors"):
        assert (again / name).read_bytes() == (opened / name).read_bytes(), name


def test_another_camera_goes_on_in_the_map(runs, tmp_path):
    output = run(tmp_path / "run", slice(20, 36), "dataset.width=200", "dataset.height=140", map=runs / "first")
    trajectory = Trajectory.load_tum(RunFolder(output).trajectory)
    assert not trajectory.lost.any() and error_cm(trajectory, open_dataset(settings().dataset)) < 1.5
    archive = KeyframeArchive.load(RunFolder(output).keyframes)
    assert len({keyframe.camera for keyframe in archive.keyframes}) == 2


def test_interrupted_run_in_a_map_is_resumed(runs, opened, tmp_path, monkeypatch):
    output, seen = tmp_path / "run", []

    def stop(done, *_):
        seen.append(done)
        if done == 15:
            raise RuntimeError("stop")

    request = RunRequest(settings("run.checkpoint_every=10"), None, output, SECOND, mesh=False, map=runs / "first")
    with pytest.raises(RuntimeError):
        run_sequence(request, stop)
    run(output, SECOND, "run.checkpoint_every=10", map=runs / "first", resume=True)
    for name in ("trajectory.txt", "map.safetensors", "keyframes.safetensors"):
        assert (output / name).read_bytes() == (opened / name).read_bytes(), name
    with pytest.raises(OutputError, match="other options, data or frames"):
        run(output, SECOND, "run.checkpoint_every=10", map=runs / "second", resume=True)


def test_another_place_is_not_found(runs, tmp_path):
    with pytest.raises(SpslamError, match="not found in the map .*spslam merge"):
        run(tmp_path / "run", slice(0, 12), "dataset.seed=5", map=runs / "first")


def test_merged_runs_are_in_one_world(runs, tmp_path):
    output = tmp_path / "merged"
    metrics = merge_runs(MergeRequest([runs / "first", runs / "second"], output))
    dataset = open_dataset(settings().dataset)
    for number in range(2):
        trajectory = Trajectory.load_tum(RunFolder(output).trajectory_of(number))
        assert error_cm(trajectory, dataset) < 1.5
    assert metrics["closed_loops"] >= 2 and metrics["mesh_frames"] == FIRST.stop + SECOND.stop - SECOND.start
    assert "warnings" not in metrics
    mesh = RunFolder(output).mesh.read_bytes()
    assert spslam("mesh", output, cwd=tmp_path).returncode == 0
    assert RunFolder(output).mesh.read_bytes() == mesh
    again = tmp_path / "again"
    result = spslam("merge", runs / "first", runs / "second", "--output", again, "--no-mesh", cwd=tmp_path)
    assert result.returncode == 0 and "trajectory-2.txt" in result.stdout
    for name in ("map.safetensors", "keyframes.safetensors", "trajectory-1.txt", "trajectory-2.txt"):
        assert (again / name).read_bytes() == (output / name).read_bytes(), name
    # And frames are found in what was merged.
    system = SlamSystem(settings(), dataset.camera)
    system.open_map(again)
    assert np.abs(system.process(dataset[60]).pose - dataset.poses()[60]).max() < 0.02


def test_trajectories_are_in_the_order_of_the_runs_whichever_joins_first(runs, tmp_path, monkeypatch):
    third, output = run(tmp_path / "third", slice(66, 86), "scene.first_pose=identity"), tmp_path / "merged"
    join = merge.join_archives

    def later(joined, archive, registrar):
        """As if the third shared no place but with the second."""
        is_third = len(archive.recordings[0].trajectory) == 20
        return "not yet" if is_third and len(joined.recordings) == 1 else join(joined, archive, registrar)

    monkeypatch.setattr(merge, "join_archives", later)
    folders = [runs / "first", third, runs / "second"]
    assert merge_runs(MergeRequest(folders, output, mesh=False))["merged"] == list(map(str, folders))
    for number, folder in enumerate(folders):
        expected, found = (
            Trajectory.load_tum(path)
            for path in (RunFolder(folder).trajectory, RunFolder(output).trajectory_of(number))
        )
        assert found.timestamps.tolist() == expected.timestamps.tolist()
        assert error_cm(found, open_dataset(settings().dataset)) < 1.5


def test_other_places_are_not_merged(runs, tmp_path):
    result = spslam("merge", runs / "first", runs / "elsewhere", "--output", tmp_path / "out", cwd=tmp_path)
    assert_refused(result, "elsewhere: shares no place with")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("scene.voxel_size_m=0.1", "scene.voxel_size_m must be"),
        ("prior.neighborhood=8", "prior.neighborhood must be 64"),
    ],
)
def test_options_that_clash_are_named(runs, tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        run(tmp_path / "run", SECOND, change, map=runs / "first")
    assert not (tmp_path / "run").exists()


def test_map_needs_a_keyframe_graph(runs, tmp_path):
    request = RunRequest(without_graph(), None, tmp_path / "run", SECOND, mesh=False, map=runs / "first")
    with pytest.raises(ConfigError, match="opened with graph.enabled=true"):
        run_sequence(request)


def without_graph():
    config = settings()
    return config.model_copy(update={"graph": config.graph.model_copy(update={"enabled": False})})


def test_folders_that_hold_no_map_are_refused(runs, tmp_path):
    plain = tmp_path / "plain"
    run_sequence(RunRequest(without_graph(), None, plain, slice(0, 2), mesh=False))
    broken = tmp_path / "broken"
    broken.mkdir()
    for name, content in contents(runs / "first").items():
        (broken / name).write_bytes(content[: len(content) // 2] if name.startswith("keyframes") else content)
    old = tmp_path / "old"
    old.mkdir()
    for name, content in contents(runs / "first").items():
        (old / name).write_bytes(content.replace(b"spslam-keyframes-1", b"spslam-keyframes-0"))
    for folder, message in (
        (tmp_path / "missing", "is no folder"),
        (tmp_path, "must be the output folder of a finished run"),
        (plain, "runs with graph.enabled=true and prior.enabled=true write"),
        (broken, "not a readable keyframe archive"),
        (old, "not a keyframe archive of format"),
    ):
        with pytest.raises(OutputError, match=message) as error:
            run(tmp_path / "run", SECOND, map=folder)
        assert str(folder) in str(error.value) and "\n" not in str(error.value)


def test_a_map_of_one_keyframe_is_refused_as_no_two_can_agree(runs, tmp_path):
    """Even the frame that it is of was said to show no place of it."""
    still = run(tmp_path / "still", slice(0, 1))
    message = f"{still}: its map has one keyframe, and a place is known by two that agree"
    with pytest.raises(OutputError, match=message):
        run(tmp_path / "run", slice(0, 4), map=still)
    for folders in ([runs / "second", still], [still, runs / "second"]):
        with pytest.raises(OutputError, match=message):
            merge_runs(MergeRequest(folders, tmp_path / "out"))
    assert [path.name for path in tmp_path.iterdir()] == ["still"]


def test_merges_that_can_not_be_are_refused(runs, tmp_path):
    for folders, message in (
        ([runs / "first"], "two finished runs"),
        ([runs / "first", runs / "first"], "hold the same frames"),
    ):
        with pytest.raises(OutputError, match=message):
            merge_runs(MergeRequest(folders, tmp_path / "out"))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "file").write_text("")
    with pytest.raises(OutputError, match="is not an empty folder"):
        merge_runs(MergeRequest([runs / "first", runs / "second"], tmp_path / "out"))


def with_options(run_folder, folder, *overrides):
    """A copy of a run, as if it had been made with other options."""
    shutil.copytree(run_folder, folder)
    RunFolder(folder).config.write_text(dump_config(settings(*overrides)))
    return folder


def test_a_map_that_is_not_optimized_is_merged(runs, tmp_path):
    plain = with_options(runs / "first", tmp_path / "plain", "mapping.iterations=0", "mapping.first_iterations=0")
    metrics = merge_runs(MergeRequest([plain, runs / "second"], tmp_path / "out", mesh=False))
    assert metrics["voxels"] > 1000


def test_a_merge_looks_for_places_with_the_options_of_the_first_run(runs, tmp_path):
    plain = with_options(runs / "first", tmp_path / "plain", "tracking.features=false")
    with pytest.raises(ConfigError, match="plain: a merge has the first run's options.*tracking.features=true only"):
        merge_runs(MergeRequest([plain, runs / "second"], tmp_path / "out"))


@pytest.mark.slow
def test_killed_merge_leaves_no_folder(runs, tmp_path, monkeypatch):
    def die(*_):
        raise KeyboardInterrupt

    output = tmp_path / "out"
    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", die)
        with pytest.raises(KeyboardInterrupt):
            merge_runs(MergeRequest([runs / "first", runs / "second"], output, mesh=False))
    assert not output.exists()
    merge_runs(MergeRequest([runs / "first", runs / "second"], output, mesh=False))
    assert [path.name for path in tmp_path.iterdir()] == ["out"] and RunFolder(output).metrics.is_file()


def test_map_is_opened_before_the_first_frame(runs):
    dataset = open_dataset(settings().dataset)
    system = SlamSystem(settings(), dataset.camera)
    system.process(dataset[0])
    with pytest.raises(ValueError, match="before the first frame"):
        system.open_map(runs / "first")
