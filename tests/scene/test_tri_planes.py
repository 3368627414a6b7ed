"""Growth of the planes: it keeps texels, and the result does not depend on the order of growth."""

import pytest
import torch

from spslam.scene.tri_planes import INITIAL_STD, TriPlanes

CELL = 0.2


def _points(*rows):
    return torch.tensor(rows, dtype=torch.float32)


def test_cover_contains_all_points(device):
    planes = TriPlanes(CELL, device=device)
    points = torch.rand(500, 3, device=device) * torch.tensor([4.0, 2.0, 3.0], device=device) - 1
    planes.cover(points)
    for plane, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        first, u, v, size_u, size_v = planes.layout[5 * plane : 5 * plane + 5]
        for axis, begin, size in ((a, u, size_u), (b, v, size_v)):
            cells = points[:, axis] / CELL
            assert begin <= float(cells.min()) and float(cells.max()) <= begin + size - 1
        assert first + size_u * size_v <= len(planes.texels)
    assert planes.cover(points) is None


def test_growth_keeps_existing_texels(device):
    planes = TriPlanes(CELL, device=device)
    points = (torch.rand(200, 3) * 2).to(device)
    planes.cover(points)
    planes.texels.uniform_()
    before, old_rows = planes.interpolate(points), planes.texels.clone()
    moved = planes.cover(_points([-5, 7, 3], [4, -6, -5]).to(device))
    assert torch.equal(planes.texels[moved], old_rows)
    # The new origin shifts positions by tens of texels, where float32 has a resolution of 4e-6.
    assert torch.allclose(planes.interpolate(points), before, atol=1e-4)


def test_initial_values_do_not_depend_on_the_order_of_growth(device):
    at_once, in_steps = TriPlanes(CELL, seed=5, device=device), TriPlanes(CELL, seed=5, device=device)
    at_once.cover(_points([-6, -6, -6], [6, 6, 6]).to(device))
    for reach in (1.0, 3.0, 5.7):
        in_steps.cover(_points([-reach] * 3, [reach] * 3).to(device))
    points = (torch.rand(300, 3) * 12 - 6).to(device)
    assert torch.allclose(at_once.interpolate(points), in_steps.interpolate(points), atol=1e-5)
    # Tolerance: five standard errors of 11,000 x 32 normal numbers.
    assert abs(float(at_once.texels.std()) - INITIAL_STD) < 7e-5 and abs(float(at_once.texels.mean())) < 9e-5


def test_seeds_give_different_texels():
    tables = []
    for seed in (1, 2):
        planes = TriPlanes(CELL, seed=seed)
        planes.cover(_points([0, 0, 0], [1, 1, 1]))
        tables.append(planes.texels)
    assert not torch.equal(*tables)


def test_points_that_are_not_finite_do_not_grow_the_planes():
    planes = TriPlanes(CELL)
    assert planes.cover(torch.full((3, 3), float("nan"))) is None
    assert planes.cover(torch.zeros(0, 3)) is None
    assert planes.interpolate(torch.zeros(4, 3)).abs().sum() == 0


def test_restore():
    planes, other = TriPlanes(CELL), TriPlanes(CELL)
    planes.cover(_points([0, 0, 0], [1, 1, 1]))
    other.restore(planes.texels, planes.layout)
    assert torch.equal(other.texels, planes.texels) and other.layout == planes.layout
    with pytest.raises(ValueError, match="TriPlanes.restore: texels must have the 768 rows of the layout, got 767"):
        other.restore(planes.texels[:-1], planes.layout)


def test_cell_size_is_checked():
    with pytest.raises(ValueError, match="TriPlanes: cell_size_m must be positive, got 0"):
        TriPlanes(0)
