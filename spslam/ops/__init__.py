"""Public op library for sparse neural reconstruction, with CPU and CUDA kernels; independent of the rest of spslam."""

from spslam.ops import comparison, trusted
from spslam.ops._library import CPU_ISA, CUDA_OFF_REASON, get_num_threads, set_num_threads
from spslam.ops.alpha_composite import Composite, alpha_composite, neus_alpha, pack_rays, volsdf_density
from spslam.ops.capture_timing import CaptureTiming, measure_capture_timing_
from spslam.ops.copy_rows import copy_rows_
from spslam.ops.covisibility import frame_overlap, select_covisible_frames
from spslam.ops.decoders import Activation, mlp, mlp_num_params
from spslam.ops.depth_image_alignment import (
    AlignmentOptions,
    DepthImageComparison,
    DepthImages,
    DrawnPixels,
    align_depth_images,
    compare_depth_images,
)
from spslam.ops.depth_planes import measure_planes
from spslam.ops.descriptors import nearest_descriptors
from spslam.ops.earlier_frames import (
    LUMA_WEIGHTS,
    NO_MOTION,
    ColorTiming,
    DepthKeyframes,
    Exposure,
    FrameMotion,
    ReferenceImage,
)
from spslam.ops.encode_frame import EncodedFrame, FrameFusion, VolumeBuffers, encode_frame_
from spslam.ops.gauss_newton import GaussNewtonOptions, gauss_newton_poses, predict_pose, track_gauss_newton
from spslam.ops.grid_levels import GridLevel, TriPlaneLevels, VolumeLevels, tri_planes_from_chw
from spslam.ops.grids import interpolate_tri_planes, interpolate_volumes
from spslam.ops.hash_table import VoxelHash, VoxelLimitError
from spslam.ops.interpolation import bilinear_interpolate, tri_plane_interpolate, trilinear_interpolate
from spslam.ops.launch_graph import LaunchGraph
from spslam.ops.marching_cubes import marching_cubes
from spslam.ops.mlp_params import Sine, mlp_init_params, mlp_params_from, mlp_to_sequential
from spslam.ops.optimize_map import AdamMoments, AdamTable, MapMoments, new_gradient_sums, optimize_map_
from spslam.ops.optimizer import normal_equations, solve_normal_equations, sparse_adam_
from spslam.ops.pixel_sampling import PixelSampling, sample_frame_pixels, unproject_pixels
from spslam.ops.prior_fusion import ENCODER_PARAMETERS, depth_normals, encode_points, fuse_prior_, random_embeddings
from spslam.ops.projective_icp import projective_icp
from spslam.ops.ray_sampling import RandomStream, philox_uniform, sample_along_rays, sample_indices
from spslam.ops.render_step import RayBatch, RenderOptions, RenderStep, SceneGradients, render_step
from spslam.ops.rolling_shutter import ShutterMotion, rectify_shutter_images_, rectify_shutter_records_
from spslam.ops.scene_query import query_color, query_sdf, query_sdf_gradient
from spslam.ops.scene_view import Intrinsics, SceneView
from spslam.ops.seen_points import SurfacePoints, add_color_detail_, add_seen_colors_, see_points
from spslam.ops.sensor_noise import SensorNoise, measure_noise_
from spslam.ops.track_adam import track_adam
from spslam.ops.tsdf import tsdf_integrate_, tsdf_query, tsdf_ray_cast, tsdf_touched_blocks
from spslam.ops.tsdf_volume import TsdfVolume
from spslam.ops.volume_rendering import rendering_losses, volume_render
from spslam.ops.voxel_hash import (
    new_voxel_hash,
    voxel_hash_absent,
    voxel_hash_build_,
    voxel_hash_find,
    voxel_hash_insert,
    voxel_hash_lookup,
    voxel_hash_update_corner_ids,
)

__all__ = [
    "CPU_ISA",
    "CUDA_OFF_REASON",
    "ENCODER_PARAMETERS",
    "LUMA_WEIGHTS",
    "NO_MOTION",
    "Activation",
    "AdamMoments",
    "AdamTable",
    "AlignmentOptions",
    "CaptureTiming",
    "ColorTiming",
    "Composite",
    "DepthImageComparison",
    "DepthImages",
    "DepthKeyframes",
    "DrawnPixels",
    "EncodedFrame",
    "FrameFusion",
    "Exposure",
    "FrameMotion",
    "GaussNewtonOptions",
    "GridLevel",
    "Intrinsics",
    "LaunchGraph",
    "MapMoments",
    "PixelSampling",
    "RandomStream",
    "RayBatch",
    "ReferenceImage",
    "RenderOptions",
    "RenderStep",
    "SceneGradients",
    "SceneView",
    "SensorNoise",
    "ShutterMotion",
    "Sine",
    "SurfacePoints",
    "TriPlaneLevels",
    "TsdfVolume",
    "VolumeBuffers",
    "VolumeLevels",
    "VoxelHash",
    "VoxelLimitError",
    "add_color_detail_",
    "add_seen_colors_",
    "align_depth_images",
    "alpha_composite",
    "bilinear_interpolate",
    "compare_depth_images",
    "comparison",
    "copy_rows_",
    "depth_normals",
    "encode_frame_",
    "encode_points",
    "frame_overlap",
    "fuse_prior_",
    "gauss_newton_poses",
    "get_num_threads",
    "interpolate_tri_planes",
    "interpolate_volumes",
    "marching_cubes",
    "measure_capture_timing_",
    "measure_noise_",
    "measure_planes",
    "mlp",
    "mlp_init_params",
    "mlp_num_params",
    "mlp_params_from",
    "mlp_to_sequential",
    "nearest_descriptors",
    "neus_alpha",
    "new_gradient_sums",
    "new_voxel_hash",
    "normal_equations",
    "optimize_map_",
    "pack_rays",
    "philox_uniform",
    "predict_pose",
    "projective_icp",
    "query_color",
    "query_sdf",
    "query_sdf_gradient",
    "random_embeddings",
    "rectify_shutter_images_",
    "rectify_shutter_records_",
    "render_step",
    "rendering_losses",
    "sample_along_rays",
    "sample_frame_pixels",
    "sample_indices",
    "see_points",
    "select_covisible_frames",
    "set_num_threads",
    "solve_normal_equations",
    "sparse_adam_",
    "track_adam",
    "track_gauss_newton",
    "tri_plane_interpolate",
    "tri_planes_from_chw",
    "trilinear_interpolate",
    "trusted",
    "tsdf_integrate_",
    "tsdf_query",
    "tsdf_ray_cast",
    "tsdf_touched_blocks",
    "unproject_pixels",
    "volsdf_density",
    "volume_render",
    "voxel_hash_absent",
    "voxel_hash_build_",
    "voxel_hash_find",
    "voxel_hash_insert",
    "voxel_hash_lookup",
    "voxel_hash_update_corner_ids",
]
