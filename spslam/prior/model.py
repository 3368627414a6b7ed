"""The prior's networks for training: the encoder over point-corner pairs and the geometry decoder, in plain torch.

Use goes through `spslam.ops.encode_points` and the decoder ops; this is the same arithmetic, differentiable, on many
patches at once. Parameters are flat vectors in the ops' layout. Lengths are in voxels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Generator, Tensor
from torch.nn.functional import linear

from spslam.prior.encoder import DECODER_WIDTHS, ENCODER_WIDTHS
from spslam.prior.patches import Patches

LATTICE_RADIUS = 6
_LATTICE_SIZE = 2 * LATTICE_RADIUS + 1


def initial_parameters(sizes: tuple[int, ...], generator: Generator) -> Tensor:
    """Random start, float32 [P]: weights and biases uniform within 1/sqrt(inputs), as torch.nn.Linear draws them."""
    layers = []
    for inputs, outputs in zip(sizes, sizes[1:], strict=False):
        uniform = torch.rand(inputs * outputs + outputs, generator=generator)
        layers.append((2 * uniform - 1) / inputs**0.5)
    return torch.cat(layers)


def perceptron(inputs: Tensor, parameters: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """ReLU perceptron [N,I] -> [N,O]; ``parameters`` = W1 b1 W2 b2 W3 b3, flat, row-major."""
    start, last = 0, len(sizes) - 2
    for layer, (width, outputs) in enumerate(zip(sizes, sizes[1:], strict=False)):
        weight = parameters[start : start + outputs * width].view(outputs, width)
        start += outputs * width
        inputs = linear(inputs, weight, parameters[start : start + outputs])
        start += outputs
        inputs = inputs if layer == last else inputs.relu_()
    return inputs


def corner_offsets(neighborhood: int) -> Tensor:
    """Offsets int64 [K,3] of the corners around a point from the lower corner of its voxel."""
    axis = {8: torch.arange(0, 2), 64: torch.arange(-1, 3)}[neighborhood]
    return torch.cartesian_prod(axis, axis, axis)


@dataclass(frozen=True)
class Pairs:
    """Q pairs of a point and a lattice corner: index of the point, corner int64 [Q,3], input [Q,6], weight [Q]."""

    point: Tensor
    corner: Tensor
    inputs: Tensor
    weight: Tensor


def pair_points(points: Tensor, normals: Tensor, neighborhood: int, min_pair_weight: float) -> Pairs:
    """Pair points [N,3] with the corners around them, weighted by ``prod(1 - |x - c| / r)^3``.

    r is 2 for 64 corners and 1 for 8. Pairs lighter than ``min_pair_weight`` are left out. The input of a pair is
    ``[(x - c) / r, n]``.
    """
    reach = 2.0 if neighborhood == 64 else 1.0
    lower = points.floor()
    offsets = corner_offsets(neighborhood)
    along_axis = (1 - ((points - lower)[:, None] - offsets).abs() / reach).clamp_min(0)
    weight = along_axis.prod(-1).pow(3)
    point, slot = (weight >= max(min_pair_weight, torch.finfo(weight.dtype).tiny)).nonzero().unbind(1)
    corner = lower.long()[point] + offsets[slot]
    inputs = torch.cat([(points[point] - corner) / reach, normals[point]], 1)
    return Pairs(point, corner, inputs, weight[point, slot])


def weighted_means(features: Tensor, weight: Tensor, row: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """Mean of features [Q,C] by row, weighted, and the sums of weights; rows without entries are 0."""
    totals = torch.zeros(rows, dtype=weight.dtype).index_add(0, row, weight)
    sums = torch.zeros(rows, features.shape[1], dtype=features.dtype).index_add(0, row, features * weight[:, None])
    return sums / totals.where(totals > 0, 1.0)[:, None], totals


def encode(
    points: Tensor, normals: Tensor, encoder_params: Tensor, neighborhood: int, min_pair_weight: float
) -> tuple[Tensor, Tensor, Tensor]:
    """What `spslam.ops.encode_points` computes, for points in voxels: sorted corners, mean features, weights."""
    pairs = pair_points(points, normals, neighborhood, min_pair_weight)
    features = perceptron(pairs.inputs, encoder_params, ENCODER_WIDTHS)
    corners, row = pairs.corner.unique(dim=0, return_inverse=True)
    return corners, *weighted_means(features, pairs.weight, row, len(corners))


@dataclass(frozen=True)
class PatchFields:
    """Feature fields of B patches on lattices of whole numbers -LATTICE_RADIUS to LATTICE_RADIUS.

    ``embeddings`` [B*L^3,8] and ``weights`` [B*L^3], L = 2 LATTICE_RADIUS + 1; weight 0 where no point came near.
    """

    embeddings: Tensor
    weights: Tensor

    def interpolate(self, patch: Tensor, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Trilinear features [Q,8] at queries [Q,3] of patches int64 [Q]; which have all eight corners, bool [Q]."""
        lower = queries.floor()
        offsets = corner_offsets(8)
        share = (1 - (queries[:, None] - lower[:, None] - offsets).abs()).prod(-1)
        row, inside = _lattice_row(patch[:, None], lower.long()[:, None] + offsets)
        inside = inside.all(-1) & (self.weights[row] > 0).all(-1)
        return (self.embeddings[row] * share[..., None]).sum(1), inside


def encode_patches(patches: Patches, encoder_params: Tensor, neighborhood: int, min_pair_weight: float) -> PatchFields:
    """Encode the seen points of every patch, with the arithmetic of `encode`. Differentiable in the parameters."""
    patch, _ = patches.seen.nonzero().unbind(1)
    pairs = pair_points(patches.points[patches.seen], patches.normals[patches.seen], neighborhood, min_pair_weight)
    row, inside = _lattice_row(patch[pairs.point], pairs.corner)
    features = perceptron(pairs.inputs, encoder_params, ENCODER_WIDTHS)
    rows = len(patches.seen) * _LATTICE_SIZE**3
    return PatchFields(*weighted_means(features, pairs.weight * inside, row, rows))


def decode(features: Tensor, decoder_params: Tensor) -> Tensor:
    """SDF over the truncation [Q] of features [Q,8], at position 0: the trained decoder doesn't look at it."""
    return perceptron(torch.nn.functional.pad(features, (3, 0)), decoder_params, DECODER_WIDTHS)[:, 0].tanh()


def without_position(decoder_params: Tensor) -> Tensor:
    """Decoder parameters whose weights of the three position inputs are 0."""
    hidden, inputs = DECODER_WIDTHS[1], DECODER_WIDTHS[0]
    params = decoder_params.clone()
    params[: hidden * inputs].view(hidden, inputs)[:, :3] = 0
    return params


def _lattice_row(patch: Tensor, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Row of a patch's lattice corner, and whether the corner lies on the lattice; others get a row of its border."""
    inside = (corner.abs() <= LATTICE_RADIUS).all(-1)
    x, y, z = (corner.clamp(-LATTICE_RADIUS, LATTICE_RADIUS) + LATTICE_RADIUS).unbind(-1)
    return ((patch * _LATTICE_SIZE + x) * _LATTICE_SIZE + y) * _LATTICE_SIZE + z, inside
