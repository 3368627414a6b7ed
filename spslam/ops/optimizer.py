"""Optimizer steps: Adam on selected rows of a table, and Gauss-Newton normal equations. Not differentiable."""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import FLOATING, check, check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops._vmap import register_rows_vmap


@public_op(as_given=("param", "grad", "exp_avg", "exp_avg_sq"))
def sparse_adam_(
    param: torch.Tensor,
    grad: torch.Tensor,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    stamps: torch.Tensor | None = None,
    stamp: int = 0,
    *,
    lr: float,
    step: int,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
) -> None:
    """One Adam step (Kingma and Ba 2015, algorithm 1), in place, on the rows with the current stamp.

    With g the gradient of such a row: m = beta1 m + (1 - beta1) g, v = beta2 v + (1 - beta2) g^2 and
    param -= lr / (1 - beta1^step) * m / (sqrt(v / (1 - beta2^step)) + eps). The gradient of these rows is then set to
    zero for the next accumulation. Rows with another stamp are neither read nor written. If all rows have the current
    stamp, the result equals that of torch.optim.Adam. The result does not depend on the number of threads. A gradient
    that is not finite affects only its own entry. V = 0 changes nothing.

    Args:
        param: float32 or float64 [V, C], or any shape with V rows along the first axis; contiguous, as the next three.
        grad: its gradient, same shape and dtype; rows with the current stamp are set to 0.
        exp_avg: first moment m, same shape and dtype.
        exp_avg_sq: second moment v, same shape and dtype.
        stamps: int32 [V], the last stamp of each row; None updates every row.
        stamp: the current stamp.
        lr: learning rate.
        step: 1-based number of the step, for the bias correction, common to all rows.
        betas: decay rates of the moments.
        eps: added to the denominator.

    Raises:
        TypeError: a tensor of another dtype.
        ValueError: wrong shapes or devices, a tensor that is not contiguous, or a number out of range.

    Example:
        >>> param, grad, exp_avg, exp_avg_sq = torch.zeros(2, 1), torch.ones(2, 1), torch.zeros(2, 1), torch.zeros(2, 1)
        >>> stamps = torch.tensor([1, 0], dtype=torch.int32)
        >>> sparse_adam_(param, grad, exp_avg, exp_avg_sq, stamps, stamp=1, lr=0.1, step=1)
        >>> param.flatten(), grad.flatten()
        (tensor([-0.1000,  0.0000]), tensor([0., 1.]))
    """
    name = "sparse_adam_"
    check_tensor(name, "param", param, param.shape if isinstance(param, torch.Tensor) else (), FLOATING)
    for argument, tensor in {"grad": grad, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}.items():
        check_tensor(name, argument, tensor, param.shape, param.dtype, like=param)
    for argument, tensor in {"param": param, "grad": grad, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}.items():
        check(tensor.is_contiguous(), name, argument, "be contiguous", f"strides {tensor.stride()}")
    if stamps is not None:
        check(param.dim() >= 1, name, "param", "have rows where stamps are given", "a scalar")
        check_tensor(name, "stamps", stamps, (param.shape[0],), torch.int32, like=param)
    check(-(2**31) <= stamp < 2**31, name, "stamp", "fit 32 bits", stamp)
    check(lr >= 0, name, "lr", "be at least 0", lr)
    check(len(betas) == 2, name, "betas", "be two numbers", betas)
    check(all(0 <= beta < 1 for beta in betas), name, "betas", "be in [0, 1)", betas)
    check(eps >= 0, name, "eps", "be at least 0", eps)
    check(step >= 1, name, "step", "be at least 1", step)
    with torch.no_grad():
        torch.ops.spslam.sparse_adam_(
            param, grad, exp_avg, exp_avg_sq, stamps, stamp, lr, betas[0], betas[1], eps, step
        )
    changed_in_place(param, grad, exp_avg, exp_avg_sq)


@public_op()
def normal_equations(
    residuals: torch.Tensor, jacobians: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Normal equations of F weighted least-squares problems in six unknowns, each over N residuals.

    Args:
        residuals: float32 or float64 [F, N], r.
        jacobians: [F, N, 6], J = dr/dx.
        weights: [F, N], w. Entries with w = 0 are skipped, even if their residual or jacobian is not finite; any other
            NaN makes the sums of its problem NaN.

    Returns:
        hessian [F, 6, 6] = sum_n w J J^T, gradient [F, 6] = sum_n w r J, cost [F] = sum_n w r^2, in the inputs' dtype.
        Sums have a fixed order (blocks of 256 entries in that dtype, sums of blocks in float64): the same bits for any
        number of threads. N = 0 gives zeros, F = 0 empty tensors.

    Raises:
        TypeError: a tensor of another dtype.
        ValueError: wrong shapes or devices.

    Example:
        >>> hessian, gradient, cost = normal_equations(torch.ones(1, 4), torch.ones(1, 4, 6), torch.ones(1, 4))
        >>> hessian[0, 0, 0], gradient[0, 0], cost[0]
        (tensor(4.), tensor(4.), tensor(4.))
    """
    name = "normal_equations"
    check_tensor(name, "residuals", residuals, ("F", "N"), FLOATING)
    frames, count = residuals.shape
    check_tensor(name, "jacobians", jacobians, (frames, count, 6), residuals.dtype, like=residuals)
    check_tensor(name, "weights", weights, (frames, count), residuals.dtype, like=residuals)
    with torch.no_grad():
        return torch.ops.spslam.normal_equations(residuals, jacobians, weights)


@public_op()
def solve_normal_equations(
    hessian: torch.Tensor, gradient: torch.Tensor, damping: float = 0.0, absolute_damping: float = 0.0
) -> torch.Tensor:
    """Damped Gauss-Newton (Levenberg-Marquardt) steps: delta = -(H + damping diag(H) + absolute_damping I)^-1 g.

    Args:
        hessian: float32 or float64 [F, 6, 6], symmetric; only the lower triangle is read.
        gradient: [F, 6].
        damping: factor of the diagonal that is added to it.
        absolute_damping: constant that is added to the diagonal.

    Returns:
        delta [F, 6], solved by LDL^T in float64. A row is 0 if the damped matrix is not positive definite to the
        precision of the dtype, or if its input is not finite. F = 0 gives an empty tensor. Deterministic.

    Raises:
        TypeError: a tensor of another dtype.
        ValueError: wrong shapes or devices, or negative damping.

    Example:
        >>> solve_normal_equations(2 * torch.eye(6)[None], torch.ones(1, 6))
        tensor([[-0.5000, -0.5000, -0.5000, -0.5000, -0.5000, -0.5000]])
    """
    name = "solve_normal_equations"
    check_tensor(name, "hessian", hessian, ("F", 6, 6), FLOATING)
    check_tensor(name, "gradient", gradient, (hessian.shape[0], 6), hessian.dtype, like=hessian)
    check(damping >= 0, name, "damping", "be at least 0", damping)
    check(absolute_damping >= 0, name, "absolute_damping", "be at least 0", absolute_damping)
    with torch.no_grad():
        return torch.ops.spslam.solve_normal_equations(hessian, gradient, damping, absolute_damping)


@torch.library.register_fake("spslam::sparse_adam_")
def _(param, grad, exp_avg, exp_avg_sq, stamps, stamp, lr, beta1, beta2, eps, step):
    return None


@torch.library.register_fake("spslam::normal_equations")
def _(residuals, jacobians, weights):
    frames = residuals.shape[0]
    return residuals.new_empty(frames, 6, 6), residuals.new_empty(frames, 6), residuals.new_empty(frames)


@torch.library.register_fake("spslam::solve_normal_equations")
def _(hessian, gradient, damping, absolute_damping):
    return torch.empty_like(gradient, memory_format=torch.contiguous_format)


register_rows_vmap("normal_equations", (0, 1, 2))
register_rows_vmap("solve_normal_equations", (0, 1))
