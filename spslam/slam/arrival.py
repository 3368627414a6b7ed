"""Frames that come one at a time, as from a camera: what is done with one before it is tracked."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import cast

import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame
from spslam.slam.feature_store import needs_features, uses_features
from spslam.slam.image_features import extract_features
from spslam.slam.pixels import FramePixels
from spslam.slam.prepared_frame import PreparedFrame


class FrameArrival:
    """Prepares frames, each as fast as it can: the kernels' threads share one.

    Beside a GPU a thread extracts the image features that will probably be asked for while the frame is sent there and
    tracked.

    Args:
        config: options of the run.
        camera: of all frames.
        device: that tracks them.
    """

    def __init__(self, config: Config, camera: Camera, device: torch.device):
        self._config, self._camera = config, camera
        self._extractor: ThreadPoolExecutor | None = None
        if device.type == "cuda" and uses_features(config):
            self._extractor = ThreadPoolExecutor(1, thread_name_prefix="spslam-features")

    def close(self) -> None:
        """Ends the thread; no frame can be prepared after it. May be called again."""
        if self._extractor is not None:
            self._extractor.shutdown(wait=False, cancel_futures=True)

    def prepare(self, frame: RgbdFrame, number: int, are_expected: bool) -> PreparedFrame:
        """A frame as `FramePipeline.submit` takes it, on the CPU.

        Args:
            frame: as it came.
            number: of frames that were processed before.
            are_expected: whether its image features will probably be asked for.
        """
        prepared = PreparedFrame.of(frame, self._camera, self._config, shared=True)
        if self._extractor is not None and (are_expected or needs_features(self._config, number)):
            pixels = cast(FramePixels, prepared.pixels)
            largest_m = self._config.dataset.max_depth_m
            coming = self._extractor.submit(extract_features, pixels, self._camera, largest_m)
            prepared.pixels = replace(pixels, features=coming)
        return prepared
