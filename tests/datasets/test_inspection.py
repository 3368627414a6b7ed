"""The look through a dataset: an analytic room whose data is then corrupted in the ways that occur."""

import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.cli.check_data import _rows
from spslam.datasets import inspection, open_dataset, registry, thinning
from spslam.datasets.base import RgbdDataset, RgbdFrame, Subset
from spslam.datasets.clock import CaptureOffsets
from spslam.datasets.findings import Finding
from spslam.datasets.inspection import inspect_dataset
from spslam.datasets.plausibility import check_first_frames
from spslam.datasets.plausibility.streams import unit_findings
from spslam.datasets.replica import open_replica
from spslam.datasets.seven_scenes import open_seven_scenes
from spslam.datasets.synthetic_rgbd import open_synthetic_rgbd
from spslam.datasets.tum import open_tum
from spslam.errors import DatasetError
from spslam.geometry import inverse, pose_from
from tests.datasets.layouts import shared_data

CAMERA = Camera(64, 48, 55.0, 55.0, 31.5, 23.5)
HALF_SIZE = np.array([3.0, 2.0, 2.5])


class BoxRoom(RgbdDataset):
    """A walk through an empty box, depth exact; attributes can be replaced to corrupt it."""

    name = "box"
    camera = CAMERA

    def __init__(self, frames=40):
        self.gt_poses = np.stack([walk(i / frames) for i in range(frames)])
        self.given_poses = self.gt_poses.copy()
        self.times = np.arange(frames) / 30
        self.scale = 1.0
        self.holes = 0
        self.broken = ()

    def __len__(self):
        return len(self.gt_poses)

    def timestamps(self):
        return self.times

    def poses(self):
        return self.given_poses

    def read(self, index):
        if index in self.broken:
            raise DatasetError(f"frame {index} is broken")
        depth = self.scale * cast(self.gt_poses[index])
        depth[: self.holes] = 0
        color = np.zeros((*depth.shape, 3), np.uint8)
        return RgbdFrame(index, self.times[index], color, depth.astype(np.float32))


def walk(fraction):
    angle = 1.5 * fraction
    c, s = np.cos(angle), np.sin(angle)
    tilt = 0.3 * np.sin(5 * fraction)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    nod = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    return pose_from(turn @ nod, np.array([2.0 * fraction - 0.7, 0.4 * np.sin(3 * fraction), 0.8 * fraction]))


def cast(pose):
    directions = CAMERA.ray_directions().astype(np.float64) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        walls = (np.sign(directions) * HALF_SIZE - pose[:3, 3]) / directions
    return np.min(np.where(directions != 0, walls, np.inf), axis=-1)


def test_frozen_depth_is_reported():
    room = BoxRoom()
    read = room.read

    def frozen(index):
        frame = read(index)
        frame.depth = read(20).depth if index > 20 else frame.depth
        frame.color[:, : index + 1] = 255  # something moves
        return frame

    room.read = frozen
    assert any(problem.startswith("depth is frozen: ") for problem in inspect_dataset(room).problems)


def test_when_colors_were_taken():
    class Late(BoxRoom):
        def read(self, index):
            return replace(super().read(index), offsets=CaptureOffsets(color=0.005 + 0.002 * (-1) ** index))

    assert inspect_dataset(BoxRoom()).color_offset is None
    found = inspect_dataset(Late())
    assert found.color_offset == pytest.approx((0.005, 0.002))
    assert ("color", "+5.0 ms +- 2.0 ms after depth, by time stamps") in _rows(found)


def test_large_images_are_thinned_without_another_finding(monkeypatch):
    whole = inspect_dataset(BoxRoom())
    monkeypatch.setattr(thinning, "_MAX_PIXELS_KEPT", CAMERA.width * CAMERA.height // 4)
    thinned = inspect_dataset(BoxRoom())
    assert thinned.problems == whole.problems == []
    assert thinned.depth.median_m == pytest.approx(whole.depth.median_m, rel=0.05)
    assert thinned.poses.agreement.relative < 0.02


def test_images_of_17_million_pixels_are_inspected_in_bounded_memory():
    """40 of them whole would be 2.7 GB."""

    class Large(BoxRoom):
        camera = Camera(4096, 4096, 4000.0, 4000.0, 2047.5, 2047.5)

        def read(self, index):
            color = np.broadcast_to(np.uint8(0), (4096, 4096, 3))
            return RgbdFrame(index, self.times[index], color, np.full((4096, 4096), 2.0, np.float32))

    tracemalloc.start()
    try:
        found = inspect_dataset(Large())
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found.frames_read == 40
    assert most < 500e6


def test_sound_data_has_no_problem():
    found = inspect_dataset(BoxRoom())
    assert found.problems == []
    assert (found.frames, found.frames_read, found.camera) == (40, 40, CAMERA)
    assert found.frames_per_second == pytest.approx(30)
    assert found.poses.count == 40
    assert found.poses.agreement.median_cm < 3
    assert found.depth.holes == 0
    assert 0 < found.depth.near_m < found.depth.median_m < found.depth.far_m < 8


CORRUPTIONS = {
    "world-to-camera; camera": inverse,
    "OpenGL axes (y up": lambda poses: poses @ np.diag([1.0, -1, -1, 1]),
    "world-to-camera in OpenGL": lambda poses: inverse(poses @ np.diag([1.0, -1, -1, 1])),
    "sorted as text": lambda poses: poses[sorted(range(len(poses)), key=str)],
}


@pytest.mark.parametrize("words", CORRUPTIONS)
def test_wrong_poses_are_explained(words):
    room = BoxRoom()
    room.given_poses = CORRUPTIONS[words](room.gt_poses)
    assert any(words in problem for problem in inspect_dataset(room).problems)


@pytest.mark.parametrize(("scale", "fix"), [(5, 0.2), (0.2, 5), (10, 0.1), (0.1, 10)])
def test_wrong_depth_scale_is_named(scale, fix):
    room = BoxRoom()
    room.scale = scale
    assert any(f"depths {fix:g} times as large would fit" in problem for problem in inspect_dataset(room).problems)


def test_implausible_depth_is_reported_without_poses():
    room = BoxRoom()
    room.scale, room.given_poses = 1000, None
    found = inspect_dataset(room)
    assert found.poses is None
    assert len(found.problems) == 1
    assert "the depth scale looks wrong" in found.problems[0]


def test_holes_and_missing_poses_and_broken_frames_are_reported():
    room = BoxRoom()
    room.holes, room.broken = 30, (3,)
    room.given_poses[5:9] = np.nan
    problems = inspect_dataset(room).problems
    assert problems == [
        "unreadable: frame 3 is broken",
        "62% of the pixels have no depth",
        "4 of 40 frames have no ground-truth pose",
    ]


def test_no_depth_at_all_is_reported():
    room = BoxRoom()
    room.holes = 48
    found = inspect_dataset(room)
    assert found.depth is None
    assert found.problems == ["no depth at all in the frames looked at"]


def test_poses_are_not_judged_by_intrinsics_that_are_wrong():
    room = BoxRoom()
    room.camera = replace(CAMERA, fx=110.0, fy=110.0, cx=63.0, cy=47.0)  # of twice the size
    (problem,) = inspect_dataset(room).problems
    assert problem.startswith("the principal point lies at 99% of the width and 99% of the height")


def test_a_convention_that_images_and_depth_agree_on_is_said_once(monkeypatch):
    text = "the poses look like world-to-camera; camera-to-world is needed"
    monkeypatch.setattr(inspection, "with_whole", lambda *_: [Finding("poses", text, "convert the poses")])
    room = BoxRoom()
    room.given_poses = inverse(room.gt_poses)
    found = [problem for problem in inspect_dataset(room).problems if text in problem]
    assert found == [f"{text}; convert the poses"]


def test_jumps_and_gaps_are_reported():
    room = BoxRoom()
    room.given_poses = None
    room.times[20:] += 3
    assert inspect_dataset(room).problems == ["1 gaps in time, the longest 3.03 s after frame 19"]
    room = BoxRoom()
    room.given_poses[20:, 0, 3] += 1
    assert any("1 jumps over 30 cm or 20 deg after frame 19" in problem for problem in inspect_dataset(room).problems)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1e3, "frames are 33.3 s apart by their time stamps: these look like milliseconds, not seconds; multiply the"),
        (1e6, "these look like microseconds"),
        (1e9, "these look like nanoseconds, not seconds; multiply the time stamps by 1e-09"),
        (1 / 60, "frames are 0.000556 s apart by their time stamps: these look like minutes"),
    ],
)
def test_another_unit_of_the_time_stamps_is_named(factor, words):
    room = BoxRoom()
    room.times = room.times * factor
    (problem,) = inspect_dataset(room).problems
    assert words in problem
    assert [str(finding) for finding in check_first_frames(room)] == [problem]


def test_frames_far_apart_that_share_little_may_be_seldom():
    steps = np.arange(20) * 30.0
    assert unit_findings(steps, has_overlap=False) == []
    assert unit_findings(steps, has_overlap=True)
    assert unit_findings(np.arange(20) * 4.0, has_overlap=True) == []
    assert unit_findings(np.zeros(20), has_overlap=True) == unit_findings(np.zeros(1), has_overlap=True) == []


def test_doubts_and_remarks_of_opening_are_said():
    room = BoxRoom()
    room.doubts, room.remarks = (Finding("camera", "the camera is guessed", "write it down"),), ("some are missing",)
    assert inspect_dataset(room).problems == ["the camera is guessed; write it down", "some are missing"]
    assert check_first_frames(room) == check_first_frames(Subset(room, 1)) == list(room.doubts)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("folder", "set dataset.depth_scale (units per meter), or depth_scale in the JSON file"),
        ("rosbag", "set dataset.depth_scale (units per meter)"),
        ("tum", "convert the depth images to 5000 units per meter"),
        ("replica", "correct camera.scale (units per meter) in cam_params.json"),
        ("7scenes", "convert the depth images to the unit that the format has (7scenes)"),
    ],
)
def test_the_scale_is_set_as_the_format_has_it(monkeypatch, kind, words):
    room = BoxRoom()
    room.scale = 1000
    monkeypatch.setitem(registry._OPENERS, kind, lambda config, path: room)
    dataset = open_dataset(SimpleNamespace(type=kind, path="x"))
    (problem,) = inspect_dataset(dataset).problems[:1]
    assert f"the depth scale looks wrong; {words}" in problem
    assert problem.endswith(": depth 0.001 times as large would fit")
    assert ("dataset.depth_scale (units" in problem) == ("depth_scale" in words)


def test_one_frame_is_enough_to_look_at():
    found = inspect_dataset(BoxRoom(1))
    assert found.problems == ["only one frame"]
    assert dict(_rows(found))["frames"] == "1; depth of 1 checked"


RECORDINGS = {
    "7scenes-redkitchen": open_seven_scenes,
    "tum-fr1-rpy-60": open_tum,
    "synthetic-grey-white-room": open_synthetic_rgbd,
    "replica-layout": open_replica,
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings_as_distributed_are_sound(name):
    found = inspect_dataset(RECORDINGS[name](shared_data(name)), frames=5)
    assert found.problems == []
    assert found.poses.agreement.median_cm < 2


class Corrupted(Subset):
    """A recording whose poses or depth were converted wrongly."""

    def __init__(self, dataset, change_poses=None, scale=1.0):
        super().__init__(dataset)
        self.change_poses, self.scale = change_poses or (lambda poses: poses), scale

    def poses(self):
        return self.change_poses(super().poses())

    def read(self, index):
        frame = super().read(index)
        frame.depth *= np.float32(self.scale)
        return frame


@pytest.mark.parametrize("words", CORRUPTIONS)
@pytest.mark.parametrize("name", ["7scenes-redkitchen", "synthetic-grey-white-room"])
def test_wrong_poses_of_recordings_are_explained(name, words):
    corrupted = Corrupted(RECORDINGS[name](shared_data(name)), CORRUPTIONS[words])
    assert any(words in problem for problem in inspect_dataset(corrupted, frames=3).problems)


@pytest.mark.parametrize(("scale", "fix"), [(0.2, 5), (5, 0.2), (0.1526, 6.5535)])
@pytest.mark.parametrize("name", ["7scenes-redkitchen", "synthetic-grey-white-room"])
def test_wrong_depth_scale_of_recordings_is_named(name, scale, fix):
    corrupted = Corrupted(RECORDINGS[name](shared_data(name)), scale=scale)
    problems = inspect_dataset(corrupted, frames=3).problems
    assert any(f"depths {fix:g} times as large would fit" in problem for problem in problems)
