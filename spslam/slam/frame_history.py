"""Read access to earlier frames, for tracking and recovery."""

from dataclasses import dataclass

import torch

from spslam import ops
from spslam.slam.state import SlamState

MAX_COMPARED = 128  # frames that a pose is verified against: the most recent and an even sample of the others
RECENT_COMPARED = 16


@dataclass(frozen=True)
class EarlierFrame:
    """An earlier frame with a trusted pose.

    Attributes:
        records: int32 [P, 3] its packed pixels in random order.
        pose: float32 [7] T_world_camera.
    """

    records: torch.Tensor
    pose: torch.Tensor


class FrameHistory:
    """Read access to the frames of a state, always in their current version.

    Args:
        state: of the system; not changed.
    """

    def __init__(self, state: SlamState):
        self._state = state

    @property
    def is_lost(self) -> bool:
        """Whether the last frame is lost."""
        return bool(self._state.frames.lost[-1])

    @property
    def consistent_frames(self) -> int:
        """How many of the last frames are lost, but have likely poses that are consistent with one another."""
        return int(self._state.frames.consistent_frames[-1])

    @property
    def consecutive_lost_frames(self) -> int:
        """How many frames at the end are lost."""
        known = (~self._state.frames.lost).nonzero()
        return len(self._state.frames) - (int(known[-1]) + 1 if len(known) else 0)

    @property
    def poses(self) -> torch.Tensor:
        """float32 [F, 7] of all frames, on the device."""
        return self._state.frames.poses

    @property
    def depth_thumbnails(self) -> torch.Tensor:
        """float16 [F, h, w] depth thumbnails (m) of all frames, 0 where unknown, on the device."""
        return self._state.frames.depth_thumbnails

    def frame(self, row: int) -> EarlierFrame:
        """The frame in a row of the frame table."""
        return EarlierFrame(self._state.pixels.records[row], self._state.frames.poses[row])

    def last(self) -> EarlierFrame | None:
        """The last frame with pixels and a trusted pose; None where there is none."""
        rows = self.usable_rows()
        return self.frame(int(rows[-1])) if len(rows) else None

    def last_mapped(self, every: int) -> tuple[int, EarlierFrame] | None:
        """The newest frame with a trusted pose that mapping took, given that it takes every n-th, and its number."""
        has_pixels, lost = self._state.pixels.has_pixels, self._state.frames.lost
        for row in range((len(lost) - 1) // every * every, -1, -every):
            if has_pixels[row] and not lost[row]:
                return row, self.frame(row)
        return None

    @property
    def noise(self) -> torch.Tensor:
        """float32 [4] what was measured of the sensor's noise, on the device; see `ops.SensorNoise`."""
        return self._state.noise.model

    def depth_keyframes(self) -> ops.DepthKeyframes | None:
        """Earlier images to align the next frame with; None if there is none with a trusted pose."""
        return self.depth_keyframes_before(len(self._state.frames))

    def depth_keyframes_before(self, number: int) -> ops.DepthKeyframes | None:
        """The same of frame `number`, the next one or the last."""
        state = self._state
        if state.depth_keyframes is None:
            return None
        return state.depth_keyframes.select(number, state.frames.lost, state.frames.poses)

    def usable_rows(self) -> torch.Tensor:
        """int64 on the CPU, ascending: frames that have pixels and a trusted pose."""
        return self._state.usable.nonzero()[:, 0]

    def compared_rows(self) -> torch.Tensor:
        """int64 on the device: the usable frames that a pose is verified against, at most `MAX_COMPARED`."""
        rows = self.usable_rows()
        if len(rows) > MAX_COMPARED:
            older = torch.linspace(0, len(rows) - RECENT_COMPARED - 1, MAX_COMPARED - RECENT_COMPARED).long()
            rows = torch.cat([rows[older], rows[-RECENT_COMPARED:]])
        device = self._state.frames.poses.device
        return rows if device.type == "cpu" else rows.pin_memory().to(device, non_blocking=True)
