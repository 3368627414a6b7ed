"""What is kept of every processed frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from spslam.camera import Camera
from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.geometry import pose7_to_matrix
from spslam.scene.sparse_volume import resize_rows
from spslam.slam.pixels import THUMBNAIL_STEP_PX
from spslam.slam.row_copies import RowCopies, write_rows

_FIRST_CAPACITY = 64
# A frame's log gain and the variance of its steps before any is known: exposure is taken to be even until it is seen to
# change.
_UNKNOWN_GAIN = (0.0, 1e-8)
_ON_HOST = ("timestamps", "depth_times", "color_offsets", "indices", "lost", "consistent_frames")


class FrameTable:
    """What is kept of every processed frame; rows are frames.

    The columns are views of buffers that double when they are full: to write to one changes the table, and a frame
    costs the same after ten thousand others as at first.

    Attributes:
        camera: of all frames.
        opened: how many rows at the begin came with an opened map: its keyframes.
    """

    def __init__(self, camera: Camera, device: torch.device | str = "cpu"):
        """A table without rows for images of that camera."""
        offset = THUMBNAIL_STEP_PX // 2
        rows = len(range(offset, camera.height, THUMBNAIL_STEP_PX))
        columns = len(range(offset, camera.width, THUMBNAIL_STEP_PX))
        self.camera = camera
        self.opened = 0
        self._count = 0
        self._unknown_gain = torch.tensor(_UNKNOWN_GAIN, device=device)
        self._set_columns(
            {
                "poses": torch.zeros(0, 7, device=device),
                "gains": torch.zeros(0, 2, device=device),
                "timestamps": torch.zeros(0, dtype=torch.float64),
                "depth_times": torch.zeros(0, dtype=torch.float64),
                "color_offsets": torch.zeros(0, dtype=torch.float64),
                "indices": torch.zeros(0, dtype=torch.int64),
                "lost": torch.zeros(0, dtype=torch.bool),
                "consistent_frames": torch.zeros(0, dtype=torch.int64),
                "depth_thumbnails": torch.zeros(0, rows, columns, dtype=torch.float16, device=device),
            }
        )

    def _set_columns(self, columns: dict[str, torch.Tensor]) -> None:
        self._columns = columns
        self._log_gain_rows = columns["gains"][:, :1]
        # Views of the columns on the CPU: a frame asks for tens of their elements, each of which would be a tensor.
        self._numbers = {name: columns[name].numpy() for name in _ON_HOST}

    @property
    def poses(self) -> torch.Tensor:
        """float32 [F, 7] T_world_camera as unit quaternion (w, x, y, z) and translation (m), on the device."""
        return self._columns["poses"][: self._count]

    @property
    def pose_rows(self) -> torch.Tensor:
        """float32 [F or more, 7] as `poses`, with the rows that are not in use yet: no view has to be made of them."""
        return self._columns["poses"]

    @property
    def gains(self) -> torch.Tensor:
        """float32 [F, 2] log gain of the frames' brightness and the variance of its steps, see `ops.Exposure`, on the
        device; a lost frame has those of the one before."""
        return self._columns["gains"][: self._count]

    @property
    def log_gain_rows(self) -> torch.Tensor:
        """float32 [F or more, 1], the first column of `gains`, with as many rows as `pose_rows`."""
        return self._log_gain_rows

    @property
    def timestamps(self) -> torch.Tensor:
        """float64 [F], s."""
        return self._columns["timestamps"][: self._count]

    @property
    def depth_times(self) -> torch.Tensor:
        """float64 [F] when the depth images were taken, s, as far as stamps tell."""
        return self._columns["depth_times"][: self._count]

    @property
    def color_offsets(self) -> torch.Tensor:
        """float64 [F] from the depth images to the color images, s, as far as stamps tell."""
        return self._columns["color_offsets"][: self._count]

    @property
    def indices(self) -> torch.Tensor:
        """int64 [F] index in the dataset."""
        return self._columns["indices"][: self._count]

    @property
    def lost(self) -> torch.Tensor:
        """bool [F] whether the pose is not to be trusted."""
        return self._columns["lost"][: self._count]

    @property
    def lost_flags(self) -> np.ndarray:
        """bool [F], `lost` for NumPy: the same memory."""
        return self._numbers["lost"][: self._count]

    @property
    def consistent_frames(self) -> torch.Tensor:
        """int64 [F] how many lost frames up to this one had a pose that is likely, and agree with one another."""
        return self._columns["consistent_frames"][: self._count]

    @property
    def depth_thumbnails(self) -> torch.Tensor:
        """float16 [F, h, w] depth thumbnails (m), on the device."""
        return self._columns["depth_thumbnails"][: self._count]

    @property
    def thumbnail_bytes(self) -> int:
        """Bytes of a frame's depth thumbnail."""
        one = self._columns["depth_thumbnails"]
        return one.element_size() * one.shape[1:].numel()

    @property
    def processed(self) -> int:
        """How many frames were processed: all rows but those that came with an opened map."""
        return self._count - self.opened

    @property
    def knows_speed(self) -> bool:
        """Whether the poses of the last two frames are trusted, so that the next one can be predicted from them."""
        return self.processed >= 2 and not self.any_lost(2)

    @property
    def is_anywhere(self) -> bool:
        """Whether a map was opened in which no frame was found yet."""
        return self.opened > 0 and bool(self.lost[self.opened :].all())

    def is_lost(self, row: int) -> bool:
        """Whether the pose of a row is not to be trusted; a negative row counts from the end."""
        return bool(self._numbers["lost"][row if row >= 0 else self._count + row])

    def any_lost(self, count: int) -> bool:
        """Whether any of the last `count` rows, or of all if they are fewer, is lost."""
        return True in self._numbers["lost"][max(self._count - count, 0) : self._count].tolist()

    def depth_time(self, row: int) -> float:
        """When the depth image of a row was taken, s, as far as stamps tell; the row counts from the first."""
        return float(self._numbers["depth_times"][row])

    def color_offset(self, row: int) -> float:
        """From the depth image of a row to its color image, s, as far as stamps tell; the row counts from the first."""
        return float(self._numbers["color_offsets"][row])

    def append(
        self,
        pose: torch.Tensor,
        timestamp: float,
        index: int,
        lost: bool,
        depth_thumbnail: torch.Tensor,
        consistent_frames: int = 0,
        offsets: CaptureOffsets = AT_ONCE,
        copies: RowCopies | None = None,
        gain: torch.Tensor | None = None,
    ) -> None:
        """Adds a row; with `copies`, what is on the device is written when these are made.

        `gain` float32 [2], as a row of `gains`; None takes that of the row before.
        """
        if self._count == self._columns["poses"].shape[0]:
            capacity = max(2 * self._count, _FIRST_CAPACITY)
            self._set_columns({name: _with_capacity(column, capacity) for name, column in self._columns.items()})
        tables = [self._columns["poses"], self._columns["depth_thumbnails"], self._columns["gains"]]
        if gain is None:
            gain = tables[2][self._count - 1] if self._count > 0 else self._unknown_gain
        values = [pose.to(tables[0]), depth_thumbnail.to(tables[1]), gain]
        write_rows(copies, tables, [self._count] * len(tables), values)
        numbers: dict[str, Any] = {
            "timestamps": timestamp,
            "depth_times": timestamp + offsets.depth,
            "color_offsets": offsets.color,
            "indices": index,
            "lost": lost,
            "consistent_frames": consistent_frames,
        }
        for name, number in numbers.items():
            self._numbers[name][self._count] = number
        self._count += 1

    def matrices(self, first: int = 0) -> np.ndarray:
        """float64 [F, 4, 4] T_world_camera of the rows from `first` on; negative ones count from the end."""
        return pose7_to_matrix(self.poses[first:].cpu().numpy().astype(np.float64))

    def tensors(self) -> dict[str, torch.Tensor]:
        """All columns, where they are; views, so clone what must stay as it is."""
        return {name: column[: self._count] for name, column in self._columns.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by copies of what `tensors()` returned."""
        self._count = len(state["poses"])
        self._set_columns({name: state[name].to(column.device, copy=True) for name, column in self._columns.items()})

    def __len__(self) -> int:
        return self._count


def _with_capacity(column: torch.Tensor, rows: int) -> torch.Tensor:
    """A column with room for so many rows, zero. On the CPU they take memory only once they are written."""
    if column.device.type != "cpu":
        return resize_rows(column, rows)
    grown = torch.from_numpy(np.zeros((rows, *column.shape[1:]), column.numpy().dtype))
    grown[: len(column)] = column
    return grown
