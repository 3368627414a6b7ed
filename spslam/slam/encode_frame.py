"""Allocates voxels around a frame's surface points and fuses the encoding of these points."""

from __future__ import annotations

import torch

from spslam import ops
from spslam.errors import ConfigError
from spslam.options import PriorOptions
from spslam.prior.encoder import Prior
from spslam.scene import SparseVolume

# Point-vertex pairs with a weight below this fraction of `options.min_weight` are not encoded: this changes 99 % of the
# SDF by less than 0.1 mm.
_LIGHT_PAIR = 1 / 60


def encode_frame(
    volume: SparseVolume,
    points: torch.Tensor,
    normals: torch.Tensor,
    prior: Prior | None,
    options: PriorOptions,
    seed: int = 0,
    tf32: bool = True,
) -> ops.EncodedFrame:
    """Encodes a frame's surface points and fuses them into the volume; section III.A and equation (1) of SP-SLAM.

    Vertices whose points weigh more than `options.min_weight` in sum are allocated; the weight of a fusion is that sum
    over `options.kappa`, at most 1; without `options.fusion` only new vertices take a feature (Table VIII). Without a
    prior the same vertices are allocated and new ones start at random.

    Args:
        volume: the sparse volume; changed.
        points: float32 [N, 3], world, meters, in random order: the first `options.points_per_frame` that have a normal
            are taken.
        normals: float32 [N, 3], world, unit, towards the camera; 0 = unknown.
        prior: the networks; None for random embeddings.
        options: the configuration's section `prior`.
        seed: of the random embeddings.
        tf32: how the encoder multiplies on CUDA, see `ops.encode_points`.

    Returns:
        How many vertices were new, and the bounds of the points. On CUDA this waits for the device, once.

    Raises:
        ConfigError: `options.neighborhood` isn't the one that the weights were trained for.
        SpslamError: the volume's limit would be passed; it is then as before.
    """
    if prior is None:
        return _allocate(volume, points, normals, options, seed)
    if options.neighborhood != prior.neighborhood:
        raise ConfigError(
            f"prior.neighborhood must be {prior.neighborhood}, that of the weights, got {options.neighborhood}"
        )
    fusion = ops.FrameFusion(
        volume.voxel_size_m,
        prior.neighborhood,
        options.min_weight * _LIGHT_PAIR,
        options.points_per_frame,
        options.min_weight,
        options.kappa,
        options.max_weight,
        fuse_known=options.fusion,
    )
    return volume.encode(points, normals, prior.encoder_params.to(points.device), fusion, tf32)


def _allocate(
    volume: SparseVolume, points: torch.Tensor, normals: torch.Tensor, options: PriorOptions, seed: int
) -> ops.EncodedFrame:
    """Allocates the vertices that an encoder would reach; new ones get random embeddings."""
    finite = points[points.isfinite().all(1)].cpu()
    bounds = torch.stack([finite.amin(0), finite.amax(0)]) if len(finite) else torch.tensor([[torch.inf], [-torch.inf]])
    known = (normals != 0).any(1).nonzero()[: options.points_per_frame, 0]
    no_encoder = points.new_zeros(ops.ENCODER_PARAMETERS)
    voxel_coords, _, weights = ops.encode_points(
        points[known], normals[known], no_encoder, volume.voxel_size_m, options.neighborhood
    )
    first_new = volume.num_voxels
    volume.insert(voxel_coords[weights > options.min_weight])
    volume.embeddings[first_new:] = ops.random_embeddings(volume.voxel_coords[first_new:], seed)
    return ops.EncodedFrame(volume.num_voxels - first_new, True, bounds.expand(2, 3))
