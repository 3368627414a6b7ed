"""Joins the maps of overlapping parts of one recording into a map of that recording.

Both parts have poses for the frames that they share, so where the second one is in the first one's world is known
without a search. Of those frames the first half is the first part's, the rest the second's. Then all keyframes are one
graph: those that share surface are registered, loops are found as in a run, and the poses are solved for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from spslam.geometry import compose, inverse
from spslam.slam.graph.archive import KeyframeArchive, Recording, same_length
from spslam.slam.graph.edges import GraphEdge, Link, LoopDecision
from spslam.slam.graph.joined import moved_recordings
from spslam.slam.graph.joining import Component, find_joint
from spslam.slam.graph.keyframe_graph import (
    WEAK_INFORMATION,
    GraphContent,
    KeyframeGraph,
    after_refusal,
    tracked_information,
)
from spslam.slam.graph.loops import AGREE_M
from spslam.slam.graph.registration import Registrar
from spslam.slam.poses import pose_tensor
from spslam.trajectory import Trajectory

MIN_SHARED_FRAMES = 3  # that both parts know, by which one is put to the other's world
COMPARED = 60  # of these frames
AHEAD_M = 1.0  # at which directions count when poses are compared


@dataclass(frozen=True)
class Part:
    """A part of a recording that was run over.

    Attributes:
        archive: its map, of one recording.
        indices: int64 [F], index in the whole recording of each frame in the trajectory, ascending.
        decisions: on the loops that were tried when it was joined, by rows of the trajectory.
    """

    archive: KeyframeArchive
    indices: np.ndarray
    decisions: tuple[LoopDecision, ...] = ()

    @property
    def trajectory(self) -> Trajectory:
        """Of all its frames."""
        return self.archive.recordings[0].trajectory

    def row(self, index: int) -> int:
        """Row in the trajectory of the first frame from an index of the recording on."""
        return int(np.searchsorted(self.indices, index))


def join_parts(first: Part, second: Part, boundary: int, registrar: Registrar) -> Part | str:
    """One part of two that follow each other.

    Args:
        first: its world is kept, and the pose of its first keyframe.
        second: is moved.
        boundary: index in the recording from which on frames are the second part's; before it they are the first's.
        registrar: of the keyframes of both.

    Returns:
        The part; or, in words, why they can't be joined. The same parts give the same result.
    """
    kept = _cut(first, slice(0, first.row(boundary))), _cut(second, slice(second.row(boundary), len(second.indices)))
    pose = _pose_by_frames(first, second)
    if not kept[0].archive.keyframes or (isinstance(pose, str) and not kept[1].archive.keyframes):
        return "one of them knows no frame of its own"
    if isinstance(pose, str):
        joint = find_joint(registrar, *(Component(each.archive.keyframes, each.archive.poses) for each in kept[::-1]))
        if isinstance(joint, str):
            return f"{pose}, and {joint}"
        pose = joint.pose
    count = len(kept[0].archive.keyframes)
    joined = _concatenated(*kept, pose)
    archive = joined.archive
    if len(archive.keyframes) == count:
        return replace(joined, decisions=kept[0].decisions)
    ties = _ties(first, second, kept, pose, registrar)
    content = GraphContent([*archive.edges, *ties], set(archive.tried), len(archive.keyframes))
    graph = KeyframeGraph(registrar, Component(archive.keyframes, archive.poses).surfaces(), content)
    graph.connect(archive.keyframes, count, archive.poses)
    loops, decisions = graph.find_loops(archive.keyframes, count, archive.poses)
    poses, refused = graph.close(archive.keyframes, archive.poses, loops)
    decisions = [*kept[0].decisions, *after_refusal(decisions, refused)]
    moved = replace(archive, recordings=moved_recordings(archive, poses), edges=content.edges, tried=content.tried)
    return replace(joined, archive=moved, decisions=tuple(decisions))


def _pose_by_frames(first: Part, second: Part) -> np.ndarray | str:
    """float64 [4, 4] T_first_second by the frames that both know; in words, why they do not say it."""
    _, ones, others = np.intersect1d(first.indices, second.indices, assume_unique=True, return_indices=True)
    known = np.flatnonzero(~(first.trajectory.lost[ones] | second.trajectory.lost[others]))
    if len(known) < MIN_SHARED_FRAMES:
        return f"the camera is known in {len(known)} frames that they share, {MIN_SHARED_FRAMES} must be"
    chosen = known[np.unique(np.linspace(0, len(known) - 1, COMPARED).round().astype(int))]
    there, here = first.trajectory.poses[ones[chosen]], second.trajectory.poses[others[chosen]]
    candidates = compose(there, inverse(here))
    # Each moves cameras, and points ahead of them, to nearly the same places: the one nearest to all is taken.
    points = np.concatenate([here[:, :3, 3], here[:, :3, 3] + AHEAD_M * here[:, :3, 2]])
    placed = np.einsum("cij,pj->cpi", candidates[:, :3, :3], points) + candidates[:, None, :3, 3]
    distances = np.linalg.norm(placed[:, None] - placed[None], axis=3).mean(2)
    best = int(distances.sum(1).argmin())
    off_m = float(np.median(distances[best]))
    return candidates[best] if off_m < AGREE_M else f"the frames that they share disagree by {100 * off_m:.0f} cm"


def _cut(part: Part, rows: slice) -> Part:
    """Some frames of a part, and their keyframes, in its world."""
    archive, trajectory = part.archive, part.trajectory
    inside = (archive.rows >= rows.start) & (archive.rows < rows.stop)
    numbers = np.cumsum(inside) - 1
    kept = np.flatnonzero(inside).tolist()
    anchors = archive.anchors
    anchors = anchors[(anchors[:, 0] >= rows.start) & (anchors[:, 0] < rows.stop) & inside[anchors[:, 1]]]
    edges = [
        replace(edge, source=int(numbers[edge.source]), target=int(numbers[edge.target]))
        for edge in archive.edges
        if inside[edge.source] and inside[edge.target]
    ]
    frames = Trajectory(trajectory.timestamps[rows], trajectory.poses[rows], trajectory.lost[rows])
    cut = replace(
        archive,
        recordings=[replace(archive.recordings[0], trajectory=frames)],
        keyframes=[archive.keyframes[one].changed(frame=archive.keyframes[one].frame - rows.start) for one in kept],
        links=[archive.links[one] for one in kept],
        records=archive.records[torch.from_numpy(inside)],
        edges=[*edges, *_held(edges, archive.poses[inside])],
        tried={
            (int(numbers[one]), int(numbers[other])) for one, other in archive.tried if inside[one] and inside[other]
        },
        anchors=np.stack([anchors[:, 0] - rows.start, numbers[anchors[:, 1]]], 1),
    )
    decisions = [
        replace(each, source=each.source - rows.start, target=each.target - rows.start)
        for each in part.decisions
        if rows.start <= min(each.source, each.target) and max(each.source, each.target) < rows.stop
    ]
    return Part(cut, part.indices[rows], tuple(decisions))


def _held(edges: Sequence[GraphEdge], poses: np.ndarray) -> list[GraphEdge]:
    """Edges to the one before, of keyframes at poses float64 [K, 4, 4] whose edges to all before were cut."""
    joined = {max(edge.source, edge.target) for edge in edges}
    return [
        GraphEdge("tracked", one, one - 1, compose(inverse(poses[one - 1]), poses[one]), WEAK_INFORMATION)
        for one in range(1, len(poses))
        if one not in joined
    ]


def _concatenated(first: Part, second: Part, pose: np.ndarray) -> Part:
    """Both, in the first one's world, without edges between them.

    Args:
        first: comes first.
        second: its frames follow.
        pose: float64 [4, 4] T_first_second.
    """
    one, other = first.archive, second.archive
    count, frames = len(one.keyframes), len(first.indices)
    ahead, behind = first.trajectory, second.trajectory
    trajectory = Trajectory(
        np.concatenate([ahead.timestamps, behind.timestamps]),
        np.concatenate([ahead.poses, compose(pose, behind.poses)]),
        np.concatenate([ahead.lost, behind.lost]),
    )
    edges = [replace(edge, source=edge.source + count, target=edge.target + count) for edge in other.edges]
    links = list(other.links)
    if links:
        links[0] = Link(compose(inverse(one.poses[-1]), pose, other.poses[0]), False)
    archive = KeyframeArchive(
        [replace(one.recordings[0], trajectory=trajectory)],
        [*one.keyframes, *(each.changed(frame=each.frame + frames) for each in other.keyframes)],
        [*one.links, *links],
        same_length([*one.records, *other.records]),
        [*one.edges, *edges],
        one.tried | {(source + count, target + count) for source, target in other.tried},
        {**other.noise, **one.noise},
        one.settings,
        np.concatenate([one.anchors, other.anchors + (frames, count)]),
    )
    return Part(archive, np.concatenate([first.indices, second.indices]))


def _ties(
    first: Part, second: Part, kept: tuple[Part, Part], pose: np.ndarray, registrar: Registrar
) -> list[GraphEdge]:
    """Edges from the first keyframe of the second part to the last one of the first, in numbers of both together.

    Each part in whose trajectory both frames are tracked says how they stand to each other.

    Args:
        first, second: before they were cut.
        kept: of them.
        pose: float64 [4, 4] T_first_second.
        registrar: of the keyframes.
    """
    one, other = kept[0].archive, kept[1].archive
    last, new = one.keyframes[-1], other.keyframes[0]
    indices = [int(kept[0].indices[last.frame]), int(kept[1].indices[new.frame])]
    tracked = [between for part in (first, second) if (between := _between(part, *indices)) is not None]
    source, edges = len(one.keyframes), []
    for each in tracked or [compose(inverse(one.poses[-1]), pose, other.poses[0])]:
        found = registrar.measure(new, last, pose_tensor(each, torch.device("cpu")))
        edges.append(GraphEdge("tracked", source, source - 1, each, tracked_information(found)))
    return edges


def _between(part: Part, target: int, source: int) -> np.ndarray | None:
    """float64 [4, 4] T_target_source of two frames, by their indices; None where a part does not know both."""
    rows = [part.row(index) for index in (target, source)]
    for row, index in zip(rows, (target, source), strict=True):
        if row == len(part.indices) or part.indices[row] != index or part.trajectory.lost[row]:
            return None
    to, at = part.trajectory.poses[rows]
    return compose(inverse(to), at)


def whole_recording(part: Part, recording: Recording) -> KeyframeArchive:
    """The map of a part that is now all of a recording, which has another name or is read from elsewhere.

    Args:
        part: of all frames.
        recording: as it is called and read; its trajectory is not used.
    """
    return replace(part.archive, recordings=[replace(recording, trajectory=part.trajectory)])
