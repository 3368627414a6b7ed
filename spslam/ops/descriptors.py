"""Binary descriptors of image features, compared by Hamming distance. Not differentiable."""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import public_op

_WORD_BYTES, _MAX_BYTES = 8, 128


@public_op()
def nearest_descriptors(descriptors: torch.Tensor, others: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The nearest of other binary descriptors, and how far it and the second nearest are.

    Lowe's ratio test keeps row i where `distances[i, 0] < ratio * distances[i, 1]`.

    Args:
        descriptors: uint8 [N, B] of ORB (B = 32), BRISK, FREAK (64) or other features; B is a multiple of 8, at most
            128.
        others: uint8 [M, B].

    Returns:
        int64 [N] the row of the nearest of `others`, the first of those that are as near, -1 where M = 0; int32 [N, 2]
        Hamming distances, bits, to it and to the second nearest, 8 B + 1 where there is none. The same for any number
        of threads and on both devices.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or B out of range.

    Example:
        >>> orb = torch.tensor([[0, 255], [1, 255], [0, 0]], dtype=torch.uint8).repeat(1, 16)
        >>> row, distances = nearest_descriptors(orb[:1], orb[1:])
        >>> row.tolist(), distances.tolist()
        ([0], [[16, 128]])
    """
    name = "nearest_descriptors"
    check_tensor(name, "descriptors", descriptors, ("N", "B"), torch.uint8)
    size = descriptors.shape[1]
    is_in_words = size % _WORD_BYTES == 0 and 0 < size <= _MAX_BYTES
    check(is_in_words, name, "descriptors", f"have a multiple of 8 bytes each, at most {_MAX_BYTES}", size)
    check_tensor(name, "others", others, ("M", size), torch.uint8, like=descriptors)
    return torch.ops.spslam.nearest_descriptors(descriptors, others)


@torch.library.register_fake("spslam::nearest_descriptors")
def _(descriptors, _):
    rows = len(descriptors)
    return descriptors.new_empty(rows, dtype=torch.int64), descriptors.new_empty(rows, 2, dtype=torch.int32)
