"""The scene prior: normals of a depth image, the point encoder, and fusion into the sparse volume."""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops._vmap import register_rows_vmap

FEATURES = 8
_HIDDEN = 64
_MAX_SIDE = 2**16 - 1  # of an image, px
# Encoder, as the layout of `mlp` has it: W1 [64, 6], b1, W2 [64, 64], b2, W3 [8, 64], b3.
ENCODER_PARAMETERS = _HIDDEN * (6 + 1) + _HIDDEN * (_HIDDEN + 1) + FEATURES * (_HIDDEN + 1)


@public_op()
def depth_normals(
    depth: torch.Tensor,
    pixels: torch.Tensor,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    step_px: int,
    max_jump: float,
) -> torch.Tensor:
    """Surface normals at pixels of a depth image.

    The cross product of the central differences of the unprojected points `step_px` to the left and right, and above
    and below. The depth of these four pixels and of the center is smoothed before by a 5x5 bilateral filter: a Gaussian
    with a standard deviation of 2 px in the image, a biweight of 6 cm in depth.

    Args:
        depth: float32 [H, W], meters; values that are 0, negative or not finite are invalid.
        pixels: int32 [N, 2], (u, v): column, row.
        fx, fy, cx, cy: pinhole intrinsics, px.
        step_px: distance of the neighbors from the pixel, 1 to 65535.
        max_jump: relative difference between a neighbor's depth and the pixel's from which on there is a depth
            discontinuity between them.

    Returns:
        float32 [N, 3] unit normals in camera axes, facing the camera (n . p < 0). 0 where undefined: invalid depth at
        one of the five pixels, a depth discontinuity, or a pixel outside the image or nearer than `step_px` to its
        border. Deterministic. N = 0 gives an empty tensor.

    Raises:
        ValueError: wrong shapes or devices, `fx`, `fy` or `max_jump` not positive, `step_px` out of range.
        TypeError: wrong dtypes.

    Example:
        >>> wall, pixels = torch.ones(32, 48), torch.tensor([[24, 16], [0, 0]], dtype=torch.int32)
        >>> depth_normals(wall, pixels, 50.0, 50.0, 24.0, 16.0, step_px=2, max_jump=0.1)[:, 2]
        tensor([-1.,  0.])
    """
    name = "depth_normals"
    check_tensor(name, "depth", depth, ["H", "W"], torch.float32)
    check_tensor(name, "pixels", pixels, ["N", 2], torch.int32, like=depth)
    check(fx > 0, name, "fx", "be positive", fx)
    check(fy > 0, name, "fy", "be positive", fy)
    check(step_px >= 1, name, "step_px", "be at least 1", step_px)
    check(step_px <= _MAX_SIDE, name, "step_px", f"be at most {_MAX_SIDE}", step_px)
    check(max_jump > 0, name, "max_jump", "be positive", max_jump)
    return torch.ops.spslam.depth_normals(depth, pixels, fx, fy, cx, cy, step_px, max_jump)


@public_op()
def encode_points(
    points: torch.Tensor,
    normals: torch.Tensor,
    encoder_params: torch.Tensor,
    voxel_size: float,
    neighborhood: int = 64,
    min_pair_weight: float = 1e-4,
    tf32: bool = True,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Encodes surface points into features at the voxel vertices around them; section III.A of SP-SLAM.

    The feature of a point x (in voxels) with normal n at a vertex c is `encoder([(x - c) / r, n])`, and its weight is
    `prod(1 - |x - c| / r)^3` over the axes. A neighborhood of 64 has r = 2 and the 4x4x4 vertices around the point, a
    neighborhood of 8 has r = 1 and the corners of its cell. The encoder is 6 -> 64 -> 64 -> 8 with ReLU.

    Args:
        points: float32 [N, 3], world, meters. Points that are not finite or beyond 2^20 voxels are skipped.
        normals: float32 [N, 3], unit, world, towards the camera; points whose normal is 0 are skipped.
        encoder_params: float32 [5128], flat, in the layout of `mlp`.
        voxel_size: meters.
        neighborhood: 64 or 8.
        min_pair_weight: pairs of a point and a vertex with a smaller weight are left out.
        tf32: on CUDA devices from sm_80 on, use tensor cores with factors rounded to 10 bits of mantissa, which changes
            features by a relative 1e-3. Otherwise, and on other devices, everything is float32. Sums of weights are
            always exact.

    Returns:
        voxel_coords int32 [M, 3], all vertices with a pair, sorted by (x, y, z); features float32 [M, 8], weighted
        means; weights float32 [M], sums of weights. The same in every run and for any number of threads; not
        differentiable. N = 0 gives M = 0. Coordinates and weights are the same on every device. On CUDA a feature that
        is not finite or exceeds 32768 makes all features NaN, and the call synchronizes with the device.

    Raises:
        ValueError: wrong shapes or devices, `voxel_size` not positive, another neighborhood, a negative minimum.
        TypeError: wrong dtypes.

    Example:
        >>> point, normal = torch.tensor([[0.5, 0.5, 0.5]]), torch.tensor([[0.0, 0.0, -1.0]])
        >>> coords, features, weights = encode_points(point, normal, torch.zeros(ENCODER_PARAMETERS), 1.0, 8)
        >>> coords[0], features.shape, weights[0]  # the weight of each of the eight corners is 0.5^9
        (tensor([0, 0, 0], dtype=torch.int32), torch.Size([8, 8]), tensor(0.0020))
    """
    name = "encode_points"
    check_tensor(name, "points", points, ["N", 3], torch.float32)
    check_tensor(name, "normals", normals, [points.shape[0], 3], torch.float32, like=points)
    check_tensor(name, "encoder_params", encoder_params, [ENCODER_PARAMETERS], torch.float32, like=points)
    check(voxel_size > 0, name, "voxel_size", "be positive", voxel_size)
    check(neighborhood in (8, 64), name, "neighborhood", "be 64 or 8", neighborhood)
    check(min_pair_weight >= 0, name, "min_pair_weight", "be at least 0", min_pair_weight)
    return torch.ops.spslam.encode_points(
        points, normals, encoder_params, voxel_size, neighborhood, min_pair_weight, tf32
    )


@public_op(as_given=("embeddings", "weights"))
def fuse_prior_(
    embeddings: torch.Tensor,
    weights: torch.Tensor,
    voxel_ids: torch.Tensor,
    features: torch.Tensor,
    feature_weights: torch.Tensor,
    max_weight: float,
) -> None:
    """Fuses encoded features into the sparse volume, in place; equation (1) of SP-SLAM.

    E <- (W E + w f) / (W + w), then W <- min(W + w, max_weight). A weight w that is 0, negative or NaN changes nothing;
    a feature that is NaN makes its voxel NaN. Each voxel is written by one thread only: the same result in every run
    and for any number of threads.

    Args:
        embeddings: float32 [V, 8], contiguous; changed.
        weights: float32 [V], contiguous; changed.
        voxel_ids: int32 [M], distinct; rows outside [0, V) are skipped.
        features: float32 [M, 8].
        feature_weights: float32 [M], at least 0.
        max_weight: upper limit of the accumulated weight, positive.

    Raises:
        ValueError: wrong shapes or devices, or `max_weight` not positive.
        TypeError: wrong dtypes.

    Example:
        >>> embeddings, weights = torch.zeros(1, 8), torch.ones(1)
        >>> fuse_prior_(embeddings, weights, torch.zeros(1, dtype=torch.int32), torch.ones(1, 8), torch.ones(1), 9.0)
        >>> embeddings[0, 0], weights
        (tensor(0.5000), tensor([2.]))
    """
    name = "fuse_prior_"
    check_tensor(name, "embeddings", embeddings, ["V", FEATURES], torch.float32)
    check_tensor(name, "weights", weights, [embeddings.shape[0]], torch.float32, like=embeddings)
    check_tensor(name, "voxel_ids", voxel_ids, ["M"], torch.int32, like=embeddings)
    rows = voxel_ids.shape[0]
    check_tensor(name, "features", features, [rows, FEATURES], torch.float32, like=embeddings)
    check_tensor(name, "feature_weights", feature_weights, [rows], torch.float32, like=embeddings)
    check(max_weight > 0, name, "max_weight", "be positive", max_weight)
    torch.ops.spslam.fuse_prior_(embeddings, weights, voxel_ids, features, feature_weights, max_weight)
    changed_in_place(embeddings, weights)


@public_op()
def random_embeddings(voxel_coords: torch.Tensor, seed: int, scale: float = 0.01) -> torch.Tensor:
    """Initial embeddings without a prior: random numbers from N(0, scale^2) that depend only on voxel and seed.

    Args:
        voxel_coords: int32 [M, 3], any integers.
        seed: 64-bit seed.
        scale: standard deviation, at least 0.

    Returns:
        float32 [M, 8]; independent of the other rows of `voxel_coords`, and up to rounding the same on every device.

    Raises:
        ValueError: wrong shape, or a negative scale.
        TypeError: wrong dtype.

    Example:
        >>> coords = torch.tensor([[1, 2, 3], [4, 5, 6]], dtype=torch.int32)
        >>> torch.equal(random_embeddings(coords, seed=0)[1:], random_embeddings(coords[1:], seed=0))
        True
    """
    check_tensor("random_embeddings", "voxel_coords", voxel_coords, ["M", 3], torch.int32)
    check(scale >= 0, "random_embeddings", "scale", "be at least 0", scale)
    return torch.ops.spslam.random_embeddings(voxel_coords, seed, scale)


@torch.library.register_fake("spslam::random_embeddings")
def _(voxel_coords, seed, scale):
    return voxel_coords.new_empty((voxel_coords.shape[0], FEATURES), dtype=torch.float32)


@torch.library.register_fake("spslam::fuse_prior_")
def _(embeddings, weights, voxel_ids, features, feature_weights, max_weight):
    return None


@torch.library.register_fake("spslam::depth_normals")
def _(depth, pixels, fx, fy, cx, cy, step_px, max_jump):
    return depth.new_empty((pixels.shape[0], 3))


@torch.library.register_fake("spslam::encode_points")
def _(points, normals, encoder_params, voxel_size, neighborhood, min_pair_weight, tf32=True):
    rows = torch.library.get_ctx().new_dynamic_size()
    return points.new_empty((rows, 3), dtype=torch.int32), points.new_empty((rows, FEATURES)), points.new_empty(rows)


register_rows_vmap("depth_normals", (1,))
register_rows_vmap("random_embeddings", (0,))
