"""How an op of the library is called: by torch's dispatcher, or inside of torch.func as a Function.

torch.func's transforms of reverse mode do not accept an op whose gradient was registered with
`torch.library.register_autograd`; there it is called as an autograd.Function of the same gradients.
"""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch._C._functorch import TransformType, get_interpreter_stack

# By the op's name; `_autograd` fills it.
functions: dict[str, type[torch.autograd.Function]] = {}


def call(op: str, *args: Any) -> Any:
    """Calls an op of the library, `torch.ops.spslam.<op>`, with its gradients."""
    if not torch.compiler.is_compiling() and torch._C._are_functorch_transforms_active() and _in_reverse_mode():
        return functions[op].apply(*args)
    return getattr(torch.ops.spslam, op)(*args)


def _in_reverse_mode() -> bool:
    """Whether one of torch.func's transforms in force is of reverse mode: grad, vjp, jacrev."""
    return any(level.key() == TransformType.Grad for level in get_interpreter_stack() or ())


def full_precision(tensor: torch.Tensor) -> AbstractContextManager:
    """Where an op is made of torch's operations: they must not compute in 16 bits in an autocast region either."""
    kind = tensor.device.type
    if kind in ("cpu", "cuda") and torch.is_autocast_enabled(kind):
        return torch.autocast(kind, enabled=False)
    return nullcontext()
