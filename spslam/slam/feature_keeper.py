"""Which frames' image features are kept, and where they come from."""

from __future__ import annotations

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.slam.feature_store import keeps_features
from spslam.slam.image_features import ImageFeatures, extract_features
from spslam.slam.pixels import FramePixels
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.state import SlamState


class FeatureKeeper:
    """Keeps image features of a doubtful frame, and of every 30th one unless there are enough of its view.

    Args:
        config: options of the run.
        camera: of all frames.
        rectifier: of that camera.
    """

    def __init__(self, config: Config, camera: Camera, rectifier: ShutterRectifier):
        self._config, self._camera, self._rectifier = config, camera, rectifier

    def keep(
        self,
        state: SlamState,
        frame: PreparedFrame,
        read: FramePixels,
        tracked: TrackedFrame,
        shutter: ops.ShutterMotion | None,
    ) -> None:
        """Keeps those of the newest frame, if they are to be kept.

        Args:
            state: after the frame; changed.
            frame: as it came.
            read: its pixels, as they were read.
            tracked: what tracking made of it.
            shutter: how the camera moved while it was read; None where that does not matter.
        """
        if tracked.occluded or state.frames.is_lost(-1):
            return
        features = self._wanted(state, frame, read) if tracked.features is None else tracked.features
        if features is not None and shutter is not None:
            features = self._rectifier.features(features, shutter)
        if features is not None:
            state.features.add(len(state.frames) - 1, features)

    def _wanted(self, state: SlamState, frame: PreparedFrame, read: FramePixels) -> ImageFeatures | None:
        """Of a frame that nobody doubted; those that are due and were not extracted ahead are extracted now."""
        if frame.features is None and not keeps_features(self._config, state.frames.processed - 1):
            return None
        if state.has_enough_features(len(state.frames) - 1):
            return None
        if frame.features is not None:
            return frame.features
        return extract_features(read, self._camera, self._config.dataset.max_depth_m)
