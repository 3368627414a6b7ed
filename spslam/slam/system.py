"""The SLAM system: what happens to one frame, in order."""

import numpy as np
import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame
from spslam.errors import DatasetError
from spslam.prior import load_prior
from spslam.slam.constraints import ConstraintSource
from spslam.slam.device_events import event_recorder
from spslam.slam.frame_history import FrameHistory
from spslam.slam.frame_report import FrameEvents, FrameReport, PendingReport
from spslam.slam.mapper import Mapper
from spslam.slam.pixels import FramePixels, sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.recovery import Recovery, TrackedFrame
from spslam.slam.state import SlamState
from spslam.slam.tracker import Tracker, TrackingProblem
from spslam.slam.upload import Upload
from spslam.trajectory import Trajectory

SETTLED_FRAMES = 3  # trusted frames in a row, this one included, before mapping continues after a lost frame
MAX_DISTANCE_M = 10_000.0  # a float32 still resolves a millimeter there


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
        """A system without a map.

        Args:
            config: options of the run.
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
        confidence = PoseConfidenceModel.load()
        self.state = SlamState.start(config, camera, self.first_pose, decoder, self.device)
        self.history = FrameHistory(self.state)
        self.constraints = ConstraintSource(config, camera)
        self.tracker = Tracker(config, camera, confidence.score_kernel_m)
        self.recovery = Recovery(config, camera, self.tracker, confidence)
        self.mapper = Mapper(config, camera, prior if config.prior.enabled else None)

    def process(self, frame: RgbdFrame) -> FrameReport:
        """Tracks and maps the next frame, and waits until the device is done with it.

        Args:
            frame: color, depth, timestamp.

        Raises:
            SpslamError: the map or the pixels would pass a limit of the configuration. The frame has then been
                processed in part, and the system must not be given another.
        """
        pixels = sample_frame(frame, self.camera, self.config)
        return self.submit(PreparedFrame(frame.index, frame.timestamp, pixels)).result()

    def submit(self, frame: PreparedFrame) -> PendingReport:
        """Tracks and maps the next frame as `process` does, but does not wait for the optimization of the map."""
        self._record = event_recorder(self.device)
        started = self._record()
        events = FrameEvents(requested=frame.requested or started, started=started, finished=started)
        number = len(self.state.frames)
        pixels = self._receive(frame, events)
        tracked = self._track(pixels, number, events)
        self._store(frame, pixels, tracked)
        iterations, loss = self._map(pixels, tracked, number, events)
        events.finished = self._record()
        return PendingReport(self._report(frame, pixels, tracked, iterations), events, frame.wait_ms, loss)

    def finish(self) -> None:
        """Optimizes once more if frames came after the last mapping call. Call it after the last frame."""
        if self.state.unmapped:
            self.mapper.optimize(self.state, self.config.mapping.iterations)
            self.state.unmapped = False

    def trajectory(self) -> Trajectory:
        """Poses of all frames as they are refined up to now."""
        frames = self.state.frames
        return Trajectory(frames.timestamps.numpy().copy(), frames.matrices(), frames.lost.numpy().copy())

    def localize(
        self, pixels: FramePixels, predicted: torch.Tensor, number: int, to_be_mapped: bool = False
    ) -> TrackedFrame:
        """The pose of a frame against the map and the frames before it; changes nothing.

        Args:
            pixels: of the frame.
            predicted: float32 [7], the pose to start from.
            number: of the frame; keys its random draws.
            to_be_mapped: whether the frame is to be mapped if its pose is trusted; it is then checked for occlusion.
        """
        if self._has_too_little_depth(pixels):
            return TrackedFrame.untracked(predicted.clone(), lost=True)
        constraints = self.constraints.gather(self.history, pixels)
        problem = TrackingProblem(self.state.scene, pixels.records, predicted, number, constraints)
        estimate = self.tracker.track(problem)
        return self.recovery.resolve(problem, estimate, pixels, self.history, to_be_mapped)

    @property
    def _has_map(self) -> bool:
        return self.state.scene.volume.num_voxels > 0

    def _receive(self, frame: PreparedFrame, events: FrameEvents) -> FramePixels:
        if not isinstance(frame.pixels, Upload):
            return frame.pixels.to(self.device)
        events.upload = (frame.pixels.begin, frame.pixels.end)
        return frame.pixels.received()

    def _track(self, pixels: FramePixels, number: int, events: FrameEvents) -> TrackedFrame:
        if not self._has_map:
            first = pose_tensor(self.first_pose, self.device)
            return TrackedFrame.untracked(first, lost=self._has_too_little_depth(pixels))
        begin = self._record()
        predicted = self.tracker.predict(self.state.frames)
        tracked = self.localize(pixels, predicted, number, self._is_mapping_turn(number))
        events.tracking = (begin, self._record())
        return tracked

    def _store(self, frame: PreparedFrame, pixels: FramePixels, tracked: TrackedFrame) -> None:
        """Adds the frame to the state, without the pixels of an occluded frame, so that mapping never uses them."""
        state, number = self.state, len(self.state.frames)
        state.frames.append(
            tracked.pose,
            frame.timestamp,
            frame.index,
            tracked.lost,
            pixels.depth_thumbnail,
            tracked.consistent_frames,
        )
        state.pixels.add(pixels.records[:0] if tracked.occluded else pixels.records)
        if state.depth_keyframes is not None and not tracked.occluded and not tracked.lost:
            earlier = self.history.depth_keyframes_before(number)
            if earlier is not None:
                state.noise.measure(pixels, tracked.pose, earlier)
            state.depth_keyframes.add(number, pixels.depth_image, pixels.intensity_image)

    def _map(
        self, pixels: FramePixels, tracked: TrackedFrame, number: int, events: FrameEvents
    ) -> tuple[int, torch.Tensor | None]:
        """Encodes and optimizes if it is the frame's turn; returns the iterations made and the last total loss."""
        is_mapped = not tracked.occluded and self._is_mapping_frame(number)
        self.state.unmapped = not is_mapped
        if not is_mapped:
            return 0, None
        is_first, begin = not self._has_map, self._record()
        self.mapper.integrate(self.state, pixels)
        events.encode = (begin, self._record())
        if not self._has_map:
            # Depth without a surface in it: the map must begin with a later frame, and so must the trajectory.
            self.state.frames.lost[-1] = True
            return 0, None
        iterations = self.config.mapping.first_iterations if is_first else self.config.mapping.iterations
        losses = self.mapper.optimize(self.state, iterations)
        events.mapping = (events.encode[1], self._record())
        return iterations, None if losses is None else _fetch(losses[0])

    def _report(
        self, frame: PreparedFrame, pixels: FramePixels, tracked: TrackedFrame, mapping_iterations: int
    ) -> FrameReport:
        return FrameReport(
            frame=len(self.state.frames) - 1,
            index=frame.index,
            timestamp=frame.timestamp,
            lost=bool(self.state.frames.lost[-1]),
            valid_depth_share=pixels.valid_depth_share,
            tracking_iterations=tracked.iterations,
            fit=tracked.fit,
            error_probability=tracked.error_probability,
            recovered=tracked.recovered,
            relocalized=tracked.relocalized,
            mapping_iterations=mapping_iterations,
            voxels=self.state.scene.volume.num_voxels,
            decode_ms=frame.decode_ms,
        )

    def _has_too_little_depth(self, pixels: FramePixels) -> bool:
        """Whether too little of the image has depth to determine a pose."""
        return len(pixels.records) == 0 or pixels.valid_depth_share < self.config.tracking.min_valid_depth_share

    def _is_mapping_turn(self, number: int) -> bool:
        return number % self.config.mapping.every == 0

    def _is_mapping_frame(self, number: int) -> bool:
        """Whether the newest frame is to be mapped: a lost one never, one soon after a lost one not yet."""
        if not self._has_map:
            return not bool(self.state.frames.lost[-1])
        return self._is_mapping_turn(number) and not bool(self.state.frames.lost[-SETTLED_FRAMES:].any())


def _check_first_pose(pose: np.ndarray) -> None:
    distance = float(np.linalg.norm(pose[:3, 3]))
    if not distance <= MAX_DISTANCE_M:
        raise DatasetError(
            f"the first pose must lie within {MAX_DISTANCE_M / 1000:.0f} km of the world's origin, got "
            f"{distance / 1000:.0f} km; scene.first_pose=identity starts at the origin instead"
        )


def _fetch(number: torch.Tensor) -> torch.Tensor:
    """A copy of a tensor [] that is on its way to the CPU; to be read once the device is done."""
    if number.device.type == "cpu":
        return number.clone()
    return torch.empty_like(number, device="cpu", pin_memory=True).copy_(number, non_blocking=True)
