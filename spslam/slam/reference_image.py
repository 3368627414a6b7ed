"""Small grayscale image of the last mapped frame, to compare brightness with while tracking."""

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam.cell_grid import CellGrid
from spslam.slam.pixels import unpack_points

LUMA_OF_WHITE = 255 * sum(ops.LUMA_WEIGHTS)
DEPTH_STEP_M = 1e-4


def reference_cells(records: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Mean brightness and depth of a frame's pixel records in each cell of a coarse grid.

    Args:
        records: int32 [P, 3] packed pixels.
        camera: of the frame.

    Returns:
        float32 [h, w, 2] brightness in [0, 1] and depth (m, 0 for cells without a record), as `ops.ReferenceImage`
        takes them; sums of integers, so the same on every run.
    """
    grid = CellGrid.of(camera)
    values = torch.stack([torch.ones_like(records[:, 0]), luma(records), _depth_steps(records, camera)], 1)
    sums = records.new_zeros(grid.rows * grid.columns, 3, dtype=torch.int64)
    sums.index_add_(0, grid.cells(records), values.long())
    count, brightness, depth = sums.double().unbind(1)
    count = count.clamp(min=1)
    cells = torch.stack([brightness / (count * LUMA_OF_WHITE), depth * (DEPTH_STEP_M / count)], 1)
    return cells.float().view(grid.rows, grid.columns, 2)


def luma(records: torch.Tensor) -> torch.Tensor:
    """Luma int32 [P] of packed pixels int32 [P, 3], from 0 to `LUMA_OF_WHITE`."""
    channels = ((records[:, 2] >> shift) & 0xFF for shift in (0, 8, 16))
    red, green, blue = (weight * channel for weight, channel in zip(ops.LUMA_WEIGHTS, channels, strict=True))
    return red + green + blue


def _depth_steps(records: torch.Tensor, camera: Camera) -> torch.Tensor:
    return (unpack_points(records, camera)[:, 2] / DEPTH_STEP_M).round().int()


class ReferenceCache:
    """The reference of the last mapped frame, made when first needed.

    Args:
        camera: of all frames.
        weight_m: m that a brightness difference of 1 counts as.
        kernel: width of the robust kernel of brightness.
    """

    def __init__(self, camera: Camera, weight_m: float, kernel: float):
        self._camera, self._weight_m, self._kernel = camera, weight_m, kernel
        self._intrinsics = CellGrid.of(camera).intrinsics
        self._key: tuple[int, int] | None = None
        self._cells = torch.empty(0)

    def get(self, row: int, records: torch.Tensor, pose: torch.Tensor) -> ops.ReferenceImage:
        """The reference of frame `row`, with its pose as it is now.

        Args:
            row: number of the frame.
            records: int32 [P, 3] its packed pixels; made anew when their number changes.
            pose: float32 [7].
        """
        if self._key != (row, len(records)):
            self._key, self._cells = (row, len(records)), reference_cells(records, self._camera)
        return ops.ReferenceImage(self._cells, pose, self._intrinsics, self._weight_m, self._kernel)
