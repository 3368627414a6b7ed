"""Files of textured meshes: what another program reads of them, and what is left where writing fails."""

import os

import numpy as np
import pytest
import trimesh

from spslam.errors import OutputError
from spslam.io import atomic_write_all
from spslam.meshing import load_mesh
from spslam.meshing.texture import TexturedMesh, save_textured_mesh

# Two triangles on two pages.
PLACES = np.array([(0.1, 0.2), (0.9, 0.2), (0.9, 0.8), (0.1, 0.2), (0.9, 0.8), (0.1, 0.8)], np.float32)


def textured():
    vertices = np.array([(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 0, 1), (1, 1, 1), (0, 1, 1)], np.float32)
    faces, normals = np.arange(6, dtype=np.int32).reshape(2, 3), np.tile(np.float32([0, 0, -1]), (6, 1))
    pages = np.random.default_rng(0).integers(0, 255, (2, 24, 32, 3)).astype(np.uint8)
    return TexturedMesh(vertices, faces, normals, PLACES, np.array([0, 1], np.int32), pages, 0.01, 0.01)


def parts(path):
    """The geometries that trimesh reads, in the order of their pages, and their images."""
    loaded = trimesh.load(path, process=False)
    shapes = sorted(loaded.geometry.values(), key=lambda shape: shape.visual.material.name)
    images = []
    for shape in shapes:
        material = shape.visual.material
        image = material.baseColorTexture if hasattr(material, "baseColorTexture") else material.image
        images.append(np.asarray(image.convert("RGB")))
    return shapes, images


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_another_program_reads_texture_coordinates_and_images(tmp_path, suffix):
    mesh = textured()
    mesh.save(tmp_path / f"wall.{suffix}")
    shapes, images = parts(tmp_path / f"wall.{suffix}")
    assert len(shapes) == 2
    for page, (shape, image) in enumerate(zip(shapes, images, strict=True)):
        np.testing.assert_array_equal(image, mesh.pages[page])
        (face,) = shape.faces
        np.testing.assert_allclose(shape.vertices[face], mesh.vertices[mesh.faces[page]], atol=1e-5)
        # trimesh's coordinates begin at the lower left.
        expected = mesh.places[mesh.faces[page]] * (1, -1) + (0, 1)
        np.testing.assert_allclose(shape.visual.uv[face], expected, atol=1e-5)
    assert len(load_mesh(tmp_path / f"wall.{suffix}").faces) == 2


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_the_same_mesh_gives_the_same_bytes(tmp_path, suffix):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        textured().save(tmp_path / folder / f"wall.{suffix}")
    one, two = ({path.name: path.read_bytes() for path in (tmp_path / folder).iterdir()} for folder in ("one", "two"))
    assert one == two
    assert set(one) == ({"wall.glb"} if suffix == "glb" else {"wall.obj", "wall.mtl", "wall-0.png", "wall-1.png"})


def test_colors_between_texels_are_bilinear():
    mesh = textured()
    at_corner = mesh.colors_at(np.array([1]), np.array([[1, 0, 0]], np.float32))[0]
    x, y = PLACES[3] * (32, 24) - 0.5
    i, j, a, b = int(x), int(y), x % 1, y % 1
    page = mesh.pages[1].astype(float)
    rows = (1 - a) * page[j : j + 2, i] + a * page[j : j + 2, i + 1]
    np.testing.assert_allclose(at_corner, (1 - b) * rows[0] + b * rows[1], atol=3)


@pytest.mark.parametrize("name", ["wall.ply", "wall.stl", "wall"])
def test_other_formats_are_refused(tmp_path, name):
    with pytest.raises(OutputError, match=r"a mesh with a texture must be written as .glb or .obj, got"):
        save_textured_mesh(textured(), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_mesh_without_faces_is_refused(tmp_path):
    mesh = textured()
    empty = TexturedMesh(
        mesh.vertices[:0], mesh.faces[:0], mesh.normals[:0], mesh.places[:0], mesh.page_of[:0], mesh.pages, 0.01, 0.01
    )
    with pytest.raises(OutputError, match="without faces"):
        empty.save(tmp_path / "wall.glb")


@pytest.mark.parametrize("survived", [0, 1, 2, 3])
def test_what_is_cut_off_leaves_no_mesh_with_images_of_another(tmp_path, monkeypatch, survived):
    """Cut off after some files were renamed, the last of which names the others."""
    names = ["wall-0.png", "wall-1.png", "wall.mtl", "wall.obj"]
    atomic_write_all({tmp_path / name: b"old " + name.encode() for name in names})
    replace, done = os.replace, []

    def cut_off(source, target):
        if len(done) == survived:
            raise OSError("cut off")
        done.append(target)
        replace(source, target)

    monkeypatch.setattr(os, "replace", cut_off)
    with pytest.raises(OutputError, match=r"wall.obj: can't be written"):
        atomic_write_all({tmp_path / name: b"new " + name.encode() for name in names})
    left = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(left) == set(names[:3])
    assert all(content in (b"old " + name.encode(), b"new " + name.encode()) for name, content in left.items())


def test_nothing_changes_where_a_file_cannot_be_made(tmp_path, monkeypatch):
    names = ["wall-0.png", "wall.mtl", "wall.obj"]
    atomic_write_all({tmp_path / name: b"old" for name in names})

    def full(path, content):
        if path.suffix == ".obj":
            raise OSError(28, "No space left on device")
        path.write_bytes(content)

    monkeypatch.setattr("spslam.io._write", full)
    with pytest.raises(OutputError, match=r"wall.obj: can't be written: No space left on device"):
        atomic_write_all({tmp_path / name: b"new" for name in names})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(names, b"old")
