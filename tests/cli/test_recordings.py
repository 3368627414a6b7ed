"""`spslam run`, `check-data` and `import` with a recording in place of a configuration."""

import json

import numpy as np
import pytest

from spslam.datasets import export_folder, import_folder
from spslam.datasets.folder import open_folder
from spslam.datasets.generated import GeneratedDataset
from spslam.errors import OutputError
from tests.cli.command import assert_refused, spslam
from tests.datasets import recordings as write
from tests.datasets.layouts import depth_meters, truncate, write_folder, write_tum

pytest.importorskip("av")
COUNT = 5


@pytest.fixture
def phone(tmp_path):
    return write.write_stray_scanner(tmp_path / "phone", COUNT)


def test_run_finds_out_what_a_recording_is_and_says_so(tmp_path):
    export_folder(GeneratedDataset(3, 96, 72), tmp_path / "mine")
    settings = ["--set=mapping.first_iterations=5", "--set=pixels.per_frame=2000", "--device=cpu", "--no-mesh"]
    result = spslam("run", "mine", *settings, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("mine: taken for a folder of color and depth images, as with: folder --data mine\n")
    (output,) = (tmp_path / "runs").iterdir()
    assert output.name.startswith("mine-")
    assert "type: folder" in (output / "config.yaml").read_text()
    assert spslam("run", "mine", *settings, "--quiet", "--output=quiet", cwd=tmp_path).stdout == ""


def test_check_data_takes_a_recording(tmp_path, phone):
    result = spslam("check-data", "phone", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "phone: taken for a Stray Scanner recording, as with: stray_scanner --data phone" in result.stdout
    assert "5, 60.0 frames/s" in result.stdout


def test_import_writes_a_folder_with_the_same_frames(tmp_path, phone):
    result = spslam("import", "phone", "copy", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "copy: 5 frames of 32x24, from stray_scanner/phone" in result.stdout
    copy = open_folder(tmp_path / "copy")
    original = spslam_dataset(phone)
    np.testing.assert_allclose(copy.timestamps(), original.timestamps(), atol=1e-9)
    np.testing.assert_allclose(copy.poses(), original.poses(), atol=1e-9)
    for i in range(COUNT):
        np.testing.assert_array_equal(copy[i].color, original[i].color)
        np.testing.assert_array_equal(copy[i].depth, original[i].depth)
    assert {path.name for path in tmp_path.iterdir()} == {"phone", "copy"}


def spslam_dataset(phone):
    from spslam.config import load_config
    from spslam.datasets import open_dataset

    return open_dataset(load_config("stray_scanner", overrides=[("dataset.path", str(phone))]).dataset)


def test_import_leaves_out_what_is_broken_and_takes_some_frames_only(tmp_path, phone):
    truncate(phone / "depth" / "000002.png")
    result = spslam("import", "stray_scanner", "copy", "--data", "phone", "--frames", "1:4", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "copy: 2 frames of 32x24" in result.stdout
    assert "! left out: " in result.stdout
    copy = open_folder(tmp_path / "copy")
    np.testing.assert_allclose(copy.timestamps(), write.START_S + np.array([1, 3]) / 60, atol=1e-6)
    assert copy[1].depth[20, 20] == pytest.approx(depth_meters(3)[20, 20], abs=1e-4)


def test_import_leaves_nothing_where_it_fails(tmp_path, phone, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    assert_refused(spslam("import", "phone", "full", "--quiet", cwd=tmp_path), "full: must be a new or an empty folder")

    def interrupted(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_folder(spslam_dataset(phone), tmp_path / "copy", interrupted)
    (tmp_path / "empty").mkdir()
    with pytest.raises(OutputError, match="can't be written"):
        import_folder(spslam_dataset(phone), phone / "rgb.mp4" / "copy")
    for path in (phone / "depth").iterdir():
        path.write_bytes(b"")
    assert spslam("import", "phone", "copy", cwd=tmp_path).returncode == 2
    assert {path.name for path in tmp_path.iterdir()} == {"phone", "full", "empty"}


def test_wrong_recordings_are_one_line(tmp_path):
    write_tum(tmp_path / "tum_like")
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.mp4").touch()
    for arguments, message in (
        (["tum_like", "--data", "elsewhere"], "--data elsewhere needs a configuration, got the recording tum_like"),
        (["empty"], "empty: is no recording that is known: must contain color/ and depth/"),
        (["absent.bag"], "absent.bag: no such configuration, file or folder"),
        (["a.mp4"], "a video needs a folder with its depth images beside it"),
        (["absent"], "absent: no such configuration; "),
    ):
        assert_refused(spslam("run", *arguments, "--quiet", cwd=tmp_path), message)
    assert not (tmp_path / "runs").exists()


def test_a_configurations_name_wins_over_a_folder(tmp_path):
    write_folder(tmp_path / "tum")
    assert_refused(spslam("check-data", "tum", cwd=tmp_path), "dataset.path must name the folder of the tum data")


def test_what_is_not_read_is_named_at_the_command_line(tmp_path):
    folder = write_folder(tmp_path / "mine")
    (folder / "intrinsics.txt").unlink()
    values = {"fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5, "distorsion": [0.1, 0, 0, 0]}
    (folder / "intrinsics.json").write_text(json.dumps(values))
    assert_refused(spslam("run", "mine", "--quiet", cwd=tmp_path), "intrinsics.json: nothing here reads distorsion")
