"""A mesh as binary glTF, small and fast to write, for the browser.

Not by trimesh, which takes ten times as long and writes colors as they are: glTF has them linear, so they would come
out too light.
"""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from spslam.meshing.mesh import TriangleMesh


_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_ARRAY, _INDICES = 34962, 34963
_GAMMA = 2.2
_LINEAR = np.round(65535 * (np.arange(256) / 255) ** _GAMMA).astype("<u2")


def to_glb(mesh: TriangleMesh) -> bytes:
    """One glTF 2.0 file with vertex colors and normals; its back faces are not drawn.

    Args:
        mesh: with at least one face.
    """
    count = len(mesh.vertices)
    colors = np.full((count, 4), 65535, "<u2")
    colors[:, :3] = _LINEAR[mesh.colors]
    indices = mesh.faces.astype("<u2" if count < 65535 else "<u4")
    blocks = [
        mesh.vertices.astype("<f4").tobytes(),
        mesh.normals.astype("<f4").tobytes(),
        colors.tobytes(),
        indices.tobytes(),
    ]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    accessors = [
        {"type": "VEC3", "componentType": _FLOAT, "min": low.tolist(), "max": high.tolist()},
        {"type": "VEC3", "componentType": _FLOAT},
        {"type": "VEC4", "componentType": _USHORT, "normalized": True},
        {"type": "SCALAR", "componentType": _USHORT if indices.itemsize == 2 else _UINT},
    ]
    offsets = np.cumsum([0, *(len(block) for block in blocks)]).tolist()
    views: list[dict] = [
        {"buffer": 0, "byteOffset": offset, "byteLength": len(block), "target": _ARRAY}
        for offset, block in zip(offsets, blocks, strict=False)
    ]
    views[3]["target"] = _INDICES
    for number, accessor in enumerate(accessors):
        accessor |= {"bufferView": number, "count": indices.size if number == 3 else count}
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}
    content = {
        "asset": {"version": "2.0", "generator": "spslam"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offsets[-1] + -offsets[-1] % 4}],
    }
    head = json.dumps(content, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    body = b"".join(blocks)
    body += b"\0" * (-len(body) % 4)
    total = 12 + 8 + len(head) + 8 + len(body)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, total),
            struct.pack("<I4s", len(head), b"JSON"),
            head,
            struct.pack("<I4s", len(body), b"BIN\0"),
            body,
        ]
    )
