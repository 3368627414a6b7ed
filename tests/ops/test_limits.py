"""What every op does with arguments that are wrong, empty or extreme: a clear error, or a documented result.

What it makes of one bad row among good ones stands in `test_bad_rows`.
"""

import copy
import inspect
import math

import pytest
import torch

from spslam import ops
from tests.ops.arguments import cameras, changed, get, numbers, outputs, tensors
from tests.ops.cases import CASES, arguments

each_op = pytest.mark.parametrize("name", CASES)
# What takes no tensor to work on: their own tests are enough.
WITHOUT_TENSORS = {"get_num_threads", "set_num_threads", "mlp_num_params", "new_gradient_sums", "new_voxel_hash"}
CPU_ONLY = {"sample_frame_pixels", "encode_frame_"}
# Integers that name rows or places. None may lead outside of a table, whatever its value.
EXTREME_INTEGERS = (-(2**31), -1, 2**31 - 1)
# Made by the voxel_hash functions alone; to look through them for sense would cost more than to use them.
TABLES = ("hash_keys", "hash_values", "corner_ids")
EXTREME_FLOATS = (math.nan, math.inf, -math.inf, 1e30, -1e30, 1e-38)
# Numbers, not tensors: no counts, which say how long a call runs.
EXTREME_NUMBERS = {float: (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e30), int: (-(2**63), -(2**31), -1, 0)}


def run(name, call):
    return getattr(ops, name)(**call)


def result_or_named_error(name, call):
    """A result, or an error in the house's wording."""
    try:
        run(name, copy.deepcopy(call))
    except (ValueError, TypeError, RuntimeError) as error:
        assert str(error).startswith(f"{name}: "), error


def test_every_op_is_tested():
    public = {name for name in ops.__all__ if inspect.isfunction(getattr(ops, name))}
    assert public == set(CASES) | WITHOUT_TENSORS


@each_op
def test_case_is_valid(name, device, generator):
    run(name, arguments(name, generator, device))


@each_op
def test_another_dtype_is_refused(name, device, generator):
    call = arguments(name, generator, device)
    for path in tensors(call):
        with pytest.raises(TypeError, match=f"{name}: .*{path[-1]} must be .*, got bfloat16"):
            run(name, changed(call, path, get(call, path).to(torch.bfloat16)))


@each_op
def test_what_is_no_tensor_is_refused(name, device, generator):
    call = arguments(name, generator, device)
    for path in tensors(call):
        with pytest.raises(TypeError, match=f"{name}: .*{path[-1]} must be a torch.Tensor, got list"):
            run(name, changed(call, path, get(call, path).tolist()))


@each_op
def test_another_number_of_axes_is_refused(name, device, generator):
    call = arguments(name, generator, device)
    for path in tensors(call):
        for other in (get(call, path)[None], get(call, path).flatten()[0]):
            with pytest.raises(ValueError, match=f"{name}: .* must "):
                run(name, changed(call, path, other))


@each_op
@pytest.mark.parametrize("other", ["meta", pytest.param("cpu", marks=pytest.mark.cuda)])
def test_another_device_is_refused(name, other, device, generator):
    call = arguments(name, generator, device)
    paths = [path for path in tensors(call) if get(call, path).device.type != other]
    for path in paths if len(paths) > 1 else ():
        with pytest.raises(ValueError, match=f"{name}: .* must be on "):
            run(name, changed(call, path, get(call, path).to(other)))


@each_op
def test_no_rows_are_legal(name, device, generator):
    for result in outputs(run(name, arguments(name, generator, device, rows=0))):
        assert name in CPU_ONLY or result.device.type == device.type
        assert not result.is_floating_point() or not result.isnan().any()


@each_op
def test_extreme_tensors_do_no_harm(name, device, generator):
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
                result_or_named_error(name, changed(call, path, torch.full_like(get(call, path), value)))


@each_op
def test_extreme_numbers_do_no_harm(name, device, generator):
    """Sizes, rates, weights, intrinsics, keys of draws: a result or an error that names the argument."""
    call = arguments(name, generator, device)
    for path in numbers(call):
        for value in EXTREME_NUMBERS[float if isinstance(get(call, path), float) else int]:
            result_or_named_error(name, changed(call, path, value))


@each_op
def test_a_camera_has_four_numbers(name, device, generator):
    call = arguments(name, generator, device)
    for path in cameras(call):
        for wrong in (get(call, path)[:3], (*get(call, path), 1.0)):
            with pytest.raises(ValueError, match=rf"{name}: .*intrinsics must be \(fx, fy, cx, cy\), got \("):
                run(name, changed(call, path, wrong))
