"""Reading the cameras of a recording from text and JSON files; what a file holds and nobody reads is an error.

An intrinsics file is a text (a 3x3 or 4x4 matrix, or fx fy cx cy) or JSON: `fx, fy, cx, cy` (or `ppx, ppy`), or
Open3D's `intrinsic_matrix`; optionally `width, height, depth_scale`, and the distortion as `model` and `coeffs` or as
`k1`, `k2`, `p1`, `p2`, .... A JSON file may hold both cameras as `color` and `depth`, with the matrix `depth_to_color`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spslam.datasets.images import DEPTH_SCALE_RULE, Size, is_depth_scale
from spslam.datasets.lens import COEFFICIENT_COUNTS, Lens, LensModel
from spslam.datasets.recording import Calibration
from spslam.datasets.registration import is_same_view
from spslam.datasets.text import camera_from_matrix, checked_pose, read_intrinsics_matrix, read_json, read_pose
from spslam.errors import DatasetError, brief
from spslam.reading import MAX_JSON_BYTES, read_text

INTRINSICS_FILES = (
    "intrinsics.txt",
    "camera-intrinsics.txt",
    "intrinsics.json",
    "camera.json",
    "camera_intrinsic.json",
    "intrinsic.json",
)
DEPTH_INTRINSICS_FILES = ("depth_intrinsics.txt", "depth_intrinsics.json")
EXTRINSICS_FILE = "depth_to_color.txt"
_COEFFICIENTS = ("coeffs", "coefficients", "distortion", "distortion_coefficients", "D")
_MODELS = ("model", "distortion_model", "lens_model")
_NUMBERED = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_LENS_KEYS = (*("fx", "fy", "cx", "cy", "ppx", "ppy", "intrinsic_matrix"), *_COEFFICIENTS, *_MODELS, *_NUMBERED)
# Keys that recorders write and that say nothing about geometry (Open3D's and librealsense's among them).
_REMARKS = (
    *("name", "device", "device_name", "serial", "serial_number", "fps", "color_format", "depth_format", "comment"),
    *("stream_length_usec", "description"),
    # Of Open3D's reader for Azure Kinects.
    *("color_mode", "depth_mode", "enable_imu", "serial_number_"),
)
_KNOWN = (*_LENS_KEYS, "width", "height", "depth_scale", "color", "depth", "depth_to_color", *_REMARKS)
# Names of models in files of ROS, librealsense, COLMAP and Open3D; `_` stands for any of space, dot and hyphen. With
# all of librealsense's Brown models the polynomial leads from the ideal point to the distorted one, with that called
# inverse too: rs2_project_point_to_pixel applies it and rs2_deproject_pixel_to_point, since 2021, iterates. What
# librealsense's modified order of terms changes is 0.02 px.
_MODEL_NAMES: dict[str, LensModel] = {
    "": "pinhole",
    "none": "pinhole",
    "pinhole": "pinhole",
    "simple_pinhole": "pinhole",
    "brown": "brown",
    "brown_conrady": "brown",
    "modified_brown_conrady": "brown",
    "plumb_bob": "brown",
    "rational_polynomial": "brown",
    "radtan": "brown",
    "opencv": "brown",
    "full_opencv": "brown",
    "inverse_brown_conrady": "brown",
    "fisheye": "fisheye",
    "equidistant": "fisheye",
    "kannala_brandt": "fisheye",
    "kannala_brandt4": "fisheye",
    "opencv_fisheye": "fisheye",
}


@dataclass(frozen=True)
class _Entry:
    """One camera of a file; `scale` are depth units per meter, None where the file doesn't say."""

    lens: Lens
    scale: float | None


def read_calibration(folder: Path, color_size: Size, depth_size: Size | None) -> tuple[Calibration, float | None]:
    """The cameras of a folder.

    Without intrinsics of their own depth images are taken as registered to the color images, of whatever size as long
    as the ratio of the sides is the same.

    Args:
        folder: holds one of `INTRINSICS_FILES`, and for a depth camera of its own one of `DEPTH_INTRINSICS_FILES` and
            `depth_to_color.txt` (4x4, row by row, m).
        color_size: (width, height) of the color images.
        depth_size: of the depth images; None where none can be read, which are taken to be as large as color.

    Returns:
        The cameras; and depth units per meter, None where no file says.

    Raises:
        DatasetError: no such file or a malformed one, a key that isn't known, another size than the images', a depth
            image of other sides without intrinsics of its own, or of another camera without its place.
    """
    depth_size = depth_size or color_size
    path = find_intrinsics(folder, INTRINSICS_FILES)
    values = read_json(path) if path.suffix == ".json" else {}
    if "color" in values or "depth" in values:
        color = _nested(values, "color", path, color_size)
        depth = _nested(values, "depth", path, depth_size) if "depth" in values else None
        scale = depth.scale if depth is not None and depth.scale is not None else color.scale
        if values.get("depth_scale") is not None:
            scale = _scale(values, str(path))
    else:
        color = _read_entry(path, values, color_size)
        depth, scale = None, color.scale
    if any((folder / name).is_file() for name in DEPTH_INTRINSICS_FILES):
        own = find_intrinsics(folder, DEPTH_INTRINSICS_FILES)
        if depth is not None:
            raise DatasetError(f"{own}: the depth camera must be in one file, but is in {path.name} too")
        depth = _read_entry(own, read_json(own) if own.suffix == ".json" else {}, depth_size)
        scale = depth.scale if depth.scale is not None else scale
    place = _read_place(folder, values, path)
    if depth is None:
        return _registered(color.lens, depth_size, place, path), scale
    if place is None:
        if not is_same_view(color.lens.camera, depth.lens.camera, np.eye(4)):
            raise DatasetError(
                f"{folder}: a depth camera of its own must have its place: {EXTRINSICS_FILE} (or depth_to_color in "
                f"{path.name}), the 4x4 matrix that maps its points to the color camera's, m; 1s and 0s for the same"
            )
        place = np.eye(4)
    return Calibration(color.lens, depth.lens, place), scale


def find_intrinsics(folder: Path, names: tuple[str, ...]) -> Path:
    """The one of some files that is there; raises DatasetError where none is, or several that are not all alike."""
    present = [folder / name for name in names if (folder / name).is_file()]
    if not present:
        raise DatasetError(f"{folder}: must contain the intrinsics in one of {', '.join(names)}, got none")
    if len({read_text(path, MAX_JSON_BYTES, DatasetError) for path in present}) > 1:
        raise DatasetError(
            f"{folder}: must contain the intrinsics in one file, got {' and '.join(path.name for path in present)}; "
            "remove or rename those that do not hold"
        )
    return present[0]


def lens_model(name: Any, source: str) -> LensModel:
    """The model that a file's name for it stands for.

    Args:
        name: as files of ROS, librealsense, COLMAP and Open3D have it.
        source: what the error begins with.

    Raises:
        DatasetError: an unknown name.
    """
    plain = str(name).strip().lower().removeprefix("distortion.")
    for character in " .-":
        plain = plain.replace(character, "_")
    if plain not in _MODEL_NAMES:
        known = ", ".join(key for key in _MODEL_NAMES if key)
        raise DatasetError(f"{source}: the lens model must be one of {known}, got {brief(str(name))}")
    return _MODEL_NAMES[plain]


def make_lens(matrix: np.ndarray, size: Size, model: LensModel, coefficients: Any, source: str) -> Lens:
    """A lens of what a file says.

    Args:
        matrix: [3, 3].
        size: (width, height) of the images.
        model: as `lens_model` gives it.
        coefficients: numbers; zeros at the end are left out or added as the model wants them.
        source: what an error begins with.

    Raises:
        DatasetError: no camera, or coefficients that don't fit the model.
    """
    camera = camera_from_matrix(matrix, *size, source)
    if not isinstance(coefficients, (list, tuple)) or not all(_is_number(value) for value in coefficients):
        raise DatasetError(f"{source}: the distortion must be a list of numbers, got {brief(coefficients)}")
    numbers = [float(value) for value in coefficients]
    if not any(numbers) and model != "fisheye":
        return Lens(camera)
    if model == "pinhole":
        model = "brown"  # the model that is meant where none is named
    counts = COEFFICIENT_COUNTS[model]
    while numbers and not numbers[-1] and len(numbers) not in counts:
        numbers.pop()
    numbers += [0.0] * (next((count for count in counts if count >= len(numbers)), 0) - len(numbers))
    try:
        return Lens(camera, model, tuple(numbers))
    except ValueError as error:
        raise DatasetError(f"{source}: {error}") from None


def _registered(lens: Lens, depth_size: Size, place: np.ndarray | None, path: Path) -> Calibration:
    """Depth without intrinsics of its own."""
    camera = lens.camera
    if place is not None:
        raise DatasetError(
            f"{path}: with {EXTRINSICS_FILE} the depth camera must have intrinsics of its own: "
            f"{' or '.join(DEPTH_INTRINSICS_FILES)}"
        )
    width, height = depth_size
    if abs(camera.width * height - camera.height * width) > max(camera.width, camera.height):
        raise DatasetError(
            f"{path.parent}: depth images of {width}x{height} beside color images of {camera.width}x{camera.height} "
            f"must have intrinsics of their own: {' or '.join(DEPTH_INTRINSICS_FILES)}, and {EXTRINSICS_FILE}"
        )
    return Calibration.of_one_view(lens, depth_size)


def _nested(values: Mapping[str, Any], name: str, path: Path, size: Size) -> _Entry:
    _check_keys(values, ("color", "depth", "depth_to_color", "depth_scale", *_REMARKS), str(path))
    entry = values.get(name)
    if not isinstance(entry, dict):
        raise DatasetError(f"{path}: must contain an object {name!r} with the camera, got {brief(entry)}")
    return _entry(entry, f"{path}, {name}", size)


def _read_entry(path: Path, values: Mapping[str, Any], size: Size) -> _Entry:
    if path.suffix == ".json":
        return _entry(values, str(path), size)
    return _Entry(Lens(read_intrinsics_matrix(path, *size)), None)


def _entry(values: Mapping[str, Any], source: str, size: Size) -> _Entry:
    _check_keys(values, _KNOWN, source)
    matrix = _matrix(values, source)
    for name, actual in zip(("width", "height"), size, strict=True):
        if name in values and values[name] != actual:
            raise DatasetError(f"{source}: {name} must be the images' {actual}, got {brief(values[name])}")
    named = next((values[key] for key in _MODELS if key in values), "")
    # librealsense's own name for the list is `coeffs`; that for the model, `model`, may be `distortion` elsewhere.
    listed = next((values[key] for key in _COEFFICIENTS if key in values and not isinstance(values[key], str)), None)
    named = named or next((values[key] for key in _COEFFICIENTS if isinstance(values.get(key), str)), "")
    model = lens_model(named, source)
    if listed is None:
        names = ("k1", "k2", "k3", "k4") if model == "fisheye" else _NUMBERED
        listed = [values.get(name, 0.0) for name in names]
        if model == "fisheye" and not any(name in values for name in names):
            raise DatasetError(f"{source}: a fisheye lens must have coefficients (coeffs), got none")
    return _Entry(make_lens(matrix, size, model, listed, source), _scale(values, source))


def _check_keys(values: Mapping[str, Any], known: tuple[str, ...], source: str) -> None:
    unknown = [key for key in values if key not in known]
    if unknown:
        listed = ", ".join(name for name in known if name not in _REMARKS)
        raise DatasetError(
            f"{source}: nothing here reads {brief(', '.join(unknown))}; remove it, or use what is read: {listed}"
        )


def _matrix(values: Mapping[str, Any], source: str) -> np.ndarray:
    stored = values.get("intrinsic_matrix")
    if stored is not None:
        return _intrinsic_matrix(stored, source)
    numbers = {}
    for name, other in (("fx", "fx"), ("fy", "fy"), ("cx", "ppx"), ("cy", "ppy")):
        value = values.get(name, values.get(other))
        if not _is_number(value):
            raise DatasetError(f"{source}: must contain numbers fx, fy, cx, cy, got {name}: {brief(value)}")
        numbers[name] = float(value)  # type: ignore[arg-type]
    return np.array([[numbers["fx"], 0, numbers["cx"]], [0, numbers["fy"], numbers["cy"]], [0, 0, 1]])


def _intrinsic_matrix(stored: Any, source: str) -> np.ndarray:
    """Open3D's: nine numbers column by column, or three rows."""
    rows = stored if isinstance(stored, list) else []
    flat = [number for row in rows for number in (row if isinstance(row, list) else [row])]
    if len(flat) != 9 or not all(_is_number(number) for number in flat):
        raise DatasetError(f"{source}: intrinsic_matrix must be nine numbers column by column, got {brief(stored)}")
    matrix = np.array(flat, dtype=np.float64).reshape(3, 3)
    return matrix if len(rows) == 3 else matrix.T


def _scale(values: Mapping[str, Any], source: str) -> float | None:
    scale = values.get("depth_scale")
    if scale is not None and not is_depth_scale(scale):
        raise DatasetError(f"{source}: depth_scale must be {DEPTH_SCALE_RULE}, got {brief(scale)}")
    return scale


def _read_place(folder: Path, values: Mapping[str, Any], path: Path) -> np.ndarray | None:
    """`color_from_depth` of the text file or of the JSON file; None where there is neither."""
    if (folder / EXTRINSICS_FILE).is_file():
        return _finite(read_pose(folder / EXTRINSICS_FILE), str(folder / EXTRINSICS_FILE))
    stored = values.get("depth_to_color")
    if stored is None:
        return None
    rows = stored if isinstance(stored, list) else []
    flat = [number for row in rows for number in (row if isinstance(row, list) else [row])]
    if len(flat) not in (12, 16) or not all(_is_number(number) for number in flat):
        raise DatasetError(f"{path}: depth_to_color must be a 4x4 matrix row by row, got {brief(stored)}")
    source = f"{path}, depth_to_color"
    return _finite(checked_pose(np.array(flat, dtype=np.float64), source), source)


def _finite(place: np.ndarray, source: str) -> np.ndarray:
    if not np.isfinite(place).all():
        raise DatasetError(f"{source}: must be a rotation and a translation, got a number that isn't finite")
    return place


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
