"""A whole mapping call against a loop of its parts: `sample_indices`, `render_step`, `sparse_adam_`."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import matrix_to_pose7
from tests.ops.scenes import INTRINSICS, OPTIONS, POSES, corner_pixels, make_scene

RENDER_OPTIONS = replace(OPTIONS, seed=2**40 + 3, frame=5, iteration=0)
NUM_PIXELS, ITERATIONS, FIXED = 300, 4, 1
RATES = dict(embeddings=4e-3, texels=4e-3, geometry_params=1e-3, color_params=1e-3, poses=1e-3)
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


class Map:
    """A scene, the records and poses of five frames, and the moments of all, none of them shared with another."""

    def __init__(self, device, seed=0, spare_rows=3):
        generator = torch.Generator().manual_seed(seed)
        self.device = device
        self.scene = make_scene(generator, random_decoder=True, device=device)
        poses = [POSES[f % len(POSES)] for f in range(5)]
        self.records = torch.stack([corner_pixels(pose, generator, 250) for pose in poses]).to(device)
        self.poses = torch.from_numpy(np.stack([matrix_to_pose7(p) for p in poses])).float()
        self.poses[:, 4:] += 0.005 * torch.randn(5, 3, generator=generator)
        self.poses = self.poses.to(device)
        self.frames = torch.tensor([0, 1, 3, 4])
        self.params = dict(
            embeddings=self.scene.embeddings,
            texels=self.scene.texels,
            geometry_params=self.scene.geometry_params,
            color_params=self.scene.color_params,
            poses=self.poses,
        )
        self.moments = {name: self._moments(param, spare_rows) for name, param in self.params.items()}

    def _moments(self, param, spare_rows):
        rows = len(param) + (spare_rows if param.dim() > 1 else 0)
        first, second = (torch.zeros(rows, *param.shape[1:], device=self.device) for _ in range(2))
        return first, second, ops.new_gradient_sums(first), torch.zeros(rows, dtype=torch.int32, device=self.device)

    def state(self):
        """Everything that a call may change."""
        return [*self.params.values(), *[tensor for moments in self.moments.values() for tensor in moments]]

    def map_moments(self, frozen=()):
        made = {}
        for name, (first, second, gradients, stamps) in self.moments.items():
            if name in ("embeddings", "texels"):
                made[name] = ops.AdamTable(first, second, RATES[name], gradients, stamps)
            else:
                made[name] = ops.AdamMoments(first, second, RATES[name])
        return ops.MapMoments(**{name: None if name in frozen else m for name, m in made.items()})

    def optimize(self, options, iterations=ITERATIONS, frozen=(), **changes):
        arguments = dict(num_pixels=NUM_PIXELS, iterations=iterations, fixed_frame=FIXED, first_step=1, first_stamp=1)
        moments = self.map_moments(frozen)
        return ops.optimize_map_(
            self.scene,
            self.records,
            self.poses,
            self.frames,
            INTRINSICS,
            options,
            moments,
            **(arguments | changes),
        )

    def loop(self, options, iterations=ITERATIONS):
        """The same, part by part."""
        losses = [self._iterate(replace(options, iteration=options.iteration + i), i + 1) for i in range(iterations)]
        return torch.stack(losses)

    def _iterate(self, options, step):
        frames, device = self.frames.to(self.device), self.device
        slot = torch.arange(NUM_PIXELS) * len(frames) // NUM_PIXELS
        pixel_stream = ops.Stream.MAPPING_PIXELS
        per_frame = self.records.shape[1]
        draw = ops.sample_indices(
            options.seed, pixel_stream, options.frame, options.iteration, NUM_PIXELS, per_frame, device
        )
        rays = ops.RayBatch(
            self.records[frames[slot.to(device)], draw], slot.int().to(device), self.poses[frames], INTRINSICS
        )
        sums = {name: torch.zeros_like(self.params[name]) for name in ("embeddings", "texels")}
        stamps = {name: self.moments[name][3] for name in sums}
        gradients = ops.SceneGradients(sums["embeddings"], stamps["embeddings"], sums["texels"], stamps["texels"], step)
        result = ops.render_step(self.scene, rays, options, gradients)
        for name, gradient in sums.items():
            self._adam(name, gradient, step, stamps[name][: len(gradient)])
        self._adam("geometry_params", result.grad_geometry, step)
        self._adam("color_params", result.grad_color, step)
        self._step_poses(frames, result.grad_poses, step)
        return result.losses

    def _adam(self, name, gradient, step, stamps=None):
        rows = len(gradient)
        first, second = (moment[:rows] for moment in self.moments[name][:2])
        ops.sparse_adam_(self.params[name], gradient, first, second, stamps, step, lr=RATES[name], step=step)

    def _step_poses(self, frames, grad_poses, step):
        free = frames != FIXED
        rows, (w, x, y, z) = frames[free], self.poses[frames[free], :4].unbind(1)
        a, b, c = grad_poses[free, 3:].unbind(1)
        turn = [-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z, c * w + a * y - b * x]
        gradient = torch.zeros_like(self.poses)
        gradient[rows] = torch.cat([2 * torch.stack(turn, 1), grad_poses[free, :3]], 1)
        stamps = torch.zeros(len(self.poses), dtype=torch.int32, device=self.device)
        stamps[rows] = 1
        self._adam("poses", gradient, step, stamps)  # of stamp `step`: none unless it is 1
        if step != 1:
            stamps[rows] = step
            self._adam("poses", gradient, step, stamps)
        self.poses[rows, :4] /= self.poses[rows, :4].norm(dim=1, keepdim=True)


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


def test_without_colour_texels_stay(device, options):
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
    threads, runs = ops.get_num_threads(), []
    try:
        for count in (1, 3):
            ops.set_num_threads(count)
            runs.append(Map(torch.device("cpu")))
            runs[-1].optimize(RENDER_OPTIONS, 2)
    finally:
        ops.set_num_threads(threads)
    assert_equal(*runs)


def test_opcheck(device, options):
    m = Map(device)
    tensors = [moments.tensors() for moments in m.map_moments().all()]
    args = (*m.scene.arguments(), m.records, m.poses, m.frames, *options.arguments(INTRINSICS), 3, 20, 1, 0)
    args += (*tensors, list(RATES.values()), 1, 1, m.poses.new_empty(1, 5))
    utilities = ("test_schema", "test_faketensor")
    torch.library.opcheck(torch.ops.spslam.optimize_map_, args, test_utils=utilities)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(records=torch.zeros(5, 9, 3)), TypeError, "records must be int32, got float32"),
        (dict(records=torch.zeros(5, 0, 3).int()), ValueError, r"records must hold at least one pixel a frame"),
        (dict(poses=torch.zeros(4, 7)), ValueError, r"poses must have shape \[5, 7\], got \[4, 7\]"),
        (dict(poses=torch.zeros(7, 5).T), ValueError, r"poses must be contiguous, got strides \(1, 5\)"),
        (dict(frames=torch.zeros(0).long()), ValueError, "frames must name at least one frame, got 0"),
        (dict(frames=torch.tensor([0, 1]).int()), TypeError, "frames must be int64, got int32"),
        (dict(num_pixels=0), ValueError, "num_pixels must be at least 1, got 0"),
        (dict(iterations=0), ValueError, "iterations must be at least 1, got 0"),
        (dict(first_step=0), ValueError, "first_step must be at least 1, got 0"),
        (dict(first_stamp=2**31 - 1), ValueError, "first_stamp must fit 32 bits, got 2147483647"),
        (dict(truncation=0.0), ValueError, "truncation must be positive, got 0.0"),
        (dict(precision="fp8"), ValueError, "precision must be tf32 or fp32, got fp8"),
    ],
    ids=str,
)
def test_errors(change, error, message):
    m, options = Map(torch.device("cpu")), RENDER_OPTIONS
    fields = {name: value for name, value in change.items() if hasattr(RENDER_OPTIONS, name)}
    options = replace(RENDER_OPTIONS, **fields)
    for name in ("records", "poses", "frames"):
        setattr(m, name, change.get(name, getattr(m, name)))
    numbers = {n: v for n, v in change.items() if n not in fields and not isinstance(v, torch.Tensor)}
    with pytest.raises(error, match="^optimize_map_: " + message):
        m.optimize(options, **numbers)


def test_frames_out_of_range():
    m = Map(torch.device("cpu"))
    m.frames = torch.tensor([0, 5])
    with pytest.raises(RuntimeError, match=r"optimize_map_: frames must be in \[0, 5\), got 5"):
        m.optimize(RENDER_OPTIONS)


@pytest.mark.parametrize(
    ("field", "value", "error", "message"),
    [
        ("exp_avg", torch.zeros(3, 8), ValueError, "embeddings.exp_avg must have at least"),
        ("exp_avg_sq", torch.zeros(200000, 7), ValueError, "embeddings.exp_avg_sq must have shape"),
        ("gradients", torch.zeros(200000, 8).long(), TypeError, "embeddings.gradients must be float32, got int64"),
        ("stamps", torch.zeros(200000), TypeError, "embeddings.stamps must be int32, got float32"),
        ("rate", -1.0, ValueError, r"embeddings.rate must be at least 0, got -1\.0"),
    ],
    ids=str,
)
def test_moments_that_do_not_fit(field, value, error, message):
    m = Map(torch.device("cpu"))
    moments = m.map_moments()
    m.map_moments = lambda frozen: replace(moments, embeddings=replace(moments.embeddings, **{field: value}))
    with pytest.raises(error, match="^optimize_map_: " + message):
        m.optimize(RENDER_OPTIONS)
