"""Signed distances against brute force over densely sampled surfaces, and the eikonal property."""

import pytest
import torch

from spslam.prior import signed_distance as sd
from tests.prior import surfaces


def row(*values):
    return torch.tensor([values], dtype=torch.float64)


# kind: distance, surface samples, and a test whether points are inside
SOLIDS = {
    "plane": (sd.plane, surfaces.plane(), lambda p: p[:, 2] < 0),
    "sphere": (lambda p: sd.sphere(p, row(2.5)), surfaces.sphere(2.5), lambda p: p.norm(dim=1) < 2.5),
    "cylinder": (lambda p: sd.cylinder(p, row(1.8)), surfaces.cylinder(1.8), lambda p: p[:, :2].norm(dim=1) < 1.8),
    "box": (
        lambda p: sd.box(p, row(1.5, 2.0, 3.0)),
        surfaces.box((1.5, 2.0, 3.0)),
        lambda p: (p.abs() < row(1.5, 2.0, 3.0)).all(1),
    ),
    "slab": (
        lambda p: sd.box(p, row(3.0, 3.0, 0.5)),
        surfaces.box((3.0, 3.0, 0.5)),
        lambda p: (p.abs() < row(3.0, 3.0, 0.5)).all(1),
    ),
    "torus": (
        lambda p: sd.torus(p, row(2.5), row(0.9)),
        surfaces.torus(2.5, 0.9),
        lambda p: (p[:, :2].norm(dim=1) - 2.5) ** 2 + p[:, 2] ** 2 < 0.81,
    ),
    "superquadric": (
        lambda p: sd.superquadric(p, row(2.0, 3.0, 2.5), row(3.0)),
        surfaces.superquadric((2.0, 3.0, 2.5), 3.0),
        lambda p: ((p.abs() / row(2.0, 3.0, 2.5)) ** 3).sum(1) < 1,
    ),
    "wavy_sheet": (
        lambda p: sd.wavy_sheet(p, row(0.8), row(0.6)),
        surfaces.wavy_sheet(0.8, 0.6),
        lambda p: p[:, 2] < 0.8 * ((0.6 * p[:, 0]).sin() + (0.6 * p[:, 1]).sin()),
    ),
}
# Brute force overestimates by at most the spacing of the samples.
SPACING = 0.08
# Iterated foot points are accurate in the band used for training: outside, and inside away from the medial axis.
ITERATED, TOLERANCE, BAND, DEPTH = ("superquadric", "wavy_sheet"), 0.01, 2.0, 1.0


@pytest.fixture
def points(generator):
    return (5 * torch.rand(800, 3, generator=generator, dtype=torch.float64) - 2.5) * 1.4


@pytest.mark.parametrize("kind", SOLIDS)
def test_distance_equals_that_to_the_nearest_sample(kind, points):
    distance, samples, _ = SOLIDS[kind]
    actual = distance(points[None])[0]
    expected = surfaces.nearest_distance(points, samples)
    excess = expected - actual.abs()
    if kind in ITERATED:
        excess = excess[(expected < BAND) & (actual > -DEPTH)]
    assert excess.min() > (-TOLERANCE if kind in ITERATED else -1e-9)
    assert excess.max() < SPACING


@pytest.mark.parametrize("kind", SOLIDS)
def test_negative_inside(kind, points):
    distance, _, inside = SOLIDS[kind]
    assert torch.equal(distance(points[None])[0] < 0, inside(points))


@pytest.mark.parametrize("kind", SOLIDS)
def test_gradient_has_unit_length(kind, points):
    distance, _, _ = SOLIDS[kind]
    here = distance(points[None])[0]
    near = points[(here < BAND) & (here > -DEPTH)]
    step = 1e-5 * torch.eye(3, dtype=torch.float64)
    differences = [(distance((near + h)[None]) - distance((near - h)[None]))[0] / 2e-5 for h in step]
    length = torch.stack(differences).norm(dim=0)
    # Finite differences across the medial axis are shorter.
    share = ((length - 1).abs() < (TOLERANCE if kind in ITERATED else 1e-6)).double().mean()
    assert share > 0.99


@pytest.mark.parametrize("kind", SOLIDS)
def test_empty(kind):
    assert SOLIDS[kind][0](torch.zeros(1, 0, 3, dtype=torch.float64)).shape == (1, 0)
