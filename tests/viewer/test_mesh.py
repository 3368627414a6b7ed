"""The growing mesh is the map's, chunk by chunk; in the browser's format it has its colors."""

import io

import numpy as np
import pytest
import torch
import trimesh

from spslam.evaluation.run_output import RunOutput
from spslam.meshing import extract_mesh
from spslam.scene import Scene
from spslam.viewer import live_mesh as module
from spslam.viewer.glb import to_glb
from spslam.viewer.live_mesh import LiveMesh
from tests.viewer.worlds import finished_run


@pytest.fixture(scope="module")
def world():
    run = RunOutput.read(finished_run())
    return Scene.load(run.folder.map), run.camera, run.trajectory.poses


def corners(vertices, faces):
    """The triangles as a sorted list of rounded corners."""
    places = np.round(np.asarray(vertices)[faces], 4)
    return sorted(map(str, np.sort(places.reshape(len(faces), 3, 3), axis=1).tolist()))


def test_chunks_together_are_the_mesh(world):
    scene, camera, poses = world
    live = LiveMesh(camera, 0.04)
    made = live.update(scene, poses)
    assert len([mesh for mesh in made.values() if mesh is not None]) > 2
    vertices, faces, _ = live.merged()
    whole = extract_mesh(scene, 0.04, camera, poses, min_part_m2=0)
    common = set(corners(vertices, faces)) & set(corners(whole.vertices, whole.faces))
    # At the rim of what was seen, what is kept depends on the neighbors, which a chunk has one cell of.
    assert len(common) > 0.98 * max(len(faces), len(whole.faces))


def test_only_what_changed_is_made_again(world, monkeypatch):
    scene, camera, poses = world
    monkeypatch.setattr(module, "_REFRESHED_SHARE", 0.0)
    live = LiveMesh(camera, 0.04)
    made = live.update(scene, poses)
    assert live.update(scene, poses) == {}
    weights = scene.volume.weights
    before = weights.clone()
    chunk = module.CHUNK_M / scene.settings.voxel_size_m
    owner = torch.div(scene.volume.voxel_coords, round(chunk), rounding_mode="floor")
    some = owner[scene.volume.corner_ids[:, 0] >= 0][0]
    weights[(owner == some).all(1)] *= 2
    try:
        assert set(live.update(scene, poses)) == {tuple(some.tolist())} < set(made)
    finally:
        weights.copy_(before)


def test_empty_map_has_no_mesh(world):
    scene, camera, poses = world
    assert LiveMesh(camera, 0.04).update(Scene(scene.settings, 0), poses) == {}


def test_chunks_that_a_map_made_again_lacks_are_gone(world, monkeypatch):
    """Also where no other chunk changed, and where nothing is left of the map."""
    scene, camera, poses = world
    monkeypatch.setattr(module, "_REFRESHED_SHARE", 0.0)
    live = LiveMesh(camera, 0.04)
    live.update(scene, poses)
    shown, corner_ids = set(live.chunks), scene.volume.corner_ids
    before = corner_ids.clone()
    chunk = round(module.CHUNK_M / scene.settings.voxel_size_m)
    owner = torch.div(scene.volume.voxel_coords, chunk, rounding_mode="floor")
    some = min(shown)
    try:
        corner_ids[(owner == torch.tensor(some)).all(1), 0] = -1
        assert live.update(scene, poses) == {some: None}
        assert set(live.chunks) == shown - {some} and live.update(scene, poses) == {}
        corner_ids[:, 0] = -1
        assert live.update(scene, poses) == dict.fromkeys(shown - {some})
        assert not len(live.merged()[1])
    finally:
        corner_ids.copy_(before)
    assert {key for key, mesh in live.update(scene, poses).items() if mesh is not None} == shown


def test_glb_is_the_mesh(world):
    scene, camera, poses = world
    mesh = extract_mesh(scene, 0.08, camera, poses)
    loaded = trimesh.load(io.BytesIO(to_glb(mesh)), file_type="glb", process=False)
    shown = next(iter(loaded.geometry.values()))
    np.testing.assert_array_equal(shown.faces, mesh.faces)
    np.testing.assert_allclose(shown.vertices, mesh.vertices)
    np.testing.assert_allclose(shown.vertex_normals, mesh.normals, atol=1e-5)
