import json
import shutil

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.replica import open_replica
from spslam.datasets.synthetic_rgbd import open_synthetic_rgbd
from spslam.errors import DatasetError
from tests.datasets.layouts import depth_meters, poses, shared_data, write_replica


def test_a_scene(tmp_path):
    dataset = open_replica(write_replica(tmp_path / "room0"))
    assert dataset.name == "replica/room0"
    assert dataset.camera == Camera(32, 24, 30, 31, 15.5, 11.5)
    frame = dataset[1]
    np.testing.assert_allclose(frame.depth, depth_meters(1), atol=1e-4)
    np.testing.assert_allclose(frame.pose, poses(3)[1], atol=1e-8)
    np.testing.assert_allclose(dataset.poses(), poses(3), atol=1e-8)


def test_the_camera_file_may_lie_in_the_folder_above(tmp_path):
    scene = write_replica(tmp_path / "room0")
    shutil.move(scene / "cam_params.json", tmp_path / "cam_params.json")
    assert open_replica(scene).camera.fx == 30
    (tmp_path / "cam_params.json").unlink()
    with pytest.raises(DatasetError, match="cam_params.json: no such file, nor in the folder above"):
        open_replica(scene)


def test_trajectories_may_be_short_or_absent(tmp_path):
    scene = write_replica(tmp_path)
    (scene / "traj.txt").write_text("\n".join((scene / "traj.txt").read_text().splitlines()[:2]))
    assert [frame.pose is None for frame in open_replica(scene)] == [False, False, True]
    (scene / "traj.txt").unlink()
    assert open_replica(scene).poses() is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": None}, r"must contain numbers camera.\{w, h, fx, fy, cx, cy, scale\}"),
        ({"w": 64}, "must give the images' size 32x24, got 64x24"),
        ({"scale": 0}, "camera.scale must be a number from 0.001 to 1e.09, got 0"),
        ({"cx": 900}, "principal point must lie in the image"),
    ],
)
def test_wrong_camera_files(tmp_path, change, message):
    scene = write_replica(tmp_path, count=1)
    values = json.loads((scene / "cam_params.json").read_text())
    values["camera"].update(change)
    (scene / "cam_params.json").write_text(json.dumps(values))
    with pytest.raises(DatasetError, match=rf"cam_params.json: .*{message}"):
        open_replica(scene)


@pytest.mark.parametrize(
    ("text", "message"), [("{", "isn't valid JSON"), ("[1]", "must contain an object"), ("{}", "got None")]
)
def test_malformed_json(tmp_path, text, message):
    scene = write_replica(tmp_path, count=1)
    (scene / "cam_params.json").write_text(text)
    with pytest.raises(DatasetError, match=rf"cam_params.json: {message}|got None"):
        open_replica(scene)


def test_wrong_layout(tmp_path):
    with pytest.raises(DatasetError, match="must contain results/frame000000.jpg and so on, got none"):
        open_replica(tmp_path)


def test_the_gray_room_is_the_same_in_both_layouts():
    replica = open_replica(shared_data("replica-layout"))
    synthetic = open_synthetic_rgbd(shared_data("synthetic-grey-white-room"), "exact")
    assert replica.camera == synthetic.camera
    np.testing.assert_allclose(replica.poses(), synthetic.poses()[: len(replica)], atol=1e-6)
    # Stored with a step of 1 mm there and 0.15 mm here.
    np.testing.assert_allclose(replica[3].depth, synthetic[3].depth, atol=6e-4)
