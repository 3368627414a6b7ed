"""Random draws and samples along rays, from counter-based Philox numbers: no generator state, equal on every device."""

from enum import IntEnum

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check


class Stream(IntEnum):
    """What a draw is for; draws of different streams are independent. Repeated in csrc/core/philox.h."""

    PIXEL_DATABASE = 0
    TRACKING_PIXELS = 1
    TRACKING_RAYS = 2
    MAPPING_PIXELS = 3
    MAPPING_RAYS = 4
    FRAME_SELECTION = 5
    COVISIBILITY = 6
    ENCODER_POINTS = 7
    INITIALIZATION = 8
    EVALUATION = 9


def philox_uniform(
    seed: int, stream: int, frame: int, iteration: int, count: int, device: torch.device | str = "cpu"
) -> torch.Tensor:
    """Uniform random numbers keyed by (seed, stream, frame, iteration), element i from counter i.

    Args:
        seed: 64-bit seed.
        stream: purpose of the draw, see `Stream`.
        frame: frame index, 0 to 2^32 - 1.
        iteration: iteration index, 0 to 2^32 - 1.
        count: how many numbers, N.
        device: where the result lives.

    Returns:
        float32 [N] in [0, 1), multiples of 2^-24; bit-identical on every device. N = 0 gives an empty tensor.
    """
    check(count >= 0, "philox_uniform", "count", "be at least 0", count)
    out = torch.empty(count, dtype=torch.float32, device=device)
    torch.ops.spslam.philox_uniform(seed, stream, frame, iteration, out)
    return out


def sample_indices(
    seed: int, stream: int, frame: int, iteration: int, count: int, upper: int, device: torch.device | str = "cpu"
) -> torch.Tensor:
    """Uniform random integers in [0, upper), drawn with replacement, keyed as in `philox_uniform`.

    Returns:
        int64 [N]; bit-identical on every device.

    Raises:
        ValueError: `count` negative, or `upper` outside [1, 2^32].
    """
    check(count >= 0, "sample_indices", "count", "be at least 0", count)
    check(1 <= upper <= 2**32, "sample_indices", "upper", "be in [1, 2^32]", upper)
    out = torch.empty(count, dtype=torch.int64, device=device)
    torch.ops.spslam.sample_indices(seed, stream, frame, iteration, upper, out)
    return out
