"""The noise of a depth camera, measured while tracking; what `track_gauss_newton` weighs pixels by."""

from typing import NamedTuple

import torch

from spslam.ops import _library, trusted  # noqa: F401
from spslam.ops._checks import check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops.earlier_frames import DepthKeyframes
from spslam.ops.scene_view import Intrinsics, check_intrinsics

_COUNTS = (2, 32, 128)  # kNoiseHistograms, kNoiseBins, kNoiseLevels of csrc/include/spslam/sensor_noise.h


class SensorNoise(NamedTuple):
    """Variances by depth and by gradient, and the residuals that they are measured from.

    The variance of a depth z, as neighboring frames disagree on it, is a^2 + c^2 z^4, as for structured light and
    stereo; that of the difference between two images' intensities, where the gradient is g, is s^2 + e^2 g^2, e being
    how far the images are from being registered.

    Attributes:
        model: float32 [4] a^2 (m^2), c^2 (1/m^2), s^2 (of [0, 1]) and e^2 (px^2).
        counts: int32 [2, 32, 128]: of distances by depth, and of differences of intensity by gradient, in quarters of
            an octave from 0.25 m and 2^-9/px on; by size, in eighths of an octave from 2^-18 m and 2^-15 on. 256 for
            each residual, less a sixteenth for each frame since.
    """

    model: torch.Tensor
    counts: torch.Tensor

    @classmethod
    def unknown(cls, device: torch.device | str = "cpu") -> "SensorNoise":
        """Nothing measured yet: depth of 3 mm and 1.3 mm/m^2, intensity that says next to nothing."""
        model = torch.tensor([9e-6, 1.69e-6, 1.0, 0.25], dtype=torch.float32, device=device)
        return cls(model, torch.zeros(_COUNTS, dtype=torch.int32, device=device))


@public_op()
def measure_noise_(
    noise: SensorNoise,
    pixels: torch.Tensor,
    pose: torch.Tensor,
    intrinsics: Intrinsics,
    depth_keyframes: DepthKeyframes,
) -> None:
    """Counts a frame's residuals against depth keyframes, fits the model to all counts, and lets counts fade.

    A residual is a point's distance from a keyframe's surface, where that is below 5 % of its depth, or the difference
    of intensities there. The deviation in a bin is 1.4826 times the median. The model is the least sum of
    n / (n + 200) (v_model / v - 1)^2 over bins of n residuals, at least 50, and variance v, with neither part negative.
    The growth, c^2 or e^2, keeps the share 0.01 / (0.01 + 1 - r^2) of its last value, r being its correlation with the
    floor: where all pixels have one depth the two cannot be told apart.

    Args:
        noise: changed in place.
        pixels: int32 [P, 3] packed pixel records of the frame (see `sample_frame_pixels`).
        pose: float32 [7] of the frame, T_world_camera.
        intrinsics: of the camera.
        depth_keyframes: earlier frames' images; without intensities these are not measured.

    Raises:
        TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range.

    Example:
        >>> noise, pose = SensorNoise.unknown(), torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> flat = torch.full((1, 8, 8), 2000, dtype=torch.uint16)  # a wall 2 m before the camera, in mm
        >>> camera = Intrinsics(8.0, 8.0, 3.5, 3.5)
        >>> keyframes = DepthKeyframes(flat, 1e-3, pose[None], ((0, 0),), camera, kernel_end=0.01)
        >>> depth = torch.tensor([2.01]).view(torch.int32).item()  # 1 cm farther
        >>> pixels = torch.tensor([[3 | 3 << 16, depth, 0]] * 100, dtype=torch.int32)
        >>> measure_noise_(noise, pixels, pose, camera, keyframes)
        >>> a, c = noise.model[:2].sqrt().tolist()
        >>> round((a**2 + c**2 * 2**4) ** 0.5, 3)  # the deviation at 2 m: 1.4826 cm
        0.015
    """
    name = "measure_noise_"
    check_tensor(name, "noise.model", noise.model, (4,), torch.float32)
    check_tensor(name, "noise.counts", noise.counts, _COUNTS, torch.int32, like=noise.model)
    check_tensor(name, "pixels", pixels, ("P", 3), torch.int32, like=noise.model)
    check_tensor(name, "pose", pose, (7,), torch.float32, like=noise.model)
    check_intrinsics(name, intrinsics)
    depth_keyframes.check(name, like=noise.model)
    trusted.measure_noise_(noise, pixels, pose, intrinsics, depth_keyframes)
    changed_in_place(noise.model, noise.counts)


@torch.library.register_fake("spslam::measure_noise_")
def _(counts, noise, pixels, pose, intrinsics, *_):
    return None
