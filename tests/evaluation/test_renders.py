"""Rendered views of a map, against the generated room, which can be rendered exactly."""

from functools import partial

import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.datasets.generated import GeneratedDataset
from spslam.evaluation.depth_metrics import depth_l1
from spslam.evaluation.mesh_metrics import observed_mask
from spslam.evaluation.renders import novel_depth, novel_poses, render_view
from spslam.evaluation.run_output import Mesh
from spslam.geometry import pose_from
from spslam.scene import Scene, SceneSettings

CAMERA = Camera(80, 60, 69.0, 69.0, 39.5, 29.5)
# The mesh is within 0.5 mm of the exact room; at depth edges a pixel may show another surface.
MESH_ERROR_M = 2e-3


@pytest.fixture(scope="module")
def room():
    dataset = GeneratedDataset(frames=60, width=80, height=60)
    frames = [dataset[index] for index in range(0, 60, 6)]
    return dataset, [frame.depth for frame in frames], np.array([frame.pose for frame in frames])


def test_novel_poses_are_new_in_free_space_and_reproducible(room):
    dataset, depths, poses = room
    found = list(novel_poses(poses, depths, dataset.camera, 2))
    assert 5 < len(found) <= 40
    for pose in found:
        assert dataset.room.signed_distance(pose[None, :3, 3])[0] > 0
        assert np.abs(poses - pose).max(axis=(1, 2)).min() > 1e-3
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(found, list(novel_poses(poses, depths, dataset.camera, 2)))
    assert not np.array_equal(found[0], next(novel_poses(poses, depths, dataset.camera, 2, seed=1)))


def test_unobserved_positions_are_not_free(room):
    dataset, depths, poses = room
    no_depth = [np.zeros_like(depth) for depth in depths]
    assert not list(novel_poses(poses, no_depth, dataset.camera, 5))
    assert not list(novel_poses(poses[:0], [], dataset.camera, 5))


def test_novel_depth_of_the_ground_truth_and_of_a_scaled_mesh(room):
    dataset, depths, poses = room
    observed = partial(observed_mask, depths=depths, poses=poses, camera=dataset.camera)
    vertices, faces = dataset.room.triangles()
    views = list(novel_poses(poses, depths, dataset.camera, 4))
    surface = (vertices, faces)
    pairs = list(novel_depth(surface, surface, iter(views), CAMERA, observed, 4))
    assert len(pairs) == 4
    assert depth_l1(pairs) == {"depth_l1_cm": 0, "depth_l1_coverage": 100}
    center = views[0][:3, 3]
    nearer = center + 0.98 * (vertices - center)
    (estimated, true), *_ = novel_depth((nearer, faces), surface, iter(views[:1]), CAMERA, observed, 1)
    both = (estimated > 0) & (true > 0)
    np.testing.assert_allclose(estimated[both], 0.98 * true[both], rtol=1e-5)


def test_ground_truth_depth_of_unobserved_surface_is_removed(room):
    dataset, depths, poses = room
    surface = dataset.room.triangles()
    exact = dataset.room.render(CAMERA, poses[0])[1]

    def left_half(points):
        return (points - poses[0, :3, 3]) @ poses[0, :3, 0] < 0

    (_, true), *_ = novel_depth(surface, surface, iter(poses[:1]), CAMERA, left_half, 1)
    assert (true[:, 40:] == 0).all()
    difference = np.abs(true - exact)[:, :40]
    assert np.median(difference) < MESH_ERROR_M
    assert not list(novel_depth(surface, surface, iter(poses[:1]), CAMERA, lambda points: points[:, 0] > 99, 1))


def test_a_rendered_view_has_the_surface_of_the_mesh_and_the_colors_of_the_map():
    scene = Scene(SceneSettings(0.04, 0.08, 0.04, 0.25, 1000), seed=0)
    vertices = np.array([[-1.0, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros((4, 3), np.uint8))
    pose = pose_from(np.eye(3), np.array([0.3, 0.0, 0.0]))
    color, depth = render_view(scene, mesh, CAMERA, pose)
    assert color.dtype == np.uint8
    shown = depth > 0
    assert 0.2 < shown.mean() < 1
    np.testing.assert_allclose(depth[shown], 2, atol=1e-5)
    assert (color[~shown] == 0).all()
    row, column = 30, 40
    assert shown[row, column]
    point = (CAMERA.ray_directions()[row, column] * depth[row, column] + pose[:3, 3]).astype(np.float32)
    expected = (scene.color(torch.from_numpy(point[None])) * 255).round()[0].numpy()
    np.testing.assert_allclose(color[row, column], expected, atol=1)
    empty = Mesh(vertices, np.zeros((0, 3), int), mesh.colors)
    assert not render_view(scene, empty, CAMERA, pose)[1].any()
