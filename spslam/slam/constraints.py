"""Tracking constraints beside the map: images of earlier frames, and the noise that they are weighed by."""

from dataclasses import dataclass
from functools import cached_property

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.slam.frame_history import FrameHistory
from spslam.slam.pixels import FramePixels
from spslam.slam.reference_image import ReferenceCache

LITTLE_DEPTH_SHARE = 0.25  # of the image; with less, depth keyframes take part from the first iteration on


@dataclass(frozen=True)
class Constraints:
    """Terms of Gauss-Newton tracking beside the map's.

    Attributes:
        noise: float32 [4] of the sensor, see `ops.SensorNoise`; None weighs all depths alike.
        reference: the last mapped frame, to compare brightness with; None compares none.
        depth_keyframes: depth images of earlier frames; None uses the map alone.
        keyframes_from_start: whether these take part in all iterations. Normally they join in the second half, as the
            map alone has the larger convergence basin; but with little depth the map does not constrain the pose.
        shutter: how the camera is predicted to move while the frame is read, by which its records are rectified and its
            images are not; None where that does not matter.
    """

    noise: torch.Tensor | None = None
    reference: ops.ReferenceImage | None = None
    depth_keyframes: ops.DepthKeyframes | None = None
    keyframes_from_start: bool = False
    shutter: ops.ShutterMotion | None = None

    @cached_property
    def noise_numbers(self) -> list[float]:
        """The noise, read; waits for the device. All 0 where none is known."""
        return [0.0] * 4 if self.noise is None else self.noise.tolist()

    @property
    def timing(self) -> ops.ColorTiming | None:
        """How color images lie beside depth images in time; None where the two are taken to be of one moment."""
        return None if self.depth_keyframes is None else self.depth_keyframes.timing

    @property
    def tells_gain(self) -> bool:
        """Whether there are earlier images by which the gain of the frame's brightness is found."""
        return self.depth_keyframes is not None and self.depth_keyframes.exposure is not None

    def depth_keyframes_of(self, iterations: int) -> ops.DepthKeyframes | None:
        """The depth keyframes for a call of so many iterations."""
        if self.depth_keyframes is None or self.keyframes_from_start:
            return self.depth_keyframes
        return self.depth_keyframes._replace(first_iteration=iterations // 2)


class ConstraintSource:
    """Gathers the constraints of a frame from the frames before it.

    Args:
        config: options of the run.
        camera: of all frames.
    """

    def __init__(self, config: Config, camera: Camera):
        weight_m, kernel = config.tracking.color_weight_m, config.tracking.color_kernel
        self._color, self._timing = config.tracking.color, config.tracking.capture_timing
        self._references = ReferenceCache(camera, weight_m, kernel) if weight_m > 0 else None
        self._mapping_every = config.mapping.every

    def gather(
        self,
        history: FrameHistory,
        pixels: FramePixels,
        depth_time: float | None = None,
        color_offset: float = 0.0,
    ) -> Constraints:
        """The constraints of the next frame.

        Args:
            history: of the frames before.
            pixels: of the frame.
            depth_time: when its depth image was taken, s; None where that is not known.
            color_offset: from there to its color image, s, as stamps say.
        """
        from_start = pixels.valid_depth_share < LITTLE_DEPTH_SHARE
        keyframes = history.depth_keyframes(depth_time, color_offset)
        if keyframes is not None and not self._timing:
            keyframes = keyframes._replace(timing=None)
        if keyframes is not None and not self._color:
            keyframes = keyframes._replace(intensities=None, timing=None, exposure=None)
        return Constraints(history.noise, self._reference(history), keyframes, from_start)

    def _reference(self, history: FrameHistory) -> ops.ReferenceImage | None:
        mapped = history.last_mapped(self._mapping_every) if self._references else None
        if mapped is None or self._references is None:
            return None
        row, earlier = mapped
        image = self._references.get(row, earlier.records, earlier.pose)
        return image._replace(motion=history.own_motion(row), log_gain=history.log_gain(row))
