"""Marching cubes against scikit-image, and against what digital topology says about the number of surfaces."""

import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage import measure

from spslam import ops
from tests.ops.threads import assert_same_for_any_threads

# A vertex is interpolated in float32 from values near 1, on edges of one sample step.
POSITION_TOLERANCE = 1e-4


def _cells(field: np.ndarray, n: int, device="cpu"):
    """Cuts a dense field, n * cells + 1 samples per axis, into cells that repeat the samples they share."""
    counts = [(size - 1) // n for size in field.shape]
    coords = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 3)
    i = coords[:, :, None] * n + np.arange(n + 1)
    values = field[i[:, 0, :, None, None], i[:, 1, None, :, None], i[:, 2, None, None, :]]
    return torch.from_numpy(coords.astype(np.int32)).to(device), torch.from_numpy(values.astype(np.float32)).to(device)


def _grid(size: int) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.linspace(-1, 1, size)] * 3, indexing="ij"), -1)


def _sphere(size: int) -> np.ndarray:
    return np.linalg.norm(_grid(size), axis=-1) - 0.73


def _torus(size: int) -> np.ndarray:
    p = _grid(size)
    return np.hypot(np.hypot(p[..., 0], p[..., 1]) - 0.6, p[..., 2]) - 0.23


def _mesh(vertices, faces, n) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices.cpu().double().numpy() * n, faces.cpu().numpy(), process=False)


def _noise(size: int, seed: int = 0) -> np.ndarray:
    """Every case next to every other, outside all around."""
    field = np.random.default_rng(seed).uniform(-1, 1, (size, size, size))
    field[[0, -1]] = field[:, [0, -1]] = field[:, :, [0, -1]] = 1
    return field.astype(np.float32)


def _edge_uses(mesh) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges, and how often each is used."""
    directed = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return np.unique(directed, axis=0, return_counts=True)


def _assert_closed_manifold(mesh):
    edges, uses = _edge_uses(mesh)
    assert (uses == 1).all()
    forward = set(map(tuple, edges))
    assert all((b, a) in forward for a, b in forward)


@pytest.mark.parametrize("shape", [_sphere, _torus])
@pytest.mark.parametrize("n", [1, 4, 8, 64])
def test_smooth_shapes_equal_scikit_image(shape, n, device):
    field = shape(65).astype(np.float32)
    mesh = _mesh(*ops.marching_cubes(*_cells(field, n, device)), n)
    vertices, faces, _, _ = measure.marching_cubes(field, 0.0)
    reference = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.vertices.shape == vertices.shape and mesh.faces.shape == faces.shape
    assert cKDTree(vertices).query(mesh.vertices)[0].max() < POSITION_TOLERANCE
    assert cKDTree(mesh.vertices).query(vertices)[0].max() < POSITION_TOLERANCE
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.euler_number == reference.euler_number
    # Cubes of four and more vertices are split along another diagonal.
    assert mesh.area == pytest.approx(reference.area, rel=1e-3)
    assert mesh.volume == pytest.approx(abs(reference.volume), rel=1e-3)


@pytest.mark.parametrize("n", [1, 3, 4])
def test_random_field_is_a_closed_manifold_with_the_right_number_of_surfaces(n, device):
    field = _noise(25)
    mesh = _mesh(*ops.marching_cubes(*_cells(field, n, device)), n)
    _assert_closed_manifold(mesh)
    inside = field < 0
    solids = ndimage.label(inside)[1]  # joined through faces only
    spaces = ndimage.label(~inside, ndimage.generate_binary_structure(3, 2))[1]  # and through edges
    assert mesh.body_count == solids + spaces - 1
    assert len(mesh.vertices) == sum((np.diff(inside, axis=a)).sum() for a in range(3))


def test_every_case_alone(device):
    cases = np.arange(256)
    corner = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1) @ [1, 2, 4]
    inside = (cases[:, None, None, None] >> corner) & 1
    coords = torch.from_numpy(np.stack([2 * cases, 0 * cases, 0 * cases], 1).astype(np.int32)).to(device)
    values = torch.from_numpy((1 - 2 * inside).astype(np.float32)).to(device)
    for case in range(256):
        vertices, faces = ops.marching_cubes(coords[case : case + 1], values[case : case + 1])
        local = vertices.cpu() - torch.tensor([2.0 * case, 0, 0])
        crossings = sum(int(np.abs(np.diff(inside[case], axis=a)).sum()) for a in range(3))
        assert len(vertices) == crossings and bool((local[:, :].eq(0.5).sum(1) == 1).all())
        if case in (0, 255):
            assert len(faces) == 0
            continue
        mesh = _mesh(local, faces, 1)
        edges, uses = _edge_uses(mesh)
        assert (uses == 1).all()
        # Edges used one way only border the cube's faces; the others run through its interior.
        forward = set(map(tuple, edges))
        for a, b in forward:
            middle = (local[a] + local[b]) / 2
            on_face = bool(((middle == 0) | (middle == 1)).any())
            assert on_face == ((b, a) not in forward)


def test_only_the_crossed_cells_are_needed(device):
    coords, values = _cells(_sphere(65), 4, device)
    crossed = (values < 0).flatten(1).any(1) & (values > 0).flatten(1).any(1)
    mesh = _mesh(*ops.marching_cubes(coords[crossed], values[crossed]), 4)
    whole = _mesh(*ops.marching_cubes(coords, values), 4)
    _assert_closed_manifold(mesh)
    np.testing.assert_array_equal(mesh.vertices, whole.vertices)
    np.testing.assert_array_equal(mesh.faces, whole.faces)


def test_differing_copies_of_shared_samples_leave_no_seam(device):
    coords, values = _cells(_noise(21), 4, device)
    rng = np.random.default_rng(1)
    values += torch.from_numpy(rng.uniform(-0.3, 0.3, values.shape).astype(np.float32)).to(device)
    order = torch.from_numpy(rng.permutation(len(coords))).to(device)
    outer = ((coords == 0) | (coords == coords.max())).any(1)
    values[outer] = 1
    mesh = _mesh(*ops.marching_cubes(coords[order], values[order]), 4)
    assert len(mesh.faces) > 1000
    _assert_closed_manifold(mesh)


@pytest.mark.parametrize("unknown", [np.nan, np.inf, -np.inf])
def test_unknown_samples_open_the_surface_around_them(unknown, device):
    field = _sphere(33).astype(np.float32)
    known = _mesh(*ops.marching_cubes(*_cells(field, 4, device)), 4)
    field[16, 16, 26:30] = unknown
    vertices, faces = ops.marching_cubes(*_cells(field, 4, device))
    mesh = _mesh(vertices, faces, 4)
    assert torch.isfinite(vertices).all()
    assert len(faces.unique()) == len(vertices)
    near = (np.abs(known.triangles_center[:, :2] - 16) < 1).all(1) & (np.abs(known.triangles_center[:, 2] - 27.5) < 2.5)
    kept = known.triangles_center[~near]
    assert 0 < near.sum() == len(known.faces) - len(mesh.faces)
    assert cKDTree(mesh.triangles_center).query(kept)[0].max() == 0


def test_level(device):
    coords, values = _cells(_sphere(33), 4, device)
    shifted = ops.marching_cubes(coords, values - 0.1)
    for a, b in zip(ops.marching_cubes(coords, values, 0.1), shifted, strict=True):
        torch.testing.assert_close(a, b)


def test_values_of_zero_are_outside(device):
    values = torch.zeros(1, 2, 2, 2, device=device)
    coords = torch.zeros(1, 3, dtype=torch.int32, device=device)
    assert len(ops.marching_cubes(coords, values)[1]) == 0
    values[0, 0, 0, 0] = -1
    vertices, faces = ops.marching_cubes(coords, values)
    assert sorted(vertices.cpu().tolist()) == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert len(faces) == 1


def test_far_and_negative_cells(device):
    coords, values = _cells(_sphere(33), 4, device)
    vertices, faces = ops.marching_cubes(coords, values)
    offset = torch.tensor([-(2**20), 3, 2**20 - 8], dtype=torch.int32, device=device)
    far_vertices, far_faces = ops.marching_cubes(coords + offset, values)
    assert torch.equal(faces, far_faces)
    # float32 has a step of 1/16 at 2^20.
    torch.testing.assert_close(far_vertices, vertices + offset, rtol=0, atol=0.07)


def test_does_not_depend_on_threads():
    coords, values = _cells(_noise(41), 4)
    assert_same_for_any_threads(lambda: ops.marching_cubes(coords, values), (1, 4))


def test_same_on_every_device(device):
    coords, values = _cells(_noise(25), 4)
    vertices, faces = ops.marching_cubes(coords.to(device), values.to(device))
    want_vertices, want_faces = ops.marching_cubes(coords, values)
    assert torch.equal(faces.cpu(), want_faces)
    torch.testing.assert_close(vertices.cpu(), want_vertices, rtol=0, atol=1e-5)


@pytest.mark.parametrize("cells", [0, 3])
def test_empty(cells, device):
    coords = torch.arange(3 * cells, dtype=torch.int32, device=device).reshape(cells, 3)
    vertices, faces = ops.marching_cubes(coords, torch.ones(cells, 5, 5, 5, device=device))
    assert vertices.shape == (0, 3) and vertices.dtype == torch.float32
    assert faces.shape == (0, 3) and faces.dtype == torch.int64


def test_non_contiguous(device):
    coords, values = _cells(_torus(25), 4, device)
    strided = ops.marching_cubes(coords.T.contiguous().T, values.transpose(1, 3).contiguous().transpose(1, 3))
    for a, b in zip(strided, ops.marching_cubes(coords, values), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    "coords,values,error,message",
    [
        (torch.zeros(1, 3), torch.zeros(1, 2, 2, 2), TypeError, "cell_coords must be int32, got float32"),
        (torch.zeros(2, 3).int(), torch.zeros(1, 2, 2, 2), ValueError, r"cell_coords must have shape \[1, 3\], got "),
        (torch.zeros(1, 3).int(), torch.zeros(1, 2, 2, 2).double(), TypeError, "values must be float32, got float64"),
        (torch.zeros(1, 3).int(), torch.zeros(1, 2, 3, 2), ValueError, r"values must have shape \[1, 2, 2, 2\], got "),
        (torch.zeros(1, 3).int(), torch.zeros(8), ValueError, r"values must have shape \[M, n \+ 1, .*\], got \[8\]"),
        (torch.zeros(1, 3).int(), torch.zeros(1, 1, 1, 1), ValueError, "at least 2 samples per axis, got 1"),
        (torch.tensor([[0, 2**20, 7]]).int(), torch.zeros(1, 2, 2, 2), ValueError, "2.20 - 1], got 0 to 1048576"),
        (torch.tensor([[0, 0, -(2**20) - 1]]).int(), torch.zeros(1, 2, 2, 2), ValueError, "got -1048577 to 0"),
        (torch.zeros(2, 3).int(), torch.zeros(2, 2, 2, 2), ValueError, "must be distinct, got a row more than once"),
    ],
)
def test_errors(coords, values, error, message, device):
    with pytest.raises(error, match=message) as raised:
        ops.marching_cubes(coords.to(device), values.to(device))
    assert str(raised.value).startswith("marching_cubes: ")


def test_opcheck(device):
    coords, values = _cells(_sphere(9), 4, device)
    torch.library.opcheck(torch.ops.spslam.marching_cubes.default, (coords, values, 0.0))
