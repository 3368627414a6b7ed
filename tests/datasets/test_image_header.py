"""Sizes from the headers of images: the same as OpenCV's, and none where a header can't be trusted."""

import struct

import cv2
import numpy as np
import pytest

from spslam.datasets.image_header import image_size, is_truncated


def encoded(suffix, image, *flags):
    done, content = cv2.imencode(suffix, image, list(flags))
    assert done
    return content.tobytes()


GRAY16, COLOR = np.arange(24 * 37, dtype=np.uint16).reshape(24, 37), np.zeros((24, 37, 3), np.uint8)
PNG, JPEG = encoded(".png", COLOR), encoded(".jpg", COLOR)


def tiff(order, is_big, tags):
    """A TIFF of only a directory with 32-bit numbers."""
    sign = (b"II" if order == "<" else b"MM") + struct.pack(order + "H", 43 if is_big else 42)
    head = struct.pack(order + "HHQ", 8, 0, 16) if is_big else struct.pack(order + "I", 8)
    entry = order + ("HHQI4x" if is_big else "HHII")
    entries = b"".join(struct.pack(entry, tag, 4, 1, value) for tag, value in tags.items())
    return sign + head + struct.pack(order + ("Q" if is_big else "H"), len(tags)) + entries


@pytest.mark.parametrize(
    "content",
    [
        encoded(".png", GRAY16),
        encoded(".png", COLOR),
        JPEG,
        encoded(".jpg", COLOR, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        encoded(".jpg", COLOR, cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
        JPEG[:2] + b"\xff\xe1" + struct.pack(">H", 9) + b"\xff\xc0note" + b"\xff\xff" + JPEG[3:],
        encoded(".tiff", GRAY16),
        encoded(".tiff", GRAY16.astype(np.float32)),
        *(tiff(order, is_big, {256: 37, 257: 24, 262: 1}) for order in "<>" for is_big in (False, True)),
    ],
)
def test_the_size_of_an_image(content):
    assert image_size(content) == (37, 24)


def test_a_tile_may_be_larger_than_the_image():
    assert image_size(tiff("<", False, {256: 37, 257: 24, 322: 2**30, 323: 16})) == (2**30, 24)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "neither PNG, JPEG nor TIFF"),
        (b"GIF89a" + bytes(100), "neither PNG, JPEG nor TIFF"),
        (encoded(".bmp", COLOR), "neither PNG, JPEG nor TIFF"),
        (encoded(".png", COLOR)[:20], "damaged header"),
        (encoded(".png", COLOR).replace(b"IHDR", b"IDAT"), "damaged header"),
        (PNG[:33] + struct.pack(">I", 2**30) + PNG[37:], "damaged chunks"),
        (PNG[:-12] + PNG[:8] + PNG[-12:], "damaged chunks"),
        (JPEG[:100], "damaged header"),
        (b"\xff\xd8\xff" + b"\0\xff" * 10**6, "damaged header"),
        (tiff("<", False, {256: 37}), "damaged header"),
        (b"II*\0" + struct.pack("<I", 2**31), "damaged header"),
        (b"II+\0" + struct.pack("<HHQ", 8, 0, 2**64 - 1), "damaged header"),
    ],
)
def test_damaged_headers(content, message):
    with pytest.raises(ValueError, match=message):
        image_size(content)


def test_a_png_may_have_padding_behind_its_end():
    assert image_size(PNG + bytes(500)) == (37, 24)


def test_a_jpeg_of_many_scans_is_refused():
    """Each takes a dozen bytes and goes over the whole image."""
    progressive = encoded(".jpg", COLOR, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    scan = progressive[progressive.index(b"\xff\xda") : -2]
    with pytest.raises(ValueError, match="a JPEG of more than 256 scans"):
        image_size(progressive[:-2] + 256 * scan + progressive[-2:])


def test_ends():
    assert [is_truncated(content) for content in (JPEG, JPEG[:-2], b"", b"II*\0")] == [False, True, True, False]
    assert not is_truncated(JPEG + bytes(500))
