"""Sparse Adam and the normal equations, against torch.optim.Adam and torch.linalg."""

import pytest
import torch

from spslam import ops

# Adam in another order of operations: a few roundings of the step.
ADAM_TOLERANCE = {torch.float32: dict(rtol=1e-5, atol=1e-7), torch.float64: dict(rtol=1e-13, atol=1e-15)}
# Sums of up to 1,000 products, added in another order.
SUM_TOLERANCE = {torch.float32: dict(rtol=1e-4, atol=1e-4), torch.float64: dict(rtol=1e-11, atol=1e-11)}
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def _adam_state(rows, channels, dtype, device, generator):
    param = torch.randn(rows, channels, generator=generator, dtype=torch.float64)
    return [param.to(device, dtype)] + [torch.zeros(rows, channels, dtype=dtype, device=device) for _ in range(3)]


@DTYPES
@pytest.mark.parametrize("rows,channels", [(301, 8), (77, 32), (50, 16), (40, 3), (5000, 8)])
@pytest.mark.parametrize("stamped", [False, True])
def test_adam_equals_torch_where_all_rows_are_touched(rows, channels, stamped, dtype, device, generator):
    param, grad, exp_avg, exp_avg_sq = _adam_state(rows, channels, dtype, device, generator)
    reference = torch.nn.Parameter(param.clone())
    adam = torch.optim.Adam([reference], lr=3e-3, betas=(0.8, 0.99), eps=1e-7)
    for step in range(1, 6):
        new_grad = torch.randn(rows, channels, generator=generator, dtype=torch.float64).to(device, dtype)
        grad.copy_(new_grad)
        stamps = torch.full((rows,), step, dtype=torch.int32, device=device) if stamped else None
        ops.sparse_adam_(
            param, grad, exp_avg, exp_avg_sq, stamps, step, lr=3e-3, step=step, betas=(0.8, 0.99), eps=1e-7
        )
        reference.grad = new_grad
        adam.step()
    state = adam.state[reference]
    torch.testing.assert_close(param, reference.detach(), **ADAM_TOLERANCE[dtype])
    torch.testing.assert_close(exp_avg, state["exp_avg"], **ADAM_TOLERANCE[dtype])
    torch.testing.assert_close(exp_avg_sq, state["exp_avg_sq"], **ADAM_TOLERANCE[dtype])
    assert not grad.any()


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5])
def test_adam_leaves_other_rows_alone(share, device, generator):
    rows, channels = 9_001, 8
    tensors = [torch.rand(rows, channels, generator=generator).to(device) for _ in range(4)]
    touched = (torch.rand(rows, generator=generator) < share).to(device)
    stamps = torch.where(touched, 7, torch.randint(0, 7, (rows,), generator=generator).to(device)).int()
    whole = [t.clone() for t in tensors]
    kept = [t.clone() for t in tensors]
    ops.sparse_adam_(*tensors, stamps, 7, lr=1e-2, step=4)
    ops.sparse_adam_(*whole, lr=1e-2, step=4)
    for got, stepped, before in zip(tensors, whole, kept, strict=True):
        assert torch.equal(got[touched], stepped[touched])
        assert torch.equal(got[~touched], before[~touched])
    assert not tensors[1][touched].any()


def test_adam_steps_a_flat_parameter_that_requires_grad(device, generator):
    param = torch.randn(100, generator=generator).to(device).requires_grad_()
    param.grad = torch.ones_like(param)
    before = param.detach().clone()
    ops.sparse_adam_(param, param.grad, torch.zeros_like(param), torch.zeros_like(param), lr=0.1, step=1)
    torch.testing.assert_close(param.detach(), before - 0.1, rtol=1e-5, atol=1e-6)


def test_adam_does_not_depend_on_threads(generator):
    tensors = [torch.rand(20_000, 8, generator=generator) for _ in range(4)]
    other = [t.clone() for t in tensors]
    stamps = torch.randint(0, 2, (20_000,), generator=generator, dtype=torch.int32)
    threads = torch.ops.spslam.get_num_threads()
    ops.sparse_adam_(*tensors, stamps, 1, lr=1e-2, step=1)
    torch.ops.spslam.set_num_threads(1)
    ops.sparse_adam_(*other, stamps, 1, lr=1e-2, step=1)
    torch.ops.spslam.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(tensors, other, strict=True))


def test_adam_empty(device):
    tensors = [torch.empty(0, 8, device=device) for _ in range(4)]
    stamps = torch.empty(0, dtype=torch.int32, device=device)
    assert ops.sparse_adam_(*tensors, stamps, 1, lr=1e-2, step=1) is None
    assert [tuple(tensor.shape) for tensor in (*tensors, stamps)] == [(0, 8)] * 4 + [(0,)]
    # No row of theirs: the arrays around them stay as they are.
    whole = [torch.ones(2, 8, device=device) for _ in range(4)]
    whole_stamps = torch.ones(2, dtype=torch.int32, device=device)
    ops.sparse_adam_(*(tensor[1:1] for tensor in whole), whole_stamps[1:1], 1, lr=1e-2, step=1)
    assert all(bool((tensor == 1).all()) for tensor in whole)


def _adam_arguments(**changes):
    arguments = {k: torch.zeros(4, 8) for k in ("param", "grad", "exp_avg", "exp_avg_sq")}
    return {**arguments, "stamps": torch.zeros(4, dtype=torch.int32), "stamp": 0, "lr": 0.1, "step": 1, **changes}


@pytest.mark.parametrize(
    "changes,error,message",
    [
        (dict(param=1.0), TypeError, r"param must be a torch\.Tensor, got float"),
        (dict(param=torch.zeros(4, 8).int()), TypeError, "param must be float32 or float64, got int32"),
        (dict(grad=torch.zeros(4, 8).double()), TypeError, "grad must be float32, got float64"),
        (dict(exp_avg=torch.zeros(4, 7)), ValueError, r"exp_avg must have shape \[4, 8\], got \[4, 7\]"),
        (dict(exp_avg_sq=torch.zeros(4, 8, device="meta")), ValueError, "exp_avg_sq must be on cpu, got meta"),
        (dict(grad=torch.zeros(8, 4).T), ValueError, r"grad must be contiguous, got strides \(1, 4\)"),
        (dict(stamps=torch.zeros(4)), TypeError, "stamps must be int32, got float32"),
        (dict(stamps=torch.zeros(5).int()), ValueError, r"stamps must have shape \[4\], got \[5\]"),
        (dict(stamp=2**31), ValueError, "stamp must fit 32 bits, got 2147483648"),
        (dict(lr=-1.0), ValueError, r"lr must be at least 0, got -1\.0"),
        (dict(betas=(0.9, 1.0)), ValueError, r"betas must be in \[0, 1\), got \(0\.9, 1\.0\)"),
        (dict(eps=-1e-8), ValueError, "eps must be at least 0, got -1e-08"),
        (dict(step=0), ValueError, "step must be at least 1, got 0"),
    ],
)
def test_adam_errors(changes, error, message):
    with pytest.raises(error, match="^sparse_adam_: " + message):
        ops.sparse_adam_(**_adam_arguments(**changes))


def test_adam_stamps_need_rows():
    scalars = [torch.tensor(0.0) for _ in range(4)]
    with pytest.raises(ValueError, match="sparse_adam_: param must have rows where stamps are given, got a scalar"):
        ops.sparse_adam_(*scalars, torch.zeros(1, dtype=torch.int32), lr=0.1, step=1)


def _least_squares(frames, count, dtype, device, generator):
    shapes = (frames, count), (frames, count, 6), (frames, count)
    return [torch.randn(s, generator=generator, dtype=torch.float64).to(device, dtype) for s in shapes]


@DTYPES
@pytest.mark.parametrize("frames,count", [(1, 1), (3, 256), (2, 257), (1, 1000), (5, 0), (0, 4)])
def test_normal_equations(frames, count, dtype, device, generator):
    residuals, jacobians, weights = _least_squares(frames, count, dtype, device, generator)
    hessian, gradient, cost = ops.normal_equations(residuals, jacobians, weights.abs())
    r, j, w = residuals.double(), jacobians.double(), weights.abs().double()
    want = torch.einsum("fn,fna,fnb->fab", w, j, j), torch.einsum("fn,fn,fna->fa", w, r, j), (w * r * r).sum(1)
    for got, expected in zip((hessian, gradient, cost), want, strict=True):
        torch.testing.assert_close(got, expected.to(dtype), **SUM_TOLERANCE[dtype])
    assert torch.equal(hessian, hessian.mT)


def test_normal_equations_skip_entries_without_weight(device, generator):
    residuals, jacobians, weights = _least_squares(2, 300, torch.float32, device, generator)
    weights[:, 100:] = 0
    residuals[:, 200] = torch.nan
    jacobians[:, 250] = torch.inf
    got = ops.normal_equations(residuals, jacobians, weights)
    want = ops.normal_equations(residuals[:, :100], jacobians[:, :100], weights[:, :100])
    for a, b in zip(got, want, strict=True):
        assert torch.equal(a, b)


def test_normal_equations_non_contiguous(device, generator):
    inputs = _least_squares(3, 70, torch.float64, device, generator)
    strided = [t.transpose(0, 1).contiguous().transpose(0, 1) for t in inputs]
    for a, b in zip(ops.normal_equations(*strided), ops.normal_equations(*inputs), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    "place,tensor,error,message",
    [
        (0, torch.zeros(2), ValueError, r"residuals must have shape \[F, N\], got \[2\]"),
        (0, torch.zeros(2, 3).int(), TypeError, "residuals must be float32 or float64, got int32"),
        (1, torch.zeros(2, 3, 5), ValueError, r"jacobians must have shape \[2, 3, 6\], got \[2, 3, 5\]"),
        (2, torch.zeros(2, 3).double(), TypeError, "weights must be float32, got float64"),
    ],
)
def test_normal_equations_errors(place, tensor, error, message):
    arguments = [torch.zeros(2, 3), torch.zeros(2, 3, 6), torch.zeros(2, 3)]
    arguments[place] = tensor
    with pytest.raises(error, match="^normal_equations: " + message):
        ops.normal_equations(*arguments)


@DTYPES
@pytest.mark.parametrize("damping,absolute_damping", [(0.0, 0.0), (1e-2, 0.0), (1e-4, 0.5)])
def test_solve_normal_equations(damping, absolute_damping, dtype, device, generator):
    factor = torch.randn(40, 6, 6, generator=generator, dtype=torch.float64)
    hessian = (factor @ factor.mT + 0.1 * torch.eye(6)).to(device, dtype)
    gradient = torch.randn(40, 6, generator=generator, dtype=torch.float64).to(device, dtype)
    got = ops.solve_normal_equations(hessian, gradient, damping, absolute_damping)
    damped = hessian.double() + damping * torch.diag_embed(hessian.double().diagonal(dim1=1, dim2=2))
    damped += absolute_damping * torch.eye(6, device=device)
    want = -torch.linalg.solve(damped, gradient.double())
    tolerance = dict(rtol=1e-6, atol=1e-6) if dtype == torch.float32 else dict(rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(got, want.to(dtype), **tolerance)


def test_unsolvable_systems_give_no_step(device):
    hessian = torch.eye(6, device=device).repeat(6, 1, 1)
    gradient = torch.ones(6, 6, device=device)
    hessian[1] = 0
    hessian[2, 3, 3] = -1
    hessian[3, 5, 0] = hessian[3, 0, 5] = torch.nan
    gradient[4, 2] = torch.inf
    hessian[5] = 1  # rank one
    delta = ops.solve_normal_equations(hessian, gradient)
    assert torch.equal(delta[0], -torch.ones(6, device=device))
    assert not delta[1:].any()
    assert ops.solve_normal_equations(hessian, gradient, absolute_damping=0.1)[[1, 5]].all()


def test_solve_empty_and_non_contiguous(device, generator):
    assert ops.solve_normal_equations(torch.empty(0, 6, 6, device=device), torch.empty(0, 6, device=device)).shape == (
        0,
        6,
    )
    factor = torch.randn(4, 6, 6, generator=generator)
    hessian = (factor @ factor.mT).to(device)
    gradient = torch.randn(6, 4, generator=generator).to(device).T
    got = ops.solve_normal_equations(hessian, gradient)
    assert torch.equal(got, ops.solve_normal_equations(hessian, gradient.contiguous()))


@pytest.mark.parametrize(
    "changes,error,message",
    [
        (dict(hessian=torch.zeros(2, 5, 5)), ValueError, r"hessian must have shape \[F, 6, 6\], got \[2, 5, 5\]"),
        (dict(gradient=torch.zeros(3, 6)), ValueError, r"gradient must have shape \[2, 6\], got \[3, 6\]"),
        (dict(gradient=torch.zeros(2, 6).double()), TypeError, "gradient must be float32, got float64"),
        (dict(damping=-0.1), ValueError, r"damping must be at least 0, got -0\.1"),
        (dict(absolute_damping=-2.0), ValueError, r"absolute_damping must be at least 0, got -2\.0"),
    ],
)
def test_solve_errors(changes, error, message):
    arguments = {"hessian": torch.zeros(2, 6, 6), "gradient": torch.zeros(2, 6), **changes}
    with pytest.raises(error, match="^solve_normal_equations: " + message):
        ops.solve_normal_equations(**arguments)


def test_opcheck(device, generator):
    tensors = [torch.rand(10, 8, generator=generator).to(device) for _ in range(4)]
    stamps = torch.ones(10, dtype=torch.int32, device=device)
    namespace = torch.ops.spslam
    torch.library.opcheck(namespace.sparse_adam_.default, (*tensors, stamps, 1, 1e-2, 0.9, 0.999, 1e-8, 1))
    torch.library.opcheck(namespace.sparse_adam_.default, (*tensors, None, 1, 1e-2, 0.9, 0.999, 1e-8, 1))
    equations = _least_squares(2, 30, torch.float32, device, generator)
    torch.library.opcheck(namespace.normal_equations.default, tuple(equations))
    hessian, gradient, _ = ops.normal_equations(equations[0], equations[1], equations[2].abs())
    torch.library.opcheck(namespace.solve_normal_equations.default, (hessian, gradient, 1e-3, 0.0))
