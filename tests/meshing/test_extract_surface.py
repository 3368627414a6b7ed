"""Surfaces of analytic fields: accuracy, watertightness, and the number of samples."""

import numpy as np
import pytest
import torch
import trimesh

from spslam.errors import SpslamError
from spslam.meshing import cubes_per_cell, extract_surface
from tests.meshing import fields

CELL_M = 0.04
# Samples keep a margin of some 1e-5 block edges to block borders, and positions are a few meters in float32.
LINEAR_ERROR_M = 1e-5


def _mesh(vertices, faces):
    return trimesh.Trimesh(vertices.cpu().double().numpy(), faces.cpu().numpy(), process=False)


@pytest.mark.parametrize("resolution_m", [0.04, 0.02, 0.013, 0.01, 0.005])
def test_linear_field_is_exact(resolution_m, device):
    normal = (0.36, -0.48, 0.8)
    cells = fields.cells_within(5, device)
    vertices, faces = extract_surface(cells, CELL_M, resolution_m, fields.plane(normal, 0.0137))
    assert len(faces) > 100
    assert (vertices @ torch.tensor(normal, device=device) - 0.0137).abs().max() < LINEAR_ERROR_M
    mesh = _mesh(vertices, faces)
    np.testing.assert_allclose(mesh.face_normals @ normal, 1, atol=1e-3)
    # Watertight inside: only edges on the border of the cells have a single face.
    edges, uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    border = (np.abs(mesh.vertices) > 5 * CELL_M - 1e-4).any(1)
    assert (uses <= 2).all() and border[edges[uses == 1]].all()


def test_room_is_watertight_and_accurate(device):
    cells = fields.cells_near(fields.room, fields.ROOM_HALF_M, CELL_M, 0.09, device)
    vertices, faces = extract_surface(cells, CELL_M, 0.02, fields.room)
    mesh = _mesh(vertices, faces)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.body_count == 2
    distance = fields.room(vertices)[0].abs()
    # Marching cubes cut off the corners where walls meet.
    wall_distance = (torch.tensor(fields.ROOM_HALF_M, device=device) - vertices.abs()).sort(1).values
    assert distance[wall_distance[:, 1] > 0.04].max() < 1e-3
    assert distance.max() < 1e-2
    room_volume = 8 * np.prod(fields.ROOM_HALF_M)
    ball_volume = 4 / 3 * np.pi * fields.BALL_RADIUS_M**3
    # Free space is outside: the room has negative volume.
    assert mesh.volume == pytest.approx(ball_volume - room_volume, rel=3e-3)


@pytest.mark.parametrize("cell_m,resolution_m", [(0.04, 0.01), (0.04, 0.04), (0.1, 0.01), (0.03, 0.002)])
def test_sphere_is_watertight_and_round(cell_m, resolution_m, device):
    cells = fields.cells_within(int(0.12 / cell_m) + 1, device)
    vertices, faces = extract_surface(cells, cell_m, resolution_m, fields.sphere(0.1))
    mesh = _mesh(vertices, faces)
    assert mesh.is_watertight and mesh.volume > 0
    # Sagitta of a chord at a radius of 10 cm.
    assert (vertices.norm(dim=1) - 0.1).abs().max() < resolution_m**2 / (4 * 0.1)


def test_surface_ends_where_the_field_is_unknown(device):
    def half_known(points):
        distance, _ = fields.sphere(0.1)(points)
        return distance, points[:, 0] < 0.0301

    vertices, faces = extract_surface(fields.cells_within(4, device), CELL_M, 0.01, half_known)
    whole, whole_faces = extract_surface(fields.cells_within(4, device), CELL_M, 0.01, fields.sphere(0.1))
    assert vertices[:, 0].max() <= 0.03 + 1e-5
    kept = (whole[whole_faces][:, :, 0] <= 0.03 + 1e-5).all(1)
    assert len(faces) == kept.sum()


def test_the_field_is_only_sampled_within_the_cells(device):
    cells = fields.cells_near(fields.sphere(0.3), (0.3, 0.3, 0.3), CELL_M, 0.05, device)
    allowed = set(map(tuple, cells.tolist()))

    def strict(points):
        sampled = torch.floor(points / CELL_M).int().unique(dim=0)
        assert set(map(tuple, sampled.tolist())) <= allowed
        return fields.sphere(0.3)(points)

    vertices, faces = extract_surface(cells, CELL_M, 0.01, strict)
    assert _mesh(vertices, faces).is_watertight


def test_surface_far_from_the_origin_is_watertight(device):
    # 400 m away float32 resolves 0.03 mm.
    cells = fields.cells_within(4, device)
    shift = torch.tensor([10_000, -10_000, 0], dtype=torch.int32, device=device)
    allowed = set(map(tuple, (cells + shift).tolist()))

    def moved(points):
        assert set(map(tuple, torch.floor(points / CELL_M).int().unique(dim=0).tolist())) <= allowed
        return fields.sphere(0.1)(points - shift * CELL_M)

    vertices, faces = extract_surface(cells + shift, CELL_M, 0.01, moved)
    assert _mesh(vertices, faces).is_watertight


def test_sample_count_scales_with_the_surface(device):
    calls = []

    def counted(points):
        calls.append(len(points))
        return fields.sphere(0.2)(points)

    cells = fields.cells_within(20, device)
    _, faces = extract_surface(cells, CELL_M, 0.005, counted, chunk_points=50_000)
    assert max(calls) <= 50_000
    dense = len(cells) * 8**3
    assert sum(calls) < dense / 10


def test_a_thin_wall_is_found(device):
    # A thin wall: negative only within 1.5 mm of x = 0.0163.
    def wall(points):
        return fields.plane((1.0, 0.0, 0.0), 0.0163)(points)[0].abs() - 0.0015, points[:, 0] == points[:, 0]

    _, faces = extract_surface(fields.cells_within(2, device), CELL_M, 0.001, wall)
    assert len(faces) > 0


def test_result_does_not_depend_on_the_chunk_size(device):
    cells = fields.cells_within(4, device)
    whole = extract_surface(cells, CELL_M, 0.005, fields.sphere(0.1))
    pieces = extract_surface(cells, CELL_M, 0.005, fields.sphere(0.1), chunk_points=1000)
    assert torch.equal(whole[0], pieces[0]) and torch.equal(whole[1], pieces[1])


@pytest.mark.parametrize("cells", [0, 8])
def test_no_cells_and_no_surface(cells, device):
    coords = fields.cells_within(1, device)[:cells]
    vertices, faces = extract_surface(coords, CELL_M, 0.01, fields.sphere(5.0))
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)


@pytest.mark.parametrize(
    "resolution_m,expected",
    [(0.05, (1, 1)), (0.01, (1, 4)), (0.0058, (1, 7)), (0.005, (2, 4)), (0.0044, (2, 5)), (0.002, (5, 4))],
)
def test_cubes_per_cell(resolution_m, expected):
    assert cubes_per_cell(CELL_M, resolution_m) == expected


def test_cubes_per_cell_are_at_most_an_eighth_more_than_desired():
    for cubes in range(1, 200):
        blocks, per_block = cubes_per_cell(1.0, 1.0 / cubes)
        assert cubes <= blocks * per_block <= cubes * 9 / 8 + 1e-9
        assert per_block <= 7 and (blocks == 1 or per_block >= 4)


@pytest.mark.parametrize(
    "changes,message",
    [
        (dict(cell_size_m=0.0), r"cell_size_m must be positive, got 0\.0"),
        (dict(resolution_m=-0.01), r"resolution_m must be positive, got -0\.01"),
        (dict(max_slope=float("nan")), "max_slope must be positive, got nan"),
        (dict(chunk_points=0), "chunk_points must be at least 1, got 0"),
        (dict(cell_coords=torch.zeros(2, 3)), r"cell_coords must be int32 \[M, 3\], got torch.float32 \[2, 3\]"),
        (dict(cell_coords=torch.zeros(2, 2).int()), r"cell_coords must be int32 \[M, 3\], got torch.int32 \[2, 2\]"),
    ],
)
def test_errors(changes, message):
    arguments = dict(cell_coords=fields.cells_within(1), cell_size_m=CELL_M, resolution_m=0.01, sdf=fields.sphere(0.03))
    with pytest.raises(ValueError, match="^extract_surface: " + message):
        extract_surface(**{**arguments, **changes})


@pytest.mark.parametrize("cell_size_m,resolution_m", [(1e6, 0.01), (1000.0, 0.02), (0.04, 1e-6)])
def test_a_surface_of_more_samples_than_any_building_has_is_refused(cell_size_m, resolution_m):
    """A map whose voxel size was changed would take gigabytes."""
    for cells in (fields.cells_within(2), fields.cells_within(2)[:0]):
        with pytest.raises(SpslamError, match="needs too much memory: the smallest that fits is about .* m"):
            extract_surface(cells, cell_size_m, resolution_m, fields.sphere(0.05))
