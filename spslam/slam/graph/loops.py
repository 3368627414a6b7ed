"""Finds loops: keyframes far apart in time, and perhaps in the map, that show the same place.

A loop is proposed by image features, its pose is found by RANSAC on them and then by registration, and it must stand
against depth (`through`, `on_surface`), brightness (`correlation`), what drift is likely over the path between, and a
second loop nearby that moves the camera the same way. What the graph thinks of it is asked afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spslam.geometry import compose, inverse, rotation_angle
from spslam.slam.graph.edges import GraphEdge, LoopDecision
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.registration import Registrar
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
    """Finds loops of one keyframe after the other.

    Args:
        registrar: of the keyframes.
    """

    def __init__(self, registrar: Registrar):
        self._registrar = registrar

    def find(
        self,
        keyframes: Sequence[Keyframe],
        one: int,
        known: set[int],
        poses: np.ndarray,
        lengths: np.ndarray,
        waiting: list[Proposal],
    ) -> tuple[list[GraphEdge], list[LoopDecision]]:
        """Loops from a keyframe to earlier ones, and those that it confirms.

        Args:
            keyframes: of the graph.
            one: number of the keyframe.
            known: numbers of those that it has an edge to.
            poses: float64 [K, 4, 4].
            lengths: float64 [K] of the path up to each, m.
            waiting: proposals of keyframes before, which is kept up to date.
        """
        edges: list[GraphEdge] = []
        decisions: list[LoopDecision] = []
        waiting[:] = [each for each in waiting if each.edge.source > one - MEMORY]
        for other in self._alike(keyframes, one, known, poses, lengths) if self._registrar.features else ():
            names = keyframes[one].frame, keyframes[other].frame
            proposal, reason = self._try(keyframes, one, other, poses, lengths)
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
            decisions.append(LoopDecision(*names, proposal is not None, reason, moved))
        return edges, decisions

    def _alike(
        self, keyframes: Sequence[Keyframe], one: int, known: set[int], poses: np.ndarray, lengths: np.ndarray
    ) -> list[int]:
        """Keyframes within reach of drift whose features are most like those of `one`."""
        earlier = np.arange(max(one - MIN_AGE + 1, 0))
        distance = np.linalg.norm(poses[earlier, :3, 3] - poses[one, :3, 3], axis=1)
        reach = _drift_m(lengths[one] - lengths[earlier]) + VIEW_M
        nearest = earlier[np.argsort(distance - reach, kind="stable")]
        within = nearest[distance[nearest] < reach[nearest]].tolist()
        image = FeatureAlignment(keyframes[one].features, keyframes[one].camera.camera)
        compared = [row for row in within if row not in known][:COMPARED]
        counts = [(image.likeness(keyframes[row].features), row) for row in compared]
        return [row for count, row in sorted(counts, reverse=True)[:TRIED] if count]

    def _try(
        self, keyframes: Sequence[Keyframe], one: int, other: int, poses: np.ndarray, lengths: np.ndarray
    ) -> tuple[Proposal | None, str]:
        start, inliers = pose_by_features(keyframes[one], keyframes[other])
        if start is None:
            return None, "image features agree on no pose"
        found = self._registrar.register(keyframes[one], keyframes[other], start)
        if found is None:
            return None, "no surface is shared"
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
    inliers = 0 if pose is None else image.inliers(matches, pose)
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
