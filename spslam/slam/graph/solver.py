"""Solutions of the keyframe graph: on a thread of the loop's process, or in one of their own (`solver_process`)."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from spslam.config import Config
from spslam.slam.graph.edges import Link
from spslam.slam.graph.keyframe import Keyframe, KeyframeCamera
from spslam.slam.graph.keyframe_graph import GraphContent, GraphUpdate, KeyframeGraph
from spslam.slam.graph.overlap import Surfaces
from spslam.slam.graph.registration import Registrar


@dataclass(frozen=True)
class GraphProblem:
    """What is to be solved, beside the keyframes.

    Attributes:
        links: of each of the K keyframes to the one before.
        poses: float64 [K, 4, 4] T_world_camera as they are known.
        content: of the graph, as of the last solution; not changed.
        noises: float32 [4] of each camera's sensor, on the host.
    """

    links: Sequence[Link]
    poses: np.ndarray
    content: GraphContent
    noises: dict[KeyframeCamera, torch.Tensor]


class GraphSolution(NamedTuple):
    """The graph's content, to which the new keyframes' edges were added, and what follows from it."""

    content: GraphContent
    update: GraphUpdate


class GraphSolver:
    """Solves the graph of a run's keyframes, again each time that there are more.

    The kernels on the CPU register keyframes, also beside a GPU: it is busy with tracking, and a process of the
    solver's own need not load its driver.

    Args:
        config: options of the run.
        pool: threads for what is done of each keyframe and pair; None does it in the caller's.
    """

    def __init__(self, config: Config, pool: ThreadPoolExecutor | None = None):
        self._config, self._pool = config, pool
        self._known: list[Keyframe] = []  # of which there are surfaces
        self._surfaces = Surfaces()

    @staticmethod
    def prepare() -> None:
        """Loads what solutions need, so that the first one need not: an import keeps other threads waiting."""
        importlib.import_module("scipy.sparse.linalg")

    def solve(self, keyframes: Sequence[Keyframe], problem: GraphProblem) -> GraphSolution:
        """Solves the graph of K keyframes: those of the last solution that it did not leave out, then new ones."""
        if not is_begin(self._known, keyframes):
            self._known, self._surfaces = [], Surfaces()
        for keyframe in keyframes[len(self._known) :]:
            self._surfaces.add(keyframe)
        options, content = self._config.graph, problem.content.copy()
        registrar = Registrar.of_config(self._config, problem.noises, pool=self._pool)
        graph = KeyframeGraph(registrar, self._surfaces, content)
        spacing = options.max_translation_m, math.radians(options.max_rotation_deg)
        update = graph.update(keyframes, problem.links, problem.poses, spacing, options.loops)
        registrar.forget()  # else Python's garbage collector does, minutes later
        self._known = kept(keyframes, update)
        return GraphSolution(content, update)

    def give_way(self) -> None:
        """Does nothing: the thread that calls it is its caller's."""

    def close(self) -> None:
        """Does nothing: a `SolverProcess` has something to close."""


def is_begin(known: Sequence[Keyframe], keyframes: Sequence[Keyframe]) -> bool:
    """Whether keyframes begin with those known: they do until the state is loaded."""
    return len(known) <= len(keyframes) and all(map(lambda one, other: one is other, known, keyframes))


def kept(keyframes: Sequence[Keyframe], update: GraphUpdate) -> list[Keyframe]:
    """The keyframes that a solution did not leave out."""
    return [keyframe for number, keyframe in enumerate(keyframes) if number not in update.left_out]
