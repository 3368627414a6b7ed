"""The same path from every kind of recording: as from its frames where they are the same, else as good a one."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.config import load_config
from spslam.datasets import identify_recording, open_dataset
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.lens import Lens
from spslam.datasets.recording import Calibration, ImageStream, Recording
from spslam.evaluation.trajectory_metrics import ate
from spslam.slam.system import SlamSystem
from spslam.trajectory import Trajectory
from tests.datasets import ros_bags
from tests.datasets.cameras import BROWN, FISHEYE, extrinsics, path, render
from tests.datasets.layouts import matrix_text, write_color, write_depth
from tests.system.sequences import settings

pytest.importorskip("rosbags")
FRAMES = 10
CAMERA = Camera(160, 120, 138.0, 138.0, 79.5, 59.5)


def track(dataset: RgbdDataset, preset: str = "fast") -> Trajectory:
    poses = dataset.poses()
    system = SlamSystem(settings(preset=preset), dataset.camera, None if poses is None else poses[0])
    reports = [system.process(frame) for frame in dataset]
    system.finish()
    assert not any(report.lost for report in reports)
    return system.trajectory()


@functools.cache
def rounded_frames() -> tuple[RgbdFrame, ...]:
    """Of one camera, with depth in whole millimeters."""
    frames = []
    for i, pose in enumerate(path()[:FRAMES]):
        color, depth = render(Lens(CAMERA), pose)
        stored = np.divide(np.round(1000 * depth), np.float32(1000), dtype=np.float32)
        frames.append(RgbdFrame(i, i / 30, color, stored, pose))
    return tuple(frames)


def write_folder(folder):
    for frame in rounded_frames():
        write_color(folder / "color" / f"{frame.index}.png", frame.color)
        write_depth(folder / "depth" / f"{frame.index}.png", frame.depth)
    (folder / "intrinsics.txt").write_text(matrix_text(CAMERA.matrix()))
    (folder / "poses.txt").write_text("".join(matrix_text(frame.pose) for frame in rounded_frames()))
    return folder


def frames_to_record(known_poses):
    frames, lens = rounded_frames(), Lens(CAMERA)
    poses = np.array([frame.pose for frame in frames]) if known_poses else None
    images = [frame.color for frame in frames], [frame.depth for frame in frames]
    # Stamped alike, as the images are of one moment: stamps that are apart would be heeded.
    return ros_bags.Frames(*images, lens, lens, poses=poses, depth_delay_s=0.0)


WRITERS = {
    "ros1": lambda folder: ros_bags.write_ros1(
        folder / "a.bag", ros_bags.camera_messages(ros := ros_bags.Messages(False), frames_to_record(True)), ros, "LZ4"
    ),
    "mcap": lambda folder: ros_bags.write_mcap(
        folder / "a.mcap", ros_bags.camera_messages(ros := ros_bags.Messages(True), frames_to_record(True)), ros
    ),
    "realsense": lambda folder: ros_bags.write_ros1(
        folder / "a.bag", ros_bags.realsense_messages(ros := ros_bags.Messages(False), frames_to_record(False)), ros
    ),
}


def test_bags_give_the_path_that_their_frames_give(tmp_path):
    folder = write_folder(tmp_path / "mine")
    expected = track(open_dataset(load_config("folder", overrides=[("dataset.path", str(folder))]).dataset))
    assert ate(expected.poses, path()[:FRAMES])["ate_rmse_cm"] < 0.3
    for name, write in WRITERS.items():
        recording = write(tmp_path / name)
        config = identify_recording(recording).config
        found = track(open_dataset(load_config(config, overrides=[("dataset.path", str(recording))]).dataset))
        if name == "realsense":  # has no reference poses, so its first pose is the identity
            start = np.linalg.inv(found.poses[0])
            assert ate(start @ found.poses, np.linalg.inv(path()[0]) @ path()[:FRAMES])["ate_rmse_cm"] < 0.3
        else:
            np.testing.assert_allclose(found.poses, expected.poses, atol=2e-5)  # the bag's first pose has rounded times


class Rendered(ImageStream):
    """What a camera at a fixed place beside the path sees, rendered when it is asked for."""

    def __init__(self, lens: Lens, path_from_camera: np.ndarray, is_depth: bool, poses: np.ndarray) -> None:
        self._lens, self._place, self._is_depth, self._poses = lens, path_from_camera, is_depth, poses

    def __len__(self) -> int:
        return len(self._poses)

    def times(self) -> np.ndarray:
        return np.arange(len(self)) / 30

    def describe(self, number: int) -> str:
        return f"rendered {number}"

    def read(self, number: int) -> np.ndarray:
        color, depth = render(self._lens, self._poses[number] @ self._place)
        return depth if self._is_depth else color


def recorded(color: Lens, depth: Lens, color_from_depth: np.ndarray, view: str, frames: int) -> Recording:
    poses = path()[:frames]
    pairs = np.repeat(np.arange(frames)[:, None], 2, axis=1)
    streams = Rendered(color, np.eye(4), False, poses), Rendered(depth, color_from_depth, True, poses)
    return Recording("rendered", *streams, pairs, Calibration(color, depth, color_from_depth), poses, view=view)


def error_cm(dataset: RgbdDataset) -> float:
    return ate(track(dataset, "balanced").poses, dataset.poses())["ate_rmse_cm"]


def wide(width: int, height: int) -> Camera:
    """A field of view of 60 degrees across."""
    focal = 0.866 * width
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


COLORS = {
    "640x360": Lens(wide(640, 360)),
    "640x360 Brown": Lens(wide(640, 360), "brown", BROWN),
    "640x360 fisheye": Lens(wide(640, 360), "fisheye", FISHEYE),
    "320x240 Brown": Lens(wide(320, 240), "brown", BROWN),
    "320x240 fisheye": Lens(wide(320, 240), "fisheye", FISHEYE),
}
DEPTHS = {
    "320x240": Lens(wide(320, 240)),
    "320x240 Brown": Lens(wide(320, 240), "brown", BROWN),
    "320x240 fisheye": Lens(wide(320, 240), "fisheye", FISHEYE),
    "160x120": Lens(wide(160, 120)),
}
PLACES = {"side by side": extrinsics(), "apart and turned": extrinsics((0.12, 0.01, -0.02), (0.04, -0.06, 0.03))}
SWEPT = 24


@functools.cache
def clean_error_cm(width: int, height: int) -> float:
    """Of one ideal camera of that size."""
    lens = Lens(wide(width, height))
    return error_cm(recorded(lens, lens, np.eye(4), "depth", SWEPT))


def check(name: str, color: Lens, depth: Lens, place: np.ndarray, view: str) -> None:
    """The error is within 10 % of that of one ideal camera, or too small to tell.

    Prints a row: what is recorded, the view, the error with one ideal camera of the same size and that found, cm.
    """
    camera = color.camera if view == "color" else depth.camera
    error, clean = error_cm(recorded(color, depth, place, view, SWEPT)), clean_error_cm(camera.width, camera.height)
    print(f"\n| {name} | {view} | {clean:.3f} | {error:.3f} |")
    assert error < max(1.1 * clean, TOLD_APART_CM)


# Exact images: with one camera the errors are 0.01 to 0.03 cm. A color image of 16:9 leaves a quarter of the depth of a
# 4:3 camera without color, which is left out, so there is less to track by.
TOLD_APART_CM = 0.1


def test_a_wide_color_image_beside_depth_gives_as_good_a_path():
    """At a quarter of the usual sizes; the sweep has larger ones."""
    color, depth = Lens(wide(320, 180), "brown", BROWN), Lens(wide(160, 120))
    dataset = recorded(color, depth, extrinsics(), "depth", FRAMES)
    assert ate(track(dataset).poses, dataset.poses())["ate_rmse_cm"] < 0.3


@pytest.mark.sweep
@pytest.mark.parametrize("view", ["depth", "color"])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("color", COLORS)
def test_any_two_cameras_give_as_good_a_path(color, depth, place, view):
    check(f"{color}, depth {depth}, {place}", COLORS[color], DEPTHS[depth], PLACES[place], view)


@pytest.mark.sweep
@pytest.mark.parametrize("view", ["depth", "color"])
def test_full_sizes_give_as_good_a_path(view):
    color = Lens(wide(1280, 720), "brown", BROWN)
    check("1280x720 Brown, depth 640x480, side by side", color, Lens(wide(640, 480)), extrinsics(), view)


@pytest.mark.sweep
@pytest.mark.parametrize("view", ["depth", "color"])
def test_a_phone_gives_as_good_a_path(view):
    color = Lens(wide(1920, 1440))
    check("1920x1440, depth 256x192, one view", color, Lens(color.camera.resized(256, 192)), np.eye(4), view)
