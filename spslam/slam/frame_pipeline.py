"""What happens to one frame, in order."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.prior import load_prior
from spslam.slam.constraints import Constraints, ConstraintSource
from spslam.slam.device_events import event_recorder, fetch
from spslam.slam.feature_keeper import FeatureKeeper
from spslam.slam.frame_history import FrameHistory
from spslam.slam.frame_report import FrameEvents, PendingReport, frame_report
from spslam.slam.graph.edges import LoopDecision
from spslam.slam.graph.global_mapping import GlobalMapping
from spslam.slam.image_features import FrameFeatures
from spslam.slam.interpreter import interpreter_shared
from spslam.slam.localizer import LocalizedFrame, Localizer
from spslam.slam.mapper import Mapper, MappingTask
from spslam.slam.moving_objects import MovingObjects, StaticFrame
from spslam.slam.multi_map import MultiMap
from spslam.slam.pixels import FramePixels
from spslam.slam.poses import check_first_pose, pose_tensor
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.recovery import Recovery
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.row_copies import RowCopies
from spslam.slam.state import SlamState
from spslam.slam.tracker import Tracker, TrackingProblem
from spslam.slam.upload import Upload

# A frame of which a smaller share of pixels lies on mapped surface is mapped out of turn: the camera moves so fast that
# at its next turn it might see nothing known.
MIN_MAPPED_SHARE = 0.5
SETTLED_FRAMES = 3  # trusted frames in a row, this one included, before mapping continues after a lost frame

# Takes a frame's pose, float64 [4, 4] T_world_camera, or None where it is lost.
PoseCallback = Callable[[np.ndarray | None], None]


class FramePipeline:
    """Tracks and maps frames that are sampled already; what `SlamSystem` is built on.

    Attributes:
        config: options of the run.
        camera: of all frames.
        device: where the map lives.
        first_pose: float64 [4, 4] T_world_camera of the first frame, or of the one that the map begins with.
        state: everything known between two frames.
        features: keeps image features of frames, and knows whether those of the next ones will be asked for.
        while_tracking: called in each frame while the device tracks it, for what the host has to do in any case.
        mapping_loss: float32 [] total loss of the last iteration that `optimize_map` made; None before.
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
            ValueError: the first pose has another shape, or is no rigid motion.
            DatasetError: the first pose lies too far from the world's origin.
        """
        self.config = config
        self.camera = camera
        self.device = torch.device(device)
        prior = self._prior = load_prior(config.prior.weights, config.prior.neighborhood)
        self._decoder = prior.decoder_params if config.prior.decoder == "pretrained" else None
        self._rectifier = ShutterRectifier(camera, config.dataset.max_depth_m)
        self.features = FeatureKeeper(config, camera, self._rectifier)
        tracking = config.tracking
        self._measures_timing = tracking.depth_keyframes and tracking.color and tracking.capture_timing
        confidence = PoseConfidenceModel.load()
        self.tracker = Tracker(config, camera, confidence.score_kernel_m)
        self.recovery = Recovery(config, camera, self.tracker, confidence)
        self._localizer = Localizer(self.tracker, self.recovery, self._rectifier)
        self._moving = MovingObjects(config, camera, self.tracker, self._rectifier if self._measures_timing else None)
        self.mapper = Mapper(config, camera, prior if config.prior.enabled else None)
        self.first_pose = np.eye(4)
        self.global_mapping: GlobalMapping | None = None
        self.while_tracking: Callable[[], None] | None = None
        self.reset(first_pose)

    def reset(self, first_pose: np.ndarray | None = None) -> None:
        """Forgets map and trajectory: the next frame is the first of a new map.

        Args:
            first_pose: as of `SlamSystem`; where not given, the next frame is where the first one was before.

        Raises:
            ValueError, DatasetError: as `SlamSystem`; nothing is forgotten then.
        """
        first_pose = self.first_pose if first_pose is None else np.array(first_pose, np.float64)
        check_first_pose(first_pose)
        self.first_pose = first_pose
        self.adopt(SlamState.start(self.config, self.camera, first_pose, self._decoder, self.device))

    def adopt(self, state: SlamState) -> None:
        """Goes on from a state of the same options and camera; map and trajectory as they were are forgotten."""
        self.state = state
        self.history = FrameHistory(self.state)
        self.constraints = ConstraintSource(self.config, self.camera)
        self._moving.forget()
        self.close()
        self.global_mapping = None
        if self.state.graph is not None:
            self.global_mapping = GlobalMapping(self.config, self._prior, self.state, self.state.graph)
        alike = functools.partial(FramePipeline, camera=self.camera, device=self.device)
        self._other_maps = MultiMap(self.config, self.state, self.global_mapping, self.tracker, self.recovery, alike)
        self._task: MappingTask | None = None
        self.mapping_loss: torch.Tensor | None = None

    def close(self) -> None:
        """Ends the threads; no frame can follow, unless after `reset`."""
        if self.global_mapping is not None:
            self.global_mapping.close()
            self._other_maps.close()

    @interpreter_shared()
    def submit(
        self, frame: PreparedFrame, on_pose: PoseCallback | None = None, defer_mapping: bool = False
    ) -> PendingReport:
        """Tracks and maps the next frame as `process` does, but does not wait for the optimization of the map.

        Args:
            frame: sampled.
            on_pose: as of `process`.
            defer_mapping: leave the optimization to `optimize_map`; what is left of one before is added to it, up to
                as many iterations as the first frame has.
        """
        self._other_maps.take_over(self.adopt)
        self._record = event_recorder(self.device)
        started = frame.requested if frame.requested is not None and frame.wait_ms == 0 else self._record()
        events = FrameEvents(requested=frame.requested or started, started=started, finished=started)
        number, begins_map = len(self.state.frames), not self._has_map
        loops = () if defer_mapping else self._update_globally(number)
        read, self.history.coming_s = self._receive(frame, events), frame.depth_time
        static = StaticFrame(self.features.of(read))
        if not begins_map:
            static = self._moving.without(self.state, self.history, frame, static.features)
        if self.global_mapping is not None:
            self.global_mapping.before_tracking()
        constraints = Constraints()
        if not begins_map:
            constraints = self.constraints.gather(self.history, read, frame.depth_time, frame.offsets.color)
        tracked, shutter, pixels = self._track(frame, static, constraints, number, events)
        tracked = self._moving.judged(static, tracked)
        if not begins_map:
            self._tell(on_pose, tracked, tracked.lost)
        moving = self._store(frame, pixels, constraints, tracked, static, shutter, read)
        is_mapped = self._integrate(pixels, tracked, number, events)
        if begins_map:
            self._tell(on_pose, tracked, self.state.frames.is_lost(-1))
        self.features.keep(self.state, frame, static, tracked, shutter)
        self._follow_other_maps(frame, read)
        is_keyframe = not tracked.occluded and not self.state.frames.is_lost(-1) and self.state.segment is None
        if self.global_mapping is not None and is_keyframe:
            self.global_mapping.after_frame(number, pixels, tracked.numbers)
        pose = self._pose(tracked)
        iterations, loss = self._optimize(begins_map, defer_mapping, events) if is_mapped else (0, None)
        if defer_mapping:
            loops = self._take_up_ready(number)
        events.finished = self._record()
        report = frame_report(self.state, frame, pixels, tracked, iterations, loops)
        return PendingReport(report, events, frame.wait_ms, loss, pose, moving)

    @property
    def mapping_left(self) -> int:
        """Iterations of a deferred optimization of the map that are still to be made."""
        return 0 if self._task is None else self._task.left

    def optimize_map(self, iterations: int | None = None) -> int:
        """Goes on with a deferred optimization of the map.

        Args:
            iterations: at most so many; all that is left where not given.

        Returns:
            Iterations made.
        """
        task = self._task
        if task is None:
            return 0
        count = task.left if iterations is None else min(iterations, task.left)
        if count > 0:
            self.mapping_loss = self.mapper.advance(self.state, task, count)[0]
        if task.left == 0:
            self._task = None
        return count

    def finish(self) -> None:
        """Optimizes once more if frames came after the last mapping call. Call it after the last frame."""
        self._other_maps.take_over(self.adopt)
        self.optimize_map()
        self._other_maps.end()
        if self.state.frames.is_anywhere:
            return
        iterations = self.config.mapping.iterations if self.state.unmapped else 0
        if self.global_mapping is not None and self.global_mapping.finish():
            iterations = self.config.mapping.first_iterations
        if iterations:
            self.mapper.optimize(self.state, iterations)
        self.state.unmapped = False

    def localize(
        self,
        pixels: FramePixels,
        predicted: torch.Tensor,
        number: int,
        to_be_mapped: bool = False,
        constraints: Constraints | None = None,
        features: FrameFeatures | None = None,
    ) -> TrackedFrame:
        """The pose of a frame against the map and the frames before it; changes nothing.

        Args:
            pixels: of the frame.
            predicted: float32 [7], the pose to start from.
            number: of the frame; keys its random draws.
            to_be_mapped: whether the frame is to be mapped if its pose is trusted; it is then checked for occlusion.
            constraints: beside the map's; None gathers them.
            features: of the frame as it was read, where `pixels` are as of predicted motion.
        """
        if self._has_too_little_depth(pixels):
            return TrackedFrame.untracked(predicted.clone(), lost=True)
        constraints = self.constraints.gather(self.history, pixels) if constraints is None else constraints
        problem = TrackingProblem(self.state.scene, pixels.records, predicted, number, constraints)
        features = self.features.of(pixels) if features is None else features
        return self._localizer.localize(problem, pixels, features, self.history, to_be_mapped, self.while_tracking)

    @property
    def _has_map(self) -> bool:
        return self.state.scene.volume.num_voxels > 0

    def _update_globally(self, number: int) -> tuple[LoopDecision, ...]:
        """Between two frames: adopts what the keyframe graph found; returns what it decided on loops."""
        if self.global_mapping is None or not self.global_mapping.is_due(number):
            return ()
        if self.global_mapping.adopts(number):
            self.optimize_map()
        return self._of_recording(self.global_mapping.before_frame(number))

    def _of_recording(self, decisions: Sequence[LoopDecision]) -> tuple[LoopDecision, ...]:
        """Decisions by the recording's numbers of frames: those of a map that was opened come before, negative."""
        opened = self.state.frames.opened
        return tuple(replace(each, source=each.source - opened, target=each.target - opened) for each in decisions)

    def _follow_other_maps(self, frame: PreparedFrame, pixels: FramePixels) -> None:
        if (place := self._other_maps.after_frame(frame, pixels, not self._has_too_little_depth(pixels))) is not None:
            self.optimize_map()
            self._other_maps.join(place)

    def _take_up_ready(self, number: int) -> tuple[LoopDecision, ...]:
        """`_update_globally` of a live run, after a frame: waits for nothing."""
        if self.global_mapping is None:
            return ()
        volume, loops = self.state.scene.volume, self._of_recording(self.global_mapping.take_up_ready(number))
        if self._task is not None and self.state.scene.volume is not volume:
            self._task = self.mapper.begin(self.state, self._task.left)  # it was begun for the map before
        return loops

    def _receive(self, frame: PreparedFrame, events: FrameEvents) -> FramePixels:
        if not isinstance(frame.pixels, Upload):
            return frame.pixels.to(self.device)
        events.upload = (frame.pixels.begin, frame.pixels.end)
        return frame.pixels.received()

    def _track(
        self, frame: PreparedFrame, static: StaticFrame, constraints: Constraints, number: int, events: FrameEvents
    ) -> LocalizedFrame:
        """Finds the pose, and rectifies the frame by the motion to it where that matters."""
        state, features, read = self.state, static.features, static.features.pixels
        if not self._has_map:
            first = pose_tensor(self.first_pose, self.device)
            return LocalizedFrame(TrackedFrame.untracked(first, lost=self._has_too_little_depth(read)), None, read)
        begin = self._record()
        if state.frames.is_anywhere:
            has_depth = not self._has_too_little_depth(read)
            found = LocalizedFrame(
                self._other_maps.find_camera(read, number, self.history.noise, has_depth), None, read
            )
        elif self._has_too_little_depth(read):
            predicted = self.tracker.predict(state.frames, self.history.steps)
            found = LocalizedFrame(TrackedFrame.untracked(predicted, lost=True), None, read)
        else:
            seconds = None
            if self._measures_timing:
                seconds = self._rectifier.seconds(state, self.history, frame.depth_time)
            to_be_mapped = self._is_mapping_turn(number)
            found = self._localizer.next_frame(
                state, features, self.history, constraints, seconds, to_be_mapped, self.while_tracking, static.start
            )
        events.tracking = (begin, self._record())
        return found

    def _store(
        self,
        frame: PreparedFrame,
        pixels: FramePixels,
        constraints: Constraints,
        tracked: TrackedFrame,
        static: StaticFrame,
        shutter: ops.ShutterMotion | None,
        read: FramePixels,
    ) -> torch.Tensor | None:
        """Adds the frame to the state, without the pixels of an occluded one; returns `PendingReport.moving`."""
        state, number, copies = self.state, len(self.state.frames), RowCopies()
        state.pixels.make_room()  # the one thing here that may fail: then nothing of the frame is stored
        state.frames.append(
            tracked.pose,
            frame.timestamp,
            frame.index,
            tracked.lost,
            pixels.depth_thumbnail,
            tracked.consistent_frames,
            frame.offsets,
            copies,
            None if tracked.lost else tracked.gain,
        )
        state.pixels.add(pixels.records[:0] if tracked.occluded else pixels.records, copies)
        is_known = not tracked.occluded and not tracked.lost
        if state.newest is not None and is_known:
            state.newest.replace(number, static.features.whole, shutter, copies)
        moving = self._moving.keep(state, self.history, read, static, shutter, tracked, copies)
        if state.depth_keyframes is not None and is_known:
            if constraints.depth_keyframes is not None:
                state.noise.measure(pixels, tracked.pose, constraints.depth_keyframes, tracked.gain)
            state.depth_keyframes.add(number, pixels.depth_image, pixels.intensity_image, shutter, copies)
        copies.make()
        return moving

    def _integrate(self, pixels: FramePixels, tracked: TrackedFrame, number: int, events: FrameEvents) -> bool:
        """Encodes the newest frame if it is its turn; returns whether the map is to be optimized next."""
        is_mapped = not tracked.occluded and self._is_mapping_frame(number, tracked)
        self.state.unmapped = not is_mapped
        if not is_mapped:
            return False
        begin = self._record()
        self.mapper.integrate(self.state, pixels)
        events.encode = (begin, self._record())
        if not self._has_map:
            # Depth without a surface in it: the map must begin with a later frame, and so must the trajectory.
            self.state.frames.lost[-1] = True
        return self._has_map

    def _optimize(self, begins_map: bool, deferred: bool, events: FrameEvents) -> tuple[int, torch.Tensor | None]:
        """Optimizes the map, or leaves it to `optimize_map`; returns the iterations made and the last total loss."""
        mapping = self.config.mapping
        iterations = mapping.first_iterations if begins_map else mapping.iterations
        if deferred:
            most = max(mapping.first_iterations, mapping.iterations)
            self._task = self.mapper.begin(self.state, min(iterations + self.mapping_left, most))
            return 0, None
        losses = self.mapper.optimize(self.state, iterations)
        if events.encode is not None:
            events.mapping = (events.encode[1], self._record())
        return iterations, None if losses is None else fetch(losses[0])

    def _pose(self, tracked: TrackedFrame) -> Sequence[float] | torch.Tensor | None:
        """The newest frame's pose, seven numbers, or float32 [7] on its way to the CPU; None where it is lost."""
        if self.state.frames.is_lost(-1):
            return None
        return tracked.numbers if tracked.is_on_host else fetch(self.state.frames.poses[-1])

    def _tell(self, on_pose: PoseCallback | None, tracked: TrackedFrame, lost: bool) -> None:
        if on_pose is not None:
            on_pose(None if lost else tracked.matrix.copy())

    def _has_too_little_depth(self, pixels: FramePixels) -> bool:
        """Whether too little of the image has depth to determine a pose."""
        return pixels.count == 0 or pixels.valid_depth_share < self.config.tracking.min_valid_depth_share

    def _is_mapping_turn(self, number: int) -> bool:
        return number % self.config.mapping.every == 0

    def _is_mapping_frame(self, number: int, tracked: TrackedFrame) -> bool:
        """Whether the newest frame is to be mapped: a lost one never, one soon after a lost one not yet."""
        if not self._has_map:
            return not self.state.frames.is_lost(-1)
        is_wanted = self._is_mapping_turn(number) or tracked.fit.inlier_share < MIN_MAPPED_SHARE
        return is_wanted and not self.state.frames.any_lost(SETTLED_FRAMES)
