"""A frame sampled from its images, as the system takes it."""

import time
from dataclasses import dataclass

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.datasets.frozen_depth import FrameSignature
from spslam.slam.device_events import DeviceEvent
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
        wait_ms: how long the host waited for the frame.
        requested: when it was requested; None where nobody kept the time.
        signature: what tells frozen depth; None where nobody asks.
    """

    index: int
    timestamp: float
    pixels: FramePixels | Upload
    decode_ms: float = 0.0
    wait_ms: float = 0.0
    requested: DeviceEvent | None = None
    signature: FrameSignature | None = None


class FramePreparation:
    """The frames of a dataset from a position on, each read, decoded, sampled and, with an uploader, sent off."""

    def __init__(self, dataset: RgbdDataset, config: Config, start: int = 0, uploader: Uploader | None = None):
        self._dataset, self._config, self._start, self._uploader = dataset, config, start, uploader

    def __len__(self) -> int:
        return len(self._dataset) - self._start

    def __getitem__(self, i: int) -> PreparedFrame:
        began = time.perf_counter()
        frame = self._dataset[i + self._start]
        pixels = sample_frame(frame, self._dataset.camera, self._config)
        signature = FrameSignature.of(frame)
        decode_ms = 1e3 * (time.perf_counter() - began)
        sent = self._uploader.send(pixels) if self._uploader else pixels
        return PreparedFrame(frame.index, frame.timestamp, sent, decode_ms, signature=signature)
