"""Volume rendering of rays and the loss terms of tracking and mapping, with analytic first derivatives.

All ops support float32 and float64, and non-contiguous and empty input. Sums have a fixed order: the same input gives
the same bits for any number of threads. `sdf` is always normalized: the signed distance divided by the truncation
distance, in [-1, 1], positive in front of surfaces.
"""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._autograd import register_gradient
from spslam.ops._checks import FLOATING, check, check_tensor, flat_rows, unflat_rows
from spslam.ops._dispatch import call, full_precision
from spslam.ops._public import public_op
from spslam.ops._vmap import register_each_vmap, register_rows_vmap

_COLORS = 3  # channels that the kernel renders itself; others are sums by its weights


@public_op()
def volume_render(
    sdf: torch.Tensor, color: torch.Tensor, t: torch.Tensor, valid: torch.Tensor | None, truncation: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Color and depth of rays as weighted sums over their samples (equations 5 and 6).

    The weight of a sample is sigmoid(sdf / truncation) * sigmoid(-sdf / truncation). It is set to 0 if it is below
    1e-3, if the sample is not valid, or if the sample is deeper than the first crossing of its ray (the smallest t of
    valid samples with negative sdf) plus truncation. The weights of a ray are then divided by their sum; a ray without
    any weight renders as zeros.

    Args:
        sdf: [R, S] float32 or float64, normalized. There may be more than one axis of rays, [..., S].
        color: [R, S, C] of the same dtype; any channels, not only 3 colors.
        t: [R, S] of the same dtype, depth of the samples, meters, in any order.
        valid: bool [R, S], whether a sample lies inside the volume; None for all.
        truncation: truncation distance tr, meters.

    Returns:
        color [R, C], depth [R] in meters, weights [R, S]. All three are differentiable with respect to `sdf`, `color`
        and `t`, for a fixed selection of samples. R = 0 gives empty tensors, S = 0 zeros. NaN propagates within its own
        ray only.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape or device does not fit, or `truncation` is not positive.

    Example:
        >>> sdf, t = torch.tensor([[1.0, 0.0, -1.0]]), torch.tensor([[0.9, 1.0, 1.1]])
        >>> color, depth, weights = volume_render(sdf, torch.ones(1, 3, 3), t, torch.ones(1, 3).bool(), 0.08)
        >>> depth
        tensor([1.])
    """
    name = "volume_render"
    check_tensor(name, "sdf", sdf, ("R", "S") if getattr(sdf, "ndim", 0) < 3 else None, FLOATING)
    shape = tuple(sdf.shape)
    check_tensor(name, "color", color, (*shape, "C"), sdf.dtype, like=sdf)
    check_tensor(name, "t", t, shape, sdf.dtype, like=sdf)
    if valid is None:
        valid = torch.ones(shape, dtype=torch.bool, device=sdf.device)
    check_tensor(name, "valid", valid, shape, torch.bool, like=sdf)
    check(truncation > 0, name, "truncation", "be positive", truncation)
    sdf, t, valid, values = flat_rows(sdf), flat_rows(t), flat_rows(valid), flat_rows(color, 2)
    colored = values.shape[2] == _COLORS
    rendered, depth, weights = call(name, sdf, values if colored else values[..., :0], t, valid, truncation)
    if not colored:
        with full_precision(weights):
            rendered = (weights[:, None] @ values)[:, 0]
    leading = shape[:-1]
    return unflat_rows(rendered, leading), unflat_rows(depth, leading), unflat_rows(weights, leading)


@public_op()
def rendering_losses(
    color: torch.Tensor,
    depth: torch.Tensor,
    sdf: torch.Tensor,
    t: torch.Tensor,
    valid: torch.Tensor,
    rendered: torch.Tensor,
    target_color: torch.Tensor,
    target_depth: torch.Tensor,
    cosine: torch.Tensor,
    truncation: float,
    cosine_targets: bool,
) -> torch.Tensor:
    """The four terms of the objective (equations 8 to 11), each averaged over all R rays.

    The distance of a sample to the measured surface is e = (target_depth - t) * c, with c = max(cosine, 0.15) if
    `cosine_targets` is set and the cosine of the ray is known, else c = 1. A sample is near if |e| < truncation and it
    is valid. It is free if e >= truncation, valid or not: outside the volume the field is 1, so the sample adds 0.

    - rgb: squared error of the rendered color, mean over the channels; only for rendered rays.
    - depth: squared error of the rendered depth, m^2; only for rendered rays.
    - free space: mean over the free samples of a ray of (sdf - 1)^2.
    - sdf: mean over the near samples of a ray of (sdf * truncation - e)^2, m^2.

    A ray adds 0 to a term for which it has no sample, and to all terms if its target depth is not positive and finite.
    A sample with a t that is not finite is ignored, and a cosine that is NaN is unknown. Any other NaN of a ray with
    positive and finite target depth propagates to the terms that use it.

    Args:
        color: [R, 3] float32 or float64, rendered.
        depth: [R] of the same dtype, rendered, meters.
        sdf: [R, S] of the same dtype, normalized.
        t: [R, S] of the same dtype, depth of the samples, meters.
        valid: bool [R, S], whether a sample lies inside the volume.
        rendered: bool [R], whether any sample of the ray had a weight.
        target_color: [R, 3] of the same dtype, measured.
        target_depth: [R] of the same dtype, measured, meters.
        cosine: [R] of the same dtype, dot product of surface normal and ray direction, with the direction scaled to
            depth 1, so it may exceed 1 near the image corners; 0 where the normal is unknown.
        truncation: truncation distance, meters.
        cosine_targets: whether distances are perpendicular to the surface instead of along the ray.

    Returns:
        [4]: rgb, depth, free space, sdf. Differentiable with respect to `color`, `depth`, `sdf` and `t`. R = 0
        gives zeros.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape or device does not fit, or `truncation` is not positive.

    Example:
        >>> one = torch.ones(1)
        >>> losses = rendering_losses(
        ...     torch.zeros(1, 3), 1.1 * one, torch.zeros(1, 2), torch.tensor([[0.5, 1.0]]), torch.ones(1, 2).bool(),
        ...     one.bool(), torch.ones(1, 3), one, 0 * one, 0.08, False)
        >>> losses
        tensor([1.0000, 0.0100, 1.0000, 0.0000])
    """
    name = "rendering_losses"
    check_tensor(name, "sdf", sdf, ("R", "S"), FLOATING)
    rays, samples = sdf.shape
    for argument, tensor, shape in (
        ("color", color, (rays, 3)),
        ("depth", depth, (rays,)),
        ("t", t, (rays, samples)),
        ("target_color", target_color, (rays, 3)),
        ("target_depth", target_depth, (rays,)),
        ("cosine", cosine, (rays,)),
    ):
        check_tensor(name, argument, tensor, shape, sdf.dtype, like=sdf)
    check_tensor(name, "valid", valid, (rays, samples), torch.bool, like=sdf)
    check_tensor(name, "rendered", rendered, (rays,), torch.bool, like=sdf)
    check(truncation > 0, name, "truncation", "be positive", truncation)
    return call(
        "rendering_losses",
        color,
        depth,
        sdf,
        t,
        valid,
        rendered,
        target_color,
        target_depth,
        cosine,
        truncation,
        cosine_targets,
    )


@torch.library.register_fake("spslam::volume_render")
def _(sdf, color, t, valid, truncation):
    rays, samples = sdf.shape
    return sdf.new_empty(rays, color.shape[2]), sdf.new_empty(rays), sdf.new_empty(rays, samples)


@torch.library.register_fake("spslam::volume_render_backward")
def _(grad_color, grad_depth, grad_weights, sdf, color, t, valid, weights, truncation):
    return sdf.new_empty(sdf.shape), sdf.new_empty(color.shape), sdf.new_empty(sdf.shape)


@torch.library.register_fake("spslam::rendering_losses")
def _(color, depth, sdf, t, valid, rendered, target_color, target_depth, cosine, truncation, cosine_targets):
    return sdf.new_empty(4)


@torch.library.register_fake("spslam::rendering_losses_backward")
def _(grad, color, depth, sdf, t, valid, rendered, target_color, target_depth, cosine, truncation, cosine_targets):
    rays, samples = sdf.shape
    return sdf.new_empty(rays, 3), sdf.new_empty(rays), sdf.new_empty(rays, samples), sdf.new_empty(rays, samples)


def _save_render(ctx, inputs, output):
    *tensors, ctx.truncation = inputs
    ctx.save_for_backward(*tensors, output[2])
    ctx.set_materialize_grads(False)


def _render_backward(ctx, grad_color, grad_depth, grad_weights):
    sdf, color, t, valid, weights = ctx.saved_tensors
    rays = sdf.shape[0]
    grad_color = sdf.new_zeros(rays, color.shape[2]) if grad_color is None else grad_color
    grad_depth = sdf.new_zeros(rays) if grad_depth is None else grad_depth
    gradients = call(
        "volume_render_backward", grad_color, grad_depth, grad_weights, sdf, color, t, valid, weights, ctx.truncation
    )
    return *gradients, None, None


def _save_losses(ctx, inputs, output):
    *tensors, ctx.truncation, ctx.cosine_targets = inputs
    ctx.save_for_backward(*tensors)


def _losses_backward(ctx, grad):
    gradients = call("rendering_losses_backward", grad, *ctx.saved_tensors, ctx.truncation, ctx.cosine_targets)
    return *gradients, None, None, None, None, None, None, None


register_gradient("volume_render", _render_backward, _save_render)
register_gradient("rendering_losses", _losses_backward, _save_losses)
register_rows_vmap("volume_render", (0, 1, 2, 3))
register_each_vmap("volume_render_backward")
register_each_vmap("rendering_losses")
register_each_vmap("rendering_losses_backward")
