"""Small multi-layer perceptrons: the geometry and color decoders (equations 2 and 4), and other people's."""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._autograd import register_gradient
from spslam.ops._checks import FLOATING, check, check_count, check_tensor, flat_rows, rows_shape, unflat_rows
from spslam.ops._dispatch import call, full_precision
from spslam.ops._mlp_layers import (
    Activation,
    Network,
    apply_network,
    check_activation,
    check_network,
    network_gradients,
)
from spslam.ops._public import public_op
from spslam.ops._vmap import register_each_vmap, register_rows_vmap

_KERNEL_LAYERS = 2
_KERNEL_OUTPUTS = (Activation.NONE, Activation.TANH, Activation.SIGMOID)
# Wider hidden layers do not fit a block's shared memory on CUDA, where a matrix library is faster.
_WIDEST_ON_CUDA = 64


@public_op()
def mlp_num_params(inputs: int, hidden: int, outputs: int, layers: int = 2, bias: bool = True) -> int:
    """Length of the flat parameter vector of `mlp`: H (I + 1) + (L - 1) H (H + 1) + O (H + 1).

    Args:
        inputs: I.
        hidden: H.
        outputs: O.
        layers: L, number of hidden layers.
        bias: whether layers have biases; without, it is H I + (L - 1) H H + O H.

    Example:
        >>> mlp_num_params(11, 32, 1)
        1473
    """
    check(layers >= 1, "mlp_num_params", "layers", "be at least 1", layers)
    one = int(bias)
    return hidden * (inputs + one) + (layers - 1) * hidden * (hidden + one) + outputs * (hidden + one)


@public_op()
def mlp(
    input: torch.Tensor,
    params: torch.Tensor,
    hidden: int,
    output: int,
    activation: int = Activation.NONE,
    layers: int = 2,
    hidden_activation: int = Activation.RELU,
    scale: float = 1.0,
) -> torch.Tensor:
    """A multi-layer perceptron with one to four hidden layers of the same width.

    y = a(W3 h(W2 h(W1 x + b1) + b2) + b3) for two hidden layers, the decoders of equations (2) and (4). With two hidden
    layers, ReLU and biases, all layers are computed for one tile of samples at a time, in cache, or on CUDA in shared
    memory, for hidden layers of up to 64 there; no intermediate values are saved for the backward pass, which
    recomputes them. Any other network is one of torch's matrix products per layer.

    Args:
        input: float32 or float64 [N, I], or [..., I].
        params: [P] of the same dtype: W1 [H, I], b1 [H], W2 [H, H], b2 [H], ..., [O, H], [O], each row-major
            (`torch.nn.Linear`'s layout), one after another; P = `mlp_num_params(I, hidden, output, layers)`, or that
            with bias=False: then there are no biases. See `mlp_init_params` and `mlp_params_from`.
        hidden: width H of the hidden layers.
        output: number of outputs, O.
        activation: activation of the last layer, an `Activation`.
        layers: number of hidden layers, 1 to 4.
        hidden_activation: activation between the layers, an `Activation`: ReLU, softplus, tanh, sigmoid or sine.
        scale: of hidden softplus, log(1 + exp(scale x)) / scale, and sine, sin(scale x); 1 for any other.

    Returns:
        [N, O], differentiable to any order with respect to `input` and `params`. N = 0 gives an empty tensor and zero
        gradients. A row of `input` with NaN gives a row of NaN.

        Gradients of `params` are summed over the samples in an order that depends only on N: the same bits for any
        number of threads, and in every run on CUDA; where torch's products compute them, in its order.

    Raises:
        TypeError: `input` is not float32 or float64, or `params` of another dtype.
        ValueError: a shape, width or activation out of range.

    Example:
        >>> x = torch.randn(1000, 11)
        >>> sdf = mlp(x, torch.randn(mlp_num_params(11, 32, 1)) / 6, hidden=32, output=1, activation=Activation.TANH)
        >>> sdf.shape
        torch.Size([1000, 1])
    """
    check_tensor("mlp", "input", input, rows_shape(input, "I"), FLOATING)
    check_count("mlp", "hidden", hidden)
    check_count("mlp", "output", output)
    check_activation("mlp", activation)
    check_network("mlp", layers, hidden_activation, scale)
    bias = _has_bias(input.shape[-1], params, hidden, output, layers)
    length = mlp_num_params(input.shape[-1], hidden, output, layers, bias)
    check_tensor("mlp", "params", params, [length], input.dtype, like=input)
    rows = flat_rows(input)
    in_kernel = layers == _KERNEL_LAYERS and bias and hidden_activation == Activation.RELU
    if in_kernel and activation in _KERNEL_OUTPUTS and not (input.is_cuda and hidden > _WIDEST_ON_CUDA):
        result = call("mlp", rows, params, hidden, output, int(activation))
    else:
        network = Network(hidden, output, layers, int(activation), int(hidden_activation), scale, bias)
        with full_precision(rows):
            result = apply_network(network, rows, params)
    return unflat_rows(result, input.shape[:-1])


def _has_bias(inputs: int, params: torch.Tensor, hidden: int, output: int, layers: int) -> bool:
    """Whether the parameters are those of layers with biases, by their number; so too if it fits neither."""
    length = params.numel() if isinstance(params, torch.Tensor) else None
    return bool(length != mlp_num_params(inputs, hidden, output, layers, bias=False))


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
    grad_input, grad_params = call("mlp_backward", grad, input, params, *ctx.widths, need_input, need_params)
    return grad_input if need_input else None, grad_params if need_params else None, None, None, None


def _composite(grad, input, params, hidden, output, activation, need_grad_input=True, need_grad_params=True):
    """`mlp_backward` in torch's operations."""
    network = Network(hidden, output, _KERNEL_LAYERS, activation, Activation.RELU, 1.0, True)
    return network_gradients(network, grad, input, params, need_grad_input, need_grad_params)


register_rows_vmap("mlp", (0,))
register_each_vmap("mlp_backward")
register_gradient("mlp", _mlp_backward, _setup_context, _composite)
