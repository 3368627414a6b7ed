"""Packing of arrays and meshes for a page; tests/evaluation/test_report_page.py reads them in a browser."""

import base64
import json
import zlib

import numpy as np
import pytest
import trimesh

from spslam.evaluation.web_data import encode_json, pack_arrays, pack_mesh
from spslam.meshing import Mesh


def unpack_arrays(packed):
    content, found, offset = zlib.decompress(base64.b64decode(packed["data"])), {}, 0
    for name, kind, count in packed["arrays"]:
        dtype = np.dtype({"Uint8Array": "u1", "Uint32Array": "<u4", "Float32Array": "<f4"}[kind])
        assert offset % dtype.itemsize == 0
        found[name] = np.frombuffer(content, dtype, count, offset)
        offset += found[name].nbytes
    assert offset == len(content)
    return found


def unpack_mesh(packed):
    """As web/unpack.js does it."""
    arrays, count = unpack_arrays(packed), packed["vertices"]
    codes = arrays["positions"].reshape(3, 2, count).astype(np.int64)
    grid = np.cumsum(signed(codes[:, 0] | codes[:, 1] << 8), axis=1) & 0xFFFF
    colors = np.cumsum(signed(arrays["colors"].reshape(3, count).astype(np.int64)), axis=1) & 0xFF
    below = arrays["corners"].reshape(3, -1).astype(np.int64)
    corners, used = [], 0
    for code in (below[0] | below[1] << 8 | below[2] << 16).tolist():
        corners.append(used - code)
        used += code == 0
    return Mesh(packed["origin"] + packed["step"] * grid.T, np.reshape(corners, (-1, 3)), colors.T.astype(np.uint8))


def signed(code):
    return np.where(code & 1, -(code + 1) // 2, code // 2)


def triangles(mesh):
    """Corners and colors of each face, in an order that doesn't depend on that of faces or vertices."""
    rows = np.concatenate([mesh.vertices[mesh.faces], mesh.colors[mesh.faces]], axis=2)
    return rows[np.lexsort(np.rint(1000 * rows).reshape(len(rows), -1).T)]


@pytest.mark.parametrize("shape", ["sphere", "one face", "flat"])
def test_a_mesh_survives_packing(shape):
    generator = np.random.default_rng(0)
    if shape == "sphere":
        solid = trimesh.creation.icosphere(4, radius=3.0)
        vertices, faces = np.array(solid.vertices), np.array(solid.faces)
    else:
        vertices = generator.uniform(-2, 2, (3 if shape == "one face" else 40, 3)) * (1, 1, shape != "flat")
        faces = np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
    mesh = Mesh(vertices, faces, generator.integers(0, 256, (len(vertices), 3), dtype=np.uint8))
    packed = json.loads(encode_json(pack_mesh(mesh)))
    shown = unpack_mesh(packed)
    assert (packed["vertices"], packed["faces"]) == (len(np.unique(faces)), len(faces))
    # Half a step of the grid: the extent in 65,535 steps.
    assert packed["step"] <= np.ptp(vertices, axis=0).max() / 65_534
    # Vertices of the grid's accuracy can swap places in the sort, so compare sums first.
    assert np.allclose(shown.vertices[shown.faces].sum(axis=(0, 1)), vertices[faces].sum(axis=(0, 1)), atol=0.05)
    expected = {tuple(color) for color in mesh.colors[np.unique(faces)].tolist()}
    assert {tuple(color) for color in shown.colors.tolist()} == expected
    order = {tuple(color): place for color, place in zip(mesh.colors.tolist(), vertices, strict=True)}
    if len(order) == len(vertices):
        places = np.array([order[tuple(color)] for color in shown.colors.tolist()])
        assert np.abs(places - shown.vertices).max() <= packed["step"]
        by_color = {tuple(map(tuple, face)) for face in mesh.colors[faces].tolist()}
        assert {tuple(map(tuple, face)) for face in shown.colors[shown.faces].tolist()} == by_color


def test_a_mesh_takes_few_bytes():
    solid = trimesh.creation.icosphere(6)
    mesh = Mesh(np.array(solid.vertices), np.array(solid.faces), np.full((len(solid.vertices), 3), 99, np.uint8))
    assert len(pack_mesh(mesh)["data"]) < 7 * len(mesh.faces)


def test_arrays_survive_packing():
    arrays = {"a": np.array([1, 2, 255], np.uint8), "b": np.array([[0.5, np.nan]], np.float32),
              "c": np.array([1 << 31], np.uint32)}  # fmt: skip
    found = unpack_arrays(pack_arrays(arrays))
    assert all(np.array_equal(found[name], array.reshape(-1), equal_nan=name == "b") for name, array in arrays.items())


def test_unknown_types_and_empty_meshes_are_refused():
    with pytest.raises(ValueError, match="pack_arrays: a must be of uint8, uint32, float32, got float64"):
        pack_arrays({"a": np.zeros(1)})
    with pytest.raises(ValueError, match="pack_mesh: must have a face"):
        pack_mesh(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8)))


def test_json_cannot_end_a_script():
    assert "<" not in encode_json({"a": "</script><!--"})
    assert json.loads(encode_json({"a": "</script>"})) == {"a": "</script>"}
