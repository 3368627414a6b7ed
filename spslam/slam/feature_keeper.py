"""Which frames' image features are kept, and where they come from."""

from __future__ import annotations

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.slam.feature_store import keeps_features, uses_features
from spslam.slam.image_features import FrameFeatures, ImageFeatures
from spslam.slam.moving_objects import StaticFrame
from spslam.slam.pixels import FramePixels
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.recovery.sliding import UNSURE_EIGENVALUE
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.state import SlamState

# After a frame whose features were asked for, or nearly: frames where surface says little come in groups, and the next
# ones are read by then.
EXPECTED_FRAMES = 30
NEAR = 1.5  # times the eigenvalue below which they may be asked for


class FeatureKeeper:
    """Keeps image features of a doubtful frame, and of every 30th one unless there are enough of its view.

    Args:
        config: options of the run.
        camera: of all frames.
        rectifier: of that camera.
    """

    def __init__(self, config: Config, camera: Camera, rectifier: ShutterRectifier):
        self._config, self._camera, self._rectifier = config, camera, rectifier
        self._since_asked = EXPECTED_FRAMES  # frames since features were asked for last

    def keep(
        self,
        state: SlamState,
        frame: PreparedFrame,
        static: StaticFrame,
        tracked: TrackedFrame,
        shutter: ops.ShutterMotion | None,
    ) -> None:
        """Keeps those of the newest frame, if they are to be kept.

        Args:
            state: after the frame; changed.
            frame: as it came.
            static: the frame without what moves.
            tracked: what tracking made of it.
            shutter: how the camera moved while it was read; None where that does not matter.
        """
        is_asked = tracked.features is not None or tracked.fit.min_eigenvalue < NEAR * UNSURE_EIGENVALUE
        self._since_asked = 0 if is_asked else self._since_asked + 1
        if tracked.occluded or state.frames.is_lost(-1):
            return
        read, number, history = static.features, len(state.frames) - 1, state.depth_history
        features = self._wanted(state, frame, static) if tracked.features is None else tracked.features
        if static.is_watched and history is not None and number in history.frames and uses_features(self._config):
            features = read.extracted  # poses of the next frames are predicted by them
        if features is not None and shutter is not None:
            features = self._rectifier.features(features, shutter)
        if features is not None:
            state.features.add(number, features)

    def of(self, read: FramePixels) -> FrameFeatures:
        """Those of a frame as it was read, extracted where they are asked for."""
        return FrameFeatures(read, self._camera, self._config.dataset.max_depth_m)

    @property
    def are_expected(self) -> bool:
        """Whether those of the next frames will probably be asked for: those of a recent one were, or nearly."""
        return self._since_asked < EXPECTED_FRAMES

    def _wanted(self, state: SlamState, frame: PreparedFrame, static: StaticFrame) -> ImageFeatures | None:
        """Of a frame that nobody doubted; those that are due and were not extracted ahead are extracted now."""
        if frame.features is None and not keeps_features(self._config, state.frames.processed - 1):
            return None
        if state.has_enough_features(len(state.frames) - 1):
            return None
        # Those that were extracted ahead are of what moves, too.
        return static.features.extracted if frame.features is None or static.is_watched else frame.features
