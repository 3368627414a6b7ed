"""Extracts a triangle mesh from a map, or from any signed distance field on sparse cells."""

from __future__ import annotations

import math

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.errors import SpslamError
from spslam.meshing.cleaning import face_support, front_facing_in_view, in_large_component
from spslam.meshing.mesh import TriangleMesh, compact, vertex_normals
from spslam.meshing.sdf_sampling import SignedDistance, near_surface, near_surface_parts, sample_blocks
from spslam.scene import Scene

CHUNK_POINTS = 1 << 19
# Of the field, near the surface: 5 GB, a hundred times what a floor of a building needs at 2 cm.
MAX_SAMPLES = 1 << 29
# Blocks near a surface for each of those that a plane passes through, as `near_surface` keeps some on both sides.
_NEAR_BLOCKS = 3
# The learned field is not an exact distance. Where its gradient exceeds this bound, surface could be missed.
MAX_SLOPE = 1.5
MIN_SUPPORT = 0.1
# Smaller connected components are likely noise; 20 cm^2 is a dozen faces at a resolution of 2 cm.
MIN_PART_M2 = 0.002
# Cubes per axis: larger blocks waste samples far from the surface, smaller ones repeat more samples at their borders.
_CUBES_PER_BLOCK = range(4, 8)


def extract_surface(
    cell_coords: torch.Tensor,
    cell_size_m: float,
    resolution_m: float,
    sdf: SignedDistance,
    max_slope: float = MAX_SLOPE,
    chunk_points: int = CHUNK_POINTS,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Extracts the zero level set of a signed distance field within given cells, as one mesh without seams.

    Cells that the surface cannot pass through are discarded by a few samples each; the others are divided into cubes
    for marching cubes. Memory beside the result: about 9 (n + 1)^3 + 500 bytes for each block of n <= 7 cubes per axis
    near the surface, which is 3 to 5 times the size of the mesh, and 40 bytes for each of `chunk_points`.

    Args:
        cell_coords: int32 [M, 3], distinct; cell c fills [c, c + 1] * cell_size_m. The field is sampled only there.
        cell_size_m: edge length of a cell.
        resolution_m: desired edge length of the cubes; a cell is divided into a whole number of them, see
            `cubes_per_cell`.
        sdf: maps float32 points [N, 3] (m) to distances float32 [N] (m, negative inside) and bool [N], whether known.
        max_slope: bound on the gradient of `sdf`; a larger one is safer and slower.
        chunk_points: largest number of points in one call of `sdf`.

    Returns:
        vertices float32 [K, 3] (m) and faces int64 [L, 3], see `ops.marching_cubes`; empty without a zero crossing.
        The same input gives the same bits.

    Raises:
        ValueError: a size that is not positive, or `cell_coords` of another dtype or shape or with repeated rows.
        SpslamError: more than `MAX_SAMPLES` samples would be needed; it names a resolution that fits.
    """
    for name, value in {"cell_size_m": cell_size_m, "resolution_m": resolution_m, "max_slope": max_slope}.items():
        if not value > 0:
            raise ValueError(f"extract_surface: {name} must be positive, got {value}")
    if chunk_points < 1:
        raise ValueError(f"extract_surface: chunk_points must be at least 1, got {chunk_points}")
    if cell_coords.dtype != torch.int32 or cell_coords.dim() != 2 or cell_coords.shape[1] != 3:
        actual = f"{cell_coords.dtype} {list(cell_coords.shape)}"
        raise ValueError(f"extract_surface: cell_coords must be int32 [M, 3], got {actual}")
    coords = near_surface(cell_coords, cell_size_m, sdf, max_slope, chunk_points)
    least_m = _least_resolution_m(max(len(coords), 1), cell_size_m)
    if cell_size_m / resolution_m > MAX_SAMPLES:  # beyond numbers that can be counted with
        raise _too_fine(resolution_m, least_m)
    blocks, per_block = cubes_per_cell(cell_size_m, resolution_m)
    # All parts of one cell are sampled at once.
    if max(len(coords), 1) * blocks**3 > MAX_SAMPLES or blocks**3 > CHUNK_POINTS:
        raise _too_fine(resolution_m, least_m)
    block_size_m = cell_size_m / blocks
    if blocks > 1:
        coords = near_surface_parts(coords, blocks, block_size_m, sdf, max_slope, chunk_points)
    samples = len(coords) * (per_block + 1) ** 3
    if samples > MAX_SAMPLES:
        raise _too_fine(resolution_m, max(least_m, 1.1 * resolution_m * math.sqrt(samples / MAX_SAMPLES)))
    values = sample_blocks(coords, block_size_m, per_block, sdf, chunk_points)
    vertices, faces = ops.marching_cubes(coords, values)
    return vertices * block_size_m, faces


def _least_resolution_m(cells: int, cell_size_m: float) -> float:
    """About the smallest resolution, m, at which a surface through so many cells can be extracted."""
    per_block = _CUBES_PER_BLOCK.start
    in_cells, in_one = (MAX_SAMPLES / cells) ** (1 / 3), CHUNK_POINTS ** (1 / 3)
    near = math.sqrt(MAX_SAMPLES / (cells * _NEAR_BLOCKS * (per_block + 1) ** 3))
    return cell_size_m / (per_block * min(in_cells, in_one, near))


def _too_fine(resolution_m: float, least_m: float) -> SpslamError:
    return SpslamError(
        f"a mesh of the map at a resolution of {resolution_m:g} m needs too much memory: the smallest that fits is "
        f"about {least_m:.2g} m (mesh.resolution_m, --resolution)"
    )


def cubes_per_cell(cell_size_m: float, resolution_m: float) -> tuple[int, int]:
    """Blocks per axis that a cell is divided into, and cubes per axis in each block.

    Their product is cell_size_m / resolution_m, rounded. From 8 on it is increased, by at most an eighth, to the next
    number that can be divided into blocks of 4 to 7 cubes.
    """
    cubes = max(round(cell_size_m / resolution_m), 1)
    if cubes < _CUBES_PER_BLOCK.stop:
        return 1, cubes
    while True:
        for per_block in _CUBES_PER_BLOCK:
            if cubes % per_block == 0:
                return cubes // per_block, per_block
        cubes += 1


def extract_mesh(
    scene: Scene,
    resolution_m: float,
    camera: Camera | None = None,
    poses: np.ndarray | None = None,
    min_support: float = MIN_SUPPORT,
    min_part_m2: float = MIN_PART_M2,
) -> TriangleMesh:
    """Extracts the colored mesh of a map, without surface that was never observed.

    The mesh is the zero level set of the map's SDF within the complete cells, cleaned as in `spslam.meshing.cleaning`.

    Args:
        scene: the map. Not changed.
        resolution_m: desired edge length of the cubes, see `extract_surface`.
        camera: intrinsics of the views at `poses`.
        poses: float [F, 4, 4] T_world_camera, the trajectory. With poses and a camera, surface that no view sees from
            the front is removed: second layers behind walls, and extrapolation beyond the image borders.
        min_support: faces are removed where the fusion weight is below this share of the largest weight within one
            voxel, as on fringes behind depth edges. 0 keeps everything.
        min_part_m2: connected components with a smaller area, m^2, are removed.

    Returns:
        The mesh; empty for an empty map. Memory is bounded as in `extract_surface`. The same map gives the same mesh.

    Raises:
        ValueError: `resolution_m` is not positive, or one of `camera` and `poses` is missing.
    """
    if (camera is None) != (poses is None):
        raise ValueError("extract_mesh: camera and poses must be given together, got one of them")
    volume, truncation_m = scene.volume, scene.settings.truncation_m

    def sdf(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        values, known = scene.sdf(points)
        return values * truncation_m, known

    cells = volume.voxel_coords[volume.corner_ids[:, 0] >= 0]
    points, faces = extract_surface(cells, volume.voxel_size_m, resolution_m, sdf)
    if min_support > 0:
        faces = faces[face_support(volume, points, faces, CHUNK_POINTS) >= min_support]
    vertices, kept = points.cpu().numpy(), faces.cpu().numpy()
    normals = vertex_normals(vertices, kept)
    if camera is not None and poses is not None and len(poses):
        kept = kept[front_facing_in_view(vertices, normals, kept, camera, poses)]
    kept = kept[in_large_component(vertices, kept, min_part_m2)]
    kept, used = compact(kept, len(vertices))
    colors = _colors(scene, points[torch.from_numpy(used).to(points.device)])
    return TriangleMesh(vertices[used], kept, colors, normals[used])


def _colors(scene: Scene, points: torch.Tensor) -> np.ndarray:
    """RGB uint8 [N, 3] at points."""
    colors = [np.zeros((0, 3), dtype=np.uint8)]
    for chunk in points.split(CHUNK_POINTS):
        colors.append((scene.color(chunk) * 255).round().clamp(0, 255).to(torch.uint8).cpu().numpy())
    return np.concatenate(colors)
