"""Ops inside of torch.compile and torch.vmap give what they give outside."""

import copy

import pytest
import torch
from torch.autograd import forward_ad

from spslam import ops
from tests.ops.arguments import outputs
from tests.ops.cases import CASES, arguments

BATCH = 3


def named(condition):
    return pytest.mark.parametrize("name", [name for name, case in CASES.items() if condition(case)])


def tensors_of(values):
    return [value for value in values.values() if isinstance(value, torch.Tensor)]


def assert_same(got, want):
    assert len(got) == len(want)
    for g, w in zip(got, want, strict=True):
        assert g.dtype == w.dtype
        torch.testing.assert_close(g, w, rtol=0, atol=0, equal_nan=True)


@named(lambda case: case.compiles)
def test_compiles_whole(name, device, generator):
    """One graph, no break: results, gradients and what is changed in place are the same to the bit."""
    call = arguments(name, generator, device)
    function = getattr(ops, name)
    torch._dynamo.reset()

    # Ops whose result has as many rows as there turn out to be: see docs/ops/index.md.
    @torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True, capture_scalar_outputs=True)
    def compiled(values):
        return torch.compile(lambda given: function(**given), fullgraph=True, backend="aot_eager")(values)

    results = []
    for run in (lambda given: function(**given), compiled):
        own = copy.deepcopy(call)
        for argument in CASES[name].differentiable:
            own[argument].requires_grad_()
        found = outputs(run(own))
        if CASES[name].differentiable:
            sum(f.sum() for f in found if f.requires_grad).backward()
        gradients = [own[argument].grad for argument in CASES[name].differentiable]
        results.append([*found, *gradients, *tensors_of(own)])
    assert_same(results[1], results[0])


@named(lambda case: case.differentiable)
def test_exports(name, device, generator):
    """torch.export gives a program that computes the same."""
    call = arguments(name, generator, device)
    keys = [key for key, value in call.items() if isinstance(value, torch.Tensor)]
    rest = {key: value for key, value in call.items() if key not in keys}

    class Program(torch.nn.Module):
        def forward(self, *tensors):
            return tuple(outputs(getattr(ops, name)(**rest, **dict(zip(keys, tensors, strict=True)))))

    given = tuple(call[key] for key in keys)
    exported = torch.export.export(Program(), given)
    assert_same(list(exported.module()(*given)), list(Program()(*given)))


@named(lambda case: case.differentiable)
def test_gradients_by_torch_func(name, device, generator):
    """torch.func.grad, and jacrev, which maps over the backward op, give what torch.autograd gives."""
    call = arguments(name, generator, device, rows=6)
    for key in CASES[name].differentiable:

        def of_one(given, key=key):
            return [o for o in outputs(getattr(ops, name)(**{**call, key: given})) if o.is_floating_point()][-1]

        leaf = call[key].clone().requires_grad_()
        out = of_one(leaf)
        (want,) = torch.autograd.grad(out.sum(), [leaf], allow_unused=True, materialize_grads=True)
        assert_same([torch.func.grad(lambda given, f=of_one: f(given).sum())(call[key])], [want])
        jacobian = torch.func.jacrev(of_one)(call[key])
        summed = jacobian.flatten(0, out.ndim - 1).sum(0) if out.ndim else jacobian
        torch.testing.assert_close(summed, want, rtol=1e-4, atol=1e-4 * max(1.0, want.abs().max().item()))


@pytest.mark.slow
def test_compiled_code_runs(generator):
    """With torch's own compiler behind it, not only the tracer."""
    call = arguments("trilinear_interpolate", generator)

    def scaled(embeddings, corner_ids, local_coords):
        return ops.trilinear_interpolate(2 * embeddings, corner_ids, local_coords).relu()

    torch._dynamo.reset()
    torch.testing.assert_close(torch.compile(scaled, fullgraph=True)(**call), scaled(**call))


@named(lambda case: case.rows)
def test_vmap_over_rows(name, device, generator):
    """Tables are shared, rows are mapped over."""
    calls = [arguments(name, generator, device, rows=20) for _ in range(BATCH)]
    rows = CASES[name].rows
    shared = {key: value for key, value in calls[0].items() if key not in rows}
    stacked = [torch.stack([call[row] for call in calls]) for row in rows]
    function = getattr(ops, name)

    got = outputs(torch.vmap(lambda *given: function(**shared, **dict(zip(rows, given, strict=True))))(*stacked))
    each = [outputs(function(**shared, **{row: call[row] for row in rows})) for call in calls]
    assert_same(got, [torch.stack(parts) for parts in zip(*each, strict=True)])


@named(lambda case: case.rows and case.differentiable)
def test_vmap_over_everything(name, device, generator):
    """Tables too, another axis than the first, and gradients through it."""
    calls = [arguments(name, generator, device, rows=20) for _ in range(BATCH)]
    mapped = sorted({*CASES[name].rows, *CASES[name].differentiable})
    shared = {key: value for key, value in calls[0].items() if key not in mapped}
    stacked = {key: torch.stack([call[key] for call in calls], 1) for key in mapped}
    function = getattr(ops, name)

    def gradients(run):
        leaves = {key: value.clone() for key, value in stacked.items()}
        for key in CASES[name].differentiable:
            leaves[key].requires_grad_()
        found = run([leaves[key] for key in mapped])
        sum(f.sum() for f in found if f.requires_grad).backward()
        return [*found, *(leaves[key].grad for key in CASES[name].differentiable)]

    def call(*given):
        return tuple(outputs(function(**shared, **dict(zip(mapped, given, strict=True)))))

    def one_by_one(given):
        each = [call(*(value.select(1, i) for value in given)) for i in range(BATCH)]
        return [torch.stack(parts) for parts in zip(*each, strict=True)]

    assert_same(gradients(lambda given: torch.vmap(call, in_dims=1)(*given)), gradients(one_by_one))


@named(lambda case: case.differentiable)
def test_many_gradients_at_once(name, generator):
    """torch.autograd.grad with is_grads_batched maps over the backward op."""
    call = arguments(name, generator, rows=20)
    leaves = [call[key].requires_grad_() for key in CASES[name].differentiable]
    result = next(part for part in outputs(getattr(ops, name)(**call)) if part.requires_grad)
    grads = torch.randn(BATCH, *result.shape, generator=generator)
    options = dict(retain_graph=True, allow_unused=True, materialize_grads=True)
    got = torch.autograd.grad(result, leaves, grads, is_grads_batched=True, **options)
    each = [torch.autograd.grad(result, leaves, grad, **options) for grad in grads]
    assert_same(got, [torch.stack(parts) for parts in zip(*each, strict=True)])


def refuses_forward_mode(name):
    return pytest.raises(NotImplementedError, match=f"^{name}: forward-mode AD is not supported, use reverse mode$")


def derive_forward(function, value):
    """The ways to ask for a derivative in forward mode."""
    ones = torch.ones_like(value)
    stacked = torch.stack([value, value])

    def with_dual(requires_grad=False):
        with forward_ad.dual_level():
            return function(forward_ad.make_dual(value.clone().requires_grad_(requires_grad), ones))

    yield lambda: torch.func.jvp(function, (value,), (ones,))
    yield lambda: torch.func.jacfwd(function)(value)
    yield lambda: torch.func.jvp(torch.vmap(function), (stacked,), (torch.ones_like(stacked),))
    yield lambda: torch.vmap(lambda v: torch.func.jvp(function, (v,), (ones,))[1])(stacked)
    yield with_dual
    yield lambda: with_dual(requires_grad=True)
    yield torch.no_grad()(with_dual)


@named(lambda case: case.differentiable)
def test_forward_mode_is_refused(name, device, generator):
    """By any of its ways, by each argument: torch's own answer would be a derivative of zero."""
    call = arguments(name, generator, device, rows=20)
    for key in CASES[name].differentiable:

        def of_one(given, key=key):
            return outputs(getattr(ops, name)(**{**call, key: given}))[-1]

        for derive in derive_forward(of_one, call[key]):
            with refuses_forward_mode(name):
                derive()


@named(lambda case: case.differentiable)
def test_forward_mode_over_a_gradient_is_refused(name, device, generator):
    """A tangent that comes with the gradient of the output, as in products with a Hessian."""
    call = arguments(name, generator, device, rows=20)
    leaves = [call[key].requires_grad_() for key in CASES[name].differentiable]
    result = next(part for part in outputs(getattr(ops, name)(**call)) if part.requires_grad)
    with forward_ad.dual_level():
        grad = forward_ad.make_dual(torch.ones_like(result), torch.ones_like(result))
        if name == "voxel_hash_lookup":  # its gradient is plain torch
            (found,) = torch.autograd.grad(result, leaves, grad)
            primal, tangent = forward_ad.unpack_dual(found)
            assert torch.equal(tangent, primal)
        else:
            with refuses_forward_mode(name):
                torch.autograd.grad(result, leaves, grad)


def test_vmap_over_nothing_is_refused(generator):
    call = arguments("mlp", generator)
    with pytest.raises(ValueError, match="spslam::mlp: torch.vmap must map over at least one entry, got 0"):
        torch.vmap(lambda params: ops.mlp(call["input"], params, 32, 3))(call["params"].expand(0, -1))
