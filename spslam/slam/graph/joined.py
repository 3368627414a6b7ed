"""Joins the archives of two maps into one: keyframes, edges and trajectories in the world of the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spslam.config import Config
from spslam.geometry import compose, inverse
from spslam.slam.graph.archive import KeyframeArchive, Recording, same_length
from spslam.slam.graph.edges import GraphEdge, Link
from spslam.slam.graph.joining import Component, Joint, find_joint
from spslam.slam.graph.keyframe_graph import GraphContent, KeyframeGraph
from spslam.slam.graph.registration import Registrar
from spslam.slam.graph.remap import corrected_poses
from spslam.trajectory import Trajectory


def join_archives(first: KeyframeArchive, second: KeyframeArchive, registrar: Registrar) -> KeyframeArchive | str:
    """One map of two that share a place.

    Args:
        first: its world is kept, and the pose of its first keyframe.
        second: is moved.
        registrar: of the keyframes of both.

    Returns:
        The map, with poses that all edges agree on; or, in words, why it can't be. The same maps give the same result.
    """
    ones, others = (Component(each.keyframes, each.poses) for each in (second, first))
    joint = find_joint(registrar, ones, others)
    if isinstance(joint, str):
        return joint
    joined, loops = _concatenated(first, second, joint)
    content = GraphContent(list(joined.edges), set(joined.tried), len(joined.keyframes))
    graph = KeyframeGraph(registrar, Component(joined.keyframes, joined.poses).surfaces(), content)
    poses, refused = graph.close(joined.keyframes, joined.poses, loops)
    if refused:
        return f"what brings them together {refused}"
    recordings = moved_recordings(joined, poses)
    return replace(joined, recordings=recordings, edges=content.edges, tried=content.tried)


def registrar_of(first: KeyframeArchive, second: KeyframeArchive, config: Config) -> Registrar:
    """A registrar of the keyframes of two maps; a sensor that both know has the noise that the first one measured."""
    return Registrar.of_config(config, {**second.noise, **first.noise})


def moved_recordings(archive: KeyframeArchive, poses: np.ndarray) -> list[Recording]:
    """The recordings of a map whose keyframes are now at poses float64 [K, 4, 4]; all frames follow them."""
    rows, at_rows = archive.with_anchors(poses)
    moved, begin = [], 0
    for recording, end in zip(archive.recordings, archive.ends.tolist(), strict=True):
        own = (rows >= begin) & (rows < end)
        at = recording.trajectory.poses
        if own.any():
            at = corrected_poses(at, rows[own] - begin, at_rows[own])
        moved.append(_at(recording, at))
        begin = end
    return moved


def _concatenated(
    first: KeyframeArchive, second: KeyframeArchive, joint: Joint
) -> tuple[KeyframeArchive, list[GraphEdge]]:
    """Both, and the loops between them, by the numbers that keyframes and frames have in both together."""
    count, frames = len(first.keyframes), int(first.ends[-1])
    moved = [_at(each, compose(joint.pose, each.trajectory.poses)) for each in second.recordings]
    keyframes = [*first.keyframes, *(each.changed(frame=each.frame + frames) for each in second.keyframes)]
    reached = compose(inverse(first.poses[-1]), joint.pose, second.poses[0])
    edges = [replace(each, source=each.source + count, target=each.target + count) for each in second.edges]
    joined = KeyframeArchive(
        [*first.recordings, *moved],
        keyframes,
        [*first.links, Link(reached, True), *second.links[1:]],
        same_length([*first.records, *second.records]),
        [*first.edges, *edges],
        first.tried | {(one + count, other + count) for one, other in second.tried},
        {**second.noise, **first.noise},
        first.settings,
        np.concatenate([first.anchors, second.anchors + (frames, count)]),
    )
    return joined, [replace(each, source=each.source + count) for each in joint.loops]


def _at(recording: Recording, poses: np.ndarray) -> Recording:
    trajectory = recording.trajectory
    return replace(recording, trajectory=Trajectory(trajectory.timestamps, poses, trajectory.lost))
