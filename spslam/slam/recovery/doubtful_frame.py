"""What is known of a frame whose pose is in doubt."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spslam.datasets.clock import LATE_S
from spslam.slam.fit import Fit
from spslam.slam.frame_history import FrameHistory
from spslam.slam.pixels import FramePixels
from spslam.slam.recovery.feature_alignment import FeatureAlignment, FeatureMatches
from spslam.slam.recovery.icp_alignment import IcpAlignment
from spslam.slam.recovery.sliding import WEAK_EIGENVALUE
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.tracker import TrackingProblem

REGISTERED_PX = 0.5  # measured errors of where colors are; with larger ones features say where colors are, not depth
# Of the features that agree with the earlier frame seen best: those of a frame that shares fewer contradict no pose, as
# where the camera has turned away from it they lie at the edge of both images.
FEW_FEATURES = 0.3
MIN_DECIDING = 60  # features, or matches with an earlier frame: fewer decide nothing
MIN_AGREEING = 0.25  # of such matches; a pose with which fewer agree has slid away from where they are
MORE_ALIKE = 0.1  # by so much brightness correlates better with a pose that decides against features
MAX_TURN_DEG_S = 300.0  # of a camera; what moves faster in the image has jumped


@dataclass(frozen=True)
class DoubtfulFrame:
    """What other poses of a frame are found and verified by.

    Attributes:
        problem: the frame, as tracking takes it.
        pixels: of the frame.
        history: the frames before.
        alignment: by ICP.
        image: by image features; None where these are not used.
        matches: of the image's features with those of earlier frames.
        late_px: by how much its colors may be off where it moves, see `compared`.
        near: all matches with the last frame and with the stored ones before it.
    """

    problem: TrackingProblem
    pixels: FramePixels
    history: FrameHistory
    alignment: IcpAlignment
    image: FeatureAlignment | None = None
    matches: tuple[FeatureMatches, ...] = ()
    late_px: float = 0.0
    near: tuple[FeatureMatches, ...] = ()

    def compared(self, row: int, anchors: Sequence[int]) -> "DoubtfulFrame":
        """The frame with its matches with the last frame, in a row, and with stored ones; its speed by the former."""
        near = self._matched([row, *anchors])
        last = [near[row]] if row in near else []
        return replace(self.with_speed(row, last), near=tuple(near.values()))

    def matched(self, rows: Sequence[int]) -> list[FeatureMatches]:
        """Matches with the features of the earlier frames in rows that have some."""
        return list(self._matched(rows).values())

    def _matched(self, rows: Sequence[int]) -> dict[int, FeatureMatches]:
        if self.image is None:
            return {}
        known = {row: features for row in rows if (features := self.history.features(row)) is not None}
        if not known:
            return {}
        poses = self.history.color_poses(list(known), is_timed=self.problem.constraints.timing is not None)
        return dict(zip(known, self.image.matches_with(list(zip(known.values(), poses, strict=True))), strict=True))

    def with_speed(self, row: int, matches: Sequence[FeatureMatches]) -> "DoubtfulFrame":
        """The frame, with how far its image moves in `LATE_S` by the first of its matches, which are with `row`."""
        if self.image is None or not matches:
            return self
        speed_px = matches[0].motion_px / self.history.seconds_since(row)
        is_turn = speed_px < self.image.focal_px * math.radians(MAX_TURN_DEG_S)
        return replace(self, late_px=LATE_S * speed_px if is_turn else 0.0)

    def with_features(self, fit: Fit, pose: np.ndarray) -> Fit:
        """The fit of a pose float64 [4, 4] with what the matches say of it; the fit where there are no image
        features."""
        if self.image is None:
            return fit
        at = self.image.of_color(pose)
        inliers = [self.image.inliers(one, at) for one in self.matches]
        shares: list[float] = []
        if self.colors_are_registered:
            most = max((one.agreeing for one in self.matches), default=0)
            telling = [one for one in self.matches if one.agreeing > FEW_FEATURES * most]
            if telling and fit.min_eigenvalue >= WEAK_EIGENVALUE:
                # Surface leaves nothing free to slide along: where others contradict, their own poses are off.
                telling = [max(telling, key=lambda one: one.agreeing)]
            within = [self.image.inliers(one, at, self.late_px) for one in telling]
            shares = [min(n / one.agreeing, 1.0) for n, one in zip(within, telling, strict=True)]
        return fit.having(
            feature_inliers=max(inliers, default=0),
            feature_share=min(shares, default=math.nan),
            feature_rays=max((self.image.ray_inliers(one, at) for one in self.matches), default=0),
        )

    @property
    def is_contradicted(self) -> bool:
        """Whether earlier frames have many matches, and with the pose that these were counted at agree only a few."""
        telling = [one for one in self.matches if len(one) >= MIN_DECIDING]
        return (
            self.colors_are_registered
            and len(telling) > 0
            and all(one.agreeing < MIN_AGREEING * len(one) for one in telling)
        )

    @property
    def colors_are_registered(self) -> bool:
        """Whether colors are where depth is, as far as was measured: neither late nor of another lens."""
        return self.problem.constraints.noise_numbers[3] <= REGISTERED_PX**2


def preferred_by_features(found: TrackedFrame, others: Sequence[TrackedFrame], times: float = 1.0) -> TrackedFrame:
    """The likeliest result, or a trusted one with which surface and image features agree that many times more.

    On a young map, or far away, one that has slid along a wall fits as well; one that stopped half-way may be nearer to
    the prediction. So many more features than agree by chance: in a plain corridor as many agree 14 cm farther on.
    """
    known = [other for other in others if not other.lost and not math.isnan(other.fit.feature_share)]
    seen = [other for other in known if other.fit.feature_inliers >= MIN_DECIDING]
    best = max(seen, key=lambda other: other.agreement, default=found)
    count = found.fit.feature_inliers
    by_chance = 1 + 1 / math.sqrt(count) if count > 0 else 1.0
    return best if best.agreement > max(times, by_chance) * found.agreement else found


def preferred_by_brightness(found: TrackedFrame, others: Sequence[TrackedFrame]) -> TrackedFrame:
    """The likeliest result, or a trusted one that fits surface better, and earlier images' brightness by far.

    Features of the last frames may be of a part of the map that is off by some centimeters, as after the camera was
    found again: all of them then agree with a pose that neither surface nor brightness is for.
    """
    alike = found.fit.brightness_correlation + MORE_ALIKE
    better = [other for other in others if not other.lost and other.weight > found.weight]
    brighter = [other for other in better if other.fit.brightness_correlation > alike]
    return max(brighter, key=lambda other: other.fit.brightness_correlation, default=found)
