"""The last frame with a trusted pose, as it was read: of most nobody asks for image features."""

from __future__ import annotations

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam.depth_keyframes import depth_image_shape
from spslam.slam.image_features import FrameFeatures, ImageFeatures
from spslam.slam.pixels import image_pixels
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.row_copies import RowCopies, write_rows


class NewestFrame:
    """Holds the images of one frame, from which its features are extracted where they are first asked for.

    Attributes:
        number: of the frame; -1 where there is none.
    """

    def __init__(self, camera: Camera, max_depth_m: float, device: torch.device | str = "cpu"):
        """Without a frame.

        Args:
            camera: of all frames.
            max_depth_m: the largest depth that images hold.
            device: where the images are.
        """
        self._camera, self._max_depth_m = camera, max_depth_m
        self._rectifier = ShutterRectifier(camera, max_depth_m)
        self._poses = torch.zeros(2, 7, device=device)  # before the frame's and its own, as they were then
        self._readout = torch.zeros(1, device=device)
        self._seconds = 0.0  # between the two; 0 where the rows of the frame are of one moment
        self.number = -1
        shape = depth_image_shape(camera)
        depth = torch.zeros(shape, dtype=torch.uint16, device=device)
        self._set_images(depth, torch.zeros_like(depth, dtype=torch.uint8))

    def replace(
        self,
        number: int,
        features: FrameFeatures,
        shutter: ops.ShutterMotion | None,
        copies: RowCopies | None = None,
    ) -> None:
        """Takes the place of the frame before, asynchronously.

        Args:
            number: of the frame.
            features: of the frame as it was read.
            shutter: how the camera moved while it was read; None where that does not matter.
            copies: poses are written when these are made; None writes them now.
        """
        self.number, self._read = number, features
        self._seconds = 0.0 if shutter is None else shutter.seconds
        if shutter is not None:
            self._readout = shutter.readout
            write_rows(copies, [self._poses, self._poses], [0, 1], [shutter.before, shutter.pose])

    def features(self) -> ImageFeatures:
        """The frame's, rectified, those without depth too; waits for the device."""
        features = self._read.extracted
        if self._seconds > 0:
            motion = ops.ShutterMotion(self._poses[0], self._poses[1], self._seconds, self._readout)
            features = self._rectifier.features(features, motion)
        return features

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that a checkpoint needs; images as copies, as a segment may have the same ones."""
        pixels = self._read.pixels
        return {
            "frame": torch.tensor([self.number]),
            "depth": pixels.depth_image.clone(),
            "intensity": pixels.intensity_image.clone(),
            "poses": self._poses,
            "readout": self._readout,
            "seconds": torch.tensor([self._seconds], dtype=torch.float64),
        }

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by a copy of what `tensors()` returned."""
        device = self._poses.device
        depth, intensity, readout = (state[name].to(device, copy=True) for name in ("depth", "intensity", "readout"))
        self.number, self._seconds, self._readout = int(state["frame"]), float(state["seconds"]), readout
        self._poses.copy_(state["poses"])
        self._set_images(depth, intensity)

    def _set_images(self, depth: torch.Tensor, intensity: torch.Tensor) -> None:
        self._read = FrameFeatures(image_pixels(depth, intensity), self._camera, self._max_depth_m)
