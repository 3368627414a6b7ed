"""Argument checks of the public ops, in one wording: `<function>: <argument> must <rule>, got <actual>`."""

from collections.abc import Sequence

import torch

FLOATING = (torch.float32, torch.float64)
# Of tables that are read in float32 where they are smaller.
TABLES = (*FLOATING, torch.float16, torch.bfloat16)
INTEGERS = (torch.int32, torch.int64)
_KEY_RANGE = 2**32


def check(condition: bool, function: str, argument: str, rule: str, actual: object) -> None:
    """Raises ValueError in the house's wording unless `condition` holds."""
    if not condition:
        raise ValueError(f"{function}: {argument} must {rule}, got {actual}")


def check_count(function: str, argument: str, count: int, least: int = 1) -> None:
    """Checks how many rays, points, iterations or channels there are to be: products of them must fit 64 bits."""
    check(count >= least, function, argument, f"be at least {least}", count)
    check(count <= 2**30, function, argument, "be at most 2^30", count)


def check_key(function: str, frame: int, iteration: int = 0) -> None:
    """Checks the parts of a draw's key that Philox has 32 bits for: larger ones would draw what smaller ones do."""
    for argument, number in (("frame", frame), ("iteration", iteration)):
        check(0 <= number < _KEY_RANGE, function, argument, "be in [0, 2^32 - 1]", number)


def check_tensor(
    function: str,
    argument: str,
    tensor: torch.Tensor,
    shape: Sequence[int | str] | None,
    dtype: torch.dtype | Sequence[torch.dtype],
    like: torch.Tensor | None = None,
) -> None:
    """Checks that `tensor` is a tensor of that shape and dtype, on the device of `like`.

    Args:
        function: name of the public function, for the message.
        argument: name of the argument, for the message.
        tensor: what the caller passed.
        shape: an int fixes an axis, a str only names it; None allows any shape.
        dtype: the dtype or dtypes allowed.
        like: a tensor whose device must be the same.

    Raises:
        TypeError: not a tensor, or another dtype.
        ValueError: another shape or device.
    """
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"{function}: {argument} must be a torch.Tensor, got {type(tensor).__name__}")
    dtypes = (dtype,) if isinstance(dtype, torch.dtype) else tuple(dtype)
    if tensor.dtype not in dtypes:
        names = " or ".join(str(d).removeprefix("torch.") for d in dtypes)
        raise TypeError(f"{function}: {argument} must be {names}, got {str(tensor.dtype).removeprefix('torch.')}")
    sizes = tuple(tensor.shape)  # read once: ops are called several times a frame
    if shape is not None and (
        len(sizes) != len(shape)
        or any(size != axis and not isinstance(axis, str) for size, axis in zip(sizes, shape, strict=True))
    ):
        wanted = "[" + ", ".join(str(axis) for axis in shape) + "]"
        raise ValueError(f"{function}: {argument} must have shape {wanted}, got {list(tensor.shape)}")
    if like is not None and tensor.device != like.device:
        raise ValueError(f"{function}: {argument} must be on {like.device}, got {tensor.device}")


def wide(table: torch.Tensor) -> torch.Tensor:
    """A table in the dtype that kernels compute in: float32 for float16 and bfloat16. Gradients flow back."""
    return table.float() if table.dtype in (torch.float16, torch.bfloat16) else table


def rows_shape(tensor: torch.Tensor, *trailing: int | str) -> tuple[int | str, ...]:
    """The shape to check rows against that may have more than one leading axis: [N, ...] or [..., ...]."""
    leading = getattr(tensor, "ndim", 0) - len(trailing)
    return (*tensor.shape[:leading], *trailing) if leading > 1 else ("N", *trailing)


def flat_rows(tensor: torch.Tensor, trailing: int = 1) -> torch.Tensor:
    """The tensor with all axes before the last `trailing` ones made one, where they are more than one."""
    leading = tensor.ndim - trailing
    return tensor.flatten(0, leading - 1) if leading > 1 else tensor


def unflat_rows(tensor: torch.Tensor, leading: Sequence[int]) -> torch.Tensor:
    """The tensor with its first axis made the axes `leading` again."""
    return tensor.view(*leading, *tensor.shape[1:]) if len(leading) > 1 else tensor
