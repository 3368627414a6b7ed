"""Keyframes: of which enough is kept to align them with one another, and to make the map of them again."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.slam.depth_keyframes import depth_image_intrinsics, depth_image_step, depth_unit
from spslam.slam.device_events import DeviceEvent, event_recorder, fetch
from spslam.slam.image_features import ImageFeatures, features_of_images
from spslam.slam.pixels import FramePixels, unpack_points

MAX_COLUMNS = 320  # of a keyframe's images
THUMBNAIL_COLUMNS = 40
MIN_DEPTH_M = 0.05
NEAR_SHARE = 0.15  # of the median depth: where surface is near, keyframes are nearer to each other


@dataclass(frozen=True)
class KeyframeCamera:
    """How keyframes' images relate to those of frames.

    Attributes:
        step: every how many pixels of a frame's depth image a keyframe holds one.
        camera: of a keyframe's images.
        max_depth_m: the largest depth that they hold.
        normal_step_px: distance of the pixels that a normal is found from, in a keyframe's images.
        max_jump: of the normals, see `ops.depth_normals`.
    """

    step: int
    camera: Camera
    max_depth_m: float
    normal_step_px: int
    max_jump: float

    @classmethod
    def of(cls, camera: Camera, max_depth_m: float, normal_step_px: int, max_jump: float) -> KeyframeCamera:
        """That of a camera's frames; `normal_step_px` in pixels of its images."""
        frame_step = depth_image_step(camera)
        columns, rows = (-(-size // frame_step) for size in (camera.width, camera.height))
        step = -(-columns // MAX_COLUMNS)
        k = depth_image_intrinsics(camera)
        sizes = -(-columns // step), -(-rows // step)
        own = Camera(*sizes, k.fx / step, k.fy / step, k.cx / step, k.cy / step)
        return cls(step, own, max_depth_m, max(round(normal_step_px / (step * frame_step)), 1), max_jump)

    @property
    def intrinsics(self) -> ops.Intrinsics:
        """Of a keyframe's images, px."""
        return ops.Intrinsics(self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy)

    @property
    def unit(self) -> float:
        """Of depth, m."""
        return depth_unit(self.max_depth_m)

    @property
    def thumbnail_step(self) -> int:
        """Distance of a depth thumbnail's pixels in a keyframe's images, px."""
        return -(-self.camera.width // THUMBNAIL_COLUMNS)

    def points(self, records: torch.Tensor) -> torch.Tensor:
        """Surface points float32 [P, 3] of a keyframe's packed records int32 [P, 3], in its axes, m."""
        return unpack_points(records, self.camera)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame of the keyframe graph, in the host's memory.

    Attributes:
        frame: its number.
        depth: uint16 [h, w] in units of the camera, 0 where unknown.
        intensity: uint8 [h, w] in 1/255.
        camera: of the images.
    """

    frame: int
    depth: torch.Tensor
    intensity: torch.Tensor
    camera: KeyframeCamera
    _found: list[ImageFeatures] = field(default_factory=list, init=False, repr=False)

    @classmethod
    def of(cls, frame: int, pixels: FramePixels, camera: KeyframeCamera) -> Keyframe:
        """That of a frame's pixels, on any device, which it waits for once."""
        return ArrivingKeyframe.of(frame, pixels, camera).arrived()

    def changed(self, **changes: Any) -> Keyframe:
        """The same image under another number or in other memory; features that were found are kept."""
        other = replace(self, **changes)
        other.know_features(self.found_features)
        return other

    @property
    def features(self) -> ImageFeatures:
        """Of the image, those of which the depth is known; found once."""
        if self.found_features is None:  # before Python 3.12 a cached_property finds those of one keyframe at a time
            images = self.intensity.numpy(), self.depth.numpy()
            found = features_of_images(*images, self.camera.camera, self.camera.max_depth_m)
            self.know_features(found.with_depth())
        return self._found[0]

    @property
    def found_features(self) -> ImageFeatures | None:
        """Those features if they were found before, by whomever; None otherwise."""
        return self._found[0] if self._found else None

    def know_features(self, found: ImageFeatures | None) -> None:
        """Takes those features from whoever found them in this image; forgets them for None."""
        self._found[:] = [] if found is None else [found]

    @cached_property
    def median_m(self) -> float:
        """Median of the depth; infinite where none is known."""
        depth = self.thumbnail
        return float(depth[depth > 0].median()) if bool((depth > 0).any()) else math.inf

    @property
    def depth_m(self) -> torch.Tensor:
        """float32 [h, w], m, 0 where unknown."""
        return self.depth.to(torch.int32).float() * self.camera.unit

    @property
    def thumbnail(self) -> torch.Tensor:
        """float32 [h', w'] depth, m, 0 where unknown: every `thumbnail_step`-th pixel, the first at half of it."""
        step = self.camera.thumbnail_step
        depth = self.depth[step // 2 :: step, step // 2 :: step]
        return depth.to(torch.int32).float() * self.camera.unit

    def sample(self, count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Random pixels: packed records int32 [P, 3] in the keyframe's pixels and normals float32 [P, 3], 0 unknown.

        P is 0 where no pixel has depth.
        """
        camera = self.camera
        color = self.intensity[:, :, None].expand(-1, -1, 3).contiguous()
        sampling = ops.PixelSampling(
            count,
            MIN_DEPTH_M,
            camera.max_depth_m,
            camera.normal_step_px,
            camera.max_jump,
            thumbnail_step=camera.thumbnail_step,
        )
        stream = ops.RandomStream.PIXEL_DATABASE
        buffer, valid = ops.sample_frame_pixels(
            self.depth_m, color, *camera.intrinsics, sampling, seed, stream, self.frame
        )
        found = count if valid else 0
        records, normals = (buffer[3 * count * i :][: 3 * found].view(-1, 3) for i in range(2))
        return records, normals.view(torch.float32)


@dataclass(frozen=True)
class ArrivingKeyframe:
    """A keyframe whose images are on their way to the host.

    Attributes:
        frame: its number.
        content: uint8 of both images, depth first.
        sent: once it is complete, the content is there.
        camera: of the images.
    """

    frame: int
    content: torch.Tensor
    sent: DeviceEvent
    camera: KeyframeCamera

    @classmethod
    def of(cls, frame: int, pixels: FramePixels, camera: KeyframeCamera) -> ArrivingKeyframe:
        """That of a frame's pixels, on any device, which it does not wait for."""
        images = pixels.depth_image, pixels.intensity_image
        depth, intensity = (image[:: camera.step, :: camera.step].flatten() for image in images)
        content = fetch(torch.cat([depth.view(torch.uint8), intensity]))
        return cls(frame, content, event_recorder(depth.device)(), camera)

    def arrived(self) -> Keyframe:
        """The keyframe; waits until it is there."""
        self.sent.wait()
        k = self.camera.camera
        depth, intensity = self.content.split((2 * k.height * k.width, k.height * k.width))
        return Keyframe(
            self.frame,
            depth.view(torch.uint16).view(k.height, k.width),
            intensity.view(k.height, k.width),
            self.camera,
        )
