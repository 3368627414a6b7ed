"""The mesh of a fused signed distance field, with a map filling in where no frame measured anything.

Both are sampled on one lattice of voxels, so the surface is extracted once and has no seam. Next to measured voxels the
map is moved to agree with them: the difference, averaged over its cells, is added to it and fades within a cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.meshing.cleaning import face_support, front_facing_in_view
from spslam.meshing.depth_views import DepthViews, Looks
from spslam.meshing.extract import CHUNK_POINTS, MIN_PART_M2, MIN_SUPPORT
from spslam.meshing.mesh import TriangleMesh, compact, component_areas, vertex_normals
from spslam.meshing.scene_filling import fill_with_scene
from spslam.ops.tsdf_volume import march_blocks
from spslam.scene import Scene

# A voxel is known from this weight on, with which its mean is known to some 5 cm (`_DEVIATION_M` over its root).
MIN_WEIGHT = 0.003
# And from this share of the largest weight nearby.
MIN_SHARE = 0.01
# A signed distance changes by no more than a voxel from one voxel to the next. Where it changes by more than the
# truncation of certain depth, two voxels as a rule, and the voxel behind is more than this share of that behind a
# surface, each was measured against another surface: what seems to lie between is a fringe, in the shadow of an edge.
# Noise alone does this where few or slanted views saw a surface, so the voxel must be behind by so many deviations of
# its mean more, that of a measurement of weight 1 being `_DEVIATION_M`, the s of `ops.measure_planes`. With this share
# of the largest weight nearby it counts as the side of a thing.
FRINGE_DEPTH, FRINGE_DEVIATIONS, FRINGE_SHARE = 0.5, 0.5, 0.3
_DEVIATION_M = 0.003
# Where it changes by more than so many voxels, which noise makes it do too, views are asked: see `_contradicted`.
STEEP_VOXELS = 1.25
# A small part stays if so much of its area is known to a voxel, and seen by views.
CONFIRMED_SHARE = 0.3
# From so many corners on a face is part of a fringe. With one it is the border of a surface, less than a voxel wide.
_FRINGE_CORNERS = 2
# A coordinate this close to a whole number of voxels is one: float32, at 100 m of 1 cm.
_LATTICE = 1e-3


def extract_fused_mesh(
    volume: ops.TsdfVolume,
    scene: Scene | None = None,
    camera: Camera | None = None,
    poses: np.ndarray | None = None,
    min_part_m2: float = MIN_PART_M2,
    views: DepthViews | None = None,
) -> TriangleMesh:
    """Extracts the colored mesh of a fused volume, and of a map where nothing was fused.

    Args:
        volume: fused frames. Not changed.
        scene: a map of the same frames in the same world; None leaves holes where nothing was measured.
        camera: intrinsics of the views at `poses`.
        poses: float [F, 4, 4] T_world_camera. Surface of the map that no view sees from the front is left out.
        min_part_m2: connected components with a smaller area, m^2, are removed, unless they are known well and views
            confirm them. A part that only the removal of fringes cuts off stays.
        views: of the same frames, as they were shown; faces that these contradict are left out too.

    Returns:
        The mesh; empty for an empty volume. The same input gives the same mesh.

    Raises:
        ValueError: one of `camera` and `poses` is missing.
    """
    if (camera is None) != (poses is None):
        raise ValueError("extract_fused_mesh: camera and poses must be given together, got one of them")
    largest = volume.least_weights(0.0, 1.0)[:, None]
    known = volume.weights >= (MIN_SHARE * largest).clamp(min=MIN_WEIGHT)
    slack = FRINGE_DEVIATIONS * _DEVIATION_M * volume.weights.rsqrt()
    behind = volume.sdf + slack < -FRINGE_DEPTH * volume.near_truncation
    behind &= volume.weights < FRINGE_SHARE * largest
    values = torch.where(known, volume.sdf, torch.nan)
    if scene is not None:
        values = fill_with_scene(volume, values, scene)
    points, faces = march_blocks(volume.block_coords, values, volume.voxel_size)
    of_voxels = _vertices(volume, (known, behind), points)
    normals = vertex_normals(points.cpu().numpy(), faces.cpu().numpy())
    vertices, kept = points.cpu().numpy(), faces.cpu().numpy()
    if scene is not None:
        kept = kept[_supported(scene, points, faces, of_voxels.measured, normals, (camera, poses))]
    areas = component_areas(vertices, kept)
    stays = areas >= min_part_m2
    if views is not None:
        small = kept[~stays]
        agreed = _firmly_seen(views, points, small, of_voxels.firm)
        stays[~stays] = component_areas(vertices, small, agreed) > CONFIRMED_SHARE * areas[~stays]
    kept = kept[stays]
    # Only now: a landing that was seen at a grazing angle must not go as a whole because fringes around it do.
    kept = kept[of_voxels.fringes.cpu().numpy()[kept].sum(1) < _FRINGE_CORNERS]
    if views is not None:
        kept = kept[~_contradicted(views, points, kept, of_voxels)]
    kept, used = compact(kept, len(vertices))
    colors = _colors(volume, scene, points[torch.from_numpy(used).to(points.device)])
    return TriangleMesh(vertices[used], kept, colors, normals[used])


class _Vertices(NamedTuple):
    """What the two voxels that a vertex lies between say of it, bool [K] each.

    Attributes:
        measured: both were.
        firm: the standard deviation of both is a voxel's edge at most.
        steep: measured, and the distance changes by more between them than that of one surface does.
        fringes: it is a fringe's.
    """

    measured: torch.Tensor
    firm: torch.Tensor
    steep: torch.Tensor
    fringes: torch.Tensor


def _vertices(volume: ops.TsdfVolume, voxels: tuple[torch.Tensor, torch.Tensor], points: torch.Tensor) -> _Vertices:
    """What is known of vertices.

    Args:
        volume: what the vertices are of.
        voxels: bool [B, 512] each, those that are known and those that may be behind a surface that ends.
        points: float32 [K, 3], vertices.
    """
    known, behind = (each.reshape(-1) for each in voxels)
    sdf, weights = volume.sdf.reshape(-1), volume.weights.reshape(-1)
    firm_weight = (_DEVIATION_M / volume.voxel_size) ** 2
    chunks = [_Vertices(*(known[:0] for _ in _Vertices._fields))]
    for chunk in points.split(CHUNK_POINTS):
        at = (chunk / volume.voxel_size).double()
        # A coordinate along which a vertex lies on the lattice must not be rounded to the voxel beside it.
        ends = ((at + _LATTICE).floor(), (at - _LATTICE).ceil())
        rows = torch.stack([_voxel_rows(volume, end.to(torch.int32)) for end in ends])
        found, rows = rows >= 0, rows.clamp(min=0)
        measured = (found & known[rows]).all(0)
        firm = measured & (weights[rows] >= firm_weight).all(0)
        change = (sdf[rows[0]] - sdf[rows[1]]).abs()
        steep = measured & (change > STEEP_VOXELS * volume.voxel_size)
        fringes = measured & (change > volume.near_truncation) & behind[rows].any(0)
        chunks.append(_Vertices(measured, firm, steep, fringes))
    return _Vertices(*map(torch.cat, zip(*chunks, strict=True)))


def _firmly_seen(views: DepthViews, points: torch.Tensor, faces: np.ndarray, firm: torch.Tensor) -> np.ndarray:
    """Bool [L]: faces that are known to a voxel, and that views saw from their front where their depth is.

    Small parts are noise as a rule; the slats of a blind that a camera saw from afar, for one, are not.

    Args:
        views: of the frames.
        points: float32 [K, 3], vertices, m.
        faces: int64 [L, 3].
        firm: bool [K], see `_Vertices`.
    """
    corners = torch.from_numpy(faces).to(points.device)
    known = firm[corners].all(1).nonzero()[:, 0]
    agreed = torch.zeros(len(faces), dtype=torch.bool, device=points.device)
    agreed[known] = _looks(views, points[corners[known]]).agreed
    return agreed.cpu().numpy()


def _contradicted(views: DepthViews, points: torch.Tensor, faces: np.ndarray, vertices: _Vertices) -> np.ndarray:
    """Bool [L]: faces that no view confirms and some contradict.

    Surface between two voxels that tell of different ones lies in the shadow of an edge, unless a view saw it from its
    front where its depth is: noise alone makes voxels differ too. What the map fills in is nothing where views see
    something farther, and none has surface near it or no depth.

    Args:
        views: of the frames.
        points: float32 [K, 3], vertices.
        faces: int64 [L, 3].
        vertices: what their voxels say of them.
    """
    corners = torch.from_numpy(faces).to(points.device)
    whole = vertices.measured[corners].all(1)
    rows = (~whole | vertices.steep[corners].any(1)).nonzero()[:, 0]
    looks = _looks(views, points[corners[rows]])
    shadow = ~looks.agreed & (looks.near | looks.through)
    nothing = looks.through & ~looks.near & ~looks.unknown
    out = torch.zeros(len(faces), dtype=torch.bool, device=points.device)
    out[rows] = torch.where(whole[rows], shadow, nothing)
    return out.cpu().numpy()


def _looks(views: DepthViews, triangles: torch.Tensor) -> Looks:
    """What views saw of triangles float32 [N, 3, 3], m."""
    sides = triangles[:, 1:] - triangles[:, :1]
    normals = torch.nn.functional.normalize(torch.linalg.cross(sides[:, 0], sides[:, 1]), dim=1, eps=1e-30)
    return views.look_at(triangles.mean(1), normals)


def _voxel_rows(volume: ops.TsdfVolume, voxels: torch.Tensor) -> torch.Tensor:
    """int64 [N], where voxels int32 [N, 3] are in the flattened arrays; -1 for none."""
    side = ops.tsdf.BLOCK_SIDE
    blocks = torch.div(voxels, side, rounding_mode="floor")
    local = (voxels - blocks * side).long()
    rows = volume.blocks.find(blocks).long()
    place = (local[:, 0] * side + local[:, 1]) * side + local[:, 2]
    return torch.where(rows >= 0, rows * ops.tsdf.BLOCK_VOXELS + place, -1)


def _supported(
    scene: Scene,
    points: torch.Tensor,
    faces: torch.Tensor,
    measured: torch.Tensor,
    normals: np.ndarray,
    views: tuple[Camera | None, np.ndarray | None],
) -> np.ndarray:
    """Bool [L]: faces whose vertices were all measured, and those of the map that `extract_mesh` would keep."""
    keep = measured[faces].all(1)
    rest = torch.nonzero(~keep)[:, 0]
    support = face_support(scene.volume, points, faces[rest], CHUNK_POINTS) >= MIN_SUPPORT
    kept, others = keep.cpu().numpy(), rest.cpu().numpy()
    good = support.cpu().numpy()
    camera, poses = views
    if camera is not None and poses is not None and len(poses):
        good &= front_facing_in_view(points.cpu().numpy(), normals, faces.cpu().numpy()[others], camera, poses)
    kept[others[good]] = True
    return kept


def _colors(volume: ops.TsdfVolume, scene: Scene | None, points: torch.Tensor) -> np.ndarray:
    """RGB uint8 [N, 3] at points: the fused ones and, where there are none, the map's."""
    colors = [np.zeros((0, 3), dtype=np.uint8)]
    for chunk in points.split(CHUNK_POINTS):
        _, rgb, known = volume.query(chunk, min_weight=MIN_WEIGHT)
        known &= (rgb > 0).any(1)
        if scene is not None:
            others = torch.nonzero(~known)[:, 0]
            rgb[others] = scene.color(chunk[others])
        colors.append((rgb * 255).round().clamp(0, 255).to(torch.uint8).cpu().numpy())
    return np.concatenate(colors)
