"""What a frame writes to tables, gathered: one launch for all of it."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from spslam import ops


class RowCopies:
    """Rows of tables that are to be overwritten; nothing is copied before `make`."""

    def __init__(self) -> None:
        self._tables: list[torch.Tensor] = []
        self._rows: list[int] = []
        self._values: list[torch.Tensor] = []

    def add(self, tables: Sequence[torch.Tensor], rows: Sequence[int], values: Sequence[torch.Tensor]) -> None:
        """`tables[i][rows[i]] = values[i]`, of one device, dtype and shape each."""
        self._tables += tables
        self._rows += rows
        self._values += values

    def make(self) -> None:
        """Makes all copies, asynchronously; there must be one."""
        ops.trusted.copy_rows_(self._tables, self._rows, self._values)


def write_rows(
    copies: RowCopies | None, tables: Sequence[torch.Tensor], rows: Sequence[int], values: Sequence[torch.Tensor]
) -> None:
    """Adds rows to copies that are made later; None makes them now."""
    if copies is None:
        ops.trusted.copy_rows_(tables, rows, values)
    else:
        copies.add(tables, rows, values)
