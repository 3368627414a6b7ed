"""When poses and map are adopted, and that frames, map and checkpoints follow."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam.config import load_config
from spslam.datasets import open_sequence
from spslam.geometry import compose, inverse, pose_from
from spslam.pose_graph import rotation_matrices
from spslam.slam.checkpoint import load_checkpoint, take_snapshot, write_snapshot
from spslam.slam.graph import keyframe_graph, redundancy
from spslam.slam.graph.edges import GraphEdge, Link
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.keyframe_store import KeyframeStore
from spslam.slam.graph.loops import Proposal
from spslam.slam.graph.remap import corrected_poses
from spslam.slam.system import SlamSystem
from tests.slam.graph.worlds import keyframes

FRAMES = 40
# Keyframes and solutions so often that all happens within a few frames, and any change makes the map again.
OFTEN = ("graph.every=8", "graph.max_translation_m=0.04", "graph.min_change_m=1e-9")


@pytest.fixture(scope="module")
def sequence():
    overrides = [f"dataset.frames={FRAMES}", "mapping.first_iterations=20", *OFTEN]
    config = load_config("places", None, [*overrides, "dataset.width=160", "dataset.height=120"])
    dataset = open_sequence(config.dataset)
    return config, dataset, [dataset[i] for i in range(FRAMES)]


def system_of(sequence, **graph):
    config, dataset, _ = sequence
    config = config.model_copy(update={"graph": config.graph.model_copy(update=graph)})
    return SlamSystem(config, dataset.camera, dataset.poses()[0])


def result_of(system):
    system.finish()
    scene = system.state.scene.state_dict()
    return [system.state.frames.poses.numpy().tobytes(), *(tensor.numpy().tobytes() for tensor in scene.values())]


def test_it_is_off_where_it_is_switched_off(sequence):
    system = system_of(sequence, enabled=False)
    assert system.state.graph is None and system.global_mapping is None


def test_map_is_made_again_at_fixed_frames(sequence):
    system, volumes = system_of(sequence), []
    for frame in sequence[2]:
        system.process(frame)
        volumes.append(system.state.scene.volume)
    changed = [i for i in range(1, FRAMES) if volumes[i] is not volumes[i - 1]]
    assert changed and all(i % 8 == 0 for i in changed)
    assert len(system.state.graph.keyframes) > 4
    assert system.state.graph.content.edges
    system.finish()
    truth = sequence[1].poses()
    error = np.linalg.norm((system.trajectory().poses - truth)[:, :3, 3], axis=1)
    assert error.max() < 0.03


def test_small_changes_leave_the_map(sequence):
    system = system_of(sequence, min_change_m=10.0)
    volume = system.state.scene.volume
    for frame in sequence[2]:
        system.process(frame)
    before = system.trajectory().poses
    system.finish()
    assert system.state.scene.volume is volume
    assert not np.array_equal(system.trajectory().poses, before)  # but poses are solved for at the end


@pytest.fixture(scope="module")
def whole(sequence):
    """What a run without interruption gives."""
    system = system_of(sequence)
    for frame in sequence[2]:
        system.process(frame)
    return result_of(system)


def test_the_same_bytes_every_time(sequence, whole):
    system = system_of(sequence)
    for frame in sequence[2]:
        system.process(frame)
    assert result_of(system) == whole


@pytest.mark.parametrize("stop", [11, 16, 27])
def test_a_resumed_system_gives_the_same_bytes(sequence, whole, stop, tmp_path):
    half = system_of(sequence)
    for frame in sequence[2][:stop]:
        half.process(frame)
    half.save(tmp_path / "half")
    resumed = SlamSystem.load(tmp_path / "half")
    for frame in sequence[2][stop:]:
        resumed.process(frame)
    assert result_of(resumed) == whole


def test_frames_may_follow_the_end(sequence):
    """A map made again after `finish` has all keyframes."""
    system = system_of(sequence)
    for frame in sequence[2][:12]:
        system.process(frame)
    system.finish()
    for frame in sequence[2][12:]:
        system.process(frame)
    system.finish()
    error = np.linalg.norm((system.trajectory().poses - sequence[1].poses())[:, :3, 3], axis=1)
    assert error.max() < 0.03
    whole = system_of(sequence)
    for frame in sequence[2]:
        whole.process(frame)
    whole.finish()
    assert system.state.scene.volume.num_voxels > 0.9 * whole.state.scene.volume.num_voxels


@pytest.mark.slow
def test_a_known_place_needs_no_more_keyframes(sequence, tmp_path, monkeypatch):
    """Keyframes stop to grow, frames of those left out follow, and a resumed system goes on alike."""
    monkeypatch.setattr(redundancy, "SIMILAR", 1)  # of the ten that there are
    monkeypatch.setattr(keyframe_graph, "RECENT", 4)
    order = [*range(0, FRAMES, 4), *range(FRAMES - 4, -1, -4)] * 3
    frames = [replace(sequence[2][at], index=i, timestamp=i / 30) for i, at in enumerate(order)]
    system, counts = system_of(sequence, every=8), []
    for frame in frames:
        if len(counts) == 44:
            system.save(tmp_path / "saved")
        system.process(frame)
        counts.append(len(system.state.graph.keyframes))
    resumed = SlamSystem.load(tmp_path / "saved")
    assert resumed.state.graph.anchors
    for frame in frames[44:]:
        resumed.process(frame)
    assert result_of(resumed) == result_of(system)
    graph = system.state.graph
    assert len(graph.keyframes) < counts[19] and len(graph.anchors) > counts[19]
    error = np.linalg.norm((system.trajectory().poses - sequence[1].poses()[order])[:, :3, 3], axis=1)
    assert error.max() < 0.03


def test_a_live_run_takes_up_what_is_ready(sequence, monkeypatch):
    """It never waits for the thread, and ends as well."""
    system, volumes = system_of(sequence), []
    held = threading.Event()
    remade = system.global_mapping._remade
    monkeypatch.setattr(system.global_mapping, "_remade", lambda *args: held_back(held, remade(*args)))
    for frame in sequence[2]:
        system.process(frame, defer_mapping=True)
        system.optimize_map(2)
        wait_for_solution(system)
        volumes.append(system.state.scene.volume)
        if len(volumes) == 30:
            assert all(volume is volumes[0] for volume in volumes)
            assert system.state.graph.target is not None  # solved, but its map is not ready
            held.set()
    for _ in range(3):  # what is left to be encoded is, and the map is adopted
        system.global_mapping._running.result()
        system.global_mapping.take_up_ready(FRAMES)
        if system.state.scene.volume is not volumes[0]:
            break
    assert system.state.scene.volume is not volumes[0]
    system.finish()
    error = np.linalg.norm((system.trajectory().poses - sequence[1].poses())[:, :3, 3], axis=1)
    assert error.max() < 0.03


def held_back(event, work):
    def later():
        event.wait(60)
        return work()

    return later


def wait_for_solution(system):
    """Until a solution is ready; not for a map."""
    running = system.global_mapping._running
    if running is not None and system.state.graph.target is None:
        running.result()


def test_reset_forgets_the_graph(sequence):
    system = system_of(sequence)
    for frame in sequence[2][:12]:
        system.process(frame)
    system.reset()
    assert system.state.graph.keyframes == [] and len(system.state.frames) == 0
    system.process(sequence[2][0])
    assert len(system.state.graph.keyframes) == 1


def test_store_survives_a_checkpoint(sequence, tmp_path):
    system = system_of(sequence)
    for frame in sequence[2][:20]:
        system.process(frame)
    state, config = system.state, system.config
    edge = GraphEdge("loop", 2, 1, np.eye(4), np.eye(6))
    state.graph.content.waiting.append(Proposal(edge, np.eye(4)))
    source = {"data": {"frames": 20}, "next": 20, "clock": {"frames": 20, "wall_s": 1.0, "decode_s": 1.0}}
    write_snapshot(tmp_path / "checkpoint", take_snapshot(state, config, source, copy=False))
    other = system_of(sequence)
    load_checkpoint(tmp_path / "checkpoint", other.state, config)
    one, two = state.graph.tensors(), other.state.graph.tensors()
    assert one.keys() == two.keys()
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert isinstance(other.state.graph, KeyframeStore)


def test_frames_follow_the_keyframes_that_they_lie_between():
    rows, count = np.array([2, 6]), 9
    poses = pose_from(np.eye(3), np.arange(count)[:, None] * np.array([1.0, 0.0, 0.0]))
    moved = poses[rows].copy()
    moved[1, 1, 3] += 0.4
    corrected = corrected_poses(poses, rows, moved)
    np.testing.assert_allclose(corrected[:, 1, 3], [0, 0, 0, 0.1, 0.2, 0.3, 0.4, 0.4, 0.4], atol=1e-12)
    np.testing.assert_allclose(corrected[:, 0, 3], np.arange(count), atol=1e-12)


def test_a_rigid_move_keeps_frames_rigid():
    random = np.random.default_rng(0)
    poses = pose_from(rotation_matrices(random.normal(0, 0.3, (7, 3))), random.normal(0, 1, (7, 3)))
    move = pose_from(rotation_matrices(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    corrected = corrected_poses(poses, np.array([0, 3, 5]), compose(move, poses[[0, 3, 5]]))
    np.testing.assert_allclose(compose(inverse(move), corrected), poses, atol=1e-9)


def test_keyframes_without_depth_are_harmless():
    (one, *_), _ = keyframes("room", 300, (0, 5))
    blind = Keyframe(9, torch.zeros_like(one.depth), one.intensity, one.camera)
    records, normals = blind.sample(100, 0)
    assert len(records) == 0 and len(normals) == 0
    assert Link(np.eye(4), True).relocalized
