"""The RealSense SDK for tests: the real one, with recordings that it makes of frames that tests make."""

from __future__ import annotations

import contextlib
import ctypes
import time
from pathlib import Path

import numpy as np
import pytest


def load_sdk():
    """pyrealsense2, with libusb from its wheel where the system has none; skips the test where it can't be loaded."""
    with contextlib.suppress(ImportError, OSError):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    return pytest.importorskip("pyrealsense2", exc_type=ImportError)


def intrinsics(sdk, camera, coefficients=()):
    lens = sdk.intrinsics()
    lens.width, lens.height = camera.width, camera.height
    lens.fx, lens.fy, lens.ppx, lens.ppy = camera.fx, camera.fy, camera.cx, camera.cy
    lens.model = sdk.distortion.brown_conrady if any(coefficients) else sdk.distortion.none
    lens.coeffs = list(coefficients) or [0.0] * 5
    return lens


def record(sdk, path: Path, frames, camera, coefficients=(), pause_s=0.01) -> Path:
    """Writes a recording (`.db3`) with the SDK's recorder: frames of a software device, depth in millimeters."""
    device = sdk.software_device()
    streams = {}
    for number, (kind, stream_type, size, stream_format) in enumerate(
        (("Depth", sdk.stream.depth, 2, sdk.format.z16), ("Color", sdk.stream.color, 3, sdk.format.rgb8))
    ):
        sensor, stream = device.add_sensor(kind), sdk.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = stream_type, 0, number, stream_format
        stream.width, stream.height, stream.fps, stream.bpp = camera.width, camera.height, 30, size
        stream.intrinsics = intrinsics(sdk, camera, coefficients)
        streams[kind] = sensor, sensor.add_video_stream(stream), size
    streams["Depth"][0].add_read_only_option(sdk.option.depth_units, 0.001)
    same_place = sdk.extrinsics()
    same_place.rotation, same_place.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
    streams["Depth"][1].register_extrinsics_to(streams["Color"][1], same_place)
    recorder, sync = sdk.recorder(str(path), device), sdk.syncer()
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(sync)
    for number, frame in enumerate(frames):
        images = {"Depth": np.rint(1000 * frame.depth).astype(np.uint16), "Color": frame.color}
        for kind, (sensor, profile, size) in streams.items():
            image = sdk.software_video_frame()
            image.pixels, image.stride, image.bpp = images[kind], size * camera.width, size
            image.timestamp, image.domain = 1e3 * frame.timestamp, sdk.timestamp_domain.system_time
            image.frame_number, image.profile = number, profile.as_video_stream_profile()
            if kind == "Depth":
                image.depth_units = 0.001
            sensor.on_video_frame(image)
        time.sleep(pause_s)
    time.sleep(0.3)  # the recorder writes on a thread
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    return path
