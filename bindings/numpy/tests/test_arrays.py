"""What happens to the arrays themselves: no copies, and clear errors."""

import doctest
import re
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import spslam_numpy as sn

import spslam

IDS = np.zeros((4, 8), np.int32)
LOCAL = np.full((4, 3), 0.5, np.float32)
EMBEDDINGS = np.arange(16, dtype=np.float32).reshape(8, 2)


def refused(kind, message):
    return pytest.raises(kind, match=re.escape(message))


def test_docstring_example():
    assert doctest.testmod(sn, extraglobs=vars(sn)).failed == 0


def test_page_runs():
    page = Path(__file__).parents[3] / "docs" / "numpy.md"
    (block,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    names = {}
    exec(compile(block, "numpy.md", "exec"), names)
    # Interpolated between voxels of 0.1 m, a ball's distance is off by its curvature.
    np.testing.assert_allclose(names["values"], [0, -0.05, 0], atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(names["vertices"] * 0.1, axis=1), 0.5, atol=0.01)
    assert len(names["faces"])


def test_versions_agree():
    text = (Path(__file__).parent.parent / "pyproject.toml").read_text()
    assert sn.__version__ == spslam.__version__ == re.search(r'^version = "(.*)"', text, re.MULTILINE)[1]


def test_reads_memory_maps_and_views(tmp_path):
    path = tmp_path / "embeddings.npy"
    np.save(path, EMBEDDINGS)
    want = sn.trilinear_interpolate(EMBEDDINGS, IDS, LOCAL)
    for same in (np.load(path, mmap_mode="r"), EMBEDDINGS[::-1][::-1], np.asfortranarray(EMBEDDINGS)):
        np.testing.assert_array_equal(sn.trilinear_interpolate(same, IDS, LOCAL), want)


def test_contiguous_input_is_not_copied(tmp_path):
    # A map of a file far larger than what may be allocated here can only be read in place.
    path = tmp_path / "sparse"
    rows = 1 << 33
    with open(path, "wb") as file:
        file.truncate(rows * 8)
    embeddings = np.memmap(path, np.float32, "r", shape=(rows, 2))
    assert not sn.trilinear_interpolate(embeddings, IDS, LOCAL).any()


def test_results_are_changed_in_place():
    param, grad, first, second = (np.ones((3, 2), np.float32) for _ in range(4))
    sn.sparse_adam_(param, grad, first, second, lr=0.1, step=1)
    assert (param < 1).all()
    assert not grad.any()


def test_wrong_types():
    with refused(TypeError, "trilinear_interpolate: embeddings must be a numpy.ndarray, got list"):
        sn.trilinear_interpolate([[1.0]], IDS, LOCAL)
    with refused(TypeError, "trilinear_interpolate: embeddings must be float32 or float64, got int32"):
        sn.trilinear_interpolate(IDS, IDS, LOCAL)
    with refused(TypeError, "trilinear_interpolate: corner_ids must be int32, got int64"):
        sn.trilinear_interpolate(EMBEDDINGS, IDS.astype(np.int64), LOCAL)
    with refused(TypeError, "trilinear_interpolate: local_coords must be float32, got float64"):
        sn.trilinear_interpolate(EMBEDDINGS, IDS, LOCAL.astype(np.float64))
    with refused(TypeError, "trilinear_interpolate: local_coords must be float32, got >f4"):
        sn.trilinear_interpolate(EMBEDDINGS, IDS, LOCAL.astype(">f4"))


def test_wrong_shapes():
    with refused(ValueError, "trilinear_interpolate: corner_ids must have shape [N, 8], got [4, 7]"):
        sn.trilinear_interpolate(EMBEDDINGS, IDS[:, :7], LOCAL)
    with refused(ValueError, "trilinear_interpolate: local_coords must have shape [4, 3], got [3, 3]"):
        sn.trilinear_interpolate(EMBEDDINGS, IDS, LOCAL[:3])
    with refused(ValueError, "mlp: params must have shape [8], got [7]"):
        sn.mlp(LOCAL, np.zeros(7, np.float32), 1, 1)


def test_arrays_that_cannot_be_changed():
    totals, ids = np.zeros(4, np.float32), np.arange(4, dtype=np.int32)
    features = np.ones((4, 8), np.float32)
    frozen = np.zeros((4, 8), np.float32)
    frozen.flags.writeable = False
    with refused(ValueError, "fuse_prior_: embeddings must be writeable, got a read-only array"):
        sn.fuse_prior_(frozen, totals, ids, features, totals, 1.0)
    with refused(ValueError, "fuse_prior_: embeddings must be contiguous, got strides (4, 16)"):
        sn.fuse_prior_(np.zeros((8, 4), np.float32).T, totals, ids, features, totals, 1.0)


def test_voxels_out_of_range_and_full_tables():
    keys, values = sn.new_voxel_hash(4)
    with pytest.raises(RuntimeError, match=re.escape("must lie in [-2^20, 2^20 - 1], got 1 rows outside")):
        sn.voxel_hash_insert(keys, values, np.array([[2**20, 0, 0]], np.int32), 0)
    with pytest.raises(RuntimeError, match="must stay at most half full, got 3 voxels for 4 slots"):
        sn.voxel_hash_insert(keys, values, np.arange(9, dtype=np.int32).reshape(3, 3), 0)
    assert (keys == -1).all()
    with refused(ValueError, "new_voxel_hash: capacity must be a power of two, got 3"):
        sn.new_voxel_hash(3)


@pytest.mark.parametrize("number", [-1, 1 << 32])
def test_keys_of_draws_out_of_range(number):
    calls = {
        "philox_uniform": lambda *key: sn.philox_uniform(0, 0, *key, 2),
        "sample_indices": lambda *key: sn.sample_indices(0, 0, *key, 2, 6),
        "sample_along_rays": lambda *key: sn.sample_along_rays(LOCAL[:, 0], 2, 1, 0.0, 1.0, 0.1, 0, 0, *key),
    }
    for name, call in calls.items():
        with refused(ValueError, f"{name}: frame must be in [0, 2^32 - 1], got {number}"):
            call(number, 0)
        with refused(ValueError, f"{name}: iteration must be in [0, 2^32 - 1], got {number}"):
            call(0, number)


def test_other_threads_run_beside_a_kernel():
    """Each call takes a tenth of a second or more: longer than what Python lets another thread have before it."""
    tables = [np.ones((20_000_000, 1), np.float32) for _ in range(4)]
    coords, equations = np.zeros((500_000, 3), np.int32), np.tile(np.eye(6), (200_000, 1, 1))
    calls = {
        "philox_uniform": lambda: sn.philox_uniform(0, 0, 0, 0, 20_000_000),
        "sample_indices": lambda: sn.sample_indices(0, 0, 0, 0, 20_000_000, 6),
        "random_embeddings": lambda: sn.random_embeddings(coords, 0),
        "sparse_adam_": lambda: sn.sparse_adam_(*tables, lr=0.1, step=1),
        "solve_normal_equations": lambda: sn.solve_normal_equations(equations, equations[:, 0].copy()),
    }
    awake, ended = [], threading.Event()

    def wake():
        while not ended.wait(0.001):
            awake.append(time.perf_counter())

    thread = threading.Thread(target=wake)
    thread.start()
    try:
        for name, call in calls.items():
            begin = time.perf_counter()
            call()
            tenth = (time.perf_counter() - begin) / 10
            assert any(begin + tenth < moment < begin + 9 * tenth for moment in awake), name
    finally:
        ended.set()
        thread.join()


def test_empty_arrays():
    assert sn.trilinear_interpolate(EMBEDDINGS, IDS[:0], LOCAL[:0]).shape == (0, 2)
    assert [part.shape for part in sn.marching_cubes(IDS[:0, :3], np.zeros((0, 2, 2, 2), np.float32))] == [(0, 3)] * 2
    empty = np.zeros((0, 3), np.float32)
    assert sn.encode_points(empty, empty, np.zeros(sn.ENCODER_PARAMETERS, np.float32), 0.04)[0].shape == (0, 3)
