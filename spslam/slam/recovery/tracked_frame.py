"""A frame's pose as tracking and recovery leave it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch

from spslam.geometry import pose7_to_matrix
from spslam.slam.fit import Fit, prediction_error
from spslam.slam.image_features import ImageFeatures
from spslam.slam.tracker import SurfaceEquations

SAME_CM, SAME_DEG = 1.0, 0.5  # nearer poses are one


@dataclass(frozen=True)
class TrackedFrame:
    """A frame's pose and whether it is trusted.

    Attributes:
        pose: float32 [7]; where the frame is lost, a likely pose, the last trusted or the predicted one.
        iterations: of tracking, summed over all initial poses.
        fit: of the pose found, also where it is not trusted.
        error_probability: that the pose is wrong; NaN where it was not tracked.
        lost: whether the pose is not trusted.
        occluded: whether something that is not part of the scene is in front of the camera.
        recovered: whether the pose was tracked from an initial pose that ICP or image features gave.
        relocalized: whether they found it against a stored frame that looks alike.
        consistent_frames: how many lost frames up to this one had likely poses that are consistent; `pose` is the
            last of them.
        features: of the image, where they were needed.
        equations: of the pose by surface alone; None where it was not tracked.
        gain: float32 [2] of the frame, on the device, as `FrameTable.gains`; None where it was not tracked.
        on_host: a pose, and its seven numbers, which were read with its fit; of the frame's if it is the same object.
    """

    pose: torch.Tensor
    iterations: int
    fit: Fit
    error_probability: float
    lost: bool
    occluded: bool = False
    recovered: bool = False
    relocalized: bool = False
    consistent_frames: int = 0
    features: ImageFeatures | None = None
    equations: SurfaceEquations | None = field(default=None, compare=False)
    gain: torch.Tensor | None = field(default=None, compare=False)
    on_host: tuple[torch.Tensor, tuple[float, ...]] | None = field(default=None, compare=False)

    @classmethod
    def untracked(cls, pose: torch.Tensor, lost: bool) -> "TrackedFrame":
        """A frame at a given pose, of which nothing was measured."""
        return cls(pose, 0, Fit(), math.nan, lost)

    @property
    def is_on_host(self) -> bool:
        """Whether the pose was read already, so that nothing waits for the device to know it."""
        return self.on_host is not None and self.on_host[0] is self.pose

    @cached_property
    def matrix(self) -> np.ndarray:
        """The pose float64 [4, 4]; waits for the device if it was not read already."""
        return pose7_to_matrix(np.array(self.numbers))

    @cached_property
    def numbers(self) -> Sequence[float]:
        """The pose's seven numbers; waits for the device if they were not read already."""
        return self.on_host[1] if self.on_host is not None and self.is_on_host else self.pose.tolist()

    def after(self, first: "TrackedFrame") -> "TrackedFrame":
        """This result with what was done for another one of the same frame before."""
        return replace(
            self,
            iterations=first.iterations + self.iterations,
            recovered=first.recovered or self.recovered,
            relocalized=first.relocalized or self.relocalized,
            features=first.features if self.features is None else self.features,
        )

    @property
    def weight(self) -> float:
        """Mean robust weight, 0 to 1; that of a pose of NaN is below all others."""
        weight = self.fit.mean_robust_weight
        return -math.inf if math.isnan(weight) else weight

    @property
    def agreement(self) -> float:
        """How well surface and, where colors are where depth is, image features agree with the pose: a gain of a tenth
        of either counts alike."""
        inliers = 1.0 if math.isnan(self.fit.feature_share) else self.fit.feature_inliers
        return max(self.weight, 0.0) * inliers

    def is_same(self, other: "TrackedFrame") -> bool:
        """Whether another result is the same pose up to noise; waits for the device."""
        error_cm, error_deg = prediction_error(self.pose.tolist(), other.pose.tolist())
        return error_cm < SAME_CM and error_deg < SAME_DEG
