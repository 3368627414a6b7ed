"""The frame loop: what happens to one frame, in order."""

import math

import numpy as np
import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame
from spslam.errors import DatasetError
from spslam.prior import load_prior
from spslam.slam.device_events import event_recorder
from spslam.slam.frame_history import FrameHistory
from spslam.slam.frame_report import FrameEvents, FrameReport, PendingReport
from spslam.slam.mapper import Mapper
from spslam.slam.pixels import FramePixels, sample_frame
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.recovery.pose_confidence import Fit
from spslam.slam.state import SlamState, pose_tensor
from spslam.slam.tracker import Tracker, TrackingResult
from spslam.slam.upload import Upload
from spslam.trajectory import Trajectory

SETTLED_FRAMES = 3  # known one after another, before what follows a loss is trusted with the map
MAX_DISTANCE_M = 10_000.0  # a float32 still tells a millimeter there


class SlamSystem:
    """Tracks and maps RGB-D frames, one `process` call each.

    Example:
        >>> system = SlamSystem(load_config("folder"), camera)          # doctest: +SKIP
        >>> for frame in frames: system.process(frame)                  # doctest: +SKIP
        >>> system.finish(); system.trajectory().save_tum("path.txt")   # doctest: +SKIP
    """

    def __init__(
        self,
        config: Config,
        camera: Camera,
        first_pose: np.ndarray | None = None,
        device: torch.device | str = "cpu",
    ):
        """A system that has seen nothing.

        Args:
            config: settings.
            camera: pinhole intrinsics of all frames.
            first_pose: float64 [4, 4] T_world_camera of the first frame; identity where not given.
            device: where the map lives and the kernels run.

        Raises:
            DatasetError: the first pose lies too far from the world's origin.
        """
        self.config = config
        self.camera = camera
        self.device = torch.device(device)
        prior = load_prior(config.prior.weights, config.prior.neighborhood)
        decoder = prior.decoder_params if config.prior.decoder == "pretrained" else None
        self.first_pose = np.eye(4) if first_pose is None else np.asarray(first_pose, np.float64)
        _check_first_pose(self.first_pose)
        self.state = SlamState.start(config, camera, self.first_pose, decoder, self.device)
        self.history = FrameHistory(self.state, camera)
        self.tracker = Tracker(config, camera)
        self.mapper = Mapper(config, camera, prior if config.prior.enabled else None)

    def process(self, frame: RgbdFrame) -> FrameReport:
        """Takes the next frame in, and waits until the device is done with it.

        Args:
            frame: color, depth, timestamp.

        Raises:
            SpslamError: the map or the pixels would pass a limit of the configuration. The frame has then been taken
                in half, and the system must not be given another.
        """
        pixels = sample_frame(frame, self.camera, self.config)
        return self.submit(PreparedFrame(frame.index, frame.timestamp, pixels)).result()

    def submit(self, frame: PreparedFrame) -> PendingReport:
        """Takes the next frame in as `process` does, but waits only for its pose: mapping goes on behind."""
        self._mark = event_recorder(self.device)
        began = self._mark()
        marks = FrameEvents(asked=frame.requested or began, began=began, done=began)
        pixels = self._receive(frame, marks)
        number = len(self.state.frames)
        tracked = self._track(pixels, number, marks)
        self.state.frames.append(
            tracked.pose, frame.timestamp, frame.index, tracked.lost, pixels.depth_thumbnail, tracked.consistent_frames
        )
        obstructed = tracked.fit.is_obstructed
        # What is before the lens is no part of the scene: neither mapped now nor drawn from later.
        self.state.pixels.add(pixels.records[:0] if obstructed else pixels.records)
        if self.state.views is not None and not obstructed and not tracked.lost:
            self.state.views.add(number, pixels.view)
        mapped = not obstructed and self._is_mapping_frame(number)
        self.state.unmapped = not mapped
        iterations, losses = self._map(pixels, marks) if mapped else (0, None)
        loss = None if losses is None else _fetch(losses[0])
        marks.done = self._mark()
        known = {
            "frame": number,
            "index": frame.index,
            "timestamp": frame.timestamp,
            "lost": bool(self.state.frames.lost[-1]),
            "valid_depth_share": pixels.valid_depth_share,
            "tracking_iterations": tracked.iterations,
            "residual_cm": _known(tracked.fit.residual_cm),
            "inlier_share": _known(tracked.fit.inlier_share),
            "mean_robust_weight": _known(tracked.fit.mean_robust_weight),
            "min_eigenvalue": _known(tracked.fit.min_eigenvalue),
            "prediction_error_cm": _known(tracked.fit.prediction_error_cm),
            "prediction_error_deg": _known(tracked.fit.prediction_error_deg),
            "free_space_violation": _known(tracked.fit.free_space_violation),
            "occluded_share": _known(tracked.fit.occluded_share),
            "map_coverage": _known(tracked.fit.map_coverage),
            "brightness_correlation": _known(tracked.fit.brightness_correlation),
            "error_probability": _known(tracked.fit.error_probability),
            "recovered": tracked.recovered,
            "relocalized": tracked.relocalized,
            "mapping_iterations": iterations,
            "voxels": self.state.scene.volume.num_voxels,
            "decode_ms": frame.decode_ms,
        }
        return PendingReport(known, marks, frame.wait_ms, loss)

    def finish(self) -> None:
        """Optimizes once more if frames came after the last mapping call. Call it after the last frame."""
        if self.state.unmapped:
            self.mapper.optimize(self.state, self.config.mapping.iterations)
            self.state.unmapped = False

    def trajectory(self) -> Trajectory:
        """Poses of all frames as they are refined up to now."""
        frames = self.state.frames
        return Trajectory(frames.timestamps.numpy().copy(), frames.matrices(), frames.lost.numpy().copy())

    def _receive(self, frame: PreparedFrame, marks: FrameEvents) -> FramePixels:
        if not isinstance(frame.pixels, Upload):
            return frame.pixels.to(self.device)
        marks.upload = (frame.pixels.begin, frame.pixels.end)
        return frame.pixels.received()

    def _track(self, pixels: FramePixels, number: int, marks: FrameEvents) -> TrackingResult:
        if self.state.scene.volume.num_voxels == 0:
            pose = pose_tensor(self.first_pose, self.device)
            return TrackingResult(pose, 0, Fit(), lost=self.tracker.has_too_little_depth(pixels))
        begin = self._mark()
        start = self.tracker.predict(self.state.frames)
        tracked = self.tracker.track(
            self.state.scene, pixels, start, number, self.history, self._is_mapping_turn(number)
        )
        marks.tracking = (begin, self._mark())
        return tracked

    def _is_mapping_turn(self, number: int) -> bool:
        return number % self.config.mapping.every == 0

    def _is_mapping_frame(self, number: int) -> bool:
        """Whether the newest frame is to be mapped: a lost one never, one soon after loss not yet."""
        if self.state.scene.volume.num_voxels == 0:
            return not bool(self.state.frames.lost[-1])
        if not self._is_mapping_turn(number):
            return False
        return not bool(self.state.frames.lost[-SETTLED_FRAMES:].any())

    def _map(self, pixels: FramePixels, marks: FrameEvents) -> tuple[int, torch.Tensor | None]:
        """Encodes and optimizes; returns the number of iterations and the last one's losses."""
        first, begin = self.state.scene.volume.num_voxels == 0, self._mark()
        self.mapper.integrate(self.state, pixels)
        marks.encode = (begin, self._mark())
        if self.state.scene.volume.num_voxels == 0:
            # Depth without a surface in it: the map must begin with a later frame, and so must the path.
            self.state.frames.lost[-1] = True
            return 0, None
        iterations = self.config.mapping.first_iterations if first else self.config.mapping.iterations
        losses = self.mapper.optimize(self.state, iterations)
        marks.mapping = (marks.encode[1], self._mark())
        return iterations, losses


def _check_first_pose(pose: np.ndarray) -> None:
    distance = float(np.linalg.norm(pose[:3, 3]))
    if not distance <= MAX_DISTANCE_M:
        raise DatasetError(
            f"the first pose must lie within {MAX_DISTANCE_M / 1000:.0f} km of the world's origin, got "
            f"{distance / 1000:.0f} km; scene.first_pose=identity starts at the origin instead"
        )


def _known(number: float) -> float | None:
    """None for NaN, which JSON has no word for."""
    return None if math.isnan(number) else number


def _fetch(number: torch.Tensor) -> torch.Tensor:
    """A copy of a tensor [] that is on its way to the CPU; to be read once the device is done."""
    if number.device.type == "cpu":
        return number.clone()
    return torch.empty_like(number, device="cpu", pin_memory=True).copy_(number, non_blocking=True)
