"""What every op does with arguments that are wrong, empty or extreme: a clear error, or a documented result."""

import copy
from dataclasses import fields, is_dataclass, replace

import pytest
import torch

from spslam import ops
from tests.ops.cases import CASES, arguments

each_op = pytest.mark.parametrize("name", CASES)
CPU_ONLY = {"sample_frame_pixels", "encode_frame_"}
# Integers that name rows or places. None may lead outside of a table, whatever its value.
EXTREME_INTEGERS = (-(2**31), -1, 2**31 - 1)
# Made by the voxel_hash functions alone; to look through them for sense would cost more than to use them.
TABLES = ("hash_keys", "hash_values", "corner_ids")
EXTREME_FLOATS = (float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1e-38)


def tensors(call):
    """Paths of all tensors among the arguments, those inside of dataclasses too."""
    for name, value in call.items():
        if isinstance(value, torch.Tensor):
            yield (name,)
        elif is_dataclass(value):
            yield from ((name, f.name) for f in fields(value) if isinstance(getattr(value, f.name), torch.Tensor))


def get(call, path):
    value = call[path[0]]
    return getattr(value, path[1]) if len(path) == 2 else value


def changed(call, path, tensor):
    value = replace(call[path[0]], **{path[1]: tensor}) if len(path) == 2 else tensor
    return call | {path[0]: value}


def run(name, call):
    return getattr(ops, name)(**call)


def outputs(result):
    if isinstance(result, torch.Tensor):
        return [result]
    if is_dataclass(result):
        return outputs(tuple(getattr(result, f.name) for f in fields(result)))
    return [tensor for part in result for tensor in outputs(part)] if isinstance(result, tuple) else []


@each_op
def test_case_is_valid(name, device, generator):
    run(name, arguments(name, generator, device))


@each_op
def test_another_dtype_is_refused(name, generator):
    call = arguments(name, generator)
    for path in tensors(call):
        with pytest.raises(TypeError, match=f"{name}: .*{path[-1]} must be .*, got bfloat16"):
            run(name, changed(call, path, get(call, path).to(torch.bfloat16)))


@each_op
def test_what_is_no_tensor_is_refused(name, generator):
    call = arguments(name, generator)
    for path in tensors(call):
        if (name, path[-1]) not in {("sparse_adam_", "stamps")}:
            with pytest.raises(TypeError, match=f"{name}: .*{path[-1]} must be a torch.Tensor, got list"):
                run(name, changed(call, path, get(call, path).tolist()))


@each_op
def test_another_number_of_axes_is_refused(name, generator):
    call = arguments(name, generator)
    for path in tensors(call):
        with pytest.raises(ValueError, match=f"{name}: .* must "):
            run(name, changed(call, path, get(call, path)[None]))


@each_op
def test_another_device_is_refused(name, generator):
    call = arguments(name, generator)
    paths = list(tensors(call))
    if len(paths) > 1:
        for path in paths:
            with pytest.raises(ValueError, match=f"{name}: .* must be on "):
                run(name, changed(call, path, get(call, path).to("meta")))


@each_op
def test_no_rows_are_legal(name, device, generator):
    for result in outputs(run(name, arguments(name, generator, device, rows=0))):
        assert name in CPU_ONLY or result.device.type == device.type
        assert not result.is_floating_point() or not result.isnan().any()


@each_op
def test_extreme_numbers_do_no_harm(name, device, generator):
    """NaN, infinity and the largest floats, in one argument at a time: no error, nothing outside of the arrays."""
    call = arguments(name, generator, device)
    for path in tensors(call):
        if get(call, path).is_floating_point():
            for value in EXTREME_FLOATS:
                extreme = torch.full_like(get(call, path), value, dtype=torch.float32).to(get(call, path).dtype)
                run(name, copy.deepcopy(changed(call, path, extreme)))


@each_op
def test_extreme_integers_do_no_harm(name, device, generator):
    """Ids, coordinates and packed words without meaning: a documented result or an error that names the argument."""
    call = arguments(name, generator, device)
    for path in tensors(call):
        own_table = path[-1] in TABLES and name != "trilinear_interpolate"
        if get(call, path).dtype in (torch.int32, torch.int64) and not own_table:
            for value in EXTREME_INTEGERS:
                extreme = copy.deepcopy(changed(call, path, torch.full_like(get(call, path), value)))
                try:
                    run(name, extreme)
                except (ValueError, RuntimeError) as error:
                    assert f"{name}: " in str(error)
