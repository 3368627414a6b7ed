"""The parts of a call's arguments, those inside of dataclasses and cameras too, by their path."""

from dataclasses import fields, is_dataclass, replace

import torch
from torch.utils._pytree import tree_map_only

from spslam import ops


def tensors(call):
    """Paths of all tensors."""
    return _paths(call, torch.Tensor)


def numbers(call):
    """Paths of all numbers that are no tensors."""
    return _paths(call, (int, float))


def cameras(call):
    """Paths of all pinhole cameras."""
    return _paths(call, ops.Intrinsics)


def _paths(call, kind):
    parts = [part for name, value in call.items() for part in _parts(value, (name,))]
    return [path for path, value in parts if isinstance(value, kind) and not isinstance(value, bool)]


def _parts(value, path):
    """A value and what it is made of."""
    yield path, value
    if is_dataclass(value):
        for field in fields(value):
            yield from _parts(getattr(value, field.name), (*path, field.name))
    elif hasattr(value, "_asdict"):  # a NamedTuple
        for name, part in value._asdict().items():
            yield from _parts(part, (*path, name))


def get(call, path):
    """What lies at a path."""
    value = call[path[0]]
    for name in path[1:]:
        value = getattr(value, name)
    return value


def changed(call, path, value):
    """The call with something else there."""
    return call | {path[0]: _with(call[path[0]], path[1:], value)}


def _with(owner, path, value):
    if not path:
        return value
    part = {path[0]: _with(getattr(owner, path[0]), path[1:], value)}
    return owner._replace(**part) if hasattr(owner, "_replace") else replace(owner, **part)


def opcheck(op, arguments, device, **options):
    """`torch.library.opcheck` with every tensor of the arguments on a device."""
    torch.library.opcheck(
        op, tree_map_only(torch.Tensor, lambda tensor: tensor.to(device), tuple(arguments)), **options
    )


def outputs(result):
    """All tensors of a result, in order."""
    if isinstance(result, torch.Tensor):
        return [result]
    if is_dataclass(result):
        return outputs(tuple(getattr(result, field.name) for field in fields(result)))
    return [tensor for part in result for tensor in outputs(part)] if isinstance(result, tuple) else []
