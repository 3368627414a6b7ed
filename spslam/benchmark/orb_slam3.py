"""The feature-based baseline: ORB-SLAM3 on RGB-D frames (`pyorbslam3`), with loop closure and relocalization.

C. Campos et al., *ORB-SLAM3: An Accurate Open-Source Library for Visual, Visual-Inertial and Multi-Map SLAM*, IEEE
Transactions on Robotics 37, 2021. Bindings and library are licensed under GPL-3, so they are an extra of their own and
are imported in a separate process only, while the baseline runs. That process also contains the library's threads, and
whatever makes the library end.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from spslam.benchmark import orb_slam3_process
from spslam.benchmark.orb_slam3_process import FAILED, SETTINGS, TRAJECTORY
from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.errors import SpslamError, brief
from spslam.trajectory import Trajectory

# The variable that pyorbslam3 reads, too.
VOCABULARY = "PYORBSLAM3_VOCAB"
_LOG = "log.txt"
_PYRAMID_LEVELS, _PYRAMID_SCALE = 8, 1.2
# ORB-SLAM3 divides each pyramid level, less a border of 16 px, into cells of 35 px, and needs one of them.
_SMALLEST_LEVEL_PX = 35 + 2 * 16
# Examples/RGB-D/TUM1.yaml of ORB-SLAM3, without lens distortion, with depth in meters.
_SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx:f}
Camera1.fy: {fy:f}
Camera1.cx: {cx:f}
Camera1.cy: {cy:f}
Camera.width: {width}
Camera.height: {height}
Camera.fps: {rate_hz}
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: {scale}
ORBextractor.nLevels: {levels}
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
loopClosing: {loop_closing:d}
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def orb_slam3_off_reason() -> str:
    """Why the baseline can't run; empty if it can."""
    if importlib.util.find_spec("pyorbslam3") is None:
        return "needs pyorbslam3, which is licensed under GPL-3: pip install 'spslam[orbslam3]'"
    if orb_vocabulary() is None:
        named = os.environ.get(VOCABULARY)
        found = f", got {brief(named)}, which is not a file" if named else ""
        return (
            f"needs ORB-SLAM3's vocabulary: {VOCABULARY} must name ORBvoc.txt, unpacked from "
            f"Vocabulary/ORBvoc.txt.tar.gz of github.com/UZ-SLAMLab/ORB_SLAM3{found}"
        )
    return ""


def orb_vocabulary() -> Path | None:
    """The file that the environment variable `PYORBSLAM3_VOCAB` names; None without the variable or the file."""
    path = Path(os.environ.get(VOCABULARY, ""))
    return path if path.is_file() else None


class OrbSlam3:
    """Tracks frames by ORB-SLAM3 in a separate process.

    The result differs from run to run, since local mapping and loop closing run in threads beside tracking.

    Args:
        camera: intrinsics of the images, which must have no lens distortion.
        rate_hz: of the frames; ORB-SLAM3 inserts a keyframe at least once a second.
        loop_closing: whether it closes loops and joins maps.

    Attributes:
        live: float64 [4, 4] T_world_camera of each frame as it was tracked, before later keyframes and loops changed
            it; None where ORB-SLAM3 was not tracking. The world is the first tracked camera's.

    Raises:
        SpslamError: pyorbslam3 or the vocabulary is missing, images are too small, or ORB-SLAM3 fails.
    """

    def __init__(self, camera: Camera, rate_hz: float, loop_closing: bool = True) -> None:
        if reason := orb_slam3_off_reason():
            raise SpslamError(f"the ORB-SLAM3 baseline {reason}")
        settings = orb_slam3_settings(camera, rate_hz, loop_closing)
        self.live: list[np.ndarray | None] = []
        self._numbers: dict[int, int] = {}
        self._start = math.nan
        self._folder = tempfile.TemporaryDirectory(prefix="spslam-orb-slam3-")
        folder = Path(self._folder.name)
        (folder / SETTINGS).write_text(settings, encoding="utf-8")
        self._connection, self._process = _start(folder)
        try:
            self._receive()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> OrbSlam3:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def process(self, frame: RgbdFrame) -> np.ndarray | None:
        """Tracks the next frame.

        Args:
            frame: color, depth and time stamp.

        Returns:
            float64 [4, 4] T_world_camera; None where ORB-SLAM3 is not tracking.

        Raises:
            SpslamError: ORB-SLAM3 failed.
        """
        if not self.live:
            self._start = frame.timestamp
        # ORB-SLAM3 writes its trajectory with microseconds.
        microseconds = round(1e6 * (frame.timestamp - self._start))
        self._numbers[microseconds] = len(self.live)
        pose = self._ask((frame.color, frame.depth, 1e-6 * microseconds))
        self.live.append(pose)
        return pose

    def finish(self) -> list[np.ndarray | None]:
        """Ends tracking, waits for loop closing, and reads the final trajectory.

        Returns:
            float64 [4, 4] T_world_camera of each frame after all optimization; None for frames that were not tracked,
            and for those whose map ORB-SLAM3 discarded. The world is the first keyframe's camera.

        Raises:
            SpslamError: ORB-SLAM3 failed.
        """
        self._ask(None)
        poses: list[np.ndarray | None] = [None] * len(self.live)
        path = Path(self._folder.name) / TRAJECTORY
        if path.is_file():
            trajectory = Trajectory.load_tum(path, skip_unknown=True)
            for timestamp, pose in zip(trajectory.timestamps, trajectory.poses, strict=True):
                number = self._numbers.get(round(1e6 * timestamp))
                # The file also has poses for frames on which tracking had just failed.
                if number is not None and self.live[number] is not None:
                    poses[number] = pose
        return poses

    def close(self) -> None:
        """Ends the process and removes its files."""
        self._process.kill()
        self._process.wait()
        self._connection.close()
        self._folder.cleanup()

    def _ask(self, request: Any) -> Any:
        with contextlib.suppress(OSError):  # _receive tells why the process ended
            self._connection.send(request)
        return self._receive()

    def _receive(self) -> Any:
        try:
            kind, content = self._connection.recv()
        except (EOFError, OSError):
            code = self._process.wait()
            raise SpslamError(f"ORB-SLAM3 ended with exit code {code}{self._last_words()}") from None
        if kind == FAILED:
            raise SpslamError(f"ORB-SLAM3 failed: {brief(content, 300)}")
        return content

    def _last_words(self) -> str:
        words = (Path(self._folder.name) / _LOG).read_text(encoding="utf-8", errors="replace").split("\n")
        lines = [line for line in words if line.strip()]
        return f": {brief(lines[-1], 200)}" if lines else ""


def _start(folder: Path) -> tuple[Connection, subprocess.Popen]:
    """Starts the process, which finds the same packages as this one and ends when the connection is closed."""
    connection, other_end = multiprocessing.Pipe()
    command = [sys.executable, "-m", orb_slam3_process.__name__, other_end.fileno(), folder, orb_vocabulary()]
    with (folder / _LOG).open("wb") as log, other_end:
        process = subprocess.Popen(
            list(map(str, command)),
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
            pass_fds=[other_end.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    return connection, process


def orb_slam3_settings(camera: Camera, rate_hz: float, loop_closing: bool = True) -> str:
    """ORB-SLAM3's settings file for a camera without distortion and depth in meters.

    ORB features are extracted on 8 pyramid levels a factor of 1.2 apart, or as many as a small image has room for.

    Args:
        camera: intrinsics.
        rate_hz: of the frames.
        loop_closing: whether it closes loops and joins maps.

    Raises:
        SpslamError: images are too small.
    """
    smallest = min(camera.width, camera.height)
    if smallest < _SMALLEST_LEVEL_PX:
        raise SpslamError(
            f"ORB-SLAM3 needs images of at least {_SMALLEST_LEVEL_PX}x{_SMALLEST_LEVEL_PX} px, "
            f"got {camera.width}x{camera.height}"
        )
    levels = sum(round(smallest / _PYRAMID_SCALE**level) >= _SMALLEST_LEVEL_PX for level in range(_PYRAMID_LEVELS))
    return _SETTINGS.format(
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        width=camera.width,
        height=camera.height,
        rate_hz=max(round(rate_hz), 1),
        scale=_PYRAMID_SCALE,
        levels=levels,
        loop_closing=loop_closing,
    )
