"""The mesh of a map that grows: extracted in chunks, of which only those are made again that changed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import torch

from spslam.camera import Camera
from spslam.meshing.cleaning import face_support, front_facing_in_view
from spslam.meshing.extract import CHUNK_POINTS, MIN_SUPPORT, extract_surface
from spslam.meshing.mesh import TriangleMesh, compact, vertex_normals
from spslam.scene import Scene
from spslam.viewer.sink import Key

CHUNK_M = 1.5  # about; a whole number of voxels
# Of all chunks, so many beside the changed ones are made again at each update: decoders change everywhere, slowly.
_REFRESHED_SHARE = 0.2
# Changes of a chunk's summed fusion weights below this share are no new observation.
_SAME_SHARE = 1e-4
# Of a code, for each axis.
_BITS, _HALF = 21, 1 << 20


class LiveMesh:
    """Keeps the mesh of a map in cubes of `CHUNK_M`.

    Args:
        camera: intrinsics of the frames.
        resolution_m: edge length of a marching-cubes cell.
    """

    def __init__(self, camera: Camera, resolution_m: float):
        self._camera, self._resolution_m = camera, resolution_m
        self._weights: dict[Key, float] = {}
        self._ages: dict[Key, int] = {}
        self._round = 0
        self.chunks: dict[Key, TriangleMesh] = {}

    def update(self, scene: Scene, poses: np.ndarray, everything: bool = False) -> dict[Key, TriangleMesh | None]:
        """Makes the chunks again that changed since the last call, and the oldest of the others.

        Args:
            scene: the map.
            poses: float64 [F, 4, 4] T_world_camera of the frames with a trusted pose.
            everything: whether to make all again.

        Returns:
            The chunks made: a mesh, or None where there is no surface any more, as where a map that the keyframe graph
            made again has no cell.
        """
        self._round += 1
        volume = scene.volume
        complete = volume.corner_ids[:, 0] >= 0
        cells = volume.voxel_coords[complete]
        per_chunk = max(round(CHUNK_M / volume.voxel_size_m), 1)
        codes, owner = np.unique(_codes(cells.numpy() // per_chunk), return_inverse=True)
        weights = np.bincount(owner, volume.weights[complete].numpy(), len(codes))
        present = [_key(int(code)) for code in codes]
        gone = self._drop_all_but(present)
        chosen = self._choose(present, weights, everything)
        if not chosen:
            return gone
        wanted = np.array(sorted(chosen))
        selected = cells[torch.from_numpy(_touches(cells.numpy(), per_chunk, wanted))]
        made = dict(split_mesh(self._extract(scene, selected, poses), wanted, per_chunk * volume.voxel_size_m))
        for key in chosen:
            self._ages[key] = self._round
            if key in made:
                self.chunks[key] = made[key]
            else:
                self.chunks.pop(key, None)
        return gone | {key: made.get(key) for key in chosen}

    def merged(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All chunks as one mesh: float32 vertices [V, 3], integer faces [L, 3], uint8 colors [V, 3]."""
        meshes = list(self.chunks.values())
        if not meshes:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.uint8)
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
        faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
        vertices = np.concatenate([mesh.vertices for mesh in meshes])
        return vertices, np.concatenate(faces), np.concatenate([mesh.colors for mesh in meshes])

    def _drop_all_but(self, present: list[Key]) -> dict[Key, TriangleMesh | None]:
        """Forgets the other chunks; returns those that had a mesh, as chunks without surface."""
        gone: dict[Key, TriangleMesh | None] = dict.fromkeys(self.chunks.keys() - set(present))
        for key in self._ages.keys() - set(present):
            del self._ages[key]
            self.chunks.pop(key, None)
        return gone

    def _choose(self, present: list[Key], weights: np.ndarray, everything: bool) -> set[Key]:
        old = {key: self._weights.get(key, 0.0) for key in present}
        changed = {
            key
            for key, weight in zip(present, weights.tolist(), strict=True)
            if everything or abs(weight - old[key]) > _SAME_SHARE * max(weight, 1.0)
        }
        self._weights = dict(zip(present, weights.tolist(), strict=True))
        others = sorted((key for key in present if key not in changed), key=lambda key: self._ages.get(key, 0))
        return changed | set(others[: int(np.ceil(_REFRESHED_SHARE * len(present)))])

    def _extract(self, scene: Scene, cells: torch.Tensor, poses: np.ndarray) -> TriangleMesh:
        truncation_m = scene.settings.truncation_m

        def sdf(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            values, known = scene.sdf(points)
            return values * truncation_m, known

        points, faces = extract_surface(cells, scene.volume.voxel_size_m, self._resolution_m, sdf)
        faces = faces[face_support(scene.volume, points, faces, CHUNK_POINTS) >= MIN_SUPPORT]
        vertices, kept = points.numpy(), faces.numpy()
        normals = vertex_normals(vertices, kept)
        if len(poses) and len(kept):
            kept = kept[front_facing_in_view(vertices, normals, kept, self._camera, poses)]
        kept, used = compact(kept, len(vertices))
        colors = (scene.color(points[torch.from_numpy(used)]) * 255).round().clamp(0, 255).to(torch.uint8).numpy()
        return TriangleMesh(vertices[used], kept, colors.reshape(-1, 3), normals[used])


def split_mesh(mesh: TriangleMesh, wanted: np.ndarray, chunk_m: float) -> Iterator[tuple[Key, TriangleMesh]]:
    """The faces of a mesh by the chunk that their middle lies in, for the wanted chunks."""
    if not len(mesh.faces):
        return
    owner = _codes(np.floor(mesh.vertices[mesh.faces].mean(axis=1) / chunk_m))
    for code in _codes(wanted):
        inside = mesh.faces[owner == code]
        if len(inside):
            faces, used = compact(inside, len(mesh.vertices))
            part = TriangleMesh(mesh.vertices[used], faces, mesh.colors[used], mesh.normals[used])
            yield _key(int(code)), part


def _touches(coords: np.ndarray, per_chunk: int, wanted: np.ndarray) -> np.ndarray:
    """bool [N]: whether a cell, or one beside it, lies in a wanted chunk; so normals have their neighbors."""
    found = np.zeros(len(coords), dtype=bool)
    codes = _codes(wanted)
    for offset in itertools.product((-1, 1), repeat=3):
        found |= np.isin(_codes((coords + np.array(offset)) // per_chunk), codes)
    return found


def _codes(keys: np.ndarray) -> np.ndarray:
    """One integer per chunk; chunks lie within 2^20 of the origin along each axis, as vertices do."""
    shifted = keys.astype(np.int64) + _HALF
    return (shifted[:, 0] << 2 * _BITS) | (shifted[:, 1] << _BITS) | shifted[:, 2]


def _key(code: int) -> Key:
    """The chunk of a code."""
    mask = (1 << _BITS) - 1
    return (code >> 2 * _BITS) - _HALF, (code >> _BITS & mask) - _HALF, (code & mask) - _HALF
