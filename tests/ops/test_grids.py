"""Tri-planes and volumes of several resolutions against grid_sample, with derivatives of every order."""

import numpy as np
import pytest
import torch

from spslam import ops
from tests import reference
from tests.ops.threads import assert_same_for_any_threads

BOUNDS = [(-0.5, 0.2, -1.0), (1.5, 1.4, 0.7)]
SIZES = [(5, 4, 6), (9, 8, 3), (2, 1, 11)]
FEW = [(3, 2, 4), (4, 3, 3)]
DTYPES = [torch.float32, torch.float64]
OPCHECKS = ("test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic")
# float32: sums of up to 36 products, and coordinates scaled in another order than grid_sample does.
TOLERANCE = {torch.float32: dict(rtol=2e-4, atol=2e-4), torch.float64: dict(rtol=1e-9, atol=1e-10)}
INTERPOLATE = {"tri_planes": ops.interpolate_tri_planes, "volumes": ops.interpolate_volumes}
each_kind = pytest.mark.parametrize("kind", INTERPOLATE)
ALIGNED = pytest.mark.parametrize("align_corners", [True, False])
CONCATENATED = pytest.mark.parametrize("concatenate", [True, False])


def grid_of(kind, align_corners=True, sizes=SIZES, **more):
    levels = ops.TriPlaneLevels if kind == "tri_planes" else ops.VolumeLevels
    return levels.from_sizes(BOUNDS, sizes, align_corners, **more)


def points_of(generator, dtype, count=200, beyond=0.3):
    """A third outside of the bounds."""
    lower, upper = (torch.tensor(corner, dtype=dtype) for corner in BOUNDS)
    return lower - beyond + (upper - lower + 2 * beyond) * torch.rand(count, 3, generator=generator, dtype=dtype)


def arguments(kind, generator, device, dtype, channels=4, count=200, **more):
    grid = grid_of(kind, **more)
    table = torch.randn(grid.num_rows, channels, generator=generator, dtype=dtype)
    points = points_of(generator, dtype, count)
    return table.to(device).requires_grad_(), points.to(device).requires_grad_(), grid


def few_rows(kind, generator, device, channels, count):
    """Float64 arguments of two small levels, of volumes the second hashed: differences are taken row by row."""
    more = dict(max_level_rows=32) if kind == "volumes" else {}
    return arguments(kind, generator, device, torch.float64, channels, count, sizes=FEW, **more)


def by_grid_sample(kind, table, points, grid):
    if kind == "tri_planes":
        return reference.grids.tri_planes(grid.to_chw(table), points, BOUNDS, grid.align_corners)
    parts = [table[v.first_row : v.first_row + v.num_rows].view(*v.size, -1) for v in grid.levels]
    return [reference.grids.volume(part, points, BOUNDS, grid.align_corners) for part in parts]


@each_kind
@ALIGNED
@CONCATENATED
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [1, 2, 8, 11])
def test_equals_grid_sample(kind, align_corners, concatenate, dtype, channels, device, generator):
    table, points, grid = arguments(kind, generator, device, dtype, channels, align_corners=align_corners)
    got = INTERPOLATE[kind](table, points, grid, concatenate)
    levels = by_grid_sample(kind, table, points, grid)
    want = torch.cat(levels, 1) if concatenate else sum(levels)
    weight = torch.randn(want.shape, generator=generator, dtype=dtype).to(device)
    grads = [torch.autograd.grad((out * weight).sum(), [table, points]) for out in (got, want)]
    for g, w in zip((got, *grads[0]), (want, *grads[1]), strict=True):
        torch.testing.assert_close(g, w, **TOLERANCE[dtype])


def test_hashed_volumes_equal_the_formula(device, generator):
    grid = grid_of("volumes", sizes=[(3, 3, 3), (20, 17, 12)], max_level_rows=64)
    assert [(level.num_rows, level.hashed) for level in grid.levels] == [(27, False), (64, True)]
    table = torch.randn(91, 2, generator=generator, dtype=torch.float64).to(device).requires_grad_()
    points = points_of(generator, torch.float64, 60, beyond=-0.01).to(device).requires_grad_()
    got = ops.interpolate_volumes(table, points, grid, concatenate=True)
    dense = reference.grids.volume(table[:27].view(3, 3, 3, 2), points, BOUNDS, True)
    want = torch.cat([dense, reference.grids.hashed_volume(table[27:], (20, 17, 12), points, BOUNDS)], 1)
    grads = [torch.autograd.grad(out.square().sum(), [table, points]) for out in (got, want)]
    for g, w in zip((got, *grads[0]), (want, *grads[1]), strict=True):
        torch.testing.assert_close(g, w, **TOLERANCE[torch.float64])


def test_cells_of_a_size(device, generator):
    """A cell size for all axes is what tri_plane_interpolate takes; one per axis is what grid_sample does."""
    grid = ops.TriPlaneLevels.from_cell_size([(0, 0, 0), (0.4, 0.3, 0.2)], [0.04])
    assert grid.levels[0].size == (11, 9, 6)
    table = torch.randn(grid.num_rows, 8, generator=generator, dtype=torch.float64).to(device)
    points = torch.rand(50, 3, generator=generator, dtype=torch.float64).to(device)
    layout = [0, 0, 0, 11, 9, 99, 0, 0, 11, 6, 165, 0, 0, 9, 6]
    want = ops.tri_plane_interpolate(table, points, 0.04, layout)
    torch.testing.assert_close(ops.interpolate_tri_planes(table, points, grid), want)
    grid = ops.TriPlaneLevels.from_cell_size(
        [(0, 0, 0), (0.4, 0.3, 0.2)], [(0.1, 0.05, 0.04), 0.1], align_corners=False
    )
    assert [level.size for level in grid.levels] == [(4, 6, 5), (4, 3, 2)]
    assert [level.upper for level in grid.levels] == [pytest.approx((0.4, 0.3, 0.2))] * 2


def test_images_and_back(device, generator):
    images = [
        [torch.randn(1, 3, h, w, generator=generator).to(device) for h, w in ((y, x), (z, x), (z, y))]
        for x, y, z in SIZES
    ]
    table, grid = ops.tri_planes_from_chw(*zip(*images, strict=True), bounds=BOUNDS)
    assert grid == grid_of("tri_planes")
    back = grid.to_chw(table)
    assert all(
        torch.equal(b, i) for one, many in zip(back, images, strict=True) for b, i in zip(one, many, strict=True)
    )
    single, grid = ops.tri_planes_from_chw(*(image[0] for image in images[0]), bounds=BOUNDS)
    assert torch.equal(single, table[: len(single)])
    leaf = images[0][0].clone().requires_grad_()
    table, grid = ops.tri_planes_from_chw(leaf, *images[0][1:], bounds=BOUNDS)
    ops.interpolate_tri_planes(table, points_of(generator, torch.float32).to(device), grid).sum().backward()
    assert leaf.grad.sum().item() == pytest.approx(600, rel=1e-4)  # the weights of a point add up to 1


def test_images_that_do_not_fit_are_refused():
    planes = dict(xy=torch.zeros(8, 30, 40), xz=torch.zeros(8, 20, 40), yz=torch.zeros(8, 20, 30))
    swapped = {key: plane.permute(1, 2, 0) for key, plane in planes.items()}
    for wrong, message in (
        (swapped, r"xz must have shape \[30, "),
        (dict(yz=planes["yz"].mT), r"yz must have shape \[8, 20, 30\], got \[8, 30, 20\]"),
        (dict(xz=planes["xz"][:4]), r"xz must have shape \[8, 20, 40\], got \[4, 20, 40\]"),
        (dict(xy=planes["xy"].expand(2, -1, -1, -1)), r"xy must have shape \[C, H, W\] or \[1, C, H, W\], got \[2"),
        (dict(xy=[planes["xy"]] * 2), r"planes must be of as many levels each, got \[1, 2\]"),
        (dict(bounds=[(0, 0, 0), (1, 0, 1)]), "bounds must be finite and ascend along every axis"),
    ):
        with pytest.raises(ValueError, match=f"^(tri_planes_from_chw|TriPlaneLevels.from_sizes): {message}"):
            ops.tri_planes_from_chw(**planes | dict(bounds=BOUNDS) | wrong)


@each_kind
@CONCATENATED
def test_gradcheck_of_first_and_second_derivatives(kind, concatenate, device, generator):
    table, points, grid = few_rows(kind, generator, device, 2, 6)

    def run(table, points):
        return INTERPOLATE[kind](table, points, grid, concatenate)

    torch.autograd.gradcheck(run, (table, points), eps=1e-7, atol=1e-5, nondet_tol=0)
    torch.autograd.gradgradcheck(run, (table, points), eps=1e-7, atol=1e-4)


@each_kind
def test_opcheck(kind, device, generator):
    table, points, grid = arguments(kind, generator, device, torch.float32, count=9)
    out = INTERPOLATE[kind](table, points, grid, True).detach()
    packed = ops.grids._packed(grid, 0 if kind == "tri_planes" else 1)
    options = (*packed, 0 if kind == "tri_planes" else 1, True)
    op = torch.ops.spslam.grid_interpolate.default
    torch.library.opcheck(op, (table, points, *options), test_utils=OPCHECKS)
    op = torch.ops.spslam.grid_interpolate_backward.default
    for wanted in ((True, True), (True, False), (False, True)):
        arguments_ = (out, table.detach(), points.detach(), *options, *wanted)
        torch.library.opcheck(op, arguments_, test_utils=OPCHECKS)


def test_opcheck_of_sums_over_rows(device, generator):
    table = torch.randn(7, 3, generator=generator).to(device).requires_grad_()
    grad = torch.randn(5, 3, generator=generator).to(device).requires_grad_()
    weights = torch.randn(5, 4, generator=generator).to(device).requires_grad_()
    rows = torch.randint(-1, 8, (5, 4), generator=generator, dtype=torch.int32).to(device)
    op = torch.ops.spslam
    for function, given in (
        (op.row_gather, (table, rows, weights)),
        (op.row_scatter, (grad, rows, weights, 7)),
        (op.row_dot, (grad, table, rows)),
    ):
        torch.library.opcheck(function.default, given, test_utils=OPCHECKS)


def test_sums_over_rows_equal_the_formula(device, generator):
    """A number that names no row is a row of zeros, and weights may be of any size."""
    table, grad = (torch.randn(n, 3, generator=generator, dtype=torch.float64) for n in (7, 5))
    weights = 1e6 * torch.randn(5, 4, generator=generator, dtype=torch.float64)
    rows = torch.randint(-1, 8, (5, 4), generator=generator)
    one_hot = torch.nn.functional.one_hot(rows + 1, 9)[..., 1:8].double()
    moved = [part.to(device) for part in (table, rows.int(), weights, grad)]
    op = torch.ops.spslam
    torch.testing.assert_close(op.row_gather(*moved[:3]).cpu(), torch.einsum("nkp,nk,pc->nc", one_hot, weights, table))
    scattered = op.row_scatter(moved[3], *moved[1:3], 7).cpu()
    torch.testing.assert_close(scattered, torch.einsum("nkp,nk,nc->pc", one_hot, weights, grad))
    torch.testing.assert_close(
        op.row_dot(moved[3], *moved[:2]).cpu(), torch.einsum("nkp,nc,pc->nk", one_hot, grad, table)
    )


@each_kind
def test_gradients_by_torch_func(kind, device, generator):
    table, points, grid = (part.detach() if isinstance(part, torch.Tensor) else part
                           for part in arguments(kind, generator, device, torch.float64, 3, count=5))  # fmt: skip

    def total(table, points):
        return INTERPOLATE[kind](table, points, grid).square().sum()

    def with_autograd(points):
        leaf = points.clone().requires_grad_()
        (first,) = torch.autograd.grad(total(table, leaf), [leaf], create_graph=True)
        return first, [torch.autograd.grad(part, [leaf], retain_graph=True)[0] for part in first.flatten()]

    first, rows = with_autograd(points)
    torch.testing.assert_close(torch.func.grad(total, argnums=1)(table, points), first.detach())
    hessian = torch.func.jacrev(torch.func.jacrev(total, argnums=1), argnums=1)(table, points)
    torch.testing.assert_close(hessian.view(15, 15), torch.stack(rows).view(15, 15))
    per_point = torch.vmap(torch.func.grad(lambda p: total(table, p[None])))(points)
    torch.testing.assert_close(per_point, first.detach())


@each_kind
def test_third_derivatives(kind, device, generator):
    """The gradient by the table of a loss on second derivatives by coordinates, against a stencil of differences."""
    table, points, grid = few_rows(kind, generator, device, 1, 4)

    def curvature(table):
        value = INTERPOLATE[kind](table, points, grid).tanh()  # tanh, for a second derivative along an axis too
        (first,) = torch.autograd.grad(value.sum(), [points], create_graph=True)
        (second,) = torch.autograd.grad(first.square().sum(), [points], create_graph=True)
        return (1e-3 * second).square().sum()

    torch.autograd.gradcheck(curvature, (table,), eps=1e-6, atol=1e-3, rtol=1e-4)


@each_kind
def test_compiles_and_exports(kind, device, generator):
    table, points, grid = arguments(kind, generator, device, torch.float32)

    class Field(torch.nn.Module):
        def forward(self, table, points):
            return INTERPOLATE[kind](table, points, grid, True)

    want = Field()(table, points)
    assert torch.equal(torch.compile(Field(), backend="aot_eager", fullgraph=True)(table, points), want)
    assert torch.equal(torch.export.export(Field(), (table, points)).module()(table, points), want)


@each_kind
def test_same_bits_for_any_number_of_threads(kind, device, generator):
    table, points, grid = arguments(kind, generator, device, torch.float32, channels=37, count=20_000)

    def run():
        out = INTERPOLATE[kind](table, points, grid)
        return [out, *torch.autograd.grad(out.square().sum(), [table, points])]

    assert_same_for_any_threads(run, (1, 2, 7))


@each_kind
def test_empty_and_leading_axes_and_nan(kind, device, generator):
    table, points, grid = arguments(kind, generator, device, torch.float32, count=12)
    assert INTERPOLATE[kind](table, points[:0], grid, True).shape == (0, 12)
    want = INTERPOLATE[kind](table, points, grid)
    got = INTERPOLATE[kind](table, points.view(2, 3, 2, 3), grid)
    assert torch.equal(got, want.view(2, 3, 2, 4))
    with torch.no_grad():
        points[1] = float("nan")
    value = INTERPOLATE[kind](table, points, grid)
    assert value[1].isnan().all()
    assert torch.equal(value[2:], want[2:])


@each_kind
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_smaller_tables_are_read_in_float32(kind, dtype, device, generator):
    table, points, grid = arguments(kind, generator, device, torch.float32)
    small = table.detach().to(dtype).requires_grad_()
    value = INTERPOLATE[kind](small, points, grid)
    assert torch.equal(value, INTERPOLATE[kind](small.float(), points, grid))
    value.sum().backward()
    assert small.grad.dtype == dtype
    assert small.grad.abs().sum() > 0


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: ops.TriPlaneLevels.from_sizes(BOUNDS, []), "sizes must be of 1 to 16 levels, got 0"),
        (lambda: ops.TriPlaneLevels.from_sizes(BOUNDS, [(1, 1, 1)] * 17), "sizes must be of 1 to 16 levels, got 17"),
        (lambda: ops.TriPlaneLevels.from_sizes(BOUNDS, [(4, 0, 4)]), r"sizes must be three integers in \[1, 2\^20\]"),
        (lambda: ops.TriPlaneLevels.from_sizes([(0, 0, 0)], [(4, 4, 4)]), r"bounds must be \(lower, upper\)"),
        (lambda: ops.TriPlaneLevels.from_cell_size(BOUNDS, [0.0]), "cell_sizes must be positive, one or three"),
        (lambda: ops.VolumeLevels.from_sizes(BOUNDS, [(2**11,) * 3]), r"sizes must make a table of at most 2\^31 - 1"),
        (
            lambda: ops.VolumeLevels.from_sizes(BOUNDS, SIZES, max_level_rows=48),
            "max_level_rows must be a power of two",
        ),
        (lambda: grid_of("tri_planes").to_chw(torch.zeros(3, 2)), r"table must have shape \[232, C\], got \[3, 2\]"),
    ],
)
def test_levels_that_cannot_be_are_refused(call, message):
    with pytest.raises(ValueError, match=r"^(TriPlane|Volume)Levels\.\w+: " + message):
        call()


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: ops.TriPlaneLevels.from_sizes(3, SIZES), "bounds must be a sequence, got int"),
        (lambda: ops.TriPlaneLevels.from_sizes(BOUNDS, (2, 2, 2)), "each of sizes must be a sequence, got int"),
        (lambda: ops.TriPlaneLevels.from_cell_size(BOUNDS, 0.1), "cell_sizes must be a sequence, got float"),
        (
            lambda: ops.tri_planes_from_chw(torch.zeros(1, 2, 2), None, [], BOUNDS),
            "xz must be a sequence, got NoneType",
        ),
    ],
)
def test_what_is_no_list_of_levels_is_refused(call, message):
    with pytest.raises(TypeError, match=f": {message}$"):
        call()


def test_arrays_say_what_lists_do():
    levels = ops.TriPlaneLevels.from_sizes(np.array(BOUNDS), np.array(SIZES))
    assert levels == ops.TriPlaneLevels.from_sizes(torch.tensor(BOUNDS, dtype=torch.float64), torch.tensor(SIZES))
    assert levels == grid_of("tri_planes")


def test_bindings_refuse_levels_that_leave_the_table():
    table, points = torch.zeros(100, 2), torch.zeros(4, 3)
    numbers = [1.0, 0.0] * 3
    for kind, levels in ((0, [0, 16, 32, 4, 4, 20, 0]), (1, [0, 0, 0, 5, 5, 5, 0]), (1, [90, 0, 0, 9, 9, 9, 16])):
        with pytest.raises(RuntimeError, match="grid_interpolate: levels must lie within the 100 rows"):
            torch.ops.spslam.grid_interpolate(table, points, levels, numbers, kind, False)
    for levels in ([0] * 7, [0, 0, 0, 2**40, 1, 1, 0], [0, 0, 0, 4, 4, 4, 48], [0] * 6):
        with pytest.raises(RuntimeError, match="grid_interpolate: .* must "):
            torch.ops.spslam.grid_interpolate(table, points, levels, numbers, 1, False)
