"""Interpolation against gather-and-weigh formulas, with gradients, checks and determinism."""

import pytest
import torch

from spslam import ops
from tests import reference
from tests.ops.threads import assert_same_for_any_threads

CELL = 0.04
LAYOUT = [0, -3, 2, 7, 5, 35, -3, -1, 7, 4, 63, 2, -1, 5, 4]
ROWS = 83
# Sums of up to a few hundred float32 products of order one, in another order than the reference's.
ORDER_TOLERANCE = dict(rtol=1e-5, atol=1e-5)
DTYPES = [torch.float32, torch.float64]
OPCHECKS = ("test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic")


def _trilinear(generator, dtype, points=300, vertices=40, channels=8):
    """Arguments of trilinear_interpolate; a fifth of the points miss a corner."""
    embeddings = torch.randn(vertices, channels, generator=generator, dtype=dtype)
    ids = torch.randint(0, vertices, (points, 8), generator=generator, dtype=torch.int32)
    ids[::5, 3] = -1
    return embeddings, ids, torch.rand(points, 3, generator=generator, dtype=dtype)


def _bilinear(generator, dtype, points=300, channels=32):
    """Arguments of bilinear_interpolate; a third of the points lie outside."""
    texels = torch.randn(6, 9, channels, generator=generator, dtype=dtype)
    size = torch.tensor([8.0, 5.0], dtype=dtype)
    return texels, torch.rand(points, 2, generator=generator, dtype=dtype) * (size + 2) - 1


def _tri_plane(generator, dtype, points=300, channels=32):
    """Arguments of tri_plane_interpolate; some points lie outside of some planes."""
    texels = torch.randn(ROWS, channels, generator=generator, dtype=dtype)
    low, size = torch.tensor([-4.0, 1.0, -2.0], dtype=dtype), torch.tensor([9.0, 7.0, 6.0], dtype=dtype)
    return texels, (torch.rand(points, 3, generator=generator, dtype=dtype) * size + low) * CELL, CELL, LAYOUT


CASES = {
    "trilinear_interpolate": (_trilinear, (0, 2)),
    "bilinear_interpolate": (_bilinear, (0, 1)),
    "tri_plane_interpolate": (_tri_plane, (0, 1)),
}
each_op = pytest.mark.parametrize("name", CASES)


def _arguments(name, device, dtype, generator, **sizes):
    """Leaf tensors on the device, and which of them are differentiable."""
    make, differentiable = CASES[name]
    arguments = [a.to(device) if isinstance(a, torch.Tensor) else a for a in make(generator, dtype, **sizes)]
    for i in differentiable:
        arguments[i].requires_grad_()
    return arguments, differentiable


def _value_and_gradients(function, arguments, differentiable, weight):
    value = function(*arguments)
    return value, *torch.autograd.grad((value * weight).sum(), [arguments[i] for i in differentiable])


@each_op
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [1, 8, 11, 32])
def test_equals_the_reference(name, dtype, channels, device, generator):
    arguments, differentiable = _arguments(name, device, dtype, generator, channels=channels)
    weight = torch.randn(300, channels, generator=generator, dtype=dtype).to(device)
    got = _value_and_gradients(getattr(ops, name), arguments, differentiable, weight)
    want = _value_and_gradients(getattr(reference.interpolation, name), arguments, differentiable, weight)
    # The gradient by a position in meters is 1 / CELL times larger than the values it comes from.
    tolerance = ORDER_TOLERANCE if dtype == torch.float32 else dict(rtol=1e-10, atol=1e-10)
    for g, w in zip(got, want, strict=True):
        torch.testing.assert_close(g, w, rtol=tolerance["rtol"], atol=tolerance["atol"] * max(1, w.abs().max().item()))


@each_op
def test_gradcheck(name, device, generator):
    arguments, _ = _arguments(name, device, torch.float64, generator, points=12, channels=3)
    torch.autograd.gradcheck(getattr(ops, name), arguments, eps=1e-7, atol=1e-6, nondet_tol=0)


@each_op
def test_opcheck(name, device, generator):
    arguments, _ = _arguments(name, device, torch.float32, generator, points=9)
    torch.library.opcheck(getattr(torch.ops.spslam, name).default, arguments, test_utils=OPCHECKS)


@each_op
@pytest.mark.parametrize("wanted", [(True, True), (True, False), (False, True)])
def test_opcheck_backward(name, wanted, device, generator):
    arguments, _ = _arguments(name, device, torch.float32, generator, points=9)
    grad = getattr(ops, name)(*arguments).detach()
    arguments = [a.detach() if isinstance(a, torch.Tensor) else a for a in arguments]
    op = getattr(torch.ops.spslam, f"{name}_backward").default
    torch.library.opcheck(op, (grad, *arguments, *wanted), test_utils=OPCHECKS)


@each_op
def test_gradient_of_one_argument_alone(name, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float64, generator)
    both = torch.autograd.grad(getattr(ops, name)(*arguments).sum(), [arguments[i] for i in differentiable])
    for i, want in zip(differentiable, both, strict=True):
        alone = [a.detach() if isinstance(a, torch.Tensor) and j != i else a for j, a in enumerate(arguments)]
        (got,) = torch.autograd.grad(getattr(ops, name)(*alone).sum(), [alone[i]])
        assert torch.equal(got, want)


@each_op
def test_gradgradcheck(name, device, generator):
    arguments, _ = _arguments(name, device, torch.float64, generator, points=8, channels=2)
    torch.autograd.gradgradcheck(getattr(ops, name), arguments, eps=1e-7, atol=1e-4)


@each_op
def test_gradient_of_an_eikonal_loss_equals_the_reference(name, device, generator):
    """The gradient by the table of a loss on the gradient by coordinates, and a product with its Hessian."""
    arguments, differentiable = _arguments(name, device, torch.float64, generator, channels=8)
    table, coords = (arguments[i] for i in differentiable)
    results = []
    for function in (getattr(ops, name), getattr(reference.interpolation, name)):
        (slope,) = torch.autograd.grad(function(*arguments).sin().sum(), [coords], create_graph=True)
        loss = (slope.square().sum(1) - 1).square().mean()
        first = torch.autograd.grad(loss, [table, coords], create_graph=True)
        product = torch.autograd.grad(first[0].square().sum(), [table])
        results.append([*first, *product])
    for g, w in zip(*results, strict=True):
        torch.testing.assert_close(g, w, rtol=1e-8, atol=1e-8 * w.abs().max().item())


@each_op
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_smaller_tables_are_read_in_float32(name, dtype, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float32, generator)
    table = differentiable[0]
    arguments[table] = arguments[table].detach().to(dtype).requires_grad_()
    value = getattr(ops, name)(*arguments)
    want = getattr(ops, name)(*(a.float() if i == table else a for i, a in enumerate(arguments)))
    assert value.dtype == torch.float32
    assert torch.equal(value, want)
    (grad,) = torch.autograd.grad(value.sum(), [arguments[table]])
    assert grad.dtype == dtype
    assert grad.abs().sum() > 0


@each_op
def test_leading_axes(name, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float32, generator, points=24)
    want = getattr(ops, name)(*arguments)
    rows = {1, 2} if name == "trilinear_interpolate" else {1}
    got = getattr(ops, name)(*(a.unflatten(0, (2, 3, 4)) if i in rows else a for i, a in enumerate(arguments)))
    assert torch.equal(got, want.unflatten(0, (2, 3, 4)))


def test_ids_of_64_bits(device, generator):
    embeddings, ids, local = (a.to(device) for a in _trilinear(generator, torch.float32))
    want = ops.trilinear_interpolate(embeddings, ids, local)
    assert torch.equal(ops.trilinear_interpolate(embeddings, ids.long(), local), want)
    far = ids.long()
    far[:, 0] += 2**32  # the same number in 32 bits
    assert not ops.trilinear_interpolate(embeddings, far, local).any()


def test_an_image_of_channels_first_is_refused():
    for shape in ((3, 48, 640), (1, 240, 320), (4, 480, 640)):
        with pytest.raises(ValueError, match=r"bilinear_interpolate: texels must be \[H, W, C\]: permute\(1, 2, 0\)"):
            ops.bilinear_interpolate(torch.zeros(shape), torch.zeros(2, 2))
    for shape in ((3, 640, 32), (1, 256, 64), (5, 48, 640)):
        ops.bilinear_interpolate(torch.zeros(shape), torch.zeros(2, 2))


@each_op
def test_compiles_without_a_graph_break(name, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float32, generator)
    compiled = torch.compile(getattr(ops, name), backend="aot_eager", fullgraph=True)
    weight = torch.ones_like(getattr(ops, name)(*arguments))
    got = _value_and_gradients(compiled, arguments, differentiable, weight)
    want = _value_and_gradients(getattr(ops, name), arguments, differentiable, weight)
    assert all(torch.equal(g, w) for g, w in zip(got, want, strict=True))


@each_op
def test_empty(name, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float32, generator, points=0, channels=8)
    value, *grads = _value_and_gradients(getattr(ops, name), arguments, differentiable, 1.0)
    assert value.shape == (0, 8)
    assert all(torch.equal(g, torch.zeros_like(arguments[i])) for g, i in zip(grads, differentiable, strict=True))


@each_op
def test_non_contiguous(name, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float32, generator)
    strided = list(arguments)
    for i in differentiable:
        strided[i] = arguments[i].detach().transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
        assert not strided[i].is_contiguous()
    value = getattr(ops, name)(*arguments)
    weight = torch.randn(value.T.shape, generator=generator).to(device).T
    got = _value_and_gradients(getattr(ops, name), strided, differentiable, weight)
    want = _value_and_gradients(getattr(ops, name), arguments, differentiable, weight)
    assert all(torch.equal(g, w) for g, w in zip(got, want, strict=True))


@each_op
@pytest.mark.parametrize("channels", [8, 32, 37])
def test_same_bits_for_any_number_of_threads(name, channels, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float32, generator, points=20_000, channels=channels)
    weight = torch.randn(20_000, channels, generator=generator).to(device)
    assert_same_for_any_threads(
        lambda: _value_and_gradients(getattr(ops, name), arguments, differentiable, weight), (1, 2, 7)
    )


def test_many_points_in_few_rows_and_few_points_in_many_rows(device, generator):
    for vertices, points in ((3, 300_000), (70_000, 1000)):
        arguments = [a.to(device) for a in _trilinear(generator, torch.float64, points, vertices, 2)]
        arguments[0].requires_grad_()
        (got,) = torch.autograd.grad(ops.trilinear_interpolate(*arguments).sum(), arguments[:1])
        (want,) = torch.autograd.grad(reference.interpolation.trilinear_interpolate(*arguments).sum(), arguments[:1])
        torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-9)


@each_op
@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_gradient_of_any_magnitude(name, scale, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float32, generator)
    grads = [
        torch.autograd.grad(getattr(ops, name)(*arguments).sum() * s, [arguments[differentiable[0]]])[0]
        for s in (1.0, scale)
    ]
    torch.testing.assert_close(grads[1].double() / scale, grads[0].double(), rtol=1e-5, atol=1e-6)


@each_op
def test_nan_is_seen(name, device, generator):
    arguments, differentiable = _arguments(name, device, torch.float32, generator)
    table, coords = (arguments[i] for i in differentiable)
    with torch.no_grad():
        coords[1] = float("nan")
    value = getattr(ops, name)(*arguments)
    assert value[1].isnan().all()
    assert value[2:].isfinite().all()
    grad = torch.ones_like(value)
    grad[2] = float("nan")
    (grad_table,) = torch.autograd.grad(value, [table], grad)
    assert grad_table.isnan().any()


def test_points_without_all_corners_get_nothing(device, generator):
    embeddings, ids, local = (a.to(device) for a in _trilinear(generator, torch.float64))
    ids[1, 7] = len(embeddings)  # out of range above counts as missing, too
    embeddings.requires_grad_()
    local.requires_grad_()
    value = ops.trilinear_interpolate(embeddings, ids, local)
    missing = [0, 1, *range(5, 300, 5)]
    assert not value[missing].any()
    grad_embeddings, grad_local = torch.autograd.grad(value[missing].sum(), [embeddings, local])
    assert not grad_embeddings.any()
    assert not grad_local.any()


def test_a_gradient_that_is_no_number_stays_with_the_point_that_has_no_value(device, generator):
    embeddings, ids, local = (a.to(device) for a in _trilinear(generator, torch.float32, points=300_000))
    ids[0, 7] = -1
    embeddings.requires_grad_()
    value = ops.trilinear_interpolate(embeddings, ids, local)
    grad = torch.ones_like(value)
    expected = torch.autograd.grad(value, embeddings, grad, retain_graph=True)[0]
    grad[0] = float("nan")
    assert torch.equal(torch.autograd.grad(value, embeddings, grad)[0], expected)


def test_volume_without_vertices(device):
    ids = torch.full((3, 8), -1, dtype=torch.int32, device=device)
    value = ops.trilinear_interpolate(torch.empty(0, 8, device=device), ids, torch.zeros(3, 3, device=device))
    assert torch.equal(value, torch.zeros(3, 8, device=device))


def test_images_of_one_row_and_planes_of_one_texel(device, generator):
    row = torch.randn(1, 5, 2, generator=generator).to(device)
    uv = torch.tensor([[1.5, 0.7], [-1.0, 3.0]], device=device)
    torch.testing.assert_close(ops.bilinear_interpolate(row, uv), torch.stack([(row[0, 1] + row[0, 2]) / 2, row[0, 0]]))
    texels = torch.randn(3, 2, generator=generator).to(device)
    layout = [0, 0, 0, 1, 1, 1, 5, 5, 1, 1, 2, -5, 0, 1, 1]
    got = ops.tri_plane_interpolate(texels, torch.randn(4, 3, generator=generator).to(device), CELL, layout)
    torch.testing.assert_close(got, texels.sum(0).expand(4, 2))


def test_planes_without_texels_are_zero(device):
    texels = torch.ones(4, 2, device=device, requires_grad=True)
    layout = [0, 0, 0, 2, 2] + 2 * [4, 0, 0, 0, 0]
    points = torch.zeros(3, 3, device=device, requires_grad=True)
    value = ops.tri_plane_interpolate(texels, points, CELL, layout)
    grads = torch.autograd.grad(value.sum(), [texels, points])
    assert not any(t.any() for t in (value, *grads))


def test_clamped_positions_have_no_gradient(device):
    texels = torch.arange(12.0, device=device).view(3, 4, 1)
    uv = torch.tensor([[-0.5, 1.5], [1.5, 7.0], [3.0, 0.0], [1.5, 1.5]], device=device, requires_grad=True)
    (grad,) = torch.autograd.grad(ops.bilinear_interpolate(texels, uv).sum(), [uv])
    assert torch.equal(grad, torch.tensor([[0.0, 4.0], [1.0, 0.0], [0.0, 0.0], [1.0, 4.0]], device=device))


def _call(name, change):
    """Calls an op with one argument replaced: change = {index: new value or function of the old one}."""
    arguments, _ = _arguments(name, "cpu", torch.float32, torch.Generator().manual_seed(0), points=4)
    for index, new in change.items():
        arguments[index] = new(arguments[index]) if callable(new) else new
    return getattr(ops, name)(*arguments)


TRILINEAR, BILINEAR, PLANES = CASES


@pytest.mark.parametrize(
    ("name", "change", "error", "message"),
    [
        (TRILINEAR, {0: [1.0]}, TypeError, "embeddings must be a torch.Tensor, got list"),
        (
            TRILINEAR,
            {0: lambda t: t.int()},
            TypeError,
            "embeddings must be float32 or float64 or float16 or bfloat16, got int32",
        ),
        (TRILINEAR, {0: lambda t: t[0]}, ValueError, r"embeddings must have shape \[V, C\], got \[8\]"),
        (TRILINEAR, {1: lambda t: t.float()}, TypeError, "corner_ids must be int32 or int64, got float32"),
        (TRILINEAR, {1: lambda t: t[:, :7]}, ValueError, r"corner_ids must have shape \[N, 8\], got \[4, 7\]"),
        (TRILINEAR, {2: lambda t: t[:3]}, ValueError, r"local_coords must have shape \[4, 3\], got \[3, 3\]"),
        (TRILINEAR, {2: lambda t: t.double()}, TypeError, "local_coords must be float32, got float64"),
        (TRILINEAR, {2: lambda t: t.to("meta")}, ValueError, "local_coords must be on cpu, got meta"),
        (BILINEAR, {0: lambda t: t[0]}, ValueError, r"texels must have shape \[H, W, C\], got \[9, 32\]"),
        (BILINEAR, {0: lambda t: t[:, :0]}, ValueError, r"texels must have at least one texel, got \[6, 0, 32\]"),
        (BILINEAR, {1: lambda t: t[:, :1]}, ValueError, r"uv must have shape \[N, 2\], got \[4, 1\]"),
        (BILINEAR, {1: lambda t: t.int()}, TypeError, "uv must be float32, got int32"),
        (PLANES, {0: lambda t: t[None]}, ValueError, r"texels must have shape \[P, C\], got \[1, 83, 32\]"),
        (PLANES, {1: lambda t: t.T}, ValueError, r"points must have shape \[N, 3\], got \[3, 4\]"),
        (PLANES, {2: 0.0}, ValueError, "cell_size must be positive, got 0.0"),
        (PLANES, {3: [0] * 14}, ValueError, "layout must have 15 numbers, got 14"),
        (PLANES, {0: lambda t: t[:82]}, ValueError, r"layout must lie within the 82 texels, got \[63, 2, -1, 5, 4\]"),
        (PLANES, {3: [-1] + LAYOUT[1:]}, ValueError, r"layout must lie within the 83 texels, got \[-1, "),
    ],
)
def test_wrong_argument_is_named(name, change, error, message):
    with pytest.raises(error, match=f"{name}: {message}"):
        _call(name, change)


def test_docstring_examples_run():
    import doctest

    import spslam.ops.interpolation as module

    assert doctest.testmod(module, extraglobs={"torch": torch}).failed == 0
