"""Meshes of maps that represent an analytic field: the decoder returns the first channel of the embedding."""

import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.meshing import extract_mesh
from spslam.meshing.cleaning import front_facing_in_view
from spslam.scene import Scene, SceneSettings
from tests.meshing import fields

VOXEL_M, TRUNCATION_M = 0.04, 0.08
CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)


def _first_channel_decoder():
    """tanh of input 3, the first channel after the position: relu(x) - relu(-x) through both hidden layers."""
    first, second, third = torch.zeros(32, 11), torch.zeros(32, 32), torch.zeros(1, 32)
    first[0, 3], first[1, 3] = 1, -1
    second[0, 0] = second[1, 1] = 1
    third[0, 0], third[0, 1] = 1, -1
    parts = (first, torch.zeros(32), second, torch.zeros(32), third, torch.zeros(1))
    return torch.cat([part.reshape(-1) for part in parts])


def _scene(field, half_extents_m, device, reach_m=0.1, weights=None):
    """A map of an analytic signed distance near its surface; `weights` maps vertices (m) to fusion weights."""
    settings = SceneSettings(VOXEL_M, TRUNCATION_M, plane_cell_m=0.04, position_scale=0.25, max_voxels=10**7)
    scene = Scene(settings, seed=0, geometry_decoder=_first_channel_decoder(), device=device)
    scene.volume.insert(fields.cells_near(field, half_extents_m, VOXEL_M, reach_m, device))
    points = scene.volume.voxel_coords * VOXEL_M
    distance, _ = field(points)
    scene.volume.embeddings[:, 0] = torch.atanh((distance / TRUNCATION_M).clamp(-0.99, 0.99))
    scene.volume.weights[:] = 1.0 if weights is None else weights(points)
    scene.planes.cover(torch.stack([points.min(0).values, points.max(0).values]))
    scene.planes.texels.uniform_(-1, 1, generator=torch.Generator(device).manual_seed(0))
    return scene


def _looking(eye, target):
    """T_world_camera of a camera at `eye` with `target` at the image center."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0.3, 0.2, 0.93])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward), 1)
    pose[:3, 3] = eye
    return pose


def _slab(points):
    """A slab 6 cm thick, whose surfaces are at z = -3 and z = 3 cm."""
    return points[:, 2].abs() - 0.03, torch.ones(len(points), dtype=torch.bool, device=points.device)


def test_sphere(device):
    scene = _scene(fields.sphere(0.5), (0.6, 0.6, 0.6), device)
    mesh = extract_mesh(scene, 0.01)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    # Error of trilinear interpolation over 4 cm: sagitta of a 7 cm chord at a radius of 50 cm.
    assert np.abs(radius - 0.5).max() < 2e-3
    assert (np.einsum("ij,ij->i", mesh.normals, mesh.vertices) > 0.99 * radius).all()
    colors = scene.color(torch.from_numpy(mesh.vertices).to(device)).cpu().numpy() * 255
    assert np.abs(colors - mesh.colors).max() < 0.51
    assert mesh.colors.std(0).min() > 1
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_same_map_same_mesh(device):
    scene = _scene(fields.sphere(0.3), (0.4, 0.4, 0.4), device)
    one, two = (extract_mesh(scene, 0.02) for _ in range(2))
    for name in ("vertices", "faces", "colors", "normals"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_surface_with_low_support_next_to_high_support_is_removed(device):
    def weights(points):
        return torch.where(points[:, 2] > 0, 10.0, 0.2)

    scene = _scene(_slab, (0.5, 0.5, 0.1), device, weights=weights)
    both = extract_mesh(scene, 0.02, min_support=0)
    assert np.abs(np.abs(both.vertices[:, 2]) - 0.03).max() < 2e-3 and both.vertices[:, 2].min() < 0
    upper = extract_mesh(scene, 0.02)
    assert upper.vertices[:, 2].min() > 0
    assert len(upper.faces) == (both.vertices[both.faces][:, :, 2] > 0).all(1).sum()


@pytest.mark.parametrize("weight", [0.0, 0.003])
def test_uniformly_low_support_is_kept(weight, device):
    scene = _scene(_slab, (0.3, 0.3, 0.1), device, weights=lambda points: weight)
    assert len(extract_mesh(scene, 0.02).faces) == len(extract_mesh(scene, 0.02, min_support=0).faces) > 0


def test_only_surface_seen_from_the_front_is_kept(device):
    scene = _scene(_slab, (0.4, 0.4, 0.1), device)
    poses = np.stack([_looking((0.1, 0, 1.5), (0, 0, 0)), _looking((-0.3, 0.2, 1.2), (0, 0, 0))])
    mesh = extract_mesh(scene, 0.02, camera=CAMERA, poses=poses)
    assert len(mesh.faces) > 500
    assert mesh.vertices[:, 2].min() > 0.02


def test_surface_out_of_view_is_removed(device):
    scene = _scene(_slab, (1.0, 0.2, 0.1), device)
    pose = _looking((0.5, 0, 0.6), (0.5, 0, 0))
    mesh = extract_mesh(scene, 0.02, camera=CAMERA, poses=np.stack([pose, np.full((4, 4), np.nan)]))
    assert len(mesh.faces) > 100
    assert mesh.vertices[:, 0].min() > 0


def test_small_components_are_removed(device):
    def balls(points):
        shifted = points - torch.tensor([0.5, 0, 0], device=points.device)
        return torch.minimum(points.norm(dim=1) - 0.2, shifted.norm(dim=1) - 0.03), points[:, 0] == points[:, 0]

    scene = _scene(balls, (0.6, 0.4, 0.4), device)
    # The ball is as small as a voxel: the map represents 50 cm^2 of it, at every resolution.
    for resolution_m in (0.01, 0.02):
        assert extract_mesh(scene, resolution_m, min_part_m2=0.004).vertices[:, 0].max() > 0.45
        assert extract_mesh(scene, resolution_m, min_part_m2=0.006).vertices[:, 0].max() < 0.25


def test_empty_map(device):
    settings = SceneSettings(VOXEL_M, TRUNCATION_M, plane_cell_m=0.04, position_scale=0.25, max_voxels=100)
    mesh = extract_mesh(Scene(settings, seed=0, device=device), 0.01)
    assert len(mesh.vertices) == len(mesh.faces) == 0


@pytest.mark.parametrize(
    "arguments,message",
    [
        (dict(resolution_m=0.0), "extract_surface: resolution_m must be positive, got 0.0"),
        (dict(resolution_m=0.01, camera=CAMERA), "extract_mesh: camera and poses must be given together, got one"),
        (dict(resolution_m=0.01, poses=np.eye(4)[None]), "extract_mesh: camera and poses must be given together"),
        (
            dict(resolution_m=0.02, camera=CAMERA, poses=np.full((2, 4, 4), np.nan)),
            "front_facing_in_view: poses must have at least one finite pose, got none",
        ),
    ],
)
def test_errors(arguments, message):
    scene = _scene(fields.sphere(0.1), (0.2, 0.2, 0.2), "cpu")
    with pytest.raises(ValueError, match=message):
        extract_mesh(scene, **arguments)


def test_front_facing_test_samples_the_whole_trajectory():
    vertices = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]], np.float32)
    faces = np.array([[0, 1, 2]])
    behind, front = _looking((0, 0, -1), (0, 0, 0)), _looking((0, 0, 1), (0, 0, 0))
    up = np.tile(np.float32([0, 0, 1]), (3, 1))
    assert front_facing_in_view(vertices, up, faces, CAMERA, np.stack([behind] * 100 + [front])).all()
    assert not front_facing_in_view(vertices, up, faces, CAMERA, np.stack([behind] * 100)).any()
    assert front_facing_in_view(vertices, -up, faces, CAMERA, behind[None]).all()
