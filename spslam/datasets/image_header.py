"""The size of an image from its header, so that an image of another size than expected is never decoded."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator

_PNG, _JPEG = b"\x89PNG", b"\xff\xd8\xff"
_TIFF = {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}
_PNG_HEAD, _PNG_CHUNK = struct.Struct(">8sI4sII"), struct.Struct(">I4s")
# Chunks of a PNG, at 8 KB each those of 80 MB, and segments of a JPEG.
_MAX_SEGMENTS = 10_000
# Markers of a JPEG that have a segment behind them; of them, those that begin a frame and tell its size, or a scan.
_MARKER = re.compile(rb"\xff[\x02-\xcf\xda-\xfe]")
_FRAME_MARKERS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BASELINE_MARKERS, _SCAN_MARKER = {0xC0, 0xC1}, 0xDA
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT = 256, 257, 322, 323
_TIFF_NUMBERS = {3: "H", 4: "I", 16: "Q"}
# A PNG ends with its IEND chunk and a JPEG with the marker FF D9; some writers add a few bytes of padding.
_END_MARKS = {_PNG: b"IEND", _JPEG: b"\xff\xd9"}
_TAIL_BYTES = 1024
# Each scan of a progressive JPEG goes over the whole image, and takes a dozen bytes; writers make about ten.
_MAX_SCANS = 256


def image_size(content: bytes) -> tuple[int, int]:
    """Size in pixels as an image file's header tells it, for PNG, JPEG and TIFF (BigTIFF too).

    Args:
        content: the whole file.

    Returns:
        (width, height). For a TIFF in tiles, the size of a tile where that is larger.

    Raises:
        ValueError: not such an image, or a damaged header.
    """
    try:
        if content.startswith(_PNG):
            return _png_size(content)
        if content.startswith(_JPEG):
            return _jpeg_size(content)
        if content[:4] in _TIFF:
            return _tiff_size(content)
    except (struct.error, IndexError, KeyError, OverflowError) as error:
        raise ValueError("damaged header") from error
    raise ValueError("neither PNG, JPEG nor TIFF")


def is_truncated(content: bytes) -> bool:
    """Whether a file is empty, or a PNG or JPEG that lacks its end; other formats have no end mark."""
    mark = next((mark for start, mark in _END_MARKS.items() if content.startswith(start)), b"")
    return not content or mark not in content[-_TAIL_BYTES:] and mark not in content[len(content) // 2 :]


def _png_size(content: bytes) -> tuple[int, int]:
    _, _, name, width, height = _PNG_HEAD.unpack_from(content)
    if name != b"IHDR":
        raise ValueError("damaged header")
    if not _has_whole_chunks(content):
        raise ValueError("damaged chunks")
    return width, height


def _has_whole_chunks(content: bytes) -> bool:
    """Whether all chunks of a PNG up to its last lie in the file: OpenCV allocates their lengths before it reads."""
    place = 8
    for _ in range(_MAX_SEGMENTS):
        if place + _PNG_CHUNK.size > len(content):
            return False
        length, name = _PNG_CHUNK.unpack_from(content, place)
        place += _PNG_CHUNK.size + length + 4  # and a checksum
        if place > len(content):
            return False
        if name == b"IEND":
            return True
    return False


def _jpeg_size(content: bytes) -> tuple[int, int]:
    size, components, one_scan = None, 0, False
    for marker, place in _jpeg_segments(content):
        if marker in _FRAME_MARKERS and size is None:
            height, width, components = struct.unpack_from(">HHB", content, place + 3)
            size, one_scan = (width, height), marker in _BASELINE_MARKERS
        if marker == _SCAN_MARKER:
            one_scan &= content[place + 2] == components
            break
    if size is None:
        raise ValueError("damaged header")
    if not one_scan and content.count(b"\xff\xda") > _MAX_SCANS:
        raise ValueError(f"a JPEG of more than {_MAX_SCANS} scans")
    return size


def _jpeg_segments(content: bytes) -> Iterator[tuple[int, int]]:
    """Markers with a segment behind them, and where the two bytes of its length are."""
    place = 2
    for _ in range(_MAX_SEGMENTS):
        found = _MARKER.search(content, place)
        if found is None:
            break
        place = found.end()
        yield content[place - 1], place
        (length,) = struct.unpack_from(">H", content, place)
        place += length


def _tiff_size(content: bytes) -> tuple[int, int]:
    order, is_big = _TIFF[content[:4]], b"+" in content[:4]
    # Where the directory is, how many entries it has, and an entry: tag, type, count, value.
    (directory,) = struct.unpack_from(f"{order}Q" if is_big else f"{order}I", content, 8 if is_big else 4)
    counter = struct.Struct(f"{order}Q" if is_big else f"{order}H")
    entry = struct.Struct(f"{order}HHQ8s" if is_big else f"{order}HHI4s")
    (count,) = counter.unpack_from(content, directory)
    found = {}
    for i in range(min(count, len(content) // entry.size)):
        tag, kind, _, value = entry.unpack_from(content, directory + counter.size + i * entry.size)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT):
            (found[tag],) = struct.unpack_from(order + _TIFF_NUMBERS[kind], value)
    return (
        max(found[_TIFF_WIDTH], found.get(_TIFF_TILE_WIDTH, 0)),
        max(found[_TIFF_HEIGHT], found.get(_TIFF_TILE_HEIGHT, 0)),
    )
