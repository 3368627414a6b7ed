"""The networks of the training compute the same as the ops."""

import pytest
import torch

from spslam import ops
from spslam.prior.encoder import DECODER_WIDTHS, ENCODER_WIDTHS
from spslam.prior.model import (
    PatchFields,
    corner_offsets,
    decode,
    encode,
    encode_patches,
    initial_parameters,
    perceptron,
    weighted_means,
    without_position,
)
from spslam.prior.patches import PatchSettings, observe

# float32 sums of up to some hundred pairs, in another order.
ROUNDING = 2e-5


@pytest.fixture
def encoder(generator):
    return initial_parameters(ENCODER_WIDTHS, generator)


@pytest.fixture
def decoder(generator):
    return initial_parameters(DECODER_WIDTHS, generator)


def cloud(generator, count=700, dtype=torch.float32):
    points = 6 * torch.rand(count, 3, generator=generator, dtype=dtype) - 3
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=-1)
    return points, normals


@pytest.mark.parametrize("neighborhood", [8, 64])
@pytest.mark.parametrize("min_pair_weight", [0.0, 1e-3, 0.02])
def test_encoding_equals_that_of_the_op(neighborhood, min_pair_weight, encoder, generator):
    points, normals = cloud(generator)
    corners, features, weights = encode(points, normals, encoder, neighborhood, min_pair_weight)
    actual = ops.encode_points(points, normals, encoder, 1.0, neighborhood, min_pair_weight)
    assert torch.equal(actual[0].long(), corners)
    torch.testing.assert_close(actual[1], features, atol=ROUNDING, rtol=ROUNDING)
    torch.testing.assert_close(actual[2], weights, atol=ROUNDING, rtol=ROUNDING)


def test_decoding_equals_that_of_the_op(decoder, generator):
    features = torch.randn(50, 8, generator=generator)
    inputs = torch.cat([torch.zeros(50, 3), features], 1)
    expected = ops.mlp(inputs, decoder, 32, 1, ops.Activation.TANH)[:, 0]
    torch.testing.assert_close(decode(features, decoder), expected, atol=ROUNDING, rtol=ROUNDING)


def test_patches_are_encoded_independently(encoder, generator):
    patches = observe("box_on_plane", 5, generator, PatchSettings())
    fields = encode_patches(patches, encoder, 64, 1e-3)
    grid = torch.cartesian_prod(*[torch.arange(-6, 7)] * 3)
    embeddings, weights = fields.embeddings.view(5, len(grid), 8), fields.weights.view(5, len(grid))
    for patch in range(5):
        seen = patches.seen[patch]
        corners, features, sums = encode(patches.points[patch][seen], patches.normals[patch][seen], encoder, 64, 1e-3)
        filled = weights[patch] > 0
        assert torch.equal(grid[filled], corners)
        torch.testing.assert_close(embeddings[patch][filled], features, atol=ROUNDING, rtol=ROUNDING)
        torch.testing.assert_close(weights[patch][filled], sums, atol=ROUNDING, rtol=ROUNDING)


def test_interpolation_equals_that_of_the_op(generator):
    side = 13
    embeddings = torch.randn(2 * side**3, 8, generator=generator)
    fields = PatchFields(embeddings, torch.ones(2 * side**3))
    patch = torch.tensor([0, 1, 1, 0])
    queries = 10 * torch.rand(4, 3, generator=generator) - 5
    features, inside = fields.interpolate(patch, queries)
    lower = queries.floor()
    steps = torch.tensor([side * side, side, 1])
    ids = patch[:, None] * side**3 + ((lower.long()[:, None] + corner_offsets(8).flip(1) + 6) * steps).sum(-1)
    expected = ops.trilinear_interpolate(embeddings, ids.int(), queries - lower)
    assert inside.all()
    torch.testing.assert_close(features, expected, atol=ROUNDING, rtol=ROUNDING)


def test_a_query_needs_all_eight_corners():
    weights = torch.ones(13**3)
    weights[(6 * 13 + 6) * 13 + 6] = 0
    fields = PatchFields(torch.zeros(13**3, 8), weights)
    queries = torch.tensor([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [6.5, 0.0, 0.0]])
    _, inside = fields.interpolate(torch.zeros(3, dtype=torch.int64), queries)
    assert inside.tolist() == [False, True, False]


def test_gradients(generator):
    sizes = (6, 5, 4, 8)
    params = initial_parameters(sizes, generator).double().requires_grad_()
    inputs = torch.randn(3, 6, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda p: perceptron(inputs, p, sizes), params)


def test_decoder_without_position_ignores_it(decoder, generator):
    params = without_position(decoder)
    features = torch.randn(20, 8, generator=generator)
    here, there = (torch.cat([50 * torch.randn(20, 3, generator=generator), features], 1) for _ in range(2))
    first, second = (ops.mlp(x, params, 32, 1, ops.Activation.TANH) for x in (here, there))
    assert torch.equal(first, second)
    assert not torch.equal(params, decoder)


def test_means_of_rows_without_entries_are_zero():
    means, totals = weighted_means(torch.ones(2, 3), torch.tensor([1.0, 3.0]), torch.tensor([2, 2]), 4)
    assert totals.tolist() == [0, 0, 4, 0]
    assert means.tolist() == [[0] * 3, [0] * 3, [1] * 3, [0] * 3]


@pytest.mark.parametrize("neighborhood", [8, 64])
def test_no_points(neighborhood, encoder):
    corners, features, weights = encode(torch.zeros(0, 3), torch.zeros(0, 3), encoder, neighborhood, 0.0)
    assert (corners.shape, features.shape, weights.shape) == ((0, 3), (0, 8), (0,))
