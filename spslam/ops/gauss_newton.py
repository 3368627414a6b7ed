"""Camera poses by Gauss-Newton on the SDF at back-projected surface points. Not differentiable.

A pixel of depth z is the world point x = R (z d) + t. Its residual is r = truncation * s(x), its weight
1 / (1 + (r / k)^2)^2 (Geman-McClure's), and the increment (dt, domega) moves the camera by dt and turns it by
exp(domega) about its center, so that dr = truncation * grad s . (dt + domega x (x - t)).

With the sensor's noise (`SensorNoise`) a residual's weight is multiplied by m^2 / (m^2 + v(z)), v(z) being the variance
of the pixel's depth and m = 3 mm the deviation of the map; against a keyframe by v(0) / v(z), v(0) at most m^2.

Each depth keyframe, an earlier frame's depth image, adds the signed distance of x from the surface that it measured,
(z' q(u', v') - 1) / |grad|, q being the inverse depth between four pixels, which on a plane is linear in the image.
The map's equations weigh c = (v_keyframes / v_map)^2 in [1e-3, 4] against the mean of the keyframes', v being the
weighted mean squared residuals where both are known: squared, as the map's error is alike for neighboring pixels and,
unlike a sensor's noise, does not average out.

Where the noise and a keyframe's intensities are given, each pixel adds the photometric residual of direct methods (Kerl
et al. 2013) against it, 2 sqrt(v(0)) min(1, e0 / e) (I_keyframe(u', v') - I) / d, with the deviation
d = sqrt(s^2 + e^2 |grad I_keyframe|^2), the robust weight of width 3 d (wider in early iterations, as the kernel of
distances), and e0 = 0.3 px: images that are worse registered are so alike for neighboring pixels.

A reference image adds the photometric residual of direct methods (Kerl et al. 2013) for each pixel: the intensity I of
an earlier frame at the projection of x, less the pixel's own, times a weight in meters.

Where gains are known (`Exposure`), intensities of an earlier frame of log gain a count exp(b - a) times in both, at
most 1; b, of the frame itself, is one more unknown, which the normal equations of the pose are solved without (Schur
complement) and which then takes its own step, of at most 0.2.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch

from spslam.ops import _library, trusted  # noqa: F401
from spslam.ops._checks import check, check_count, check_key, check_tensor
from spslam.ops._public import public_op
from spslam.ops.earlier_frames import DepthKeyframes, ReferenceImage
from spslam.ops.scene_view import Intrinsics, SceneView, check_intrinsics


@public_op()
def predict_pose(before: torch.Tensor, last: torch.Tensor, steps: float = 1.0) -> torch.Tensor:
    """The pose after two given ones at constant speed, (T1 T0^-1)^steps T1; reads nothing back to the host.

    Args:
        before: float32 [7] T0 = T_world_camera, quaternion (w, x, y, z) and translation (m).
        last: float32 [7] T1.
        steps: time from T1 to the pose, in times from T0 to T1; above 0.

    Returns:
        float32 [7], its quaternion of norm 1 with w >= 0; not finite where a pose is not.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device; steps that are not above 0 and finite.

    Example:
        >>> still = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> moved = torch.tensor([1.0, 0, 0, 0, 0.25, 0, 0])
        >>> predict_pose(still, moved)[4:]
        tensor([0.5000, 0.0000, 0.0000])
    """
    check_tensor("predict_pose", "last", last, (7,), torch.float32)
    check_tensor("predict_pose", "before", before, (7,), torch.float32, like=last)
    if not 0 < steps < math.inf:
        raise ValueError(f"predict_pose: steps must be above 0 and finite, got {steps}")
    return trusted.predict_pose(before, last, steps)


def _scalar(default: Any = dataclasses.MISSING, **bound: float) -> Any:
    """A field that goes to the op among its scalars; `above` or `at_least` is what it is checked against."""
    return dataclasses.field(default=default, metadata=bound)


@dataclass(frozen=True, kw_only=True)
class GaussNewtonOptions:
    """How `track_gauss_newton` draws pixels, weighs residuals and steps.

    Attributes:
        num_pixels: drawn in each iteration, with replacement.
        iterations: how many.
        truncation: of the scene's SDF, m.
        kernel_start: first width k of the robust kernel, m.
        kernel_end: last width, m, reached one iteration before the last; between them k goes geometrically.
        damping: relative Levenberg damping.
        seed, stream, frame: keys of the draws, see `philox_uniform`.
        score_kernel: width of the robust kernel that the statistics are computed with, m, so that they compare whatever
            kernel finds the pose; None takes the iteration's own.
        held_information: in iterations before `depth_keyframes.first_iteration`, added to the diagonal of H for each
            unit of its weights, 1/m^2: directions of less information per pixel hardly move while the map alone, with
            its noise, would move the pose. 0 holds none.
        tf32: on CUDA devices from sm_80 on, let tensor cores multiply in the decoder, with factors rounded to 10 bits
            of mantissa: under 0.1 mm of SDF. Elsewhere, and without it, everything is float32.
    """

    num_pixels: int
    iterations: int
    truncation: float = _scalar(above=0)
    kernel_start: float = _scalar(above=0)
    kernel_end: float = _scalar(above=0)
    damping: float = _scalar(at_least=0)
    seed: int
    stream: int
    frame: int
    score_kernel: float | None = _scalar(None, above=0)
    held_information: float = _scalar(0.0, at_least=0)
    tf32: bool = True

    def check(self, function: str) -> None:
        """Raises ValueError, naming `function`, where a number is out of range."""
        check_count(function, "num_pixels", self.num_pixels)
        check_count(function, "iterations", self.iterations)
        check_key(function, self.frame)
        for name, bounds in _SCALARS.items():
            value = getattr(self, name)
            if value is not None and "above" in bounds:
                check(value > bounds["above"], function, name, "be positive", value)
            elif value is not None:
                check(value >= bounds["at_least"], function, name, f"be at least {bounds['at_least']}", value)

    def arguments(self, intrinsics: Intrinsics) -> tuple[list[float], list[int]]:
        """The schema's scalars and integers: the enums TrackingScalar and TrackingInteger in
        csrc/bindings/tracking_arguments.h."""
        scalars = [*intrinsics, *(getattr(self, name) or 0.0 for name in _SCALARS)]
        integers = [self.num_pixels, self.iterations, self.seed, int(self.stream), self.frame, int(self.tf32)]
        return scalars, integers


# Names and bounds, in the order of SPS_GAUSS_NEWTON_SCALARS in csrc/include/spslam/gauss_newton.h.
_SCALARS = {field.name: field.metadata for field in dataclasses.fields(GaussNewtonOptions) if field.metadata}
_ITERATIONS = 1  # among the integers


@public_op()
def track_gauss_newton(
    scene: SceneView,
    pixels: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    options: GaussNewtonOptions,
    *,
    noise: torch.Tensor | None = None,
    reference: ReferenceImage | None = None,
    depth_keyframes: DepthKeyframes | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Tracks one frame against a frozen scene; all iterations in one call, on CUDA in one kernel that never stops for
    the host.

    Each iteration draws pixels anew, solves (H + damping diag(H) + (1e-6 tr(H) + 1e-8) I) delta = -g, until the depth
    keyframes join with `options.held_information` on the diagonal too, and limits the step to a norm of 0.15. Points
    outside the map, or where |s| >= 0.98, take no part, and neither do pixels without a positive, finite depth nor any
    from a pose that is not finite.

    Args:
        scene: the map.
        pixels: int32 [P, 3] packed pixel records of the frame, P >= 1 (see csrc/kernels/pixel_record.h).
        pose: float32 [7] start, unit quaternion (w, x, y, z) and translation (m), T_world_camera.
        intrinsics: of the camera.
        options: pixels, iterations, kernels and random keys.
        noise: float32 [4], `SensorNoise.model`; None weighs near and far alike and compares no keyframe's intensities.
        reference: an earlier frame to compare colors with; None uses the surface alone. It takes no part in the
            statistics.
        depth_keyframes: earlier frames' images to align the surface with; None uses the map alone. They take no part in
            the statistics and H.

    Returns:
        float32 [7] pose; float32 [iterations, 7] with the weighted mean squared residual (m^2), the share of pixels on
        mapped surface, the norms of the step in translation (m) and rotation (rad), and the mean weight over all pixels
        (0 for those off the map), each before the iteration's step and with the weights of `options.score_kernel`, and
        the log gain after it (0 where depth keyframes have no exposure), with the variance of its steps, this one
        included, v + (max(d^2 - own variance, 0) - v) / 16 (see `Exposure`);
        float32 [6, 6] H of the last iteration, scaled as if pixels weighed on average what those weights are, whatever
        they weigh by their depth and the iteration's kernel. The same to the bit every time on one device, and for any
        number of CPU threads.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> pose = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> options = GaussNewtonOptions(
        ...     num_pixels=4, iterations=2, truncation=0.08, kernel_start=0.08, kernel_end=0.02, damping=1e-4, seed=0,
        ...     stream=RandomStream.TRACKING_PIXELS, frame=0)
        >>> pixels, camera = torch.zeros(4, 3, dtype=torch.int32), Intrinsics(60.0, 60.0, 31.5, 23.5)
        >>> still, stats, hessian = track_gauss_newton(SceneView.empty(), pixels, pose, camera, options)
        >>> torch.equal(still, pose), stats[:, 1]  # nothing is mapped: no pixel takes part, the camera stays
        (True, tensor([0., 0.]))
    """
    name = "track_gauss_newton"
    scene.check(name)
    check_tensor(name, "pixels", pixels, ("P", 3), torch.int32, like=scene.embeddings)
    check(len(pixels) > 0, name, "pixels", "have at least one row", 0)
    check_tensor(name, "pose", pose, (7,), torch.float32, like=scene.embeddings)
    check_intrinsics(name, intrinsics)
    options.check(name)
    if noise is not None:
        check_tensor(name, "noise", noise, (4,), torch.float32, like=scene.embeddings)
    if reference is not None:
        reference.check(name, like=scene.embeddings)
    if depth_keyframes is not None:
        depth_keyframes.check(name, like=scene.embeddings)
    found = trusted.track_gauss_newton(scene, pixels, pose, intrinsics, options, noise, reference, depth_keyframes)
    return found[7:14], found[50:].view(-1, trusted.STATISTICS), found[14:50].view(6, 6)


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
        pixels: int32 [F, N, 3] packed pixel records, F < 2^16.
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
def _(before, last, _):
    return last.new_empty(7)


@torch.library.register_fake("spslam::track_gauss_newton")
def _(scene, scene_scalars, plane_layout, frame, scalars, integers, *_):
    return frame[1].new_empty(50 + trusted.STATISTICS * integers[_ITERATIONS])


@torch.library.register_fake("spslam::gauss_newton_poses")
def _(scene, scene_scalars, plane_layout, pixels, poses, *_):
    frames = poses.shape[0]
    return (
        poses.new_empty((frames, 6, 6)),
        poses.new_empty((frames, 6)),
        poses.new_empty(frames),
        poses.new_empty(frames),
    )
