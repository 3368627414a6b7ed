"""A coarse grid over the image, to make small images of a frame's pixel records."""

from dataclasses import dataclass

import torch

from spslam import ops
from spslam.camera import Camera

MAX_COLUMNS = 80  # about three pixel records per cell


@dataclass(frozen=True)
class CellGrid:
    """Square cells of `step` x `step` pixels that cover the image.

    Attributes:
        step: px.
        rows, columns: of cells.
        intrinsics: in cells.
    """

    step: int
    rows: int
    columns: int
    intrinsics: ops.Intrinsics

    @classmethod
    def of(cls, camera: Camera) -> "CellGrid":
        """The finest grid of at most `MAX_COLUMNS` columns."""
        step = -(-camera.width // MAX_COLUMNS)
        rows, columns = -(-camera.height // step), -(-camera.width // step)
        center = (camera.cx + 0.5) / step - 0.5, (camera.cy + 0.5) / step - 0.5
        return cls(step, rows, columns, ops.Intrinsics(camera.fx / step, camera.fy / step, *center))

    def cells(self, records: torch.Tensor) -> torch.Tensor:
        """Number row * columns + column of the cell of each packed pixel record: int64 [P] of int32 [P, 3]."""
        u, v = records[:, 0] & 0xFFFF, (records[:, 0] >> 16) & 0xFFFF
        return (v // self.step * self.columns + u // self.step).long()
