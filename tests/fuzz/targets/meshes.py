"""Meshes: PLY (text and binary), OBJ, GLB, STL and OFF."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from random import Random

import numpy as np
import trimesh

from spslam.evaluation.surface import TriangleSurface
from tests.fuzz.formats import Format
from tests.fuzz.mutations import mutate_bytes, mutate_text, to_bytes
from tests.fuzz.structures import mutate_value

CUBE = trimesh.creation.box()
COLORED = trimesh.Trimesh(CUBE.vertices, CUBE.faces, process=False, vertex_colors=np.full((8, 4), 200, np.uint8))
BALL = trimesh.creation.icosphere(1)


def exported(mesh: trimesh.Trimesh, suffix: str, **options) -> bytes:
    """A mesh's file."""
    content = mesh.export(file_type=suffix, **options)
    return content if isinstance(content, bytes) else content.encode()


class _Mesh(Format):
    """A mesh as ground truth: points are sampled on it and distances measured to it."""

    suffix: str
    examples: tuple[bytes, ...]
    POINTS = np.array([[0.0, 0, 0], [1, 1, 1], [1e5, 0, 0]])

    def write(self, random: Random, folder: Path) -> None:
        (folder / f"mesh.{self.suffix}").write_bytes(self.spoiled(random, random.choice(self.examples)))

    def spoiled(self, random: Random, content: bytes) -> bytes:
        return mutate_bytes(random, content, self.examples)

    def read(self, folder: Path) -> None:
        surface = TriangleSurface.load(folder / f"mesh.{self.suffix}")
        surface.sample_surface(50)
        surface.distance(self.POINTS)


class _TextMesh(_Mesh):
    """A mesh that is a text."""

    def spoiled(self, random: Random, content: bytes) -> bytes:
        if random.random() < 0.2:
            return super().spoiled(random, content)
        return to_bytes(mutate_text(random, content.decode("utf-8", "surrogateescape")))


class Ply(_Mesh):
    """PLY: bytes, the words of its header, and the numbers of a text."""

    name, suffix = "ply", "ply"
    examples = (
        exported(CUBE, "ply"),
        exported(COLORED, "ply"),
        exported(CUBE, "ply", encoding="ascii"),
        exported(BALL, "ply"),
    )
    WORDS = ("ascii", "binary_little_endian", "binary_big_endian", "vertex", "face", "edge", "x", "list", "element")
    WORDS += (
        "property",
        "uchar",
        "int",
        "uint64",
        "float",
        "double",
        "int8",
        "vertex_indices",
        "texture",
        "1000000000000",
    )

    def spoiled(self, random: Random, content: bytes) -> bytes:
        if random.random() < 0.4:
            return super().spoiled(random, content)
        head, end, body = content.partition(b"end_header\n")
        words = head.decode().split(" ")
        for _ in range(random.choice((1, 1, 2))):
            words[random.randrange(len(words))] = random.choice(self.WORDS)
        text = " ".join(words) if random.random() < 0.5 else mutate_text(random, head.decode())
        return to_bytes(text) + end + body


class Obj(_TextMesh):
    """OBJ: a text."""

    name, suffix = "obj", "obj"
    extras = b"mtllib ../../../etc/passwd\nusemtl a\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\ns off\no a\ng b\n"
    examples = (exported(CUBE, "obj"), exported(COLORED, "obj"), exported(CUBE, "obj") + extras)


class Off(_TextMesh):
    """OFF: a text."""

    name, suffix = "off", "off"
    examples = (exported(CUBE, "off"), exported(BALL, "off"))


class Stl(_Mesh):
    """STL: bytes, or a text."""

    name, suffix = "stl", "stl"
    examples = (exported(CUBE, "stl"), exported(CUBE, "stl_ascii"))


class Glb(_Mesh):
    """GLB: bytes, and its JSON."""

    name, suffix = "glb", "glb"
    examples = (exported(CUBE, "glb"), exported(COLORED, "glb"), exported(BALL, "glb"))

    def spoiled(self, random: Random, content: bytes) -> bytes:
        if random.random() < 0.3:
            return super().spoiled(random, content)
        (length,) = struct.unpack_from("<I", content, 12)
        tree = mutate_value(random, json.loads(content[20 : 20 + length]))
        text = to_bytes(mutate_text(random, json.dumps(tree))) if random.random() < 0.2 else json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<I4s", len(text), b"JSON") + text + content[20 + length :]
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


FORMATS = (Ply(), Obj(), Off(), Stl(), Glb())
