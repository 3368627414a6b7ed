"""The noise of the recording's depth and color, and when they are taken, measured while it is tracked."""

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam.pixels import FramePixels

PIXELS = 3000  # of a frame, that residuals are counted of
TIMING_PIXELS = 1000  # that say when images were taken


class SensorNoiseEstimate:
    """What is known of the noise; see `ops.SensorNoise` for the model.

    Args:
        camera: of all frames.
        depth_noise_m: deviation of depth at 1 m, which grows with its square; None measures it.
        device: where it is measured.
    """

    def __init__(self, camera: Camera, depth_noise_m: float | None = None, device: torch.device | str = "cpu"):
        self._intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        self._noise = ops.SensorNoise.unknown(device)
        self._timing = ops.CaptureTiming.unknown(device)
        self._color_delay, self._readout = self._timing.color_delay, self._timing.seconds[1:]  # views, for each frame
        self._depth_noise_m = depth_noise_m
        self._fix_depth()

    @property
    def model(self) -> torch.Tensor:
        """float32 [4] for `ops.track_gauss_newton`, on the device."""
        return self._noise.model

    @property
    def color_delay(self) -> torch.Tensor:
        """float32 [1] from a frame's depth image to its color image, s, on the device; 0 where it does not matter."""
        return self._color_delay

    @property
    def readout(self) -> torch.Tensor:
        """float32 [1] from the first row of a frame that is read to the last, s; as `color_delay`."""
        return self._readout

    def measure(
        self,
        pixels: FramePixels,
        pose: torch.Tensor,
        depth_keyframes: ops.DepthKeyframes,
        gain: torch.Tensor | None = None,
    ) -> None:
        """Takes account of a frame at a trusted pose, float32 [7], and gain, float32 [2]; asynchronously."""
        exposure = depth_keyframes.exposure
        if exposure is not None and gain is not None:
            depth_keyframes = depth_keyframes._replace(exposure=exposure._replace(frame=gain))
        counts = TIMING_PIXELS, PIXELS
        ops.trusted.measure_frame_(
            self._noise, self._timing, pixels.records, pose, self._intrinsics, depth_keyframes, counts
        )
        self._fix_depth()

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that a checkpoint needs."""
        return {**self._noise._asdict(), "timing": self._timing.seconds, "timing_state": self._timing.state}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by a copy of what `tensors()` returned."""
        for name, tensor in self.tensors().items():
            tensor.copy_(state[name])

    def _fix_depth(self) -> None:
        if self._depth_noise_m is not None:
            self._noise.model[1].fill_(self._depth_noise_m**2)
