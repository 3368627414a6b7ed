"""Options of pose estimation."""

from __future__ import annotations

from typing import Literal

from spslam.options.needs import above, is_, need
from spslam.options.section import Section, option

_ADAM = need(is_("tracking.optimizer", "adam"))
# With adam, Gauss-Newton starts anew only in recovery and relocalization.
_GAUSS_NEWTON = need(
    is_("tracking.optimizer", "gauss_newton"),
    is_("tracking.recovery", True),
    above("tracking.relocalization_candidates", 0),
)


class TrackingOptions(Section):
    """Pose estimation of each frame against the fixed map (section III.D).

    With `adam`, Gauss-Newton still measures how well the resulting pose fits, and refines the poses that recovery
    proposes: its kernels, weights and earlier depth images apply there.
    """

    optimizer: Literal["adam", "gauss_newton"] = option(
        "`adam` on quaternion and translation as in the paper, or `gauss_newton` on the signed distance"
    )
    iterations: int = option("I_t, iterations per frame", "iterations", ge=1)
    first_iterations: int = option(
        "iterations for each of the first frames", "iterations", needs=(need(above("tracking.first_frames", 0)),), ge=1
    )
    first_frames: int = option("how many frames get `first_iterations`", "frames", ge=0)
    pixels: int = option("M_t, pixels drawn anew in each iteration", "px", ge=16, le=2**20)
    rotation_rate: float = option("learning rate of the quaternion", needs=(_ADAM,), ge=0)
    translation_rate: float = option("learning rate of the translation", "m", needs=(_ADAM,), ge=0)
    kernel_start_m: float = option(
        "Gauss-Newton: width of the robust kernel in the first iteration", "m", needs=(_GAUSS_NEWTON,), gt=0
    )
    kernel_end_m: float = option("Gauss-Newton: width of the robust kernel in the last iteration", "m", gt=0)
    damping: float = option("Gauss-Newton: fraction of its diagonal that is added to the normal matrix", ge=0)
    depth_noise_m: float | None = option(
        "Gauss-Newton: standard deviation of depth at 1 m, which grows with the square of depth; null measures it "
        "against depth keyframes, and without them assumes that of a Kinect; 0 weights all depths equally",
        "m",
        ge=0,
        le=0.1,
    )
    color_weight_m: float = option(
        "Gauss-Newton: weight of brightness residuals against a small image of the last mapped frame: the distance "
        "that is equivalent to a difference from black to white; 0 disables them",
        "m",
        ge=0,
    )
    color_kernel: float = option(
        "Gauss-Newton: width of the robust kernel of these differences; white is 1",
        needs=(need(above("tracking.color_weight_m", 0)),),
        gt=0,
    )
    depth_keyframes: bool = option(
        "Gauss-Newton: also align with the depth images of the last frame, one 10 to 19 and one 40 to 49 frames earlier"
    )
    color: bool = option(
        "Gauss-Newton: also compare brightness with these frames, weighted by its noise as measured",
        needs=(need(is_("tracking.depth_keyframes", True)),),
    )
    capture_timing: bool = option(
        "Gauss-Newton: measure how much later than depth color is taken, and how long the camera reads a frame out (a "
        "rolling shutter), and compensate for both",
        needs=(need(is_("tracking.depth_keyframes", True)), need(is_("tracking.color", True))),
    )
    depth_keyframe_kernel_m: float = option(
        "Gauss-Newton: width of the robust kernel of distances to these depth images in the last iteration",
        "m",
        needs=(need(is_("tracking.depth_keyframes", True)),),
        gt=0,
    )
    recovery: bool = option(
        "repeat tracking from poses found by projective ICP if a frame fits the map badly; with `adam` only if "
        "tracking failed"
    )
    features: bool = option(
        "keep image features (ORB) of every 30th frame, and track a doubtful or lost frame also from the poses that "
        "they give",
        needs=(need(is_("tracking.recovery", True)),),
    )
    moving_objects: bool = option(
        "leave out what moves before the camera, such as people, by the depth of the last two seconds",
        needs=(need(is_("tracking.depth_keyframes", True)),),
    )
    recovery_min_robust_weight: float = option(
        "recover and verify when the mean robust weight of the pixels is below this", ge=0, le=1
    )
    verify_threshold: float = option(
        "verify a pose, and try others, when its error probability is above this (docs/tracking-failure.md)", ge=0, le=1
    )
    lost_threshold: float = option("a frame is lost when its error probability stays above this", ge=0, le=1)
    relocalization_threshold: float = option(
        "relocalize a lost camera when the error probability is at most this, or at most 0.1 in 4 consecutive frames "
        "with consistent poses",
        ge=0,
        le=1,
    )
    relocalization_candidates: int = option(
        "number of stored frames, the most similar ones, that a lost frame is aligned with; 0 disables relocalization",
        "frames",
        ge=0,
    )
    min_inlier_share: float = option(
        "a frame is lost when a smaller fraction of its pixels lies on mapped surface, unless the image features of "
        "frames before hold it",
        ge=0,
        le=1,
    )
    min_valid_depth_share: float = option("a frame is lost when a smaller fraction of its pixels has depth", ge=0, le=1)

    def check(self) -> None:
        if self.kernel_end_m > self.kernel_start_m:
            raise ValueError(f"tracking.kernel_end_m must be at most tracking.kernel_start_m, got {self.kernel_end_m}")
