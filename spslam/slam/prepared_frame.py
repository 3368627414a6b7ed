"""A frame sampled from its images, as the system takes it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.datasets.frozen_depth import FrameSignature
from spslam.slam.device_events import DeviceEvent
from spslam.slam.feature_store import keeps_features, needs_features, uses_features
from spslam.slam.image_features import ImageFeatures, extract_features
from spslam.slam.pixels import FramePixels, sample_frame
from spslam.slam.upload import Upload, Uploader


@dataclass
class PreparedFrame:
    """A sampled frame; its images are freed.

    Attributes:
        index: of the frame in the dataset; keys its draws.
        timestamp: s.
        pixels: on the CPU, or on their way to the device.
        decode_ms: reading, decoding and sampling, on the thread that did it.
        wait_ms: how long the host waited for the frame; 0 where it was there already.
        requested: when it was requested; None where nobody kept the time.
        signature: what tells frozen depth; None where nobody asks.
        features: of its image, where they are kept in any case and were extracted ahead; else this is done once the
            pose is known.
        offsets: as of `RgbdFrame`.
    """

    index: int
    timestamp: float
    pixels: FramePixels | Upload
    decode_ms: float = 0.0
    wait_ms: float = 0.0
    requested: DeviceEvent | None = None
    signature: FrameSignature | None = None
    features: ImageFeatures | None = None
    offsets: CaptureOffsets = AT_ONCE

    @property
    def depth_time(self) -> float:
        """When the depth image was taken, s."""
        return self.timestamp + self.offsets.depth

    @classmethod
    def of(cls, frame: RgbdFrame, camera: Camera, config: Config, shared: bool = False) -> "PreparedFrame":
        """Samples a frame of color, depth and time stamp, of pinhole intrinsics, for a run of a configuration; `shared`
        as of `sample_frame`."""
        began = time.perf_counter()
        pixels = sample_frame(frame, camera, config, shared)
        decode_ms = 1e3 * (time.perf_counter() - began)
        return cls(frame.index, frame.timestamp, pixels, decode_ms, offsets=frame.offsets)


class FramePreparation:
    """The frames of a dataset from a position on, each read, decoded, sampled and, with an uploader, sent off.

    Image features that are kept in any case are extracted too.

    Args:
        dataset: the frames.
        config: how they are sampled.
        start: position of the first one.
        uploader: sends them to a device.
        extracts: asked of each frame whether to extract its image features in any case: whoever takes it then waits
            for none. None extracts those that are needed.
    """

    def __init__(
        self,
        dataset: RgbdDataset,
        config: Config,
        start: int = 0,
        uploader: Uploader | None = None,
        extracts: Callable[[], bool] | None = None,
    ):
        self._dataset, self._config, self._start, self._uploader = dataset, config, start, uploader
        self._extracts = extracts if uses_features(config) else None

    def __len__(self) -> int:
        return len(self._dataset) - self._start

    def __getitem__(self, i: int) -> PreparedFrame:
        began = time.perf_counter()
        frame, config = self._dataset[i + self._start], self._config
        prepared = PreparedFrame.of(frame, self._dataset.camera, config)
        is_kept = keeps_features(config, i + self._start)
        if needs_features(config, i + self._start) or (self._extracts is not None and self._extracts()):
            features = self._extract(prepared)
            prepared.features = features if is_kept else None
        prepared.signature = FrameSignature.of(frame)
        prepared.decode_ms = 1e3 * (time.perf_counter() - began)
        if self._uploader:
            prepared.pixels = self._uploader.send(cast(FramePixels, prepared.pixels))
        return prepared

    def extract_ahead(self, frame: PreparedFrame, number: int) -> None:
        """Extracts image features of a frame of this that is on the CPU, if frame `number` of the run needs them.

        That number differs from the frame's position where frames could not be read.
        """
        if needs_features(self._config, number):
            self._extract(frame)

    def _extract(self, frame: PreparedFrame) -> ImageFeatures:
        """Extracts the image features of a frame on the CPU, unless that was done."""
        pixels = cast(FramePixels, frame.pixels)
        features = extract_features(pixels, self._dataset.camera, self._config.dataset.max_depth_m)
        frame.pixels = replace(pixels, features=features)
        return features
