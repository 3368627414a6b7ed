"""What is of the wrong type is refused by every op in one wording, whatever it stands for."""

import inspect
from dataclasses import is_dataclass

import numpy as np
import pytest
import torch

from spslam import ops
from tests.ops.arguments import changed, get, numbers
from tests.ops.cases import CASES, arguments

each_op = pytest.mark.parametrize("name", CASES)
NO_NUMBERS = ("8", [1], 1j, None)


def kind_of(value):
    return "an int" if isinstance(value, int) else "a float"


def refused(name, call, what):
    with pytest.raises(TypeError, match=rf"^{name}: (each of )?\S+ must be {what}, got (a )?[\w.]+"):
        getattr(ops, name)(**call)


@each_op
def test_what_is_no_number_is_refused(name, generator):
    call = arguments(name, generator)
    for path in numbers(call):
        kind = kind_of(get(call, path))
        for wrong in (*NO_NUMBERS, *([8.0] if kind == "an int" else [])):
            refused(name, changed(call, path, wrong), kind)


@each_op
def test_a_tensor_is_no_number(name, generator):
    """Its gradient would be lost, as numbers have none."""
    call = arguments(name, generator)
    for path in numbers(call):
        for requires_grad in (False, True):
            value = torch.tensor(1.0, requires_grad=requires_grad)
            refused(name, changed(call, path, value), kind_of(get(call, path)))


def test_no_gradient_of_a_number_is_lost(generator):
    """Nor in torch.func, whose tensors don't say that they require gradients."""
    call = arguments("tri_plane_interpolate", generator)

    def total(cell_size):
        return ops.tri_plane_interpolate(**{**call, "cell_size": cell_size}).sum()

    for differentiate in (torch.func.grad, torch.func.jacfwd):
        with pytest.raises(TypeError, match="tri_plane_interpolate: cell_size must be a float, got a torch.Tensor"):
            differentiate(total)(torch.tensor(0.04))


@each_op
def test_numbers_of_numpy_are_numbers(name, generator):
    call = arguments(name, generator)
    for path in numbers(call):
        value = get(call, path)
        other = np.int64(value) if isinstance(value, int) else np.float32(value)
        getattr(ops, name)(**changed(arguments(name, generator), path, other))


@each_op
def test_what_is_no_bool_is_refused(name, generator):
    call = arguments(name, generator)
    flags = [key for key, p in inspect.signature(getattr(ops, name)).parameters.items() if p.annotation is bool]
    for flag in flags:
        for wrong in (1, "yes", None, torch.tensor(True)):
            refused(name, call | {flag: wrong}, "a bool")


@each_op
def test_another_object_is_refused(name, generator):
    call = arguments(name, generator)
    for argument, value in call.items():
        if is_dataclass(value) or hasattr(value, "_fields"):
            optional = inspect.signature(getattr(ops, name)).parameters[argument].default is None
            kind = "a sequence of float" if isinstance(value, ops.Intrinsics) else f"an? {type(value).__name__}"
            for wrong in ("scene", torch.zeros(4), *(() if optional else (None,))):
                refused(name, call | {argument: wrong}, kind)


@pytest.mark.parametrize(
    "name, argument, wrong, message",
    [
        ("tri_plane_interpolate", "layout", torch.zeros(15), "layout must be a sequence of int, got a torch.Tensor"),
        ("tri_plane_interpolate", "layout", None, "layout must be a sequence of int, got NoneType"),
        ("tri_plane_interpolate", "layout", [0.5] * 15, "each of layout must be an int, got float"),
        ("sparse_adam_", "betas", 0.9, "betas must be a sequence of float, got float"),
        ("sparse_adam_", "betas", ("a", "b"), "each of betas must be a float, got str"),
        ("mlp", "activation", "tanh", "activation must be an int, got str"),
        ("mlp", "hidden", 8.0, "hidden must be an int, got float"),
        ("mlp", "hidden", torch.tensor(32), "hidden must be an int, got a torch.Tensor"),
    ],
)
def test_sequences_and_names(name, argument, wrong, message, generator):
    with pytest.raises(TypeError, match=f"^{name}: {message}"):
        getattr(ops, name)(**arguments(name, generator) | {argument: wrong})


@pytest.mark.parametrize("wrong", [2**63, -(2**63) - 1, 2**80])
@each_op
def test_integers_fit_64_bits(name, wrong, generator):
    call = arguments(name, generator)
    for path in numbers(call):
        if isinstance(get(call, path), int):
            with pytest.raises(ValueError, match=rf"^{name}: \S+ must (fit 64 bits|be .*), got"):
                getattr(ops, name)(**changed(call, path, wrong))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: ops.set_num_threads(2.0), "set_num_threads: count must be an int, got float"),
        (lambda: ops.new_voxel_hash("8"), "new_voxel_hash: capacity must be an int, got str"),
        (lambda: ops.mlp_num_params(3, 8.0, 1), "mlp_num_params: hidden must be an int, got float"),
        (lambda: ops.VoxelHash(8.0), "VoxelHash: capacity must be an int, got float"),
        (lambda: ops.VoxelHash(max_voxels="9"), "VoxelHash: max_voxels must be an int, got str"),
        (lambda: ops.VoxelHash().reserve(1.5), "VoxelHash.reserve: rows must be an int, got float"),
        (
            lambda: ops.VoxelHash().insert([[0, 0, 0]]),
            "VoxelHash.insert: voxel_coords must be a torch.Tensor, got list",
        ),
        (
            lambda: ops.VoxelHash().insert(torch.zeros(1, 3)),
            "VoxelHash.insert: voxel_coords must be int32 or int64, got float32",
        ),
        (
            lambda: ops.VoxelHash().find(torch.zeros(1, 3)),
            "VoxelHash.find: voxel_coords must be int32 or int64, got float32",
        ),
        (
            lambda: ops.VoxelHash().lookup(torch.zeros(1, 3), "1"),
            "VoxelHash.lookup: voxel_size must be a float, got str",
        ),
        (lambda: ops.VoxelHash().lookup([0], 0.1), "VoxelHash.lookup: points must be a torch.Tensor, got list"),
        (lambda: ops.new_gradient_sums([0]), "new_gradient_sums: param must be a torch.Tensor, got list"),
    ],
)
def test_what_has_no_case(call, message):
    with pytest.raises(TypeError, match=f"^{message}"):
        call()
