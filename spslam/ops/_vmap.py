"""Batching rules of ops for `torch.vmap`."""

from collections.abc import Callable

import torch

from spslam.ops._dispatch import call

_rules: dict[str, Callable] = {}


def vmap_rule(op: str) -> Callable:
    """The batching rule of an op, as `torch.library.register_vmap` takes it."""
    return _rules[op]


def _register(op: str, rule: Callable) -> None:
    _rules[op] = rule
    torch.library.register_vmap(f"spslam::{op}", rule)


def register_rows_vmap(op: str, rows: tuple[int, ...], one_by_one: tuple[int, ...] = ()) -> None:
    """Registers a batching rule that folds the mapped axis into the rows of an op.

    For ops whose outputs have one row per row of the inputs. If an argument not in `rows`, such as a table, has the
    mapped axis too, the op runs once per entry.

    Args:
        op: name of the op.
        rows: positions of the arguments whose first axis is the rows; one may be None.
        one_by_one: positions of optional arguments that number the rows: with one of them each entry is a call.
    """

    def rule(info, in_dims, *args):
        in_dims = _tensor_dims(in_dims, args)
        mapped = {i for i, dim in enumerate(in_dims) if dim is not None}
        if not mapped <= set(rows) or any(args[i] is not None for i in one_by_one):
            return _run_per_entry(op, info.batch_size, in_dims, args)
        size = info.batch_size
        folded, count = list(args), 0
        for i in rows:
            if args[i] is None:
                continue
            expanded = args[i].movedim(in_dims[i], 0) if i in mapped else args[i].expand(size, *args[i].shape)
            count = expanded.shape[1]
            folded[i] = expanded.reshape(size * count, *expanded.shape[2:])
        outputs = call(op, *folded)
        if isinstance(outputs, torch.Tensor):
            return outputs.unflatten(0, (size, count)), 0
        return tuple(output.unflatten(0, (size, count)) for output in outputs), (0,) * len(outputs)

    _register(op, rule)


def register_each_vmap(op: str) -> None:
    """Registers a batching rule that runs an op once per entry: for ops that reduce over rows, or use row numbers."""

    def rule(info, in_dims, *args):
        return _run_per_entry(op, info.batch_size, _tensor_dims(in_dims, args), args)

    _register(op, rule)


def _tensor_dims(in_dims, args) -> tuple[int | None, ...]:
    """The mapped axis of each tensor argument, None for all others: for a list torch passes a list of None."""
    return tuple(dim if isinstance(arg, torch.Tensor) else None for dim, arg in zip(in_dims, args, strict=True))


def _run_per_entry(op, size, in_dims, args):
    if size == 0:
        raise ValueError(f"spslam::{op}: torch.vmap must map over at least one entry, got 0")
    entries = [
        call(op, *(arg if dim is None else arg.select(dim, i) for arg, dim in zip(args, in_dims, strict=True)))
        for i in range(size)
    ]
    if isinstance(entries[0], torch.Tensor):
        return torch.stack(entries), 0
    return tuple(torch.stack(outputs) for outputs in zip(*entries, strict=True)), (0,) * len(entries[0])
