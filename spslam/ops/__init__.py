"""Kernels for sparse neural reconstruction: the public op library, independent of the rest of spslam."""

from spslam.ops._library import CPU_ISA, CUDA_OFF_REASON
from spslam.ops.interpolation import bilinear_interpolate, tri_plane_interpolate, trilinear_interpolate
from spslam.ops.optimizer import normal_equations, solve_normal_equations, sparse_adam_
from spslam.ops.ray_sampling import Stream, philox_uniform, sample_indices

__all__ = [
    "CPU_ISA",
    "CUDA_OFF_REASON",
    "Stream",
    "bilinear_interpolate",
    "normal_equations",
    "philox_uniform",
    "sample_indices",
    "solve_normal_equations",
    "sparse_adam_",
    "tri_plane_interpolate",
    "trilinear_interpolate",
]
