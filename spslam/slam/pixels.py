"""Pixels of one frame: which are kept, and how they are packed.

A pixel record is three 32-bit words: u | v << 16; the bits of the float32 depth (m); r | g << 8 | b << 16 | c << 24.
c is the foreshortening n . d times 128 (n the surface normal, d the ray direction with camera z = 1; 0 = unknown): it
turns a depth difference along the ray into a distance to the surface's tangent plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame
from spslam.slam.depth_keyframes import depth_image_step, depth_unit

if TYPE_CHECKING:
    from concurrent.futures import Future

    from spslam.slam.image_features import ImageFeatures

THUMBNAIL_STEP_PX = 16
WORD_BYTES = 4  # of the buffer


@dataclass(frozen=True)
class FramePixels:
    """What tracking and mapping need of a frame, in one buffer, so that an upload is one copy.

    Attributes:
        buffer: int32 words of the records, normals, depth thumbnail, depth image and intensity image, as
            `ops.sample_frame_pixels` returns them.
        capacity: records that the buffer holds; without depth they are 0 and none of them counts.
        thumbnail_shape: rows and columns of the depth thumbnail.
        depth_image_shape: rows and columns of the depth and intensity images; 0 and 0 without.
        valid_depth_share: share of the image's pixels with usable depth.
        features: of the images, where they were extracted ahead, or while they are; on the CPU, and no part of the
            buffer.
    """

    buffer: torch.Tensor
    capacity: int
    thumbnail_shape: tuple[int, int]
    depth_image_shape: tuple[int, int]
    valid_depth_share: float
    features: ImageFeatures | Future[ImageFeatures] | None = None

    @property
    def count(self) -> int:
        """P, the number of records; 0 without depth."""
        return self.capacity if self.valid_depth_share > 0 else 0

    @cached_property
    def records(self) -> torch.Tensor:
        """int32 [P, 3] packed pixels in random order, so that any prefix is an even sample; a view of the buffer."""
        return self._view(torch.int32, 0, (self.count, 3))

    @cached_property
    def normals(self) -> torch.Tensor:
        """float32 [P, 3] unit normals in camera axes, turned to the camera, 0 where unknown; a view of the buffer."""
        return self._view(torch.float32, 3 * self.capacity, (self.count, 3))

    @cached_property
    def depth_thumbnail(self) -> torch.Tensor:
        """float16 [h, w] depth (m) at every `THUMBNAIL_STEP_PX`-th pixel, 0 where invalid; a view of the buffer."""
        return self._view(torch.float16, 6 * self.capacity, self.thumbnail_shape)

    @cached_property
    def depth_image(self) -> torch.Tensor:
        """uint16 [h', w'] depth in 1/65535 of the largest that is used, 0 where unknown; a view of the buffer."""
        return self._view(torch.uint16, self.buffer.numel() - sum(self._image_words), self.depth_image_shape)

    @cached_property
    def intensity_image(self) -> torch.Tensor:
        """uint8 [h', w'] intensity in 1/255 of the same pixels; a view of the buffer."""
        return self._view(torch.uint8, self.buffer.numel() - self._image_words[1], self.depth_image_shape)

    def _view(self, dtype: torch.dtype, word: int, shape: tuple[int, int]) -> torch.Tensor:
        """What the buffer holds from a word on, [rows, columns]; a frame asks for several, so in few operations."""
        content = self.buffer if dtype == torch.int32 else self.buffer.view(dtype)
        first = content.storage_offset() + word * WORD_BYTES // content.element_size()
        return content.as_strided(shape, (shape[1], 1), first)

    @property
    def _image_words(self) -> tuple[int, int]:
        return _image_words(self.depth_image_shape)

    def to(self, device: torch.device, non_blocking: bool = False) -> FramePixels:
        """The same on another device; one copy."""
        return self.holding(self.buffer.to(device, non_blocking=non_blocking))

    def holding(self, buffer: torch.Tensor) -> FramePixels:
        """The same in another buffer, to which the words were copied."""
        return FramePixels(
            buffer,
            self.capacity,
            self.thumbnail_shape,
            self.depth_image_shape,
            self.valid_depth_share,
            self.features,
        )

    def only_images(self, copy: Callable[[torch.Tensor], torch.Tensor]) -> FramePixels:
        """Depth and intensity image without the rest, in a buffer of their own that `copy` makes of theirs."""
        first = self.buffer.numel() - sum(self._image_words)
        return replace(self, buffer=copy(self.buffer[first:]), capacity=0, thumbnail_shape=(0, 0))

    def having(self, **views: torch.Tensor) -> FramePixels:
        """The same, but for views by their names, which are tensors of their own; the buffer is as it was read."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__, **views)
        return other


def sample_frame(frame: RgbdFrame, camera: Camera, config: Config, shared: bool = False) -> FramePixels:
    """Draws `pixels.per_frame` pixels with valid depth, with replacement, and finds their normals.

    Args:
        frame: color and depth; `frame.index` keys the draw.
        camera: pinhole intrinsics of the frame.
        config: sections `dataset` (depth range), `pixels` and `prior` (normals).
        shared: whether the kernels' threads share the work, as where nothing else has any for them.
    """
    depth = torch.from_numpy(np.ascontiguousarray(frame.depth, np.float32))
    color = torch.from_numpy(np.ascontiguousarray(frame.color))
    return sample_images(depth, color, frame.index, camera, config, shared)


def sample_images(
    depth: torch.Tensor, color: torch.Tensor, index: int, camera: Camera, config: Config, shared: bool = False
) -> FramePixels:
    """`sample_frame` of images on any device, float32 and uint8; on CUDA it waits for its stream."""
    sampling = replace(_sampling(camera, config), shared=shared)
    buffer, num_valid = ops.sample_frame_pixels(
        depth,
        color,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        sampling,
        config.seed,
        ops.RandomStream.PIXEL_DATABASE,
        index,
    )
    shapes = sampling.thumbnail_shape(*depth.shape), sampling.depth_image_shape(*depth.shape)
    return FramePixels(buffer, sampling.count, *shapes, num_valid / depth.numel())


def blank_pixels(camera: Camera, config: Config) -> FramePixels:
    """What `sample_frame` makes of a frame without depth."""
    sampling = _sampling(camera, config)
    size = camera.height, camera.width
    shapes = sampling.thumbnail_shape(*size), sampling.depth_image_shape(*size)
    (rows, columns), images = shapes[0], _image_words(shapes[1])
    words = 6 * sampling.count + -(-rows * columns // 2) + sum(images)
    return FramePixels(torch.zeros(words, dtype=torch.int32), sampling.count, *shapes, 0.0)


def image_pixels(depth: torch.Tensor, intensity: torch.Tensor) -> FramePixels:
    """Images uint16 and uint8 [h', w'] without records, of one device."""
    rows, columns = depth.shape
    nothing = torch.zeros(0, dtype=torch.int32, device=depth.device)
    return FramePixels(nothing, 0, (0, 0), (rows, columns), 0.0).having(depth_image=depth, intensity_image=intensity)


def _image_words(shape: tuple[int, int]) -> tuple[int, int]:
    """Words that a depth and an intensity image of a shape take."""
    pixels = shape[0] * shape[1]
    return -(-pixels // 2), -(-pixels // 4)


def _sampling(camera: Camera, config: Config) -> ops.PixelSampling:
    return ops.PixelSampling(
        count=config.pixels.per_frame,
        min_depth=config.dataset.min_depth_m,
        max_depth=config.dataset.max_depth_m,
        step_px=config.prior.normal_step_px,
        max_jump=config.prior.max_jump,
        thumbnail_step=THUMBNAIL_STEP_PX,
        depth_image_step=depth_image_step(camera),
        depth_image_unit=depth_unit(config.dataset.max_depth_m),
    )


def unpack_points(records: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Surface points of pixel records in camera axes: float32 [P, 3], m."""
    u = (records[:, 0] & 0xFFFF).float()
    v = ((records[:, 0] >> 16) & 0xFFFF).float()
    z = records[:, 1].contiguous().view(torch.float32)
    return torch.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
