"""Front-to-back compositing of rays, as in NeRF, NeuS and VolSDF: any number of channels, dense and packed rays.

The kernel supports float32 and float64, and non-contiguous and empty input. Sums have a fixed order: the same input
gives the same bits for any number of threads, and in every run on CUDA.
"""

from typing import NamedTuple

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._autograd import register_gradient
from spslam.ops._checks import FLOATING, INTEGERS, check, check_tensor, flat_rows, unflat_rows
from spslam.ops._dispatch import call
from spslam.ops._public import public_op
from spslam.ops._vmap import register_each_vmap, register_rows_vmap


class Composite(NamedTuple):
    """What `alpha_composite` returns.

    Attributes:
        values: [R, C], sum of weight times value.
        depth: [R], sum of weight times t; divided by `opacity` it is the expected depth of what is there.
        opacity: [R] in [0, 1], sum of the weights. A background adds (1 - opacity) times its value.
        weights: of the samples, in their shape.
    """

    values: torch.Tensor
    depth: torch.Tensor
    opacity: torch.Tensor
    weights: torch.Tensor


@public_op(as_given=("packed_info",))
def alpha_composite(
    opacities: torch.Tensor,
    values: torch.Tensor,
    t: torch.Tensor,
    lengths: torch.Tensor | None = None,
    packed_info: torch.Tensor | None = None,
    stop: float = 0.0,
) -> Composite:
    """Composites the samples of rays front to back.

    The weight of sample i is w_i = alpha_i T_i with T_i = prod_{j < i} (1 - alpha_j), the share of the light that
    reaches it (Max, "Optical models for direct volume rendering", 1995; equation 3 of NeRF, equation 10 of NeuS).

    Args:
        opacities: float32 or float64 [R, S], alpha in [0, 1] of the samples, in the order along the ray. If `lengths`
            is given: density sigma, at least 0, in 1 / m, and alpha = 1 - exp(-sigma length). Leading axes may be more
            than one, [..., S], or one, with `packed_info`: [N].
        values: [R, S, C] or [N, C] of the same dtype: color, normals, semantics, features. C may be 0.
        t: [R, S] or [N] of the same dtype, where the samples are: depth or distance along the ray, meters.
        lengths: [R, S] or [N] of the same dtype, or None: length of ray that a sample stands for, meters.
        packed_info: int32 or int64 [R, 2], or None: first sample and number of samples of each ray in lists of N
            samples, as nerfacc has them; see `pack_rays`. Rays must not share a sample. A span that leaves the list
            gives NaN for its ray. Samples of no ray have weight and gradient 0.
        stop: samples with T_i below this take no part: weight 0 and no gradient. 0 takes all.

    Returns:
        values [R, C], depth [R], opacity [R], weights in the shape of `opacities`. All are differentiable with respect
        to `opacities`, `values`, `t` and `lengths`, for a fixed selection of samples, also where alpha is 1. R = 0
        gives empty tensors, a ray without samples zeros. NaN propagates within its own ray only, to the samples behind.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape or device does not fit, or `stop` is not in [0, 1].

    Example:
        >>> alpha, t = torch.tensor([[0.5, 1.0, 0.5]]), torch.tensor([[1.0, 2.0, 3.0]])
        >>> values, depth, opacity, weights = alpha_composite(alpha, torch.ones(1, 3, 4), t)
        >>> weights, depth
        (tensor([[0.5000, 0.5000, 0.0000]]), tensor([1.5000]))
    """
    name = "alpha_composite"
    packed = packed_info is not None
    axes = ("N",) if packed else ("R", "S")
    check_tensor(name, "opacities", opacities, axes if packed or getattr(opacities, "ndim", 0) < 3 else None, FLOATING)
    shape = tuple(opacities.shape)
    check_tensor(name, "values", values, (*shape, "C"), opacities.dtype, like=opacities)
    check_tensor(name, "t", t, shape, opacities.dtype, like=opacities)
    if lengths is not None:
        check_tensor(name, "lengths", lengths, shape, opacities.dtype, like=opacities)
    if packed_info is not None:
        check_tensor(name, "packed_info", packed_info, ("R", 2), INTEGERS, like=opacities)
        packed_info = packed_info.long()
    check(0 <= stop <= 1, name, "stop", "be in [0, 1]", stop)
    if len(shape) < 3:
        return Composite(*call(name, opacities, lengths, values, t, packed_info, stop))
    flat = [None if part is None else flat_rows(part) for part in (opacities, lengths, t)]
    parts = call(name, flat[0], flat[1], flat_rows(values, 2), flat[2], packed_info, stop)
    return Composite(*(unflat_rows(part, shape[:-1]) for part in parts))


@public_op()
def pack_rays(ray_indices: torch.Tensor, num_rays: int) -> torch.Tensor:
    """The spans of rays in a list of samples, from the ray of each sample. Waits for CUDA.

    Args:
        ray_indices: int32 or int64 [N], the ray of each sample, ascending, in [0, num_rays - 1].
        num_rays: R.

    Returns:
        packed_info int64 [R, 2], first sample and number of samples; rays without samples have 0 of them.

    Raises:
        TypeError: wrong dtype.
        ValueError: a wrong shape, or indices that descend or lie out of range.

    Example:
        >>> pack_rays(torch.tensor([0, 0, 2]), 3).tolist()
        [[0, 2], [2, 0], [2, 1]]
    """
    check_tensor("pack_rays", "ray_indices", ray_indices, ("N",), INTEGERS)
    check(0 <= num_rays <= 2**30, "pack_rays", "num_rays", "be in [0, 2^30]", num_rays)
    ray_indices = ray_indices.long().contiguous()
    rays = torch.arange(num_rays, device=ray_indices.device)
    bounds = torch.searchsorted(ray_indices, torch.stack([rays, rays + 1]))
    if ray_indices.shape[0]:
        low, high, steps = ray_indices[0], ray_indices[-1], ray_indices.diff()
        fits = bool(((low >= 0) & (high < num_rays) & (steps >= 0).all()).item())
        check(fits, "pack_rays", "ray_indices", f"ascend within [0, {num_rays - 1}]", "other indices")
    return torch.stack([bounds[0], bounds[1] - bounds[0]], 1)


@public_op()
def neus_alpha(sdf_front: torch.Tensor, sdf_back: torch.Tensor, sharpness: torch.Tensor | float) -> torch.Tensor:
    """Opacity of sections of a ray from the signed distances at their ends (NeuS, equation 13).

    alpha = max((Phi(f) - Phi(b)) / Phi(f), 0) with Phi(x) = sigmoid(sharpness x). Computed by logarithms, so that it
    does not lose precision behind the surface. With one distance at the middle of a section, its ends are
    sdf -+ cosine * length / 2, where the cosine is that of ray and gradient (negative where the ray enters).

    Args:
        sdf_front: float32 or float64 [R, S], or any shape: signed distance where the ray enters the section, meters.
        sdf_back: the same shape and dtype, where it leaves.
        sharpness: s, 1 / m, positive: a number, or a tensor that broadcasts, such as a learned one.

    Returns:
        alpha in that shape, in [0, 1], differentiable to any order with respect to all three. Empty input gives an
        empty tensor.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: the shapes or devices differ, or `sharpness` is a number that is not positive.

    Example:
        >>> neus_alpha(torch.tensor([0.01, -0.01]), torch.tensor([-0.01, 0.01]), 100.0)
        tensor([0.6321, 0.0000])
    """
    check_tensor("neus_alpha", "sdf_front", sdf_front, None, FLOATING)
    check_tensor("neus_alpha", "sdf_back", sdf_back, tuple(sdf_front.shape), sdf_front.dtype, like=sdf_front)
    _check_scale("neus_alpha", "sharpness", sharpness, sdf_front)
    log_sigmoid = torch.nn.functional.logsigmoid
    passed = log_sigmoid(sharpness * sdf_back) - log_sigmoid(sharpness * sdf_front)
    return 0 - torch.expm1(passed.clamp(max=0))


@public_op()
def volsdf_density(sdf: torch.Tensor, beta: torch.Tensor | float) -> torch.Tensor:
    """Density from signed distance: the Laplace distribution's function of -sdf, divided by beta (VolSDF, equation 2).

    Args:
        sdf: float32 or float64 [R, S], or any shape: signed distance, meters, positive outside.
        beta: scale of the distribution, meters, positive: a number, or a tensor that broadcasts, such as a learned one.

    Returns:
        density in that shape, 1 / m, for `alpha_composite` with lengths. Differentiable to any order. Empty input gives
        an empty tensor.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: another device, or `beta` is a number that is not positive.

    Example:
        >>> volsdf_density(torch.tensor([-1.0, 0.0, 1.0]), 0.1)
        tensor([9.9998e+00, 5.0000e+00, 2.2700e-04])
    """
    check_tensor("volsdf_density", "sdf", sdf, None, FLOATING)
    _check_scale("volsdf_density", "beta", beta, sdf)
    outside = sdf > 0
    tail = 0.5 * torch.exp(-torch.where(outside, sdf, -sdf) / beta)
    return torch.where(outside, tail, 1 - tail) / beta


def _check_scale(function: str, argument: str, value: torch.Tensor | float, like: torch.Tensor) -> None:
    if isinstance(value, torch.Tensor):
        check_tensor(function, argument, value, None, like.dtype, like=like)
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{function}: {argument} must be a float or a torch.Tensor, got {type(value).__name__}")
    else:
        check(value > 0, function, argument, "be positive", value)


@torch.library.register_fake("spslam::alpha_composite")
def _(opacities, lengths, values, t, packed_info, stop):
    rays = opacities.shape[0] if packed_info is None else packed_info.shape[0]
    per_ray = opacities.new_empty(rays), opacities.new_empty(rays)
    return opacities.new_empty(rays, values.shape[-1]), *per_ray, opacities.new_empty(opacities.shape)


@torch.library.register_fake("spslam::alpha_composite_backward")
def _(
    grad_values, grad_depth, grad_opacity, grad_weights, opacities, lengths, values, t, packed_info, weights, stop
):  # fmt: skip
    per_sample = [opacities.new_empty(opacities.shape) for _ in range(2)]
    of_lengths = opacities.new_empty((0,) if lengths is None else lengths.shape)
    return per_sample[0], of_lengths, opacities.new_empty(values.shape), per_sample[1]


def _save(ctx, inputs, output):
    opacities, lengths, values, t, packed_info, ctx.stop = inputs
    ctx.has_lengths, ctx.packed = lengths is not None, packed_info is not None
    optional = [part for part in (lengths, packed_info) if part is not None]
    ctx.save_for_backward(opacities, values, t, output[3], *optional)
    ctx.set_materialize_grads(False)


def _backward(ctx, grad_values, grad_depth, grad_opacity, grad_weights):
    opacities, values, t, weights, *optional = ctx.saved_tensors
    lengths = optional[0] if ctx.has_lengths else None
    packed_info = optional[-1] if ctx.packed else None
    rays = opacities.shape[0] if packed_info is None else packed_info.shape[0]
    grad_values = opacities.new_zeros(rays, values.shape[-1]) if grad_values is None else grad_values
    grad_depth = opacities.new_zeros(rays) if grad_depth is None else grad_depth
    grad_opacity = opacities.new_zeros(rays) if grad_opacity is None else grad_opacity
    of_opacities, of_lengths, of_values, of_t = call(
        "alpha_composite_backward",
        *(grad_values, grad_depth, grad_opacity, grad_weights, opacities, lengths, values, t, packed_info, weights),
        ctx.stop,
    )
    return of_opacities, of_lengths if ctx.has_lengths else None, of_values, of_t, None, None


register_rows_vmap("alpha_composite", (0, 1, 2, 3), one_by_one=(4,))
register_each_vmap("alpha_composite_backward")
register_gradient("alpha_composite", _backward, _save)
