"""The types of what the package exports; what each does is said by its docstring and by `spslam.ops`."""

from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from spslam_numpy._enums import Activation as Activation
from spslam_numpy._enums import RandomStream as RandomStream
from spslam_numpy._hash_table import VoxelHash as VoxelHash
from spslam_numpy._hash_table import VoxelLimitError as VoxelLimitError

__version__: Final[str]
__all__: list[str]
CPU_ISA: Final[str]
ENCODER_PARAMETERS: Final[int]

# Float arrays of one call are all of one dtype, and so is its result.
F = TypeVar("F", np.float32, np.float64)
Bools = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Layout = list[int] | tuple[int, ...]

def set_num_threads(count: int) -> None: ...
def get_num_threads() -> int: ...
def new_voxel_hash(capacity: int) -> tuple[Int64, Int32]: ...
def voxel_hash_absent(hash_keys: Int64, hash_values: Int32, voxel_coords: Int32) -> Int32: ...
def voxel_hash_insert(hash_keys: Int64, hash_values: Int32, voxel_coords: Int32, first_id: int) -> Int32: ...
def voxel_hash_build_(hash_keys: Int64, hash_values: Int32, voxel_coords: Int32) -> None: ...
def voxel_hash_find(hash_keys: Int64, hash_values: Int32, voxel_coords: Int32) -> Int32: ...
def voxel_hash_update_corner_ids(
    hash_keys: Int64, hash_values: Int32, voxel_coords: Int32, corner_ids: Int32, first_new: int
) -> None: ...
def voxel_hash_lookup(
    hash_keys: Int64, hash_values: Int32, corner_ids: Int32, points: NDArray[F], voxel_size: float
) -> tuple[Int32, NDArray[F]]: ...
def trilinear_interpolate(embeddings: NDArray[F], corner_ids: Int32, local_coords: NDArray[F]) -> NDArray[F]: ...
def trilinear_interpolate_backward(
    grad: NDArray[F], embeddings: NDArray[F], corner_ids: Int32, local_coords: NDArray[F]
) -> tuple[NDArray[F], NDArray[F]]: ...
def bilinear_interpolate(texels: NDArray[F], uv: NDArray[F]) -> NDArray[F]: ...
def bilinear_interpolate_backward(
    grad: NDArray[F], texels: NDArray[F], uv: NDArray[F]
) -> tuple[NDArray[F], NDArray[F]]: ...
def tri_plane_interpolate(texels: NDArray[F], points: NDArray[F], cell_size: float, layout: Layout) -> NDArray[F]: ...
def tri_plane_interpolate_backward(
    grad: NDArray[F], texels: NDArray[F], points: NDArray[F], cell_size: float, layout: Layout
) -> tuple[NDArray[F], NDArray[F]]: ...
def philox_uniform(seed: int, stream: int, frame: int, iteration: int, count: int) -> Float32: ...
def sample_indices(seed: int, stream: int, frame: int, iteration: int, count: int, upper: int) -> Int64: ...
def sample_along_rays(
    depth: NDArray[F],
    num_uniform: int,
    num_surface: int,
    near: float,
    far: float,
    truncation: float,
    seed: int,
    stream: int,
    frame: int,
    iteration: int,
) -> NDArray[F]: ...
def volume_render(
    sdf: NDArray[F], color: NDArray[F], t: NDArray[F], valid: Bools, truncation: float
) -> tuple[NDArray[F], NDArray[F], NDArray[F]]: ...
def volume_render_backward(
    grad_color: NDArray[F],
    grad_depth: NDArray[F],
    grad_weights: NDArray[F],
    sdf: NDArray[F],
    color: NDArray[F],
    t: NDArray[F],
    valid: Bools,
    weights: NDArray[F],
    truncation: float,
) -> tuple[NDArray[F], NDArray[F], NDArray[F]]: ...
def rendering_losses(
    color: NDArray[F],
    depth: NDArray[F],
    sdf: NDArray[F],
    t: NDArray[F],
    valid: Bools,
    rendered: Bools,
    target_color: NDArray[F],
    target_depth: NDArray[F],
    cosine: NDArray[F],
    truncation: float,
    cosine_targets: bool,
) -> NDArray[F]: ...
def mlp_num_params(inputs: int, hidden: int, outputs: int) -> int: ...
def mlp(input: NDArray[F], params: NDArray[F], hidden: int, output: int, activation: int = 0) -> NDArray[F]: ...
def mlp_backward(
    grad: NDArray[F], input: NDArray[F], params: NDArray[F], hidden: int, output: int, activation: int = 0
) -> tuple[NDArray[F], NDArray[F]]: ...
def sparse_adam_(
    param: NDArray[F],
    grad: NDArray[F],
    exp_avg: NDArray[F],
    exp_avg_sq: NDArray[F],
    stamps: Int32 | None = None,
    stamp: int = 0,
    *,
    lr: float,
    step: int,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
) -> None: ...
def normal_equations(
    residuals: NDArray[F], jacobians: NDArray[F], weights: NDArray[F]
) -> tuple[NDArray[F], NDArray[F], NDArray[F]]: ...
def solve_normal_equations(
    hessian: NDArray[F], gradient: NDArray[F], damping: float = 0.0, absolute_damping: float = 0.0
) -> NDArray[F]: ...
def depth_normals(
    depth: Float32, pixels: Int32, fx: float, fy: float, cx: float, cy: float, step_px: int, max_jump: float
) -> Float32: ...
def encode_points(
    points: Float32,
    normals: Float32,
    encoder_params: Float32,
    voxel_size: float,
    neighborhood: int = 64,
    min_pair_weight: float = 1e-4,
) -> tuple[Int32, Float32, Float32]: ...
def fuse_prior_(
    embeddings: Float32,
    weights: Float32,
    voxel_ids: Int32,
    features: Float32,
    feature_weights: Float32,
    max_weight: float,
) -> None: ...
def random_embeddings(voxel_coords: Int32, seed: int, scale: float = 0.01) -> Float32: ...
def marching_cubes(cell_coords: Int32, values: Float32, level: float = 0.0) -> tuple[Float32, Int64]: ...
