"""Rows of tables overwritten in one call: as single assignments do it; errors."""

import pytest
import torch

from spslam import ops
from tests.ops.arguments import opcheck


def make_copies(device):
    """Tables of several dtypes, one of them twice; values that are not finite, not contiguous or empty."""
    generator = torch.Generator().manual_seed(0)
    halves = torch.rand(4, 3, 5, generator=generator).half()
    numbers = torch.randint(0, 255, (6, 2), generator=generator, dtype=torch.int32)
    tables = [torch.rand(8, 7, generator=generator), halves, numbers, numbers.to(torch.uint16), torch.zeros(3, 0)]
    tables = [table.to(device) for table in tables]
    values = [
        torch.tensor([1.0, 2.0, float("nan"), float("inf"), -0.0, 3.0, 4.0]),
        torch.rand(5, 3, generator=generator).half().T,
    ]
    values += [torch.tensor([1, 2], dtype=torch.int32), torch.tensor([3, 4], dtype=torch.int32).to(torch.uint16)]
    values = [*(value.to(device) for value in values), torch.zeros(0, device=device)]
    return [*tables, tables[0]], [5, 0, 3, 1, 2, 7], [*values, values[0] + 1]


def test_as_single_assignments(device):
    tables, rows, values = make_copies(device)
    expected = [table.clone() for table in tables[:-1]]
    for table, row, value in zip([*expected, expected[0]], rows, values, strict=True):
        table[row] = value
    ops.copy_rows_(tables, rows, values)
    for table, wanted in zip(tables, expected, strict=False):
        assert torch.equal(table.view(torch.uint8), wanted.view(torch.uint8))
    ops.copy_rows_([], [], [])


@pytest.mark.parametrize("count", [9, 20])
def test_copies_that_need_earlier_ones_come_after_them(device, count):
    """A row that is written twice, one that is read after it was written, and one that is written after it was read."""
    generator = torch.Generator().manual_seed(count)
    table = torch.rand(count, 5, generator=generator).to(device)
    rows = torch.randint(count, (count,), generator=generator).tolist()
    expected = table.clone()
    for i, row in enumerate(rows):
        expected[row] = expected[i].clone()
    ops.copy_rows_([table] * count, rows, [table[i] for i in range(count)])
    assert torch.equal(table, expected)


@pytest.mark.parametrize("columns", [1, 15, 16, 17, 100_003])
def test_rows_of_any_length_and_place(device, columns):
    value = torch.arange(columns + 1, device=device).to(torch.uint8)
    for first in (0, 1):  # bytes from where memory is aligned
        table = torch.zeros(4, columns, dtype=torch.uint8, device=device)
        ops.copy_rows_([table], [2], [value[first : first + columns]])
        assert torch.equal(table[2], value[first : first + columns]) and not table[[0, 1, 3]].any()


def test_a_view_of_a_table_is_the_table(device):
    table, value = torch.zeros(4, 3, device=device), torch.ones(3, device=device)
    ops.copy_rows_([table[1:]], [0], [value])
    assert table.sum(1).tolist() == [0, 3, 0, 0]


@pytest.mark.parametrize("shift", [1, 3, 4096])
def test_a_value_may_overlap_the_row_that_it_is_copied_to(shift, device):
    flat = torch.arange(3 * 8192, dtype=torch.float32, device=device)
    table, value = flat.view(3, 8192), flat[8192 - shift : 2 * 8192 - shift]
    expected = value.clone()
    ops.copy_rows_([table], [1], [value])
    assert torch.equal(table[1], expected)


def test_wrong_arguments(device):
    table, value = torch.zeros(4, 3, device=device), torch.ones(3, device=device)
    for row in (-1, 4):
        with pytest.raises(ValueError, match=rf"copy_rows_: rows must be in \[0, 4\), got {row}"):
            ops.copy_rows_([table], [row], [value])
    with pytest.raises(ValueError, match=r"copy_rows_: values must have shape \[3\], got \[2\]"):
        ops.copy_rows_([table], [0], [value[:2]])
    with pytest.raises(TypeError, match="copy_rows_: values must be float32, got float64"):
        ops.copy_rows_([table], [0], [value.double()])
    with pytest.raises(ValueError, match="copy_rows_: tables must be contiguous, got strides"):
        ops.copy_rows_([table.T], [0], [torch.ones(4, device=device)])
    with pytest.raises(ValueError, match="copy_rows_: rows must be 1, one for each table, got 2"):
        ops.copy_rows_([table], [0, 1], [value])
    with pytest.raises(ValueError, match="copy_rows_: values must be 1, one for each table, got 0"):
        ops.copy_rows_([table], [0], [])


def test_the_binding_refuses_what_would_write_elsewhere(device):
    table, value = torch.zeros(4, 3, device=device), torch.ones(3, device=device)
    for rows, values in (([4], [value]), ([-1], [value]), ([0], [value[:2]]), ([0], [value.double()]), ([0], [])):
        with pytest.raises(RuntimeError, match="copy_rows_: "):
            ops.trusted.copy_rows_([table], rows, values)
    assert not table.any()


def test_opcheck(device):
    tables, rows, values = make_copies(device)
    opcheck(torch.ops.spslam.copy_rows_.default, (tables[:3], rows[:3], values[:3]), device)
