"""A truncated signed distance field on sparse blocks of 8 x 8 x 8 voxels, as functions of tensors.

Voxel (i, j, k) of block b lies at (8 b + (i, j, k)) voxel_size; it is element (8 i + j) 8 + k of the block's row. A
hash table (see `new_voxel_hash`) has the row of each block. `TsdfVolume` holds the tensors and grows them. Not
differentiable.
"""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_count, check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops.depth_planes import DEFAULT_NOISE, PLANE_SIZE, check_noise
from spslam.ops.scene_view import Intrinsics, check_intrinsics
from spslam.ops.voxel_hash import check_table

# kTsdfBlockSide, kTsdfColorSize and kNoBlock of csrc/include/spslam/tsdf.h.
BLOCK_SIDE = 8
BLOCK_VOXELS = BLOCK_SIDE**3
COLOR_SIZE = 4
NO_BLOCK = torch.iinfo(torch.int32).min

_MAX_SIDE = 1 << 14


@public_op()
def tsdf_touched_blocks(
    planes: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    *,
    voxel_size: float,
    truncation: float,
    noise: tuple[float, float] = DEFAULT_NOISE,
    step: int = 1,
) -> torch.Tensor:
    """The blocks within the truncation of the surface that a frame measured, with repetitions.

    Args:
        planes: float32 [H, W, 5] of `measure_planes`.
        pose: float32 [7] of the frame, T_world_camera: unit quaternion (w, x, y, z) and translation (m).
        intrinsics: of the image, px.
        voxel_size: m.
        truncation: m; where two deviations of the noise are more, these, at most 0.2 m.
        noise: floor (m^2) and growth (1/m^2) of the variance of depth, see `measure_planes`.
        step: only every so many pixels per axis are looked at.

    Returns:
        int32 [N, 3] block coordinates, in no particular order; N = 0 where nothing was measured. On CUDA the call
        synchronizes, to get N.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> camera, pose = Intrinsics(8.0, 8.0, 3.5, 3.5), torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> planes = measure_planes(torch.full((8, 8), 2.0), camera)
        >>> blocks = tsdf_touched_blocks(planes, pose, camera, voxel_size=0.1, truncation=0.3)
        >>> blocks[:, 2].unique()  # blocks of 0.8 m, from 1.7 to 2.3 m
        tensor([2], dtype=torch.int32)
    """
    _check_touch("tsdf_touched_blocks", planes, pose, intrinsics, voxel_size, truncation, noise, step)
    coords = torch.ops.spslam.tsdf_touched_blocks(
        planes, pose, list(intrinsics), voxel_size, truncation, list(noise), step
    )
    # Not by a mask, for which torch wakes its own threads, however few rows there are: they would wait for cores.
    return coords.index_select(0, (coords[:, 0] != NO_BLOCK).nonzero()[:, 0])


def missing_blocks(
    name: str,
    table: tuple[torch.Tensor, torch.Tensor],
    planes: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    voxel_size: float,
    truncation: float,
    noise: tuple[float, float],
    step: int,
) -> torch.Tensor:
    """Those of `tsdf_touched_blocks` that a table lacks, on behalf of another function, which errors name.

    Returns:
        int32 [N, 3], with repetitions, in no particular order; the call waits for CUDA once.
    """
    _check_touch(name, planes, pose, intrinsics, voxel_size, truncation, noise, step, like=table[0])
    sizes = voxel_size, truncation, list(noise)
    return torch.ops.spslam.tsdf_missing_blocks(planes, pose, list(intrinsics), *sizes, step, *table)


def _check_touch(
    name: str,
    planes: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    voxel_size: float,
    truncation: float,
    noise: tuple[float, float],
    step: int,
    like: torch.Tensor | None = None,
) -> None:
    _check_frame(name, planes, pose, intrinsics, like)
    _check_sizes(name, voxel_size, truncation)
    check_noise(name, noise)
    check_count(name, "step", step)


@public_op()
def tsdf_integrate_(
    block_coords: torch.Tensor,
    sdf: torch.Tensor,
    weights: torch.Tensor,
    colors: torch.Tensor,
    planes: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    *,
    voxel_size: float,
    truncation: float,
    near_truncation: float | None = None,
    noise: tuple[float, float] = DEFAULT_NOISE,
    color: torch.Tensor | None = None,
    max_weight: float = 1e4,
) -> None:
    """Adds a frame to the voxels that it sees, in place (Curless and Levoy 1996).

    A voxel learns its distance from the plane of the pixel that it falls on, at most the pixel's truncation: that is
    `near_truncation` and a deviation s of the noise at the voxel's depth, at most `truncation`, but no less than 2 s,
    up to 0.2 m: noise that is larger than the truncation makes many surfaces of one. It weighs the distance by the
    plane's weight. Behind the surface that stays up to 1.2 s, at most 0.7 of the truncation, and then falls to 0 at the
    truncation. Voxels farther behind learn nothing, nor do those more than three voxels behind whose depth is larger
    than the plane's on their ray by 1 / 0.3 of the truncation. Those in front learn that they are free, which removes
    what has moved away; those farther in front than the truncation with the weight of a plane that far behind them, as
    noise of far surface is none of the space before it. Colors within 1.5 voxels of the surface are averaged with the
    plane's weight squared, less where a pixel is larger than a voxel.

    Args:
        block_coords: int32 [B, 3], distinct.
        sdf: float32 [B or more, 512] mean distance, m, positive in free space; changed.
        weights: float32, as `sdf`; changed.
        colors: uint16 [B or more, 512, 4] mean red, green and blue in 1/256 and their weight in 1/1024; changed.
        planes: float32 [H, W, 5] of `measure_planes`; an image without pixels changes nothing.
        pose: float32 [7] of the frame, T_world_camera: unit quaternion (w, x, y, z) and translation (m).
        intrinsics: of the image, px.
        voxel_size: m.
        truncation: the largest but for noise, m.
        near_truncation: where there is no noise, m; `truncation` where not given.
        noise: floor (m^2) and growth (1/m^2) of the variance of depth, see `measure_planes`.
        color: uint8 [H, W, 3]; None leaves the colors.
        max_weight: a voxel's weight is cut to this: a smaller one forgets earlier frames sooner.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.
        RuntimeError: `sdf`, `weights` or `colors` is not contiguous.

    Example:
        >>> camera, pose = Intrinsics(8.0, 8.0, 3.5, 3.5), torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> planes = measure_planes(torch.full((8, 8), 2.0), camera)
        >>> block = torch.tensor([[0, 0, 2]], dtype=torch.int32)
        >>> sdf, weights = torch.zeros(1, 512), torch.zeros(1, 512)
        >>> colors = torch.zeros(1, 512, 4, dtype=torch.uint16)
        >>> tsdf_integrate_(block, sdf, weights, colors, planes, pose, camera, voxel_size=0.1, truncation=0.3)
        >>> sdf[0, 1:7].mul(10).round().div(10) + 0  # from z = 1.7 to 2.2 m
        tensor([ 0.3000,  0.2000,  0.1000,  0.0000, -0.1000, -0.2000])
    """
    name = "tsdf_integrate_"
    _check_blocks(name, sdf, weights, colors)
    check_tensor(name, "block_coords", block_coords, ("B", 3), torch.int32, like=sdf)
    check(len(block_coords) <= len(sdf), name, "block_coords", f"have at most {len(sdf)} rows", len(block_coords))
    _check_frame(name, planes, pose, intrinsics, like=sdf)
    _check_sizes(name, voxel_size, truncation)
    near = truncation if near_truncation is None else near_truncation
    check(0 < near <= truncation, name, "near_truncation", "be positive and at most truncation", near)
    check_noise(name, noise)
    check(max_weight > 0, name, "max_weight", "be positive", max_weight)
    if color is not None:
        check_tensor(name, "color", color, (*planes.shape[:2], 3), torch.uint8, like=sdf)
    if planes.numel() == 0:  # the kernel looks into tiles of the image, of which there are none
        return
    torch.ops.spslam.tsdf_integrate_(
        block_coords,
        sdf,
        weights,
        colors,
        planes,
        [] if color is None else [color],
        pose,
        list(intrinsics),
        voxel_size,
        [truncation, near],
        list(noise),
        max_weight,
    )
    changed_in_place(sdf, weights)


@public_op()
def tsdf_query(
    hash_keys: torch.Tensor,
    hash_values: torch.Tensor,
    sdf: torch.Tensor,
    weights: torch.Tensor,
    colors: torch.Tensor,
    points: torch.Tensor,
    *,
    voxel_size: float,
    min_weight: float = 0.0,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Trilinear distance and color at points.

    Args:
        hash_keys, hash_values: the table of the blocks.
        sdf, weights: float32 [B, 512], as `tsdf_integrate_` has them.
        colors: uint16 [B, 512, 4].
        points: float32 [N, 3], world, m.
        voxel_size: m.
        min_weight: a voxel is known from this weight on; without any weight it never is.

    Returns:
        float32 [N] distance, m; float32 [N, 3] RGB in [0, 1], 0 where no voxel around has a color; bool [N] whether all
        eight voxels around the point are known; distance and color are 0 where not, as for points that are not finite.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> keys, values = new_voxel_hash(2)
        >>> _ = voxel_hash_insert(keys, values, torch.zeros(1, 3, dtype=torch.int32), 0)
        >>> x = torch.arange(8.0).repeat_interleave(64)[None]
        >>> field = keys, values, x, torch.ones(1, 512), torch.zeros(1, 512, 4, dtype=torch.uint16)
        >>> distance, _, known = tsdf_query(*field, torch.tensor([[0.25, 0.1, 0.1], [0.75, 0, 0]]), voxel_size=0.1)
        >>> distance, known
        (tensor([2.5000, 0.0000]), tensor([ True, False]))
    """
    name = "tsdf_query"
    _check_field(name, (hash_keys, hash_values, sdf, weights, colors), voxel_size)
    check_tensor(name, "points", points, ("N", 3), torch.float32, like=sdf)
    return torch.ops.spslam.tsdf_query(hash_keys, hash_values, sdf, weights, colors, points, voxel_size, min_weight)


@public_op()
def tsdf_ray_cast(
    hash_keys: torch.Tensor,
    hash_values: torch.Tensor,
    sdf: torch.Tensor,
    weights: torch.Tensor,
    colors: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    *,
    size: tuple[int, int],
    voxel_size: float,
    depth_range: tuple[float, float] = (0.1, 10.0),
    min_weight: float = 0.0,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The first surface on the ray of each pixel that is seen from its front.

    Args:
        hash_keys, hash_values: the table of the blocks.
        sdf, weights: float32 [B, 512], as `tsdf_integrate_` has them.
        colors: uint16 [B, 512, 4].
        pose: float32 [7] of the view, T_world_camera: unit quaternion (w, x, y, z) and translation (m).
        intrinsics: of the view, px.
        size: width and height of the view, px.
        voxel_size: m.
        depth_range: least and most depth, m.
        min_weight: a voxel is known from this weight on; without any weight it never is.

    Returns:
        float32 [H, W] depth along the optical axis, m, 0 without surface; float32 [H, W, 3] unit normals towards free
        space in world axes, 0 where the field around is not known; float32 [H, W, 3] RGB in [0, 1]. The same bits for
        any number of threads.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> camera, pose = Intrinsics(8.0, 8.0, 3.5, 3.5), torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> volume = TsdfVolume(0.05)
        >>> volume.integrate(torch.full((8, 8), 2.0), pose, camera)
        >>> depth, normals, _ = tsdf_ray_cast(*volume.field(), pose, camera, size=(8, 8), voxel_size=0.05)
        >>> round(depth[4, 4].item(), 3), (normals[4, 4].round() + 0).tolist()
        (2.0, [0.0, 0.0, -1.0])
    """
    name = "tsdf_ray_cast"
    _check_field(name, (hash_keys, hash_values, sdf, weights, colors), voxel_size)
    check_tensor(name, "pose", pose, (7,), torch.float32, like=sdf)
    check_intrinsics(name, intrinsics)
    check(len(size) == 2 and min(size) >= 0 and max(size) <= _MAX_SIDE, name, "size", f"be 0 to {_MAX_SIDE} px", size)
    fits = len(depth_range) == 2 and 0 < depth_range[0] < depth_range[1]
    check(fits, name, "depth_range", "be two ascending positive numbers", depth_range)
    numbers = list(intrinsics), list(size), list(depth_range), voxel_size, min_weight
    return torch.ops.spslam.tsdf_ray_cast(hash_keys, hash_values, sdf, weights, colors, pose, *numbers)


def _check_frame(
    name: str, planes: torch.Tensor, pose: torch.Tensor, intrinsics: Intrinsics, like: torch.Tensor | None = None
) -> None:
    check_tensor(name, "planes", planes, ("H", "W", PLANE_SIZE), torch.float32, like=like)
    check(max(planes.shape[:2]) <= _MAX_SIDE, name, "planes", f"have at most {_MAX_SIDE} px", list(planes.shape))
    check_tensor(name, "pose", pose, (7,), torch.float32, like=planes)
    check_intrinsics(name, intrinsics)


def _check_sizes(name: str, voxel_size: float, truncation: float) -> None:
    check(voxel_size > 0, name, "voxel_size", "be positive", voxel_size)
    check(truncation >= voxel_size, name, "truncation", "be at least voxel_size", truncation)


def _check_blocks(name: str, sdf: torch.Tensor, weights: torch.Tensor, colors: torch.Tensor) -> None:
    check_tensor(name, "sdf", sdf, ("B", BLOCK_VOXELS), torch.float32)
    check_tensor(name, "weights", weights, tuple(sdf.shape), torch.float32, like=sdf)
    check_tensor(name, "colors", colors, (*sdf.shape, COLOR_SIZE), torch.uint16, like=sdf)


def _check_field(name: str, field: tuple[torch.Tensor, ...], voxel_size: float) -> None:
    hash_keys, hash_values, sdf, weights, colors = field
    check_table(name, hash_keys, hash_values)
    _check_blocks(name, sdf, weights, colors)
    check(sdf.device == hash_keys.device, name, "sdf", f"be on {hash_keys.device}", sdf.device)
    check(voxel_size > 0, name, "voxel_size", "be positive", voxel_size)


@torch.library.register_fake("spslam::tsdf_missing_blocks")
@torch.library.register_fake("spslam::tsdf_touched_blocks")
def _(planes, *_):
    return planes.new_empty((torch.library.get_ctx().new_dynamic_size(), 3), dtype=torch.int32)


@torch.library.register_fake("spslam::tsdf_integrate_")
def _(*_):
    return None


@torch.library.register_fake("spslam::tsdf_query")
def _(hash_keys, hash_values, sdf, weights, colors, points, *_):
    n = len(points)
    return points.new_empty(n), points.new_empty(n, 3), points.new_empty(n, dtype=torch.bool)


@torch.library.register_fake("spslam::tsdf_ray_cast")
def _(hash_keys, hash_values, sdf, weights, colors, pose, intrinsics, size, *_):
    width, height = size
    return sdf.new_empty(height, width), sdf.new_empty(height, width, 3), sdf.new_empty(height, width, 3)
