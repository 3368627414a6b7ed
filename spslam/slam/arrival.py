"""Frames that come one at a time, as from a camera: what is done with one before it is tracked."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame
from spslam.slam.device_events import StreamEvent
from spslam.slam.feature_store import needs_features, uses_features
from spslam.slam.image_features import ImageFeatures, extract_features
from spslam.slam.pixels import FramePixels
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.upload import ImageUploader, Upload


class FrameArrival:
    """Prepares frames, each as fast as it can: on a CPU the kernels' threads share one, a GPU samples it.

    Beside a GPU a thread extracts the image features that will probably be asked for while the frame is tracked.

    Args:
        config: options of the run.
        camera: of all frames.
        device: that tracks them.
    """

    def __init__(self, config: Config, camera: Camera, device: torch.device):
        self._config, self._camera = config, camera
        self._uploader = ImageUploader(device, camera, config) if device.type == "cuda" else None
        self._extractor: ThreadPoolExecutor | None = None
        if device.type == "cuda" and uses_features(config):
            self._extractor = ThreadPoolExecutor(1, thread_name_prefix="spslam-features")

    def close(self) -> None:
        """Ends the thread; no frame can be prepared after it. May be called again."""
        if self._extractor is not None:
            self._extractor.shutdown(wait=False, cancel_futures=True)

    def prepare(self, frame: RgbdFrame, number: int, are_expected: bool) -> PreparedFrame:
        """A frame as `FramePipeline.submit` takes it, on the device or on its way there.

        Args:
            frame: as it came; its images may be changed afterwards.
            number: of frames that were processed before.
            are_expected: whether its image features will probably be asked for.
        """
        if self._uploader is None:
            return PreparedFrame.of(frame, self._camera, self._config, shared=True)
        began = time.perf_counter()
        upload = self._uploader.sample(frame)
        if self._extractor is not None and (are_expected or needs_features(self._config, number)):
            upload = self._with_features(upload, self._uploader, self._extractor)
        decode_ms = 1e3 * (time.perf_counter() - began)
        return PreparedFrame(frame.index, frame.timestamp, upload, decode_ms, offsets=frame.offsets)

    def _with_features(self, upload: Upload, uploader: ImageUploader, extractor: ThreadPoolExecutor) -> Upload:
        """An upload whose image features are being extracted."""
        images, fetched = uploader.fetch_images(upload.pixels)
        coming = extractor.submit(self._extracted, images, fetched)
        return replace(upload, pixels=replace(upload.pixels, features=coming))

    def _extracted(self, images: FramePixels, fetched: StreamEvent) -> ImageFeatures:
        fetched.wait()
        return extract_features(images, self._camera, self._config.dataset.max_depth_m)
