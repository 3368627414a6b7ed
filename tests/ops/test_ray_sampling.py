"""Philox draws and the samples along rays."""

import numpy as np
import pytest
import torch

from spslam import ops
from tests import reference
from tests.reference import philox4x32
from tests.reference.ray_sampling import philox_words

PAPER = dict(num_uniform=32, num_surface=11, near=0.2, far=1.02, truncation=0.08)
KEY = dict(seed=2**35 + 5, stream=ops.RandomStream.MAPPING_RAYS, frame=7, iteration=3)
OPCHECKS = ("test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic")


def test_reference_reproduces_the_published_vector():
    out = philox4x32(np.zeros((1, 4), np.uint32), (0, 0))[0]
    assert [hex(x) for x in out] == ["0x6627e8d5", "0xe169c58d", "0xbc57ac4c", "0x9b00dbd8"]


def test_uniform_is_the_high_bits_of_philox(device):
    got = ops.philox_uniform(2**40 + 7, ops.RandomStream.TRACKING_RAYS, 3, 11, 5000, device).cpu()
    want = (philox_words(2**40 + 7, 2, 3, 11, 5000) >> 8).astype(np.float32) / np.float32(2**24)
    assert torch.equal(got, torch.from_numpy(want))


def test_indices_cover_the_range_evenly(device):
    got = ops.sample_indices(1, ops.RandomStream.PIXEL_DATABASE, 0, 0, 100_000, 7, device).cpu()
    want = (philox_words(1, 0, 0, 0, 100_000).astype(np.uint64) * np.uint64(7)) >> np.uint64(32)
    assert torch.equal(got, torch.from_numpy(want.astype(np.int64)))
    assert (torch.bincount(got, minlength=7) - 100_000 / 7).abs().max() < 600


def test_empty(device):
    assert ops.philox_uniform(0, 0, 0, 0, 0, device).shape == (0,)


@pytest.mark.parametrize("upper", [0, -3, 2**32 + 1])
def test_upper_out_of_range_is_named(upper):
    with pytest.raises(ValueError, match=rf"sample_indices: upper must be in \[1, 2\^32\], got {upper}"):
        ops.sample_indices(0, 0, 0, 0, 1, upper)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("counts", [(32, 11), (0, 5), (7, 0), (1, 1), (70, 3)])
def test_samples_equal_the_reference(dtype, counts, device, generator):
    depth = (torch.rand(500, generator=generator, dtype=dtype) * 5 + 0.1).to(device)
    settings = PAPER | dict(zip(("num_uniform", "num_surface"), counts, strict=True))
    got = ops.sample_along_rays(depth, **settings, **KEY)
    want = reference.ray_sampling.sample_along_rays(depth, *settings.values(), *KEY.values())
    # A few roundings of a depth of up to five meters.
    torch.testing.assert_close(got, want, rtol=0, atol=5e-6 if dtype == torch.float32 else 1e-14)
    assert (got.diff(dim=1) >= 0).all()


def test_each_part_of_the_intervals_gets_one_sample(device):
    depth = torch.full((64,), 2.0, device=device)
    uniform = ops.sample_along_rays(depth, **(PAPER | dict(num_surface=0)), **KEY)
    assert torch.equal(((uniform / 2 - 0.2) / 0.82 * 32).floor(), torch.arange(32.0, device=device).expand(64, 32))
    surface = ops.sample_along_rays(depth, **(PAPER | dict(num_uniform=0)), **KEY)
    assert torch.equal(((surface - 1.92) / 0.16 * 11).floor(), torch.arange(11.0, device=device).expand(64, 11))


def test_rays_without_depth_get_zeros(device):
    depth = torch.tensor([1.0, 0.0, -1.0, float("nan"), float("inf"), 2.0], device=device)
    samples = ops.sample_along_rays(depth, **PAPER, **KEY)
    assert not samples[1:5].any()
    assert (samples[[0, 5]] > 0).all()


def test_samples_do_not_depend_on_the_other_rays_nor_on_threads(device):
    depth = torch.linspace(0.5, 4, 3000, device=device)
    samples = ops.sample_along_rays(depth, **PAPER, **KEY)
    assert torch.equal(ops.sample_along_rays(depth[:17], **PAPER, **KEY), samples[:17])
    threads = ops.get_num_threads()
    try:
        ops.set_num_threads(5)
        assert torch.equal(ops.sample_along_rays(depth, **PAPER, **KEY), samples)
    finally:
        ops.set_num_threads(threads)


def test_samples_of_strided_and_empty_input(device):
    depth = torch.linspace(0.5, 4, 30, device=device)
    assert torch.equal(
        ops.sample_along_rays(depth[::3], **PAPER, **KEY), ops.sample_along_rays(depth[::3].clone(), **PAPER, **KEY)
    )
    assert ops.sample_along_rays(depth[:0], **PAPER, **KEY).shape == (0, 43)
    assert ops.sample_along_rays(depth, 0, 0, 0.2, 1.0, 0.1, **KEY).shape == (30, 0)


def test_opcheck(device):
    depth = torch.linspace(0.5, 4, 5, device=device)
    arguments = (depth, 4, 3, 0.2, 1.02, 0.08, 1, 2, 3, 4)
    torch.library.opcheck(torch.ops.spslam.sample_along_rays.default, arguments, test_utils=OPCHECKS)
    out = torch.empty(5, device=device)
    torch.library.opcheck(torch.ops.spslam.philox_uniform.default, (1, 2, 3, 4, out), test_utils=OPCHECKS)
    out = torch.empty(5, dtype=torch.int64, device=device)
    torch.library.opcheck(torch.ops.spslam.sample_indices.default, (1, 2, 3, 4, 9, out), test_utils=OPCHECKS)


def test_compiles_without_a_graph_break(device):
    depth = torch.linspace(0.5, 4, 5, device=device)
    compiled = torch.compile(ops.sample_along_rays, backend="aot_eager", fullgraph=True)
    assert torch.equal(compiled(depth, **PAPER, **KEY), ops.sample_along_rays(depth, **PAPER, **KEY))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(depth=torch.zeros(3, 1)), ValueError, r"depth must have shape \[R\], got \[3, 1\]"),
        (dict(depth=torch.zeros(3).int()), TypeError, "depth must be float32 or float64, got int32"),
        (dict(num_uniform=-1), ValueError, r"num_uniform must be in \[0, 2\^20\], got -1"),
        (dict(num_surface=2**20 + 1), ValueError, r"num_surface must be in \[0, 2\^20\], got 1048577"),
        (dict(near=-0.1), ValueError, "near must be at least 0, got -0.1"),
        (dict(far=0.1), ValueError, r"far must be at least near \(0.2\), got 0.1"),
        (dict(truncation=-1.0), ValueError, "truncation must be at least 0, got -1.0"),
        (
            dict(depth=torch.zeros(4097), num_uniform=2**20, num_surface=0),
            ValueError,
            r"depth must have at most 2\^32 / S rays, got 4097",
        ),
    ],
)
def test_wrong_argument_of_sample_along_rays_is_named(change, error, message):
    with pytest.raises(error, match=f"sample_along_rays: {message}"):
        ops.sample_along_rays(**(dict(depth=torch.ones(2)) | PAPER | KEY | change))


def test_docstring_examples_run():
    import doctest

    import spslam.ops.ray_sampling as module

    assert doctest.testmod(module).failed == 0


@pytest.mark.parametrize("number", [-1, 2**32])
def test_keys_out_of_range_are_named(number):
    calls = [
        lambda frame, iteration: ops.philox_uniform(0, 0, frame, iteration, 2),
        lambda frame, iteration: ops.sample_indices(0, 0, frame, iteration, 2, 6),
        lambda frame, iteration: ops.sample_along_rays(torch.ones(2), 2, 1, 0.0, 1.0, 0.1, 0, 0, frame, iteration),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=r": frame must be in \[0, 2\^32 - 1\]"):
            call(number, 0)
        with pytest.raises(ValueError, match=r": iteration must be in \[0, 2\^32 - 1\]"):
            call(0, number)
