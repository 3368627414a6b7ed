"""A whole tracking call with Adam on quaternion and translation, as in the paper (section III.D)."""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_count, check_tensor
from spslam.ops._public import public_op
from spslam.ops.launch_graph import LaunchGraph
from spslam.ops.ray_sampling import RandomStream
from spslam.ops.render_step import RenderOptions
from spslam.ops.scene_view import Intrinsics, SceneView, check_intrinsics


@public_op()
def track_adam(
    scene: SceneView,
    records: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    options: RenderOptions,
    *,
    num_pixels: int,
    iterations: int,
    rotation_rate: float,
    translation_rate: float,
    pixel_stream: int = RandomStream.TRACKING_PIXELS,
    graph: LaunchGraph | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tracks one frame against a frozen scene; all iterations in one call.

    Iteration i draws `num_pixels` of the records as `sample_indices` does with `pixel_stream` and iteration
    `options.iteration + i`, makes a `render_step` with them, keeps the pose if its total loss is the least so far, and
    takes an Adam step (beta 0.9 and 0.999, epsilon 1e-8) on quaternion and translation; the quaternion is then
    normalized. On CUDA nothing waits for the device.

    Args:
        scene: the map; not changed.
        records: int32 [P, 3] packed pixel records of the frame, see `RayBatch`; P >= 1.
        pose: float32 [7] where to start: unit quaternion (w, x, y, z) and translation (m).
        intrinsics: of the camera.
        options: of the first iteration; `pose_gradient` is not read.
        num_pixels: R, rays per iteration, at least 1.
        iterations: I, at least 1.
        rotation_rate: learning rate of the quaternion.
        translation_rate: learning rate of the translation, m.
        pixel_stream: random stream of the draw.
        graph: where the call's CUDA graph is kept; without one the kernels are launched one after the other.

    Returns:
        float32 [7], the pose with the least loss; `pose` where every loss is NaN. And float32 [I, 5], the losses before
        each step, as `RenderStep.losses`.

        Deterministic: the same bits for any number of CPU threads and, on CUDA, from run to run.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> options = RenderOptions(
        ...     32, 11, near=0.2, far=1.02, truncation=0.08, cosine_targets=True, weight_rgb=10.0, weight_depth=0.1,
        ...     weight_free_space=20.0, weight_sdf=1000.0, seed=0, stream=2, frame=0, iteration=0)
        >>> pose, losses = track_adam(
        ...     SceneView.empty(), torch.zeros(50, 3, dtype=torch.int32), torch.tensor([1.0, 0, 0, 0, 0, 0, 0]),
        ...     Intrinsics(60.0, 60.0, 31.5, 23.5), options, num_pixels=64, iterations=6, rotation_rate=1e-3,
        ...     translation_rate=2e-3)
        >>> losses.shape, pose[0]
        (torch.Size([6, 5]), tensor(1.))
    """
    name = "track_adam"
    scene.check(name)
    options.check(name)
    check_tensor(name, "records", records, ("P", 3), torch.int32, like=scene.embeddings)
    check(len(records) >= 1, name, "records", "hold at least one pixel", len(records))
    check_tensor(name, "pose", pose, (7,), torch.float32, like=scene.embeddings)
    check_intrinsics(name, intrinsics)
    check_count(name, "num_pixels", num_pixels)
    check_count(name, "iterations", iterations)
    check(rotation_rate >= 0, name, "rotation_rate", "be at least 0", rotation_rate)
    check(translation_rate >= 0, name, "translation_rate", "be at least 0", translation_rate)
    with torch.no_grad():
        return torch.ops.spslam.track_adam(
            *scene.arguments(),
            records,
            pose,
            *options.arguments(intrinsics),
            [rotation_rate, translation_rate],
            # The enum Integer in csrc/bindings/track_adam.cpp.
            [int(pixel_stream), num_pixels, iterations, 0 if graph is None else graph.number(pose.device)],
        )


_ITERATIONS = 2  # among the integers


@torch.library.register_fake("spslam::track_adam")
def _(scene, scene_scalars, plane_layout, records, pose, render_scalars, render_integers, rates, integers):
    return pose.new_empty(7), pose.new_empty(integers[_ITERATIONS], 5)
