"""Rows of several tables overwritten in one call. Not differentiable."""

from collections.abc import Sequence

import torch

from spslam.ops import _library, trusted  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import changed_in_place, public_op


@public_op()
def copy_rows_(tables: Sequence[torch.Tensor], rows: Sequence[int], values: Sequence[torch.Tensor]) -> None:
    """Writes a value to one row of each of several tables, `tables[i][rows[i]] = values[i]`, one after the other.

    One call takes less time than an assignment each, which is a few operations of torch: a frame that is stored is
    half a dozen small copies. On CUDA nothing waits for the device.

    Args:
        tables: T tensors [R, ...] of any dtype, all on one device, contiguous; changed in place. One table may be there
            several times.
        rows: T row numbers in [0, R).
        values: T tensors [...] of the shape and dtype of their table's rows, on the same device. T = 0 copies nothing.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> poses, flags = torch.zeros(3, 2), torch.zeros(2, dtype=torch.int32)
        >>> copy_rows_([poses, flags], [2, 0], [torch.ones(2), torch.tensor(7, dtype=torch.int32)])
        >>> poses[:, 0], flags
        (tensor([0., 0., 1.]), tensor([7, 0], dtype=torch.int32))
    """
    name = "copy_rows_"
    check(len(rows) == len(tables), name, "rows", f"be {len(tables)}, one for each table", len(rows))
    check(len(values) == len(tables), name, "values", f"be {len(tables)}, one for each table", len(values))
    for table, row, value in zip(tables, rows, values, strict=True):
        check_tensor(name, "tables", table, None, getattr(table, "dtype", torch.float32), like=tables[0])
        check(table.dim() > 0, name, "tables", "have rows", "a scalar")
        check(table.is_contiguous(), name, "tables", "be contiguous", f"strides {table.stride()}")
        check(0 <= row < table.shape[0], name, "rows", f"be in [0, {table.shape[0]})", row)
        check_tensor(name, "values", value, table.shape[1:], table.dtype, like=table)
    if tables:  # without a tensor nothing says which device's kernel is meant
        trusted.copy_rows_(tables, rows, values)
        changed_in_place(*tables)


@torch.library.register_fake("spslam::copy_rows_")
def _(tables, rows, values):
    return None
