"""End-to-end tests of the commands, on a few small frames of the generated room."""

import html
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
import torch

from experiments.wrong_recordings import FAULTS, WrongRecording
from spslam.cli.progress import ProgressBar, ProgressLines, summarize
from spslam.config import load_config
from spslam.datasets import export_folder
from spslam.datasets.generated import GeneratedDataset
from spslam.evaluation import finished_run
from spslam.run.output_folder import OutputFolder
from spslam.run_folder import RunFolder
from spslam.slam.fit import Fit
from spslam.slam.graph.archive import KeyframeArchive
from tests.cli.command import ROOT, assert_refused, spslam, spslam_process

SMALL = [
    "--set=dataset.width=96",
    "--set=dataset.height=72",
    "--set=pixels.per_frame=3000",
    "--set=mapping.first_iterations=20",
    "--set=mapping.iterations=2",
    "--set=run.checkpoint_every=2",
    "--device=cpu",
]
FILES = {"config.yaml", "keyframes.safetensors", "log.jsonl", "map.safetensors", "metrics.json", "previews"}
FILES |= {"report.html", "trajectory.txt"}


def run(cwd, *arguments):
    result = spslam("run", "demo", *SMALL, *arguments, cwd=cwd)
    assert result.returncode == 0, result.stderr
    return result


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a finished run in `out`, and what the command said."""
    folder = tmp_path_factory.mktemp("finished")
    result = spslam_process("run", "demo", *SMALL, "--frames", "0:8", "--output", "out", cwd=folder)
    assert result.returncode == 0, result.stderr
    return folder, result


@pytest.fixture
def few_samples(monkeypatch):
    """Figures of a mesh from a few of its points and views."""
    few = partial(finished_run.surface_figures, samples=5_000, novel_views=5)
    monkeypatch.setattr(finished_run, "surface_figures", few)


def test_run_writes_all_files_and_prints_their_paths(finished):
    folder, result = finished
    assert {path.name for path in (folder / "out").iterdir()} == FILES | {"mesh.ply"}
    assert re.search(r"^frames +8$", result.stdout, re.MULTILINE)
    for word in ("frames/s", "ATE RMSE", "out/mesh.ply", "out/report.html"):
        assert word in result.stdout
    assert "8/8 frames" in result.stderr
    metrics = json.loads((folder / "out" / "metrics.json").read_text())
    assert metrics["frames"] == 8
    assert metrics["ate_rmse_cm"] < 3
    assert metrics["command"].startswith("spslam run demo --set=")
    assert html.escape(metrics["command"]) in (folder / "out" / "report.html").read_text()
    page = (ROOT / "docs" / "outputs.md").read_text()
    assert not [key for key in metrics if f"`{key}`" not in page]


def test_saved_configuration_is_that_of_the_run(finished):
    config = load_config(finished[0] / "out" / "config.yaml")
    assert config == load_config(
        "demo", overrides=[*(text.removeprefix("--set=") for text in SMALL[:-1]), "device=cpu"]
    )


def test_finished_run_is_not_overwritten(finished):
    folder, _ = finished
    before = (folder / "out" / "trajectory.txt").read_bytes()
    again = ["run", "demo", *SMALL, "--frames", "0:8", "--output", "out"]
    assert_refused(spslam(*again, cwd=folder), "holds a finished run; use another --output")
    resumed = spslam(*again, "--resume", cwd=folder)
    assert resumed.returncode == 0, resumed.stderr
    assert resumed.stdout.startswith("this run had finished before; nothing was left to do\n")
    assert (folder / "out" / "trajectory.txt").read_bytes() == before


def test_eval_adds_metrics_of_the_mesh(finished, few_samples):
    folder, _ = finished
    result = spslam("eval", "out", "--gt-mesh", "out/mesh.ply", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "F1 at 5 cm" in result.stdout
    # Compared with itself, the mesh differs only by the alignment of estimated and ground-truth poses.
    assert json.loads((folder / "out" / "metrics.json").read_text())["f1_5cm"] > 99
    exact = spslam("eval", "out", "--gt-mesh", "generated", cwd=folder)
    assert "accuracy" in exact.stdout
    assert_refused(spslam("eval", "out", "--gt-mesh", "absent.ply", cwd=folder), "absent.ply: no such file")


def test_eval_adds_metrics_of_views_and_of_alignment_with_scale(finished):
    folder, _ = finished
    result = spslam("eval", "out", "--views", "--scale", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "PSNR" in result.stdout
    metrics = json.loads((folder / "out" / "metrics.json").read_text())
    assert 10 < metrics["psnr_db"] < 60
    assert 0 < metrics["ssim"] < 1
    assert 0 < metrics["view_coverage"] <= 100
    assert metrics["ate_scaled_rmse_cm"] <= metrics["ate_rmse_cm"]
    assert "As in the paper" in (folder / "out" / "report.html").read_text()


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_mesh_is_extracted_from_the_map(finished, suffix):
    folder, _ = finished
    result = spslam("mesh", "out", "--resolution", "0.08", "--format", suffix, cwd=folder)
    assert result.returncode == 0, result.stderr
    assert f"out/mesh.{suffix}: " in result.stdout
    assert (folder / "out" / f"mesh.{suffix}").stat().st_size > 1000


def test_no_mesh_and_quiet(tmp_path):
    result = run(tmp_path, "--frames", "0:2", "--output", "out", "--no-mesh", "--quiet")
    assert (result.stdout, result.stderr) == ("", "")
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_output_is_named_after_configuration_and_time(tmp_path):
    run(tmp_path, "--frames", "0:1", "--no-mesh", "--quiet")
    assert re.fullmatch(r"demo-\d{8}-\d{6}", next((tmp_path / "runs").iterdir()).name)


def test_interruption_is_one_line_and_resumes_to_the_same_bytes(tmp_path):
    arguments = [*SMALL, "--frames", "0:12", "--no-mesh", "--quiet"]
    run(tmp_path, *arguments, "--output", "whole")
    command = [sys.executable, "-m", "spslam", "run", "demo", *arguments, "--output", tmp_path / "cut"]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    checkpoint = tmp_path / "cut" / "checkpoint.safetensors"
    while not checkpoint.exists() and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130, error
    assert error == f"spslam: interrupted; the same command with --output {tmp_path / 'cut'} --resume continues\n"
    assert_refused(spslam("run", "demo", *arguments, "--output", "cut", cwd=tmp_path), "continue it with --resume")
    run(tmp_path, *arguments, "--output", "cut", "--resume")
    for name in ("trajectory.txt", "map.safetensors"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.slow
def test_demo_replaces_an_earlier_run_over_the_room(finished, few_samples, tmp_path):
    shutil.copytree(finished[0] / "out", tmp_path / "runs" / "demo")
    result = spslam("demo", "--frames", 1, "--device", "cpu", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "F1 at 5 cm" in result.stdout
    commands = re.findall(r"^  .* -m spslam (.*)$", result.stdout, re.MULTILINE)
    assert commands == [
        "download tum/fr1_desk",
        "run tum --data data/tum/rgbd_dataset_freiburg1_desk",
        "run folder --data DIR",
    ]
    assert {path.name for path in (tmp_path / "runs" / "demo").iterdir()} == FILES | {"mesh.ply"}
    assert json.loads((tmp_path / "runs" / "demo" / "metrics.json").read_text())["frames"] == 1


def test_check_data_describes_the_room(tmp_path):
    result = spslam("check-data", "demo", "--set", "dataset.width=64", "--set", "dataset.height=48", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for line in ("frames        300", "size          64x48 px", "ground truth  300 of 300 poses", "no problems found"):
        assert line in result.stdout


class Report:
    lost, fit, loss = False, Fit(residual_cm=0.31), 0.2


def test_progress_without_a_terminal_is_printed_as_lines(capsys):
    lines = ProgressLines()
    lines(1, 3, None)
    lines(2, 3, Report())
    lines(3, 3, Report())
    error = capsys.readouterr().err
    assert re.fullmatch(r"3/3 frames, [\d.]+ frames/s, ok, residual 0\.31 cm, loss 0\.200\n", error)


def test_progress_on_a_terminal_is_a_bar_that_ends_with_a_newline(capsys):
    bar = ProgressBar()
    bar(4, 9, Report())  # a resumed run
    time.sleep(0.2)  # tqdm draws ten times per second
    bar(5, 9, Report())
    bar.close()
    error = capsys.readouterr().err
    assert "| 5/9 [" in error
    assert "frames/s, ok, residual 0.31 cm, loss 0.200]" in error
    assert error.endswith("\n")


def test_summary_leaves_out_missing_metrics(tmp_path):
    assert summarize({"frames": 5}, tmp_path) == [("frames", "5")]
    assert summarize({"frames": 5, "lost_frames": 1, "skipped_frames": 2, "fps": 3.21}, tmp_path) == [
        ("frames", "5 (1 lost, 2 skipped)"),
        ("speed", "3.2 frames/s"),
    ]


def test_first_frames_that_do_not_fit_stop_a_run_unless_told_otherwise(tmp_path):
    """A recording whose depth is mirrored: refused with what is wrong, nothing left behind; overruled, it runs."""
    export_folder(WrongRecording(GeneratedDataset(12, 160, 120), FAULTS["depth mirrored"]), tmp_path / "data")
    arguments = ["run", "folder", "--data", "data", "--output", "out", "--quiet", "--no-mesh", *SMALL[2:]]
    assert_refused(
        spslam(*arguments, cwd=tmp_path), "the first frames do not fit together: depth does not belong to color"
    )
    assert not (tmp_path / "out").exists()
    overruled = spslam(*arguments, "--set=run.data_check=warn", cwd=tmp_path)
    assert overruled.returncode == 0, overruled.stderr
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert any("depth does not belong to color" in warning for warning in metrics["warnings"])
    assert "Doubts about the data" in (tmp_path / "out" / "report.html").read_text()
    skipped = spslam(*arguments[:5], "other", *arguments[6:], "--set=run.data_check=skip", cwd=tmp_path)
    assert skipped.returncode == 0, skipped.stderr
    assert "warnings" not in json.loads((tmp_path / "other" / "metrics.json").read_text())


def test_mesh_command_makes_the_runs_own_mesh_again(tmp_path, device):
    run(tmp_path, "--frames", "0:3", "--output", "out", "--quiet", f"--device={device}")
    own = (tmp_path / "out" / "mesh.ply").read_bytes()
    result = spslam("mesh", "out", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "tsdf at 0.01 m" in result.stdout and "MB of voxels" in result.stdout
    assert (tmp_path / "out" / "mesh.ply").read_bytes() == own
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["mesh_source"] == "tsdf" and metrics["mesh_resolution_m"] == 0.01
    assert metrics["mesh_frames"] == metrics["mesh_color_frames"] == 3


@pytest.mark.skipif(torch.cuda.is_available(), reason="the device isn't absent here")
def test_mesh_command_on_a_device_that_is_absent(finished):
    folder, _ = finished
    before = (folder / "out" / "mesh.ply").read_bytes()
    refused = spslam("mesh", "out", "--device", "cuda", cwd=folder)
    assert_refused(refused, "device cuda is not available")
    assert "use --device cpu" in refused.stderr
    assert (folder / "out" / "mesh.ply").read_bytes() == before


def test_mesh_command_divides_edges_for_finer_colors(finished):
    folder, _ = finished
    vertices = []
    for number in ("0", "1"):
        arguments = ["--resolution", "0.05", "--subdivisions", number, "--format", "obj"]
        result = spslam("mesh", "out", *arguments, cwd=folder)
        assert result.returncode == 0, result.stderr
        vertices.append((folder / "out" / "mesh.obj").read_text().count("\nv "))
    assert 0 < vertices[0] < vertices[1]
    for other in (["--source", "neural"], ["--texture"]):
        refused = spslam("mesh", "out", "--subdivisions", "1", *other, cwd=folder)
        assert_refused(refused, "--subdivisions is of vertices with colors of frames")


def test_mesh_command_extracts_the_map_alone(finished):
    folder, _ = finished
    result = spslam("mesh", "out", "--source", "neural", "--resolution", "0.05", "--format", "obj", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "neural at 0.04 m" in result.stdout


def test_mesh_command_bakes_a_texture(finished):
    folder, _ = finished
    result = spslam("mesh", "out", "--resolution", "0.05", "--texture", "--texel", "0.02", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "out/mesh.glb: " in result.stdout and "; texels of 20.0 mm, 1 x " in result.stdout
    content = (folder / "out" / "mesh.glb").read_bytes()
    assert content[:4] == b"glTF" and b"image/png" in content
    arguments = ["--texture", "--source", "neural", "--resolution", "0.08", "--format", "obj"]
    result = spslam("mesh", "out", *arguments, cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "neural at 0.04 m; texels of " in result.stdout
    assert (folder / "out" / "mesh.obj").read_text().startswith("mtllib mesh.mtl\n")
    assert [path.name for path in RunFolder(folder / "out").texture_files()] == ["mesh-0.png", "mesh.mtl"]


def test_a_texture_that_cannot_be_is_refused(finished, tmp_path):
    folder, _ = finished
    refused = spslam("mesh", "out", "--texture", "--format", "ply", cwd=folder)
    assert_refused(refused, "--format ply can't have a texture: --texture needs glb or obj")
    assert_refused(spslam("mesh", "out", "--texel", "0.01", cwd=folder), "--texel is the size of what --texture makes")
    shutil.copytree(folder / "out", tmp_path / "moved", ignore=shutil.ignore_patterns("*.glb"))
    config = tmp_path / "moved" / "config.yaml"
    text = re.sub("type: generated", "type: tum", config.read_text())
    config.write_text(re.sub("path: null", f"path: {tmp_path / 'absent'}", text))
    gone = spslam("mesh", "moved", "--texture", cwd=tmp_path)
    assert_refused(gone, "moved: a texture is made of the run's frames, which can't be read again")
    assert not (tmp_path / "moved" / "mesh.glb").exists()


def test_a_second_demo_leaves_one_that_is_running_alone(finished, tmp_path):
    shutil.copytree(finished[0] / "out", tmp_path / "demo")
    before = {path.name for path in (tmp_path / "demo").iterdir()}
    with OutputFolder(tmp_path / "demo").locked():
        refused = spslam("demo", "--output", "demo", "--frames", "2", "--device", "cpu", cwd=tmp_path)
    assert_refused(refused, "another run is writing into it")
    assert {path.name for path in (tmp_path / "demo").iterdir()} == before


def test_a_path_that_was_set_holds_in_any_folder(tmp_path):
    export_folder(GeneratedDataset(4, 96, 72), tmp_path / "data")
    words = ["run", "folder", *SMALL[2:], "--set=dataset.path=data", "--no-mesh", "--output", "out"]
    result = spslam(*words, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert load_config(tmp_path / "out" / "config.yaml").dataset.path == str(tmp_path / "data")
    # By a link's own name a camera may be known, to what reads the data again as well.
    (tmp_path / "freiburg1").symlink_to("data")
    words = ["run", "folder", *SMALL[2:], "--data", "freiburg1", "--no-mesh", "--output", "linked"]
    assert spslam(*words, cwd=tmp_path).returncode == 0
    assert load_config(tmp_path / "linked" / "config.yaml").dataset.path == str(tmp_path / "freiburg1")
    (recording,) = KeyframeArchive.load(tmp_path / "linked" / "keyframes.safetensors").recordings
    assert recording.source["dataset"]["path"] == str(tmp_path / "freiburg1")


def test_the_reason_why_frames_were_skipped_is_said(tmp_path):
    export_folder(GeneratedDataset(4, 96, 72), tmp_path / "data")
    image = sorted((tmp_path / "data" / "depth").iterdir())[2]
    image.write_bytes(image.read_bytes()[:100])
    words = ["run", "folder", *SMALL[2:], "--data", "data", "--no-mesh", "--output", "out"]
    result = spslam(*words, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert re.search(rf"skipped first: .*{image.name}.*; all are in out/skipped.jsonl", result.stdout)
