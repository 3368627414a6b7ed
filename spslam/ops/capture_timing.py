"""When a camera takes its images, measured while tracking: the delay from depth to color, and the readout of a frame.

Images of a moving camera that are not of one moment show the surface from two poses, and so do the rows of a rolling
shutter. Between two frames this matters only where the camera moved differently: there surface and brightness, or upper
and lower rows, disagree on the relative pose. One Gauss-Newton step solves for that pose and the times together, as
visual-inertial systems do (Li and Mourikis 2014; Qin and Shen 2018).
"""

from typing import NamedTuple

import torch

from spslam.ops import _library, trusted  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops.earlier_frames import DepthKeyframes
from spslam.ops.scene_view import Intrinsics, check_intrinsics


class CaptureTiming(NamedTuple):
    """What is known of the times.

    Attributes:
        seconds: float32 [2] from a frame's depth image to its color image, and from the first row that is read to the
            last: the estimates, s, and 0 where they are below 1.5 and 3 ms. Negative where color comes first, and where
            the last row does.
        state: float64 [2, 2] of each the estimate, s, and its inverse variance, 1/s^2.
    """

    seconds: torch.Tensor
    state: torch.Tensor

    @property
    def color_delay(self) -> torch.Tensor:
        """float32 [1] s, for `ColorTiming`; a view."""
        return self.seconds[:1]

    @classmethod
    def unknown(cls, device: torch.device | str = "cpu") -> "CaptureTiming":
        """Nothing measured yet: all of one moment."""
        seconds = torch.zeros(2, dtype=torch.float32, device=device)
        return cls(seconds, torch.zeros(2, 2, dtype=torch.float64, device=device))


@public_op()
def measure_capture_timing_(
    timing: CaptureTiming,
    pixels: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    noise: torch.Tensor,
    depth_keyframes: DepthKeyframes,
) -> None:
    """Moves the estimates towards the times at which surface and brightness of all rows agree on the relative poses.

    Residuals are differences of intensity, as of `track_gauss_newton`, and distances from the keyframes' surface, whose
    slope is measured over so many pixels that noise hardly turns it, weighted by inverse variances. With the relative
    pose of each pair of frames eliminated, their normal equations M t = -g give the frame's own estimates, with the
    variances n / 300 M^-1 + (4 ms)^2, n being the differences of intensity of a pair if they are more than 300. The
    estimates are weighted means of these, in which a frame counts as off by 10 ms at most, beginning with 0 s of a
    deviation of 5 ms; they never count as better than 1 ms, so that they follow a drift, nor become larger than 90 ms.
    Frames whose motion is unknown say nothing.

    Args:
        timing: changed in place. What it says is compensated already: intensities are compared with its delay, and
            pixels and images are rectified by its readout, or by an estimate hardly older.
        pixels: int32 [P, 3] packed pixel records of the frame (see `sample_frame_pixels`).
        pose: float32 [7] of the frame, T_world_camera, as tracked.
        intrinsics: of the camera.
        noise: float32 [4] of the sensor, `SensorNoise.model`.
        depth_keyframes: earlier frames' images with intensities and a timing, whose delay is
            `timing.color_delay`.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> timing, still = CaptureTiming.unknown(), torch.tensor([[1.0, 0, 0, 0, 0, 0, 0]])
        >>> flat = torch.full((1, 8, 8), 2000, dtype=torch.uint16)
        >>> camera, motion = Intrinsics(8.0, 8.0, 3.5, 3.5), FrameMotion(0, 1 / 30)
        >>> keyframes = DepthKeyframes(
        ...     flat, 1e-3, still, ((0, 0),), camera, kernel_end=0.01,
        ...     intensities=torch.zeros(1, 8, 8, dtype=torch.uint8),
        ...     timing=ColorTiming(timing.color_delay, (motion,), motion))
        >>> pixels = torch.tensor([[3 | 3 << 16, torch.tensor([2.0]).view(torch.int32).item(), 0]], dtype=torch.int32)
        >>> noise = SensorNoise.unknown().model
        >>> measure_capture_timing_(timing, pixels, still[0], camera, noise, keyframes)
        >>> timing.seconds  # a camera that stands still tells nothing
        tensor([0., 0.])
    """
    name = "measure_capture_timing_"
    check_tensor(name, "timing.seconds", timing.seconds, (2,), torch.float32)
    check_tensor(name, "timing.state", timing.state, (2, 2), torch.float64, like=timing.seconds)
    check_tensor(name, "pixels", pixels, ("P", 3), torch.int32, like=timing.seconds)
    check_tensor(name, "pose", pose, (7,), torch.float32, like=timing.seconds)
    check_intrinsics(name, intrinsics)
    check_tensor(name, "noise", noise, (4,), torch.float32, like=timing.seconds)
    depth_keyframes.check(name, like=timing.seconds)
    check(depth_keyframes.timing is not None, name, "depth_keyframes", "have a timing", None)
    trusted.measure_capture_timing_(timing, pixels, pose, intrinsics, noise, depth_keyframes)
    changed_in_place(timing.seconds, timing.state)


@torch.library.register_fake("spslam::measure_capture_timing_")
def _(state, timing, pixels, pose, noise, intrinsics, *_):
    return None
