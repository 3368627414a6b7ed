"""Decoding PNG files of the kinds that cameras' images come as, twice as fast as OpenCV: the same pixels.

Depth is a gray image of 16 bits, color one of three times 8. ISA-L inflates them, in a third of zlib's time, and
`spslam.datasets.image_kernels` undoes the filters of the rows, several rows at a time. Everything else, damaged files
among it, is left to OpenCV.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from isal import isal_zlib

from spslam.datasets.image_kernels import unfilter_png

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHUNK, _CHECKSUM, _HEADER = struct.Struct(">I4s"), struct.Struct(">I"), struct.Struct(">IIBBBBB")
_CHANNELS = {0: 1, 2: 3}  # by color type: gray, RGB
_BITS = {0: (8, 16), 2: (8,)}
# Chunks without influence on the pixels, which a reader may ignore. Of others OpenCV has its own view: transparency,
# several images.
_IGNORED = {b"cHRM", b"gAMA", b"iCCP", b"sRGB", b"pHYs", b"tEXt", b"zTXt", b"iTXt", b"tIME", b"bKGD", b"eXIf"}
_MAX_CHUNKS = 10_000
_DAMAGED: type[Exception] = isal_zlib.IsalError  # type: ignore[assignment]  # its stub has an instance


def decode_png(content: bytes, channels: int) -> np.ndarray | None:
    """The pixels of a PNG, if it is one that this module decodes.

    Args:
        content: of the file; the size in its header is one that may be allocated.
        channels: that are wanted, 1 or 3.

    Returns:
        uint8 or uint16 [H, W], or uint8 [H, W, 3] RGB; None if OpenCV is to decode it: no PNG, another number of
        channels, interlaced, with a palette or transparency, or damaged.
    """
    found = _image_data(content)
    if found is None:
        return None
    (width, height, bits, kind, *methods), data = found
    if any(methods) or bits not in _BITS.get(kind, ()) or _CHANNELS[kind] != channels:
        return None
    size = height * (1 + width * channels * bits // 8)
    inflation = isal_zlib.decompressobj()
    try:
        filtered = inflation.decompress(b"".join(data), max_length=size + 1)
    except _DAMAGED:
        return None
    if len(filtered) != size or not inflation.eof:
        return None
    return unfilter_png(filtered, (height, width), channels, bits)


def _image_data(content: bytes) -> tuple[tuple[int, ...], list[memoryview]] | None:
    """The header's fields and the parts of the compressed pixels; None where a chunk is damaged or not of these."""
    if not content.startswith(_SIGNATURE):
        return None
    header, data, view, place = None, [], memoryview(content), len(_SIGNATURE)
    for _ in range(_MAX_CHUNKS):
        if place + _CHUNK.size > len(content):
            return None
        length, name = _CHUNK.unpack_from(content, place)
        end = place + _CHUNK.size + length
        if end + _CHECKSUM.size > len(content):
            return None
        if zlib.crc32(view[place + 4 : end]) != _CHECKSUM.unpack_from(content, end)[0]:
            return None
        chunk, place = view[place + _CHUNK.size : end], end + _CHECKSUM.size
        if (header is None) != (name == b"IHDR"):
            return None
        if name == b"IHDR":
            if length != _HEADER.size:
                return None
            header = _HEADER.unpack(chunk)
        elif name == b"IDAT":
            data.append(chunk)
        elif name == b"IEND":
            return None if header is None else (header, data)
        elif name not in _IGNORED:
            return None
    return None
