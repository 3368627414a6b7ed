"""Earlier frames that `track_gauss_newton` compares a frame with, besides the map."""

import math
from typing import NamedTuple

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops.scene_view import Intrinsics, check_intrinsics

# Weights of red, green and blue in a reference's intensity (Rec. 601), in thousandths; the kernel's own.
LUMA_WEIGHTS: tuple[int, int, int] = torch.ops.spslam.luma_weights()

_MAX_DEPTH_KEYFRAMES = 8


class FrameMotion(NamedTuple):
    """How the camera came to a frame.

    Attributes:
        row: of an earlier pose, in `DepthKeyframes.poses`; negative where it is unknown. Where color comes before
            depth, one more than twice as long before: else its error comes back with the other sign, and larger.
        seconds: since that pose, s.
        color_offset: from the frame's depth image to its color image, s, as their stamps say.
    """

    row: int
    seconds: float
    color_offset: float = 0.0


NO_MOTION = FrameMotion(-1, 1.0)


class ReferenceImage(NamedTuple):
    """A small gray image of an earlier frame, to compare colors with.

    Attributes:
        cells: float32 [H, W, 2] intensity in [0, 1] (`LUMA_WEIGHTS`) and depth (m, 0 where unknown). A point is
            compared where it falls between four cells whose depth agrees with its own to a tenth.
        pose: float32 [7] T_world_camera of the frame, unit quaternion (w, x, y, z) and translation (m).
        intrinsics: in cells: those of s x s pixels have focal lengths f / s and principal point (c + 1/2) / s - 1/2.
        weight: m that an intensity difference of 1 counts as.
        kernel: width of the robust kernel, intensity.
        motion: how the camera came to the frame, its row being one of the poses of the depth keyframes: where these
            have a timing, its colors are of when it took them.
        log_gain: float32 [1] of the frame, see `Exposure`, for depth keyframes that have one; None takes its brightness
            as it is.
    """

    cells: torch.Tensor
    pose: torch.Tensor
    intrinsics: Intrinsics
    weight: float
    kernel: float
    motion: FrameMotion = NO_MOTION
    log_gain: torch.Tensor | None = None

    def check(self, function: str, like: torch.Tensor) -> None:
        """Raises TypeError or ValueError, naming `function`, where something does not fit."""
        check_tensor(function, "reference.cells", self.cells, ("H", "W", 2), torch.float32, like=like)
        check_tensor(function, "reference.pose", self.pose, (7,), torch.float32, like=like)
        check_intrinsics(function, self.intrinsics, "reference.intrinsics")
        check(self.weight >= 0, function, "reference.weight", "be at least 0", self.weight)
        check(self.kernel > 0, function, "reference.kernel", "be positive", self.kernel)
        _check_motion(function, "reference.motion", self.motion)
        if self.log_gain is not None:
            check_tensor(function, "reference.log_gain", self.log_gain, (1,), torch.float32, like=like)

    def arguments(self) -> tuple[list[torch.Tensor], list[float]]:
        """What the schema takes: the enum ReferenceScalar in csrc/bindings/tracking_arguments.h."""
        tensors = [self.cells, self.pose]
        if self.log_gain is not None:
            tensors.append(self.log_gain)
        return tensors, [*self.intrinsics, self.weight, self.kernel, *self.motion]


class ColorTiming(NamedTuple):
    """When color images are taken; the camera is taken to move on as it came.

    Attributes:
        delay: float32 [1] from a frame's depth image to its color image beside its motion's `color_offset`, s, negative
            where color comes first (see `measure_capture_timing_`).
        keyframes: the motion of each keyframe.
        frame: that of the frame which is compared with them.
        readouts: float32 [R] by which of them each image of the keyframes was rectified, s; None takes all to be
            rectified as the frame is. Only `measure_capture_timing_` heeds it.
    """

    delay: torch.Tensor
    keyframes: tuple[FrameMotion, ...]
    frame: FrameMotion
    readouts: torch.Tensor | None = None

    def check(self, function: str, like: torch.Tensor, keyframes: int, poses: int) -> None:
        """Raises TypeError or ValueError, naming `function`, where something does not fit."""
        name = "depth_keyframes.timing"
        check_tensor(function, f"{name}.delay", self.delay, (1,), torch.float32, like=like)
        check(len(self.keyframes) == keyframes, function, name, f"have {keyframes} motions", len(self.keyframes))
        for motion in (self.frame, *self.keyframes):
            _check_motion(function, name, motion, poses)


class Exposure(NamedTuple):
    """By how much brighter some frames' images are than others', as a camera's automatic exposure makes them.

    A frame's gain is the factor of its brightness against what all frames' would be. An earlier image is compared with
    a frame as if it were as bright as that one, and at most white. The frame's own gain is an unknown beside its pose.

    Where an even exposure is known to be one, the unknown must not take what brightness says of the pose: with a
    variance v the frame's log gain is expected at a0, in the unit of the pixels' equations as strongly as
    1 / (v + d^2 / 16), d being by how much the pixels would have it otherwise: so what changes plainly is free at once.

    Attributes:
        log_gains: float32 [F, 1] natural logarithms of the gains of the frames that `DepthKeyframes.poses` are of; may
            be a column of a wider table.
        frame: float32 [1] that of the frame which is compared with them, a0, as far as it is known; or [2], and the
            variance v of the step from there. It takes effect where the noise of intensities is known.
    """

    log_gains: torch.Tensor
    frame: torch.Tensor

    def check(self, function: str, like: torch.Tensor, poses: int) -> None:
        """Raises TypeError or ValueError, naming `function`, where something does not fit."""
        name = "depth_keyframes.exposure"
        check_tensor(function, f"{name}.log_gains", self.log_gains, (poses, 1), torch.float32, like=like)
        check_tensor(function, f"{name}.frame", self.frame, ("1 or 2",), torch.float32, like=like)
        check(len(self.frame) in (1, 2), function, f"{name}.frame", "have shape [1] or [2]", list(self.frame.shape))


class DepthKeyframes(NamedTuple):
    """Depth images of earlier frames, to align a frame's surface with.

    Attributes:
        images: uint16 [R, H, W] depth in `unit`, 0 where unknown. A point is compared where it falls between four
            pixels with depth whose inverses spread less than 3 %.
        unit: m.
        poses: float32 [F, 7] T_world_camera, unit quaternions (w, x, y, z) and translations (m).
        rows: of each keyframe, at most 8, the row of its image and the row of its pose.
        intrinsics: of the images, px.
        kernel_end: last width of the robust kernel of these distances, m; the first is that of the map's.
        first_iteration: from which on they take part; the map alone has the larger basin of convergence.
        intensities: uint8 [R, H, W] intensity (`LUMA_WEIGHTS`) in 1/255, compared where the depth is and agrees with
            the point's own to 5 %; None compares none.
        timing: when they were taken; None takes each to be of the moment of its depth image.
        exposure: how bright they are; None takes all to be as bright as one another.
    """

    images: torch.Tensor
    unit: float
    poses: torch.Tensor
    rows: tuple[tuple[int, int], ...]
    intrinsics: Intrinsics
    kernel_end: float
    first_iteration: int = 0
    intensities: torch.Tensor | None = None
    timing: ColorTiming | None = None
    exposure: Exposure | None = None

    def check(self, function: str, like: torch.Tensor) -> None:
        """Raises TypeError or ValueError, naming `function`, where something does not fit."""
        name = "depth_keyframes"
        check_tensor(function, f"{name}.images", self.images, ("R", "H", "W"), torch.uint16, like=like)
        check_tensor(function, f"{name}.poses", self.poses, ("F", 7), torch.float32, like=like)
        if self.intensities is not None:
            shape = self.images.shape
            check_tensor(function, f"{name}.intensities", self.intensities, shape, torch.uint8, like=like)
        check_intrinsics(function, self.intrinsics, f"{name}.intrinsics")
        check(self.unit > 0, function, f"{name}.unit", "be positive", self.unit)
        check(self.kernel_end > 0, function, f"{name}.kernel_end", "be positive", self.kernel_end)
        check(self.first_iteration >= 0, function, f"{name}.first_iteration", "be at least 0", self.first_iteration)
        count, most = len(self.rows), _MAX_DEPTH_KEYFRAMES
        check(count <= most, function, f"{name}.rows", f"be at most {most}", count)
        for image, pose in self.rows:
            inside = 0 <= image < len(self.images) and 0 <= pose < len(self.poses)
            check(inside, function, f"{name}.rows", "name images and poses that are there", (image, pose))
        if self.timing is not None:
            check(self.intensities is not None, function, f"{name}.timing", "come with intensities", "none")
            self.timing.check(function, like, count, len(self.poses))
            if self.timing.readouts is not None:
                shape = self.images.shape[:1]
                check_tensor(function, f"{name}.timing.readouts", self.timing.readouts, shape, torch.float32, like=like)
        if self.exposure is not None:
            check(self.intensities is not None, function, f"{name}.exposure", "come with intensities", "none")
            self.exposure.check(function, like, len(self.poses))

    def arguments(self) -> tuple[list[torch.Tensor], list[float], list[int]]:
        """What schemas take: the enums KeyframeScalar and KeyframeInteger in csrc/bindings/depth_keyframes.h."""
        timing, count = self.timing, len(self.rows)
        motions = [NO_MOTION] * (1 + count) if timing is None else [timing.frame, *timing.keyframes]
        frame, *others = ((each.row, round(1e9 * each.seconds), round(1e9 * each.color_offset)) for each in motions)
        places = [place for row, motion in zip(self.rows, others, strict=True) for place in (*row, *motion)]
        times = (None, None) if timing is None else (timing.delay, timing.readouts)
        tensors = [self.images, self.poses, self.intensities, *times, *(self.exposure or ())]
        scalars = [*self.intrinsics, self.unit, self.kernel_end]
        return [one for one in tensors if one is not None], scalars, [self.first_iteration, *frame, *places]


def _check_motion(function: str, name: str, motion: FrameMotion, poses: float = math.inf) -> None:
    fits = motion.row < 0 or (motion.row < poses and 1e-9 <= motion.seconds < 1e9)
    check(fits, function, name, "name poses that are there and positive times", motion)
    check(abs(motion.color_offset) < 1e9, function, name, "have finite color offsets", motion)
