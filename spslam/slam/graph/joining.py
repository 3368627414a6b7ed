"""Joins two components of keyframes that were mapped apart: where the one is in the other's world, if they meet.

A keyframe of the one that shows a place of the other is found by its image features, its pose by RANSAC on them and
by registration, and both must stand against depth, free space and brightness, as a loop within one component
(`loops.py`). Nothing is known of where the components are, so no drift limits what a loop may say: brightness must
correlate more instead, several loops must agree on one relative pose, and what both components see from there must be
the same surface.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spslam.geometry import compose, inverse, rotation_angle
from spslam.slam.graph.edges import GraphEdge
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.loops import AGREE_M, AGREE_RAD, pose_by_features
from spslam.slam.graph.overlap import Surfaces
from spslam.slam.graph.registration import Registrar, Registration
from spslam.slam.poses import pose_tensor
from spslam.slam.recovery.feature_alignment import FeatureAlignment

MIN_LOOPS = 2  # that agree, from different keyframes to different ones
TRIED = 2  # keyframes of the other component, the most alike, that each is matched with
MOST_SOURCES = 96  # keyframes of the one component that are matched with the other, evenly spread
MIN_SHARED = 0.35  # of the surface, of keyframes that must agree once the relative pose is known
COMPARED = 24  # pairs of such keyframes
MIN_AGREEING = 0.7  # of these pairs
MATCHED = 96  # keyframes of a component that a single frame is compared with
CONFIRMING = 6  # of these, the most alike, that it is matched with
# Of brightness on the surface shared; below it poses are doubted elsewhere too. Storeys that are alike have 0.3 to 0.6.
MIN_CORRELATION_ANYWHERE = 0.7


@dataclass(frozen=True)
class Component:
    """Keyframes whose poses are known in one world.

    Attributes:
        keyframes: K of them.
        poses: float64 [K, 4, 4] T_world_camera.
    """

    keyframes: Sequence[Keyframe]
    poses: np.ndarray

    def surfaces(self) -> Surfaces:
        """Those of the keyframes."""
        surfaces = Surfaces()
        for keyframe in self.keyframes:
            surfaces.add(keyframe)
        return surfaces


@dataclass(frozen=True)
class Joint:
    """Where one component is in another's world.

    Attributes:
        pose: float64 [4, 4] T_other_one.
        loops: that agree on it; the source is a keyframe of the one, the target one of the other component.
    """

    pose: np.ndarray
    loops: tuple[GraphEdge, ...]


@dataclass(frozen=True)
class _Loop:
    """A loop between components, and where it puts the one in the other's world, float64 [4, 4]."""

    edge: GraphEdge
    pose: np.ndarray


def find_joint(registrar: Registrar, one: Component, other: Component) -> Joint | str:
    """Finds where a component is in another's world.

    Args:
        registrar: of the keyframes of both.
        one: is moved.
        other: is where it is.

    Returns:
        The joint; or, in words, why there is none. The same keyframes give the same result.
    """
    loops = _loops(registrar, one, other)
    if len(loops) < MIN_LOOPS:
        return f"{len(loops)} of their keyframes show the same place, {MIN_LOOPS} must"
    agreeing = _agreeing(loops, one)
    sources, targets = ({getattr(loop.edge, end) for loop in agreeing} for end in ("source", "target"))
    if min(len(sources), len(targets)) < MIN_LOOPS:
        return f"of {len(loops)} places that look alike no {MIN_LOOPS} agree on where the runs meet"
    pose = _mean_pose(agreeing, one)
    contradiction = _contradiction(registrar, one, other, pose)
    return Joint(pose, tuple(loop.edge for loop in agreeing)) if contradiction is None else contradiction


def find_frame(registrar: Registrar, frame: Keyframe, known: Component, turn: int = 0) -> np.ndarray | None:
    """Where a frame, which may be anywhere, is in a component's world.

    Args:
        registrar: of the keyframes and the frame.
        frame: as a keyframe.
        known: the component.
        turn: of a large component, which part of it the frame is compared with.

    Returns:
        float64 [4, 4] T_world_camera on which at least two keyframes agree, by features, surface, free space and
        brightness; None where they do not.
    """
    if not registrar.features:
        return None
    count = len(known.keyframes)
    rows = [(turn * MATCHED + i) % count for i in range(min(MATCHED, count))]
    image = FeatureAlignment(frame.features, frame.camera.camera)
    found: list[np.ndarray] = []
    for row in _most_alike(image, known.keyframes, rows)[:CONFIRMING]:
        start, _ = pose_by_features(frame, known.keyframes[row])
        one = None if start is None else _registered(registrar, frame, known.keyframes[row], start)
        if one is None:
            continue
        pose = compose(known.poses[row], one.pose)
        if any(_is_near(pose, each) for each in found):
            return pose
        found.append(pose)
    return None


def _loops(registrar: Registrar, one: Component, other: Component) -> list[_Loop]:
    count = len(one.keyframes)
    sources = np.unique(np.linspace(0, count - 1, min(count, MOST_SOURCES)).round().astype(int)).tolist()
    loops = []
    for source in sources if registrar.features else ():
        keyframe = one.keyframes[source]
        image = FeatureAlignment(keyframe.features, keyframe.camera.camera)
        for target in _most_alike(image, other.keyframes, range(len(other.keyframes)))[:TRIED]:
            start, _ = pose_by_features(keyframe, other.keyframes[target])
            found = None if start is None else _registered(registrar, keyframe, other.keyframes[target], start)
            if found is not None:
                edge = GraphEdge("loop", source, target, found.pose, found.information)
                loops.append(_Loop(edge, compose(other.poses[target], found.pose, inverse(one.poses[source]))))
    return loops


def _most_alike(image: FeatureAlignment, keyframes: Sequence[Keyframe], rows: Iterable[int]) -> list[int]:
    """Those of the rows whose image is like a given one, the most alike first."""
    counts = [(image.likeness(keyframes[row].features), row) for row in rows]
    return [row for likeness, row in sorted(counts, reverse=True) if likeness]


def _agreeing(loops: Sequence[_Loop], one: Component) -> list[_Loop]:
    """The largest group of loops that put the keyframes of the one to the same place as the group's first does."""
    groups = [[each for each in loops if _agree(loop, each, one)] for loop in loops]
    return max(groups, key=len)


def _agree(loop: _Loop, each: _Loop, one: Component) -> bool:
    """Whether two loops put both keyframes that they begin at to the same places."""
    ends = one.poses[[loop.edge.source, each.edge.source]]
    return all(_is_near(compose(each.pose, end), compose(loop.pose, end)) for end in ends)


def _mean_pose(loops: Sequence[_Loop], one: Component) -> np.ndarray:
    """The pose of the loop that all others are nearest to, at the keyframes that they begin at."""
    ends = one.poses[[loop.edge.source for loop in loops]]
    places = np.array([compose(loop.pose, ends)[:, :3, 3] for loop in loops])
    distances = np.linalg.norm(places[:, None] - places[None], axis=3).sum((1, 2))
    return loops[int(distances.argmin())].pose


def _contradiction(registrar: Registrar, one: Component, other: Component, pose: np.ndarray) -> str | None:
    """Why the surface that both components see says that they are not so; None where it does not."""
    surfaces, moved = other.surfaces(), compose(pose, one.poses)
    pairs = []
    for row, at in enumerate(moved):
        shares = surfaces.overlaps_of(one.keyframes[row], at, other.poses)
        best = int(shares.argmax())
        if shares[best] >= MIN_SHARED:
            pairs.append((row, best))
    if not pairs:
        return "where they seem to meet, no two views share enough surface to be compared"
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), COMPARED)).round().astype(int))
    agreeing = 0
    for row, best in (pairs[i] for i in chosen.tolist()):
        start = compose(inverse(other.poses[best]), moved[row])
        agreeing += _show_the_same(registrar, one.keyframes[row], other.keyframes[best], start)
    if agreeing < MIN_AGREEING * len(chosen):
        return f"where they seem to meet, only {agreeing} of {len(chosen)} views show the same surface"
    return None


def _show_the_same(registrar: Registrar, source: Keyframe, target: Keyframe, pose: np.ndarray) -> bool:
    """Whether a source shows the target's surface from T_target_source [4, 4], there or after it was registered.

    Where little is shared registration may slide along it; where maps have drifted the pose is off by that.
    """
    there = registrar.measure(source, target, _tensor(pose))
    if there is not None and _is_proof(there):
        return True
    found = _registered(registrar, source, target, _tensor(pose))
    return found is not None and _is_near(found.pose, pose)


def _registered(registrar: Registrar, source: Keyframe, target: Keyframe, start: torch.Tensor) -> Registration | None:
    """A registration that proves that two keyframes show the same place; None where it does not."""
    found = registrar.register(source, target, start)
    return found if found is not None and _is_proof(found) else None


def _is_proof(found: Registration) -> bool:
    """Whether a registration proves that two keyframes, which may be anywhere, show the same place."""
    return found.shortcoming() is None and not found.correlation < MIN_CORRELATION_ANYWHERE


def _is_near(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two poses are one, as far as loops must agree."""
    between = inverse(one) @ other
    near = float(np.linalg.norm(between[:3, 3])) < AGREE_M
    return near and float(rotation_angle(between[:3, :3])) < AGREE_RAD


def _tensor(pose: np.ndarray) -> torch.Tensor:
    return pose_tensor(pose, torch.device("cpu"))
