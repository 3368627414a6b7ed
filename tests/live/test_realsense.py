"""RealSense by the real SDK: recordings that it made of generated frames; only the camera itself is not there."""

import functools
import json
import sys
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.errors import SourceError
from spslam.live import realsense
from spslam.live.realsense import RealSenseSource, _explained, _is_connected
from tests.cli.command import assert_refused, spslam
from tests.live.realsense_sdk import load_sdk, record
from tests.system.sequences import Recorded


@pytest.fixture(scope="module")
def sdk():
    return load_sdk()


@pytest.fixture(scope="module")
def dataset():
    return Recorded(12)


@pytest.fixture(scope="module")
def recording(sdk, dataset, tmp_path_factory):
    return record(sdk, tmp_path_factory.mktemp("sdk") / "room.db3", dataset, dataset.camera)


def numbers_of(frames, dataset):
    """The numbers that frames were recorded with; their images must be those that were recorded."""
    numbers = [round(30 * frame.timestamp) for frame in frames]
    for frame, number in zip(frames, numbers, strict=True):
        np.testing.assert_array_equal(frame.color, dataset[number].color)
        # Registration to a color camera in the same place leaves depth where it is, but for holes and edges.
        assert np.mean(np.abs(frame.depth - dataset[number].depth) < 0.0006) > 0.9
    return numbers


def test_frames_come_as_they_were_recorded(recording, dataset):
    with RealSenseSource(recording=recording, real_time=False) as source:
        assert repr(source) == "RealSenseSource(RealSense recording room.db3, 160x120)"
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(source.camera, name) == pytest.approx(getattr(dataset.camera, name), rel=1e-6)
        frames = [item.frame for item in source.frames() if item is not None]
    assert numbers_of(frames, dataset) == list(range(len(dataset)))
    assert source.dropped == 0


def test_frames_that_are_not_taken_in_time_are_counted(recording, dataset):
    """At the pace of the recording, 100 Hz, of which a busy machine takes some; color and depth are of one frame."""
    frames = []
    with RealSenseSource(recording=recording) as source:
        for item in source.frames():
            if item is not None:
                frames.append(item.frame)
                time.sleep(0.03)
    numbers = numbers_of(frames, dataset)
    assert 0 < len(numbers) < len(dataset) and (np.diff(numbers) > 0).all()
    assert len(numbers) + source.dropped == numbers[-1] - numbers[0] + 1


class Image:
    """An image as the SDK names its parts."""

    def __init__(self, milliseconds, domain="clock"):
        self.get_timestamp, self.get_frame_timestamp_domain = lambda: milliseconds, lambda: domain


@pytest.mark.parametrize(
    ("color", "depth", "offsets"),
    [
        (Image(104.0), Image(101.0), CaptureOffsets(0.001, 0.003)),
        (Image(104.0), Image(9e9, "another"), AT_ONCE),
    ],
)
def test_when_the_two_images_were_taken(color, depth, offsets):
    class Images:
        get_color_frame, get_depth_frame = lambda self: color, lambda self: depth
        get_timestamp = lambda self: 100.0  # noqa: E731

    found = RealSenseSource._offsets(Images())
    assert (found.depth, found.color) == pytest.approx((offsets.depth, offsets.color), abs=1e-9)


@pytest.mark.parametrize(
    ("color", "depth", "is_pair"),
    [
        (Image(100.0), Image(116.0), True),  # at 30 Hz
        (Image(100.0), Image(133.3), False),  # the SDK's for a color image that is missing
        (Image(133.3), Image(100.0), False),
        (Image(100.0), Image(9e9, "another"), True),
        (None, Image(100.0), False),
    ],
)
def test_images_of_two_moments_are_no_frame(recording, color, depth, is_pair):
    class Images:
        get_color_frame, get_depth_frame = lambda self: color, lambda self: depth

    with RealSenseSource(recording=recording, real_time=False) as source:
        assert source._is_pair(Images()) == is_pair


def test_a_recording_is_tracked_and_recorded_by_the_command(recording, dataset, tmp_path, monkeypatch):
    """The frames that a busy machine would drop are too many for so short a recording: each waits until it is taken."""
    monkeypatch.setattr(realsense, "RealSenseSource", functools.partial(RealSenseSource, real_time=False))
    arguments = ["--recording", recording, "--max-wait", "60000", "--no-mesh", "--device", "cpu"]
    arguments += ["--set", "mapping.first_iterations=12", "--output", "out", "--record", "rec"]
    result = spslam("live", "realsense", *arguments, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "latency p99" in result.stdout
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["received_frames"] == len(dataset)
    again = spslam("run", "folder", "--data", "rec", "--device=cpu", "--no-mesh", "--quiet", cwd=tmp_path)
    assert again.returncode == 0, again.stderr


def test_distortion_of_the_lens_is_undone(sdk, dataset, tmp_path):
    coefficients = (0.1, -0.05, 0.001, -0.001, 0.02)
    path = record(sdk, tmp_path / "lens.db3", [dataset[0]] * 4, dataset.camera, coefficients)
    with RealSenseSource(recording=path, real_time=False) as source:
        item = next(item for item in source.frames() if item is not None)
    matrix = dataset.camera.matrix()
    expected = cv2.undistort(dataset[0].color, matrix, np.array(coefficients))
    inner = np.s_[10:-10, 10:-10]
    difference = np.abs(item.frame.color[inner].astype(int) - expected[inner])
    # The room's patterns are as fine as pixels, where two interpolations differ; undone not at all, it is 30.
    assert difference.mean() < 3
    assert np.abs(dataset[0].color[inner].astype(int) - expected[inner]).mean() > 4 * difference.mean()


def test_files_that_cannot_be_played_are_named(sdk, tmp_path):
    with pytest.raises(SourceError, match="absent.bag: no such file"):
        RealSenseSource(recording=tmp_path / "absent.bag")
    (tmp_path / "text.db3").write_text("hello")
    with pytest.raises(SourceError, match="text.db3: can't be played by pyrealsense2: "):
        RealSenseSource(recording=tmp_path / "text.db3")


def test_without_a_camera_one_line_says_so(sdk, tmp_path):
    assert_refused(spslam("live", "realsense", cwd=tmp_path), "no RealSense camera is connected; check its cable")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("numbers", "serial", "found"),
    [([], None, False), ([None], None, True), (["7"], None, True), ([None, "7"], "7", True), ([None, "8"], "7", False)],
)
def test_a_camera_is_looked_for_among_those_connected(numbers, serial, found):
    """Of some devices the SDK has no serial number, and raises where it is asked for one."""

    class Device:
        def __init__(self, number):
            self.number = number

        def supports(self, info):
            return self.number is not None

        def get_info(self, info):
            if self.number is None:
                raise RuntimeError("info not supported by the device")
            return self.number

    devices = SimpleNamespace(devices=[Device(number) for number in numbers])
    sdk = SimpleNamespace(context=lambda: devices, camera_info=SimpleNamespace(serial_number=0))
    assert _is_connected(sdk, serial) is found


def test_what_the_sdk_refuses_is_explained():
    assert "no camera 77 sends color and depth of 9x9 at 1 Hz; choose another --size or --rate" in _explained(
        "Couldn't resolve requests", None, "77", "9x9 at 1 Hz"
    )
    assert "can't be started: busy" in _explained("busy", None, None, "")


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ModuleNotFoundError("No module named 'pyrealsense2'"), "needs pyrealsense2: pip install 'spslam[realsense]'"),
        (ImportError("libusb-1.0.so.0: cannot open shared object file"), "`apt install libusb-1.0-0`"),
    ],
)
def test_without_the_sdk_one_line_says_what_to_install(monkeypatch, tmp_path, error, message):
    class Missing:
        def find_spec(self, name, path=None, target=None):
            if name == "pyrealsense2":
                raise error

    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Missing(), *sys.meta_path])
    assert_refused(spslam("live", "realsense", cwd=tmp_path), message)
