"""Threads that work beside a GPU change nothing: neither edges and loops, nor the map made again."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from spslam.prior import load_prior
from spslam.scene import SparseVolume
from spslam.slam.graph.edges import Link
from spslam.slam.graph.keyframe_graph import GraphContent, KeyframeGraph
from spslam.slam.graph.overlap import Surfaces
from spslam.slam.graph.registration import Registrar
from spslam.slam.graph.remap import encode_keyframe, encode_keyframes
from spslam.slam.host_threads import host_threads
from tests.slam.graph.worlds import NOISE, keyframes, place, relative

NUMBERS = tuple(range(0, 96, 8))
SPACING = 0.2, 0.2


@pytest.fixture(scope="module")
def made():
    return keyframes("room", 96, NUMBERS)


def test_a_graph_is_the_same(made):
    frames, poses = made
    frames = [each.changed(frame=number) for number, each in enumerate((*frames, *frames))]
    poses = np.concatenate([poses, poses])
    links = [Link(np.eye(4), False), *(Link(relative(poses, i, i - 1), False) for i in range(1, len(poses)))]
    results = []
    with ThreadPoolExecutor(3) as pool:
        for each in (None, pool):
            surfaces = Surfaces()
            for keyframe in frames:
                surfaces.add(keyframe)
            graph = KeyframeGraph(Registrar({frames[0].camera: NOISE}, 0, pool=each), surfaces, GraphContent())
            results.append((graph.update(frames, links, poses, SPACING), graph.content))
    (alone, content), (together, other) = results
    assert np.array_equal(alone.poses, together.poses) and alone.decisions == together.decisions
    assert [(e.kind, e.source, e.target) for e in content.edges] == [(e.kind, e.source, e.target) for e in other.edges]
    assert alone.decisions and any(edge.kind == "covisible" for edge in content.edges)


def test_a_map_is_the_same(made):
    frames, poses = made
    config, prior, volumes = place("room", 96)[0], load_prior(), []
    with ThreadPoolExecutor(3) as pool:
        for each in ("one by one", None, pool):
            volume = SparseVolume(config.scene.voxel_size_m, config.scene.max_voxels)
            if each == "one by one":
                for keyframe, pose in zip(frames, poses, strict=True):
                    encode_keyframe(volume, keyframe, pose, prior, config)
            else:
                encode_keyframes(volume, zip(frames, poses, strict=True), prior, config, each)
            volumes.append(volume)
    for volume in volumes[1:]:
        assert torch.equal(volume.voxel_coords, volumes[0].voxel_coords)
        assert torch.equal(volume.embeddings, volumes[0].embeddings)


def test_tracking_keeps_the_cores_of_a_cpu():
    assert host_threads(torch.device("cpu")) is None
