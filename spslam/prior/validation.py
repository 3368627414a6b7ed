"""Validation of a prior: errors of the predicted distance on kinds of solids that it was not trained on."""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from spslam.prior.model import PatchFields, decode, encode_patches
from spslam.prior.patches import Patches, PatchSettings, observe
from spslam.prior.shapes import HELD_OUT_KINDS

MM_PER_VOXEL = 40.0
"""Errors are given for voxels of 4 cm."""
_SEED = 7
_SOLIDS = 64
_NOISE = 2.0 / MM_PER_VOXEL
# The sign of smaller distances is not evaluated; the error of the zero crossing covers them.
_SIGN_MARGIN = 0.2
_STEPS = torch.arange(-8, 9) / 8


@torch.no_grad()
def validate(
    encoder_params: Tensor,
    decoder_params: Tensor,
    neighborhood: int,
    min_pair_weight: float,
    kinds: tuple[str, ...] = HELD_OUT_KINDS,
) -> dict[str, dict[str, float]]:
    """Errors on 64 solids of each kind with 2 mm of depth noise, and their means over the kinds. Deterministic.

    Args:
        encoder_params: float32 [5128].
        decoder_params: float32 [1473].
        neighborhood: see `spslam.ops.encode_points`.
        min_pair_weight: see `spslam.ops.encode_points`.
        kinds: kinds of solids.

    Returns:
        For each kind and for `mean`, in millimeters at 4 cm voxels:
        `near_mae_mm`, `far_mae_mm`: mean absolute error of the distance within one voxel of the surface, and from one
        to two voxels.
        `sign_accuracy`: share of correct signs beyond 0.2 voxels.
        `zero_crossing_mm`, `zero_crossing_bias_mm`: mean absolute and mean signed distance, along the rays, of the
        predicted surface to the tangent plane of the exact surface.
        `crossing_share`: share of rays with a zero crossing.
    """
    figures = {}
    for index, kind in enumerate(kinds):
        patches = observe(kind, _SOLIDS, Generator().manual_seed(_SEED + index), PatchSettings(noise=_NOISE))
        fields = encode_patches(patches, encoder_params, neighborhood, min_pair_weight)
        figures[kind] = _distance_errors(patches, fields, decoder_params)
        figures[kind] |= _crossing_errors(patches, fields, decoder_params)
    names = next(iter(figures.values()))
    figures["mean"] = {name: sum(figures[kind][name] for kind in kinds) / len(kinds) for name in names}
    return {kind: {name: round(value, 4) for name, value in row.items()} for kind, row in figures.items()}


def _distance_errors(patches: Patches, fields: PatchFields, decoder_params: Tensor) -> dict[str, float]:
    truncation = PatchSettings().truncation
    patch, _ = patches.valid.nonzero().unbind(1)
    features, inside = fields.interpolate(patch, patches.queries[patches.valid])
    predicted = truncation * decode(features[inside], decoder_params)
    exact = truncation * patches.sdf[patches.valid][inside]
    error, near = MM_PER_VOXEL * (predicted - exact).abs(), exact.abs() <= 1
    has_clear_sign = exact.abs() > _SIGN_MARGIN
    return {
        "near_mae_mm": error[near].mean().item(),
        "far_mae_mm": error[~near].mean().item(),
        "sign_accuracy": (predicted.sign() == exact.sign())[has_clear_sign].float().mean().item(),
    }


def _crossing_errors(patches: Patches, fields: PatchFields, decoder_params: Tensor) -> dict[str, float]:
    """Errors of the first zero crossing, searched one voxel to either side of the surface along the rays."""
    patch, _ = patches.valid.nonzero().unbind(1)
    view = patches.view.expand_as(patches.surface)[patches.valid]
    points = patches.surface[patches.valid][:, None] + _STEPS[:, None] * view[:, None]
    features, inside = fields.interpolate(patch.repeat_interleave(len(_STEPS)), points.reshape(-1, 3))
    sdf = decode(features, decoder_params).where(inside, torch.nan).view(-1, len(_STEPS))
    offset, crosses = first_zero_crossing(sdf, _STEPS.expand_as(sdf))
    tilt = (view * patches.surface_normals[patches.valid]).sum(-1).abs()
    # Without any crossing the error is set to the search distance, so that it is a number.
    error = MM_PER_VOXEL * ((offset * tilt)[crosses] if crosses.any() else _STEPS.max().view(1))
    return {
        "zero_crossing_mm": error.abs().mean().item(),
        "zero_crossing_bias_mm": error.mean().item(),
        "crossing_share": crosses.float().mean().item(),
    }


def first_zero_crossing(sdf: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """The first zero crossing from outside to inside along rays, by linear interpolation between samples.

    Args:
        sdf: [R, S], samples in order; NaN where the field is unknown. A crossing needs known values on both sides.
        depth: [R, S], depth of the samples.

    Returns:
        Depth of the crossing [R], 0 without one, and bool [R], whether there is one.
    """
    crossing = (sdf[:, :-1] > 0) & (sdf[:, 1:] <= 0)
    first = crossing.float().argmax(1, keepdim=True)
    before, after = sdf.gather(1, first), sdf.gather(1, first + 1)
    start, stop = depth.gather(1, first), depth.gather(1, first + 1)
    found = crossing.any(1)
    return (start + (stop - start) * before / (before - after))[:, 0].where(found, 0.0), found
