"""What moves along with the camera is found by depth, and left out; a mask of the user's is read and applied."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from experiments.capture_faults import FAULTS, carried_pixels
from experiments.wrong_recordings import WrongRecording
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import Subset
from spslam.datasets.carried import FRAMES, carried_in, find_carried
from spslam.datasets.places import PlacesDataset
from spslam.errors import DatasetError
from spslam.geometry import pose_from
from tests.cli.command import spslam
from tests.datasets.layouts import depth_meters, write_folder

COUNT = 120


class Robot(WrongRecording):
    """A generated place with something before the camera that moves along with it.

    Args:
        arm: whether there is something.
        place: see `PlacesDataset`.
        motion: of the camera; None for one that stands.
        sensor: see `PlacesDataset`.
        steady: whether the camera is carried at one height and pitch, low above the floor, as on a robot.
        unreadable: numbers of frames that can't be read.
    """

    def __init__(self, arm=True, place="apartment", motion="walking", sensor="stereo", steady=False, unreadable=()):
        data = PlacesDataset(place, motion or "walking", sensor, COUNT, 7)
        if steady:
            way = data.motion.poses
            data.motion.poses = lambda times: low_and_level(way(times))
        fault = FAULTS["robot's arm" if arm else "none"]
        super().__init__(
            data, replace(fault, order=None if motion else lambda count: np.zeros(count, int)), with_poses=False
        )
        self.shown, self._unreadable = carried_pixels((self.camera.height, self.camera.width)), unreadable

    def read(self, index):
        if index in self._unreadable:
            raise DatasetError(f"frame {index}")
        return super().read(index)


def low_and_level(poses):
    forward, right = poses[:, :3, 2] * [1, 1, 0], np.array([0.0, 0.0, 1.0])
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True) * 0.97 + [0, 0, -0.25]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    positions = poses[:, :3, 3] * [1, 1, 0] + [0, 0, 0.45]
    return pose_from(np.stack((right, np.cross(forward, right), forward), axis=-1), positions)


@pytest.mark.parametrize("steady", [False, True], ids=["carried", "on wheels"])
@pytest.mark.parametrize("sensor", ["stereo", "structured_light", "time_of_flight", "phone_lidar"])
def test_an_arm_is_found(sensor, steady):
    robot = Robot(sensor=sensor, steady=steady)
    found = find_carried(robot)
    assert found[robot.shown].all()
    assert found.sum() < 1.6 * robot.shown.sum()


@pytest.mark.parametrize("place", ["room", "apartment", "stairwell", "arcade", "desk", "hall"])
@pytest.mark.parametrize("steady", [False, True], ids=["carried", "on wheels"])
def test_nothing_is_found_where_there_is_nothing(place, steady):
    """A floor before a robot on wheels has the same depth in all frames too."""
    assert find_carried(Robot(False, place, steady=steady)) is None


def test_a_camera_that_stands_tells_nothing():
    assert find_carried(Robot(motion=None)) is None


def test_frames_that_can_not_be_read_do_not_count():
    robot = Robot(unreadable=range(COUNT // 4))
    assert find_carried(robot)[robot.shown].all()
    assert find_carried(Robot(unreadable=range(COUNT // 8, COUNT))) is None


def test_something_else_that_stays_the_same_is_no_arm():
    """Before a camera that stands somebody walks: a box on a table is near, and all else is as still."""
    depth = np.full((120, 160), 3.0, np.float32)
    depth[80:, 40:120] = 0.8
    images = [depth.copy() for _ in range(FRAMES)]
    for i, image in enumerate(images):
        image[20:70, 9 * i : 9 * i + 20] = 2.0
    assert carried_in(images) is None


def test_an_image_without_depth_tells_nothing():
    assert carried_in([np.zeros((120, 160), np.float32)] * FRAMES) is None


@pytest.fixture
def recording(tmp_path):
    return write_folder(tmp_path / "recording", COUNT // 4)


def opened(folder, mask="null"):
    return open_dataset(load_config("folder", overrides=[f"dataset.mask={mask}"]).dataset, folder)


def mask_file(path, shape, left_out):
    image = np.full(shape, 255, np.uint8)
    image[left_out] = 0
    assert cv2.imwrite(str(path), image)
    return path


def test_black_pixels_of_a_mask_have_no_depth(recording, tmp_path):
    shape = depth_meters(0).shape
    left_out = np.s_[: shape[0] // 2]
    data = opened(recording, mask_file(tmp_path / "mask.png", shape, left_out))
    everything = opened(recording, "none")
    assert everything.left_out is None
    for dataset, number in ((data, 2), (Subset(data, 1), 1)):
        depth = dataset[number].depth
        assert not depth[left_out].any()
        np.testing.assert_array_equal(depth[shape[0] // 2 :], everything[2].depth[shape[0] // 2 :])
        np.testing.assert_array_equal(dataset.depth(number), depth)


def test_a_mask_in_color_is_read(recording, tmp_path):
    shape = depth_meters(0).shape
    data = opened(recording, mask_file(tmp_path / "mask.png", (*shape, 3), np.s_[:4]))
    assert data.left_out.sum() == 4 * shape[1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path, shape: None, "does not exist"),
        (lambda path, shape: path.write_text("x"), "not an image"),
        (lambda path, shape: mask_file(path, (shape[0], shape[1] + 1), np.s_[:4]), "must be as large as"),
        (lambda path, shape: mask_file(path, shape, np.s_[:]), "is black"),
    ],
    ids=["missing", "no image", "another size", "black"],
)
def test_a_mask_that_can_not_be_used_is_refused(recording, tmp_path, make, message):
    make(tmp_path / "mask.png", depth_meters(0).shape)
    with pytest.raises(DatasetError, match=f"dataset.mask: .*{message}"):
        opened(recording, tmp_path / "mask.png")


@pytest.fixture(scope="module")
def robot_folder(tmp_path_factory):
    robot, folder = Robot(), tmp_path_factory.mktemp("robot")
    for number in range(0, COUNT, 3):
        frame = robot.read(number)
        for kind, image in (("color", frame.color[..., ::-1]), ("depth", (1000 * frame.depth).astype(np.uint16))):
            (folder / kind).mkdir(exist_ok=True)
            assert cv2.imwrite(str(folder / kind / f"{number:03}.png"), image)
    k = robot.camera
    np.savetxt(folder / "intrinsics.txt", [[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
    return robot.shown, folder


def test_opening_a_recording_finds_an_arm_and_says_so(robot_folder):
    shown, folder = robot_folder
    data = opened(folder)
    assert not data[5].depth[shown].any()
    assert any("moves along with the camera" in remark for remark in data.remarks)
    assert opened(folder, "none")[5].depth[shown].all()


def test_a_copy_of_it_has_all_depth(robot_folder, tmp_path):
    """In the copy it is found again; without depth its colors would be taken for those of what lies behind."""
    shown, folder = robot_folder
    result = spslam("import", "folder", "--data", str(folder), "copy", "--quiet", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert opened(tmp_path / "copy", "none")[5].depth[shown].all()
    assert not opened(tmp_path / "copy")[5].depth[shown].any()
