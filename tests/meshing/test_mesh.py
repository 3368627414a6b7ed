"""Triangle meshes, and their files."""

import json
import os
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from spslam.errors import OutputError
from spslam.meshing import TriangleMesh, load_mesh, save_mesh
from spslam.meshing.cleaning import in_large_component
from spslam.meshing.mesh import compact, face_normals, vertex_normals


def _sphere(subdivisions=3, offset=0.0):
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = (shape.vertices + offset).astype(np.float32)
    faces = shape.faces.astype(np.int32)
    colors = (255 * (shape.vertices + 1) / 2).astype(np.uint8)
    return TriangleMesh(vertices, faces, colors, vertex_normals(vertices, faces))


def _empty():
    return TriangleMesh(*(np.zeros((0, 3), dtype) for dtype in (np.float32, np.int32, np.uint8, np.float32)))


def linear(levels):
    """The light, 0 to 1, that levels of sRGB, 0 to 255, stand for (IEC 61966-2-1)."""
    share = np.asarray(levels) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def test_vertex_normals_of_a_sphere_are_radial():
    mesh = _sphere(4)
    assert np.abs(mesh.normals - mesh.vertices).max() < 1e-2
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, rtol=1e-6)


def test_vertex_normals_agree_with_trimesh_weighted_by_area():
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(50, 3)).astype(np.float32)
    faces = rng.integers(0, 50, (80, 3)).astype(np.int32)
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    shape = trimesh.Trimesh(vertices, faces, process=False)
    expected = np.zeros((50, 3))
    for normal, area, corners in zip(shape.face_normals, shape.area_faces, faces, strict=True):
        for corner in corners:
            expected[corner] += normal * area
    used = np.linalg.norm(expected, axis=1) > 0
    expected[used] /= np.linalg.norm(expected[used], axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(vertices, faces), expected, atol=1e-5)


def test_degenerate_faces_have_no_normal():
    assert not vertex_normals(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32)).any()


def test_compact_drops_unused_vertices():
    mesh = _sphere()
    kept = mesh.faces[mesh.vertices[mesh.faces].mean(1)[:, 2] > 0]
    faces, used = compact(kept, len(mesh.vertices))
    assert len(faces) == len(kept) and len(used) < len(mesh.vertices)
    np.testing.assert_array_equal(mesh.vertices[used][faces], mesh.vertices[kept])
    no_faces, none_used = compact(mesh.faces[:0], len(mesh.vertices))
    assert len(no_faces) == len(none_used) == 0


def test_small_components():
    small, large = _sphere(1), _sphere(2)
    vertices = np.concatenate((0.1 * small.vertices, large.vertices))
    faces = np.concatenate((small.faces, large.faces + len(small.vertices)))
    is_large = np.arange(len(faces)) >= len(small.faces)
    area_m2 = np.linalg.norm(face_normals(vertices, small.faces), axis=1).sum() / 2
    np.testing.assert_array_equal(in_large_component(vertices, faces, 1.001 * area_m2), is_large)
    assert in_large_component(vertices, faces, 0.999 * area_m2).all()
    assert in_large_component(vertices, faces, 0).all()
    assert in_large_component(vertices, faces[:0], 1.0).shape == (0,)


@pytest.mark.parametrize(
    "field,array,message",
    [
        ("vertices", np.zeros((4, 3)), r"vertices must be float32 \[4, 3\], got float64 \[4, 3\]"),
        ("faces", np.zeros((2, 3), np.int64), r"faces must be int32 \[2, 3\], got int64 \[2, 3\]"),
        ("colors", np.zeros((4, 4), np.uint8), r"colors must be uint8 \[4, 3\], got uint8 \[4, 4\]"),
        ("normals", np.zeros((3, 3), np.float32), r"normals must be float32 \[4, 3\], got float32 \[3, 3\]"),
    ],
)
def test_mesh_errors(field, array, message):
    arrays = dict(
        vertices=np.zeros((4, 3), np.float32),
        faces=np.zeros((2, 3), np.int32),
        colors=np.zeros((4, 3), np.uint8),
        normals=np.zeros((4, 3), np.float32),
    )
    with pytest.raises(ValueError, match="^TriangleMesh: " + message):
        TriangleMesh(**{**arrays, field: array})


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj", "PLY"])
def test_files_contain_the_mesh(suffix, tmp_path):
    mesh = _sphere()
    path = tmp_path / f"mesh.{suffix}"
    save_mesh(mesh, path)
    loaded = trimesh.load(path, process=False, force="mesh")
    np.testing.assert_allclose(loaded.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    shown = loaded.visual.vertex_colors[:, :3]
    # trimesh takes the linear colors of a GLB as they are.
    np.testing.assert_array_equal(shown, np.rint(255 * linear(mesh.colors)) if suffix == "glb" else mesh.colors)
    assert os.listdir(tmp_path) == [path.name]


def test_ply_contains_the_normals(tmp_path):
    mesh = _sphere()
    save_mesh(mesh, tmp_path / "mesh.ply")
    header, body = (tmp_path / "mesh.ply").read_bytes().split(b"end_header\n", 1)
    assert header.index(b"property float nx") < header.index(b"property uchar red")
    vertex = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
    np.testing.assert_array_equal(np.frombuffer(body, vertex, len(mesh.vertices))["normal"], mesh.normals)


def test_glb_contains_the_normals(tmp_path):
    mesh = _sphere()
    save_mesh(mesh, tmp_path / "mesh.glb")
    assert b'"NORMAL":' in (tmp_path / "mesh.glb").read_bytes()


def test_colors_in_a_glb_are_linear_as_its_format_has_them(tmp_path):
    mesh = _sphere()
    colors = np.resize(np.arange(256, dtype=np.uint8), mesh.colors.shape)
    save_mesh(replace(mesh, colors=colors), tmp_path / "mesh.glb")
    content = (tmp_path / "mesh.glb").read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + length])
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"]) == (5126, "VEC3")
    start = 28 + length + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    stored = np.frombuffer(content, "<f4", colors.size, start).reshape(-1, 3)
    np.testing.assert_allclose(stored, linear(colors), rtol=1e-6)
    np.testing.assert_array_equal(load_mesh(tmp_path / "mesh.glb").colors, colors)


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj"])
def test_files_are_reproducible(suffix, tmp_path):
    paths = [tmp_path / f"{name}.{suffix}" for name in "ab"]
    for path in paths:
        save_mesh(_sphere(), path)
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_empty_mesh(tmp_path):
    save_mesh(_empty(), tmp_path / "mesh.ply")
    assert b"element vertex 0" in (tmp_path / "mesh.ply").read_bytes()
    for suffix in ("glb", "obj"):
        with pytest.raises(OutputError, match=rf"mesh\.{suffix}: a mesh without faces can be written as \.ply only"):
            save_mesh(_empty(), tmp_path / f"mesh.{suffix}")
    assert os.listdir(tmp_path) == ["mesh.ply"]


@pytest.mark.parametrize("name,shown", [("mesh.stl", r"got \.stl"), ("mesh", "got a file without suffix")])
def test_unknown_suffix(name, shown, tmp_path):
    with pytest.raises(OutputError, match=rf"a mesh must be written as \.ply, \.glb, \.obj, {shown}"):
        save_mesh(_sphere(), tmp_path / name)
    assert os.listdir(tmp_path) == []


def test_missing_folder(tmp_path):
    with pytest.raises(OutputError, match=r"mesh\.ply: can't be written: No such file or directory"):
        save_mesh(_sphere(), tmp_path / "missing" / "mesh.ply")
