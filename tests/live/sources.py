"""Live cameras made by tests: frames of the generated room, with or without faults."""

from __future__ import annotations

import time

import numpy as np

from spslam.datasets.base import RgbdFrame
from spslam.live.source import LiveSource
from tests.system.sequences import Recorded


class RoomCamera(LiveSource):
    """The generated room's first frames one after the other; waits until `ready()` before each but the first.

    Args:
        count: frames.
        pause_s: between them.
        fault: raised after the last.
        change: may modify a frame, or replace it by what is to be yielded.
        has_poses: whether frames come with their true poses.
    """

    name = "test camera"

    def __init__(self, count=6, pause_s=0.0, fault=None, change=None, has_poses=False):
        self.recorded = Recorded(count)
        self.camera = self.recorded.camera
        self.count, self.pause_s, self.fault, self.change, self.closed = count, pause_s, fault, change, 0
        self.has_poses = has_poses

    def frames(self):
        for index in range(self.count):
            time.sleep(self.pause_s)
            frame = self.recorded[index]
            frame.pose = frame.pose if self.has_poses else None
            yield self.change(frame) if self.change else frame
        if self.fault is not None:
            raise self.fault

    def close(self):
        self.closed += 1


def plain_frame(number=0, width=160, height=120):
    """A frame whose depth and color tell its number."""
    color = np.full((height, width, 3), number % 200, dtype=np.uint8)
    return RgbdFrame(number, number / 30, color, np.full((height, width), 1 + number / 100, dtype=np.float32))
