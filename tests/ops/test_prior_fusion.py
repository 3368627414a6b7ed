"""The scene prior's ops against plain formulas."""

import pytest
import torch

from spslam import ops


def fusion_case(generator, device, voxels=50, rows=20):
    embeddings = torch.randn(voxels, 8, generator=generator)
    weights = torch.rand(voxels, generator=generator) * 3
    weights[::3] = 0
    ids = torch.randperm(voxels, generator=generator)[:rows].int()
    features = torch.randn(rows, 8, generator=generator)
    feature_weights = torch.rand(rows, generator=generator)
    feature_weights[::4] = 0
    return [x.to(device) for x in (embeddings, weights, ids, features, feature_weights)]


def test_fuse_prior_is_equation_1(device, generator):
    embeddings, weights, ids, features, feature_weights = fusion_case(generator, device)
    want, want_weights = embeddings.double(), weights.double()
    for row, v in enumerate(ids.tolist()):
        w, total = feature_weights[row].double(), want_weights[v] + feature_weights[row].double()
        if w > 0:
            want[v] = (want_weights[v] * want[v] + w * features[row].double()) / total
            want_weights[v] = min(total, 2.0)
    ops.fuse_prior_(embeddings, weights, ids, features, feature_weights, 2.0)
    assert torch.allclose(embeddings.double(), want, atol=1e-6)
    assert torch.allclose(weights.double(), want_weights, atol=1e-6)


def test_fuse_prior_skips_rows_outside(device, generator):
    embeddings, weights, _, features, feature_weights = fusion_case(generator, device, rows=3)
    before = embeddings.clone(), weights.clone()
    ids = torch.tensor([-1, 50, 2**31 - 1], dtype=torch.int32, device=device)
    ops.fuse_prior_(embeddings, weights, ids, features, feature_weights, 2.0)
    assert torch.equal(embeddings, before[0])
    assert torch.equal(weights, before[1])
    ops.fuse_prior_(embeddings, weights, ids[:0], features[:0], feature_weights[:0], 2.0)


def test_fuse_prior_takes_strided_features(device, generator):
    embeddings, weights, ids, features, feature_weights = fusion_case(generator, device)
    again = embeddings.clone(), weights.clone()
    ops.fuse_prior_(embeddings, weights, ids, features, feature_weights, 2.0)
    ops.fuse_prior_(*again, ids, features.T.contiguous().T, feature_weights.repeat(2, 1).T[:, 0], 2.0)
    assert torch.equal(embeddings, again[0])
    assert torch.equal(weights, again[1])


def test_fuse_prior_names_wrong_arguments(generator):
    embeddings, weights, ids, features, feature_weights = fusion_case(generator, "cpu")
    with pytest.raises(ValueError, match=r"fuse_prior_: features must have shape \[20, 8\], got \[19, 8\]"):
        ops.fuse_prior_(embeddings, weights, ids, features[1:], feature_weights, 2.0)
    with pytest.raises(ValueError, match=r"fuse_prior_: weights must have shape \[50\], got \[49\]"):
        ops.fuse_prior_(embeddings, weights[1:], ids, features, feature_weights, 2.0)
    with pytest.raises(ValueError, match="fuse_prior_: max_weight must be positive, got 0"):
        ops.fuse_prior_(embeddings, weights, ids, features, feature_weights, 0)
    with pytest.raises(TypeError, match="fuse_prior_: voxel_ids must be int32, got int64"):
        ops.fuse_prior_(embeddings, weights, ids.long(), features, feature_weights, 2.0)


def test_opcheck(device, generator):
    torch.library.opcheck(torch.ops.spslam.fuse_prior_, (*fusion_case(generator, device), 2.0))
