"""What every op makes of one bad row among good ones, as its docstring says: the others never notice."""

import copy
import importlib
import math

import pytest
import torch

from spslam import ops
from tests.ops.arguments import changed, get, outputs, tensors
from tests.ops.cases import CASES, arguments

NAN = (math.nan,)
NOT_FINITE = (math.nan, math.inf, -math.inf)
NOWHERE = (*NOT_FINITE, 1e30, -1e30)
NO_DEPTH = (*NOT_FINITE, -1.0, 0.0)
OUT_OF_RANGE = (2**20, -(2**20) - 1, 2**31 - 1, -(2**31))
NO_ROW = (-1, 2**20, 2**31 - 1, -(2**31))
ANY = None  # an output that has nothing to do with it

# (op, argument, bad values, what each output then has in that row)
ROWS = [
    ("voxel_hash_find", "voxel_coords", OUT_OF_RANGE, [-1]),
    ("voxel_hash_lookup", "points", NOWHERE, [-1, 0]),
    ("trilinear_interpolate", "corner_ids", NO_ROW, [0]),
    ("trilinear_interpolate", "local_coords", NAN, [math.nan]),
    ("bilinear_interpolate", "uv", NAN, [math.nan]),
    ("tri_plane_interpolate", "points", NAN, [math.nan]),
    ("interpolate_tri_planes", "points", NAN, [math.nan]),
    ("interpolate_volumes", "points", NAN, [math.nan]),
    ("sample_along_rays", "depth", NO_DEPTH, [0]),
    ("unproject_pixels", "normals", NAN, [ANY, math.nan]),
    ("volume_render", "sdf", NAN, [math.nan, math.nan, math.nan]),
    ("volume_render", "color", NAN, [math.nan, ANY, ANY]),
    ("volume_render", "t", NAN, [ANY, math.nan, ANY]),
    ("alpha_composite", "opacities", NAN, [math.nan, math.nan, math.nan, math.nan]),
    ("alpha_composite", "lengths", NAN, [math.nan, math.nan, math.nan, math.nan]),
    ("alpha_composite", "values", NAN, [math.nan, ANY, ANY, ANY]),
    ("alpha_composite", "t", NAN, [ANY, math.nan, ANY, ANY]),
    ("mlp", "input", NAN, [math.nan]),
    ("normal_equations", "residuals", NAN, [ANY, math.nan, math.nan]),
    ("normal_equations", "jacobians", NAN, [math.nan, math.nan, ANY]),
    ("normal_equations", "weights", NAN, [math.nan, math.nan, math.nan]),
    ("solve_normal_equations", "hessian", NOT_FINITE, [0]),
    ("solve_normal_equations", "gradient", NOT_FINITE, [0]),
    ("depth_normals", "pixels", NO_ROW, [0]),
    ("query_sdf", "points", NOWHERE, [1, 0]),
    ("query_sdf_gradient", "points", NOWHERE, [1, 0, 0]),
    ("query_color", "points", NAN, [math.nan]),
    ("gauss_newton_poses", "poses", NOT_FINITE, [0, 0, 0, 0]),
    ("frame_overlap", "poses", NOT_FINITE, [0]),
    ("frame_overlap", "depth_thumbnails", NOT_FINITE, [0]),
]
# Clamped to the border, as what lies outside of an image or plane is.
CLAMPED = [
    ("bilinear_interpolate", "uv"),
    ("tri_plane_interpolate", "points"),
    ("interpolate_tri_planes", "points"),
    ("interpolate_volumes", "points"),
    ("query_color", "points"),
]
# Ops of packed pixels: (op, path of the records).
RECORDS = [
    ("render_step", ("rays", "pixels")),
    ("track_gauss_newton", ("pixels",)),
    ("gauss_newton_poses", ("pixels",)),
    ("track_adam", ("records",)),
    ("optimize_map_", ("records",)),
    ("select_covisible_frames", ("records",)),
]
# Which row of a table a bad one is: (op, argument, bad values, tables, whether they change at all).
TABLE_ROWS = [
    ("sparse_adam_", "grad", NAN, ("param", "exp_avg", "exp_avg_sq"), True),
    ("fuse_prior_", "features", NAN, ("embeddings",), True),
    ("fuse_prior_", "feature_weights", (math.nan, 0.0, -1.0, -math.inf), ("embeddings", "weights"), False),
]
# Ops whose rows melt together, or that check them: the test that says what becomes of a bad one.
ELSEWHERE = {
    "voxel_hash_absent": "test_voxel_hash.test_coordinates_out_of_range_leave_the_table_alone",
    "voxel_hash_insert": "test_voxel_hash.test_coordinates_out_of_range_leave_the_table_alone",
    "voxel_hash_build_": "test_voxel_hash.test_coordinates_out_of_range_leave_the_table_alone",
    "encode_points": "test_prior_fusion.test_points_beyond_the_range_of_coordinates_are_skipped",
    "encode_frame_": "test_encode_frame.test_points_that_are_not_finite_or_too_far_are_skipped",
    "sample_frame_pixels": "test_pixel_sampling.test_pixels_are_those_of_numpy",
    "measure_noise_": "test_sensor_noise.test_pixels_without_depth_add_nothing",
    "measure_capture_timing_": "test_capture_timing.test_pixels_and_poses_that_are_not_finite_tell_nothing",
    "rectify_shutter_records_": "test_capture_timing.test_records_and_poses_that_are_not_finite_stay",
    "rectify_shutter_images_": "test_capture_timing.test_records_and_poses_that_are_not_finite_stay",
    "marching_cubes": "test_marching_cubes.test_unknown_samples_open_the_surface_around_them",
    "measure_planes": "test_tsdf.test_planes_are_unknown_without_depth",
    "tsdf_touched_blocks": "test_tsdf.test_frames_that_are_not_finite_change_nothing",
    "tsdf_integrate_": "test_tsdf.test_frames_that_are_not_finite_change_nothing",
    "tsdf_query": "test_tsdf.test_query_interpolates_and_says_what_is_unknown",
    "tsdf_ray_cast": "test_tsdf.test_frames_that_are_not_finite_change_nothing",
    "see_points": "test_seen_points.test_points_that_are_not_finite_are_not_seen",
    "add_seen_colors_": "test_seen_points.test_means_of_weighted_colors",
    "add_color_detail_": "test_seen_points.test_detail_of_edges",
    "align_depth_images": "test_depth_image_alignment.test_pairs_without_images_and_poses_that_are_not_finite_stay",
    "compare_depth_images": "test_depth_image_alignment.test_pairs_without_images_and_poses_that_are_not_finite_stay",
    "nearest_descriptors": "test_descriptors.test_nearest_are_those_of_numpy",
    "copy_rows_": "test_copy_rows.test_as_single_assignments",
    "projective_icp": "test_projective_icp.test_holes_and_strangers_take_no_part",
}


def same(got, want):
    return all(torch.equal(g.nan_to_num(), w.nan_to_num()) for g, w in zip(got, want, strict=True))


def corrupted(call, path, value, row=0):
    """The call with a value all over one row of an argument."""
    tensor = get(call, path).clone()
    tensor[row] = value
    return changed(call, path, tensor)


def run(name, call):
    """Results, and the arguments as the op left them."""
    own = copy.deepcopy(call)
    return outputs(getattr(ops, name)(**own)), own


def test_every_op_is_tested():
    """Those without a tensor have no rows; a pose is one row, and NaN gives NaN."""
    rowless = {"philox_uniform", "sample_indices", "predict_pose"}
    listed = {row[0] for row in (*ROWS, *CLAMPED, *RECORDS, *TABLE_ROWS)} | set(ELSEWHERE) | rowless
    own = {"voxel_hash_update_corner_ids", "rendering_losses", "random_embeddings"}
    assert listed | own == set(CASES)
    for name in ELSEWHERE.values():
        module, function = name.split(".")
        assert hasattr(importlib.import_module(f"tests.ops.{module}"), function)


@pytest.mark.parametrize("name, argument, values, expected", ROWS)
def test_a_bad_row_gives_what_is_documented(name, argument, values, expected, device, generator):
    call = arguments(name, generator, device)
    good, _ = run(name, call)
    for value in values:
        got, _ = run(name, corrupted(call, (argument,), value, row=1))
        assert same([g[2:] for g in got], [g[2:] for g in good])
        assert same([g[:1] for g in got], [g[:1] for g in good])
        for part, want in zip(got, expected, strict=True):
            if want is not ANY:
                assert torch.equal(part[1].double(), torch.full_like(part[1].double(), want)) or (
                    math.isnan(want) and part[1].isnan().all()
                )


@pytest.mark.parametrize("name, argument", CLAMPED)
def test_infinity_is_the_border(name, argument, device, generator):
    call = arguments(name, generator, device)
    for value in (math.inf, -math.inf):
        assert same(
            run(name, corrupted(call, (argument,), value))[0],
            run(name, corrupted(call, (argument,), math.copysign(1e6, value)))[0],
        )


@pytest.mark.parametrize("name, path", RECORDS)
def test_a_pixel_without_depth_adds_nothing(name, path, device, generator):
    """Whatever it is that is no depth: the same bits as for 0, in results and in what is changed in place."""
    call = arguments(name, generator, device)

    def with_depth(value):
        records = get(call, path).clone()
        records[..., ::3, 1] = int(torch.tensor(value).view(torch.int32))
        results, own = run(name, changed(call, path, records))
        return [*results, *(get(own, part) for part in tensors(own) if part != path)]

    want = with_depth(0.0)
    for value in NO_DEPTH:
        assert same(with_depth(value), want)


@pytest.mark.parametrize("name, argument, values, tables, changes", TABLE_ROWS)
def test_a_bad_row_reaches_its_own_row_of_a_table(name, argument, values, tables, changes, device, generator):
    call = arguments(name, generator, device)
    if name == "sparse_adam_":
        row = int(call["stamps"].eq(1).nonzero()[0])
        target = row
    else:
        row, target = 0, int(call["voxel_ids"][0])
    _, good = run(name, call)
    for value in values:
        _, own = run(name, corrupted(call, (argument,), value, row))
        for table in tables:
            others = torch.arange(len(own[table]), device=device) != target
            assert torch.equal(own[table][others], good[table][others])
            entry = own[table][target]
            assert entry.isnan().all() if changes else torch.equal(entry, call[table][target])


@pytest.mark.parametrize("value", OUT_OF_RANGE)
def test_a_vertex_out_of_range_has_no_cell(value, device, generator):
    call = arguments("voxel_hash_update_corner_ids", generator, device)
    _, own = run("voxel_hash_update_corner_ids", corrupted(call, ("voxel_coords",), value))
    assert (own["corner_ids"][0] == -1).all()


@pytest.mark.parametrize("value", OUT_OF_RANGE)
def test_random_embeddings_take_any_integer(value, device, generator):
    call = arguments("random_embeddings", generator, device)
    (good,), (got,) = (
        run("random_embeddings", call)[0],
        run("random_embeddings", corrupted(call, ("voxel_coords",), value))[0],
    )
    assert got.isfinite().all()
    assert torch.equal(got[1:], good[1:])


def test_losses_leave_out_what_has_no_place(device, generator):
    """A depth that is none takes its ray out, t its sample; a cosine that is no number is one that is unknown."""
    call = arguments("rendering_losses", generator, device)

    def losses(argument, value):
        return run("rendering_losses", corrupted(call, (argument,), value))[0][0]

    for value in NO_DEPTH:
        assert torch.equal(losses("target_depth", value), losses("target_depth", 0.0))
    assert torch.equal(losses("t", math.nan), losses("t", math.inf))
    assert losses("t", math.nan).isfinite().all()
    assert torch.equal(losses("cosine", math.nan), losses("cosine", 0.0))


@pytest.mark.parametrize(
    "argument, terms", [("color", [0]), ("target_color", [0]), ("depth", [1]), ("sdf", [2, 3]), ("valid", [])]
)
def test_losses_show_what_is_no_number(argument, terms, device, generator):
    call = arguments("rendering_losses", generator, device)
    call["rendered"][0] = call["valid"][0] = True
    call["target_depth"][0] = call["t"][0].median()  # samples before the surface and near it
    value = False if argument == "valid" else math.nan
    losses = run("rendering_losses", corrupted(call, (argument,), value))[0][0]
    assert losses.isnan().nonzero().flatten().tolist() == terms


@pytest.mark.parametrize("argument", ["before", "last"])
def test_no_pose_is_predicted_from_none(argument, device, generator):
    call = arguments("predict_pose", generator, device)
    (pose,), _ = run("predict_pose", changed(call, (argument,), torch.full((7,), math.nan, device=device)))
    assert pose.isnan().any()


@pytest.mark.parametrize("name", ["track_gauss_newton", "track_adam", "projective_icp"])
def test_tracking_from_no_pose_finds_none(name, device, generator):
    """No pixel falls on the map, nothing moves; the pose that comes back is as broken as the one that went in."""
    call = arguments(name, generator, device)
    results, _ = run(name, changed(call, ("pose",), torch.full((7,), math.nan, device=device)))
    assert results[0].isnan().any()
    assert not results[1].any()


@pytest.mark.parametrize("name, path", [("render_step", ("rays", "poses")), ("optimize_map_", ("poses",))])
def test_rays_from_no_pose_meet_nothing(name, path, device, generator):
    call = arguments(name, generator, device)
    results, own = run(name, corrupted(call, path, math.nan))
    others = [result[1:] if result.shape == (2, 6) else result for result in results]  # but its own gradient
    assert all(result.isfinite().all() for result in others)
    assert all(get(own, part).isfinite().all() for part in tensors(own) if part != path)
