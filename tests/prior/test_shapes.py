"""Random solids: compositions against brute force, surface near the origin, and reproducibility."""

import pytest
import torch

from spslam.prior.shapes import HELD_OUT_KINDS, TRAINING_KINDS, Composition, nearest_surface, random_solid
from tests.prior import surfaces

KINDS = TRAINING_KINDS + HELD_OUT_KINDS
# Without compositions: gradient steps in their distance end in creases, where normals are undefined.
PRIMITIVES = [kind for kind in KINDS if "_on_" not in kind and "cut" not in kind]
# Coordinates of up to 60 voxels in float32.
ROUNDING = 2e-4


@pytest.mark.parametrize("kind", KINDS)
def test_surface_passes_near_the_origin(kind, generator):
    solid = random_solid(kind, 32, generator)
    reach = 6.0 if isinstance(solid, Composition) else 1e-2
    assert solid.signed_distance(torch.zeros(32, 1, 3)).abs().max() < reach


@pytest.mark.parametrize("kind", KINDS)
def test_distance_is_lipschitz_continuous(kind, generator):
    solid = random_solid(kind, 16, generator)
    center = nearest_surface(solid, torch.randn(16, 1, 3, generator=generator))
    here, there = (center + 2 * torch.rand(16, 200, 3, generator=generator) - 1 for _ in range(2))
    change = (solid.signed_distance(here) - solid.signed_distance(there)).abs()
    share = (change <= (here - there).norm(dim=-1) + ROUNDING).float().mean()
    assert share > (0.99 if kind == "superquadric" else 0.9999)


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_normals_are_unit_gradients(kind, generator):
    solid = random_solid(kind, 16, generator)
    surface = nearest_surface(solid, torch.randn(16, 20, 3, generator=generator))
    normals = solid.normals(surface)
    assert torch.allclose(normals.norm(dim=-1), torch.ones(16, 20), atol=1e-5)
    outside = solid.signed_distance(surface + 0.05 * normals)
    assert (outside > 0.04).float().mean() > 0.95


@pytest.mark.parametrize("operation", ["union", "intersection"])
def test_composition_is_a_lower_bound_and_exact_if_the_foot_point_is_on_the_surface(operation, generator):
    parts = [random_solid("box", 1, generator), random_solid("plane", 1, generator)]
    solid = Composition(parts[0], parts[1], operation)
    samples = torch.cat([_samples(part) for part in parts])
    samples = samples[solid.signed_distance(samples[None].float())[0].abs() < 1e-3].double()
    points = 4 * torch.rand(1, 1000, 3, generator=generator) - 2
    actual, normals = solid.signed_distance(points)[0], solid.normals(points)[0]
    expected = surfaces.nearest_distance(points[0].double(), samples)
    spacing = 0.2
    assert (actual.abs() <= expected + spacing).all()
    foot = points[0] - actual[:, None] * normals
    exact = solid.signed_distance(foot[None])[0].abs() < 0.02
    assert exact.float().mean() > 0.3
    assert ((expected - actual.abs())[exact] < spacing).all()


def _samples(part):
    """Points of the surface of a primitive in the patch frame, from its parametric form."""
    half_size = part.parameters.get("half_size")
    own = surfaces.plane(8.0) if half_size is None else surfaces.box(half_size[0].tolist())
    return (own - part.anchor.double()) @ part.rotation[0].T.double() + part.position.double()


def test_concave_solids_are_hollow(generator):
    rooms = random_solid("room", 8, generator)
    assert (rooms.orientation == -1).all()
    centers = rooms.position - (rooms.anchor[:, None] @ rooms.rotation.transpose(1, 2))[:, 0]
    assert (rooms.signed_distance(centers[:, None]) > 0).all()


def test_rotations_are_proper(generator):
    rotation = random_solid("plane", 100, generator).rotation
    assert torch.allclose(rotation @ rotation.transpose(1, 2), torch.eye(3).expand(100, 3, 3), atol=1e-5)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(100), atol=1e-5)


def test_same_generator_state_gives_the_same_solids():
    first, second = (
        random_solid("box_on_plane", 4, torch.Generator().manual_seed(3)).signed_distance(torch.ones(4, 5, 3))
        for _ in range(2)
    )
    assert torch.equal(first, second)


def test_unknown_kind_is_named(generator):
    with pytest.raises(ValueError, match="random_solid: kind must be one of plane, .*, got cone"):
        random_solid("cone", 1, generator)
