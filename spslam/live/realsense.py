"""RealSense cameras by their SDK, which brings depth to the view of the color image; the extra `realsense`."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.datasets.frame_arrays import UNNUMBERED
from spslam.errors import SourceError
from spslam.live.source import LiveFrame, LiveSource

WIDTH, HEIGHT, RATE_HZ = 640, 480, 30  # every camera of the D400 series has them for both streams
SETTLING_FRAMES = 15  # until automatic exposure has found its value
_WAIT_MS = 500
_SILENCE_S = 5.0
# The lens is taken as free of distortion if it moves no pixel further.
_NEGLIGIBLE_PX = 0.1
# Of a frame's period. Images of one moment are at most half of it apart, as cameras do not expose both together; where
# one is missing, the SDK gives the one before in its place, which is a whole period off.
_MOST_APART = 0.75
_GRID_PX = 8  # distance of the pixels of which the SDK is asked where they come from


class RealSenseSource(LiveSource, AbstractContextManager):
    """Color and depth of a RealSense camera, or of a recording that its SDK made.

    The SDK registers depth to color; intrinsics, depth unit and times (s) are the camera's. Where the color lens has
    distortion, both images are undistorted.

    Args:
        serial: serial number of the camera; any camera where not given.
        width, height: of both streams, px; 640x480 where not given.
        rate_hz: frames per second; 30 where not given.
        recording: a `.bag` or `.db3` file of the SDK, instead of a camera.
        real_time: play the recording at its own pace, so that frames are dropped where they are not taken in time;
            else each waits until it is taken.

    Attributes:
        dropped: frames that came without their color or depth image, or were not taken in time.

    Raises:
        SourceError: pyrealsense2 is missing, there is no such camera, mode or recording.
    """

    def __init__(
        self,
        serial: str | None = None,
        width: int | None = None,
        height: int | None = None,
        rate_hz: int | None = None,
        recording: Path | None = None,
        real_time: bool = True,
    ) -> None:
        self._sdk = sdk = _import_sdk()
        self._is_recording, self.dropped = recording is not None, 0
        config = sdk.config()
        if recording is not None:
            if not Path(recording).is_file():
                raise SourceError(f"{recording}: no such file")
            config.enable_device_from_file(str(recording), repeat_playback=False)
        else:
            size = width or WIDTH, height or HEIGHT
            if serial is not None:
                config.enable_device(serial)
            config.enable_stream(sdk.stream.depth, *size, sdk.format.z16, rate_hz or RATE_HZ)
            config.enable_stream(sdk.stream.color, *size, sdk.format.rgb8, rate_hz or RATE_HZ)
        self._pipeline: Any = sdk.pipeline()
        try:
            if recording is not None:
                # Before the first frame is played.
                player = config.resolve(sdk.pipeline_wrapper(self._pipeline)).get_device().as_playback()
                player.set_real_time(real_time)
                # It would play from the start of its first stream on, and lose what the other had until its own start.
                player.pause()
            elif not _is_connected(sdk, serial):
                raise SourceError(_not_connected(serial))  # starting would wait for one, 15 s
            profile = self._pipeline.start(config)
            if recording is not None:
                _resume(player)
        except RuntimeError as error:
            wanted = f"{width or WIDTH}x{height or HEIGHT} at {rate_hz or RATE_HZ} Hz"
            raise SourceError(_explained(str(error), recording, serial, wanted)) from None
        try:
            self._read_profile(profile, recording)
        except BaseException:
            self.close()
            raise

    def frames(self) -> Iterator[LiveFrame | None]:
        last_s, number, unsettled = time.monotonic(), None, 0 if self._is_recording else SETTLING_FRAMES
        while True:
            frameset, complete_s = self._wait(), time.monotonic()
            if frameset is None:
                if self._is_over():
                    return
                if complete_s - last_s > _SILENCE_S:
                    raise SourceError(
                        f"{self.name}: sent no color and depth image of one moment for {_SILENCE_S:g} s; check its "
                        "cable and USB port"
                    )
                yield None
                continue
            last_s = complete_s
            if unsettled > 0:
                unsettled -= 1
                continue
            latest = frameset.get_depth_frame().get_frame_number()
            if number is not None and latest > number:
                self.dropped += latest - number - 1
            number = latest
            yield LiveFrame(self._convert(frameset), complete_s)

    def close(self) -> None:
        pipeline, self._pipeline = self._pipeline, None
        if pipeline is not None:
            pipeline.stop()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"RealSenseSource({self.name}, {self.camera.width}x{self.camera.height})"

    def _read_profile(self, profile: Any, recording: Path | None) -> None:
        sdk, device = self._sdk, profile.get_device()
        streams = {stream.stream_type(): stream for stream in profile.get_streams()}
        if sdk.stream.color not in streams or sdk.stream.depth not in streams:
            raise SourceError(f"{recording or 'the camera'}: must have a color and a depth stream")
        infos = (sdk.camera_info.name, sdk.camera_info.serial_number)
        words = [device.get_info(info) for info in infos if device.supports(info)]
        self.name = " ".join(words) or (f"RealSense recording {Path(recording).name}" if recording else "RealSense")
        self._playback = device.as_playback() if self._is_recording else None
        rate_hz = min(stream.fps() for stream in streams.values())
        self._most_apart_ms = 1e3 * _MOST_APART / max(rate_hz, 1)
        color = streams[sdk.stream.color].as_video_stream_profile()
        lens = color.get_intrinsics()
        self.camera = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy)
        self._to_rgb = _conversion(sdk, color.format(), self.name)
        self._maps = _undistortion(sdk, lens)
        self._align = sdk.align(sdk.stream.color)

    def _wait(self) -> Any:
        """The next pair of images; None if none came in time, or one image came without the other of its moment."""
        try:
            arrived, frameset = self._pipeline.try_wait_for_frames(_WAIT_MS)
        except RuntimeError as error:
            raise SourceError(f"{self.name}: {error}") from None
        return frameset if arrived and self._is_pair(frameset) else None

    def _is_pair(self, frameset: Any) -> bool:
        color, depth = frameset.get_color_frame(), frameset.get_depth_frame()
        if not color or not depth:
            return False
        if color.get_frame_timestamp_domain() != depth.get_frame_timestamp_domain():
            return True  # of two clocks
        return abs(color.get_timestamp() - depth.get_timestamp()) <= self._most_apart_ms

    def _is_over(self) -> bool:
        return self._playback is not None and self._playback.current_status() == self._sdk.playback_status.stopped

    def _convert(self, frameset: Any) -> RgbdFrame:
        aligned = self._align.process(frameset)
        stored, color = aligned.get_depth_frame(), np.asanyarray(aligned.get_color_frame().get_data())
        # The SDK reuses the memory of its frames.
        color = color.copy() if self._to_rgb is None else cv2.cvtColor(color, self._to_rgb)
        depth = np.asanyarray(stored.get_data()) * np.float32(stored.get_units())
        if self._maps is not None:
            color = cv2.remap(color, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            # Depth between a near and a far pixel would be of neither.
            depth = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        offsets = self._offsets(frameset)
        time_s = frameset.get_timestamp() / 1e3
        return RgbdFrame(UNNUMBERED, time_s, color, depth.astype(np.float32, copy=False), offsets=offsets)

    @staticmethod
    def _offsets(frameset: Any) -> CaptureOffsets:
        """By the stamps of the two images, which the camera gives them itself."""
        color, depth = frameset.get_color_frame(), frameset.get_depth_frame()
        if color.get_frame_timestamp_domain() != depth.get_frame_timestamp_domain():
            return AT_ONCE  # of two clocks
        frame_ms, color_ms, depth_ms = frameset.get_timestamp(), color.get_timestamp(), depth.get_timestamp()
        return CaptureOffsets((depth_ms - frame_ms) / 1e3, (color_ms - depth_ms) / 1e3)


def _import_sdk() -> Any:
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise SourceError("a RealSense camera needs pyrealsense2: pip install 'spslam[realsense]'") from None
    except ImportError as error:
        hint = "; install libusb, on Debian and Ubuntu `apt install libusb-1.0-0`" if "libusb" in str(error) else ""
        raise SourceError(f"pyrealsense2 can't be loaded: {error}{hint}") from None
    return pyrealsense2


def _resume(player: Any) -> None:
    """Plays a paused recording on, without waiting: the SDK returns once a frame was taken, or after 10 s."""

    def resume() -> None:
        with contextlib.suppress(RuntimeError):  # stopped before a frame was taken
            player.resume()

    threading.Thread(target=resume, name="spslam-realsense", daemon=True).start()


def _explained(error: str, recording: Path | None, serial: str | None, wanted: str) -> str:
    """What to do about the SDK's refusal to start."""
    if recording is not None:
        return f"{recording}: can't be played by pyrealsense2: {error}"
    if "No device connected" in error:
        return _not_connected(serial)
    if "resolve" in error:
        which = f"camera {serial}" if serial else "RealSense camera"
        return f"no {which} sends color and depth of {wanted}; choose another --size or --rate, or unplug the others"
    return f"the RealSense camera can't be started: {error}"


def _is_connected(sdk: Any, serial: str | None) -> bool:
    """Whether there is a camera, or that one. Some devices have no serial number."""
    number = sdk.camera_info.serial_number
    devices = list(sdk.context().devices)
    known = [device.get_info(number) for device in devices if device.supports(number)]
    return serial in known if serial is not None else len(devices) > 0


def _not_connected(serial: str | None) -> str:
    which = f"with the serial number {serial} " if serial else ""
    return f"no RealSense camera {which}is connected; check its cable, and the SDK's udev rules (docs/live.md)"


def _conversion(sdk: Any, color_format: Any, name: str) -> int | None:
    """OpenCV's code of the conversion to RGB; None where the images are RGB."""
    known = {
        sdk.format.rgb8: None,
        sdk.format.bgr8: cv2.COLOR_BGR2RGB,
        sdk.format.rgba8: cv2.COLOR_RGBA2RGB,
        sdk.format.bgra8: cv2.COLOR_BGRA2RGB,
    }
    if color_format not in known:
        raise SourceError(f"{name}: color must be rgb8, bgr8, rgba8 or bgra8, got {color_format}")
    return known[color_format]


def _undistortion(sdk: Any, lens: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Where each pixel of a pinhole image lies in the camera's, float32 [H, W] each; None without distortion.

    The SDK is asked for pixels on a grid, whatever model its lens has; between them the maps are smooth.
    """
    columns, rows = (-(-size // _GRID_PX) + 1 for size in (lens.width, lens.height))
    grid = np.empty((rows, columns, 2), dtype=np.float32)
    for row in range(rows):
        for column in range(columns):
            x, y = (column * _GRID_PX - lens.ppx) / lens.fx, (row * _GRID_PX - lens.ppy) / lens.fy
            grid[row, column] = sdk.rs2_project_point_to_pixel(lens, [x, y, 1.0])
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float32)
    maps = cv2.remap(grid, u / _GRID_PX, v / _GRID_PX, cv2.INTER_LINEAR)
    moved = max(float(np.abs(maps[..., 0] - u).max()), float(np.abs(maps[..., 1] - v).max()))
    return None if moved <= _NEGLIGIBLE_PX else (maps[..., 0].copy(), maps[..., 1].copy())
