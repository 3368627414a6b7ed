"""A valid call of every public op, by argument name, for the tests that say something of all of them."""

from collections.abc import Callable
from dataclasses import dataclass

import torch

from spslam import ops
from tests.ops import scene_cases, seen_points_cases, tsdf_cases
from tests.ops.case_inputs import CAMERA, KEY, LAYOUT, SAMPLES, VOXEL, normal, on_device, random_coords, uniform
from tests.ops.scenes import TRUNCATION

Build = Callable[[torch.Generator, torch.device, int], dict]


@dataclass(frozen=True)
class Case:
    """How to call an op.

    Attributes:
        build: makes the arguments from a generator, a device and a number of rows, which may be 0.
        differentiable: names of the arguments that the op is differentiable by.
        rows: names of the arguments whose rows `torch.vmap` may map over, the others shared; empty if none.
        compiles: whether torch.compile takes a call of it whole.
    """

    build: Build
    differentiable: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    compiles: bool = True


def arguments(name: str, generator: torch.Generator, device: torch.device | str = "cpu", rows: int = 60) -> dict:
    """A valid call's arguments, by name."""
    return CASES[name].build(generator, torch.device(device), rows)


def _table(generator, device, n):
    """A table of `n` coordinates, repetitions included: keys, values, coordinates, corner ids."""
    keys, values = ops.new_voxel_hash(1024, device)
    coords = ops.voxel_hash_insert(keys, values, random_coords(generator, n).to(device), 0)
    corners = torch.full((len(coords), 8), -1, dtype=torch.int32, device=device)
    ops.voxel_hash_update_corner_ids(keys, values, coords, corners, 0)
    return keys, values, coords, corners


def _hash(generator, device, n, **more):
    keys, values, coords, corners = _table(generator, device, max(n, 1) * 4)
    known = dict(hash_keys=keys, hash_values=values, voxel_coords=random_coords(generator, n), corner_ids=corners)
    return on_device(device, {name: known.get(name, value) for name, value in more.items()})


def _find(generator, device, n):
    return _hash(generator, device, n, hash_keys=None, hash_values=None, voxel_coords=None)


def _insert(generator, device, n):
    return _find(generator, device, n) | dict(first_id=len(_table(generator, device, max(n, 1) * 4)[2]))


def _build_table(generator, device, n):
    keys, values, coords, _ = _table(generator, device, n)
    return dict(hash_keys=keys, hash_values=values, voxel_coords=coords)


def _update_corners(generator, device, n):
    keys, values, coords, corners = _table(generator, device, n)
    return dict(hash_keys=keys, hash_values=values, voxel_coords=coords, corner_ids=corners, first_new=0)


def _lookup(generator, device, n):
    points = 0.1 * normal(generator, n, 3)
    return _hash(
        generator, device, n, hash_keys=None, hash_values=None, corner_ids=None, points=points, voxel_size=VOXEL
    )


def _trilinear(generator, device, n):
    ids = torch.randint(-1, 40, (n, 8), generator=generator, dtype=torch.int32)
    return on_device(
        device, dict(embeddings=normal(generator, 40, 8), corner_ids=ids, local_coords=uniform(generator, n, 3))
    )


def _bilinear(generator, device, n):
    return on_device(device, dict(texels=normal(generator, 6, 9, 5), uv=10 * uniform(generator, n, 2) - 1))


def _tri_plane(generator, device, n):
    points = 0.5 * uniform(generator, n, 3) - 0.2
    return on_device(device, dict(texels=normal(generator, 83, 32), points=points, cell_size=VOXEL, layout=LAYOUT))


def _tri_plane_levels(generator, device, n):
    grid = ops.TriPlaneLevels.from_sizes([(-0.2, -0.2, -0.2), (0.3, 0.3, 0.3)], [(3, 4, 5), (6, 7, 8)])
    table = normal(generator, grid.num_rows, 4)
    return on_device(device, dict(table=table, points=0.6 * uniform(generator, n, 3) - 0.25, grid=grid))


def _volume_levels(generator, device, n):
    bounds = [(-0.2, -0.2, -0.2), (0.3, 0.3, 0.3)]
    grid = ops.VolumeLevels.from_sizes(bounds, [(3, 4, 5), (6, 7, 8)], max_level_rows=64)
    points = 0.6 * uniform(generator, n, 3) - 0.25
    table = normal(generator, grid.num_rows, 2)
    return on_device(device, dict(table=table, points=points, grid=grid, concatenate=True))


def _uniform_draw(generator, device, n):
    return dict(KEY, count=n, device=device)


def _index_draw(generator, device, n):
    return dict(KEY, count=n, upper=17, device=device)


def _along_rays(generator, device, n):
    shape = dict(num_uniform=16, num_surface=5, near=0.2, far=1.02, truncation=TRUNCATION)
    return on_device(device, dict(depth=uniform(generator, n) + 0.5, **shape, **KEY))


def _frame_pixels(generator, device, n):
    color = torch.randint(0, 256, (48, 64, 3), generator=generator).to(torch.uint8)
    sampling = ops.PixelSampling(
        n, min_depth=0.1, max_depth=9.0, step_px=2, max_jump=0.1, thumbnail_step=16, depth_image_step=2
    )
    key = dict(seed=7, stream=ops.RandomStream.PIXEL_DATABASE, frame=3)
    images = dict(depth=1 + 0.1 * uniform(generator, 48, 64), color=color)
    return on_device(device, images) | CAMERA | dict(sampling=sampling, **key)


def _samples(generator, n):
    t = 1 + uniform(generator, n, SAMPLES).sort(1).values
    sdf = ((1.5 - t) / TRUNCATION).clamp(-1, 1)
    return dict(sdf=sdf, color=uniform(generator, n, SAMPLES, 3), t=t, valid=uniform(generator, n, SAMPLES) < 0.9)


def _render(generator, device, n):
    return on_device(device, dict(_samples(generator, n), truncation=TRUNCATION))


def _losses(generator, device, n):
    samples = _samples(generator, n) | dict(color=uniform(generator, n, 3), depth=1 + uniform(generator, n))
    targets = dict(
        rendered=uniform(generator, n) < 0.9,
        target_color=uniform(generator, n, 3),
        target_depth=1 + uniform(generator, n),
        cosine=uniform(generator, n),
    )
    return on_device(device, samples | targets | dict(truncation=TRUNCATION, cosine_targets=True))


def _composite(generator, device, n):
    t = 1 + uniform(generator, n, SAMPLES).sort(1).values
    densities = dict(opacities=20 * uniform(generator, n, SAMPLES), lengths=0.05 * uniform(generator, n, SAMPLES))
    return on_device(device, densities | dict(values=uniform(generator, n, SAMPLES, 4), t=t, stop=1e-4))


def _mlp(generator, device, n):
    params = normal(generator, ops.mlp_num_params(11, 32, 3)) / 6
    return on_device(device, dict(input=normal(generator, n, 11), params=params, hidden=32, output=3, activation=1))


def _adam(generator, device, n):
    names = ("param", "grad", "exp_avg", "exp_avg_sq")
    stamps = torch.randint(0, 2, (n,), generator=generator, dtype=torch.int32)
    tables = {name: uniform(generator, n, 8) for name in names}
    return on_device(device, tables | dict(stamps=stamps, stamp=1, lr=1e-2, step=3))


def _equations(generator, device, n):
    shapes = dict(residuals=(2, n), jacobians=(2, n, 6), weights=(2, n))
    return on_device(device, {name: uniform(generator, *shape) for name, shape in shapes.items()})


def _solve(generator, device, n):
    root = normal(generator, n, 6, 6)
    hessian = root @ root.mT + 6 * torch.eye(6)
    return on_device(
        device, dict(hessian=hessian, gradient=normal(generator, n, 6), damping=1e-4, absolute_damping=1e-9)
    )


def _depth_normals(generator, device, n):
    pixels = torch.randint(0, 48, (n, 2), generator=generator, dtype=torch.int32)
    image = 1 + 0.1 * uniform(generator, 48, 64)
    return on_device(device, dict(depth=image, pixels=pixels, **CAMERA, step_px=2, max_jump=0.1))


def _encode(generator, device, n):
    normals = torch.nn.functional.normalize(normal(generator, n, 3))
    params = normal(generator, ops.ENCODER_PARAMETERS) / 8
    points = 0.2 * normal(generator, n, 3)
    return on_device(device, dict(points=points, normals=normals, encoder_params=params, voxel_size=VOXEL))


def _encode_frame(generator, device, n):
    volume = ops.VolumeBuffers(
        *ops.new_voxel_hash(8192, device),
        voxel_coords=torch.zeros(4096, 3, dtype=torch.int32, device=device),
        corner_ids=torch.full((4096, 8), -1, dtype=torch.int32, device=device),
        embeddings=torch.zeros(4096, 8, device=device),
        weights=torch.zeros(4096, device=device),
    )
    call = _encode(generator, device, n)
    fusion = ops.FrameFusion(call.pop("voxel_size"), 64, 1e-4, 8000, 0.006, 2.5, 20.0)
    return dict(volume=volume, num_voxels=0, max_voxels=4096, **call, fusion=fusion)


def _unproject(generator, device, n):
    records = torch.randint(0, 2**30, (n, 3), generator=generator, dtype=torch.int32)
    pose = torch.tensor([1.0, 0, 0, 0, 0.5, 0, 0])
    return on_device(device, dict(records=records, normals=normal(generator, n, 3), pose=pose, **CAMERA))


def _fuse(generator, device, n):
    ids = torch.randperm(n + 5, generator=generator)[:n].int()
    volume = dict(embeddings=normal(generator, n + 5, 8), weights=uniform(generator, n + 5))
    added = dict(voxel_ids=ids, features=normal(generator, n, 8), feature_weights=uniform(generator, n))
    return on_device(device, volume | added | dict(max_weight=2.0))


def _random_embeddings(generator, device, n):
    return on_device(device, dict(voxel_coords=random_coords(generator, n), seed=5))


def _descriptors(generator, device, n):
    counts = {"descriptors": n, "others": 70}
    drawn = {name: torch.randint(0, 256, (rows, 32), generator=generator) for name, rows in counts.items()}
    return on_device(device, {name: each.to(torch.uint8) for name, each in drawn.items()})


def _marching_cubes(generator, device, n):
    side = torch.arange(max(n, 1), dtype=torch.int32)
    coords = torch.stack([side, side // 2, side // 3], 1)[:n]
    return on_device(device, dict(cell_coords=coords, values=normal(generator, n, 4, 4, 4)))


CASES = {
    "voxel_hash_find": Case(_find, rows=("voxel_coords",)),
    "voxel_hash_absent": Case(_find),
    "voxel_hash_insert": Case(_insert),
    "voxel_hash_build_": Case(_build_table, compiles=False),
    "voxel_hash_update_corner_ids": Case(_update_corners),
    "voxel_hash_lookup": Case(_lookup, ("points",), rows=("points",)),
    "trilinear_interpolate": Case(_trilinear, ("embeddings", "local_coords"), rows=("corner_ids", "local_coords")),
    "bilinear_interpolate": Case(_bilinear, ("texels", "uv"), rows=("uv",)),
    "tri_plane_interpolate": Case(_tri_plane, ("texels", "points"), rows=("points",)),
    "interpolate_tri_planes": Case(_tri_plane_levels, ("table", "points"), rows=("points",)),
    "interpolate_volumes": Case(_volume_levels, ("table", "points"), rows=("points",)),
    "philox_uniform": Case(_uniform_draw),
    "sample_indices": Case(_index_draw),
    "sample_along_rays": Case(_along_rays, rows=("depth",)),
    "sample_frame_pixels": Case(_frame_pixels),
    "unproject_pixels": Case(_unproject),
    "volume_render": Case(_render, ("sdf", "color", "t"), rows=("sdf", "color", "t", "valid")),
    "alpha_composite": Case(
        _composite, ("opacities", "values", "t", "lengths"), rows=("opacities", "values", "t", "lengths")
    ),
    "rendering_losses": Case(
        _losses,
        ("color", "depth", "sdf", "t"),
        rows=("color", "depth", "sdf", "t", "valid", "rendered", "target_color", "target_depth", "cosine"),
    ),
    "mlp": Case(_mlp, ("input", "params"), rows=("input",)),
    "sparse_adam_": Case(_adam),
    "normal_equations": Case(_equations, rows=("residuals", "jacobians", "weights")),
    "solve_normal_equations": Case(_solve, rows=("hessian", "gradient")),
    "depth_normals": Case(_depth_normals, rows=("pixels",)),
    "encode_points": Case(_encode),
    "encode_frame_": Case(_encode_frame, compiles=False),
    "fuse_prior_": Case(_fuse),
    "random_embeddings": Case(_random_embeddings, rows=("voxel_coords",)),
    "marching_cubes": Case(_marching_cubes),
    "measure_planes": Case(tsdf_cases.planes),
    "tsdf_touched_blocks": Case(tsdf_cases.touched_blocks),
    "tsdf_integrate_": Case(tsdf_cases.integrate),
    "tsdf_query": Case(tsdf_cases.query),
    "tsdf_ray_cast": Case(tsdf_cases.ray_cast),
    "see_points": Case(seen_points_cases.see),
    "add_seen_colors_": Case(seen_points_cases.add_colors),
    "add_color_detail_": Case(seen_points_cases.add_detail),
    "query_sdf": Case(scene_cases.scene_points),
    "query_sdf_gradient": Case(scene_cases.scene_points),
    "query_color": Case(scene_cases.scene_points),
    "render_step": Case(scene_cases.render_step),
    "track_gauss_newton": Case(scene_cases.track),
    "measure_noise_": Case(scene_cases.measure_noise),
    "measure_capture_timing_": Case(scene_cases.measure_timing),
    "rectify_shutter_records_": Case(scene_cases.rectify_records),
    "rectify_shutter_images_": Case(scene_cases.rectify_images),
    "gauss_newton_poses": Case(scene_cases.frame_equations),
    "align_depth_images": Case(scene_cases.align_images),
    "compare_depth_images": Case(scene_cases.compare_images),
    "track_adam": Case(scene_cases.track_adam),
    "optimize_map_": Case(scene_cases.optimize_map),
    "predict_pose": Case(scene_cases.predict),
    "nearest_descriptors": Case(_descriptors),
    "copy_rows_": Case(scene_cases.copy_rows),
    "projective_icp": Case(scene_cases.icp),
    "frame_overlap": Case(scene_cases.overlap),
    "select_covisible_frames": Case(scene_cases.select),
}
