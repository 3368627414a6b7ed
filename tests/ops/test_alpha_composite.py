"""Compositing of rays against explicit products and sums, with gradients, packed rays and densities."""

import pytest
import torch

from spslam import ops
from tests import reference
from tests.ops.threads import assert_same_for_any_threads

DTYPES = [torch.float32, torch.float64]
OPCHECKS = ("test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic")
# float32: sums and products over up to 70 samples, in another order than the reference's.
TOLERANCE = {torch.float32: dict(rtol=3e-5, atol=3e-5), torch.float64: dict(rtol=1e-10, atol=1e-11)}
# More than a warp, and not a multiple of one.
RAYS, SAMPLES = 9, 70
DENSITY = pytest.mark.parametrize("density", [False, True])


def dense(generator, dtype, device, channels=3, density=False, rays=RAYS, samples=SAMPLES):
    """opacities, values, t, lengths; some alphas are exactly 0 and 1."""
    alpha = 0.1 * torch.rand(rays, samples, generator=generator, dtype=dtype)
    if density:
        alpha = 30 * alpha
    elif rays > 2 and samples > 8:
        alpha[1, 5], alpha[2, 7], alpha[2, 8] = 1.0, 0.0, 1.0
    t = torch.rand(rays, samples, generator=generator, dtype=dtype).sort(1).values
    values = torch.randn(rays, samples, channels, generator=generator, dtype=dtype)
    lengths = 0.02 * torch.rand(rays, samples, generator=generator, dtype=dtype) if density else None
    parts = (alpha, values, t, lengths)
    return [None if part is None else part.to(device).requires_grad_() for part in parts]


def packed(generator, dtype, device, **options):
    """The same as a list of samples; rays of 0 to 70 samples, and some samples of no ray."""
    opacities, values, t, lengths = dense(generator, dtype, device, rays=4, **options)
    flat = [None if p is None else p.detach().flatten(0, 1).requires_grad_() for p in (opacities, values, t, lengths)]
    spans = torch.tensor([[150, 70], [0, 1], [3, 0], [10, 33], [50, 64]], device=device)
    return flat, spans


def check(function, arguments, generator, **options):
    """Values and gradients of a random objective of all outputs equal the reference's."""
    results = []
    for one in (function, reference.alpha_composite.alpha_composite):
        generator.manual_seed(3)
        out = one(*arguments, **options)
        weights = [torch.randn(o.shape, generator=generator, dtype=o.dtype).to(o.device) for o in out]
        leaves = [a for a in arguments if a is not None and a.requires_grad]
        objective = sum((o * w).sum() for o, w in zip(out, weights, strict=True))
        results.append([*out, *torch.autograd.grad(objective, leaves)])
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want, **TOLERANCE[arguments[0].dtype])


@DENSITY
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [0, 1, 3, 5, 40])
def test_equals_the_reference(dtype, channels, density, device, generator):
    check(ops.alpha_composite, dense(generator, dtype, device, channels, density), generator)


@DENSITY
@pytest.mark.parametrize("dtype", DTYPES)
def test_packed_rays_equal_the_reference(dtype, density, device, generator):
    arguments, spans = packed(generator, dtype, device, density=density)
    for info in (spans, spans.int()):
        check(ops.alpha_composite, arguments, generator, packed_info=info)


def test_packed_rays_are_dense_rays(device, generator):
    arguments = dense(generator, torch.float32, device, density=True)
    rays = torch.arange(RAYS, device=device)
    spans = torch.stack([rays * SAMPLES, torch.full_like(rays, SAMPLES)], 1)
    want = ops.alpha_composite(*arguments)
    got = ops.alpha_composite(*(a.flatten(0, 1) for a in arguments), packed_info=spans)
    assert all(torch.equal(g, w.view(g.shape)) for g, w in zip(got, want, strict=True))


@pytest.mark.parametrize("stop", [1e-3, 0.3, 1.0])
def test_stop_at_a_transmittance(stop, device, generator):
    arguments = dense(generator, torch.float64, device)
    check(ops.alpha_composite, arguments, generator, stop=stop)
    flat, spans = packed(generator, torch.float64, device)
    check(ops.alpha_composite, flat, generator, packed_info=spans, stop=stop)


def test_stopped_samples_get_no_gradient(device):
    alpha = torch.tensor([[0.5, 0.5, 0.5, 0.5]], device=device, requires_grad=True)
    values = torch.ones(1, 4, 2, device=device, requires_grad=True)
    out = ops.alpha_composite(alpha, values, torch.ones(1, 4, device=device), stop=0.25)
    assert out.weights.tolist() == [[0.5, 0.25, 0.125, 0.0]]
    grads = torch.autograd.grad(out.values.sum() + out.opacity.sum(), [alpha, values])
    assert (grads[0][0, 3], grads[1][0, 3].sum()) == (0, 0)
    assert (grads[0][0, :3] > 0).all()


@DENSITY
def test_gradcheck(density, device, generator):
    arguments = dense(generator, torch.float64, device, 2, density, rays=3, samples=9)
    torch.autograd.gradcheck(lambda *a: tuple(ops.alpha_composite(*a)), arguments, nondet_tol=0)


@pytest.mark.parametrize("output", range(4))
def test_gradient_of_one_output_alone(output, device, generator):
    arguments = dense(generator, torch.float64, device, density=True)
    pair = [
        torch.autograd.grad(function(*arguments)[output].sum(), arguments, materialize_grads=True, allow_unused=True)
        for function in (ops.alpha_composite, reference.alpha_composite.alpha_composite)
    ]
    for got, want in zip(*pair, strict=True):
        torch.testing.assert_close(got, want)


def test_second_derivatives_are_refused(device, generator):
    arguments = dense(generator, torch.float64, device)[:3]
    (first,) = torch.autograd.grad(
        ops.alpha_composite(*arguments).depth.square().sum(), arguments[:1], create_graph=True
    )
    with pytest.raises(NotImplementedError, match="alpha_composite: second derivatives are not supported"):
        first.sum().backward()


@DENSITY
def test_opcheck(density, device, generator):
    opacities, values, t, lengths = dense(generator, torch.float32, device, density=density)
    op = torch.ops.spslam.alpha_composite.default
    torch.library.opcheck(op, (opacities, lengths, values, t, None, 0.1), test_utils=OPCHECKS)
    (opacities, values, t, lengths), spans = packed(generator, torch.float32, device, density=density)
    torch.library.opcheck(op, (opacities, lengths, values, t, spans, 0.1), test_utils=OPCHECKS)
    parts = [None if part is None else part.detach() for part in (opacities, lengths, values, t)]
    out = ops.alpha_composite(parts[0], parts[2], parts[3], parts[1], spans)
    for of_weights in (None, out.weights):
        arguments = (*out[:3], of_weights, *parts, spans, out.weights, 0.1)
        torch.library.opcheck(torch.ops.spslam.alpha_composite_backward.default, arguments, test_utils=OPCHECKS)


def test_compiles_and_exports_packed(device, generator):
    (opacities, values, t, lengths), spans = packed(generator, torch.float32, device, density=True)
    want = ops.alpha_composite(opacities, values, t, lengths, spans)
    compiled = torch.compile(ops.alpha_composite, backend="aot_eager", fullgraph=True)
    assert all(torch.equal(g, w) for g, w in zip(compiled(opacities, values, t, lengths, spans), want, strict=True))

    class Renderer(torch.nn.Module):
        def forward(self, *arguments):
            return tuple(ops.alpha_composite(*arguments))

    exported = torch.export.export(Renderer(), (opacities, values, t, lengths, spans))
    got = exported.module()(opacities, values, t, lengths, spans)
    assert all(torch.equal(g, w) for g, w in zip(got, want, strict=True))


def test_gradients_by_torch_func(device, generator):
    """grad, and jacrev, which maps over the backward op."""
    opacities, values, t, _ = dense(generator, torch.float64, device, rays=2, samples=4)

    def depth(opacities):
        return ops.alpha_composite(opacities, values, t).depth

    (want,) = torch.autograd.grad(depth(opacities).sum(), [opacities])
    torch.testing.assert_close(torch.func.grad(lambda a: depth(a).sum())(opacities.detach()), want)
    jacobian = torch.func.jacrev(depth)(opacities.detach())
    torch.testing.assert_close(jacobian.sum(0), want)
    by_ray = torch.vmap(torch.func.grad(lambda a, v, t: ops.alpha_composite(a[None], v[None], t[None]).depth.sum()))
    torch.testing.assert_close(by_ray(opacities.detach(), values.detach(), t.detach()), want)


def test_leading_axes(device, generator):
    arguments = dense(generator, torch.float32, device, rays=6, density=True)
    want = ops.alpha_composite(*arguments)
    got = ops.alpha_composite(*(a.unflatten(0, (2, 3)) for a in arguments))
    assert got.values.shape == (2, 3, 3)
    assert all(torch.equal(g, w.unflatten(0, (2, 3))) for g, w in zip(got, want, strict=True))


@pytest.mark.parametrize(("rays", "samples"), [(0, 5), (5, 0)])
def test_empty(rays, samples, device, generator):
    arguments = dense(generator, torch.float32, device, rays=rays, samples=samples)[:3]
    out = ops.alpha_composite(*arguments)
    assert [list(o.shape) for o in out] == [[rays, 3], [rays], [rays], [rays, samples]]
    grads = torch.autograd.grad(sum(o.sum() for o in out), arguments)
    assert not any(g.any() for g in (*out, *grads))
    none = torch.zeros(0, 2, dtype=torch.int64, device=device)
    out = ops.alpha_composite(*(a.flatten(0, 1) for a in arguments), packed_info=none)
    assert [list(o.shape) for o in out] == [[0, 3], [0], [0], [rays * samples]]


def test_non_contiguous(device, generator):
    arguments = dense(generator, torch.float32, device, density=True)
    strided = [torch.stack([a, a], -1)[..., 0] for a in arguments]
    pair = (ops.alpha_composite(*strided), ops.alpha_composite(*arguments))
    assert all(torch.equal(g, w) for g, w in zip(*pair, strict=True))


def test_same_bits_for_any_number_of_threads(device, generator):
    arguments = dense(generator, torch.float32, device, rays=3000, samples=20, density=True)

    def run():
        out = ops.alpha_composite(*arguments)
        return [*out, *torch.autograd.grad(sum(o.square().sum() for o in out), arguments)]

    assert_same_for_any_threads(run, (1, 2, 7))


def test_nan_is_seen_by_its_own_ray(device, generator):
    for argument in range(4):
        arguments = [a.detach() for a in dense(generator, torch.float32, device, density=True)]
        good = ops.alpha_composite(*arguments)
        arguments[argument][4, 3] = float("nan")
        got = ops.alpha_composite(*arguments, stop=1e-3)
        assert any(part[4].isnan().any() for part in got[:3])
        others = [0, 1, 2, 3, 5, 6, 7, 8]
        assert not any(part[others].isnan().any() for part in got)
        torch.testing.assert_close(got.weights[others], good.weights[others], atol=1e-3, rtol=0)


@pytest.mark.parametrize("span", [[-1, 3], [0, -1], [278, 3], [2**62, 2**62], [281, 0]])
def test_a_span_outside_of_the_samples_is_nan(span, device, generator):
    arguments, spans = packed(generator, torch.float32, device)
    spans[1] = torch.tensor(span)
    out = ops.alpha_composite(*arguments, packed_info=spans)
    assert [part[1].isnan().all().item() for part in out[:3]] == [True] * 3
    assert not any(part[[0, 2, 3, 4]].isnan().any() for part in out[:3])


def test_rays_are_packed_by_their_indices(device, generator):
    indices = torch.tensor([1, 1, 1, 3], device=device)
    assert ops.pack_rays(indices.int(), 5).tolist() == [[0, 0], [0, 3], [3, 0], [3, 1], [4, 0]]
    assert ops.pack_rays(indices[:0], 2).tolist() == [[0, 0], [0, 0]]
    for wrong, rays in (([1, 0], 5), ([0, 5], 5), ([-1, 0], 5)):
        with pytest.raises(ValueError, match=r"pack_rays: ray_indices must ascend within \[0, 4\], got other indices"):
            ops.pack_rays(torch.tensor(wrong, device=device), rays)
    with pytest.raises(TypeError, match="pack_rays: ray_indices must be int32 or int64, got float32"):
        ops.pack_rays(torch.zeros(3, device=device), 2)


def test_densities_of_signed_distance(device, generator):
    sdf = (0.1 * torch.randn(2, 40, generator=generator, dtype=torch.float64)).to(device).requires_grad_()
    scale = torch.tensor(20.0, dtype=torch.float64, device=device, requires_grad=True)
    got, want = ops.neus_alpha(sdf[0], sdf[1], scale), reference.alpha_composite.neus_alpha(sdf[0], sdf[1], scale)
    torch.testing.assert_close(got, want)
    torch.testing.assert_close(
        torch.autograd.grad(got.sum(), [sdf, scale]), torch.autograd.grad(want.sum(), [sdf, scale])
    )
    density = ops.volsdf_density(sdf, 1 / scale)
    torch.testing.assert_close(density, reference.alpha_composite.volsdf_density(sdf, 1 / scale))
    torch.testing.assert_close(ops.volsdf_density(sdf, 0.05), density)
    torch.autograd.gradcheck(ops.volsdf_density, (sdf, scale))
    torch.autograd.gradgradcheck(ops.volsdf_density, (sdf, scale))
    torch.autograd.gradgradcheck(ops.neus_alpha, (sdf[0].detach().requires_grad_(), sdf[1].detach(), scale))


def test_densities_far_from_the_surface_keep_their_precision(device):
    """In float32, where a quotient of two sigmoids is 0 / 0."""
    far = torch.tensor([-5.0, -5.0, 5.0, 0.0], device=device, requires_grad=True)
    back = torch.tensor([-5.01, -4.99, 4.99, -5.0], device=device)
    alpha = ops.neus_alpha(far, back, 200.0)
    torch.testing.assert_close(
        alpha.detach().cpu(), torch.tensor([1 - 2.718281828**-2, 0.0, 0.0, 1.0]), atol=1e-4, rtol=0
    )
    alpha.sum().backward()
    assert far.grad.isfinite().all()
    sdf = torch.tensor([-100.0, 100.0, 0.0], device=device, requires_grad=True)
    density = ops.volsdf_density(sdf, 0.001)
    torch.testing.assert_close(density.detach().cpu(), torch.tensor([1000.0, 0.0, 500.0]))
    density.sum().backward()
    torch.testing.assert_close(sdf.grad.cpu(), torch.tensor([0.0, 0.0, -500000.0]))


@pytest.mark.parametrize("function, argument", [("neus_alpha", "sharpness"), ("volsdf_density", "beta")])
def test_scales_of_densities_are_checked(function, argument):
    sdf = [torch.zeros(3)] * (2 if function == "neus_alpha" else 1)
    for wrong, error, message in (
        (0.0, ValueError, "be positive, got 0.0"),
        ("1", TypeError, "be a float or a torch.Tensor, got str"),
        (torch.ones(1).double(), TypeError, "be float32, got float64"),
    ):
        with pytest.raises(error, match=f"^{function}: {argument} must {message}"):
            getattr(ops, function)(*sdf, wrong)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(opacities=torch.zeros(4)), ValueError, r"opacities must have shape \[R, S\], got \[4\]"),
        (dict(opacities=torch.zeros(2, 5).half()), TypeError, "opacities must be float32 or float64, got float16"),
        (dict(values=torch.zeros(2, 5)), ValueError, r"values must have shape \[2, 5, C\], got \[2, 5\]"),
        (dict(t=torch.zeros(2, 4)), ValueError, r"t must have shape \[2, 5\], got \[2, 4\]"),
        (dict(lengths=torch.zeros(2, 4)), ValueError, r"lengths must have shape \[2, 5\], got \[2, 4\]"),
        (dict(packed_info=torch.zeros(2, 2).long()), ValueError, r"opacities must have shape \[N\], got \[2, 5\]"),
        (dict(stop=1.5), ValueError, r"stop must be in \[0, 1\], got 1.5"),
        (dict(stop=float("nan")), ValueError, r"stop must be in \[0, 1\], got nan"),
    ],
)
def test_wrong_argument_is_named(change, error, message):
    arguments = dict(opacities=torch.zeros(2, 5), values=torch.zeros(2, 5, 3), t=torch.zeros(2, 5))
    with pytest.raises(error, match=f"^alpha_composite: {message}"):
        ops.alpha_composite(**arguments | change)


@pytest.mark.parametrize("channels", [0, 1, 2, 7])
def test_volume_render_with_any_channels(channels, device, generator):
    """Signed distance through a wall, all samples valid; the weights are those of three colors, to the bit."""
    t = torch.rand(20, 43, generator=generator, dtype=torch.float64).sort(1).values.to(device).requires_grad_()
    sdf = ((0.5 - t) / 0.08).clamp(-1, 1).detach().requires_grad_()
    values = torch.randn(20, 43, channels, generator=generator, dtype=torch.float64).to(device).requires_grad_()
    valid = torch.ones(20, 43, dtype=torch.bool, device=device)
    got = ops.volume_render(sdf, values, t, None, 0.08)
    want = reference.volume_rendering.volume_render(sdf, values, t, valid, 0.08)
    colored = ops.volume_render(sdf, values.new_zeros(20, 43, 3), t, None, 0.08)
    assert torch.equal(got[1], colored[1])
    assert torch.equal(got[2], colored[2])
    objective = [sum((o * o).sum() for o in out) for out in (got, want)]
    grads = [torch.autograd.grad(o, [sdf, values, t]) for o in objective]
    for g, w in zip((*got, *grads[0]), (*want, *grads[1]), strict=True):
        torch.testing.assert_close(g, w, rtol=1e-9, atol=1e-11)
    split = ops.volume_render(*(part.unflatten(0, (4, 5)) for part in (sdf, values, t)), None, 0.08)
    assert all(torch.equal(g.flatten(0, 1), w) for g, w in zip(split, got, strict=True))
