"""Edges of the keyframe graph, and what became of loops that were tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from spslam.pose_graph import PoseEdges

EdgeKind = Literal["tracked", "relocalized", "covisible", "loop"]
EDGE_KINDS: tuple[EdgeKind, ...] = get_args(EdgeKind)


@dataclass(frozen=True)
class GraphEdge:
    """A measured relative pose of two keyframes.

    Attributes:
        kind: `tracked` one after the other, `relocalized` where frames between them are lost, `covisible` where both
            see the same surface at the poses known, `loop` where only the images said so.
        source, target: numbers of the keyframes.
        measured: float64 [4, 4] T_target_source.
        information: float64 [6, 6], see `PoseEdges`.
    """

    kind: EdgeKind
    source: int
    target: int
    measured: np.ndarray
    information: np.ndarray


@dataclass(frozen=True)
class Link:
    """How a keyframe was reached from the one before.

    Attributes:
        pose: float64 [4, 4] of the keyframe in the axes of the one before, as tracked.
        relocalized: whether frames between them are lost.
    """

    pose: np.ndarray
    relocalized: bool


@dataclass(frozen=True)
class LoopDecision:
    """A loop that was tried.

    Attributes:
        source, target: numbers of the frames; in a log, keyframes of a map that was opened have negative ones.
        accepted: whether it became an edge.
        reason: why not, or what spoke for it.
        correction_m: how far the source moves by it.
    """

    source: int
    target: int
    accepted: bool
    reason: str
    correction_m: float


def pose_edges(edges: Sequence[GraphEdge]) -> PoseEdges:
    """Edges as `optimize_pose_graph` takes them; tracked ones and loops, which were verified, always count."""
    return PoseEdges(
        np.array([edge.source for edge in edges], np.int64),
        np.array([edge.target for edge in edges], np.int64),
        np.array([edge.measured for edge in edges]).reshape(-1, 4, 4),
        np.array([edge.information for edge in edges]).reshape(-1, 6, 6),
        np.array([edge.kind not in ("tracked", "loop") for edge in edges], bool),
    )
