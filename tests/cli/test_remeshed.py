"""`spslam mesh` and `eval` on a finished run: what a new mesh replaces, changed data, and sizes that can't be."""

import json
import re
import shutil

import numpy as np
import pytest

from spslam.cli.progress import summarize
from spslam.datasets import export_folder
from spslam.datasets.generated import GeneratedDataset
from spslam.evaluation import finished_run
from spslam.run_folder import RunFolder
from spslam.trajectory import Trajectory
from tests.cli.command import assert_refused, spslam

SMALL = ["--set=pixels.per_frame=3000", "--set=mapping.first_iterations=20", "--set=mapping.iterations=2"]
STALE = {"accuracy_cm": 1.5, "f1_5cm": 50.0, "depth_l1_cm": 3.0, "psnr_db": 20.0, "ssim": 0.5}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a recording in `data` and a finished run over it in `out`."""
    folder = tmp_path_factory.mktemp("finished")
    export_folder(GeneratedDataset(6, 96, 72), folder / "data")
    command = ["run", "folder", "--data", "data", "--output", "out", "--device=cpu", "--set=mesh.resolution_m=0.05"]
    result = spslam(*command, *SMALL, "--quiet", cwd=folder)
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture
def folder(finished, tmp_path):
    """A copy that a test may change."""
    copied = shutil.copytree(finished, tmp_path / "copied")
    config = copied / "out" / "config.yaml"
    config.write_text(config.read_text().replace(str(finished / "data"), str(copied / "data")))
    return copied


def metrics_of(folder):
    return json.loads((folder / "out" / "metrics.json").read_text())


def add_stale(folder):
    (folder / "out" / "metrics.json").write_text(json.dumps({**metrics_of(folder), **STALE}))


def remesh(folder, *arguments):
    result = spslam("mesh", "out", *arguments, cwd=folder)
    assert result.returncode == 0, result.stderr
    return result.stdout


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_figures_of_the_mesh_before_go_with_it(folder):
    add_stale(folder)
    said = remesh(folder, "--resolution", "0.08", "--format", "glb")
    assert "figures of the mesh before" not in said and STALE.items() <= metrics_of(folder).items()
    said = remesh(folder, "--resolution", "0.08", "--source", "neural")
    assert "! the figures of the mesh before were removed; `spslam eval out --gt-mesh PLY --views` measures" in said
    metrics = metrics_of(folder)
    assert not STALE.keys() & metrics.keys() and "mesh_mb" not in metrics
    # The map has nothing coarser than its own voxels.
    assert metrics["mesh_resolution_m"] == 0.04 and metrics["mesh_source"] == "neural" and "ate_rmse_cm" in metrics
    report = (folder / "out" / "report.html").read_text()
    assert "accuracy_cm" not in report and "psnr_db" not in report and "neural" in report
    assert "figures of the mesh before" not in remesh(folder, "--resolution", "0.08")


def test_an_evaluation_replaces_all_its_figures(folder, monkeypatch):
    add_stale(folder)
    monkeypatch.setattr(finished_run, "surface_figures", lambda *_: {"accuracy_cm": 1.0, "f1_5cm": 90.0})
    result = spslam("eval", "out", "--gt-mesh", "out/mesh.ply", cwd=folder)
    assert result.returncode == 0 and "depth L1" not in result.stdout
    metrics = metrics_of(folder)
    assert metrics["accuracy_cm"] == 1.0 and "depth_l1_cm" not in metrics and metrics["psnr_db"] == 20.0
    monkeypatch.setattr(finished_run, "view_figures", lambda *_: {})
    assert "PSNR" not in spslam("eval", "out", "--views", cwd=folder).stdout
    assert not {"psnr_db", "ssim"} & metrics_of(folder).keys() and metrics_of(folder)["f1_5cm"] == 90.0


def test_eval_prints_the_scale(folder):
    result = spslam("eval", "out", "--scale", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert re.search(r"^ATE, scaled +\d+\.\d\d cm\nscale +[01]\.\d{4}$", result.stdout, re.MULTILINE)
    rows = dict(summarize({"ate_scaled_rmse_cm": 1.234, "ate_scale": 1.00561}, folder))
    assert rows["ATE, scaled"] == "1.23 cm" and rows["scale"] == "1.0056"


def test_eval_tells_no_ground_truth_from_none_of_tracked_frames(folder):
    trajectory, ground_truth = folder / "out" / "trajectory.txt", folder / "out" / "previews" / "ground_truth.txt"
    known = Trajectory.load_tum(ground_truth)
    tracked = Trajectory.load_tum(trajectory)
    Trajectory(tracked.timestamps, tracked.poses, np.arange(6) == 5).save_tum(trajectory)
    Trajectory(known.timestamps[5:], known.poses[5:]).save_tum(ground_truth)
    refused = spslam("eval", "out", cwd=folder)
    assert_refused(refused, "out: no tracked frame has a ground-truth pose to compare with; --views evaluates")
    refused = spslam("eval", "out", "--gt-mesh", "out/mesh.ply", cwd=folder)
    assert_refused(refused, "out: no tracked frame has a ground-truth pose, so the mesh can't be aligned")
    ground_truth.unlink()
    refused = spslam("eval", "out", cwd=folder)
    assert_refused(refused, "out: there are no ground-truth poses to compare with; --gt-mesh evaluates the mesh")


@pytest.mark.parametrize("command", [["mesh", "out"], ["eval", "out", "--views"]])
def test_another_camera_is_refused(folder, command):
    intrinsics = folder / "data" / "intrinsics.json"
    values = json.loads(intrinsics.read_text())
    intrinsics.write_text(json.dumps(values | {"fx": 1.1 * values["fx"]}))
    before = contents(folder / "out")
    assert_refused(spslam(*command, cwd=folder), "out: the data has changed since the run, whose camera was 96x72 px")
    assert contents(folder / "out") == before


def test_frames_that_are_gone_are_not_needed_by_the_map_alone(folder):
    (folder / "data").rename(folder / "moved")
    advice = ": no such folder): put them back, or use --source neural, which needs none"
    refused = spslam("mesh", "out", cwd=folder)
    assert_refused(refused, "out: the run's frames can't be read again (")
    assert advice in refused.stderr
    result = spslam("mesh", "out", "--source", "neural", cwd=folder)
    assert result.returncode == 0, result.stderr


def test_missing_and_unreadable_frames_are_said(folder):
    times = folder / "data" / "times.txt"
    lines = times.read_text().splitlines()
    lines[1] = "0.001"
    times.write_text("\n".join(lines) + "\n")
    image = folder / "data" / "depth" / "000003.png"
    image.write_bytes(image.read_bytes()[:100])
    for said in (remesh(folder), spslam("eval", "out", "--views", cwd=folder).stdout):
        assert "! 1 of 6 frames of the run is not in folder/data any more\n" in said
        assert "! 1 frame of the run can't be read and is left out, the first: " in said and "000003.png" in said
    assert metrics_of(folder)["mesh_frames"] == metrics_of(folder)["mesh_color_frames"] == 4


def test_the_resolution_said_of_the_map_is_that_of_its_cells(folder):
    assert "; neural at 0.00571429 m, " in remesh(folder, "--resolution", "0.006", "--source", "neural")
    assert metrics_of(folder)["mesh_resolution_m"] == pytest.approx(0.04 / 7)  # a whole number in a voxel


@pytest.mark.parametrize("wish", [[], ["--format=glb"], ["--format=obj", "--texture"]])
def test_a_mesh_of_no_frame_replaces_none_of_frames(folder, wish):
    for image in (folder / "data" / "depth").iterdir():
        image.write_bytes(image.read_bytes()[:100])
    before = contents(folder / "out")
    refused = spslam("mesh", "out", *wish, cwd=folder)
    assert_refused(refused, "folder/data: none of the 6 frames to fuse can be read: restore the data, or use --source")
    assert contents(folder / "out") == before


@pytest.mark.parametrize("source", ["tsdf", "neural"])
@pytest.mark.parametrize("resolution", ["1e-5", "1e-300", "5e-324"])
def test_a_resolution_beyond_memory_is_refused_with_one_that_fits(folder, source, resolution):
    before = contents(folder / "out")
    refused = spslam("mesh", "out", "--resolution", resolution, "--source", source, cwd=folder)
    message = "choose a resolution of at least" if source == "tsdf" else "the smallest that fits is about"
    assert_refused(refused, message)
    least_m = float(re.search(message + r" ([\d.]+) m", refused.stderr)[1])
    assert 1e-4 < least_m < 0.01
    assert contents(folder / "out") == before


def test_a_resolution_has_the_range_of_the_option(folder):
    refused = spslam("mesh", "out", "--resolution", "100", cwd=folder)
    assert_refused(refused, "--resolution: must be a length of at most 1 m, got '100'")


@pytest.mark.parametrize("wish", [["--format=ply"], ["--format=glb"], ["--format=obj"], ["--format=glb", "--texture"]])
def test_a_mesh_without_surface_replaces_none(folder, monkeypatch, wish):
    from spslam.meshing import TriangleMesh
    from spslam.run import mesh

    empty = TriangleMesh(*(np.zeros((0, 3), kind) for kind in (np.float32, np.int32, np.uint8, np.float32)))
    monkeypatch.setattr(mesh, "extract_mesh", lambda *_: empty)
    before = contents(folder / "out")
    refused = spslam("mesh", "out", "--source", "neural", "--resolution", "1", *wish, cwd=folder)
    assert_refused(refused, f"out/mesh.{wish[0][-3:]}: no surface at a resolution of 0.04 m, so no mesh was written")
    assert contents(folder / "out") == before


@pytest.mark.parametrize("said", ["not enough memory", "DefaultCPUAllocator: can't allocate memory"])
def test_memory_that_is_not_there_is_one_line(folder, monkeypatch, said):
    from spslam.run import mesh

    def fail(*_):
        raise RuntimeError(said)

    monkeypatch.setattr(mesh, "extract_mesh", fail)
    refused = spslam("mesh", "out", "--source", "neural", cwd=folder)
    assert_refused(refused, "the machine is out of memory: choose a larger --resolution, or use a machine with more")


@pytest.mark.parametrize("texel", ["1e-9", "1e-300", "1e9"])
def test_texels_that_no_texture_has_are_refused(folder, texel):
    refused = spslam("mesh", "out", "--texture", "--texel", texel, cwd=folder)
    assert_refused(refused, "a texel of a texture (--texel) must have an edge from 1e-06 to 1 m, got")


def test_an_obj_takes_the_textures_of_the_one_before_with_it(folder):
    remesh(folder, "--resolution", "0.08", "--format", "obj", "--texture", "--texel", "0.02")
    (folder / "out" / "mesh-1.png").touch()  # of one with more pages
    remesh(folder, "--resolution", "0.08", "--format", "obj", "--texture", "--texel", "0.02")
    assert [path.name for path in RunFolder(folder / "out").texture_files()] == ["mesh-0.png", "mesh.mtl"]
    remesh(folder, "--resolution", "0.08", "--format", "obj")
    assert RunFolder(folder / "out").texture_files() == []
    assert "mtllib" not in (folder / "out" / "mesh.obj").read_text()


@pytest.mark.parametrize("command", ["eval", "view"])
def test_a_merged_map_is_called_one(folder, command):
    (folder / "out" / "trajectory.txt").rename(folder / "out" / "trajectory-1.txt")
    refused = spslam(command, "out", cwd=folder)
    assert_refused(refused, "out: is a merged map, which has no trajectory of its own; give one of the merged runs")


def test_figures_of_a_merged_map_are_of_its_new_mesh(folder, monkeypatch):
    from spslam.run import recordings

    (folder / "out" / "trajectory.txt").rename(folder / "out" / "trajectory-1.txt")
    before = metrics_of(folder)
    with monkeypatch.context() as patches:
        patches.setattr(recordings, "_open_again", lambda _: "it is gone")
        said = "the mesh is of the map alone where folder/data was: it is gone"
        assert f"! {said}\n" in remesh(folder)
    metrics = metrics_of(folder)
    assert metrics["mesh_source"] == "neural" and metrics["warnings"] == [said]
    assert not {"mesh_frames", "mesh_mb"} & metrics.keys()
    remesh(folder, "--format", "glb")
    assert metrics_of(folder) == metrics
    remesh(folder)
    assert {**metrics_of(folder), "mesh_s": before["mesh_s"]} == before


def test_earlier_frames_are_missed_only_where_frames_are_fused(folder, monkeypatch):
    from spslam.run import recordings

    (folder / "out" / "metrics.json").write_text(json.dumps({**metrics_of(folder), "map": "earlier"}))
    monkeypatch.setattr(recordings, "read_again", lambda *_: ([], ["the mesh is of the map alone where it was"]))
    assert "! the mesh is of the map alone" not in remesh(folder, "--source", "neural")
    assert "! the mesh is of the map alone where it was\n" in remesh(folder, "--source", "tsdf")
