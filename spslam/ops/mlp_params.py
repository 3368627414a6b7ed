"""Parameters of `mlp`: drawn, taken from a `torch.nn.Sequential`, and given back to one."""

import math
from typing import Any

import torch

from spslam.ops._checks import FLOATING, check, check_tensor
from spslam.ops._mlp_layers import MOST_LAYERS, Activation, Network, check_activation, check_network, split_params
from spslam.ops._public import public_op
from spslam.ops.decoders import mlp_num_params

_MODULES = {
    torch.nn.Tanh: Activation.TANH,
    torch.nn.Sigmoid: Activation.SIGMOID,
    torch.nn.ReLU: Activation.RELU,
    torch.nn.Softplus: Activation.SOFTPLUS,
}
# torch's default, from which on softplus is the identity; `mlp` has no other.
_SOFTPLUS_THRESHOLD = 20


class Sine(torch.nn.Module):
    """sin(scale x), which torch has no module for.

    Args:
        scale: SIREN's omega.
    """

    def __init__(self, scale: float = 1.0):
        super().__init__()
        self.scale = scale

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """The sine of a tensor of any shape."""
        return torch.sin(self.scale * x)


@public_op()
def mlp_init_params(
    inputs: int,
    hidden: int,
    outputs: int,
    layers: int = 2,
    hidden_activation: int = Activation.RELU,
    scale: float = 1.0,
    bias: bool = True,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Parameters to begin with: as `torch.nn.Linear` draws them, and for sines as SIREN does.

    Uniform in +-1 / sqrt(fan in). For `Activation.SINE` weights are uniform in +-1 / inputs in the first layer and in
    +-sqrt(6 / hidden) / scale in all others (Sitzmann et al., "Implicit Neural Representations with Periodic Activation
    Functions", section 3.2).

    Args:
        inputs: I.
        hidden: H.
        outputs: O.
        layers: number of hidden layers, 1 to 4.
        hidden_activation: an `Activation`.
        scale: as for `mlp`; that of a sine counts here, any other is only checked.
        bias: whether layers have biases.
        generator: what draws; None for torch's own.

    Returns:
        params float32 [P] on the CPU, a leaf without gradient.

    Raises:
        ValueError: a width or number out of range.

    Example:
        >>> params = torch.nn.Parameter(mlp_init_params(11, 32, 1))
        >>> params.shape
        torch.Size([1473])
    """
    for name, width in (("inputs", inputs), ("hidden", hidden), ("outputs", outputs)):
        check(1 <= width <= 2**20, "mlp_init_params", name, "be in [1, 2^20]", width)
    check_network("mlp_init_params", layers, hidden_activation, scale)
    count = mlp_num_params(inputs, hidden, outputs, layers, bias)
    params = torch.empty(count, dtype=torch.float32, device="cpu")
    network = Network(hidden, outputs, layers, Activation.NONE, hidden_activation, scale, bias)
    for i, (weight, offset) in enumerate(split_params(network, inputs, params)):
        fan_in = weight.shape[1]
        bound = 1 / math.sqrt(fan_in)
        if hidden_activation == Activation.SINE:
            weight.uniform_(*_both(1 / fan_in if i == 0 else math.sqrt(6 / fan_in) / scale), generator=generator)
        else:
            weight.uniform_(*_both(bound), generator=generator)
        if offset is not None:
            offset.uniform_(*_both(bound), generator=generator)
    return params


@public_op()
def mlp_params_from(network: torch.nn.Sequential) -> tuple[torch.Tensor, dict[str, Any]]:
    """Parameters and options of `mlp` for a `torch.nn.Sequential`, so that mlp(x, params, **options) is network(x).

    Args:
        network: `torch.nn.Linear` with one activation between each two, all hidden layers of one width and one
            activation: `ReLU`, `Softplus` of the usual threshold, `Tanh`, `Sigmoid` or `ops.Sine`; after the last, one
            or none. All with biases or all without.

    Returns:
        params [P], a copy that gradients flow through, and options for `mlp`: hidden, output, activation, layers,
        hidden_activation and scale.

    Raises:
        ValueError: `network` is anything else.

    Example:
        >>> linear = torch.nn.Linear
        >>> network = torch.nn.Sequential(linear(3, 64), torch.nn.Softplus(beta=100), linear(64, 1))
        >>> params, options = mlp_params_from(network)
        >>> options["layers"], options["hidden_activation"], options["scale"]
        (1, <Activation.SOFTPLUS: 4>, 100.0)
    """
    name, last = "mlp_params_from", (Activation.NONE, 1.0)
    linear: list[torch.nn.Linear] = []
    between: list[tuple[Activation, float]] = []
    for i, module in enumerate(network):
        if i % 2 == 0:
            check(isinstance(module, torch.nn.Linear), name, "network", "alternate Linear and activation", module)
            linear += [module] if isinstance(module, torch.nn.Linear) else []
        else:
            between.append(_activation_of(name, module))
    if len(between) == len(linear) and between:
        last = between.pop()
    depth = len(linear) - 1
    check(1 <= depth <= MOST_LAYERS, name, "network", "have one to four hidden layers", depth)
    check(len(set(between)) == 1, name, "network", "have one activation between all layers", between)
    widths = {layer.out_features for layer in linear[:-1]}
    check(len(widths) == 1, name, "network", "have hidden layers of one width", sorted(widths))
    check(last[1] == 1, name, "network", "have no scale in its last activation", last[1])
    biases = [layer.bias for layer in linear]
    check(len({part is None for part in biases}) == 1, name, "network", "have biases in all layers or none", biases)
    parts = [part for layer in linear for part in (layer.weight.flatten(), layer.bias) if part is not None]
    hidden_activation, scale = between[0]
    options = dict(hidden=widths.pop(), output=linear[-1].out_features, activation=last[0], layers=depth)
    return torch.cat(parts), options | dict(hidden_activation=hidden_activation, scale=scale)


@public_op()
def mlp_to_sequential(
    params: torch.Tensor,
    inputs: int,
    hidden: int,
    output: int,
    activation: int = Activation.NONE,
    layers: int = 2,
    hidden_activation: int = Activation.RELU,
    scale: float = 1.0,
) -> torch.nn.Sequential:
    """The network of `mlp` as modules, the reverse of `mlp_params_from`.

    Args:
        params: [P], as for `mlp`; copied.
        inputs: I.
        hidden, output, activation, layers, hidden_activation, scale: as for `mlp`.

    Returns:
        Modules of the dtype and on the device of `params`.

    Raises:
        TypeError: `params` is no tensor.
        ValueError: `params` of another length, or an activation, scale or number of layers that `mlp` refuses.

    Example:
        >>> params = mlp_init_params(3, 16, 1)
        >>> mlp_to_sequential(params, 3, hidden=16, output=1)[0]
        Linear(in_features=3, out_features=16, bias=True)
    """
    name = "mlp_to_sequential"
    check_activation(name, activation)
    check_network(name, layers, hidden_activation, scale)
    lengths = {mlp_num_params(inputs, hidden, output, layers, bias): bias for bias in (True, False)}
    length = params.numel() if isinstance(params, torch.Tensor) else None
    bias = lengths.get(length, True)
    wanted = length if length in lengths else next(iter(lengths))
    check_tensor(name, "params", params, [wanted], FLOATING)
    network = Network(hidden, output, layers, activation, hidden_activation, scale, bias)
    modules: list[torch.nn.Module] = []
    for i, (weight, offset) in enumerate(split_params(network, inputs, params.detach())):
        layer = torch.nn.Linear(weight.shape[1], weight.shape[0], bias, device=params.device, dtype=params.dtype)
        layer.load_state_dict({"weight": weight} | ({} if offset is None else {"bias": offset}))
        modules += [layer, *_modules_of(hidden_activation if i < layers else activation, scale if i < layers else 1.0)]
    return torch.nn.Sequential(*modules)


def _both(bound: float) -> tuple[float, float]:
    return -bound, bound


def _activation_of(name: str, module: torch.nn.Module) -> tuple[Activation, float]:
    if isinstance(module, Sine):
        return Activation.SINE, module.scale
    known = type(module) in _MODULES
    check(known, name, "network", "have ReLU, Softplus, Tanh, Sigmoid or ops.Sine between its layers", module)
    if not isinstance(module, torch.nn.Softplus):
        return _MODULES[type(module)], 1.0
    usual = module.threshold == _SOFTPLUS_THRESHOLD
    check(usual, name, "network", f"have softplus of threshold {_SOFTPLUS_THRESHOLD}", module.threshold)
    return Activation.SOFTPLUS, float(module.beta)


def _modules_of(activation: int, scale: float) -> list[torch.nn.Module]:
    if activation == Activation.SINE:
        return [Sine(scale)]
    if activation == Activation.SOFTPLUS:
        return [torch.nn.Softplus(beta=scale)]
    return [module() for module, known in _MODULES.items() if known == activation]
