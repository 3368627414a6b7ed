"""Finds loops: keyframes far apart in time, and perhaps in the map, that show the same place.

A loop is proposed by image features, its pose is found by RANSAC on them and then by registration, and it must stand
against depth (`through`, `on_surface`), brightness (`correlation`), what drift is likely over the path between, and a
second loop nearby that moves the camera the same way. What the graph thinks of it is asked afterwards.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spslam.geometry import compose, inverse, rotation_angle
from spslam.slam.graph.edges import GraphEdge, LoopDecision
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.registration import Registrar, Registration
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.feature_alignment import FeatureAlignment

COMPARED = 48  # keyframes, the nearest ones, whose features are compared with a keyframe's
TRIED = 2  # of these, the most alike
MIN_AGE = 10  # keyframes between the two of a loop
MIN_INLIERS = 30  # matches that agree on the pose
VIEW_M = 3.0  # from farther off than this, images are rarely alike
DRIFT_M, DRIFT_SHARE = 0.3, 0.02  # of the path between: more is no drift but another place
DRIFT_RAD, DRIFT_RAD_PER_M = 0.1, 0.01
MEMORY = 10  # keyframes that a loop waits for a second one
AGREE_M, AGREE_RAD = 0.15, 0.05  # to which two loops move the camera the same way


@dataclass(frozen=True)
class Proposal:
    """A loop that waits for a second one.

    Attributes:
        edge: that it would become.
        correction: float64 [4, 4] by which it would move the source in the world.
    """

    edge: GraphEdge
    correction: np.ndarray


class LoopFinder:
    """Finds loops of new keyframes to earlier ones.

    Args:
        registrar: of the keyframes.
    """

    def __init__(self, registrar: Registrar):
        self._registrar = registrar

    def find(
        self,
        keyframes: Sequence[Keyframe],
        known: Mapping[int, set[int]],
        poses: np.ndarray,
        lengths: np.ndarray,
        waiting: list[Proposal],
    ) -> tuple[list[GraphEdge], list[LoopDecision]]:
        """Loops from some keyframes to earlier ones, and those that these confirm.

        Args:
            keyframes: K of the graph.
            known: by number of a keyframe to find loops from, in ascending order, the numbers that it has an edge to.
            poses: float64 [K, 4, 4].
            lengths: float64 [K] of the path up to each, m.
            waiting: proposals of keyframes before, which is kept up to date.
        """
        edges: list[GraphEdge] = []
        decisions: list[LoopDecision] = []
        if not self._registrar.features:
            return edges, decisions
        candidates = self._candidates(keyframes, known, poses, lengths)
        registered = self._registered(keyframes, candidates)
        for (one, other), found in zip(candidates, registered, strict=True):
            waiting[:] = [each for each in waiting if each.edge.source > one - MEMORY]
            proposal, reason = (None, found) if isinstance(found, str) else _judge(one, other, found, poses, lengths)
            moved = 0.0 if proposal is None else _shift(proposal.correction, poses[one])
            if proposal is not None:
                agreeing = [each for each in waiting if each.edge.source != one and _agree(each, proposal, poses)]
                if agreeing:
                    edges += [proposal.edge, *(each.edge for each in agreeing)]
                    for each in agreeing:
                        waiting.remove(each)
                        source, target = (keyframes[end].frame for end in (each.edge.source, each.edge.target))
                        shift = _shift(each.correction, poses[each.edge.source])
                        decisions.append(LoopDecision(source, target, True, "confirmed by a second one", shift))
                else:
                    waiting.append(proposal)
                    proposal, reason = None, "waits for a second one"
            names = keyframes[one].frame, keyframes[other].frame
            decisions.append(LoopDecision(*names, proposal is not None, reason, moved))
        waiting[:] = [each for each in waiting if each.edge.source > max(known, default=0) - MEMORY]
        return edges, decisions

    def _candidates(
        self, keyframes: Sequence[Keyframe], known: Mapping[int, set[int]], poses: np.ndarray, lengths: np.ndarray
    ) -> list[tuple[int, int]]:
        """Pairs of a new keyframe and an earlier one, within reach of drift, whose features are most alike."""
        compared = {one: _within_reach(one, known[one], poses, lengths)[:COMPARED] for one in known}
        used = dict.fromkeys(row for one in known if compared[one] for row in (one, *compared[one]))
        self._registrar.each(lambda row: keyframes[row].features, used)

        def most_alike(one: int) -> list[tuple[int, int]]:
            image = FeatureAlignment(keyframes[one].features, keyframes[one].camera.camera)
            counts = [(image.likeness(keyframes[row].features), row) for row in compared[one]]
            return [(one, row) for count, row in sorted(counts, reverse=True)[:TRIED] if count]

        with_others = [one for one in known if compared[one]]
        return list(itertools.chain.from_iterable(self._registrar.each(most_alike, with_others)))

    def _registered(
        self, keyframes: Sequence[Keyframe], candidates: Sequence[tuple[int, int]]
    ) -> list[tuple[Registration, int] | str]:
        """Of each pair its registration, from the pose by features, and how many agree; or why there is none."""
        pairs = [(keyframes[one], keyframes[other]) for one, other in candidates]
        starts = self._registrar.each(lambda pair: pose_by_features(*pair), pairs)
        placed = [(row, start) for row, (start, _) in enumerate(starts) if start is not None]
        found: list[tuple[Registration, int] | str] = ["image features agree on no pose"] * len(pairs)
        if not placed:
            return found
        rows = [row for row, _ in placed]
        registered = self._registrar.register_all(
            [pairs[row] for row in rows], torch.stack([start for _, start in placed])
        )
        for row, each in zip(rows, registered, strict=True):
            found[row] = "no surface is shared" if each is None else (each, starts[row][1])
        return found


def _within_reach(one: int, known: set[int], poses: np.ndarray, lengths: np.ndarray) -> list[int]:
    """Earlier keyframes within reach of drift, the nearest first, without those that it has an edge to."""
    earlier = np.arange(max(one - MIN_AGE + 1, 0))
    distance = np.linalg.norm(poses[earlier, :3, 3] - poses[one, :3, 3], axis=1)
    reach = _drift_m(lengths[one] - lengths[earlier]) + VIEW_M
    nearest = earlier[np.argsort(distance - reach, kind="stable")]
    return [row for row in nearest[distance[nearest] < reach[nearest]].tolist() if row not in known]


def _judge(
    one: int, other: int, registered: tuple[Registration, int], poses: np.ndarray, lengths: np.ndarray
) -> tuple[Proposal | None, str]:
    """What a registered pair, of which so many features agree, proposes; or why it proposes nothing."""
    found, inliers = registered
    reason = found.shortcoming()
    if reason is not None:
        return None, reason
    correction = compose(poses[other], found.pose, inverse(poses[one]))
    path = abs(float(lengths[one] - lengths[other]))
    if _shift(correction, poses[one]) > _drift_m(path):
        return None, f"{_shift(correction, poses[one]):.2f} m are no drift over {path:.1f} m"
    if float(rotation_angle(correction[:3, :3])) > DRIFT_RAD + DRIFT_RAD_PER_M * path:
        return None, f"a turn by {np.degrees(rotation_angle(correction[:3, :3])):.0f} degrees is no drift"
    edge = GraphEdge("loop", one, other, found.pose, found.information)
    return Proposal(edge, correction), f"{inliers} features, {found.on_surface:.0%} of the surface"


def pose_by_features(source: Keyframe, target: Keyframe) -> tuple[torch.Tensor | None, int]:
    """T_target_source float32 [7] of image features and how many agree; None where too few do."""
    image = FeatureAlignment(source.features, source.camera.camera)
    origin = pose_tensor(np.eye(4), torch.device("cpu"))
    matches = image.matches(target.features, origin)
    pose = image.pose(matches, torch.device("cpu"))
    inliers = 0 if pose is None else image.inliers(matches, image.color_pose(pose))
    return (pose, inliers) if inliers >= MIN_INLIERS else (None, inliers)


def _drift_m(path: np.ndarray | float) -> np.ndarray:
    return DRIFT_M + DRIFT_SHARE * np.asarray(path)


def _shift(correction: np.ndarray, pose: np.ndarray) -> float:
    """How far a correction moves a pose, m."""
    return float(np.linalg.norm((correction @ pose - pose)[:3, 3]))


def _agree(one: Proposal, other: Proposal, poses: np.ndarray) -> bool:
    """Whether two proposals move the camera the same way."""
    between = inverse(one.correction) @ other.correction
    pose = poses[other.edge.source]
    return _shift(between, pose) < AGREE_M and float(rotation_angle(between[:3, :3])) < AGREE_RAD
