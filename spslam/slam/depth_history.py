"""Coarse depth of the last two seconds' frames, by which what moves is found."""

from __future__ import annotations

from collections.abc import Callable

import torch

from spslam.camera import Camera
from spslam.slam.depth_keyframes import depth_image_shape
from spslam.slam.row_copies import RowCopies, write_rows

WATCHED_S = 2.0  # what was seen longer ago says nothing
# By how much a camera may be off its prediction, m and radians: where nothing is known, and at most; and the share of
# it that is left a frame later.
UNPREDICTED, MOST_OFF, FADES = (0.02, 0.02), (0.1, 0.1), 0.7
COLUMNS = 80  # of cells, at most
SLOTS = 10  # frames
INTERVAL_S = 1 / 6  # between two of them
MOST_BETWEEN = 15  # frames between two of them, where stamps say less


class DepthHistory:
    """Depth images of some of the last frames, every `step`-th pixel, rectified, whatever moves in them included.

    Attributes:
        step: px of the depth image.
        cells: uint16 [S, h, w] in the unit of depth images, 0 where unknown, on the device.
        frames: number of the frame in each slot, -1 for none.
        moving: number of the last frame in which something was seen to move, -1 for none.
        looked: number of the frame in which it was looked for last and nobody has read yet what was found, -1 for none.
        off: by how much the camera was predicted otherwise than it moved of late, m and radians.
        found: int32 [2] what was found there, counts of `ops.comparison.find_moving_cells`, on the device.
    """

    def __init__(self, camera: Camera, device: torch.device | str = "cpu"):
        """Without frames.

        Args:
            camera: of all frames.
            device: where the cells are.
        """
        rows, columns = depth_image_shape(camera)
        self.step = -(-columns // COLUMNS)
        shape = cell_shape(camera)
        self.cells = torch.zeros(SLOTS, *shape, dtype=torch.uint16, device=device)
        self.frames = [-1] * SLOTS
        self.moving = self.looked = -1
        self.off: tuple[float, ...] = UNPREDICTED
        self.found = torch.zeros(2, dtype=torch.int32, device=device)

    def takes(self, frame: int, seconds: float) -> bool:
        """Whether frame number `frame` is to be kept; not if another one was just before.

        Args:
            frame: its number.
            seconds: since the last one that was kept; 0 where there is none, or no time has passed.
        """
        return not 0 < seconds < INTERVAL_S or frame - max(self.frames) >= MOST_BETWEEN

    def keep(self, frame: int, cells: torch.Tensor, copies: RowCopies | None = None) -> None:
        """Takes frame number `frame` in, asynchronously, in the place of the oldest.

        Args:
            frame: its number.
            cells: uint16 [h, w] of its depth image.
            copies: they are written when these are made; None writes them now.
        """
        slot = self.frames.index(min(self.frames))
        write_rows(copies, [self.cells], [slot], [cells])
        self.frames[slot] = frame

    def predicted(self, off_m: float, off_rad: float) -> None:
        """Takes account of by how much a frame's predicted pose was off; a jump says no more than `MOST_OFF`."""
        before = (FADES * each for each in self.off)
        off = (min(pair) for pair in zip((off_m, off_rad), MOST_OFF, strict=True))
        self.off = tuple(max(pair) for pair in zip(off, before, strict=True))

    def known(self, is_lost: Callable[[int], bool], seconds_since: Callable[[int], float]) -> list[tuple[int, int]]:
        """Slot and number of each frame with a trusted pose that is at most `WATCHED_S` old."""
        kept = [(slot, frame) for slot, frame in enumerate(self.frames) if frame >= 0 and not is_lost(frame)]
        return [(slot, frame) for slot, frame in kept if seconds_since(frame) <= WATCHED_S]

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that a checkpoint needs."""
        numbers = {name: torch.tensor(getattr(self, name)) for name in ("frames", "moving", "looked")}
        off = torch.tensor(self.off, dtype=torch.float64)
        return {"cells": self.cells, "found": self.found, "off": off, **numbers}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by a copy of what `tensors()` returned."""
        self.cells.copy_(state["cells"])
        self.frames = state["frames"].tolist()
        self.moving, self.looked = int(state["moving"]), int(state["looked"])
        self.off = tuple(state["off"].tolist())
        self.found = state["found"].to(self.cells.device, copy=True)


def cell_shape(camera: Camera) -> tuple[int, int]:
    """Rows and columns of the cells."""
    rows, columns = depth_image_shape(camera)
    step = -(-columns // COLUMNS)
    return -(-rows // step), -(-columns // step)
