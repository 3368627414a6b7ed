"""Calls with several numbers of kernel threads."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch

from spslam import ops

Result = TypeVar("Result")


def with_threads(function: Callable[[], Result], counts: Sequence[int]) -> list[Result]:
    """The function's result for each number of threads; the number from before is restored."""
    threads = ops.get_num_threads()
    results = []
    try:
        for count in counts:
            ops.set_num_threads(count)
            results.append(function())
    finally:
        ops.set_num_threads(threads)
    return results


def assert_same_for_any_threads(function: Callable[[], Sequence[torch.Tensor]], counts: Sequence[int] = (1, 2, 3)):
    """The function's tensors have the same bits for each number of threads."""
    first, *others = with_threads(function, counts)
    for other in others:
        assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))
