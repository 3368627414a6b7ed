"""The fused step, against the same composed in float64, and its promises: determinism and frozen parts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam import ops
from spslam.geometry import matrix_to_pose7, quaternion_to_matrix
from tests.ops.scenes import INTRINSICS, OPTIONS, POSES, make_scene
from tests.ops.step_inputs import gradient_buffers, noisy_rays
from tests.ops.threads import assert_same_for_any_threads
from tests.reference.render_step import PARAMETERS, render_step

GRADIENTS = dict(
    zip(("poses", *PARAMETERS), ("grad_poses", "embeddings", "grad_geometry", "texels", "grad_color"), strict=True)
)
# Float32 sums of some thousand terms against float64.
LOSS_TOLERANCE = dict(rtol=2e-5, atol=1e-7)
# The same on matrix units: products of 11-bit factors, through two hidden layers.
TF32_LOSS_TOLERANCE = dict(rtol=2e-3, atol=1e-5)
# Of gradients, as a share of the largest element: float32 sums of some thousand terms with cancellation.
ELEMENT_TOLERANCE = 1e-3
# The step on CUDA adds in another order than the reference, so a hidden unit, cell face or threshold within rounding of
# a sample may fall on the other side: one sample in some draws, which is 1.5 % of an element. As shares of the largest
# element and of the norm.
CUDA_ELEMENT_TOLERANCE, CUDA_NORM_TOLERANCE = 0.03, 0.02
# In tf32 a random decoder has many hidden units within rounding of zero, each of which may pass or not. The reference
# with its products rounded so strays from itself by as much: 0.30 and 0.07. Where the decoder is the scene's own the
# tolerance above holds.
TF32_ELEMENT_TOLERANCE, TF32_NORM_TOLERANCE = 0.35, 0.1


@pytest.fixture
def device(backend) -> torch.device:
    return backend.device


@pytest.fixture
def options(backend) -> ops.RenderOptions:
    return replace(OPTIONS, precision=backend.precision)


def _step(scene, rays, options, gradients=None):
    """Losses and all gradients by the reference's names."""
    step = ops.render_step(scene, rays, options, gradients)
    found = {name: getattr(step, field, None) for name, field in GRADIENTS.items()}
    if gradients is not None:
        found |= {"embeddings": gradients.embeddings, "texels": gradients.texels}
    return step.losses, found


def _loss_tolerance(options):
    return TF32_LOSS_TOLERANCE if options.precision == "tf32" else LOSS_TOLERANCE


def _assert_close(got, want, rough=False):
    error = (got.cpu().double() - want).abs()
    if got.device.type == "cpu":
        assert error.max() <= ELEMENT_TOLERANCE * want.abs().max()
    elif rough:
        assert error.max() <= TF32_ELEMENT_TOLERANCE * want.abs().max()
        assert error.norm() <= TF32_NORM_TOLERANCE * want.norm()
    else:
        assert error.max() <= CUDA_ELEMENT_TOLERANCE * want.abs().max()
        assert error.norm() <= CUDA_NORM_TOLERANCE * want.norm()


@pytest.mark.parametrize(
    "change",
    [
        {},
        dict(cosine_targets=False),
        dict(weight_rgb=0.0),
        dict(weight_free_space=0.0, weight_sdf=0.0),
        dict(weight_rgb=0.0, weight_depth=0.0, weight_sdf=0.0),
        dict(num_uniform=0),
        dict(num_surface=0, num_uniform=70),
        dict(truncation=0.05, near=0.5, far=1.2),
    ],
    ids=str,
)
def test_losses_and_gradients_are_those_of_the_composition(device, options, generator, change):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays, options = noisy_rays(generator, device=device), replace(options, **change)
    want_losses, want = render_step(scene, rays, options)
    if options.weight_rgb == 0:
        want_losses[1] = 0  # color is not evaluated
    losses, got = _step(scene, rays, options, gradient_buffers(scene))
    torch.testing.assert_close(losses.cpu().double(), want_losses, **_loss_tolerance(options))
    for name in want:
        _assert_close(got[name], want[name], rough=options.precision == "tf32")


def test_many_rays(device, options, generator):
    """More than are under way at once, on CUDA several to a warp; against the CPU, which the reference vouches for."""
    scene = make_scene(generator, random_decoder=False, device=device)
    rays = noisy_rays(generator, counts=(2600, 1900, 41), device=device)
    losses, got = _step(scene, rays, options, gradient_buffers(scene))
    cpu_rays = replace(rays, **{name: getattr(rays, name).cpu() for name in ("pixels", "ray_frames", "poses")})
    cpu_scene = make_scene(torch.Generator().manual_seed(0), random_decoder=False)
    want_losses, want = _step(cpu_scene, cpu_rays, options, gradient_buffers(cpu_scene))
    torch.testing.assert_close(losses.cpu(), want_losses, **_loss_tolerance(options))
    for name in want:
        _assert_close(got[name], want[name].double())


def test_where_the_scene_means_something(device, options, generator):
    """The corner's own SDF: surfaces are crossed once, so the rendering terms and the mask matter."""
    scene = make_scene(generator, random_decoder=False, device=device)
    rays = noisy_rays(generator, device=device)
    want_losses, want = render_step(scene, rays, options)
    losses, got = _step(scene, rays, options, gradient_buffers(scene))
    torch.testing.assert_close(losses.cpu().double(), want_losses, **_loss_tolerance(options))
    assert losses[1:].min() > 0
    for name in want:
        _assert_close(got[name], want[name])


def test_pose_gradient_is_the_slope_of_the_loss(device, options, generator):
    """Central differences of the op itself, all samples well inside the volume: the loss jumps where one leaves it.

    In float32: to tf32 the differences of this step are below the rounding.
    """
    scene = make_scene(generator, random_decoder=True, device=device)
    rays = noisy_rays(generator, counts=(400,), device=device)
    sharp = dict(num_uniform=0, truncation=0.03, weight_rgb=0.0, weight_depth=0.0)
    options = replace(options, precision="fp32", **sharp)
    gradient = ops.render_step(scene, rays, options).grad_poses[0].cpu()
    start, step, slopes = POSES[0], 1e-4, []
    for axis in range(6):
        totals = []
        for sign in (1, -1):
            increment = np.zeros(6)
            increment[axis] = sign * step
            moved = start.copy()
            turn = quaternion_to_matrix(np.concatenate([[1.0], increment[3:] / 2]))
            moved[:3, :3] = turn @ start[:3, :3]
            moved[:3, 3] += increment[:3]
            poses = torch.from_numpy(matrix_to_pose7(moved))[None].float().to(device)
            totals.append(float(ops.render_step(scene, replace(rays, poses=poses), options).losses[0]))
        slopes.append((totals[0] - totals[1]) / (2 * step))
    # Over a step samples cross cells' faces, where the slope of the interpolation changes.
    torch.testing.assert_close(torch.tensor(slopes), gradient, rtol=0, atol=0.01 * float(gradient.norm()))


def test_tracking_leaves_the_scene_and_gives_the_same_pose_gradient(device, options, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays = noisy_rays(generator, device=device)
    losses, with_scene = _step(scene, rays, options, gradient_buffers(scene))
    tracking = ops.render_step(scene, rays, options)
    assert tracking.grad_geometry is None and tracking.grad_color is None
    assert torch.equal(tracking.losses, losses)
    assert torch.equal(tracking.grad_poses, with_scene["poses"])


def test_frozen_geometry_still_teaches_color(device, options, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays, everything, color = noisy_rays(generator, device=device), gradient_buffers(scene), gradient_buffers(scene)
    full = ops.render_step(scene, rays, options, everything)
    color = replace(color, embeddings=None, embedding_stamps=None)
    step = ops.render_step(scene, rays, replace(options, pose_gradient=False), color)
    assert step.grad_poses is None and step.grad_geometry is None
    assert torch.equal(step.losses, full.losses) and torch.equal(step.grad_color, full.grad_color)
    assert torch.equal(color.texels, everything.texels)


def test_stamps_mark_the_rows_that_rays_reach(device, options, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    gradients = gradient_buffers(scene, stamp=9, spare_rows=5)
    ops.render_step(scene, noisy_rays(generator, device=device), options, gradients)
    for table, stamps in (
        (gradients.embeddings, gradients.embedding_stamps),
        (gradients.texels, gradients.texel_stamps),
    ):
        assert set(stamps.unique().tolist()) == {0, 9}
        assert not table[stamps != 9].any() and not stamps[-5:].any()
        assert (table[stamps == 9].abs().sum(1) > 0).float().mean() > 0.5


def test_gradients_of_tables_are_added(device, options, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays, once, twice = noisy_rays(generator, device=device), gradient_buffers(scene), gradient_buffers(scene)
    ops.render_step(scene, rays, options, once)
    for _ in range(2):
        ops.render_step(scene, rays, options, twice)
    torch.testing.assert_close(twice.embeddings, 2 * once.embeddings, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(twice.texels, 2 * once.texels, rtol=1e-4, atol=1e-5)


def test_same_bits_for_any_number_of_threads(generator):
    scene = make_scene(generator, random_decoder=True)
    rays = noisy_rays(generator, counts=(1500, 900, 41))

    def step():
        gradients = gradient_buffers(scene)
        losses, found = _step(scene, rays, OPTIONS, gradients)
        return [losses, *found.values(), gradients.embedding_stamps, gradients.texel_stamps]

    assert_same_for_any_threads(step)


def test_same_bits_from_run_to_run(device, options, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays = noisy_rays(generator, device=device)
    results = []
    for _ in range(3):
        losses, found = _step(scene, rays, options, gradient_buffers(scene))
        results.append([losses, *found.values()])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_no_rays(device, options, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays = noisy_rays(generator, device=device)
    none = replace(rays, pixels=rays.pixels[:0], ray_frames=rays.ray_frames[:0])
    losses, found = _step(scene, none, options, gradient_buffers(scene))
    assert not losses.any() and not any(g.any() for g in found.values())


def test_rays_without_depth_add_nothing_but_count(device, options, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays = noisy_rays(generator, counts=(64,), device=device)
    blind = rays.pixels.clone()
    blind[:, 1] = 0
    padded = replace(rays, pixels=torch.cat([rays.pixels, blind]), ray_frames=torch.cat([rays.ray_frames] * 2))
    want, got = ops.render_step(scene, rays, options), ops.render_step(scene, padded, options)
    torch.testing.assert_close(got.losses, want.losses / 2)
    torch.testing.assert_close(got.grad_poses, want.grad_poses / 2, rtol=1e-4, atol=1e-4)


def test_a_call_on_poses_that_are_none_leaves_no_trace(device, options, generator):
    """A ray without depth has no direction; one kept from the call before would make 0 * nan of its gradient."""
    scene = make_scene(generator, random_decoder=True, device=device)
    rays = noisy_rays(generator, counts=(64,), device=device)
    want = ops.render_step(scene, rays, options)
    ops.render_step(scene, replace(rays, poses=torch.full_like(rays.poses, torch.nan)), options)
    got = ops.render_step(scene, rays, options)
    assert torch.equal(got.losses, want.losses) and torch.equal(got.grad_poses, want.grad_poses)


def test_outside_the_map(device, options, generator):
    """Every sample is free space of SDF 1: only the mask of the terms is left, which is nothing."""
    scene = make_scene(generator, random_decoder=True, device=device)
    rays = noisy_rays(generator, device=device)
    far = rays.poses.clone()
    far[:, 4:] += 1e6
    losses, found = _step(scene, replace(rays, poses=far), options, gradient_buffers(scene))
    assert not losses.any() and not any(g.any() for g in found.values())


def test_no_planes(device, options, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    bare = replace(scene, texels=scene.texels[:0], plane_layout=[0] * 15)
    rays = noisy_rays(generator, device=device)
    step = ops.render_step(bare, rays, options, gradient_buffers(bare))
    dark = ops.render_step(replace(scene, texels=torch.zeros_like(scene.texels)), rays, options)
    torch.testing.assert_close(step.losses, dark.losses)
    torch.testing.assert_close(step.grad_poses, dark.grad_poses)


def test_opcheck(device, generator):
    scene = make_scene(generator, random_decoder=True, device=device)
    rays, g = noisy_rays(generator, device=device), gradient_buffers(scene)
    new = rays.poses.new_empty
    args = ([rays.pixels, rays.ray_frames, rays.poses], *OPTIONS.arguments(INTRINSICS), 3, new(5), new(3, 6))
    args += ([new(1473), g.embeddings, g.embedding_stamps], [new(2211), g.texels, g.texel_stamps])
    torch.library.opcheck(torch.ops.spslam.render_step, (*scene.arguments(), *args))
