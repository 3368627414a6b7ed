"""Azure Kinect's recordings (`k4arecorder`): Matroska files with color and depth tracks, and the calibration.

Color is MJPEG, YUY2 or NV12, depth 16-bit millimeters without compression; FFmpeg decodes both. The attachment
`calibration.json` holds the cameras in units of the sensors' sizes, before the cropping of the mode that was recorded,
and where they are to the depth camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spslam.datasets.images import Size
from spslam.datasets.lens import Lens
from spslam.datasets.pairing import pair_by_time
from spslam.datasets.recording import Calibration, Recording, View
from spslam.datasets.text import camera_from_matrix, checked_pose
from spslam.datasets.video import VideoStream, explained, open_video
from spslam.errors import DatasetError, brief
from spslam.geometry import inverse
from spslam.reading import MAX_JSON_BYTES, open_regular, parse_json

_UNITS_PER_METER = 1000.0
_LOCATIONS = {"CALIBRATION_CameraLocationD0": "depth", "CALIBRATION_CameraLocationPV0": "color"}
# Of each image size: that of the calibrated (binned) sensor image, and what is cropped from its left and top, as in the
# Azure Kinect SDK (transformation/mode_specific_calibration.c).
_MODES: dict[str, dict[Size, tuple[Size, Size]]] = {
    "depth": {
        (320, 288): ((512, 512), (96, 90)),
        (640, 576): ((1024, 1024), (192, 180)),
        (512, 512): ((512, 512), (0, 0)),
        (1024, 1024): ((1024, 1024), (0, 0)),
    },
    "color": {
        (1280, 720): ((1280, 960), (0, 120)),
        (1920, 1080): ((1920, 1440), (0, 180)),
        (2560, 1440): ((2560, 1920), (0, 240)),
        (2048, 1536): ((2048, 1536), (0, 0)),
        (3840, 2160): ((3840, 2880), (0, 360)),
        (4096, 3072): ((4096, 3072), (0, 0)),
    },
}
_PARAMETERS = 14


def open_azure_kinect(path: Path, tolerance_s: float = 0.02, view: View = "depth") -> Recording:
    """Opens a recording.

    Args:
        path: the `.mkv` file.
        tolerance_s: images that are less apart are one frame.
        view: see `Recording`.

    Raises:
        DatasetError: PyAV is not installed, a file that can't be read, without color or depth, or of a mode whose
            calibration is not known.
    """
    tracks, attached = _contents(path)
    missing = [name for name in ("COLOR", "DEPTH") if name not in tracks]
    if missing:
        raise DatasetError(
            f"{path}: must have tracks COLOR and DEPTH of k4arecorder, got no {' and no '.join(missing)}; a file that "
            "was cut or converted has lost them"
        )
    color = VideoStream(path, tracks["COLOR"])
    depth = VideoStream(path, tracks["DEPTH"], is_depth=True, units_per_meter=_UNITS_PER_METER)
    if attached is None:
        raise DatasetError(f"{path}: must have the attachment calibration.json of k4arecorder, got none")
    sizes = {"color": color.index.size, "depth": depth.index.size}
    calibration = read_calibration(attached, sizes, f"{path}, calibration.json")
    pairs = pair_by_time(color.times(), depth.times(), tolerance_s, str(path))
    dataset = Recording(f"azure_kinect/{path.stem}", color, depth, pairs, calibration, view=view)
    dataset.is_timed = True
    return dataset


def read_calibration(content: bytes, sizes: Mapping[str, Size], source: str) -> Calibration:
    """The cameras of an attachment.

    Args:
        content: the JSON text.
        sizes: (width, height) of the `color` and the `depth` images.
        source: what errors begin with.

    Raises:
        DatasetError: not such a text, or a mode that is not known.
    """
    text = content.rstrip(b"\0").decode("utf-8", "replace")
    information = parse_json(text, source, DatasetError).get("CalibrationInformation")
    cameras = information.get("Cameras") if isinstance(information, dict) else None
    found: dict[str, tuple[Lens, np.ndarray]] = {}
    for entry in cameras if isinstance(cameras, list) else ():
        kind = _LOCATIONS.get(str(entry.get("Location"))) if isinstance(entry, dict) else None
        if kind is not None:
            found[kind] = _camera(entry, kind, sizes[kind], f"{source}, {kind} camera")
    if len(found) != len(_LOCATIONS):
        raise DatasetError(f"{source}: must describe a depth and a color camera, got {', '.join(found) or 'neither'}")
    (color, color_place), (depth, depth_place) = found["color"], found["depth"]
    return Calibration(color, depth, color_place @ inverse(depth_place))


def _contents(path: Path) -> tuple[dict[str, int], bytes | None]:
    """Numbers of the video tracks by name, and the calibration."""
    open_regular(path, DatasetError).close()
    with explained(path), open_video(path) as container:
        tracks = {stream.metadata.get("title", ""): number for number, stream in enumerate(container.streams.video)}
        for stream in container.streams.attachments:
            if stream.name == "calibration.json":
                content = bytes(stream.data or b"")
                if len(content) > MAX_JSON_BYTES:
                    raise DatasetError(f"{path}: calibration.json must have at most {MAX_JSON_BYTES} bytes")
                return tracks, content
        return tracks, None


def _camera(entry: Mapping[str, Any], kind: str, size: Size, source: str) -> tuple[Lens, np.ndarray]:
    """The lens in the recorded mode, and points of the reference camera to points of this one."""
    if size not in _MODES[kind]:
        known = ", ".join(f"{width}x{height}" for width, height in _MODES[kind])
        raise DatasetError(f"{source}: images must be of one of the modes {known}, got {size[0]}x{size[1]}")
    numbers = _numbers(entry, ("Intrinsics", "ModelParameters"), _PARAMETERS, source)
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = numbers
    (width, height), (left, top) = _MODES[kind][size]
    # The SDK counts from the corner of a pixel, we from its center.
    center = cx * width - left - 0.5, cy * height - top - 0.5
    matrix = np.array([[fx * width, 0, center[0]], [0, fy * height, center[1]], [0, 0, 1]])
    lens = Lens(camera_from_matrix(matrix, *size, source), "brown", (k1, k2, p1, p2, k3, k4, k5, k6))
    place = np.eye(4)
    place[:3, :3] = np.reshape(_numbers(entry, ("Rt", "Rotation"), 9, source), (3, 3))
    place[:3, 3] = _numbers(entry, ("Rt", "Translation"), 3, source)
    return lens, checked_pose(place.reshape(-1), source)


def _numbers(entry: Mapping[str, Any], keys: tuple[str, str], count: int, source: str) -> list[float]:
    section = entry.get(keys[0])
    values = section.get(keys[1]) if isinstance(section, dict) else None
    is_row = isinstance(values, list) and len(values) >= count
    try:
        numbers = [float(value) for value in values[:count]] if is_row else []  # type: ignore[index]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise DatasetError(f"{source}: {'.'.join(keys)} must be {count} numbers, got {brief(values)}")
    return numbers
