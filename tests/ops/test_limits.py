"""What every op does with arguments that are wrong, empty or extreme: a clear error, or a documented result.

What it makes of one bad row among good ones stands in `test_bad_rows`.
"""

import copy
import inspect
import itertools
import math
import re

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from spslam import ops
from tests.ops.arguments import cameras, changed, get, numbers, outputs, tensors
from tests.ops.cases import CASES, arguments

each_op = pytest.mark.parametrize("name", CASES)
# What takes no tensor to work on: their own tests are enough.
WITHOUT_TENSORS = {
    "get_num_threads",
    "set_num_threads",
    "mlp_init_params",
    "mlp_num_params",
    "mlp_params_from",
    "new_gradient_sums",
    "new_voxel_hash",
}
# Of torch's own operations alone: their own tests are enough.
COMPOSED = {"mlp_to_sequential", "neus_alpha", "pack_rays", "tri_planes_from_chw", "volsdf_density"}
# Tables that may be of float16 and bfloat16, and rows that may have more than one leading axis: (op, argument).
SMALLER = {
    ("trilinear_interpolate", "embeddings"),
    ("bilinear_interpolate", "texels"),
    ("tri_plane_interpolate", "texels"),
    ("interpolate_tri_planes", "table"),
    ("interpolate_volumes", "table"),
}
MORE_AXES = {
    ("bilinear_interpolate", "uv"),
    ("tri_plane_interpolate", "points"),
    ("interpolate_tri_planes", "points"),
    ("interpolate_volumes", "points"),
    ("mlp", "input"),
}
CPU_ONLY = {"encode_frame_"}
# Integers that name rows or places. None may lead outside of a table, whatever its value.
EXTREME_INTEGERS = (-(2**31), -1, 2**31 - 1)
# Made by the voxel_hash functions alone; to look through them for sense would cost more than to use them.
TABLES = ("hash_keys", "hash_values", "corner_ids")
EXTREME_FLOATS = (math.nan, math.inf, -math.inf, 1e30, -1e30, 1e-38)
# What bindings take beside tensors: sums and products of these would not fit 64 bits, or 32.
EXTREME_ARGUMENTS = (-(2**63), -(2**62), -(2**31) - 1, -1, 2**31, 2**32 + 1, 2**62, 2**63 - 1)
# How many of something there are to be: within 2^30.
COUNTS = ("num_pixels", "iterations", "num_points", "hidden", "output", "first_step", "num_uniform", "num_surface")
HUGE_COUNTS = (2**30 + 1, 2**31, 2**62, 2**63 - 1)
# Numbers, not tensors: no counts, which say how long a call runs.
EXTREME_NUMBERS = {float: (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e30), int: (-(2**63), -(2**31), -1, 0)}


class Recorder(TorchDispatchMode):
    """Notes the calls of spslam's own torch ops."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function.namespace == "spslam":
            self.calls.append((function, copy.deepcopy(args)))
        return function(*args, **(kwargs or {}))


def binding_calls(name, call):
    """The torch ops that a public op calls, with the arguments that it hands them."""
    with Recorder() as recorder:
        run(name, call)
    assert recorder.calls
    return recorder.calls


def with_extreme_integers(arguments):
    """The arguments with one integer at a time, in a list or not, replaced by each extreme one."""
    for position, argument in enumerate(arguments):
        if isinstance(argument, int) and not isinstance(argument, bool):
            for value in EXTREME_ARGUMENTS:
                yield [*arguments[:position], value, *arguments[position + 1 :]]
        elif isinstance(argument, list) and all(isinstance(part, int) for part in argument):
            for i, value in itertools.product(range(len(argument)), EXTREME_ARGUMENTS):
                changed = [*argument[:i], value, *argument[i + 1 :]]
                yield [*arguments[:position], changed, *arguments[position + 1 :]]


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
    assert public == set(CASES) | WITHOUT_TENSORS | COMPOSED


@each_op
def test_case_is_valid(name, device, generator):
    run(name, arguments(name, generator, device))


@each_op
def test_another_dtype_is_refused(name, device, generator):
    call = arguments(name, generator, device)
    for path in tensors(call):
        other = torch.complex64 if (name, path[-1]) in SMALLER else torch.bfloat16
        with pytest.raises(TypeError, match=f"{name}: .*{path[-1]} must be .*, got {str(other)[6:]}"):
            run(name, changed(call, path, get(call, path).to(other)))


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
        more_axes = [] if (name, path[-1]) in MORE_AXES else [get(call, path)[None]]
        for other in (*more_axes, get(call, path).flatten()[0]):
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
def test_bindings_take_any_integer(name, device, generator):
    """Behind the checks of Python too, where integers of a file or of another caller may come: an error or a result."""
    for function, call in binding_calls(name, arguments(name, generator, device)):
        for extreme in with_extreme_integers(call):
            try:
                function(*copy.deepcopy(extreme))
            except RuntimeError as error:
                assert re.match(r"\w+_?: .* must ", str(error)), error


def bad_layouts(layout):
    """Layouts of planes that leave the table: by sums and products that overflow, by sizes and origins that do."""
    for plane in range(3):
        offset, origin_u, origin_v, size_u, size_v = layout[5 * plane : 5 * plane + 5]
        for bad in (
            (2**63 - size_u * size_v, origin_u, origin_v, size_u, size_v),
            (2**63 - 1, origin_u, origin_v, size_u, size_v),
            (offset, origin_u, origin_v, 2**32, 2**32),
            (offset, origin_u, origin_v, 2**62, 4),
            (offset, origin_u, origin_v, 2**32 + size_u, size_v),
            (offset, 2**32 + origin_u, origin_v, size_u, size_v),
            (offset, origin_u, 2**31 - 1, size_u, size_v),
            (-1, origin_u, origin_v, size_u, size_v),
            (offset, origin_u, origin_v, -size_u, -size_v),
        ):
            yield [*layout[: 5 * plane], *bad, *layout[5 * plane + 5 :]]


@pytest.mark.parametrize("name", ["query_color", "query_sdf", "render_step", "track_adam", "optimize_map_"])
def test_planes_of_a_scene_stay_within_their_texels(name, device, generator):
    """A file may say anything: see `spslam.tensor_file`."""
    call = arguments(name, generator, device)
    for layout in bad_layouts(call["scene"].plane_layout):
        with pytest.raises(ValueError, match=f"{name}: plane_layout must "):
            run(name, changed(call, ("scene", "plane_layout"), layout))
        for function, given in binding_calls(name, call):
            with pytest.raises(RuntimeError, match="spslam: .*plane layout must "):
                function(*given[:2], layout, *given[3:])


def test_planes_of_an_interpolation_stay_within_their_texels(device, generator):
    call = arguments("tri_plane_interpolate", generator, device)
    for layout in bad_layouts(call["layout"]):
        with pytest.raises(ValueError, match="tri_plane_interpolate: layout must "):
            run("tri_plane_interpolate", call | dict(layout=layout))
        with pytest.raises(RuntimeError, match="tri_plane_interpolate: .*plane layout must "):
            torch.ops.spslam.tri_plane_interpolate(call["texels"], call["points"], call["cell_size"], layout)


def test_sizes_without_memory_do_no_harm():
    """A tensor of 0 columns may have any number of rows: products of its sizes don't fit 64 bits."""
    op = torch.ops.spslam
    no_columns = torch.zeros(0, 2**61)
    with pytest.raises(RuntimeError, match="must have shape"):
        op.trilinear_interpolate_backward(
            torch.zeros(0), no_columns, torch.zeros(16, 8, dtype=torch.int32), torch.zeros(16, 3)
        )
    with pytest.raises(RuntimeError, match=r"hidden must be in \[1, 2\^30\], got"):
        op.mlp(torch.zeros(4, 2), torch.zeros(5), 2**32, 1, 0)
    with pytest.raises(RuntimeError, match="must have 2 to 1025 samples per axis"):
        op.marching_cubes(torch.zeros(0, 3, dtype=torch.int32), torch.zeros(0, 2**20, 2**20, 2**20), 0.0)
    with pytest.raises(RuntimeError, match=r"frames must be in \[0, 2\^30\]"):
        op.normal_equations(torch.zeros(2**61, 0), torch.zeros(2**61, 0, 6), torch.zeros(2**61, 0))


@each_op
def test_huge_counts_are_refused(name, device, generator):
    call = arguments(name, generator, device)
    for path in numbers(call):
        if path[-1] in COUNTS:
            for count in HUGE_COUNTS:
                with pytest.raises(ValueError, match=rf"{name}: .*{path[-1]}.* must .*, got [0-9]+$"):
                    run(name, changed(call, path, count))


@each_op
def test_a_camera_has_four_numbers(name, device, generator):
    call = arguments(name, generator, device)
    for path in cameras(call):
        for wrong in (get(call, path)[:3], (*get(call, path), 1.0)):
            with pytest.raises(ValueError, match=rf"{name}: .*intrinsics must be \(fx, fy, cx, cy\), got \("):
                run(name, changed(call, path, wrong))
        fx, fy, *center = get(call, path)
        for wrong in ((0.0, fy, *center), (fx, -fy, *center), (math.nan, fy, *center), (fx, math.inf, *center)):
            with pytest.raises(ValueError, match=rf"{name}: .*intrinsics must have positive finite focal lengths"):
                run(name, changed(call, path, wrong))
