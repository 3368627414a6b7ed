"""Rendering weights, rendered rays and losses against the equations, with gradients and checks."""

import pytest
import torch

from spslam import ops
from tests import reference
from tests.ops.threads import assert_same_for_any_threads

TRUNCATION = 0.08
DTYPES = [torch.float32, torch.float64]
OPCHECKS = ("test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic")
# The kernels' exponential is within 2 ulp, and sums run over 43 samples and some hundred rays.
TOLERANCE = {torch.float32: dict(rtol=2e-5, atol=1e-5), torch.float64: dict(rtol=1e-11, atol=1e-11)}


def _samples(generator, dtype, rays=200, samples=43):
    """sdf, color, t, valid of rays through a noisy surface near 2 m; some rays miss the volume or see no surface."""
    t = (torch.rand(rays, samples, generator=generator, dtype=dtype) * 2.5).sort(1).values
    noise = torch.randn(rays, samples, generator=generator, dtype=dtype)
    sdf = ((2 - t) / TRUNCATION * 0.3 + 0.2 * noise).clamp(-1, 1)
    sdf[::9] = sdf[::9].abs() + 0.05  # nothing crossed
    sdf[::11] = 1.0  # every bell is below the floor
    valid = torch.rand(rays, samples, generator=generator) < 0.8
    valid[::7] = False
    return sdf, torch.rand(rays, samples, 3, generator=generator, dtype=dtype), t, valid


def _render_arguments(generator, dtype, device, **sizes):
    """Arguments of volume_render, and which are differentiable."""
    sdf, color, t, valid = (a.to(device) for a in _samples(generator, dtype, **sizes))
    return [sdf.requires_grad_(), color.requires_grad_(), t.requires_grad_(), valid, TRUNCATION], (0, 1, 2)


def _loss_arguments(generator, dtype, device, rays=200, samples=43, cosine_targets=True):
    """Arguments of rendering_losses, and which are differentiable."""
    sdf, _, t, valid = _samples(generator, dtype, rays, samples)
    uniform = torch.rand(rays, 8, generator=generator, dtype=dtype)
    depth, target_depth, cosine = 1.9 + 0.2 * uniform[:, 0], 1.9 + 0.2 * uniform[:, 1], 1.25 * uniform[:, 2]
    cosine[::3] = 0
    target_depth[::13] = 0
    rendered = torch.rand(rays, generator=generator) < 0.7
    arguments = [uniform[:, 3:6], depth, sdf, t, valid, rendered, uniform[:, 5:8], target_depth, cosine]
    arguments = [a.to(device).contiguous() for a in arguments]
    for i in range(4):
        arguments[i].requires_grad_()
    return [*arguments, TRUNCATION, cosine_targets], (0, 1, 2, 3)


CASES = {"volume_render": _render_arguments, "rendering_losses": _loss_arguments}
each_op = pytest.mark.parametrize("name", CASES)


def _outputs(function, arguments):
    out = function(*arguments)
    return out if isinstance(out, tuple) else (out,)


def _values_and_gradients(function, arguments, differentiable, generator):
    outputs = _outputs(function, arguments)
    generator.manual_seed(7)
    weights = [torch.randn(o.shape, generator=generator, dtype=o.dtype).to(o.device) for o in outputs]
    objective = sum((o * w).sum() for o, w in zip(outputs, weights, strict=True))
    return *outputs, *torch.autograd.grad(objective, [arguments[i] for i in differentiable])


def _assert_equals_reference(name, arguments, differentiable, generator):
    got = _values_and_gradients(getattr(ops, name), arguments, differentiable, generator)
    function = getattr(reference.volume_rendering, name)
    want = _values_and_gradients(function, arguments, differentiable, generator)
    tolerance = TOLERANCE[arguments[0].dtype]
    for g, w in zip(got, want, strict=True):
        scale = max(1.0, w.detach().abs().max().item()) if w.numel() else 1.0
        torch.testing.assert_close(g, w, rtol=tolerance["rtol"], atol=tolerance["atol"] * scale)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("samples", [1, 16, 43])
def test_volume_render_equals_the_reference(dtype, samples, device, generator):
    _assert_equals_reference("volume_render", *_render_arguments(generator, dtype, device, samples=samples), generator)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("cosine_targets", [False, True])
def test_rendering_losses_equal_the_reference(dtype, cosine_targets, device, generator):
    arguments = _loss_arguments(generator, dtype, device, cosine_targets=cosine_targets)
    _assert_equals_reference("rendering_losses", *arguments, generator)


def test_weights_of_a_hand_made_ray(device):
    t = torch.tensor([[0.90, 0.95, 1.00, 1.02, 1.099, 1.101, 1.2]], device=device)
    sdf = torch.tensor([[1.0, 0.5, 0.1, -0.1, -0.2, -0.2, 0.1]], device=device)
    valid = torch.tensor([[True, True, True, True, True, True, True]], device=device)
    color = torch.ones(1, 7, 3, device=device)
    _, depth, weights = ops.volume_render(sdf, color, t, valid, TRUNCATION)
    # 1.0 is below the floor; 1.101 and 1.2 lie behind the crossing at 1.02 plus the truncation.
    assert (weights[0] > 0).tolist() == [False, True, True, True, True, False, False]
    bells = [1 / (2 + 2 * torch.cosh(torch.tensor(s / TRUNCATION)).item()) for s in (0.5, 0.1, -0.1, -0.2)]
    torch.testing.assert_close(weights[0, 1:5].cpu(), torch.tensor(bells) / sum(bells))
    assert 0.95 < depth.item() < 1.099
    valid[0, 3] = False  # an invalid sample neither renders nor crosses: the crossing moves to 1.099
    assert (ops.volume_render(sdf, color, t, valid, TRUNCATION)[2][0] > 0).tolist() == [
        False, True, True, False, True, True, False,
    ]  # fmt: skip


def test_the_order_of_the_samples_does_not_matter(device, generator):
    sdf, color, t, valid = (a.to(device) for a in _samples(generator, torch.float64))
    order = torch.randperm(43, generator=generator).to(device)
    shuffled = ops.volume_render(sdf[:, order], color[:, order], t[:, order], valid[:, order], TRUNCATION)
    straight = ops.volume_render(sdf, color, t, valid, TRUNCATION)
    torch.testing.assert_close(shuffled[0], straight[0])
    torch.testing.assert_close(shuffled[1], straight[1])
    torch.testing.assert_close(shuffled[2], straight[2][:, order])


def test_rays_that_meet_nothing_render_zeros_and_get_no_gradient(device, generator):
    arguments, differentiable = _render_arguments(generator, torch.float32, device)
    color, depth, weights = ops.volume_render(*arguments)
    assert torch.equal(weights.sum(1) > 0, depth > 0)
    empty = depth == 0
    assert empty[::7].all()
    assert empty[::11].all()
    assert not color[empty].any()
    gradients = torch.autograd.grad(color.sum() + depth.sum(), [arguments[i] for i in differentiable])
    assert not any(g[empty].any() for g in gradients)


def test_rays_without_measurement_add_nothing(device, generator):
    arguments, differentiable = _loss_arguments(generator, torch.float64, device)
    arguments[7].fill_(0)
    losses = ops.rendering_losses(*arguments)
    assert not losses.any()
    gradients = torch.autograd.grad(losses.sum(), [arguments[i] for i in differentiable])
    assert not any(g.any() for g in gradients)


@each_op
def test_gradcheck(name, device, generator):
    arguments, _ = CASES[name](generator, torch.float64, device, rays=15, samples=6)
    torch.autograd.gradcheck(getattr(ops, name), arguments, eps=1e-8, atol=2e-5, nondet_tol=0)


@pytest.mark.parametrize("output", [0, 1, 2])
def test_gradient_of_one_output_alone(output, device, generator):
    arguments, differentiable = _render_arguments(generator, torch.float64, device)
    leaves = [arguments[i] for i in differentiable]
    for function in (ops.volume_render, reference.volume_rendering.volume_render):
        value = function(*arguments)[output]
        weight = torch.linspace(-1, 1, value.numel(), dtype=value.dtype, device=device).view(value.shape)
        gradients = torch.autograd.grad((value * weight).sum(), leaves, allow_unused=True)
        gradients = [torch.zeros_like(leaf) if g is None else g for g, leaf in zip(gradients, leaves, strict=True)]
        if function is ops.volume_render:
            got = gradients
    for g, w in zip(got, gradients, strict=True):
        torch.testing.assert_close(g, w, rtol=1e-11, atol=1e-11)


@each_op
def test_opcheck(name, device, generator):
    arguments, _ = CASES[name](generator, torch.float32, device, rays=9, samples=5)
    torch.library.opcheck(getattr(torch.ops.spslam, name).default, arguments, test_utils=OPCHECKS)


@each_op
def test_opcheck_backward(name, device, generator):
    arguments, _ = CASES[name](generator, torch.float32, device, rays=9, samples=5)
    arguments = [a.detach() if isinstance(a, torch.Tensor) else a for a in arguments]
    outputs = _outputs(getattr(ops, name), arguments)
    *tensors, truncation = arguments
    if name == "volume_render":
        variants = [(outputs[0], outputs[1], grad, *tensors, outputs[2], truncation) for grad in (None, outputs[2])]
    else:
        variants = [(outputs[0], *arguments)]
    for variant in variants:
        op = getattr(torch.ops.spslam, f"{name}_backward").default
        torch.library.opcheck(op, variant, test_utils=OPCHECKS)


@each_op
def test_second_derivatives_are_refused(name, device, generator):
    arguments, differentiable = CASES[name](generator, torch.float64, device)
    value = sum(o.square().sum() for o in _outputs(getattr(ops, name), arguments))
    (first,) = torch.autograd.grad(value, [arguments[differentiable[0]]], create_graph=True)
    with pytest.raises(NotImplementedError, match=f"{name}: second derivatives are not supported"):
        first.sum().backward()


@each_op
def test_compiles_without_a_graph_break(name, device, generator):
    arguments, differentiable = CASES[name](generator, torch.float32, device)
    compiled = torch.compile(getattr(ops, name), backend="aot_eager", fullgraph=True)
    got = _values_and_gradients(compiled, arguments, differentiable, generator)
    want = _values_and_gradients(getattr(ops, name), arguments, differentiable, generator)
    assert all(torch.equal(g, w) for g, w in zip(got, want, strict=True))


@each_op
@pytest.mark.parametrize(("rays", "samples"), [(0, 43), (5, 0)])
def test_empty(name, rays, samples, device, generator):
    arguments, differentiable = CASES[name](generator, torch.float32, device, rays=rays, samples=samples)
    if name == "rendering_losses":
        arguments[5].fill_(False)
    values = _values_and_gradients(getattr(ops, name), arguments, differentiable, generator)
    assert not any(v.any() for v in values)
    if name == "volume_render":
        assert [list(v.shape) for v in values[:3]] == [[rays, 3], [rays], [rays, samples]]


@each_op
def test_non_contiguous(name, device, generator):
    arguments, differentiable = CASES[name](generator, torch.float32, device)
    strided = []
    for a in arguments:
        if isinstance(a, torch.Tensor):
            padded = torch.stack([a.detach(), a.detach()], -1)[..., 0]
            assert not padded.is_contiguous()
            strided.append(padded.requires_grad_(a.requires_grad))
        else:
            strided.append(a)
    got = _values_and_gradients(getattr(ops, name), strided, differentiable, generator)
    want = _values_and_gradients(getattr(ops, name), arguments, differentiable, generator)
    assert all(torch.equal(g, w) for g, w in zip(got, want, strict=True))


@each_op
def test_same_bits_for_any_number_of_threads(name, device, generator):
    arguments, differentiable = CASES[name](generator, torch.float32, device, rays=3000)
    assert_same_for_any_threads(
        lambda: _values_and_gradients(getattr(ops, name), arguments, differentiable, generator), (1, 2, 7)
    )


def test_nan_is_seen(device, generator):
    arguments, _ = _render_arguments(generator, torch.float32, device)
    ray = int((ops.volume_render(*arguments)[1] > 0).nonzero()[0])
    sample = int(arguments[3][ray].nonzero()[0])
    with torch.no_grad():
        arguments[0][ray, sample] = float("nan")
    color, depth, _ = ops.volume_render(*arguments)
    assert depth[ray].isnan()
    assert color[ray].isnan().all()
    assert depth.isnan().sum() == 1
    arguments, _ = _loss_arguments(generator, torch.float32, device)
    with torch.no_grad():
        arguments[2].fill_(float("nan"))
    assert ops.rendering_losses(*arguments)[2:].isnan().all()


RENDER, LOSSES = CASES


@pytest.mark.parametrize(
    ("name", "index", "change", "error", "message"),
    [
        (RENDER, 0, lambda t: t[0], ValueError, r"sdf must have shape \[R, S\], got \[5\]"),
        (RENDER, 0, lambda t: t.half(), TypeError, "sdf must be float32 or float64, got float16"),
        (RENDER, 1, lambda t: t[:, :2], ValueError, r"color must have shape \[9, 5, C\], got \[9, 2, 3\]"),
        (RENDER, 1, lambda t: t.double(), TypeError, "color must be float32, got float64"),
        (RENDER, 2, lambda t: t[:, 1:], ValueError, r"t must have shape \[9, 5\], got \[9, 4\]"),
        (RENDER, 2, lambda t: t.to("meta"), ValueError, "t must be on cpu, got meta"),
        (RENDER, 3, lambda t: t.int(), TypeError, "valid must be bool, got int32"),
        (RENDER, 4, lambda t: 0.0, ValueError, "truncation must be positive, got 0.0"),
        (LOSSES, 0, lambda t: t[:, :2], ValueError, r"color must have shape \[9, 3\], got \[9, 2\]"),
        (LOSSES, 1, lambda t: t[1:], ValueError, r"depth must have shape \[9\], got \[8\]"),
        (LOSSES, 2, lambda t: t.int(), TypeError, "sdf must be float32 or float64, got int32"),
        (LOSSES, 3, lambda t: t.double(), TypeError, "t must be float32, got float64"),
        (LOSSES, 4, lambda t: t.float(), TypeError, "valid must be bool, got float32"),
        (LOSSES, 5, lambda t: t[:, None], ValueError, r"rendered must have shape \[9\], got \[9, 1\]"),
        (LOSSES, 6, lambda t: t.T, ValueError, r"target_color must have shape \[9, 3\], got \[3, 9\]"),
        (LOSSES, 7, lambda t: None, TypeError, "target_depth must be a torch.Tensor, got NoneType"),
        (LOSSES, 8, lambda t: t.to("meta"), ValueError, "cosine must be on cpu, got meta"),
        (LOSSES, 9, lambda t: -0.1, ValueError, "truncation must be positive, got -0.1"),
    ],
)
def test_wrong_argument_is_named(name, index, change, error, message):
    arguments, _ = CASES[name](torch.Generator().manual_seed(0), torch.float32, "cpu", rays=9, samples=5)
    arguments[index] = change(arguments[index])
    with pytest.raises(error, match=f"{name}: {message}"):
        getattr(ops, name)(*arguments)


def test_docstring_examples_run():
    import doctest

    import spslam.ops.volume_rendering as module

    assert doctest.testmod(module, extraglobs={"torch": torch}).failed == 0
