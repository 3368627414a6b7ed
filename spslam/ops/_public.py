"""What every public op does before its own checks."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch

from spslam.ops._numbers import number_rules

P = ParamSpec("P")
R = TypeVar("R")

_LOWERED = (torch.float16, torch.bfloat16)


def public_op(*, name: str | None = None, as_given: tuple[str, ...] = ()) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of a public op: checks its numbers, and casts its tensors in an autocast region.

    Numbers are checked by their annotations, see `_numbers`. Where torch.autocast is on for a tensor's device, float16
    and bfloat16 become float32, in which the kernels compute: what a `torch.nn.Linear` gives there can go straight into
    an op, and gradients flow back through the cast.

    Args:
        name: of the op in messages; None for the function's own.
        as_given: tensors that are not cast: those changed in place, and those whose dtype is meant.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        title = name or function.__name__
        rules = number_rules(function)
        parameters = tuple(inspect.signature(function).parameters)

        @functools.wraps(function)
        def checked(*args: Any, **kwargs: Any) -> R:
            named = [*zip(parameters, args, strict=False), *kwargs.items()]
            for argument, value in named:
                rule = rules.get(argument)
                if rule is not None and not rule.fits(value):
                    rule.refuse(title, argument, value)
            if any(_is_lowered(value) for _, value in named):
                positional = [_cast(a, v, as_given) for a, v in zip(parameters, args, strict=False)]
                args = (*positional, *args[len(parameters) :])
                kwargs = {argument: _cast(argument, value, as_given) for argument, value in kwargs.items()}
            return function(*args, **kwargs)

        return checked

    return decorate


def changed_in_place(*tensors: torch.Tensor | None) -> None:
    """Tells autograd that an op has written to tensors: a gradient that needs what was there is then an error."""
    if torch.compiler.is_compiling():  # what a compiled graph changes stands in the op's schema
        return
    for tensor in tensors:
        if tensor is not None and not tensor.is_inference():
            torch.autograd.graph.increment_version(tensor)


def _is_lowered(value: object) -> bool:
    return isinstance(value, torch.Tensor) and value.dtype in _LOWERED


def _cast(argument: str, value: Any, as_given: tuple[str, ...]) -> Any:
    """The value in float32, if it is a tensor that autocast made smaller."""
    if argument in as_given or not _is_lowered(value) or not torch.is_autocast_enabled(value.device.type):
        return value
    return value.float()
