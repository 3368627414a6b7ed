"""The networks of the prior for training: the encoder of point-vertex pairs and the geometry decoder, in torch.

Inference uses `spslam.ops.encode_points` and the decoder ops. This module computes the same, differentiably, on a batch
of patches. Parameters are flat vectors in the layout of the ops. Lengths are in voxels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Generator, Tensor
from torch.nn.functional import linear

from spslam.prior.encoder import DECODER_WIDTHS, ENCODER_WIDTHS
from spslam.prior.patches import Patches

GRID_RADIUS = 6
_GRID_SIZE = 2 * GRID_RADIUS + 1


def initial_parameters(sizes: tuple[int, ...], generator: Generator) -> Tensor:
    """Random initial parameters, float32 [P]: uniform within 1/sqrt(inputs) of each layer, as torch.nn.Linear's."""
    layers = []
    for inputs, outputs in zip(sizes, sizes[1:], strict=False):
        uniform = torch.rand(inputs * outputs + outputs, generator=generator)
        layers.append((2 * uniform - 1) / inputs**0.5)
    return torch.cat(layers)


def perceptron(inputs: Tensor, parameters: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """A ReLU network [N, I] -> [N, O].

    Args:
        inputs: [N, I].
        parameters: W1, b1, W2, b2, W3, b3, flat, row-major.
        sizes: layer widths.
    """
    start, last = 0, len(sizes) - 2
    for layer, (width, outputs) in enumerate(zip(sizes, sizes[1:], strict=False)):
        weight = parameters[start : start + outputs * width].view(outputs, width)
        start += outputs * width
        inputs = linear(inputs, weight, parameters[start : start + outputs])
        start += outputs
        inputs = inputs if layer == last else inputs.relu_()
    return inputs


def corner_offsets(neighborhood: int) -> Tensor:
    """Offsets int64 [K, 3] of the K vertices around a point, relative to the lower corner of its voxel."""
    axis = {8: torch.arange(0, 2), 64: torch.arange(-1, 3)}[neighborhood]
    return torch.cartesian_prod(axis, axis, axis)


@dataclass(frozen=True)
class Pairs:
    """Q pairs of a point and a grid vertex.

    Attributes:
        point: int64 [Q], index of the point.
        corner: int64 [Q, 3], coordinates of the vertex.
        inputs: [Q, 6], input of the encoder.
        weight: [Q].
    """

    point: Tensor
    corner: Tensor
    inputs: Tensor
    weight: Tensor


def pair_points(points: Tensor, normals: Tensor, neighborhood: int, min_pair_weight: float) -> Pairs:
    """Pairs points with the vertices around them.

    The weight of a pair of point x and vertex c is `prod(1 - |x - c| / r)^3`, with r = 2 for 64 vertices and r = 1 for
    8. The input of the encoder is `[(x - c) / r, n]`.

    Args:
        points: [N, 3].
        normals: [N, 3].
        neighborhood: vertices per point, 64 or 8.
        min_pair_weight: pairs with a smaller weight are left out.
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
    """Weighted mean of features [Q, C] per output row, [rows, C], and the sums of weights [rows]; empty rows are 0."""
    totals = torch.zeros(rows, dtype=weight.dtype).index_add(0, row, weight)
    sums = torch.zeros(rows, features.shape[1], dtype=features.dtype).index_add(0, row, features * weight[:, None])
    return sums / totals.where(totals > 0, 1.0)[:, None], totals


def encode(
    points: Tensor, normals: Tensor, encoder_params: Tensor, neighborhood: int, min_pair_weight: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Same as `spslam.ops.encode_points`, for points in voxels: sorted vertices, mean features, weights."""
    pairs = pair_points(points, normals, neighborhood, min_pair_weight)
    features = perceptron(pairs.inputs, encoder_params, ENCODER_WIDTHS)
    corners, row = pairs.corner.unique(dim=0, return_inverse=True)
    return corners, *weighted_means(features, pairs.weight, row, len(corners))


@dataclass(frozen=True)
class PatchFields:
    """Feature fields of B patches, on grids of vertices with coordinates in [-GRID_RADIUS, GRID_RADIUS].

    Attributes:
        embeddings: [B*L^3, 8], L = 2 GRID_RADIUS + 1.
        weights: [B*L^3], 0 for vertices without a point nearby.
    """

    embeddings: Tensor
    weights: Tensor

    def interpolate(self, patch: Tensor, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Interpolates features trilinearly.

        Args:
            patch: int64 [Q], index of the patch of each query.
            queries: [Q, 3].

        Returns:
            [Q, 8], and bool [Q], whether all eight corners have features.
        """
        lower = queries.floor()
        offsets = corner_offsets(8)
        share = (1 - (queries[:, None] - lower[:, None] - offsets).abs()).prod(-1)
        row, inside = _grid_row(patch[:, None], lower.long()[:, None] + offsets)
        inside = inside.all(-1) & (self.weights[row] > 0).all(-1)
        return (self.embeddings[row] * share[..., None]).sum(1), inside


def encode_patches(patches: Patches, encoder_params: Tensor, neighborhood: int, min_pair_weight: float) -> PatchFields:
    """Encodes the observed points of every patch, as `encode`. Differentiable with respect to the parameters."""
    patch, _ = patches.seen.nonzero().unbind(1)
    pairs = pair_points(patches.points[patches.seen], patches.normals[patches.seen], neighborhood, min_pair_weight)
    row, inside = _grid_row(patch[pairs.point], pairs.corner)
    features = perceptron(pairs.inputs, encoder_params, ENCODER_WIDTHS)
    rows = len(patches.seen) * _GRID_SIZE**3
    return PatchFields(*weighted_means(features, pairs.weight * inside, row, rows))


def decode(features: Tensor, decoder_params: Tensor) -> Tensor:
    """SDF / truncation [Q] of features [Q, 8], at position 0, because the trained decoder ignores the position."""
    return perceptron(torch.nn.functional.pad(features, (3, 0)), decoder_params, DECODER_WIDTHS)[:, 0].tanh()


def without_position(decoder_params: Tensor) -> Tensor:
    """Decoder parameters with the weights of the three position inputs set to 0."""
    hidden, inputs = DECODER_WIDTHS[1], DECODER_WIDTHS[0]
    params = decoder_params.clone()
    params[: hidden * inputs].view(hidden, inputs)[:, :3] = 0
    return params


def _grid_row(patch: Tensor, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Row of a vertex in the grid of its patch, and whether it is inside; others get the nearest row at the border."""
    inside = (corner.abs() <= GRID_RADIUS).all(-1)
    x, y, z = (corner.clamp(-GRID_RADIUS, GRID_RADIUS) + GRID_RADIUS).unbind(-1)
    return ((patch * _GRID_SIZE + x) * _GRID_SIZE + y) * _GRID_SIZE + z, inside
