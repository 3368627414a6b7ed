"""The composed step equals the reference, so that a comparison of speed compares the same work."""

from dataclasses import replace

import pytest
import torch

from experiments.compose import OPS, TORCH, compose_render_step
from spslam import ops
from tests.ops.scenes import OPTIONS, make_scene
from tests.ops.step_inputs import gradient_buffers, noisy_rays
from tests.reference.render_step import render_step

# Both are float64; they differ in the rounding of 1 / cell size, once.
TOLERANCE = 1e-9


def _double(gradients):
    return replace(gradients, embeddings=gradients.embeddings.double(), texels=gradients.texels.double())


@pytest.mark.parametrize("parts", [OPS, TORCH])
@pytest.mark.parametrize("compact", [False, True])
@pytest.mark.parametrize(
    "change",
    [
        {},
        *(
            pytest.param(change, marks=pytest.mark.slow)
            for change in (dict(cosine_targets=False), dict(weight_rgb=0.0))
        ),
    ],
    ids=str,
)
def test_equals_the_reference(parts, compact, change, device, generator):
    scene, rays = make_scene(generator, random_decoder=True, device=device), noisy_rays(generator, device=device)
    options = replace(OPTIONS, **change)
    want_losses, want = render_step(scene, rays, options)
    want_losses[1] *= options.weight_rgb > 0
    gradients = _double(gradient_buffers(scene))
    step = compose_render_step(scene, rays, options, gradients, parts, compact, torch.float64)
    torch.testing.assert_close(step.losses.cpu(), want_losses, rtol=TOLERANCE, atol=TOLERANCE)
    got = dict(
        poses=step.grad_poses,
        embeddings=gradients.embeddings,
        geometry_params=step.grad_geometry,
        texels=gradients.texels,
        color_params=step.grad_color,
    )
    for name, gradient in got.items():
        scale = max(1.0, want[name].abs().max().item())
        torch.testing.assert_close(gradient.cpu(), want[name], rtol=TOLERANCE, atol=TOLERANCE * scale)
    for table, stamps in (
        (gradients.embeddings, gradients.embedding_stamps),
        (gradients.texels, gradients.texel_stamps),
    ):
        assert torch.equal(stamps == gradients.stamp, (table != 0).any(1))


@pytest.mark.parametrize("parts", [OPS, TORCH])
def test_frozen_parts_get_no_gradient(parts, device, generator):
    scene, rays = make_scene(generator, random_decoder=True, device=device), noisy_rays(generator, device=device)
    tracking = compose_render_step(scene, rays, OPTIONS, None, parts)
    assert tracking.grad_geometry is None and tracking.grad_color is None
    fused = ops.render_step(scene, rays, replace(OPTIONS, precision="fp32"))
    torch.testing.assert_close(tracking.losses, fused.losses, rtol=1e-4, atol=1e-6)
    mapping = compose_render_step(
        scene, rays, replace(OPTIONS, pose_gradient=False), replace(gradient_buffers(scene), embeddings=None), parts
    )
    assert mapping.grad_poses is None and mapping.grad_geometry is None and mapping.grad_color is not None


def test_no_rays(device, generator):
    scene, rays = make_scene(generator, random_decoder=True, device=device), noisy_rays(generator, device=device)
    none = replace(rays, pixels=rays.pixels[:0], ray_frames=rays.ray_frames[:0])
    assert not compose_render_step(scene, none, OPTIONS, gradient_buffers(scene), OPS).losses.any()
