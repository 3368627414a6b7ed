"""In an autocast region ops take what other modules give there, and compute in float32."""

import pytest
import torch

from spslam import ops
from tests.ops.arguments import outputs
from tests.ops.cases import CASES, arguments

LOWERED = pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
# Changed in place, or of 16 bits by their meaning: not cast.
AS_GIVEN = {"param", "grad", "exp_avg", "exp_avg_sq", "embeddings", "weights", "sums", "poses", "depth_thumbnails"}


def float_arguments(name, call):
    """Names of the float32 tensors among the arguments that an op casts."""
    given = AS_GIVEN if name.endswith("_") or "thumbnail_step" in call else set()
    tensors = {key for key, value in call.items() if isinstance(value, torch.Tensor) and value.dtype == torch.float32}
    return sorted(tensors - given)


@LOWERED
@pytest.mark.parametrize("name", CASES)
def test_ops_compute_in_float32(name, dtype, device, generator):
    call, same = (arguments(name, generator.manual_seed(0), device) for _ in range(2))
    keys = float_arguments(name, call)
    low = {key: call[key].to(dtype) for key in keys}
    with torch.autocast(device.type, dtype=dtype):
        results = outputs(getattr(ops, name)(**call | low))
    wanted = outputs(getattr(ops, name)(**same | {key: value.float() for key, value in low.items()}))
    assert len(results) == len(wanted)
    for got, want in zip(results, wanted, strict=True):
        assert got.dtype == want.dtype
        assert torch.equal(got.nan_to_num(), want.nan_to_num())


@LOWERED
def test_a_network_goes_on_from_a_layer(dtype, device, generator):
    """Gradients flow back through the cast, into the layer's float32 weights."""
    layer = torch.nn.Linear(6, 11, device=device)
    params = torch.randn(ops.mlp_num_params(11, 8, 2), generator=generator).to(device).requires_grad_()
    x = torch.randn(20, 6, generator=generator).to(device)
    with torch.autocast(device.type, dtype=dtype):
        hidden = layer(x)
        assert hidden.dtype == dtype
        out = ops.mlp(hidden, params, 8, 2)
    assert out.dtype == torch.float32
    out.sum().backward()
    assert params.grad.dtype == layer.weight.grad.dtype == torch.float32
    assert layer.weight.grad.abs().sum() > 0


def test_what_torch_computes_is_in_float32_too(device, generator):
    """Networks without a kernel, other channels than three, and second derivatives inside of the region."""
    x = torch.randn(20, 3, generator=generator).to(device).requires_grad_()
    params = {
        layers: ops.mlp_init_params(3, 16, 2, layers, generator=generator).to(device).requires_grad_()
        for layers in (2, 3)
    }
    t = torch.rand(4, 9, generator=generator).sort(1).values.to(device)
    values = torch.rand(4, 9, 5, generator=generator).to(device)

    def run():
        rendered = ops.volume_render((0.5 - t) * 10, values, t, None, 0.1)[0]
        (slope,) = torch.autograd.grad(ops.mlp(x, params[2], 16, 2).tanh().sum(), [x], create_graph=True)
        return [ops.mlp(x, params[3], 16, 2, layers=3), rendered, *torch.autograd.grad(slope.square().sum(), [x])]

    want = run()
    with torch.autocast(device.type, dtype=torch.bfloat16):
        got = run()
    assert [g.dtype for g in got] == [torch.float32] * 3
    assert all(torch.equal(g, w) for g, w in zip(got, want, strict=True))


def test_compiled_code_casts_too(generator):
    layer = torch.nn.Linear(6, 11)
    params = torch.randn(ops.mlp_num_params(11, 8, 2), generator=generator)
    x = torch.randn(20, 6, generator=generator)

    def network(x):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return ops.mlp(layer(x), params, 8, 2)

    torch._dynamo.reset()
    assert torch.equal(torch.compile(network, fullgraph=True, backend="aot_eager")(x), network(x))


@LOWERED
def test_what_is_changed_in_place_is_not_cast(dtype):
    """The change would be made to a copy and lost."""
    table = torch.zeros(4, 8, dtype=dtype)
    with torch.autocast("cpu", dtype=torch.bfloat16), pytest.raises(TypeError, match="sparse_adam_: param must be"):
        ops.sparse_adam_(table, table, table, table, lr=0.1, step=1)


def test_outside_of_a_region_nothing_is_cast():
    with pytest.raises(TypeError, match="mlp: input must be float32 or float64, got bfloat16"):
        ops.mlp(torch.zeros(1, 3, dtype=torch.bfloat16), torch.zeros(1), 8, 1)
