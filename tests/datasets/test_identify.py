"""What a path is taken for where files of more than one format are in it."""

import json

import pytest

from spslam.datasets import identify_recording
from spslam.errors import DatasetError
from tests.datasets.layouts import write_folder, write_tum


def config_of(path):
    return identify_recording(path).config


def test_a_log_of_another_program_makes_no_open3d_recording(tmp_path):
    folder = write_folder(tmp_path / "mine")
    (folder / "ffmpeg.log").touch()
    assert config_of(folder) == "folder"
    (folder / "trajectory.log").touch()
    assert config_of(folder) == "open3d"


@pytest.mark.parametrize("own", ["poses.txt", "times.txt"])
def test_files_of_a_folder_recording_decide(tmp_path, own):
    folder = write_folder(tmp_path / "mine")
    (folder / "intrinsics.txt").rename(folder / "intrinsic.json")
    (folder / "intrinsic.json").write_text(json.dumps({"fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5}))
    assert config_of(folder) == "open3d"
    (folder / own).touch()
    assert config_of(folder) == "folder"
    (folder / "intrinsic.json").unlink()
    (folder / "trajectory.log").touch()  # without intrinsics only Open3D's default camera is left
    assert config_of(folder) == "open3d"


@pytest.mark.parametrize(
    ("name", "config"),
    [
        ("rgbd_bonn_balloon", "bonn"),
        ("Bonn-balloon", "bonn"),
        ("bonnie_fr1", "tum"),
        ("carbonn", "tum"),
        ("fr1", "tum"),
    ],
)
def test_bonn_is_a_word_of_the_name(tmp_path, name, config):
    assert config_of(write_tum(tmp_path / name)) == config


def test_a_link_tells_the_name_as_well(tmp_path):
    write_tum(tmp_path / "balloon")
    (tmp_path / "rgbd_bonn_balloon").symlink_to(tmp_path / "balloon")
    assert config_of(tmp_path / "rgbd_bonn_balloon") == "bonn"
    assert config_of(tmp_path / "balloon") == "tum"


@pytest.mark.parametrize(
    ("write", "remove", "rename", "message"),
    [
        (
            write_folder,
            "intrinsics.txt",
            {},
            r"beside color/ and depth/ must be the intrinsics .*: intrinsics\.txt with fx",
        ),
        (write_folder, None, {"color": "RGB", "depth": "Depth"}, "in lower case, rename RGB to rgb and Depth to depth"),
        (write_tum, "depth.txt", {}, r"beside rgb\.txt must be depth\.txt, a line `timestamp file` for each image"),
        (write_tum, "rgb.txt", {}, r"beside depth\.txt must be rgb\.txt"),
    ],
)
def test_what_a_folder_lacks_is_named(tmp_path, write, remove, rename, message):
    folder = write(tmp_path / "mine")
    if remove is not None:
        (folder / remove).unlink()
    for name, other in rename.items():
        (folder / name).rename(folder / other)
    with pytest.raises(DatasetError, match=f"mine: is no recording that is known: .*{message}.*; it contains "):
        identify_recording(folder)
