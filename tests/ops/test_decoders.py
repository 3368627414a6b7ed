"""The small networks, against torch.nn."""

import itertools

import pytest
import torch

from spslam import ops
from tests.ops.threads import assert_same_for_any_threads

# (inputs, hidden, outputs): the two decoders, the prior's encoder, widths that fill no vector, and one that a block's
# shared memory has no room for.
SHAPES = [(11, 32, 1), (32, 32, 3), (6, 64, 8), (3, 5, 2), (17, 33, 4), (9, 200, 12)]
ACTIVATIONS = {
    ops.Activation.NONE: torch.nn.Identity,
    ops.Activation.TANH: torch.nn.Tanh,
    ops.Activation.SIGMOID: torch.nn.Sigmoid,
}
# Sums of up to 200 float32 products in another order, through three layers.
FLOAT32_TOLERANCE = dict(rtol=1e-4, atol=1e-5)
FLOAT64_TOLERANCE = dict(rtol=1e-11, atol=1e-12)


def _module(shape, activation, dtype, device):
    inputs, hidden, outputs = shape
    linear = torch.nn.Linear
    layers = [linear(inputs, hidden), torch.nn.ReLU(), linear(hidden, hidden), torch.nn.ReLU(), linear(hidden, outputs)]
    return torch.nn.Sequential(*layers, ACTIVATIONS[activation]()).to(device, dtype)


def _flat(parameters):
    return torch.cat([p.detach().reshape(-1) for p in parameters])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("shape", "activation"), list(itertools.product(SHAPES, ACTIVATIONS)))
def test_forward_and_gradients_match_torch(device, dtype, shape, activation):
    torch.manual_seed(1)
    module = _module(shape, activation, dtype, device)
    x = torch.randn(1500, shape[0], dtype=dtype, device=device, requires_grad=True)
    params = _flat(module.parameters()).requires_grad_()
    grad = torch.randn(1500, shape[2], dtype=dtype, device=device)
    want = module(x)
    want_grads = torch.autograd.grad(want, [x, *module.parameters()], grad)
    got = ops.mlp(x, params, shape[1], shape[2], activation)
    got_x, got_params = torch.autograd.grad(got, [x, params], grad)
    tolerance = FLOAT32_TOLERANCE if dtype == torch.float32 else FLOAT64_TOLERANCE
    torch.testing.assert_close(got, want, **tolerance)
    torch.testing.assert_close(got_x, want_grads[0], **tolerance)
    scale = 1500**0.5  # of a parameter's gradient, a sum over the samples
    torch.testing.assert_close(got_params / scale, _flat(want_grads[1:]) / scale, **tolerance)


def test_more_rows_than_are_under_way_at_once(device):
    torch.manual_seed(3)
    rows, shape = 150_001, (3, 5, 2)
    module = _module(shape, ops.Activation.TANH, torch.float32, device)
    x = torch.randn(rows, shape[0], device=device, requires_grad=True)
    params, grad = _flat(module.parameters()).requires_grad_(), torch.randn(rows, shape[2], device=device)
    want = module.double()(x.double())
    want_grads = torch.autograd.grad(want, [x, *module.parameters()], grad.double())
    got = ops.mlp(x, params, shape[1], shape[2], ops.Activation.TANH)
    got_x, got_params = torch.autograd.grad(got, [x, params], grad)
    torch.testing.assert_close(got.double(), want, **FLOAT32_TOLERANCE)
    torch.testing.assert_close(got_x, want_grads[0], **FLOAT32_TOLERANCE)
    torch.testing.assert_close(got_params.double() / rows**0.5, _flat(want_grads[1:]) / rows**0.5, **FLOAT32_TOLERANCE)


@pytest.mark.parametrize("shape", SHAPES)
def test_same_bits_from_run_to_run(device, shape):
    torch.manual_seed(4)
    x = torch.randn(20_011, shape[0], device=device, requires_grad=True)
    params = torch.randn(ops.mlp_num_params(*shape), device=device, requires_grad=True)
    results = []
    for _ in range(3):
        out = ops.mlp(x, params, shape[1], shape[2])
        results.append([out, *torch.autograd.grad(out.square().sum(), [x, params])])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_gradcheck(device, activation):
    torch.manual_seed(2)
    x = torch.randn(9, 3, dtype=torch.float64, device=device, requires_grad=True)
    params = torch.randn(ops.mlp_num_params(3, 6, 2), dtype=torch.float64, device=device, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, p: ops.mlp(x, p, 6, 2, activation), (x, params))


def test_opcheck(device):
    x = torch.randn(40, 11, device=device, requires_grad=True)
    params = torch.randn(ops.mlp_num_params(11, 32, 1), device=device, requires_grad=True)
    torch.library.opcheck(torch.ops.spslam.mlp, (x, params, 32, 1, 1))
    args = (torch.randn(40, 1, device=device), x.detach(), params.detach(), 32, 1, 1, True, False)
    torch.library.opcheck(torch.ops.spslam.mlp_backward, args)


def test_only_the_gradients_asked_for(device):
    x = torch.randn(70, 4, device=device, requires_grad=True)
    params = torch.randn(ops.mlp_num_params(4, 8, 1), device=device)
    ops.mlp(x, params, 8, 1).sum().backward()
    assert x.grad is not None and params.grad is None
    x2, p2 = x.detach(), params.clone().requires_grad_()
    ops.mlp(x2, p2, 8, 1).sum().backward()
    assert p2.grad.abs().sum() > 0


def test_empty(device):
    x = torch.zeros(0, 4, device=device, requires_grad=True)
    params = torch.randn(ops.mlp_num_params(4, 8, 2), device=device, requires_grad=True)
    out = ops.mlp(x, params, 8, 2)
    out.sum().backward()
    assert out.shape == (0, 2) and x.grad.shape == (0, 4) and not params.grad.any()


def test_non_contiguous(device):
    x = torch.randn(11, 50, device=device).T
    params = torch.randn(2 * ops.mlp_num_params(11, 32, 1), device=device)[::2]
    assert torch.equal(ops.mlp(x, params, 32, 1), ops.mlp(x.contiguous(), params.contiguous(), 32, 1))


def test_nan_passes_through(device):
    x = torch.zeros(8, 3, device=device)
    x[5, 1] = float("nan")
    params = torch.rand(ops.mlp_num_params(3, 8, 1), device=device)
    out = ops.mlp(x, params, 8, 1)[:, 0]
    assert out.isnan().tolist() == [i == 5 for i in range(8)]


def test_gradients_do_not_depend_on_the_number_of_threads():
    x = torch.randn(20_011, 11)
    params = torch.randn(ops.mlp_num_params(11, 32, 1), requires_grad=True)
    assert_same_for_any_threads(lambda: torch.autograd.grad(ops.mlp(x, params, 32, 1).square().sum(), params))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_gradgradcheck(device, activation):
    torch.manual_seed(2)
    x = torch.randn(5, 3, dtype=torch.float64, device=device, requires_grad=True)
    params = torch.randn(ops.mlp_num_params(3, 6, 2), dtype=torch.float64, device=device, requires_grad=True)
    assert torch.autograd.gradgradcheck(lambda x, p: ops.mlp(x, p, 6, 2, activation), (x, params))


def test_hessian_vector_products_match_torch(device):
    """Of an eikonal loss: derivatives of third order."""
    torch.manual_seed(6)
    module = _module((3, 32, 1), ops.Activation.TANH, torch.float64, device)
    params = _flat(module.parameters()).requires_grad_()
    x = torch.randn(50, 3, dtype=torch.float64, device=device, requires_grad=True)
    results = []
    for function, leaves in (
        (lambda x: ops.mlp(x, params, 32, 1, ops.Activation.TANH), [params]),
        (module, list(module.parameters())),
    ):
        (slope,) = torch.autograd.grad(function(x).sum(), [x], create_graph=True)
        first = _flat_graph(torch.autograd.grad((slope.norm(dim=1) - 1).square().mean(), leaves, create_graph=True))
        vector = torch.linspace(-1, 1, len(first), dtype=first.dtype, device=device)
        results.append((first.detach(), _flat_graph(torch.autograd.grad(first @ vector, leaves))))
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want, **FLOAT64_TOLERANCE)


def _flat_graph(parts):
    return torch.cat([part.flatten() for part in parts])


def test_gradients_by_torch_func(device):
    torch.manual_seed(7)
    x = torch.randn(4, 3, dtype=torch.float64, device=device)
    params = torch.randn(ops.mlp_num_params(3, 6, 1), dtype=torch.float64, device=device)

    def value(x):
        return ops.mlp(x[None], params, 6, 1, ops.Activation.TANH)[0, 0]

    leaf = x.clone().requires_grad_()
    out = ops.mlp(leaf, params, 6, 1, ops.Activation.TANH)
    (want,) = torch.autograd.grad(out.sum(), [leaf], create_graph=True)
    torch.testing.assert_close(torch.vmap(torch.func.grad(value))(x), want.detach())
    hessian = torch.func.jacrev(torch.func.jacrev(value))(x[0])
    rows = [torch.autograd.grad(want[0, a], [leaf], retain_graph=True)[0][0] for a in range(3)]
    torch.testing.assert_close(hessian, torch.stack(rows))


INNER = {
    ops.Activation.RELU: (torch.nn.ReLU, 1.0),
    ops.Activation.TANH: (torch.nn.Tanh, 1.0),
    ops.Activation.SIGMOID: (torch.nn.Sigmoid, 1.0),
    ops.Activation.SOFTPLUS: (lambda: torch.nn.Softplus(beta=20.0), 20.0),
    ops.Activation.SINE: (lambda: ops.Sine(3.0), 3.0),
}


@pytest.mark.parametrize("inner", INNER)
@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("layers", [1, 2, 3, 4])
def test_other_networks_match_torch(device, inner, bias, layers):
    torch.manual_seed(5)
    make, scale = INNER[inner]
    widths = [4, *[16] * layers, 2]
    modules = []
    for inputs, outputs in zip(widths[:-1], widths[1:], strict=True):
        modules += [torch.nn.Linear(inputs, outputs, bias, device=device, dtype=torch.float64), make()]
    network = torch.nn.Sequential(*modules[:-1], torch.nn.Tanh())
    params, options = ops.mlp_params_from(network)
    assert options == dict(hidden=16, output=2, activation=ops.Activation.TANH, layers=layers,
                           hidden_activation=inner, scale=scale)  # fmt: skip
    assert len(params) == ops.mlp_num_params(4, 16, 2, layers, bias)
    x = torch.randn(6, 5, 4, dtype=torch.float64, device=device, requires_grad=True)
    got, want = ops.mlp(x, params, **options), network(x)
    torch.testing.assert_close(got, want, **FLOAT64_TOLERANCE)
    leaves = [x, *network.parameters()]  # gradients flow back through the copy of the parameters
    grads = [torch.autograd.grad(out.sum(), leaves, create_graph=True) for out in (got, want)]
    second = [torch.autograd.grad(grad[0].square().sum(), leaves, allow_unused=True, materialize_grads=True)
              for grad in grads]  # fmt: skip
    for g, w in zip((*grads[0], *second[0]), (*grads[1], *second[1]), strict=True):
        torch.testing.assert_close(g, w, **FLOAT64_TOLERANCE)
    again = ops.mlp_to_sequential(params, 4, **options)
    assert torch.equal(again(x), want)
    assert [type(module) for module in again] == [type(module) for module in network]


def test_wide_networks_match_torch(device):
    torch.manual_seed(8)
    module = _module((32, 256, 8), ops.Activation.NONE, torch.float32, device)
    params, options = ops.mlp_params_from(module[:-1])
    x = torch.randn(300, 32, device=device, requires_grad=True)
    got, want = ops.mlp(x, params, **options), module(x)
    torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-4)  # sums of 256 products, through three layers


@pytest.mark.parametrize("inner", [ops.Activation.RELU, ops.Activation.SINE])
def test_parameters_to_begin_with(inner, generator):
    scale = 30.0 if inner == ops.Activation.SINE else 1.0
    params = ops.mlp_init_params(3, 64, 1, 3, inner, scale, generator=generator)
    again = ops.mlp_init_params(3, 64, 1, 3, inner, scale, generator=generator.manual_seed(0))
    assert torch.equal(params, again)
    network = ops.mlp_to_sequential(params, 3, 64, 1, layers=3, hidden_activation=inner, scale=scale)
    bounds = [layer.weight.abs().max().item() for layer in network if isinstance(layer, torch.nn.Linear)]
    want = [1 / 3, *[(6 / 64) ** 0.5 / 30] * 3] if inner == ops.Activation.SINE else [3**-0.5, 1 / 8, 1 / 8, 1 / 8]
    assert bounds == pytest.approx(want, rel=0.05)
    assert all(bound <= limit for bound, limit in zip(bounds, want, strict=True))


@pytest.mark.parametrize(
    ("modules", "message"),
    [
        ([torch.nn.ReLU()], "alternate Linear and activation"),
        ([torch.nn.Linear(3, 4), torch.nn.GELU(), torch.nn.Linear(4, 1)], "have ReLU, Softplus, Tanh, Sigmoid or"),
        ([torch.nn.Linear(3, 4)], "have one to four hidden layers, got 0"),
        (
            [torch.nn.Linear(3, 4), torch.nn.ReLU(), torch.nn.Linear(4, 5), torch.nn.ReLU(), torch.nn.Linear(5, 1)],
            r"have hidden layers of one width, got \[4, 5\]",
        ),
        (
            [torch.nn.Linear(3, 4), torch.nn.ReLU(), torch.nn.Linear(4, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1)],
            "have one activation between all layers",
        ),
        ([torch.nn.Linear(3, 4, False), torch.nn.ReLU(), torch.nn.Linear(4, 1)], "have biases in all layers or none"),
        (
            [torch.nn.Linear(3, 4), torch.nn.Softplus(threshold=5), torch.nn.Linear(4, 1)],
            "have softplus of threshold 20, got 5",
        ),
    ],
)
def test_networks_that_do_not_fit_are_refused(modules, message):
    with pytest.raises(ValueError, match=f"^mlp_params_from: network must {message}"):
        ops.mlp_params_from(torch.nn.Sequential(*modules))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(layers=5), r"layers must be in \[1, 4\], got 5"),
        (dict(hidden_activation=0), "hidden_activation must be an Activation, 0 to 5, but not 0, got 0"),
        (dict(scale=2.0), "scale must be positive, and 1 but for softplus and sine, got 2.0"),
    ],
)
def test_what_mlp_refuses_its_helpers_refuse_too(options, message):
    with pytest.raises(ValueError, match=f"^mlp_init_params: {message}"):
        ops.mlp_init_params(3, 8, 1, **options)
    params = torch.zeros(ops.mlp_num_params(3, 8, 1, options.get("layers", 2)))
    with pytest.raises(ValueError, match=f"^mlp_to_sequential: {message}"):
        ops.mlp_to_sequential(params, 3, 8, 1, **options)
    with pytest.raises(ValueError, match="^mlp_to_sequential: activation must be an Activation, 0 to 5, got 6"):
        ops.mlp_to_sequential(params, 3, 8, 1, activation=6)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(input=torch.zeros(3)), ValueError, r"mlp: input must have shape \[N, I\], got \[3\]"),
        (dict(input=torch.zeros(3, 4).half()), TypeError, "mlp: input must be float32 or float64, got float16"),
        (dict(params=torch.zeros(7)), ValueError, r"mlp: params must have shape \[121\], got \[7\]"),
        (dict(params=torch.zeros(121).double()), TypeError, "mlp: params must be float32, got float64"),
        (dict(hidden=0), ValueError, "mlp: hidden must be at least 1, got 0"),
        (dict(output=0), ValueError, "mlp: output must be at least 1, got 0"),
        (dict(activation=6), ValueError, "mlp: activation must be an Activation, 0 to 5, got 6"),
        (
            dict(hidden_activation=0),
            ValueError,
            "mlp: hidden_activation must be an Activation, 0 to 5, but not 0, got 0",
        ),
        (dict(layers=5), ValueError, r"mlp: layers must be in \[1, 4\], got 5"),
        (dict(scale=2.0), ValueError, "mlp: scale must be positive, and 1 but for softplus and sine, got 2.0"),
    ],
)
def test_errors(change, error, message):
    args = dict(input=torch.zeros(3, 4), params=torch.zeros(121), hidden=8, output=1, activation=0) | change
    with pytest.raises(error, match=message):
        ops.mlp(**args)
