"""When images were taken, by their time stamps: a camera takes them evenly, its stamps often are not.

Stamps that are given on arrival, as a Kinect's, are late by what the transport took: by up to 5 ms in TUM's recordings,
where images of every third frame seem to be 28 and 40 ms apart and are 33 (docs/experiments/2026-11-color-stamps.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WINDOW = 31  # stamps that an image's time is taken from, itself in the middle where there are as many on both sides
LEAST_STAMPS = 8  # with fewer there is no telling how even they are
# Of the period, by which a stamp of an even clock is off at most: beyond that images are taken as they come.
MOST_OFF = 0.3
# By so much the moments of a frame's depth and color may differ, or those of an image's rows: as in recordings whose
# images are paired by time, and with a rolling shutter.
LATE_S = 0.02
# s, between two frames: nearer stamps are of one moment (ops count in whole nanoseconds), and over a longer time the
# camera hardly moves evenly.
LEAST_MOTION_S, MAX_MOTION_S = 1e-9, 0.12
_MOST_AT_ONCE = 1 << 15  # windows in memory


@dataclass(frozen=True)
class CaptureOffsets:
    """When a frame's images were taken.

    Attributes:
        depth: from the frame's time stamp to its depth image, s.
        color: from the depth image to the color image, s.
    """

    depth: float = 0.0
    color: float = 0.0


AT_ONCE = CaptureOffsets()


def capture_times(stamps: np.ndarray) -> np.ndarray:
    """When a stream's images were taken.

    Where all stamps around one lie within 0.3 of a period of even steps, of which some may be missing, the line through
    them says when; elsewhere the stamp itself does. Delays that all of them have remain.

    Args:
        stamps: float64 [N] of all images of the stream, s, ascending.

    Returns:
        float64 [N], s.
    """
    stamps = np.asarray(stamps, np.float64)
    count = len(stamps)
    if count < LEAST_STAMPS:
        return stamps.copy()
    period = float(np.median(np.diff(stamps)))
    if not period > 0:
        return stamps.copy()
    window = min(WINDOW, count)
    starts = np.clip(np.arange(count) - window // 2, 0, count - window)
    # Numbers in steps from the first image on; a gap in the stamps is as many steps as fit best.
    numbers = np.concatenate([[0.0], np.cumsum(np.maximum(np.round(np.diff(stamps) / period), 1))])
    times = np.empty(count)
    for first in range(0, count, _MOST_AT_ONCE):
        part = slice(first, min(first + _MOST_AT_ONCE, count))
        rows = starts[part, None] + np.arange(window)
        # Of the image itself: differences stay exact where stamps are seconds since 1970.
        steps, seconds = numbers[rows] - numbers[part, None], stamps[rows] - stamps[part, None]
        mean, mean_s = steps.mean(1, keepdims=True), seconds.mean(1, keepdims=True)
        centered = steps - mean
        slope = (centered * (seconds - mean_s)).sum(1, keepdims=True) / (centered**2).sum(1, keepdims=True)
        off = np.abs(seconds - mean_s - slope * centered).max(1)
        is_even = off < MOST_OFF * period
        times[part] = stamps[part] + np.where(is_even, (mean_s - slope * mean)[:, 0], 0.0)
    return times


def capture_offsets(stamps: np.ndarray, color: np.ndarray, depth: np.ndarray) -> list[CaptureOffsets]:
    """Of frames with time stamps and the times of their images, each float64 [F], s."""
    pairs = zip((depth - stamps).tolist(), (color - depth).tolist(), strict=True)
    return [CaptureOffsets(*pair) for pair in pairs]
