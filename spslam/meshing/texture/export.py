"""Writes textured meshes as GLB, or as OBJ with its materials and images."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spslam.errors import OutputError
from spslam.io import atomic_write, atomic_write_all
from spslam.meshing.glb import FLOAT, INDICES, UINT, VERTEX_DATA, GlbBinary, encode_document
from spslam.meshing.texture.textured_mesh import TexturedMesh
from spslam.run_folder import TEXTURED_FORMATS

_SUFFIXES = tuple(f".{name}" for name in TEXTURED_FORMATS)
# Of PNG, 0 to 9: the first gives nearly the size of the last at a third of the time.
_COMPRESSION = 3
# Numbers of the glTF 2.0 specification.
_LINEAR, _LINEAR_MIPMAPS, _CLAMP = 9729, 9987, 33071


def check_textured_format(path: Path) -> None:
    """Raises OutputError where a file of this name can't have a texture."""
    if path.suffix.lower() not in _SUFFIXES:
        known = " or ".join(_SUFFIXES)
        raise OutputError(f"{path}: a mesh with a texture must be written as {known}, got {path.suffix or 'no suffix'}")


def save_textured_mesh(mesh: TexturedMesh, path: str | os.PathLike) -> None:
    """Writes a textured mesh; the same mesh gives the same bytes.

    Args:
        mesh: with at least one face.
        path: `.glb` (glTF 2.0, one file; axes are not changed, and colors are shown without light by programs that know
            KHR_materials_unlit), or `.obj`. For NAME.obj also NAME.mtl and NAME-0.png, NAME-1.png, ... are written. All
            are complete before the first is renamed, and a NAME.obj from before is removed before that, so it never
            goes with images of another.

    Raises:
        OutputError: another suffix, a mesh without faces, or the operating system refuses.
    """
    path = Path(path)
    check_textured_format(path)
    if not len(mesh.faces):
        raise OutputError(f"{path}: a mesh without faces can't have a texture")
    images = [_png(page) for page in mesh.pages]
    if path.suffix.lower() == ".glb":
        atomic_write(path, _glb(mesh, images))
        return
    names = [f"{path.stem}-{page}.png" for page in range(len(images))]
    materials = path.with_suffix(".mtl")
    files: dict[Path, bytes] = {path.with_name(name): image for name, image in zip(names, images, strict=True)}
    files[materials] = _mtl(names).encode()
    files[path] = _obj(mesh, materials.name).encode()
    atomic_write_all(files)


def _png(page: np.ndarray) -> bytes:
    done, content = cv2.imencode(".png", page[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])
    if not done:
        raise OutputError(f"a texture of {page.shape[1]}x{page.shape[0]} px can't be encoded as PNG")
    return content.tobytes()


def _mtl(names: list[str]) -> str:
    parts = (
        f"newmtl page{page}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {name}\n" for page, name in enumerate(names)
    )
    return "\n".join(parts)


def _obj(mesh: TexturedMesh, materials: str) -> str:
    """Lines of an OBJ file, whose texture coordinates begin at the lower left and whose indices at 1."""
    places = np.stack([mesh.places[:, 0], 1 - mesh.places[:, 1]], axis=1)
    lines = [f"mtllib {materials}\n"]
    for name, rows, digits in (("v", mesh.vertices, 5), ("vt", places, 6), ("vn", mesh.normals, 3)):
        row = f"{name} " + " ".join([f"%.{digits}f"] * rows.shape[1]) + "\n"
        lines.append((row * len(rows)) % tuple(rows.ravel().tolist()))
    for page in range(len(mesh.pages)):
        faces = mesh.faces[mesh.page_of == page] + 1
        lines.append(f"usemtl page{page}\n")
        lines.append(("f %d/%d/%d %d/%d/%d %d/%d/%d\n" * len(faces)) % tuple(np.repeat(faces.ravel(), 3).tolist()))
    return "".join(lines)


def _glb(mesh: TexturedMesh, images: list[bytes]) -> bytes:
    """A binary glTF 2.0: all pages share the vertices, each has its material and its faces."""
    binary = GlbBinary()
    attributes = {
        "POSITION": binary.positions(mesh.vertices),
        "NORMAL": binary.accessor(mesh.normals.astype("<f4"), FLOAT, "VEC3", VERTEX_DATA),
        "TEXCOORD_0": binary.accessor(mesh.places.astype("<f4"), FLOAT, "VEC2", VERTEX_DATA),
    }
    primitives = []
    for page in range(len(images)):
        faces = mesh.faces[mesh.page_of == page].astype("<u4").reshape(-1, 1)
        if len(faces):
            indices = binary.accessor(faces, UINT, "SCALAR", INDICES)
            primitives.append({"attributes": attributes, "indices": indices, "material": page})
    more = {
        "materials": [_material(page) for page in range(len(images))],
        "textures": [{"sampler": 0, "source": page} for page in range(len(images))],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": [{"mimeType": "image/png", "bufferView": binary.view(image)} for image in images],
        "extensionsUsed": ["KHR_materials_unlit"],
    }
    return encode_document(primitives, binary, more)


def _material(page: int) -> dict[str, Any]:
    surface = {"baseColorTexture": {"index": page}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": f"page{page}", "pbrMetallicRoughness": surface, "extensions": {"KHR_materials_unlit": {}}}
