"""PNG files decoded by ISA-L and compiled filters, against OpenCV and the pixels they were written of."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spslam.datasets import images
from spslam.datasets.image_kernels import unfilter_png
from spslam.datasets.png import decode_png
from spslam.errors import DatasetError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
GRAY, RGB, PALETTE, RGBA = 0, 2, 3, 6


def chunk(name, content):
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def filtered(rows, pixel_bytes, filters):
    """The bytes [H, W] of an image's rows behind their filters' numbers, by the specification's formulas."""
    above, out = np.zeros(rows.shape[1], np.int64), []
    for row, kind in zip(rows.astype(np.int64), filters, strict=True):
        left, corner = np.zeros_like(row), np.zeros_like(row)
        left[pixel_bytes:], corner[pixel_bytes:] = row[:-pixel_bytes], above[:-pixel_bytes]
        near = np.stack([left, above, corner])
        paeth = near[np.abs(near - (left + above - corner)).argmin(0), np.arange(len(row))]
        predicted = (np.zeros_like(row), left, above, (left + above) // 2, paeth)[kind % 5]
        out.append(bytes([kind]) + ((row - predicted) % 256).astype(np.uint8).tobytes())
        above = row
    return b"".join(out)


def png(image, filters, data_bytes=1 << 20, extra=b"", kind=None, interlaced=0, data=None):
    """A PNG of gray or RGB numbers, its data in chunks of so many bytes."""
    channels = 1 if image.ndim == 2 else image.shape[2]
    bits, kind = 8 * image.itemsize, {1: GRAY, 3: RGB, 4: RGBA}[channels] if kind is None else kind
    rows = image.astype(image.dtype.newbyteorder(">")).reshape(len(image), -1).view(np.uint8)
    if data is None:
        data = zlib.compress(filtered(rows, channels * image.itemsize, filters))
    header = struct.pack(">IIBBBBB", image.shape[1], image.shape[0], bits, kind, 0, 0, interlaced)
    parts = [chunk(b"IDAT", data[i : i + data_bytes]) for i in range(0, len(data), data_bytes)]
    return SIGNATURE + chunk(b"IHDR", header) + extra + b"".join(parts) + chunk(b"IEND", b"")


def some_image(shape, dtype, seed, smooth):
    random = np.random.default_rng(seed)
    if smooth:
        rows, columns = np.indices(shape[:2])
        values = 3 * rows + 2 * columns + random.integers(0, 3, shape[:2])
        values = values if len(shape) == 2 else values[..., None] + np.arange(shape[2])
        return values.astype(dtype)
    return random.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_pixels_are_those_written_and_opencvs(data):
    channels, dtype = data.draw(st.sampled_from([(1, np.uint8), (1, np.uint16), (3, np.uint8)]))
    height, width = data.draw(st.integers(1, 14)), data.draw(st.integers(1, 20))
    shape = (height, width) if channels == 1 else (height, width, channels)
    image = some_image(shape, dtype, data.draw(st.integers(0, 99)), data.draw(st.booleans()))
    filters = data.draw(st.lists(st.sampled_from([0, 1, 2, 3, 4, 4, 4, 4]), min_size=height, max_size=height))
    content = png(image, filters, data.draw(st.sampled_from([7, 1 << 20])))
    found = decode_png(content, channels)
    assert found.dtype == image.dtype and np.array_equal(found, image)
    by_opencv = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(found, by_opencv if channels == 1 else by_opencv[..., ::-1])


def test_runs_of_paeth_of_every_length():
    image = some_image((60, 33), np.uint16, 0, smooth=True)
    filters, length = [], 1
    while len(filters) < 60:
        filters += [4] * length + [length % 4]
        length += 1
    assert np.array_equal(decode_png(png(image, filters[:60]), 1), image)


def test_what_opencv_writes():
    depth, color = some_image((48, 65), np.uint16, 1, True), some_image((48, 65, 3), np.uint8, 2, False)
    for image, channels in ((depth, 1), (color, 3)):
        content = cv2.imencode(".png", image)[1].tobytes()
        expected = image if channels == 1 else image[..., ::-1]
        assert np.array_equal(decode_png(content, channels), expected)


IMAGE = some_image((6, 9), np.uint16, 3, smooth=True)
GOOD = png(IMAGE, [4] * 6)
RAW = filtered(IMAGE.astype(">u2").view(np.uint8), 2, [1] * 6)
PALETTED = png(some_image((4, 4), np.uint8, 0, True) % 4, [0] * 4, extra=chunk(b"PLTE", bytes(12)), kind=PALETTE)
LEFT_TO_OPENCV = {
    "no PNG": b"\xff\xd8\xff\xe0" + bytes(40),
    "empty": b"",
    "signature alone": SIGNATURE,
    "no header": SIGNATURE + chunk(b"IEND", b""),
    "short header": SIGNATURE + chunk(b"IHDR", bytes(5)) + chunk(b"IEND", b""),
    "two headers": GOOD[:33] + GOOD[8:],
    "palette": PALETTED,
    "transparency": png(IMAGE, [4] * 6, extra=chunk(b"tRNS", b"\0\1")),
    "several images": png(IMAGE, [4] * 6, extra=chunk(b"acTL", bytes(8))),
    "interlaced": png(IMAGE, [4] * 6, interlaced=1),
    "alpha": png(some_image((4, 4, 4), np.uint8, 0, True), [0] * 4),
    "three channels": png(some_image((4, 4, 3), np.uint8, 0, True), [0] * 4),
    "three channels of 16 bits": png(some_image((4, 4, 3), np.uint16, 0, True), [0] * 4),
    "checksum": GOOD[:50] + bytes([GOOD[50] ^ 1]) + GOOD[51:],
    "cut": GOOD[:-20],
    "too few data": png(IMAGE, [], data=zlib.compress(RAW[:-3])),
    "too many data": png(IMAGE, [], data=zlib.compress(RAW + b"\0")),
    "data without end": png(IMAGE, [], data=zlib.compress(RAW)[:-6]),
    "checksum of the data": png(IMAGE, [], data=zlib.compress(RAW)[:-1] + b"\x55"),
    "no data": png(IMAGE, [], data=b""),
    "no deflated data": png(IMAGE, [], data=b"nothing"),
    "no such filter": png(IMAGE, [], data=zlib.compress(b"\x05" + RAW[1:])),
}


@pytest.mark.parametrize("content", LEFT_TO_OPENCV.values(), ids=LEFT_TO_OPENCV.keys())
def test_everything_else_is_left_to_opencv(content):
    assert decode_png(content, 1) is None


IGNORED = {
    b"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000),
    b"gAMA": struct.pack(">I", 45455),
    b"sRGB": b"\0",
    b"pHYs": struct.pack(">IIB", 2835, 2835, 1),
    b"tEXt": b"Software\0a camera",
    b"tIME": struct.pack(">HBBBBB", 2026, 11, 25, 12, 0, 0),
    b"bKGD": struct.pack(">H", 7),
    b"eXIf": b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0",  # to be turned by 90 degrees
}


@pytest.mark.parametrize("name", IGNORED)
def test_chunks_that_opencv_ignores_too(name):
    content = png(IMAGE, [4] * 6, extra=chunk(name, IGNORED[name]))
    assert np.array_equal(decode_png(content, 1), IMAGE)
    assert np.array_equal(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED), IMAGE)


def outcome(read, content):
    try:
        return read(content).tobytes()
    except DatasetError as error:
        return str(error)


@pytest.mark.parametrize("channels", [1, 3])
def test_damaged_files_read_as_by_opencv_alone(channels, monkeypatch):
    random = np.random.default_rng(channels)
    shape, dtype = ((24, 31), np.uint16) if channels == 1 else ((24, 31, 3), np.uint8)
    good = png(some_image(shape, dtype, 5, True), random.integers(0, 5, 24).tolist(), 100)
    read = {1: lambda c: images.decode_depth(c, "image", 1000), 3: lambda c: images.decode_color(c, "image")}[channels]
    contents = [good]
    for _ in range(150):
        damaged = bytearray(good)
        for place in random.integers(0, len(good), random.integers(1, 4)):
            damaged[place] = random.integers(0, 256)
        contents.append(bytes(damaged[: random.integers(1, 3 * len(good))]))
    found = [outcome(read, content) for content in contents]
    monkeypatch.setattr(images, "decode_png", lambda content, channels: None)
    assert found == [outcome(read, content) for content in contents]


def test_an_image_of_another_size_than_its_bytes():
    for args in [((2, 2), 1, 8), ((2, 1), 2, 16), ((2, 1), 0, 8)]:
        with pytest.raises(ValueError, match="unfilter_png: not an image"):
            unfilter_png(bytes(7), *args)
    assert unfilter_png(b"", (0, 3), 1, 8).shape == (0, 3)
