"""A whole mapping call: all iterations of the joint optimization of scene and poses in one op (section III.D)."""

from dataclasses import dataclass

import torch

from spslam.ops import _library, trusted  # noqa: F401
from spslam.ops._checks import check, check_count, check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops.launch_graph import LaunchGraph
from spslam.ops.ray_sampling import RandomStream
from spslam.ops.render_step import RenderOptions
from spslam.ops.scene_view import Intrinsics, SceneView, check_intrinsics


@dataclass(frozen=True)
class AdamMoments:
    """What Adam keeps of a tensor of parameters, and its learning rate.

    Attributes:
        exp_avg: float32, first moment, of the parameters' shape; may have spare rows.
        exp_avg_sq: second moment, likewise.
        rate: learning rate.
    """

    exp_avg: torch.Tensor
    exp_avg_sq: torch.Tensor
    rate: float

    def check(self, function: str, name: str, param: torch.Tensor) -> None:
        """Raises TypeError or ValueError, naming `function`, where a tensor does not fit `param`."""
        _check_rows(function, f"{name}.exp_avg", self.exp_avg, param, torch.float32)
        _check_rows(function, f"{name}.exp_avg_sq", self.exp_avg_sq, param, torch.float32)
        check(param.is_contiguous(), function, name, "be contiguous", f"strides {param.stride()}")
        check(self.rate >= 0, function, f"{name}.rate", "be at least 0", self.rate)

    def tensors(self) -> list[torch.Tensor]:
        """As the op's schema takes them."""
        return [self.exp_avg, self.exp_avg_sq]


@dataclass(frozen=True)
class AdamTable(AdamMoments):
    """The same of a table of which each iteration touches some rows.

    Attributes:
        gradients: sums of an iteration's gradients as `new_gradient_sums` makes them, of the parameters' shape; zero
            before and after a call.
        stamps: int32 [rows], the iteration that last touched a row.
    """

    gradients: torch.Tensor
    stamps: torch.Tensor

    def check(self, function: str, name: str, param: torch.Tensor) -> None:
        """Raises TypeError or ValueError, naming `function`, where a tensor does not fit `param`."""
        super().check(function, name, param)
        _check_rows(function, f"{name}.gradients", self.gradients, param, _gradient_dtype(param.device))
        _check_rows(function, f"{name}.stamps", self.stamps, param[:, 0], torch.int32)

    def tensors(self) -> list[torch.Tensor]:
        """As the op's schema takes them."""
        return [self.exp_avg, self.exp_avg_sq, self.gradients, self.stamps]


@dataclass(frozen=True)
class MapMoments:
    """Which parameters a mapping call optimizes. What is None is frozen.

    Attributes:
        embeddings, texels: of the scene's tables.
        geometry_params, color_params: of its decoders.
        poses: of the poses [F, 7].
    """

    embeddings: AdamTable | None = None
    texels: AdamTable | None = None
    geometry_params: AdamMoments | None = None
    color_params: AdamMoments | None = None
    poses: AdamMoments | None = None

    def check(self, function: str, scene: SceneView, poses: torch.Tensor) -> None:
        """Raises TypeError or ValueError, naming `function`, where a tensor does not fit."""
        params = (scene.embeddings, scene.texels, scene.geometry_params, scene.color_params, poses)
        for name, moments, param in zip(_PARAMETERS, self.all(), params, strict=True):
            if moments is not None:
                moments.check(function, name, param)

    def all(self) -> tuple[AdamMoments | None, ...]:
        """In the order of the attributes."""
        return self.embeddings, self.texels, self.geometry_params, self.color_params, self.poses

    def arguments(self) -> tuple[list[torch.Tensor], list[float]]:
        """What the schema takes: the tensors of what is not frozen, and all rates, -1 where frozen."""
        tensors = [tensor for moments in self.all() if moments is not None for tensor in moments.tensors()]
        return tensors, [-1.0 if moments is None else moments.rate for moments in self.all()]


_PARAMETERS = ("embeddings", "texels", "geometry_params", "color_params", "poses")


@public_op(as_given=("param",))
def new_gradient_sums(param: torch.Tensor) -> torch.Tensor:
    """Zeros for the sums of a parameter's gradients.

    Args:
        param: [V, C] or any shape.

    Returns:
        zeros of the shape and device of `param`: float32 on the CPU, where sums have a fixed order, int64 (fixed point)
        on CUDA, where they have not. V = 0 gives an empty tensor.

    Raises:
        TypeError: `param` is no tensor.

    Example:
        >>> new_gradient_sums(torch.ones(2, 3)).shape
        torch.Size([2, 3])
    """
    if not isinstance(param, torch.Tensor):
        raise TypeError(f"new_gradient_sums: param must be a torch.Tensor, got {type(param).__name__}")
    return torch.zeros(param.shape, dtype=_gradient_dtype(param.device), device=param.device)


@public_op(as_given=("poses",))
def optimize_map_(
    scene: SceneView,
    records: torch.Tensor,
    poses: torch.Tensor,
    frames: torch.Tensor,
    intrinsics: Intrinsics,
    options: RenderOptions,
    moments: MapMoments,
    *,
    num_pixels: int,
    iterations: int,
    fixed_frame: int,
    first_step: int,
    first_stamp: int,
    first_color_step: int | None = None,
    pixel_stream: int = RandomStream.MAPPING_PIXELS,
    graph: LaunchGraph | None = None,
) -> torch.Tensor:
    """Optimizes scene and poses over chosen frames, in place; all iterations in one call.

    Iteration i draws `num_pixels` pixels, shared evenly by the frames, as `sample_indices` does with `pixel_stream` and
    iteration `options.iteration + i`; makes a `render_step` with them; and takes one Adam step (as `sparse_adam_`) on
    the rows touched, on the decoders, and on quaternion and translation of the frames' poses, whose quaternions are
    then normalized. On CUDA nothing waits for the device.

    Args:
        scene: the map. Its tables and decoders are changed where `moments` are given.
        records: int32 [F, P, 3] packed pixel records of all frames, see `RayBatch`.
        poses: float32 [F, 7] T_world_camera; changed where their moments are given; contiguous.
        frames: int64 [n] distinct rows of the frames to draw from, n >= 1, on the CPU or the scene's device. There
            they are not looked at before they are used: each must be in [0, F).
        intrinsics: of the cameras.
        options: of the first iteration; `pose_gradient` is not read.
        moments: what is optimized.
        num_pixels: R, rays per iteration, at least 1.
        iterations: I, at least 1.
        fixed_frame: row of `poses` that is not changed, as the gauge of the reconstruction; -1 for none.
        first_step: 1-based number of the first Adam step since the moments were zero.
        first_stamp: stamp of the first iteration; the I from it on must be new to the tables.
        first_color_step: as `first_step`, of the moments of `texels` and `color_params`; None is that one.
        pixel_stream: random stream of the draw.
        graph: where the call's CUDA graph is kept; without one the kernels are launched one after the other.

    Returns:
        float32 [I, 5] losses of each iteration, as `RenderStep.losses`.

        Deterministic: the same bits for any number of CPU threads and, on CUDA, from run to run. On CUDA the ray kernel
        takes up to 64 samples per ray; beyond that the single ops run one after the other, to the same effect.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> options = RenderOptions(
        ...     32, 11, near=0.2, far=1.02, truncation=0.08, cosine_targets=True, weight_rgb=10.0, weight_depth=0.1,
        ...     weight_free_space=20.0, weight_sdf=1000.0, seed=0, stream=4, frame=0, iteration=0)
        >>> scene, poses = SceneView.empty(), torch.tensor([[1.0, 0, 0, 0, 0, 0, 0]])
        >>> decoder = AdamMoments(torch.zeros(1473), torch.zeros(1473), rate=1e-3)
        >>> losses = optimize_map_(
        ...     scene, torch.zeros(1, 50, 3, dtype=torch.int32), poses, torch.tensor([0]),
        ...     Intrinsics(60.0, 60.0, 31.5, 23.5), options, MapMoments(geometry_params=decoder),
        ...     num_pixels=64, iterations=5, fixed_frame=0, first_step=1, first_stamp=1)
        >>> losses.shape
        torch.Size([5, 5])
    """
    name = "optimize_map_"
    scene.check(name)
    options.check(name)
    check_tensor(name, "records", records, ("F", "P", 3), torch.int32, like=scene.embeddings)
    check(records.shape[1] >= 1, name, "records", "hold at least one pixel per frame", list(records.shape))
    check_tensor(name, "poses", poses, (len(records), 7), torch.float32, like=scene.embeddings)
    check(poses.is_contiguous(), name, "poses", "be contiguous", f"strides {poses.stride()}")
    on_cpu = isinstance(frames, torch.Tensor) and frames.device.type == "cpu"
    check_tensor(name, "frames", frames, ("n",), torch.int64, like=None if on_cpu else poses)
    check(len(frames) >= 1, name, "frames", "name at least one frame", len(frames))
    check_intrinsics(name, intrinsics)
    moments.check(name, scene, poses)
    check_count(name, "num_pixels", num_pixels)
    check_count(name, "iterations", iterations)
    check_count(name, "first_step", first_step)
    color_step = first_step if first_color_step is None else first_color_step
    check_count(name, "first_color_step", color_step)
    last_stamp = first_stamp + iterations - 1
    check(first_stamp >= -(2**31) and last_stamp < 2**31, name, "first_stamp", "fit 32 bits", first_stamp)
    integers = [int(pixel_stream), num_pixels, iterations, fixed_frame, first_step, color_step, first_stamp]
    losses = trusted.optimize_map_(scene, records, poses, frames, intrinsics, options, moments, integers, graph)
    params = (scene.embeddings, scene.texels, scene.geometry_params, scene.color_params, poses)
    optimized = [param for one, param in zip(moments.all(), params, strict=True) if one is not None]
    changed_in_place(*optimized, *moments.arguments()[0])
    return losses


def _gradient_dtype(device: torch.device) -> torch.dtype:
    return torch.int64 if device.type == "cuda" else torch.float32


def _check_rows(function: str, argument: str, tensor: torch.Tensor, param: torch.Tensor, dtype: torch.dtype) -> None:
    """Checks a tensor of at least as many rows as `param`, else of its shape."""
    check_tensor(function, argument, tensor, ("rows", *param.shape[1:]), dtype, like=param)
    check(len(tensor) >= len(param), function, argument, f"have at least {len(param)} rows", len(tensor))
    check(tensor.is_contiguous(), function, argument, "be contiguous", f"strides {tensor.stride()}")


@torch.library.register_fake("spslam::optimize_map_")
def _optimize_map_fake(*args):
    return None
