"""Small multi-layer perceptrons: the geometry and color decoders (equations 2 and 4)."""

from enum import IntEnum

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._autograd import register_gradient
from spslam.ops._checks import FLOATING, check, check_count, check_tensor
from spslam.ops._public import public_op
from spslam.ops._vmap import register_each_vmap, register_rows_vmap


class Activation(IntEnum):
    """Activation of the last layer. Duplicated in csrc/include/spslam/decoders.h."""

    NONE = 0
    TANH = 1
    SIGMOID = 2


@public_op()
def mlp_num_params(inputs: int, hidden: int, outputs: int) -> int:
    """Length of the flat parameter vector of `mlp`: H (I + 1) + H (H + 1) + O (H + 1).

    Args:
        inputs: I.
        hidden: H.
        outputs: O.

    Example:
        >>> mlp_num_params(11, 32, 1)
        1473
    """
    return hidden * (inputs + 1) + hidden * (hidden + 1) + outputs * (hidden + 1)


@public_op()
def mlp(
    input: torch.Tensor, params: torch.Tensor, hidden: int, output: int, activation: int = Activation.NONE
) -> torch.Tensor:
    """A multi-layer perceptron with two hidden layers and ReLU between its three linear layers.

    y = a(W3 relu(W2 relu(W1 x + b1) + b2) + b3), the decoders of equations (2) and (4). All layers are computed for one
    tile of samples at a time, in cache, or on CUDA in shared memory if it fits. No intermediate values are saved for
    the backward pass, which recomputes them.

    Args:
        input: float32 or float64 [N, I].
        params: [P] of the same dtype: W1 [H, I], b1 [H], W2 [H, H], b2 [H], W3 [O, H], b3 [O], each row-major
            (`torch.nn.Linear`'s layout), one after another; P = `mlp_num_params(I, hidden, output)`.
        hidden: width H of both hidden layers.
        output: number of outputs, O.
        activation: activation of the last layer, an `Activation`.

    Returns:
        [N, O], differentiable with respect to `input` and `params`. N = 0 gives an empty tensor and zero gradients. A
        row of `input` with NaN gives a row of NaN.

        Gradients of `params` are summed over the samples in an order that depends only on N: the same bits for any
        number of threads, and in every run on CUDA.

    Raises:
        TypeError: `input` is not float32 or float64, or `params` of another dtype.
        ValueError: a shape, width or activation out of range.

    Example:
        >>> x = torch.randn(1000, 11)
        >>> sdf = mlp(x, torch.randn(mlp_num_params(11, 32, 1)) / 6, hidden=32, output=1, activation=Activation.TANH)
        >>> sdf.shape
        torch.Size([1000, 1])
    """
    check_tensor("mlp", "input", input, ["N", "I"], FLOATING)
    check_count("mlp", "hidden", hidden)
    check_count("mlp", "output", output)
    check(int(activation) in (0, 1, 2), "mlp", "activation", "be 0, 1 or 2", activation)
    check_tensor("mlp", "params", params, [mlp_num_params(input.shape[1], hidden, output)], input.dtype, like=input)
    return torch.ops.spslam.mlp(input, params, hidden, output, int(activation))


@torch.library.register_fake("spslam::mlp")
def _mlp_fake(input, params, hidden, output, activation):
    return input.new_empty((input.shape[0], output))


@torch.library.register_fake("spslam::mlp_backward")
def _mlp_backward_fake(grad, input, params, hidden, output, activation, need_grad_input=True, need_grad_params=True):
    rows = input.shape[0] if need_grad_input else 0
    return input.new_empty((rows, input.shape[1])), input.new_empty((params.shape[0] if need_grad_params else 0,))


def _setup_context(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:2])
    ctx.widths = inputs[2:]


def _mlp_backward(ctx, grad):
    input, params = ctx.saved_tensors
    need_input, need_params = ctx.needs_input_grad[:2]
    grad_input, grad_params = torch.ops.spslam.mlp_backward(grad, input, params, *ctx.widths, need_input, need_params)
    return grad_input if need_input else None, grad_params if need_params else None, None, None, None


register_gradient("mlp", _mlp_backward, _setup_context)
register_rows_vmap("mlp", (0,))
register_each_vmap("mlp_backward")
