"""Simulated observations of the solids."""

from dataclasses import replace

import pytest
import torch

from spslam.prior.patches import Patches, PatchSettings, observe
from spslam.prior.shapes import HELD_OUT_KINDS, TRAINING_KINDS

KINDS = TRAINING_KINDS + HELD_OUT_KINDS
ON_SURFACE = 0.02
CLEAN = PatchSettings(noise=0.0, max_normal_jitter=0.0, max_normal_blur=0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_clean_points_are_the_traced_surface(kind, generator):
    patches = observe(kind, 32, generator, CLEAN)
    assert patches.seen.any() and patches.valid.any()
    assert torch.equal(patches.points[patches.seen], patches.surface[patches.seen])
    assert torch.allclose(patches.normals[patches.seen], patches.surface_normals[patches.seen], atol=1e-6)
    facing = (patches.surface_normals * patches.view).sum(-1)
    assert (facing[patches.seen] < 0).all()


def test_traced_points_lie_on_the_solid(generator, monkeypatch):
    """Evaluates the distance of the solid that `observe` draws."""
    from spslam.prior import patches as patches_module

    kept = []
    monkeypatch.setattr(
        patches_module,
        "_at_origin",
        lambda *a, inner=patches_module._at_origin: kept.append(inner(*a)) or kept[-1],
    )
    for kind in KINDS:
        patches = observe(kind, 16, generator, CLEAN)
        assert kept[-1].signed_distance(patches.surface)[patches.seen].abs().max() < ON_SURFACE
        distance = kept[-1].signed_distance(patches.queries).clamp(-2, 2) / 2
        assert torch.allclose(distance[patches.valid], patches.sdf[patches.valid], atol=1e-4)


# Tracing that sheet takes ten times as long as any other surface.
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow) if kind == "wavy_sheet" else kind for kind in KINDS]
)
def test_values_are_finite_within_reach(kind, generator):
    patches = observe(kind, 64, generator, PatchSettings())
    for value in (patches.points, patches.normals, patches.queries, patches.sdf[patches.valid]):
        assert value.isfinite().all()
    assert patches.points.abs().max() < 6
    assert patches.sdf[patches.valid].abs().max() <= 1
    assert (patches.points[~patches.seen] == 0).all()
    assert (patches.normals[~patches.seen] == 0).all()


def test_noise_is_along_the_view_direction(generator):
    patches = observe("plane", 64, generator, PatchSettings(noise=0.1))
    error = (patches.points - patches.surface)[patches.seen]
    view = patches.view.expand_as(patches.surface)[patches.seen]
    along = (error * view).sum(-1)
    assert torch.allclose(error, along[:, None] * view, atol=1e-5)
    assert along.std() == pytest.approx(0.1, rel=0.05)
    assert along.mean().abs() < 0.005


def test_normals_are_unit_and_noisy(generator):
    patches = observe("plane", 64, generator, PatchSettings())
    normals, exact = patches.normals[patches.seen], patches.surface_normals[patches.seen]
    assert torch.allclose(normals.norm(dim=-1), torch.ones(len(normals)), atol=1e-5)
    angle = (normals * exact).sum(-1).clamp(-1, 1).arccos()
    assert 0.02 < angle.median() < 0.3


def test_points_are_dropped_and_have_holes(generator):
    patches = observe("plane", 200, generator, PatchSettings())
    share = patches.seen.float().mean(1)
    assert share.min() < 0.25 < 0.6 < share.max()


def test_sign_of_queries_agrees_with_the_view(generator):
    patches = observe("slab", 64, generator, PatchSettings())
    behind = ((patches.queries - patches.surface) * patches.view).sum(-1)[patches.valid]
    sdf = patches.sdf[patches.valid]
    assert ((sdf < 0) == (behind > 0))[behind.abs() > 0.05].all()


def test_queries_do_not_go_beyond_the_middle_of_a_slab(generator):
    """Half the thickness is at most 1.5 voxels; queries deeper than that are nearest to the far side."""
    patches = observe("slab", 64, generator, PatchSettings())
    assert 2 * patches.sdf[patches.valid].min() > -1.5 - ON_SURFACE


def test_patches_depend_on_the_given_generator_only():
    before = torch.get_rng_state()
    first, second = (observe("cut_sphere", 8, torch.Generator().manual_seed(5), PatchSettings()) for _ in range(2))
    assert torch.equal(before, torch.get_rng_state())
    for name in vars(first):
        assert torch.equal(getattr(first, name), getattr(second, name))


def test_batches_are_concatenated_and_indexed(generator):
    first, second = (observe("sphere", 3, generator, PatchSettings()) for _ in range(2))
    both = Patches.cat([first, second])
    assert len(both) == 6
    assert torch.equal(both[3:].points, second.points)


def test_blurred_normals_change_gradually_at_an_edge():
    """Near an edge of a box, differences over a voxel use both faces. Points and distances do not change."""

    def observe_box(blur):
        return observe("box", 64, torch.Generator().manual_seed(2), replace(CLEAN, max_normal_blur=blur))

    sharp, blurred = observe_box(0.0), observe_box(1.0)
    for name in ("points", "seen", "sdf", "valid", "surface_normals"):
        assert torch.equal(getattr(sharp, name), getattr(blurred, name))
    cosine = (sharp.normals * blurred.normals).sum(-1)[sharp.seen]
    assert cosine.min() < 0.9
    assert cosine.median() > 0.999
    assert torch.allclose(blurred.normals[blurred.seen].norm(dim=-1), torch.ones(len(cosine)), atol=1e-5)
