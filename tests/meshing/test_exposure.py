"""Gains of frames' colors: what is recovered, that they are the exact solution, and what many frames take."""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from spslam.meshing.texture.exposure import Exposures, _offsets

SIDE_PX = 5  # of the squares that have one color in an image, as wide as what colors are means over


def exposures(frames, vertices, seen, gains):
    """Colors of vertices along a path: each frame sees `seen` of them, as squares in a row, brighter by its gain."""
    random = np.random.default_rng(0)
    albedos = random.uniform(60, 160, (vertices, 3))
    made = Exposures(vertices, frames)
    for number in range(frames):
        ids = (np.arange(seen) + number * (vertices - seen) // max(frames - 1, 1)) % vertices
        image = np.rint(albedos[ids] * gains[number]).clip(0, 255).astype(np.uint8)[None]
        image = image.repeat(SIDE_PX, axis=0).repeat(SIDE_PX, axis=1)
        u, v = SIDE_PX * np.arange(seen) + SIDE_PX // 2, np.full(seen, SIDE_PX // 2)
        made.add(SimpleNamespace(frame=SimpleNamespace(color=image), number=number), SimpleNamespace(ids=ids, u=u, v=v))
    return made


def test_gains_undo_what_frames_are_brighter_by():
    gains = np.random.default_rng(1).uniform(0.8, 1.25, (40, 3))
    relative = exposures(40, 200, 100, gains).gains() * gains
    # They are drawn to each other, as to what else changes with the view.
    assert np.log(relative).std(axis=0).max() < 0.2 * np.log(gains).std(axis=0).min()


def test_offsets_are_those_of_elimination():
    random = np.random.default_rng(2)
    counts = random.uniform(0.1, 1, (60, 300)) * (random.uniform(size=(60, 300)) < 0.1)
    counts[7] = 0  # a frame that sees nothing
    per_vertex, per_frame = np.maximum(counts.sum(0), 1e-12), counts.sum(1)
    right = per_frame * random.normal(size=60)
    diagonal = per_frame + 0.05 * per_frame.mean()
    expected = np.linalg.solve(np.diag(diagonal) - counts / per_vertex @ counts.T, right)
    found = _offsets(csr_matrix(counts), per_vertex, diagonal, right)
    assert found == pytest.approx(expected, abs=1e-13) and found[7] == 0
    assert not _offsets(csr_matrix(counts), per_vertex, diagonal, np.zeros(60)).any()


def test_memory_does_not_grow_with_pairs_of_frames():
    many = exposures(3000, 2000, 20, np.ones((3000, 3)))
    tracemalloc.start()
    gains = many.gains()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6 < 8 * 3000**2
    assert np.abs(gains - 1).max() < 1e-3
