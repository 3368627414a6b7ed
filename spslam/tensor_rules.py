"""What a file of named tensors must hold: rules for each tensor, and relations between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from spslam.errors import SpslamError

Sizes = dict[str, int]
Layout = tuple[torch.dtype, tuple[int, ...]]
Relation = Callable[[Mapping[str, Tensor], Sizes], None]


@dataclass(frozen=True)
class TensorRule:
    """What one tensor must be. Floating-point values must always be finite.

    Attributes:
        dtype: of its values.
        shape: of each axis the size, or the name of a size: a name stands for the same number in the whole file.
        low: least value; None for any.
        high: largest value; None for any.
        optional: whether the file may lack it.
    """

    dtype: torch.dtype
    shape: tuple[int | str, ...]
    low: float | None = None
    high: float | None = None
    optional: bool = False


@dataclass(frozen=True)
class TensorSchema:
    """The tensors of one kind of file.

    Attributes:
        rules: by name of the tensor. Other tensors in a file are ignored.
        relations: called with the tensors and the sizes, after all rules hold; raise SpslamError.
        pairs: names of optional tensors of which a file must have both or neither.
    """

    rules: Mapping[str, TensorRule]
    relations: tuple[Relation, ...] = ()
    pairs: tuple[tuple[str, str], ...] = field(default=())

    def check_layouts(self, layouts: Mapping[str, Layout], sizes: Mapping[str, int]) -> Sizes:
        """Checks names, dtypes and shapes, which a file's header tells before any tensor is read.

        Args:
            layouts: dtype and shape by name.
            sizes: those that are known beforehand, by name.

        Returns:
            All sizes, by name.

        Raises:
            SpslamError: names the first tensor at fault.
        """
        known = dict(sizes)
        for name, rule in self.rules.items():
            if name in layouts:
                _check_layout(name, layouts[name], rule, known)
            elif not rule.optional:
                raise SpslamError(f"tensor {name} is missing")
        for one, other in self.pairs:
            if (one in layouts) != (other in layouts):
                raise SpslamError(f"tensors {one} and {other} must both be there, got one of them")
        return known

    def check(self, tensors: Mapping[str, Tensor], sizes: Mapping[str, int]) -> None:
        """Checks everything; raises SpslamError, which names the first tensor at fault.

        Args:
            tensors: by name, on any device.
            sizes: those that are known beforehand, by name.
        """
        layouts = {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors.items()}
        known = self.check_layouts(layouts, sizes)
        for name, rule in self.rules.items():
            if name in tensors:
                check_values(name, tensors[name], rule)
        for relation in self.relations:
            relation(tensors, known)


def _check_layout(name: str, layout: Layout, rule: TensorRule, sizes: Sizes) -> None:
    dtype, shape = layout
    fits = dtype == rule.dtype and len(shape) == len(rule.shape)
    for actual, wanted in zip(shape, rule.shape, strict=False):
        fits &= actual == (sizes.setdefault(wanted, actual) if isinstance(wanted, str) else wanted)
    if not fits:
        wanted = ", ".join(str(sizes.get(size, size) if isinstance(size, str) else size) for size in rule.shape)
        raise SpslamError(f"tensor {name} must be {_name(rule.dtype)} [{wanted}], got {_name(dtype)} {list(shape)}")


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def check_values(name: str, tensor: Tensor, rule: TensorRule) -> None:
    """Raises SpslamError where a value is not finite or outside the rule's range."""
    if tensor.numel() == 0:
        return
    if rule.dtype == torch.bool:
        # Any byte can stand in a file, and kernels take one above 1 for neither true nor false.
        if int(tensor.view(torch.uint8).max()) > 1:
            raise SpslamError(f"tensor {name} must be 0 or 1, got {int(tensor.view(torch.uint8).max())}")
        return
    if not rule.dtype.is_floating_point and rule.low is None and rule.high is None:
        return
    low, high = (bound.item() for bound in torch.aminmax(tensor))
    if not (math.isfinite(low) and math.isfinite(high)):
        raise SpslamError(f"tensor {name} must be finite, got NaN or infinity")
    if rule.low is not None and low < rule.low:
        raise SpslamError(f"tensor {name} must be at least {rule.low:g}, got {low:g}")
    if rule.high is not None and high > rule.high:
        raise SpslamError(f"tensor {name} must be at most {rule.high:g}, got {high:g}")
