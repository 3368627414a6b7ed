"""The scene prior: normals of a depth image, the depth encoder, and its fusion into the sparse volume."""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor

FEATURES = 8


def fuse_prior_(
    embeddings: torch.Tensor,
    weights: torch.Tensor,
    voxel_ids: torch.Tensor,
    features: torch.Tensor,
    feature_weights: torch.Tensor,
    max_weight: float,
) -> None:
    """Fuses encoded features into the sparse volume, in place; equation (1) of SP-SLAM.

    E <- (W E + w f) / (W + w), then W <- min(W + w, max_weight). A feature of weight 0 changes nothing. Each voxel has
    one writer: the same result on every run and for every thread count.

    Args:
        embeddings: float32 [V, 8], contiguous; changed.
        weights: float32 [V], contiguous; changed.
        voxel_ids: int32 [M], distinct; rows outside [0, V) are skipped.
        features: float32 [M, 8].
        feature_weights: float32 [M], at least 0.
        max_weight: cap of the total weight, positive.

    Raises:
        ValueError: wrong shapes or devices, or `max_weight` not positive.
        TypeError: wrong dtypes.
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


@torch.library.register_fake("spslam::fuse_prior_")
def _(embeddings, weights, voxel_ids, features, feature_weights, max_weight):
    return None
