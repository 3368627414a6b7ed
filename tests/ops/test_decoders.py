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


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(input=torch.zeros(3)), ValueError, r"mlp: input must have shape \[N, I\], got \[3\]"),
        (dict(input=torch.zeros(3, 4).half()), TypeError, "mlp: input must be float32 or float64, got float16"),
        (dict(params=torch.zeros(7)), ValueError, r"mlp: params must have shape \[121\], got \[7\]"),
        (dict(params=torch.zeros(121).double()), TypeError, "mlp: params must be float32, got float64"),
        (dict(hidden=0), ValueError, "mlp: hidden must be at least 1, got 0"),
        (dict(output=0), ValueError, "mlp: output must be at least 1, got 0"),
        (dict(activation=3), ValueError, "mlp: activation must be 0, 1 or 2, got 3"),
    ],
)
def test_errors(change, error, message):
    args = dict(input=torch.zeros(3, 4), params=torch.zeros(121), hidden=8, output=1, activation=0) | change
    with pytest.raises(error, match=message):
        ops.mlp(**args)
