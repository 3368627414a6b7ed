"""What the gradients of all ops share: how they are registered, and errors where torch would give silent zeros."""

from collections.abc import Callable

import torch
from torch.autograd import forward_ad

# Those that may carry tangents; of fake tensors too.
_AUTOGRAD_KEYS = ("AutogradCPU", "AutogradCUDA", "AutogradMeta")

# Kept: what is registered through it lives as long as it does.
_fragment = torch.library.Library("spslam", "FRAGMENT")


def register_gradient(op: str, backward: Callable, setup_context: Callable) -> None:
    """Makes an op differentiable, once and in reverse mode; anything else is an error.

    Args:
        op: its name. Where there is an op `<op>_backward`, second derivatives and forward-mode AD of that are refused.
        backward, setup_context: as `torch.library.register_autograd` takes them.
    """
    torch.library.register_autograd(f"spslam::{op}", backward, setup_context=setup_context)
    _forbid_forward_mode(op, op)
    if hasattr(torch.ops.spslam, f"{op}_backward"):
        _forbid_second_derivatives(op)
        _forbid_forward_mode(f"{op}_backward", op)


def _forbid_second_derivatives(op: str) -> None:
    """Makes differentiating `<op>_backward` an error: without this its result would silently count as a constant."""

    def backward(ctx, *grads):
        raise NotImplementedError(f"{op}: second derivatives are not supported")

    torch.library.register_autograd(f"spslam::{op}_backward", backward)


def _forbid_forward_mode(registered: str, op: str) -> None:
    """Makes a tangent among the inputs an error that names `op`: torch's kernel would drop it, as if it were zero.

    In front of the kernel that register_autograd made, so that it sees what torch.func and torch.vmap unwrap.
    """

    def guarded(key: str) -> Callable:
        kernel = torch.library.get_kernel(f"spslam::{registered}", key)

        def call(keyset, *args, **kwargs):
            if any(_has_tangent(value) for value in args):
                raise NotImplementedError(f"{op}: forward-mode AD is not supported, use reverse mode")
            return kernel.call_boxed(keyset, *args, **kwargs)

        return call

    for key in _AUTOGRAD_KEYS:
        _fragment.impl(registered, guarded(key), key, with_keyset=True)


def _has_tangent(value: object) -> bool:
    return isinstance(value, torch.Tensor) and forward_ad.unpack_dual(value).tangent is not None
