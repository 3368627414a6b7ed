"""Camera poses by Gauss-Newton on the SDF at back-projected surface points. Not differentiable.

A pixel of depth z is the world point x = R (z d) + t. Its residual is r = truncation * s(x), its weight
1 / (1 + (r / k)^2)^2 (Geman-McClure's), and the increment (dt, domega) moves the camera by dt and turns it by
exp(domega) about its center, so that dr = truncation * grad s . (dt + domega x (x - t)).

Where the noise of depth grows with z^2, as for structured light and stereo, a residual's inverse variance falls as
1 / (1 + (z / z0)^4).

Earlier frames' depth images add, view by view, the signed distance of x from the surface seen there,
(z' q(u', v') - 1) / |grad|, q being the inverse depth between four pixels, which on a plane is linear in the image.
Beside the mean of the views' equations, those of the map count c = (v_views / v_map)^2 in [1e-3, 4], v being the
weighted mean squared residuals where both are known: squared, as the map's error is alike for neighboring pixels and,
unlike a sensor's noise, does not average out.

A reference image adds, pixel by pixel, what direct methods minimize (Kerl et al. 2013): the intensity I of an earlier
frame where x falls in it, less the pixel's own, times a weight in meters.
"""

from typing import NamedTuple

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_count, check_tensor
from spslam.ops._public import public_op
from spslam.ops.scene_view import Intrinsics, SceneView, check_intrinsics

# What red, green and blue count for in a reference's intensity (Rec. 601), in thousandths; the kernel's own.
LUMA_WEIGHTS: tuple[int, int, int] = torch.ops.spslam.luma_weights()

_MAX_DEPTH_KEYFRAMES = 8


@public_op()
def predict_pose(before: torch.Tensor, last: torch.Tensor) -> torch.Tensor:
    """The pose after two given ones if the camera goes on as it went, T1 T0^-1 T1; reads nothing back to the host.

    Args:
        before: float32 [7] T0 = T_world_camera, quaternion (w, x, y, z) and translation (m).
        last: float32 [7] T1.

    Returns:
        float32 [7], its quaternion of norm 1 with w >= 0; not finite where a pose is not.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device.

    Example:
        >>> still = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> moved = torch.tensor([1.0, 0, 0, 0, 0.25, 0, 0])
        >>> predict_pose(still, moved)[4:]
        tensor([0.5000, 0.0000, 0.0000])
    """
    check_tensor("predict_pose", "last", last, (7,), torch.float32)
    check_tensor("predict_pose", "before", before, (7,), torch.float32, like=last)
    return torch.ops.spslam.predict_pose(before, last)


class ReferenceImage(NamedTuple):
    """A small gray image of an earlier frame, to compare colors with.

    Attributes:
        cells: float32 [H, W, 2] intensity in [0, 1] (`LUMA_WEIGHTS`) and depth (m, 0 where unknown). A point is
            compared where it falls between four cells whose depth agrees with its own to a tenth.
        pose: float32 [7] T_world_camera of the frame, unit quaternion (w, x, y, z) and translation (m).
        intrinsics: in cells: those of s x s pixels have focal lengths f / s and principal point (c + 1/2) / s - 1/2.
        weight: m that an intensity difference of 1 counts as.
        kernel: width of the robust kernel, intensity.
    """

    cells: torch.Tensor
    pose: torch.Tensor
    intrinsics: Intrinsics
    weight: float
    kernel: float


class DepthKeyframes(NamedTuple):
    """Depth images of earlier frames, to hold a frame's surface against.

    Attributes:
        images: uint16 [R, H, W] depth in `unit`, 0 where unknown. A point is compared where it falls between four
            pixels with depth whose inverses spread less than 3 %.
        unit: m.
        poses: float32 [F, 7] T_world_camera, unit quaternions (w, x, y, z) and translations (m).
        rows: of each view, at most 8, the row of its image and the row of its pose.
        intrinsics: of the images, px.
        kernel_end: last width of the robust kernel of these distances, m; the first is that of the map's.
        first_iteration: from which on they take part; the map alone brings a pose from farther away.
    """

    images: torch.Tensor
    unit: float
    poses: torch.Tensor
    rows: tuple[tuple[int, int], ...]
    intrinsics: Intrinsics
    kernel_end: float
    first_iteration: int = 0


@public_op()
def track_gauss_newton(
    scene: SceneView,
    pixels: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    *,
    num_pixels: int,
    iterations: int,
    truncation: float,
    kernel_start: float,
    kernel_end: float,
    damping: float,
    seed: int,
    stream: int,
    frame: int,
    score_kernel: float | None = None,
    noise_crossover_depth: float = 0.0,
    reference: ReferenceImage | None = None,
    views: DepthKeyframes | None = None,
    tf32: bool = True,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Tracks one frame against a frozen scene; all iterations in one call, on CUDA in one kernel that never stops for
    the host.

    Each iteration draws pixels anew, solves (H + damping diag(H) + (1e-6 tr(H) + 1e-8) I) delta = -g, and limits the
    step to a norm of 0.15. The kernel width k goes geometrically from `kernel_start` to `kernel_end`, reached one
    iteration before the last. Points outside the map, or where |s| >= 0.98, take no part, and neither do pixels
    without a positive, finite depth nor any from a pose that is not finite.

    Args:
        scene: the map.
        pixels: int32 [P, 3] packed pixel records of the frame, P >= 1 (see csrc/kernels/pixel_record.h).
        pose: float32 [7] start, unit quaternion (w, x, y, z) and translation (m), T_world_camera.
        intrinsics: of the camera.
        num_pixels: drawn in each iteration, with replacement.
        iterations: how many.
        truncation: of the scene's SDF, m.
        kernel_start: first width k of the robust kernel, m.
        kernel_end: last width, m.
        damping: relative Levenberg damping.
        seed, stream, frame: keys of the draws, see `philox_uniform`.
        score_kernel: width of the kernel that the statistics are told by, m, so that poses are judged alike whatever
            kernel finds them; None takes the iteration's own.
        noise_crossover_depth: depth z0 at which noise that grows with z^2 is as large as that of the map, m; pixels weigh
            1 / (1 + (z / z0)^4) of what they would. 0 weighs near and far alike.
        reference: an earlier frame to compare colors with; None uses the surface alone. It takes no part in what the
            statistics say.
        views: earlier frames' depth images; None uses the map alone. They take no part in what statistics and H say.
        tf32: on CUDA devices from sm_80 on, let tensor cores multiply in the decoder, with factors rounded to 10 bits
            of mantissa: under 0.1 mm of SDF. Elsewhere, and without it, everything is float32.

    Returns:
        float32 [7] pose; float32 [iterations, 5] with the weighted mean squared residual (m^2), the share of pixels on
        mapped surface, the norms of the step in translation (m) and rotation (rad), and the mean weight over all pixels
        (0 for those off the map), each before the iteration's step and with the weights of `score_kernel`; float32
        [6, 6] H of the last iteration, scaled as if pixels weighed on average what those weights are, whatever they
        weigh by their depth and the iteration's kernel. The same to the bit every time on one device, and for any
        number of CPU threads.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> pose = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> still, stats, hessian = track_gauss_newton(
        ...     SceneView.empty(), torch.zeros(4, 3, dtype=torch.int32), pose, Intrinsics(60.0, 60.0, 31.5, 23.5),
        ...     num_pixels=4, iterations=2, truncation=0.08, kernel_start=0.08, kernel_end=0.02, damping=1e-4,
        ...     seed=0, stream=1, frame=0)
        >>> torch.equal(still, pose), stats[:, 1]  # nothing is mapped: no pixel takes part, the camera stays
        (True, tensor([0., 0.]))
    """
    name = "track_gauss_newton"
    scene.check(name)
    check_tensor(name, "pixels", pixels, ("P", 3), torch.int32, like=scene.embeddings)
    check(len(pixels) > 0, name, "pixels", "have at least one row", 0)
    check_tensor(name, "pose", pose, (7,), torch.float32, like=scene.embeddings)
    check_intrinsics(name, intrinsics)
    check_count(name, "num_pixels", num_pixels)
    check_count(name, "iterations", iterations)
    check(truncation > 0, name, "truncation", "be positive", truncation)
    check(
        kernel_start > 0 and kernel_end > 0,
        name,
        "kernel_start and kernel_end",
        "be positive",
        (kernel_start, kernel_end),
    )
    check(score_kernel is None or score_kernel > 0, name, "score_kernel", "be positive", score_kernel)
    check(damping >= 0, name, "damping", "be at least 0", damping)
    check(noise_crossover_depth >= 0, name, "noise_crossover_depth", "be at least 0", noise_crossover_depth)
    image: tuple[torch.Tensor | None, torch.Tensor | None, list[float], float, float] = (None, None, [], 0.0, 1.0)
    if reference is not None:
        _check_reference(name, reference, like=scene.embeddings)
        image = (reference.cells, reference.pose, list(reference.intrinsics), reference.weight, reference.kernel)
    earlier: tuple[torch.Tensor | None, torch.Tensor | None, list[int], list[float], float, float, int]
    earlier = (None, None, [], [], 1.0, 1.0, 0)
    if views is not None:
        _check_keyframes(name, views, like=scene.embeddings)
        rows = [row for pair in views.rows for row in pair]
        earlier = (
            views.images,
            views.poses,
            rows,
            list(views.intrinsics),
            views.unit,
            views.kernel_end,
            views.first_iteration,
        )
    return torch.ops.spslam.track_gauss_newton(
        *scene.arguments(),
        pixels,
        pose,
        list(intrinsics),
        num_pixels,
        iterations,
        truncation,
        kernel_start,
        kernel_end,
        score_kernel or 0.0,
        damping,
        seed,
        stream,
        frame,
        noise_crossover_depth,
        *image,
        *earlier,
        tf32,
    )


def _check_reference(name: str, reference: ReferenceImage, like: torch.Tensor) -> None:
    check_tensor(name, "reference.cells", reference.cells, ("H", "W", 2), torch.float32, like=like)
    check_tensor(name, "reference.pose", reference.pose, (7,), torch.float32, like=like)
    check_intrinsics(name, reference.intrinsics, "reference.intrinsics")
    check(reference.weight >= 0, name, "reference.weight", "be at least 0", reference.weight)
    check(reference.kernel > 0, name, "reference.kernel", "be positive", reference.kernel)


def _check_keyframes(name: str, views: DepthKeyframes, like: torch.Tensor) -> None:
    check_tensor(name, "views.images", views.images, ("R", "H", "W"), torch.uint16, like=like)
    check_tensor(name, "views.poses", views.poses, ("F", 7), torch.float32, like=like)
    check_intrinsics(name, views.intrinsics, "views.intrinsics")
    check(views.unit > 0, name, "views.unit", "be positive", views.unit)
    check(views.kernel_end > 0, name, "views.kernel_end", "be positive", views.kernel_end)
    check(views.first_iteration >= 0, name, "views.first_iteration", "be at least 0", views.first_iteration)
    check(
        len(views.rows) <= _MAX_DEPTH_KEYFRAMES,
        name,
        "views.rows",
        f"be at most {_MAX_DEPTH_KEYFRAMES}",
        len(views.rows),
    )
    for image, pose in views.rows:
        inside = 0 <= image < len(views.images) and 0 <= pose < len(views.poses)
        check(inside, name, "views.rows", "name images and poses that are there", (image, pose))


@public_op()
def gauss_newton_poses(
    scene: SceneView,
    pixels: torch.Tensor,
    poses: torch.Tensor,
    intrinsics: Intrinsics,
    *,
    truncation: float,
    kernel: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Normal equations of many frames' poses against a frozen scene, all given pixels used that have a depth.

    Args:
        scene: the map.
        pixels: int32 [F, N, 3] packed pixel records.
        poses: float32 [F, 7].
        intrinsics: of the camera.
        truncation: of the scene's SDF, m.
        kernel: width k of the robust kernel, m.

    Returns:
        H float32 [F, 6, 6], gradient float32 [F, 6], weighted mean squared residual float32 [F] (m^2), share of pixels
        on mapped surface float32 [F]. F = 0 or N = 0 gives empty tensors or zeros, a pose that is not finite zeros.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> pixels, poses = torch.zeros(2, 5, 3, dtype=torch.int32), torch.tensor([[1.0, 0, 0, 0, 0, 0, 0]] * 2)
        >>> camera = Intrinsics(60.0, 60.0, 31.5, 23.5)
        >>> hessian, _, _, inliers = gauss_newton_poses(
        ...     SceneView.empty(), pixels, poses, camera, truncation=0.08, kernel=0.05)
        >>> hessian.shape, inliers
        (torch.Size([2, 6, 6]), tensor([0., 0.]))
    """
    name = "gauss_newton_poses"
    scene.check(name)
    check_tensor(name, "pixels", pixels, ("F", "N", 3), torch.int32, like=scene.embeddings)
    check_tensor(name, "poses", poses, (len(pixels), 7), torch.float32, like=scene.embeddings)
    check_intrinsics(name, intrinsics)
    check(truncation > 0, name, "truncation", "be positive", truncation)
    check(kernel > 0, name, "kernel", "be positive", kernel)
    return torch.ops.spslam.gauss_newton_poses(*scene.arguments(), pixels, poses, list(intrinsics), truncation, kernel)


@torch.library.register_fake("spslam::predict_pose")
def _(before, last):
    return last.new_empty(7)


@torch.library.register_fake("spslam::track_gauss_newton")
def _(scene, scene_scalars, plane_layout, pixels, pose, intrinsics, num_pixels, iterations, *_):
    return pose.new_empty(7), pose.new_empty((iterations, 5)), pose.new_empty((6, 6))


@torch.library.register_fake("spslam::gauss_newton_poses")
def _(scene, scene_scalars, plane_layout, pixels, poses, *_):
    frames = poses.shape[0]
    return (
        poses.new_empty((frames, 6, 6)),
        poses.new_empty((frames, 6)),
        poses.new_empty(frames),
        poses.new_empty(frames),
    )
