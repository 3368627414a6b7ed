"""Record3D (iPhone and iPad): an `.r3d` archive, the folder unpacked from it, or its export as EXR and images.

`metadata` (JSON): `K` (3x3 column by column, of the color images), `fps`, `frameTimestamps`, `dw`, `dh` (size of depth)
and `poses` (qx qy qz qw x y z; camera to world, axes of OpenGL). `rgbd/N.jpg`, `rgbd/N.depth` (float32 in meters,
LZFSE) and `rgbd/N.conf` (8 bits, LZFSE). The export has `EXR_RGBD/metadata.json`, `rgb/N.jpg` (or png), `depth/N.exr`.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spslam.datasets.exr import read_exr
from spslam.datasets.images import MAX_IMAGE_BYTES, Size, check_image_size, decode_color, depth_in_meters
from spslam.datasets.lens import Lens
from spslam.datasets.recording import Calibration, ImageStream, Recording, View
from spslam.datasets.stray_scanner import known_poses
from spslam.datasets.text import camera_from_matrix
from spslam.errors import DatasetError, brief
from spslam.reading import MAX_TEXT_BYTES, open_regular, parse_json, read_bytes

METADATA_FILES = ("metadata", "metadata.json")
_EXPORT = "EXR_RGBD"
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_FRAMES_PER_SECOND = 60.0
_RATES = (1e-3, 1e6)


class _Archive:
    """Files by name, in a folder or a zip file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        self.names = self._list()

    def read(self, name: str, max_bytes: int = MAX_IMAGE_BYTES) -> bytes:
        if self.path.is_dir():
            return read_bytes(self.path / name, max_bytes, DatasetError)
        try:
            archive = self._opened()
            if archive.getinfo(name).file_size > max_bytes:
                raise DatasetError(f"{self.path}, {name}: must have at most {max_bytes} bytes")
            return archive.read(name)
        except KeyError:
            raise DatasetError(f"{self.path}, {name}: no such file in the archive") from None
        except DatasetError:
            raise
        except Exception as error:  # zipfile raises whatever a damaged archive makes it raise
            raise DatasetError(f"{self.path}, {name}: can't be read: {brief(str(error) or 'damaged')}") from error

    def describe(self, name: str) -> str:
        return str(self.path / name) if self.path.is_dir() else f"{self.path}, {name}"

    def _list(self) -> set[str]:
        if self.path.is_dir():
            found = [path for folder in (".", "rgbd", "rgb", "depth") for path in (self.path / folder).glob("*")]
            return {str(path.relative_to(self.path)) for path in found}
        open_regular(self.path, DatasetError).close()
        try:
            return set(self._opened().namelist())
        except Exception as error:
            raise DatasetError(f"{self.path}: can't be read as an .r3d archive: {brief(str(error))}") from None

    def _opened(self) -> zipfile.ZipFile:
        self._zip = self._zip or zipfile.ZipFile(self.path)
        return self._zip

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_zip": None}


@dataclass(frozen=True)
class _Images(ImageStream):
    """What both streams share: `names[i]` is the file of image i."""

    archive: _Archive
    names: list[str]
    seconds: np.ndarray
    size: Size

    def __len__(self) -> int:
        return len(self.names)

    def times(self) -> np.ndarray:
        return self.seconds.copy()

    def describe(self, number: int) -> str:
        return self.archive.describe(self.names[number])


class _ColorImages(_Images):
    def read(self, number: int) -> np.ndarray:
        return decode_color(self.archive.read(self.names[number]), self.describe(number), self.size)


@dataclass(frozen=True)
class _DepthImages(_Images):
    min_confidence: int = 0

    def read(self, number: int) -> np.ndarray:
        name = self.names[number]
        if name.endswith(".exr"):
            return depth_in_meters(read_exr(self.archive.path / name, self.size), None)
        content = self.archive.read(name)
        width, height = self.size
        stored = np.frombuffer(self._unpacked(content, name, 4), "<f4").reshape(height, width)
        depth = depth_in_meters(stored, None)
        sure = name.removesuffix(".depth") + ".conf"
        if self.min_confidence > 0 and sure in self.archive.names:
            confidence = np.frombuffer(self._unpacked(self.archive.read(sure), sure, 1), np.uint8)
            depth[confidence.reshape(height, width) < self.min_confidence] = 0
        return depth

    def _unpacked(self, content: bytes, name: str, bytes_per_pixel: int) -> bytes:
        unpacked = _unpack(content, self.archive.describe(name))
        wanted = self.size[0] * self.size[1] * bytes_per_pixel
        if len(unpacked) != wanted:
            raise DatasetError(
                f"{self.archive.describe(name)}: must hold {self.size[0]}x{self.size[1]} pixels in {wanted} bytes, "
                f"got {len(unpacked)}"
            )
        return unpacked


def open_record3d(path: Path, min_confidence: int = 0, view: View = "depth") -> Recording:
    """Opens a recording of Record3D.

    Args:
        path: the `.r3d` file, the folder unpacked from it, or the folder of the export (that holds `EXR_RGBD`).
        min_confidence: depth of lower confidence (0, 1, 2) comes as 0; the export has none.
        view: see `Recording`.

    Raises:
        DatasetError: a missing path, another layout, malformed metadata, or a library that is not installed.
    """
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    archive = _Archive(path / _EXPORT if (path / _EXPORT).is_dir() else path)
    name = next((name for name in METADATA_FILES if name in archive.names), None)
    if name is None:
        raise DatasetError(f"{archive.path}: must contain {' or '.join(METADATA_FILES)}, got neither")
    source = archive.describe(name)
    values = _parse(archive.read(name, MAX_TEXT_BYTES), source)
    colors, depths, numbers = _frame_names(archive)
    seconds = _times(values, numbers, source)
    color = _ColorImages(archive, colors, seconds, (0, 0))
    size = decode_color(archive.read(colors[0]), color.describe(0)).shape[1::-1]
    depth_size = _depth_size(values, archive, depths[0], size)
    calibration = Calibration.of_one_view(_lens(values, size, source), depth_size)
    pairs = np.repeat(np.arange(len(numbers))[:, None], 2, axis=1)
    streams = (
        _ColorImages(archive, colors, seconds, size),
        _DepthImages(archive, depths, seconds, depth_size, min_confidence),
    )
    poses = _poses(values, numbers, source)
    return Recording(f"record3d/{path.stem}", *streams, pairs, calibration, poses, view=view)


def _frame_names(archive: _Archive) -> tuple[list[str], list[str], np.ndarray]:
    """The color and depth images of the frames that have both, and their numbers, ascending."""
    found: dict[str, dict[int, str]] = {"color": {}, "depth": {}}
    for name in archive.names:
        folder, _, file = name.rpartition("/")
        stem, _, suffix = file.rpartition(".")
        kind = {"jpg": "color", "jpeg": "color", "png": "color", "depth": "depth", "exr": "depth"}.get(suffix.lower())
        if suffix == "exr" and not archive.path.is_dir():
            continue
        if kind is not None and folder in ("rgbd", "rgb", "depth") and stem.isdecimal() and len(stem) < 10:
            found[kind][int(stem)] = name
    numbers = sorted(found["color"].keys() & found["depth"].keys())
    if not numbers:
        raise DatasetError(
            f"{archive.path}: must contain rgbd/0.jpg and rgbd/0.depth (or rgb/0.jpg and depth/0.exr) and so on, got "
            f"{len(found['color'])} color and {len(found['depth'])} depth images without the other"
        )
    return *([found[kind][number] for number in numbers] for kind in ("color", "depth")), np.array(numbers)  # type: ignore[return-value]


def _parse(content: bytes, source: str) -> dict[str, Any]:
    try:
        return parse_json(content.decode("utf-8-sig"), source, DatasetError)
    except UnicodeDecodeError:
        raise DatasetError(f"{source}: must be a text file") from None


def _numbers(values: dict[str, Any], key: str, width: int, source: str) -> np.ndarray | None:
    """The rows [N, width] of numbers under a key; None where it is absent or empty."""
    stored = values.get(key)
    if not stored:
        return None
    try:
        rows = np.array(stored, dtype=np.float64).reshape(-1, width)
    except (TypeError, ValueError):
        raise DatasetError(f"{source}: {key} must be rows of {width} numbers, got {brief(stored)}") from None
    return rows


def _times(values: dict[str, Any], numbers: np.ndarray, source: str) -> np.ndarray:
    rows = _numbers(values, "frameTimestamps", 1, source)
    if rows is not None and numbers[-1] < len(rows):
        seconds = rows[numbers, 0]
        if not np.isfinite(seconds).all() or (np.diff(seconds) <= 0).any():
            raise DatasetError(f"{source}: frameTimestamps must be finite and ascend")
        return seconds
    rate = values.get("fps", _FRAMES_PER_SECOND)
    if not isinstance(rate, (int, float)) or not _RATES[0] <= rate <= _RATES[1]:
        raise DatasetError(f"{source}: fps must be a number from {_RATES[0]:g} to {_RATES[1]:g}, got {brief(rate)}")
    return numbers / float(rate)


def _poses(values: dict[str, Any], numbers: np.ndarray, source: str) -> np.ndarray | None:
    rows = _numbers(values, "poses", 7, source)
    if rows is None:
        return None
    poses = np.full((len(numbers), 4, 4), np.nan)
    known = numbers < len(rows)
    found = rows[numbers[known]]
    poses[known] = known_poses(found[:, [3, 0, 1, 2, 4, 5, 6]]) @ _OPENCV_FROM_OPENGL
    return poses


def _lens(values: dict[str, Any], size: Size, source: str) -> Lens:
    matrix = _numbers(values, "K", 9, source)
    if matrix is None or len(matrix) != 1:
        raise DatasetError(f"{source}: must contain K, nine numbers column by column, got {brief(values.get('K'))}")
    described = values.get("w"), values.get("h")
    if not all(isinstance(side, int) and 0 < side < 2**15 for side in described):
        described = size
    if described[0] * size[1] != described[1] * size[0]:  # type: ignore[operator]
        raise DatasetError(
            f"{source}: w and h must be the images' {size[0]}x{size[1]} or in proportion, got {described}"
        )
    camera = camera_from_matrix(matrix.reshape(3, 3).T, *described, source)  # type: ignore[arg-type]
    return Lens(camera.resized(*size))


def _depth_size(values: dict[str, Any], archive: _Archive, name: str, color: Size) -> Size:
    """(width, height) by the metadata, else by the number of pixels and the sides of the color images."""
    if name.endswith(".exr"):
        return read_exr(archive.path / name).shape[1::-1]
    size = values.get("dw"), values.get("dh")
    if all(isinstance(side, int) for side in size):
        check_image_size(size, archive.describe(name))  # type: ignore[arg-type]
        return size  # type: ignore[return-value]
    pixels = len(_unpack(archive.read(name), archive.describe(name))) // 4
    height = round((pixels * color[1] / color[0]) ** 0.5)
    if height < 1 or pixels % height:
        raise DatasetError(f"{archive.describe(name)}: {pixels} pixels must have the sides of the color images")
    return pixels // height, height


def _unpack(content: bytes, source: str) -> bytes:
    try:
        import lzfse
    except ImportError:
        raise DatasetError(f"{source}: depth of Record3D needs lzfse: pip install 'spslam[phone]'") from None
    try:
        return lzfse.decompress(content)
    except Exception as error:
        raise DatasetError(f"{source}: can't be unpacked: {brief(str(error) or 'damaged')}") from None
