"""Frames from arrays: what is converted, and the line that each usual mistake ends in."""

import numpy as np
import pytest

from spslam import RgbdFrame

COLOR = np.zeros((48, 64, 3), dtype=np.uint8)
METERS = np.full((48, 64), 1.5, dtype=np.float32)


def test_millimeters_and_what_was_not_measured():
    stored = np.full((48, 64), 1500, dtype=np.uint16)
    stored[:24] = 0
    frame = RgbdFrame.from_arrays(COLOR, stored, 0.5, depth_scale=1000)
    assert frame.depth.dtype == np.float32
    assert (frame.depth[24:] == np.float32(1.5)).all()
    assert (frame.depth[:24] == 0).all()
    assert repr(frame) == "RgbdFrame(64x48, t=0.500 s, depth in 50 % of the pixels, median 1.50 m)"


def test_unknown_depth_of_floats_is_zero():
    meters = METERS.astype(np.float64)
    meters[0, :3] = np.nan, -1, np.inf
    frame = RgbdFrame.from_arrays(COLOR, meters, 0.0)
    assert frame.depth[0, :3].tolist() == [0, 0, 0]
    assert np.isnan(meters[0, 0])  # the array given is left alone
    assert "no depth" in repr(RgbdFrame.from_arrays(COLOR, 0 * METERS, 0))


def test_a_view_of_another_order_is_taken():
    bgr = np.zeros((48, 64, 3), dtype=np.uint8)
    assert RgbdFrame.from_arrays(bgr[..., ::-1], METERS, 0).color.flags.c_contiguous


@pytest.mark.parametrize(
    ("color", "depth", "options", "error", "message"),
    [
        (COLOR, (1000 * METERS).astype("u2"), {}, ValueError, "depth of uint16 needs depth_scale, its units per meter"),
        (
            COLOR,
            1000 * METERS,
            {},
            ValueError,
            "got float32 with a median of 1500 m at depth_scale=1; depth_scale=1000",
        ),
        (COLOR, METERS / 1000, {}, ValueError, "a median of 0.0015 m"),
        (COLOR, METERS, {"depth_scale": 1000}, ValueError, "a median of 0.0015 m at depth_scale=1000"),
        (COLOR, METERS, {"depth_scale": 0}, ValueError, "depth_scale must be a number above 0, got 0"),
        (COLOR, METERS.astype("u1"), {}, TypeError, "depth must be floating-point meters or whole numbers of 16 bits"),
        (
            COLOR,
            METERS[..., None],
            {},
            ValueError,
            r"depth must have shape \[H, W\], got \[48, 64, 1\]; depth\[..., 0\]",
        ),
        (COLOR / 255, METERS, {}, TypeError, "got float64 .*; multiply colors from 0 to 1 by 255 first"),
        (COLOR[..., 0], METERS, {}, ValueError, "repeat a gray image over three channels"),
        (np.zeros((48, 64, 4), "u1"), METERS, {}, ValueError, r"leave out the fourth channel, color\[..., :3\]"),
        (COLOR.transpose(2, 0, 1), METERS, {}, ValueError, "the channels come last"),
        (COLOR[:0], METERS[:0], {}, ValueError, r"color must have shape \[H, W, 3\], got \[0, 64, 3\]"),
        (COLOR, METERS[::2], {}, ValueError, r"depth must be as large as color, \[48, 64\], got \[24, 64\]"),
    ],
)
def test_mistakes_are_named(color, depth, options, error, message):
    with pytest.raises(error, match=f"^RgbdFrame.from_arrays: .*{message}"):
        RgbdFrame.from_arrays(color, depth, 0.0, **options)


@pytest.mark.parametrize("timestamp", [1.7e18, 1.7e12, np.nan, "now", None])
def test_times_are_in_seconds(timestamp):
    with pytest.raises(ValueError, match="timestamp must be in seconds, at most 1e"):
        RgbdFrame.from_arrays(COLOR, METERS, timestamp)
