"""Meshes of any origin: those that are written here come back, and what can't be a mesh is one line."""

import json
import struct

import numpy as np
import pytest
import trimesh

from spslam.errors import DatasetError
from spslam.evaluation.surface import TriangleSurface
from spslam.meshing import TriangleMesh, load_mesh, save_mesh
from spslam.meshing.load import READ_FORMATS
from spslam.meshing.ply import decode_own_ply

CUBE = trimesh.creation.box()


def save(path, vertices=CUBE.vertices, faces=CUBE.faces):
    """Writes a mesh with one color in any format."""
    mesh = trimesh.Trimesh(vertices, faces, process=False, vertex_colors=np.full((len(vertices), 4), 200, np.uint8))
    content = mesh.export(file_type=path.suffix[1:])
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("suffix", READ_FORMATS)
def test_formats(tmp_path, suffix):
    mesh = load_mesh(save(tmp_path / f"mesh{suffix}"))
    assert (mesh.vertices.dtype, mesh.faces.dtype, mesh.colors.dtype) == (np.float64, np.int64, np.uint8)
    assert len(mesh.faces) == 12
    surface = TriangleSurface.load(tmp_path / f"mesh{suffix}")
    assert trimesh.Trimesh(*surface.triangles(), process=False).area == pytest.approx(6)
    assert mesh.colors.shape == mesh.vertices.shape


def test_a_written_mesh_comes_back(tmp_path):
    vertices = CUBE.vertices.astype(np.float32)
    colors = np.arange(3 * len(vertices), dtype=np.uint8).reshape(-1, 3)
    mesh = TriangleMesh(vertices, CUBE.faces.astype(np.int32), colors, np.zeros_like(vertices))
    for suffix in ("ply", "obj", "glb"):
        save_mesh(mesh, tmp_path / f"mesh.{suffix}")
        loaded = load_mesh(tmp_path / f"mesh.{suffix}")
        np.testing.assert_array_equal(loaded.vertices, vertices)
        np.testing.assert_array_equal(loaded.faces, CUBE.faces)
        np.testing.assert_array_equal(loaded.colors, colors)


def test_a_glb_that_is_nearly_one_written_here_is_read_as_any_other(tmp_path):
    vertices = CUBE.vertices.astype(np.float32)
    faces, colors = CUBE.faces.astype(np.int32), np.full((len(vertices), 3), 128, np.uint8)
    path = tmp_path / "mesh.glb"
    save_mesh(TriangleMesh(vertices, faces, colors, np.zeros_like(vertices)), path)
    content = path.read_bytes()
    path.write_bytes(content.replace(b'"generator":"spslam"', b'"generator":"others"'))
    loaded = load_mesh(path)
    np.testing.assert_array_equal(loaded.faces, CUBE.faces)
    assert (loaded.colors == 55).all()  # linear, as trimesh reads them
    for damaged in (content[:100], content[:-4], content[:20] + b"[" * 400 + content[420:]):
        path.write_bytes(damaged)
        refused(path, "can't be read as a mesh: ")


def refused(path, message):
    for load in (load_mesh, TriangleSurface.load):
        with pytest.raises(DatasetError, match=f"{path.name}: .*{message}") as error:
            load(path)
        assert "\n" not in str(error.value)


PLY = """ply
format {form} 1.0
element vertex {vertices}
property float x
property float y
property float z
element face {faces}
property list uchar int vertex_indices
end_header
"""


def ply(path, form="ascii", vertices=3, faces=1, body=b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"):
    path.write_bytes(PLY.format(form=form, vertices=vertices, faces=faces).encode() + body)
    return path


def test_a_ply_written_here_is_read_as_trimesh_does(tmp_path, monkeypatch):
    generator = np.random.default_rng(0)
    vertices = generator.normal(size=(len(CUBE.vertices), 3)).astype(np.float32)
    colors = generator.integers(0, 256, (len(vertices), 3), np.uint8)
    path = tmp_path / "mesh.ply"
    save_mesh(TriangleMesh(vertices, CUBE.faces.astype(np.int32), colors, -vertices), path)
    other = tmp_path / "other.ply"
    other.write_bytes(path.read_bytes().replace(b"ply\n", b"ply\ncomment another program's\n", 1))
    assert decode_own_ply(other.read_bytes()) is None
    expected = load_mesh(other)
    monkeypatch.setattr(trimesh, "load", lambda *arguments, **options: pytest.fail("not needed"))
    mesh = load_mesh(path)
    for name in ("vertices", "faces", "colors"):
        assert np.array_equal(getattr(mesh, name), getattr(expected, name))
        assert getattr(mesh, name).dtype == getattr(expected, name).dtype


@pytest.mark.parametrize("change", [lambda content: content[:-1], lambda content: content + b"\0"])
def test_a_ply_that_was_cut_is_left_to_trimesh(tmp_path, change):
    path = tmp_path / "mesh.ply"
    zeros = np.zeros_like(CUBE.vertices, np.float32)
    colors = np.zeros((len(zeros), 3), np.uint8)
    save_mesh(TriangleMesh(CUBE.vertices.astype(np.float32), CUBE.faces.astype(np.int32), colors, zeros), path)
    assert decode_own_ply(change(path.read_bytes())) is None


@pytest.mark.parametrize("index", [3, -1, 2**31 - 1, -(2**31)])
def test_a_face_that_names_no_vertex_is_refused(tmp_path, index):
    text = f"0 0 0\n1 0 0\n0 1 0\n3 0 1 {index}\n".encode()
    refused(ply(tmp_path / "a.ply", body=text), "faces must index 3 vertices")
    binary = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<B3i", 3, 0, 1, index)
    refused(ply(tmp_path / "b.ply", "binary_little_endian", body=binary), "faces must index 3 vertices")
    if index == 3:
        (tmp_path / "c.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n")
        refused(tmp_path / "c.obj", "")


@pytest.mark.parametrize("number", ["nan", "inf", "1e300", "-1e7"])
def test_coordinates_that_are_none_are_refused(tmp_path, number):
    body = f"0 0 0\n1 0 0\n0 1 {number}\n3 0 1 2\n".encode()
    refused(ply(tmp_path / "a.ply", body=body), "coordinates must be finite and within 1e.06 m of the origin")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("name", ["vertices", "faces"])
@pytest.mark.parametrize(
    "count", ["1000000000000", "9" * 40, "-5", "many"], ids=["large", "digits", "negative", "text"]
)
def test_counts_beyond_the_file_are_not_believed(tmp_path, form, name, count):
    message = "invalid literal for int" if count == "many" else "it announces -?[0-9]+ "
    refused(ply(tmp_path / "a.ply", form, **{name: count}), message)


def test_files_that_are_no_meshes_are_refused(tmp_path):
    for name, content in {
        "a.ply": b"",
        "b.ply": b"ply\nformat ascii 1.0\n",
        "c.glb": b"glTF" + bytes(40),
        "d.obj": b"\xff\xfe\0\0",
        "e.stl": struct.pack("<80sI", b"", 2**32 - 1),
        "f.off": b"OFF\n3 1000000000000 0\n",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DatasetError, match=name):
            TriangleSurface.load(tmp_path / name)
    refused(tmp_path / "absent.ply", "no such file")
    (tmp_path / "mesh.zip").write_bytes(b"PK")
    refused(tmp_path / "mesh.zip", "a mesh must be one of .ply, .obj, .glb, .stl, .off, got .zip")


def test_ground_truth_has_an_area(tmp_path):
    path = save(tmp_path / "flat.ply", 0 * CUBE.vertices, CUBE.faces)
    with pytest.raises(DatasetError, match=r"flat.ply: must be a mesh with an area, but none of 12 faces has one"):
        TriangleSurface.load(path)


def test_a_file_that_names_others_is_read_alone(tmp_path):
    (tmp_path / "a.obj").write_text("mtllib /etc/passwd\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert len(load_mesh(tmp_path / "a.obj").faces) == 1


def test_a_scene_that_names_one_mesh_many_times_is_refused(tmp_path):
    ball = trimesh.creation.icosphere(4)
    content = save(tmp_path / "a.glb", ball.vertices, ball.faces).read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    tree = json.loads(content[20 : 20 + length])
    mesh = next(node["mesh"] for node in tree["nodes"] if "mesh" in node)
    tree["nodes"] = [{"name": f"n{i}", "mesh": mesh} for i in range(1000)]
    tree["scenes"] = [{"nodes": list(range(1000))}]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + content[20 + length :]
    (tmp_path / "a.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    refused(tmp_path / "a.glb", "bytes and 5120000 faces")


def test_a_mesh_in_millimeters_is_too_large_to_measure_distances_to(tmp_path):
    """Eight thousand faces of a square meter in millimeters would be looked up at a billion places."""
    mesh = trimesh.creation.box().subdivide().subdivide().subdivide().subdivide().subdivide()
    surface = TriangleSurface.load(save(tmp_path / "a.ply", 1e5 * mesh.vertices, mesh.faces))
    with pytest.raises(DatasetError, match="a mesh of 12288 faces and .* m2 is too large .* is it in meters"):
        surface.distance(np.zeros((1, 3)))
