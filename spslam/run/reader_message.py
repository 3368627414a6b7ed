"""What processes that read send for each frame, whose pixels they leave in memory that both sides map."""

from typing import NamedTuple, cast

import torch

from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.datasets.frozen_depth import FrameSignature
from spslam.errors import DatasetError
from spslam.slam.image_features import ImageFeatures
from spslam.slam.pixels import FramePixels
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.upload import Upload


class Message(NamedTuple):
    """From a process that reads: a frame without its pixels, one that can't be read, a failure, or the end of the
    dataset (all defaults).

    Attributes:
        read_ms: time that a reading thread spent on the frame.
        slot: slot that holds the frame's pixels; None where there is no frame.
        dataset_index: `PreparedFrame.index`.
        timestamp, decode_ms: as in `PreparedFrame`.
        valid_depth_share, features: as in `FramePixels`.
        keeps_features: whether the features are those of `PreparedFrame` too.
        offsets: as in `PreparedFrame`, in the order of its fields; None for those of images taken at once.
        signature: as in `PreparedFrame`, where it is still to be looked at.
        error: of a frame that can't be read.
        failure: traceback of an exception that is not the data's fault; the process then ends.
        ended: exit code of a process that prepared frames, if one ended before its time.
    """

    read_ms: float = 0.0
    slot: int | None = None
    dataset_index: int = 0
    timestamp: float = 0.0
    decode_ms: float = 0.0
    valid_depth_share: float = 0.0
    features: ImageFeatures | None = None
    keeps_features: bool = False
    offsets: tuple[float, float] | None = None
    signature: FrameSignature | None = None
    error: DatasetError | None = None
    failure: str | None = None
    ended: int | None = None

    @classmethod
    def of(cls, frame: PreparedFrame, read_ms: float, slot: int, signature: FrameSignature | None = None) -> "Message":
        """Of a frame whose pixels are in a slot."""
        pixels = cast(FramePixels, frame.pixels)
        features = cast(ImageFeatures | None, pixels.features)  # nobody extracts them meanwhile
        described = (frame.index, frame.timestamp, frame.decode_ms, pixels.valid_depth_share, features)
        offsets = None if frame.offsets == AT_ONCE else (frame.offsets.depth, frame.offsets.color)
        return cls(read_ms, slot, *described, frame.features is not None, offsets, signature)

    def pixels(self, blank: FramePixels, buffer: torch.Tensor) -> FramePixels:
        """The frame's pixels: those of a blank frame with another buffer, int32 [words]."""
        shapes = blank.thumbnail_shape, blank.depth_image_shape
        return FramePixels(buffer, blank.capacity, *shapes, self.valid_depth_share, self.features)

    def frame(self, pixels: FramePixels | Upload) -> PreparedFrame:
        """The frame with these pixels."""
        frame = PreparedFrame(self.dataset_index, self.timestamp, pixels, self.decode_ms)
        frame.features = self.features if self.keeps_features else None
        frame.signature = self.signature
        if self.offsets is not None:
            frame.offsets = CaptureOffsets(*self.offsets)
        return frame
