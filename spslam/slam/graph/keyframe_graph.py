"""The graph of keyframes: its edges are measured, and its poses are those that agree with them best."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from spslam.geometry import compose, inverse, rotation_angle
from spslam.pose_graph import PoseEdges, optimize_pose_graph, squared_errors
from spslam.slam.graph.edges import EdgeKind, GraphEdge, Link, LoopDecision, pose_edges
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.loops import LoopFinder, Proposal
from spslam.slam.graph.overlap import Surfaces
from spslam.slam.graph.redundancy import RECENT, moved_edges, redundant_keyframes
from spslam.slam.graph.registration import Registrar, Registration
from spslam.slam.poses import pose_tensor

NEIGHBORS = 3  # keyframes before, which each is registered with
MIN_SHARED = 0.35  # of the surface, of keyframes that are registered with each other
PARTNERS = 5  # of the others, that share most
SEPARATION = 3  # keyframes between partners
MAX_CHANGE_M, MAX_CHANGE_RAD = 0.1, 0.05  # farther from the poses known, a registration is proof of nothing
TRACKED_IMAGES = 4  # a tracked pose stands on the map and three images, a registration on one image
MEDIAN_SQUARE = 5.35  # of e^T I e of six degrees of freedom
CONTRADICTION = 600.0  # e^T I e of a tracked edge by which a loop contradicts it

# Of a tracked pose of keyframes that show no common surface: 5 cm, 2 degrees.
WEAK_INFORMATION = np.diag([1 / 0.05**2] * 3 + [1 / np.radians(2.0) ** 2] * 3)


@dataclass
class GraphContent:
    """What the graph knows; grows.

    Attributes:
        edges: measured.
        tried: pairs of numbers (source, target) that were registered because they share surface.
        done: how many keyframes have all their edges.
        waiting: loops that wait for a second one.
    """

    edges: list[GraphEdge] = field(default_factory=list)
    tried: set[tuple[int, int]] = field(default_factory=set)
    done: int = 0
    waiting: list[Proposal] = field(default_factory=list)

    def copy(self) -> GraphContent:
        """Another one of the same edges, which can grow on its own."""
        return GraphContent(list(self.edges), set(self.tried), self.done, list(self.waiting))

    def leave_out(self, out: Mapping[int, int], poses: np.ndarray) -> None:
        """Leaves out keyframes, given with their references, at poses float64 [K, 4, 4]; numbers the others anew."""
        numbers = np.cumsum([one not in out for one in range(len(poses))]) - 1
        edges, waiting = moved_edges(self.edges, out, poses), []
        for proposal in self.waiting:
            if proposal.edge.source not in out and proposal.edge.target not in out:
                waiting.append(replace(proposal, edge=_renumbered(proposal.edge, numbers)))
        self.edges, self.waiting = [_renumbered(edge, numbers) for edge in edges], waiting
        kept = [pair for pair in self.tried if pair[0] not in out and pair[1] not in out]
        self.tried = {(int(numbers[one]), int(numbers[other])) for one, other in kept}
        self.done -= len(out)


@dataclass(frozen=True)
class GraphUpdate:
    """Poses that agree with the graph's edges.

    Attributes:
        poses: float64 [K, 4, 4] T_world_camera of the keyframes.
        decisions: on the loops that were tried.
        left_out: keyframes that the content has no more, and their references; in numbers of these K.
    """

    poses: np.ndarray
    decisions: tuple[LoopDecision, ...]
    left_out: dict[int, int]


class KeyframeGraph:
    """Measures edges and solves for poses.

    Args:
        registrar: of the keyframes.
        surfaces: of the keyframes.
        content: to go on with.
    """

    def __init__(self, registrar: Registrar, surfaces: Surfaces, content: GraphContent):
        self._registrar, self._surfaces, self.content = registrar, surfaces, content
        self._loops = LoopFinder(registrar)

    def update(
        self,
        keyframes: Sequence[Keyframe],
        links: Sequence[Link],
        poses: np.ndarray,
        spacing: tuple[float, float],
        with_loops: bool = True,
    ) -> GraphUpdate:
        """Takes in new keyframes, solves, and leaves out what shows nothing new.

        Args:
            keyframes: K of the graph, the new ones last.
            links: of each keyframe to the one before.
            poses: float64 [K, 4, 4] T_world_camera as they are known.
            spacing: of two keyframes that follow each other, m (less where surface is near) and rad.
            with_loops: whether loops are looked for.
        """
        first = self.content.done
        self._join(keyframes, first, links, poses)
        loops, decisions = self.find_loops(keyframes, first, poses) if with_loops else ([], [])
        self.content.done = len(keyframes)
        poses, refused = self.close(keyframes, poses, loops)
        decisions = after_refusal(decisions, refused)
        if loops and not refused:
            first = 0
        return GraphUpdate(poses, tuple(decisions), self._left_out(first, poses, spacing))

    def find_loops(
        self, keyframes: Sequence[Keyframe], first: int, poses: np.ndarray
    ) -> tuple[list[GraphEdge], list[LoopDecision]]:
        """Loops from the keyframes from `first` on to those before, and what was decided on all that were tried.

        Args:
            keyframes: K of the graph.
            first: number of the first new one.
            poses: float64 [K, 4, 4] T_world_camera as they are known.
        """
        lengths = np.append(0.0, np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).cumsum())
        known: dict[int, set[int]] = {one: set() for one in range(first, len(keyframes))}
        for edge in self.content.edges:
            if edge.source in known:
                known[edge.source].add(edge.target)
        return self._loops.find(keyframes, known, poses, lengths, self.content.waiting)

    def connect(self, keyframes: Sequence[Keyframe], first: int, poses: np.ndarray) -> None:
        """Registers the keyframes from `first` on with those just before them, and with all that share surface.

        Args:
            keyframes: K of the graph.
            first: number of the first one, 1 at least.
            poses: float64 [K, 4, 4] T_world_camera as they are known.
        """
        ones = range(first, len(keyframes))
        pairs = [(one, other) for one in ones for other in range(max(one - NEIGHBORS, 0), one)]
        self._register(keyframes, [*pairs, *self._covisible(ones, poses)], poses)

    def close(self, keyframes: Sequence[Keyframe], poses: np.ndarray, loops: list[GraphEdge]) -> tuple[np.ndarray, str]:
        """Solves with loops that were found, and with the edges between what they bring together.

        Args:
            keyframes: K of the graph.
            poses: float64 [K, 4, 4] T_world_camera as they are known.
            loops: may be none.

        Returns:
            Poses float64 [K, 4, 4], and why the loops were refused after all; empty where they were not.
        """
        poses, refused = self._solved(poses, loops)
        if loops and not refused:
            # What drift kept apart now shares surface.
            self._register(keyframes, self._covisible(range(len(keyframes)), poses), poses)
            poses, _ = self._solved(poses, [])
        return poses, refused

    def _left_out(self, first: int, poses: np.ndarray, spacing: tuple[float, float]) -> dict[int, int]:
        """Leaves out redundant keyframes of those from `first` on, and of those that were too new for it before."""
        candidates = range(max(first - RECENT, 1), len(poses) - RECENT)
        out = redundant_keyframes(candidates, poses, spacing, self.content.edges, self._surfaces)
        if out:
            self.content.leave_out(out, poses)
            self._surfaces.keep(np.array([one not in out for one in range(len(poses))]))
        return out

    def _join(self, keyframes: Sequence[Keyframe], first: int, links: Sequence[Link], poses: np.ndarray) -> None:
        """The edges of the keyframes from `first` on to those before that share surface with them."""
        ones = range(max(first, 1), len(keyframes))
        tracked = _tensors([links[one].pose for one in ones])
        measured = self._registrar.measure_all([(keyframes[one], keyframes[one - 1]) for one in ones], tracked)
        for one, found in zip(ones, measured, strict=True):
            information = tracked_information(found)
            kind: EdgeKind = "relocalized" if links[one].relocalized else "tracked"
            self.content.edges.append(GraphEdge(kind, one, one - 1, links[one].pose, information))
        self.connect(keyframes, ones.start, poses)

    def _covisible(self, ones: Iterable[int], poses: np.ndarray) -> list[tuple[int, int]]:
        """Keyframes with those that share most surface with them."""
        pairs: list[tuple[int, int]] = []
        for one in ones:
            shares = self._surfaces.overlaps(one, poses)[: one - NEIGHBORS] if one > NEIGHBORS else np.zeros(0)
            chosen: list[int] = []
            for other in np.argsort(-shares, kind="stable").tolist():
                if shares[other] < MIN_SHARED or len(chosen) >= PARTNERS:
                    break
                if all(abs(other - each) >= SEPARATION for each in chosen):
                    chosen.append(other)
            pairs += [(one, other) for other in chosen]
        return pairs

    def _register(self, keyframes: Sequence[Keyframe], pairs: Sequence[tuple[int, int]], poses: np.ndarray) -> None:
        """Registers pairs that were not tried before from the poses known; those that prove something become edges."""
        content = self.content
        pairs = [pair for pair in dict.fromkeys(pairs) if pair not in content.tried]
        content.tried.update(pairs)
        starts = [compose(inverse(poses[other]), poses[one]) for one, other in pairs]
        registered = self._registrar.register_all(
            [(keyframes[one], keyframes[other]) for one, other in pairs], _tensors(starts)
        )
        for (one, other), start, found in zip(pairs, starts, registered, strict=True):
            if found is None or found.shortcoming() is not None:
                continue
            change = inverse(start) @ found.pose
            near = float(np.linalg.norm(change[:3, 3])) < MAX_CHANGE_M
            if near and float(rotation_angle(change[:3, :3])) < MAX_CHANGE_RAD:
                content.edges.append(GraphEdge("covisible", one, other, found.pose, found.information))

    def _solved(self, poses: np.ndarray, loops: list[GraphEdge]) -> tuple[np.ndarray, str]:
        """Poses that agree with all edges and loops; loops that contradict what was tracked are refused, with why."""
        fixed = np.zeros(len(poses), bool)
        fixed[0] = True
        scale = self._variance_scale(poses)
        if loops:
            edges = _scaled([*self.content.edges, *loops], scale)
            solution = optimize_pose_graph(poses, edges, fixed)
            tracked = [edge.kind == "tracked" for edge in self.content.edges]
            worst = float(solution.errors[: len(tracked)][tracked].max(initial=0.0))
            if worst < CONTRADICTION:
                self.content.edges += loops
                return solution.poses, ""
            reason = f"contradicts the path, as one of those found with it may (chi-squared {worst:.0f})"
            return optimize_pose_graph(poses, _scaled(self.content.edges, scale), fixed).poses, reason
        return optimize_pose_graph(poses, _scaled(self.content.edges, scale), fixed).poses, ""

    def _variance_scale(self, poses: np.ndarray) -> float:
        """By how much registrations vary more than they say, by those of neighbors, which are where they were tracked.

        Some sensors distort depth by centimeters, or show colors from elsewhere, alike in every frame.
        """
        near = [edge for edge in self.content.edges if edge.kind == "covisible"]
        near = [edge for edge in near if abs(edge.source - edge.target) <= NEIGHBORS]
        if not near:
            return 1.0
        return max(float(np.median(squared_errors(poses, pose_edges(near)))) / MEDIAN_SQUARE, 1.0)


def after_refusal(decisions: Sequence[LoopDecision], refused: str) -> list[LoopDecision]:
    """Decisions on loops, of which the accepted ones were refused after all for a reason; empty where they were not."""
    return [
        replace(decision, accepted=False, reason=refused) if refused and decision.accepted else decision
        for decision in decisions
    ]


def tracked_information(measured: Registration | None) -> np.ndarray:
    """float64 [6, 6] of a tracked pose, by how the keyframes compare there; None where they share no surface."""
    return WEAK_INFORMATION if measured is None else TRACKED_IMAGES * measured.information


def _scaled(edges: Sequence[GraphEdge], variance_scale: float) -> PoseEdges:
    """Edges, of which registered ones vary by a factor more than they say."""
    joined = pose_edges(edges)
    registered = np.array([edge.kind in ("covisible", "loop") for edge in edges], bool)
    information = np.where(registered[:, None, None], joined.information / variance_scale, joined.information)
    return replace(joined, information=information)


def _renumbered(edge: GraphEdge, numbers: np.ndarray) -> GraphEdge:
    return replace(edge, source=int(numbers[edge.source]), target=int(numbers[edge.target]))


def _tensors(poses: Sequence[np.ndarray]) -> torch.Tensor:
    """float32 [B, 7] of poses float64 [4, 4] each."""
    return torch.stack([pose_tensor(pose, torch.device("cpu")) for pose in poses]) if poses else torch.zeros(0, 7)
