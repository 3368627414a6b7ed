"""Keyframes that show nothing new: they are left out, so that the graph of a known place stays as large as it is.

A keyframe is redundant if older ones stand close to where it stands and see what it sees, and it was registered with
one of these, its reference. What is known of it goes on with that one: its edges become the reference's, and frames
that followed it follow the reference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spslam.geometry import compose, inverse, rotation_angle
from spslam.slam.graph.edges import GraphEdge
from spslam.slam.graph.keyframe import NEAR_SHARE
from spslam.slam.graph.overlap import Surfaces

RECENT = 12  # newest keyframes, which all stay: new ones are registered with them, and loops wait for a second one
SIMILAR = 3  # older ones that must stand close: fewer frames would make a noisier map again
COVERED = 0.9  # of its surface must be seen by older ones
_REGISTERED = ("covisible", "loop")


@dataclass(frozen=True)
class Anchor:
    """A keyframe that was left out.

    Attributes:
        frame: its number.
        reference: number of the keyframe that it follows.
        pose: float64 [4, 4] of it in the reference's axes.
    """

    frame: int
    reference: int
    pose: np.ndarray


def redundant_keyframes(
    candidates: Sequence[int],
    poses: np.ndarray,
    spacing: tuple[float, float],
    edges: Sequence[GraphEdge],
    surfaces: Surfaces,
) -> dict[int, int]:
    """Keyframes that can be left out, and the reference of each, which stays.

    Args:
        candidates: numbers of keyframes that are looked at, ascending.
        poses: float64 [K, 4, 4] T_world_camera.
        spacing: of keyframes that follow each other, m (less where surface is near) and rad: closer is close.
        edges: of the graph.
        surfaces: of the keyframes.
    """
    registered: dict[int, list[int]] = {}
    for edge in edges:
        if edge.kind in _REGISTERED:
            registered.setdefault(max(edge.source, edge.target), []).append(min(edge.source, edge.target))
    out: dict[int, int] = {}
    kept = np.ones(len(poses), bool)
    for one in candidates:
        older = np.flatnonzero(kept[:one])
        relative = compose(inverse(poses[one]), poses[older])
        distance, angle = np.linalg.norm(relative[:, :3, 3], axis=1), rotation_angle(relative[:, :3, :3])
        reach = min(spacing[0], NEAR_SHARE * surfaces.median_m(one))
        close = older[(distance < reach) & (angle < spacing[1])]
        references = np.intersect1d(close, registered.get(one, ()))
        if len(close) >= SIMILAR and len(references) and surfaces.covered(one, older, poses) > COVERED:
            nearest = distance[np.searchsorted(older, references)].argmin()
            out[one], kept[one] = int(references[nearest]), False
    return out


def moved_edges(edges: Sequence[GraphEdge], out: Mapping[int, int], poses: np.ndarray) -> list[GraphEdge]:
    """Edges of the graph without the keyframes that are left out, in its numbers; those of these are references' now.

    A pair of keyframes has at most one edge that it has got in this way.

    Args:
        edges: before.
        out: references of the keyframes that are left out.
        poses: float64 [K, 4, 4] T_world_camera of all keyframes.
    """
    between = {(edge.source, edge.target): edge for edge in edges if edge.kind in _REGISTERED}
    result = [edge for edge in edges if edge.source not in out and edge.target not in out]
    joined = {frozenset((edge.source, edge.target)) for edge in result}
    for edge in edges:
        source, target = (out.get(end, end) for end in (edge.source, edge.target))
        if (source, target) == (edge.source, edge.target) or source == target or frozenset((source, target)) in joined:
            continue
        joined.add(frozenset((source, target)))
        measured, covariance = edge.measured, np.linalg.inv(edge.information)
        # The two stand so close that errors in the axes of one are nearly those in the axes of the other.
        for end, reference in ((edge.source, source), (edge.target, target)):
            if end != reference:
                step = between.get((end, reference)) or between[(reference, end)]
                covariance = covariance + np.linalg.inv(step.information)
        if source != edge.source:
            measured = compose(measured, inverse(poses[edge.source]), poses[source])
        if target != edge.target:
            measured = compose(inverse(poses[target]), poses[edge.target], measured)
        information = np.linalg.inv(covariance)
        result.append(
            replace(
                edge, source=source, target=target, measured=measured, information=(information + information.T) / 2
            )
        )
    return result


def moved_anchors(
    anchors: Sequence[Anchor], out: Mapping[int, int], frames: Sequence[int], poses: np.ndarray
) -> list[Anchor]:
    """Anchors with those of the keyframes that are left out, in the graph's numbers, ascending.

    Args:
        anchors: before.
        out: references of the keyframes that are left out.
        frames: numbers of the frames of the first K keyframes.
        poses: float64 [K, 4, 4] T_world_camera of these.
    """
    result = []
    for anchor in anchors:
        reference = out.get(anchor.reference)
        if reference is None:
            result.append(anchor)
        else:
            pose = compose(inverse(poses[reference]), poses[anchor.reference], anchor.pose)
            result.append(Anchor(anchor.frame, reference, pose))
    result += [Anchor(frames[one], to, compose(inverse(poses[to]), poses[one])) for one, to in out.items()]
    return sorted(result, key=lambda anchor: anchor.frame)


def with_anchors(
    rows: np.ndarray, poses: np.ndarray, anchors: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The frames that say how all others move: those of keyframes and of keyframes that were left out.

    Args:
        rows: int64 [K], frames of the keyframes.
        poses: float64 [K, 4, 4] of these, T_world_camera.
        anchors: as of `Anchor`: frames and references int64 [N], poses float64 [N, 4, 4].

    Returns:
        Frames int64 [K + N], ascending, and their poses float64 [K + N, 4, 4].
    """
    frames, references, relative = anchors
    numbers = np.append(rows, frames)
    order = np.argsort(numbers, kind="stable")
    return numbers[order], np.concatenate([poses, compose(poses[references], relative)])[order]
