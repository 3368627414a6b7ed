"""A whole mapping call against a loop of its parts: `sample_indices`, `render_step`, `sparse_adam_`."""

from dataclasses import replace

import pytest
import torch

from spslam import ops
from tests.ops.mapping_scene import RATES, RENDER_OPTIONS, Map
from tests.ops.scenes import INTRINSICS
from tests.ops.threads import with_threads

# The first iteration is the same arithmetic; the compiler may fuse its products and sums otherwise.
FIRST_TOLERANCE = dict(rtol=1e-5, atol=1e-6)
# Adam's first steps go by a gradient's sign, so rounding sends parameters of almost no gradient another way.
STRAYED_SHARE, LOSS_TOLERANCE = 0.02, dict(rtol=2e-3, atol=1e-5)


@pytest.fixture
def device(backend) -> torch.device:
    return backend.device


@pytest.fixture
def options(backend) -> ops.RenderOptions:
    return replace(RENDER_OPTIONS, precision=backend.precision)


def assert_equal(one, other):
    assert all(torch.equal(a, b) for a, b in zip(one.state(), other.state(), strict=True))


def test_first_iteration_is_that_of_the_loop(device, options):
    whole, parts = Map(device), Map(device)
    losses, want = whole.optimize(options, iterations=1), parts.loop(options, iterations=1)
    assert losses.shape == (1, 5)
    torch.testing.assert_close(losses, want, **FIRST_TOLERANCE)
    for name, param in whole.params.items():
        torch.testing.assert_close(param, parts.params[name], **FIRST_TOLERANCE)
        for got, expected in zip(whole.moments[name][:2], parts.moments[name][:2], strict=True):
            torch.testing.assert_close(got, expected, **FIRST_TOLERANCE)
    for name in ("embeddings", "texels"):
        assert torch.equal(whole.moments[name][3], parts.moments[name][3])
        assert not whole.moments[name][2].any()


def test_further_iterations_follow_the_loop(device, options):
    whole, parts = Map(device), Map(device)
    losses, want = whole.optimize(options), parts.loop(options)
    torch.testing.assert_close(losses, want, **LOSS_TOLERANCE)
    for name, param in whole.params.items():
        strayed = (param - parts.params[name]).abs() > 0.5 * RATES[name]
        assert strayed.float().mean() <= STRAYED_SHARE, name
    assert torch.equal(whole.moments["embeddings"][3], parts.moments["embeddings"][3])


def test_more_samples_than_a_warp_holds(device, options):
    options = replace(options, num_uniform=70, num_surface=20)
    whole, parts = Map(device), Map(device)
    torch.testing.assert_close(whole.optimize(options, 2), parts.loop(options, 2), **LOSS_TOLERANCE)
    assert not any(whole.moments[name][2].any() for name in ("embeddings", "texels"))


def test_the_loss_falls(device, options):
    losses = Map(device).optimize(options, iterations=40)[:, 0]
    assert losses[-5:].mean() < 0.7 * losses[:5].mean()


def test_calls_go_on_where_the_last_one_ended(device, options):
    """Two calls are one of as many iterations, with random numbers, steps, and stamps counted on."""
    once, twice = Map(device), Map(device)
    once.optimize(options, 4)
    twice.optimize(options, 3)
    twice.optimize(replace(options, iteration=3), 1, first_step=4, first_stamp=4)
    assert_equal(once, twice)


def test_colors_count_their_own_steps(device, options):
    """Moments of colors may be older: their bias is corrected by their own number of steps."""
    own, all_old, all_new = Map(device), Map(device), Map(device)
    own.optimize(options, 1, first_color_step=50)
    all_old.optimize(options, 1, first_step=50)
    all_new.optimize(options, 1)
    for name, param in own.params.items():
        same, other = (all_old, all_new) if name in ("texels", "color_params") else (all_new, all_old)
        assert torch.equal(param, same.params[name]), name
        assert not torch.equal(param, other.params[name]), name


@pytest.mark.parametrize(
    "frozen", [("embeddings", "geometry_params"), ("texels", "color_params"), ("poses",), ("geometry_params",)], ids=str
)
def test_what_is_frozen_stays(device, options, frozen):
    scene, before = Map(device), Map(device)
    scene.optimize(options, 2, frozen)
    for name, param in scene.params.items():
        assert torch.equal(param, before.params[name]) == (name in frozen), name


def test_the_fixed_frame_and_others_stay(device, options):
    scene, before = Map(device), Map(device)
    scene.optimize(options)
    moved = (scene.poses != before.poses).any(1)
    assert moved.tolist() == [True, False, False, True, True]  # 1 is fixed, 2 is not among the frames
    torch.testing.assert_close(scene.poses[:, :4].norm(dim=1), torch.ones(5, device=device))


def test_frames_may_lie_on_the_device(device, options):
    here, there = Map(device), Map(device)
    there.frames = there.frames.to(device)
    here.optimize(options, 2)
    there.optimize(options, 2)
    assert_equal(here, there)


def test_same_bits_from_run_to_run(device, options):
    runs = [Map(device) for _ in range(3)]
    losses = [run.optimize(options) for run in runs]
    for run, loss in zip(runs[1:], losses[1:], strict=True):
        assert torch.equal(loss, losses[0])
        assert_equal(run, runs[0])


def test_without_color_texels_stay(device, options):
    scene, before = Map(device), Map(device)
    losses = scene.optimize(replace(options, weight_rgb=0.0), 2)
    assert not losses[:, 1].any()
    assert torch.equal(scene.scene.texels, before.scene.texels)


def test_a_graph_gives_the_same_and_survives_growth(device, options):
    graph = ops.LaunchGraph()
    for seed in range(3):
        with_graph, without = Map(device, seed, spare_rows=50 * seed), Map(device, seed)
        without.optimize(options)
        losses = with_graph.optimize(options, graph=graph)
        del losses  # its memory may be another call's output
        assert all(torch.equal(p, without.params[name]) for name, p in with_graph.params.items())
    assert graph.builds == (1 if device.type == "cuda" else 0)
    Map(device).optimize(options, 2, graph=graph)
    assert graph.builds == (2 if device.type == "cuda" else 0)


@pytest.mark.cuda
def test_on_a_side_stream(options):
    if options.precision != "tf32":
        pytest.skip("streams do not depend on the precision")
    device, graph = torch.device("cuda"), ops.LaunchGraph()
    want, runs = Map(device), [Map(device) for _ in range(2)]
    want.optimize(options)
    streams = [torch.cuda.Stream() for _ in runs]
    torch.cuda.synchronize()
    for run, stream in zip(runs, streams, strict=True):
        with torch.cuda.stream(stream):
            run.optimize(options, graph=graph)
    torch.cuda.synchronize()
    for run in runs:
        assert_equal(run, want)


def test_same_bits_for_any_number_of_threads():
    def optimized():
        mapped = Map(torch.device("cpu"))
        mapped.optimize(RENDER_OPTIONS, 2)
        return mapped

    assert_equal(*with_threads(optimized, (1, 3)))


def test_opcheck(device, options):
    m = Map(device)
    args = (*m.scene.arguments(), m.records, m.poses, m.frames, *options.arguments(INTRINSICS))
    args += (*m.map_moments().arguments(), [3, 20, 1, 0, 1, 1, 1, 0], m.poses.new_empty(1, 5))
    utilities = ("test_schema", "test_faketensor")
    torch.library.opcheck(torch.ops.spslam.optimize_map_, args, test_utils=utilities)
