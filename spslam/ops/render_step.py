"""One step of tracking or mapping, fused: rays in, losses and gradients out (sections III.B, III.C).

The composable ops compute the same one at a time (`sample_along_rays`, `voxel_hash_find`, `trilinear_interpolate`,
`mlp`, `volume_render`, `rendering_losses`). Here the forward and backward pass of a ray run while its samples are in
the cache, and samples outside the allocated voxels are skipped.
"""

from dataclasses import dataclass

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_key, check_tensor
from spslam.ops._public import public_op
from spslam.ops.scene_view import COLOR_PARAMS, GEOMETRY_PARAMS, Intrinsics, SceneView, check_intrinsics

PRECISIONS = ("tf32", "fp32")


@dataclass(frozen=True)
class RayBatch:
    """R rays of F cameras with one pinhole model.

    Attributes:
        pixels: int32 [R, 3] packed pixel records (csrc/kernels/pixel_record.h): u | v << 16, the bits of the float32
            depth (m, 0 = invalid), r | g << 8 | b << 16 | c << 24 with c = 128 n.d, the foreshortening (0 = unknown).
        ray_frames: int32 [R] row of `poses` that a ray starts from, not decreasing.
        poses: float32 [F, 7] T_world_camera as quaternion (w, x, y, z) and translation (m).
        intrinsics: of the cameras.
    """

    pixels: torch.Tensor
    ray_frames: torch.Tensor
    poses: torch.Tensor
    intrinsics: Intrinsics

    def check(self, function: str, like: torch.Tensor) -> None:
        """Raises TypeError or ValueError, naming `function`, where a tensor does not fit."""
        check_tensor(function, "ray_frames", self.ray_frames, ("R",), torch.int32, like=like)
        check_tensor(function, "pixels", self.pixels, (len(self.ray_frames), 3), torch.int32, like=like)
        check_tensor(function, "poses", self.poses, ("F", 7), torch.float32, like=like)
        check_intrinsics(function, self.intrinsics)


@dataclass(frozen=True)
class RenderOptions:
    """How rays are sampled and what the losses weigh.

    Attributes:
        num_uniform: samples spread over the ray, stratified, N_c.
        num_surface: samples within the truncation distance of the measured depth, N_f.
        near, far: where the uniform ones begin and end, as shares of the measured depth.
        truncation: distance at which the SDF saturates, m.
        cosine_targets: measure distances to the surface's tangent plane (depth difference times the pixel's
            foreshortening, at least 0.15), not along the ray.
        weight_rgb, weight_depth, weight_free_space, weight_sdf: weights of equations (8), (9), (11), (10). Color is
            not evaluated where weight_rgb is 0.
        seed, stream, frame, iteration: keys of the sampling, see `philox_uniform`.
        pose_gradient: whether the gradient of the poses is wanted.
        precision: "tf32" multiplies in the decoders on tensor cores, with factors of 10 bits of mantissa summed in
            float32, and sums the decoders' gradients of bfloat16 factors; "fp32" stays in float32. It applies to CUDA
            devices with tensor cores and up to 64 samples per ray; elsewhere everything is float32.
    """

    num_uniform: int
    num_surface: int
    near: float
    far: float
    truncation: float
    cosine_targets: bool
    weight_rgb: float
    weight_depth: float
    weight_free_space: float
    weight_sdf: float
    seed: int
    stream: int
    frame: int
    iteration: int
    pose_gradient: bool = True
    precision: str = "tf32"

    def check(self, function: str) -> None:
        """Raises ValueError, naming `function`, where a number is out of range."""
        check(self.num_uniform >= 0, function, "num_uniform", "be at least 0", self.num_uniform)
        check(self.num_surface >= 0, function, "num_surface", "be at least 0", self.num_surface)
        samples = self.num_uniform + self.num_surface
        check(1 <= samples <= 65536, function, "num_uniform + num_surface", "be in [1, 65536]", samples)
        check(0 <= self.near <= self.far, function, "near and far", "be 0 <= near <= far", (self.near, self.far))
        check(self.truncation > 0, function, "truncation", "be positive", self.truncation)
        check_key(function, self.frame, self.iteration)
        check(self.precision in PRECISIONS, function, "precision", f"be {' or '.join(PRECISIONS)}", self.precision)

    def arguments(self, intrinsics: Intrinsics) -> tuple[list[float], list[int]]:
        """The scalars and integers of schemas: the enums in csrc/bindings/render_options.h."""
        weights = [self.weight_rgb, self.weight_depth, self.weight_free_space, self.weight_sdf]
        samples = [self.num_uniform, self.num_surface, int(self.cosine_targets)]
        key = [self.seed, int(self.stream), self.frame, self.iteration]
        scalars = [*intrinsics, self.near, self.far, self.truncation, *weights]
        return scalars, [*samples, *key, PRECISIONS.index(self.precision)]


@dataclass(frozen=True)
class SceneGradients:
    """Where the gradients of a scene's tables are added up. What is None is frozen.

    Attributes:
        embeddings: float32 [>= V, 8]; rows used are zero before the call.
        embedding_stamps: int32 [>= V]; set to `stamp` in every row of `embeddings` that the rays reach.
        texels: float32 [>= P, 32], as `embeddings`.
        texel_stamps: int32 [>= P].
        stamp: a number that no row carries yet, such as a running count of steps.
    """

    embeddings: torch.Tensor | None
    embedding_stamps: torch.Tensor | None
    texels: torch.Tensor | None
    texel_stamps: torch.Tensor | None
    stamp: int

    def check(self, function: str, scene: SceneView) -> None:
        """Raises TypeError or ValueError, naming `function`, where a tensor does not fit."""
        wanted = (
            ("embeddings", self.embeddings, torch.float32, scene.embeddings, 8),
            ("embedding_stamps", self.embedding_stamps, torch.int32, scene.embeddings, None),
            ("texels", self.texels, torch.float32, scene.texels, 32),
            ("texel_stamps", self.texel_stamps, torch.int32, scene.texels, None),
        )
        for name, tensor, dtype, table, channels in wanted:
            if tensor is None:
                continue
            argument = f"gradients.{name}"
            shape = ("rows",) if channels is None else ("rows", channels)
            check_tensor(function, argument, tensor, shape, dtype, like=table)
            check(len(tensor) >= len(table), function, argument, f"have at least {len(table)} rows", len(tensor))
            check(tensor.is_contiguous(), function, argument, "be contiguous", f"strides {tensor.stride()}")


@dataclass(frozen=True)
class RenderStep:
    """Results of `render_step`.

    Attributes:
        losses: float32 [5]: the weighted total, then the terms without weights: rgb (0 where it has
            no weight), depth (m^2), free space, SDF (m^2).
        grad_poses: float32 [F, 6] dL/d translation (1/m) and dL/d omega (1/rad), omega turning the camera about its
            center by exp(omega) R; None where not wanted.
        grad_geometry: float32 [1473] of the geometry decoder; None where embeddings are frozen.
        grad_color: float32 [2211] of the color decoder; None where texels are frozen.
    """

    losses: torch.Tensor
    grad_poses: torch.Tensor | None
    grad_geometry: torch.Tensor | None
    grad_color: torch.Tensor | None


@public_op()
def render_step(
    scene: SceneView, rays: RayBatch, options: RenderOptions, gradients: SceneGradients | None = None
) -> RenderStep:
    """Renders rays, computes the losses against the measurements, and their gradients.

    Total = weight_rgb (8) + weight_depth (9) + weight_sdf (10) + weight_free_space (11) of the paper, all averaged over
    the R rays; a ray without a positive, finite depth adds nothing but counts, and so does one from a pose that is not
    finite. Samples along a ray and the terms are those of
    `sample_along_rays`, `volume_render` and `rendering_losses`, of which this is the fusion. Points outside complete
    cells have SDF 1, weight 0 and no gradient.

    Voxel coordinates are floor(point / voxel_size) of world points; the geometry decoder sees
    ((point - origin) * position_scale, embedding).

    Args:
        scene: the map; not changed.
        rays: what was measured, and from where.
        options: sampling, weights and random keys.
        gradients: where the scene's gradients go; None (tracking) freezes the scene.

    Returns:
        losses and gradients. R = 0 gives zeros.

        Every sum has a fixed order: the same bits for any number of threads and, on CUDA, from run to run. Rows of
        `gradients` must not be shared with another call under way.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> rays = RayBatch(
        ...     pixels=torch.zeros(8, 3, dtype=torch.int32), ray_frames=torch.zeros(8, dtype=torch.int32),
        ...     poses=torch.tensor([[1.0, 0, 0, 0, 0, 0, 0]]), intrinsics=Intrinsics(60.0, 60.0, 31.5, 23.5))
        >>> options = RenderOptions(
        ...     32, 11, near=0.2, far=1.02, truncation=0.08, cosine_targets=True, weight_rgb=10.0, weight_depth=0.1,
        ...     weight_free_space=20.0, weight_sdf=1000.0, seed=0, stream=2, frame=0, iteration=0)
        >>> step = render_step(SceneView.empty(), rays, options)
        >>> step.losses, step.grad_poses.shape
        (tensor([0., 0., 0., 0., 0.]), torch.Size([1, 6]))
    """
    name = "render_step"
    scene.check(name)
    rays.check(name, scene.embeddings)
    options.check(name)
    if gradients is not None:
        gradients.check(name, scene)
    g = gradients or SceneGradients(None, None, None, None, 0)
    new = rays.poses.new_empty
    step = RenderStep(
        losses=new(5),
        grad_poses=new(len(rays.poses), 6) if options.pose_gradient else None,
        grad_geometry=None if g.embeddings is None else new(GEOMETRY_PARAMS),
        grad_color=None if g.texels is None else new(COLOR_PARAMS),
    )
    torch.ops.spslam.render_step(
        *scene.arguments(),
        [rays.pixels, rays.ray_frames, rays.poses],
        *options.arguments(rays.intrinsics),
        g.stamp,
        step.losses,
        step.grad_poses,
        _decoder_outputs(step.grad_geometry, g.embeddings, g.embedding_stamps),
        _decoder_outputs(step.grad_color, g.texels, g.texel_stamps),
    )
    return step


def _decoder_outputs(
    params: torch.Tensor | None, table: torch.Tensor | None, stamps: torch.Tensor | None
) -> list[torch.Tensor]:
    """Gradients of a decoder and of its table, and the table's stamps if any; nothing where they are frozen."""
    if params is None or table is None:
        return []
    return [params, table] if stamps is None else [params, table, stamps]


@torch.library.register_fake("spslam::render_step")
def _render_step_fake(*args):
    return None
