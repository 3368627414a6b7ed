"""Random numbers and samples along rays by the counter-based Philox generator: no state, the same on every device."""

from enum import IntEnum

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import FLOATING, check, check_key, check_tensor
from spslam.ops._public import public_op
from spslam.ops._vmap import register_each_vmap

_MAX_SAMPLES = 2**20
_COUNTER_RANGE = 2**32


class RandomStream(IntEnum):
    """Purpose of random numbers; different streams are independent. Duplicated in csrc/core/philox.h."""

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


@public_op()
def philox_uniform(
    seed: int, stream: int, frame: int, iteration: int, count: int, device: torch.device | str = "cpu"
) -> torch.Tensor:
    """Uniform random numbers with the key (seed, stream, frame, iteration); element i uses counter i.

    Args:
        seed: 64-bit seed.
        stream: purpose of the numbers, see `RandomStream`.
        frame: frame index, 0 to 2^32 - 1.
        iteration: iteration index, 0 to 2^32 - 1.
        count: number of elements, N.
        device: device of the result.

    Returns:
        float32 [N] in [0, 1), multiples of 2^-24; bit-identical on every device. N = 0 gives an empty tensor.

    Raises:
        ValueError: `count` negative, or `frame` or `iteration` out of range.

    Example:
        >>> torch.equal(philox_uniform(0, 0, 0, 0, 3), philox_uniform(0, 0, 0, 0, 5)[:3])
        True
    """
    check(count >= 0, "philox_uniform", "count", "be at least 0", count)
    check_key("philox_uniform", frame, iteration)
    out = torch.empty(count, dtype=torch.float32, device=device)
    torch.ops.spslam.philox_uniform(seed, stream, frame, iteration, out)
    return out


@public_op()
def sample_indices(
    seed: int, stream: int, frame: int, iteration: int, count: int, upper: int, device: torch.device | str = "cpu"
) -> torch.Tensor:
    """Uniform random integers in [0, upper), drawn with replacement.

    Args:
        seed, stream, frame, iteration: key, as in `philox_uniform`.
        count: number of elements, N.
        upper: 1 to 2^32.
        device: device of the result.

    Returns:
        int64 [N], floor(word * upper / 2^32) of the first Philox word of each element; bit-identical on every device.
        N = 0 gives an empty tensor.

    Raises:
        ValueError: `count` negative, `upper` outside [1, 2^32], or `frame` or `iteration` out of range.

    Example:
        >>> drawn = sample_indices(0, RandomStream.EVALUATION, 0, 0, count=1000, upper=6)
        >>> drawn.min(), drawn.max()
        (tensor(0), tensor(5))
    """
    check(count >= 0, "sample_indices", "count", "be at least 0", count)
    check(1 <= upper <= 2**32, "sample_indices", "upper", "be in [1, 2^32]", upper)
    check_key("sample_indices", frame, iteration)
    out = torch.empty(count, dtype=torch.int64, device=device)
    torch.ops.spslam.sample_indices(seed, stream, frame, iteration, upper, out)
    return out


@public_op()
def sample_along_rays(
    depth: torch.Tensor,
    num_uniform: int,
    num_surface: int,
    near: float,
    far: float,
    truncation: float,
    seed: int,
    stream: int,
    frame: int,
    iteration: int,
) -> torch.Tensor:
    """Depths of samples along each ray, based on its measured depth D (section III-B).

    `num_uniform` samples are stratified over [near * D, far * D], and `num_surface` samples over
    [D - truncation, D + truncation]. Both are merged in ascending order.

    Args:
        depth: [R] float32 or float64, measured depth of each ray, meters. Rays with a depth that is not positive and
            finite get zeros.
        num_uniform: samples between camera and surface (N_c), 0 to 2^20.
        num_surface: samples around the surface (N_f), 0 to 2^20.
        near: start of the uniform samples as a share of the depth (n_1).
        far: end of the uniform samples (n_2), at least `near`.
        truncation: half width of the interval around the surface, meters.
        seed, stream, frame, iteration: key, as in `philox_uniform`. Sample s of ray r, with the uniform samples first,
            uses element r * S + s, which must be below 2^32.

    Returns:
        [R, S] with S = num_uniform + num_surface, of the dtype of `depth`, meters, ascending in each row. Not
        differentiable. The same in every run; devices differ only by rounding. R = 0 or S = 0 gives an empty tensor.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape does not fit, a number is out of range, or R * S exceeds 2^32.

    Example:
        >>> sample_along_rays(torch.tensor([2.0]), 2, 1, 0.0, 1.0, 0.1, 0, RandomStream.TRACKING_RAYS, 0, 0).shape
        torch.Size([1, 3])
    """
    name = "sample_along_rays"
    check_tensor(name, "depth", depth, ("R",), FLOATING)
    check(0 <= num_uniform <= _MAX_SAMPLES, name, "num_uniform", "be in [0, 2^20]", num_uniform)
    check(0 <= num_surface <= _MAX_SAMPLES, name, "num_surface", "be in [0, 2^20]", num_surface)
    check(near >= 0, name, "near", "be at least 0", near)
    check(near <= far, name, "far", f"be at least near ({near})", far)
    check(truncation >= 0, name, "truncation", "be at least 0", truncation)
    check_key(name, frame, iteration)
    elements = depth.shape[0] * (num_uniform + num_surface)
    check(elements <= _COUNTER_RANGE, name, "depth", "have at most 2^32 / S rays", depth.shape[0])
    return torch.ops.spslam.sample_along_rays(
        depth.detach(), num_uniform, num_surface, near, far, truncation, seed, stream, frame, iteration
    )


@torch.library.register_fake("spslam::sample_along_rays")
def _(depth, num_uniform, num_surface, near, far, truncation, seed, stream, frame, iteration):
    return depth.new_empty(depth.shape[0], num_uniform + num_surface)


@torch.library.register_fake("spslam::philox_uniform")
def _(seed, stream, frame, iteration, out):
    pass


@torch.library.register_fake("spslam::sample_indices")
def _(seed, stream, frame, iteration, upper, out):
    pass


# Not folded into rows, because the random numbers of a ray depend on its row.
register_each_vmap("sample_along_rays")
