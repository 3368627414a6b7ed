"""What the gradients of all ops share: how they are registered, and errors where torch would give silent zeros."""

from collections.abc import Callable, Sequence

import torch
from torch.autograd import forward_ad

from spslam.ops._dispatch import full_precision, functions
from spslam.ops._vmap import vmap_rule

# Those that may carry tangents; of fake tensors too.
_AUTOGRAD_KEYS = ("AutogradCPU", "AutogradCUDA", "AutogradMeta")

# Kept: what is registered through it lives as long as it does.
_fragment = torch.library.Library("spslam", "FRAGMENT")


def register_gradient(
    op: str,
    backward: Callable,
    setup_context: Callable,
    composite: Callable | None = None,
    title: Callable[[tuple], str] | None = None,
) -> None:
    """Makes an op differentiable in reverse mode; what is missing is an error.

    Args:
        op: its name.
        backward, setup_context: as `torch.library.register_autograd` takes them.
        composite: what the op `<op>_backward` computes, written in ops that are differentiable themselves: takes its
            arguments, of which the last say which outputs are needed, and returns the outputs, None for the others.
            Derivatives of second and any higher order are taken of it; without it, they are refused.
        title: the name that errors begin with, from the arguments of the op or of `<op>_backward`; None for `op`.
    """
    title = title or (lambda args: op)
    _register(op, title, backward, setup_context)
    if not hasattr(torch.ops.spslam, f"{op}_backward"):
        return
    if composite is None:

        def refuse(ctx, *grads):
            raise NotImplementedError(f"{op}: second derivatives are not supported")

        _register(f"{op}_backward", title, refuse, _save_nothing)
    else:
        _register(f"{op}_backward", title, _backward_of(composite), _save_arguments)


def _register(registered: str, title: Callable, backward: Callable, setup_context: Callable) -> None:
    torch.library.register_autograd(f"spslam::{registered}", backward, setup_context=setup_context)
    _forbid_forward_mode(registered, title)
    functions[registered] = _function_of(registered, backward, setup_context)


def _save_nothing(ctx, inputs, output):
    pass


def _save_arguments(ctx, inputs, output):
    ctx.tensors = [i for i, value in enumerate(inputs) if isinstance(value, torch.Tensor)]
    ctx.others = [None if isinstance(value, torch.Tensor) else value for value in inputs]
    ctx.save_for_backward(*(inputs[i] for i in ctx.tensors))
    ctx.set_materialize_grads(False)  # of two gradients often only one is differentiated again


def _backward_of(composite: Callable) -> Callable:
    """The gradient of a composite's arguments from those of its outputs."""

    def backward(ctx, *grads):
        arguments = list(ctx.others)
        for i, tensor in zip(ctx.tensors, ctx.saved_tensors, strict=True):
            arguments[i] = tensor
        # The last arguments say which outputs are needed: those alone that something came back for.
        asked = arguments[-len(grads) :]
        arguments[-len(grads) :] = [need and grad is not None for need, grad in zip(asked, grads, strict=True)]
        wanted = [i for i in ctx.tensors if ctx.needs_input_grad[i]]
        kept: list[int] = []

        def outputs(*tensors):
            given = list(arguments)
            for i, tensor in zip(wanted, tensors, strict=True):
                given[i] = tensor
            results = composite(*given)
            kept[:] = [i for i, result in enumerate(results) if result is not None and grads[i] is not None]
            return tuple(results[i] for i in kept)

        pull_back = _pull_back_inside_func if torch._C._are_functorch_transforms_active() else _pull_back
        with full_precision(arguments[ctx.tensors[0]]):
            found = pull_back(outputs, [arguments[i] for i in wanted], lambda: tuple(grads[i] for i in kept))
        every: list[torch.Tensor | None] = [None] * len(arguments)
        for i, gradient in zip(wanted, found, strict=True):
            every[i] = gradient
        return tuple(every)

    return backward


def _pull_back(function: Callable, tensors: list, grads: Callable) -> Sequence[torch.Tensor | None]:
    """Gradients of a function's arguments from those of its outputs, by torch.autograd.

    What torch.func.vjp does, without the seconds that the first use of torch.func costs.
    """
    again = torch.is_grad_enabled()  # whether the result is to be differentiated too
    with torch.enable_grad():
        # Views, so that a tensor that another one was computed from gets its own share alone.
        own = [tensor.view_as(tensor) if again else tensor.detach().requires_grad_() for tensor in tensors]
        results = function(*own)
    pairs = [(result, grad) for result, grad in zip(results, grads(), strict=True) if result.requires_grad]
    if not pairs:
        return [None] * len(tensors)
    outputs, given = [result for result, _ in pairs], [grad for _, grad in pairs]
    return torch.autograd.grad(outputs, own, given, create_graph=again, allow_unused=True)


def _pull_back_inside_func(function: Callable, tensors: list, grads: Callable) -> Sequence[torch.Tensor | None]:
    """The same inside of a transform of torch.func, where torch.autograd.grad is not allowed."""
    return torch.func.vjp(function, *tensors)[1](grads())


def _function_of(registered: str, backward_: Callable, setup_context_: Callable) -> type:
    """The op as torch.func takes it."""

    class OpFunction(torch.autograd.Function):
        @staticmethod
        def forward(*args):
            return getattr(torch.ops.spslam, registered)(*args)

        setup_context = staticmethod(setup_context_)
        backward = staticmethod(backward_)

        @staticmethod
        def vmap(info, in_dims, *args):
            return vmap_rule(registered)(info, in_dims, *args)

        @staticmethod
        def jvp(ctx, *tangents):
            raise NotImplementedError(f"{registered}: forward-mode AD is not supported, use reverse mode")

    OpFunction.__name__ = OpFunction.__qualname__ = registered
    return OpFunction


def _forbid_forward_mode(registered: str, title: Callable[[tuple], str]) -> None:
    """Makes a tangent among the inputs an error that names the op: torch's kernel would drop it, as if it were zero.

    In front of the kernel that register_autograd made, so that it sees what torch.func and torch.vmap unwrap.
    """

    def guarded(key: str) -> Callable:
        kernel = torch.library.get_kernel(f"spslam::{registered}", key)

        def call(keyset, *args, **kwargs):
            if any(_has_tangent(value) for value in args):
                raise NotImplementedError(f"{title(args)}: forward-mode AD is not supported, use reverse mode")
            return kernel.call_boxed(keyset, *args, **kwargs)

        return call

    for key in _AUTOGRAD_KEYS:
        _fragment.impl(registered, guarded(key), key, with_keyset=True)


def _has_tangent(value: object) -> bool:
    return isinstance(value, torch.Tensor) and forward_ad.unpack_dual(value).tangent is not None
