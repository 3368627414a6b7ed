"""Decides whether a tracked pose is trusted, and looks for a better one where it is not."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.geometry import pose7_to_matrix
from spslam.slam.frame_history import FrameHistory
from spslam.slam.image_features import FrameFeatures
from spslam.slam.pixels import FramePixels
from spslam.slam.recovery.doubtful_frame import (
    MIN_DECIDING,
    DoubtfulFrame,
    preferred_by_brightness,
    preferred_by_features,
)
from spslam.slam.recovery.feature_alignment import FeatureAlignment, FeatureMatches, joined_too
from spslam.slam.recovery.icp_alignment import IcpAlignment
from spslam.slam.recovery.place_recognition import retrieve, retrieve_by_features
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.pose_judge import PoseJudge
from spslam.slam.recovery.sliding import WEAK_EIGENVALUE, is_consistent, may_have_slid
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.recovery.verifier import Verifier
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.tracker import PoseEstimate, Tracker, TrackingProblem

CONSISTENT_FRAMES = 4  # lost frames in a row whose likely poses are consistent are found
LIKELY_ERROR_PROBABILITY = 0.1  # of each of them at most
OCCLUSION_CHECK_WEIGHT = 0.7  # a frame to be mapped with a smaller mean robust weight may be occluded
ANCHORS = 2  # stored frames that hold a pose beside the last one
SHORT_LOSS = 5  # lost frames in a row after which the camera is still near its last trusted pose
MIN_GAIN = 0.02  # of mean robust weight, or that share of agreement, for another result than the first
MAX_LOSS = 0.2  # of mean robust weight, of a pose that may still be the right one; the better fit may be a place alike
MAX_FEATURE_NOISE = 0.1  # of mean robust weight, that noise of image features takes from the right pose
MAX_VERIFIED = 4  # poses of a frame
MORE_AGREEING = 1.2  # times as much agreement decides for a pose that image features alone give


class Recovery:
    """Decides whether a pose estimate is trusted. Only a doubtful one is verified and tracked again.

    Args:
        config: options of the run.
        camera: of all frames.
        tracker: optimizes the pose from other initial poses.
        confidence: computes the probability that a pose is wrong.
    """

    def __init__(self, config: Config, camera: Camera, tracker: Tracker, confidence: PoseConfidenceModel):
        self._config, self._camera, self._tracker, self._confidence = config, camera, tracker, confidence
        self._judge = PoseJudge(config, confidence)
        self._verifier = Verifier(config, camera, confidence)
        self._rectifier = ShutterRectifier(camera, config.dataset.max_depth_m)

    def judge(self, estimate: PoseEstimate, history: FrameHistory | None = None) -> TrackedFrame:
        """The estimate, trusted or not by its fit alone; see `PoseJudge`."""
        return self._judge.judge(estimate, history)

    def settled(self, estimate: PoseEstimate, history: FrameHistory, to_be_mapped: bool) -> TrackedFrame | None:
        """What `resolve` finds where the estimate's fit decides; None where more has to be asked.

        Args:
            estimate: the tracker's result.
            history: the frames before.
            to_be_mapped: whether the frame is to be mapped if its pose is trusted.
        """
        tracked = self.judge(estimate, history)
        is_questioned = self._is_in_doubt(tracked, history) or self._may_have_slid(tracked, history)
        return None if is_questioned or (to_be_mapped and _may_be_occluded(tracked)) else tracked

    def resolve(
        self,
        problem: TrackingProblem,
        estimate: PoseEstimate,
        pixels: FramePixels,
        history: FrameHistory,
        to_be_mapped: bool,
        features: FrameFeatures,
    ) -> TrackedFrame:
        """The frame's best pose: the estimate or, if it is doubtful, the best one from other initial poses.

        Args:
            problem: the frame.
            estimate: the tracker's result.
            pixels: of the frame.
            history: the frames before.
            to_be_mapped: whether the frame is to be mapped if its pose is trusted.
            features: of the frame as it was read.
        """
        tracked = self.judge(estimate, history)
        if self._is_in_doubt(tracked, history):
            tracked = self._recover(problem, tracked, pixels, history, self._image(problem, history, features))
        else:
            if self._may_have_slid(tracked, history):
                tracked = self._held(problem, tracked, pixels, history, features)
            if to_be_mapped and _may_be_occluded(tracked):
                tracked = self._check_occlusion(problem, tracked, pixels, history)
        if not tracked.lost or tracked.consistent_frames:
            return tracked
        # A pose predicted from lost frames is not trusted: continue from the last trusted pose.
        known = history.last() if history.consistent_frames else None
        return replace(tracked, pose=(problem.predicted if known is None else known.pose).clone())

    def _is_in_doubt(self, tracked: TrackedFrame, history: FrameHistory) -> bool:
        return history.is_lost or self._is_unpredicted(history) or self._is_doubtful(tracked)

    def _is_unpredicted(self, history: FrameHistory) -> bool:
        """Whether nothing says how far the camera has moved; a pose that slid from the last one fits a young map."""
        return self._config.tracking.recovery and not history.knows_speed

    def _is_doubtful(self, tracked: TrackedFrame) -> bool:
        tracking = self._config.tracking
        return (
            tracked.lost
            or tracked.error_probability > tracking.verify_threshold
            or tracked.fit.mean_robust_weight < tracking.recovery_min_robust_weight
        )

    def _may_have_slid(self, tracked: TrackedFrame, history: FrameHistory) -> bool:
        """Whether image features are used, and asked of this pose."""
        tracking = self._config.tracking
        return tracking.features and tracking.recovery and may_have_slid(tracked.fit, history)

    def _held(
        self,
        problem: TrackingProblem,
        tracked: TrackedFrame,
        pixels: FramePixels,
        history: FrameHistory,
        features: FrameFeatures,
    ) -> TrackedFrame:
        """The pose held by image features in directions that surface leaves free, where there are enough of them."""
        row, image = history.last_row(), self._image(problem, history, features)
        if row is None or image is None or tracked.equations is None:
            return tracked
        frame = DoubtfulFrame(problem, pixels, history, IcpAlignment(pixels, self._camera), image)
        held, has_matches = self._hold(frame.compared(row, self._anchors(history, row)), tracked)
        if held is not None and not held.lost:
            return held
        if not has_matches:
            return replace(tracked, features=image.read)
        return self._recover(problem, tracked, pixels, history, image)  # it has slid too far to be held

    def _hold(self, frame: DoubtfulFrame, tracked: TrackedFrame) -> tuple[TrackedFrame | None, bool]:
        """The frame at the pose that surface and image features agree on; None where they don't, and whether there are
        enough matches with the frames near it to say so."""
        image = frame.image
        if image is None or tracked.equations is None:
            return None, False
        matches = frame.near
        numbers = image.held(tracked.numbers, tracked.equations.information, matches, frame.late_px)
        if numbers is None:
            return None, sum(map(len, matches)) >= MIN_DECIDING
        pose = torch.from_numpy(numbers).to(tracked.pose.device)
        estimate = self._tracker.measure(frame.problem, pose)
        matrix = pose7_to_matrix(numbers.astype(np.float64))
        at = image.of_color(matrix)
        frame = replace(frame, matches=tuple(image.counted(one, at) for one in matches))
        fit, on_host = frame.with_features(estimate.fit, matrix), (pose, tuple(numbers.tolist()))
        held = replace(tracked, pose=pose, fit=fit, features=image.read, on_host=on_host)
        held = self._judge.judged(held, frame.history)
        fits = held.weight > tracked.weight - MAX_LOSS and not frame.is_contradicted
        return held if fits else None, True

    def _check_occlusion(
        self, problem: TrackingProblem, tracked: TrackedFrame, pixels: FramePixels, history: FrameHistory
    ) -> TrackedFrame:
        fit = self._verifier.verified(
            tracked.fit, tracked.pose, problem.scene, pixels, history, compares_brightness=False
        )
        return self._judge.judged(replace(tracked, fit=fit), history)

    def _verify(self, frame: DoubtfulFrame, tracked: TrackedFrame) -> TrackedFrame:
        """The pose judged with what other frames have seen: surface, brightness and image features."""
        scene = frame.problem.scene
        fit = self._verifier.verified(tracked.fit, tracked.pose, scene, frame.pixels, frame.history)
        return self._judge.judged(replace(tracked, fit=frame.with_features(fit, tracked.matrix)), frame.history)

    def _recover(
        self,
        problem: TrackingProblem,
        first: TrackedFrame,
        pixels: FramePixels,
        history: FrameHistory,
        image: FeatureAlignment | None,
    ) -> TrackedFrame:
        """The best result from the prediction and the last trusted frame; if that is lost, also from similar frames.

        Args:
            problem: the frame.
            first: the result from the prediction.
            pixels: of the frame.
            history: the frames before.
            image: its image features; None where these are not used.
        """
        frame = DoubtfulFrame(problem, pixels, history, IcpAlignment(pixels, self._camera), image)
        frame, starts = self._starts_at_last(frame, first)
        candidates, iterations = self._track_from(frame, first, starts), 0
        seen = self._seen(frame, starts)
        # After lost frames with consistent poses, the prediction does not come from the last trusted pose.
        found = None
        if history.consecutive_lost_frames <= SHORT_LOSS and not history.consistent_frames:
            found = self._likeliest(frame, candidates, seen=seen)
            if found.lost and problem.constraints.reference is not None:
                # Late colors may be what led tracking astray; these starts need no help of a coarse image.
                constraints = replace(problem.constraints, reference=None)
                frame = replace(frame, problem=replace(problem, constraints=constraints))
                iterations = sum(candidate.iterations for candidate in candidates[1:])
                candidates = self._track_from(frame, first, starts)
                found = self._likeliest(frame, candidates, seen=seen)
        if found is None or found.lost or self._confidence.has_jumped(found.fit):
            found = self._relocalize(frame, candidates)
        elif self._may_have_slid(found, history):
            # Tracked on from where features had put it, it may have slid along what surface leaves free.
            held, _ = self._hold(frame, found)
            held = None if held is None else self._verify(frame, held)
            found = found if held is None or held.lost else held
        iterations += sum(candidate.iterations for candidate in candidates)
        return replace(found, iterations=iterations, features=frame.image.read if frame.image else None)

    def _image(
        self, problem: TrackingProblem, history: FrameHistory, features: FrameFeatures
    ) -> FeatureAlignment | None:
        """The frame's image features, as of its motion; None where they are not used."""
        tracking = self._config.tracking
        if not (tracking.features and tracking.recovery):
            return None
        read = rectified = features.extracted
        if problem.constraints.shutter is not None:
            rectified = self._rectifier.features(read, problem.constraints.shutter)
        timing = problem.constraints.timing
        motion = None if timing is None else history.color_motion(timing.frame)
        floor, growth = problem.constraints.noise_numbers[:2]
        return FeatureAlignment(rectified, self._camera, motion, read, problem.predicted.device, (floor, growth))

    def _starts_at_last(self, frame: DoubtfulFrame, first: TrackedFrame) -> tuple[DoubtfulFrame, list[torch.Tensor]]:
        """Poses against the last trusted frame: by image features, by ICP from the predicted pose and from its own."""
        tracking, history = self._config.tracking, frame.history
        wanted = tracking.recovery and (tracking.optimizer == "gauss_newton" or first.lost)
        row = history.last_row() if wanted else None
        if row is None:
            return frame, []
        last = history.frame(row)
        frame = frame.compared(row, self._anchors(history, row))
        frame, by_features = self._match(frame, frame.near)
        from_poses = (*by_features, frame.problem.predicted, last.pose)
        return frame, [*by_features, *frame.alignment.poses([(last, start) for start in from_poses])]

    def _anchors(self, history: FrameHistory, row: int) -> list[int]:
        """Rows of the newest stored frames with image features before `row`: from frame to frame a pose may slide."""
        return [known for known in history.feature_rows() if known < row - 1][-ANCHORS:]

    def _match(self, frame: DoubtfulFrame, found: Sequence[FeatureMatches]) -> tuple[DoubtfulFrame, list[torch.Tensor]]:
        """The frame with those of the matches found that agree on a pose, and these poses."""
        if frame.image is None:
            return frame, []
        matches, starts = list(frame.matches), []
        several = joined_too(found)
        for matched, start in zip(several, frame.image.poses(several), strict=True):
            if start is not None:
                matches.append(frame.image.counted(matched, frame.image.color_pose(start)))
                starts.append(start)
        return replace(frame, matches=tuple(matches)), starts

    def _track_from(self, frame: DoubtfulFrame, first: TrackedFrame, starts: list[torch.Tensor]) -> list[TrackedFrame]:
        """A result, and those from other starts."""
        others = [self.judge(self._tracker.track_from(frame.problem, start), frame.history) for start in starts]
        return [first, *(replace(other, recovered=True) for other in others)]

    def _seen(self, frame: DoubtfulFrame, starts: list[torch.Tensor]) -> TrackedFrame | None:
        """The pose that image features alone give, the first starts, with that earlier frame with which most agree."""
        if not frame.matches or not frame.colors_are_registered:
            return None
        most = max(range(len(frame.matches)), key=lambda i: frame.matches[i].agreeing)
        estimate = self._tracker.measure(frame.problem, starts[most])
        return replace(self.judge(estimate, frame.history), recovered=True)

    def _likeliest(
        self,
        frame: DoubtfulFrame,
        candidates: list[TrackedFrame],
        anywhere: bool = False,
        seen: TrackedFrame | None = None,
    ) -> TrackedFrame:
        """The candidate of the smallest error probability when verified; only the best fits of distinct poses are.

        Args:
            frame: the frame.
            candidates: the first is taken among equals.
            anywhere: whether the camera may be anywhere, so that the predicted pose says nothing.
            seen: the pose of image features alone; as noise moves it by centimeters, it counts only where far more
                features agree with it than with the likeliest, and a trusted one fits surface hardly better.
        """
        candidates = [replace(one, fit=frame.with_features(one.fit, one.matrix)) for one in candidates]
        distinct: list[TrackedFrame] = []
        kept: list[int] = []  # their numbers
        weights = [candidate.weight + MIN_GAIN * (i == 0) for i, candidate in enumerate(candidates)]
        for i in sorted(range(len(candidates)), key=lambda i: -weights[i]):
            if distinct and weights[i] < distinct[0].weight - MAX_LOSS:
                break
            same = next((k for k, other in enumerate(distinct) if candidates[i].is_same(other)), None)
            if same is None:
                distinct.append(candidates[i])
                kept.append(i)
            elif self._favored(candidates, i) > self._favored(candidates, kept[same]):
                distinct[same], kept[same] = candidates[i], i
        verified = [self._verify(frame, candidate) for candidate in distinct[:MAX_VERIFIED]]
        found = min(verified, key=lambda tracked: self._rank(tracked, anywhere))
        if anywhere:
            return found
        found = preferred_by_features(found, verified)
        if seen is not None and (found.lost or seen.weight > found.weight - MAX_FEATURE_NOISE):
            found = preferred_by_features(found, [self._verify(frame, seen)], MORE_AGREEING)
        return preferred_by_brightness(found, verified)

    @staticmethod
    def _favored(candidates: Sequence[TrackedFrame], i: int) -> float:
        return candidates[i].agreement * (1 + MIN_GAIN * (i == 0))

    def _rank(self, tracked: TrackedFrame, anywhere: bool) -> float:
        fit = tracked.fit.unpredicted() if anywhere else tracked.fit
        probability = self._confidence.error_probability(fit, compares=True)
        return math.inf if math.isnan(probability) else probability

    def _relocalize(self, frame: DoubtfulFrame, candidates: list[TrackedFrame]) -> TrackedFrame:
        """The likeliest of given results and those from stored frames that look alike, if it is certain enough.

        The results from stored frames are appended to `candidates`.
        """
        history, count, known = frame.history, self._config.tracking.relocalization_candidates, len(candidates)
        alike = retrieve(history, frame.pixels, count, self._camera)
        starts = frame.alignment.poses([(candidate.earlier, candidate.start) for candidate in alike])
        if frame.image is not None and count:
            rows = retrieve_by_features(history, frame.image, frame.problem.frame)
            frame, by_features = self._match(frame, frame.matched(rows))
            starts = [*by_features, *starts]
        candidates += self._track_from(frame, candidates[0], starts)[1:]
        found = self._likeliest(frame, candidates, anywhere=True)
        is_new = not any(found.pose is candidate.pose for candidate in candidates[:known])
        # Stored frames may confirm, where the last one shows too little, that the camera is where it was predicted.
        is_followed = not history.is_lost and not found.lost and is_consistent(found.fit)
        if not is_followed:
            found = self._accept_anywhere(found, history.consistent_frames, frame.colors_are_registered)
        return replace(found, relocalized=is_new and not found.lost)

    def _accept_anywhere(
        self, tracked: TrackedFrame, consistent_before: int, colors_are_registered: bool
    ) -> TrackedFrame:
        """The result, accepted by stricter thresholds, as the camera may be anywhere and some places look alike.

        The error probability is computed without the prediction error. It must be at most
        `tracking.relocalization_threshold`, or at most `LIKELY_ERROR_PROBABILITY` in `CONSISTENT_FRAMES` consecutive
        frames with consistent poses. Where surface leaves a direction free, poses that slide are consistent too: there
        only the former counts, and many image features must agree. Where colors are where depth is, surface whose
        brightness was another one in earlier images is elsewhere.
        """
        was_near = is_consistent(tracked.fit)
        fit = tracked.fit.unpredicted()
        tracked = self._judge.judged(replace(tracked, fit=fit))
        if colors_are_registered and self._confidence.looks_elsewhere(fit):
            return replace(tracked, lost=True, consistent_frames=0)
        is_firm = fit.min_eigenvalue >= WEAK_EIGENVALUE
        is_certain = tracked.error_probability <= self._config.tracking.relocalization_threshold
        if is_certain and not tracked.lost and (is_firm or self._confidence.has_many_features(fit)):
            return replace(tracked, consistent_frames=0)
        is_likely = tracked.error_probability <= LIKELY_ERROR_PROBABILITY and is_firm
        frames = int(is_likely and not tracked.lost) * (1 + consistent_before * int(was_near))
        if frames >= CONSISTENT_FRAMES:
            return replace(tracked, lost=False, consistent_frames=0)
        return replace(tracked, lost=True, consistent_frames=frames)


def _may_be_occluded(tracked: TrackedFrame) -> bool:
    """Whether that is to be checked before the frame is mapped: it fits badly, and nobody has looked yet."""
    return math.isnan(tracked.fit.occluded_share) and tracked.fit.mean_robust_weight < OCCLUSION_CHECK_WEIGHT
