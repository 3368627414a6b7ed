"""Initial poses for tracking from image features: they need neither a start nor the map.

Features of an earlier frame are matched with the frame's (ratio test, Lowe 2004); the pose is that of a perspective
three-point solver within RANSAC (OpenCV's `solvePnPRansac` by USAC, Raguram et al. 2013), refined on all inliers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.geometry import inverse
from spslam.slam.color_motion import ColorMotion
from spslam.slam.depth_keyframes import depth_image_intrinsics
from spslam.slam.host_threads import shared_host_threads
from spslam.slam.image_features import ImageFeatures
from spslam.slam.poses import pose_matrix, pose_tensor
from spslam.slam.recovery.feature_equations import (
    SeenPoints,
    SeenRays,
    agreeing_points,
    held_pose,
    ray_equations,
)

MAX_RATIO = 0.8  # of the distances to the best and to the second-best match
MAX_ERROR_DEG = 0.33  # of a reprojected point, as seen from the camera: 3 px of a Kinect's 640
MIN_ERROR_PX = 1.0  # which features of a small image have anyway
MIN_INLIERS = 20  # fewer may agree by chance, or lie on one small thing
# At most. More samples find more right poses where less than a quarter of the matches agree, but also more of the
# wrong ones with which some twenty matches agree: those at one edge, after a jump.
RANSAC_ITERATIONS = 100
RANSAC_CONFIDENCE = 0.999
COMPARED = 250  # of the strongest features, to find out which of many frames look alike
MIN_ALIKE = 12  # matches of these


@dataclass(frozen=True)
class FeatureMatches(SeenPoints):
    """Surface points of an earlier frame, and where the frame shows them.

    Attributes:
        points, positions, deviations: see `SeenPoints`.
        rows: int64 [M], the frame's features that they are matched with; the same one several times where they are of
            several earlier frames.
        agreeing: how many of the frame's features agree with the pose that they give.
        before: float64 [M, 2], where the earlier frame showed them; None where nobody asks.
        rays: what was matched beyond the range of depth; None where that is not kept of the earlier frame.
    """

    rows: np.ndarray
    agreeing: int = 0
    before: np.ndarray | None = None
    rays: SeenRays | None = None

    @property
    def motion_px(self) -> float:
        """By how much they moved in the image since the earlier frame, their median; 0 without any."""
        if self.before is None or not len(self):
            return 0.0
        return float(np.median(np.linalg.norm(self.positions - self.before, axis=1)))


class FeatureAlignment:
    """Poses of one frame by matching its image features with those of earlier frames.

    Args:
        features: of the frame.
        camera: of all frames.
        motion: from the frame's depth to its color image; None where they are of one moment. Poses that are taken and
            returned are those of depth.
        read: the features as they were read, where `features` are rectified.
        device: that compares descriptors, and has the poses.
        depth_noise: a^2 (m^2) and c^2 (1/m^2) of the variance of a depth z, a^2 + c^2 z^4; none where it is not known.

    Attributes:
        features: see the argument.
        read: see the argument; `features` where it is not given.
        max_error_px: farther from where the frame shows them, points do not agree with a pose.
        focal_px: focal length of the intensity image.
    """

    def __init__(
        self,
        features: ImageFeatures,
        camera: Camera,
        motion: ColorMotion | None = None,
        read: ImageFeatures | None = None,
        device: torch.device | str = "cpu",
        depth_noise: tuple[float, float] = (0.0, 0.0),
    ):
        self._device, self._depth_noise = torch.device(device), depth_noise
        self.features, self.read = features, features if read is None else read
        self._motion = motion
        k = depth_image_intrinsics(camera)
        self._matrix = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
        self._inverse_matrix = np.linalg.inv(self._matrix)
        self._intrinsics = np.array([k.fx, k.fy, k.cx, k.cy], np.float64)
        self.focal_px = k.fx
        self.max_error_px = max(k.fx * math.tan(math.radians(MAX_ERROR_DEG)), MIN_ERROR_PX)

    def matches(self, earlier: ImageFeatures, pose: torch.Tensor) -> FeatureMatches:
        """Matches with the features of an earlier frame whose color image is of a pose float32 [7]: those with depth
        among themselves, and those beyond its range among all."""
        return self.matches_with([(earlier, pose_matrix(pose))])[0]

    def matches_with(self, earlier: Sequence[tuple[ImageFeatures, np.ndarray]]) -> list[FeatureMatches]:
        """`matches` with several earlier frames, by one call of the device.

        Args:
            earlier: features of each, and the pose float64 [4, 4] of its color image.
        """
        # Of stored ones no others are kept.
        measured = [one.with_depth() if len(one.positions) else one for one, _ in earlier]
        has_rays = [one.beyond_m is not None and bool(one.beyond_m.any()) for one, _ in earlier]
        whole = [one.descriptors for (one, _), has in zip(earlier, has_rays, strict=True) if has]
        pairs = ratio_matches(self._descriptors, [*(one.descriptors for one in measured), *whole])
        beyond, found = iter(pairs[len(earlier) :]), []
        for (one, to_world), near, matched, has in zip(earlier, measured, pairs, has_rays, strict=False):
            rays = self._rays(one, to_world, next(beyond)) if has else None
            found.append(self._points(near, to_world, matched, rays))
        return found

    def _points(
        self, earlier: ImageFeatures, to_world: np.ndarray, pairs: np.ndarray, rays: SeenRays | None
    ) -> FeatureMatches:
        """Pairs of features with those of an earlier frame whose color image is of a pose float64 [4, 4]."""
        local = earlier.points[pairs[:, 1]].astype(np.float64)
        positions = self.features.positions[pairs[:, 0]].astype(np.float64)
        before, turn = (local @ self._matrix.T)[:, :2] / local[:, 2:], to_world[:3, :3].T
        z, (floor, growth) = local[:, 2:], self._depth_noise
        deviations = np.sqrt(floor + growth * z**4) * (local / z) @ turn
        points = local @ turn + to_world[:3, 3]
        return FeatureMatches(points, positions, deviations, pairs[:, 0], before=before, rays=rays)

    def _rays(self, earlier: ImageFeatures, to_world: np.ndarray, pairs: np.ndarray) -> SeenRays:
        """Those of the pairs that lie beyond the range of the earlier frame's depth."""
        ranges = earlier.beyond_m
        if ranges is None:
            raise ValueError("FeatureAlignment: the earlier frame's features must have ranges")
        row, known = pairs[ranges[pairs[:, 1]] > 0].T
        before = earlier.positions[known].astype(np.float64)
        directions = np.concatenate([before, np.ones((len(before), 1))], 1) @ self._inverse_matrix.T
        positions = self.features.positions[row].astype(np.float64)
        return SeenRays(to_world[:3, 3], directions @ to_world[:3, :3].T, positions, ranges[known].astype(np.float64))

    def poses(self, several: Sequence[FeatureMatches]) -> list[torch.Tensor | None]:
        """`pose` of several matches, each by itself; on the host's threads beside a GPU."""
        device, threads = self._device, shared_host_threads(self._device)
        if threads is None or len(several) < 2:
            return [self.pose(one, device) for one in several]
        return list(threads.map(self.pose, several, [device] * len(several)))

    def pose(self, matches: FeatureMatches, device: torch.device) -> torch.Tensor | None:
        """Pose float32 [7] of the frame; None where fewer than `MIN_INLIERS` matches agree on one."""
        if len(matches) < MIN_INLIERS:
            return None
        matrix = self._matrix.copy()  # which this function may write to
        is_found, _, rotation, translation, inliers = cv2.solvePnPRansac(
            matches.points, matches.positions, matrix, None, params=self._ransac
        )
        if not is_found or inliers is None:
            return None
        rows = inliers[:, 0]
        if _count_distinct(matches.rows[rows]) < MIN_INLIERS:
            return None
        rotation, translation = cv2.solvePnPRefineLM(
            matches.points[rows], matches.positions[rows], self._matrix, None, rotation, translation
        )
        to_camera = np.eye(4)
        to_camera[:3, :3], to_camera[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        if not np.isfinite(to_camera).all():
            return None
        found = inverse(to_camera)
        return pose_tensor(found if self._motion is None else self._motion.depth_pose(found), device)

    def counted(self, matches: FeatureMatches, color_pose: np.ndarray) -> FeatureMatches:
        """The matches, with how many agree with the pose that they give, see `color_pose`."""
        return replace(matches, agreeing=self.inliers(matches, color_pose))

    def held(
        self,
        pose: Sequence[float],
        information: np.ndarray,
        matches: Sequence[FeatureMatches],
        late_px: float = 0.0,
    ) -> np.ndarray | None:
        """The pose that surface and image features agree on best; None where fewer than `MIN_INLIERS` agree.

        Gauss-Newton on reprojection errors with Geman-McClure's weights, beside the equations of surface. What was seen
        beyond the range of depth takes part too: it tells how the camera has turned.

        Args:
            pose: seven numbers, where surface has put the camera.
            information: float64 [6, 6] of that pose, see `SurfaceEquations`.
            matches: with earlier frames.
            late_px: by how much the features may be off, where that is more than `max_error_px`.

        Returns:
            float32 [7].
        """
        held = held_pose(
            self._intrinsics,
            _joined(matches),
            [one.rays for one in matches if one.rays is not None and len(one.rays)],
            self._motion,
            np.array(pose, np.float64),
            information,
            max(self.max_error_px, late_px),
            MIN_INLIERS,
        )
        return None if held is None else held.astype(np.float32)

    def color_pose(self, pose: torch.Tensor) -> np.ndarray:
        """Pose float64 [4, 4] of the frame's color image, of a pose float32 [7]; waits for the device."""
        return self.of_color(pose_matrix(pose))

    def of_color(self, pose: np.ndarray) -> np.ndarray:
        """The same of a pose float64 [4, 4]."""
        return pose if self._motion is None else self._motion.color_pose(pose)

    def inliers(self, matches: FeatureMatches, color_pose: np.ndarray, late_px: float = 0.0) -> int:
        """How many of the frame's features agree with a pose: a point that one is matched with reprojects to within
        `max_error_px`, and what the noise of its depth may add along its epipolar line.

        Args:
            matches: with earlier frames; a feature that several of them have counts once.
            color_pose: of this frame, see `color_pose`.
            late_px: or to within so much, which the image may have moved since depth was measured.
        """
        agrees = agreeing_points(self._intrinsics, matches, color_pose, max(self.max_error_px, late_px))
        return _count_distinct(matches.rows[agrees])

    def ray_inliers(self, matches: FeatureMatches, color_pose: np.ndarray) -> int:
        """How many rays agree with a pose, see `inliers`: reprojected, what lies on them beyond the range of depth may
        be within `max_error_px` of where the frame shows it."""
        if matches.rays is None or not len(matches.rays):
            return 0
        return ray_equations(self._intrinsics, matches.rays, color_pose, self.max_error_px)[0]

    def likeness(self, earlier: ImageFeatures) -> int:
        """How many of the strongest features match; 0 below `MIN_ALIKE`."""
        count = len(ratio_matches(self._descriptors[:COMPARED], [earlier.descriptors[:COMPARED]])[0])
        return count if count >= MIN_ALIKE else 0

    @cached_property
    def _ransac(self) -> cv2.UsacParams:
        """Counts of inliers, without local optimization: the pose is refined on them afterwards."""
        params = cv2.UsacParams()
        params.score, params.loMethod = cv2.SCORE_METHOD_RANSAC, cv2.LOCAL_OPTIM_NULL
        params.threshold, params.confidence = self.max_error_px, RANSAC_CONFIDENCE
        params.maxIterations = RANSAC_ITERATIONS
        return params

    @cached_property
    def _descriptors(self) -> torch.Tensor:
        return _tensor(self.features.descriptors).to(self._device)


def joined_too(matches: Sequence[FeatureMatches]) -> list[FeatureMatches]:
    """Matches with several earlier frames, and all of them as one: each may have too few to give a pose."""
    some = [one for one in matches if len(one)]
    if len(some) < 2:
        return list(matches)
    return [*matches, _joined(some)]


def _joined(matches: Sequence[FeatureMatches]) -> FeatureMatches:
    """All points of several matches."""
    points, positions, deviations = (
        np.concatenate([np.zeros((0, columns)), *(getattr(one, name) for one in matches)])
        for name, columns in (("points", 3), ("positions", 2), ("deviations", 3))
    )
    rows = np.concatenate([np.zeros(0, np.int64), *(one.rows for one in matches)])
    return FeatureMatches(points, positions, deviations, rows)


def _count_distinct(rows: np.ndarray) -> int:
    """How many different ones there are among rows int64 [N] of a frame's features, hundreds."""
    return int(np.count_nonzero(np.bincount(rows)))


def ratio_matches(descriptors: torch.Tensor, earlier: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Rows of descriptors uint8 [N, 32] that match plainly better than any others in groups of [M, 32]: int64 [K, 2]
    for each group.

    The descriptors' device compares them, and is waited for.
    """
    none = np.zeros((0, 2), np.int64)
    compared = [i for i, group in enumerate(earlier) if len(group) > 1] if len(descriptors) else []
    matches = [none] * len(earlier)
    for first in range(0, len(compared), ops.trusted.DESCRIPTOR_GROUPS):
        numbers = compared[first : first + ops.trusted.DESCRIPTOR_GROUPS]
        others = _tensor(np.concatenate([earlier[i] for i in numbers])).to(descriptors.device)
        found = ops.trusted.nearest_in_groups(descriptors, others, [len(earlier[i]) for i in numbers]).cpu().numpy()
        distances = found[1].view(np.int32).reshape(len(numbers), -1, 2)
        is_match = distances[..., 0] < MAX_RATIO * distances[..., 1]
        for i, nearest, matched in zip(numbers, found[0], is_match, strict=True):
            rows = np.flatnonzero(matched)
            matches[i] = np.stack([rows, nearest[rows]], 1)
    return matches


def _tensor(descriptors: np.ndarray) -> torch.Tensor:
    """The same memory, or a copy of what may not be written to, as in a file that is mapped."""
    return torch.from_numpy(np.require(descriptors, requirements=["C", "W"]))
