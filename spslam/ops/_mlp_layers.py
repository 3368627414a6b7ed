"""A multi-layer perceptron as torch's matrix products: any depth and activation, and its gradients as formulas."""

from enum import IntEnum
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812

from spslam.ops._checks import check

MOST_LAYERS = 4  # hidden ones


class Activation(IntEnum):
    """Activation of a layer of `mlp`. The first three are also in csrc/include/spslam/decoders.h."""

    NONE = 0
    TANH = 1
    SIGMOID = 2
    RELU = 3
    SOFTPLUS = 4
    SINE = 5


class Network(NamedTuple):
    """What `mlp` is asked for beside input and parameters; see there."""

    hidden: int
    output: int
    layers: int
    activation: int
    hidden_activation: int
    scale: float
    bias: bool


def check_network(function: str, layers: int, hidden_activation: int, scale: float) -> None:
    """Checks the hidden layers that a function is asked for, on its behalf."""
    check(1 <= layers <= MOST_LAYERS, function, "layers", f"be in [1, {MOST_LAYERS}]", layers)
    inner = 0 < int(hidden_activation) < len(Activation)
    check(inner, function, "hidden_activation", "be an Activation, 0 to 5, but not 0", hidden_activation)
    has_scale = hidden_activation in (Activation.SOFTPLUS, Activation.SINE)
    rule = "be positive, and 1 but for softplus and sine"
    check(scale > 0 if has_scale else scale == 1, function, "scale", rule, scale)


def check_activation(function: str, activation: int) -> None:
    """Checks the activation of the last layer."""
    check(0 <= int(activation) < len(Activation), function, "activation", "be an Activation, 0 to 5", activation)


def split_params(network: Network, inputs: int, params: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor | None]]:
    """Weight [outputs, inputs] and bias of each layer, views of the flat parameters."""
    widths = [inputs, *[network.hidden] * network.layers, network.output]
    sizes, shapes = [], list(zip(widths[1:], widths[:-1], strict=True))
    for rows, columns in shapes:
        sizes += [rows * columns, rows] if network.bias else [rows * columns]
    parts = params.split(sizes)
    step = 2 if network.bias else 1
    return [
        (parts[step * i].view(shape), parts[step * i + 1] if network.bias else None) for i, shape in enumerate(shapes)
    ]


def apply_network(network: Network, input: torch.Tensor, params: torch.Tensor) -> torch.Tensor:
    """The outputs [N, O]."""
    x = input
    layers = split_params(network, input.shape[1], params)
    for weight, bias in layers[:-1]:
        x = activate(network.hidden_activation, F.linear(x, weight, bias), network.scale)
    weight, bias = layers[-1]
    return activate(network.activation, F.linear(x, weight, bias), 1.0)


def activate(activation: int, x: torch.Tensor, scale: float) -> torch.Tensor:
    """An activation of pre-activations."""
    if activation == Activation.TANH:
        return x.tanh()
    if activation == Activation.SIGMOID:
        return x.sigmoid()
    if activation == Activation.RELU:
        return x.relu()
    if activation == Activation.SOFTPLUS:
        return F.softplus(x, scale)
    if activation == Activation.SINE:
        return (scale * x).sin()
    return x


def network_gradients(
    network: Network, grad: torch.Tensor, input: torch.Tensor, params: torch.Tensor, need_input: bool, need_params: bool
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Gradients of the input and of the parameters of a network with ReLU, as formulas that are differentiable.

    The last activation is none, tanh or sigmoid; the derivative of ReLU at 0 is 0.
    """
    layers = split_params(network, input.shape[1], params)
    values = [input]
    for weight, bias in layers[:-1]:
        values.append(F.linear(values[-1], weight, bias).relu())
    weight, bias = layers[-1]
    result = activate(network.activation, F.linear(values[-1], weight, bias), 1.0)
    if network.activation == Activation.TANH:
        grad = grad * (1 - result * result)
    elif network.activation == Activation.SIGMOID:
        grad = grad * result * (1 - result)
    parts: list[torch.Tensor] = []
    for i in reversed(range(len(layers))):
        if need_params:
            parts = [(grad.mT @ values[i]).flatten(), grad.sum(0), *parts]
        if i > 0:
            grad = (grad @ layers[i][0]) * (values[i].detach() > 0)
        elif need_input:
            grad = grad @ layers[i][0]
    return grad if need_input else None, torch.cat(parts) if need_params else None
