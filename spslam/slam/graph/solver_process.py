"""Solutions of the keyframe graph by another process, so that they don't compete with the frame loop for Python's GIL.

The other process keeps the keyframes. For each solution the loop's sends it the new ones, what the graph knows, and
poses as they are; it answers with what the graph then knows, and better poses. If it ends before its time, the loop's
process solves the graph itself, with the same result.
"""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection

import torch

from spslam.config import Config
from spslam.errors import SpslamError, brief
from spslam.helper_process import DISCONNECTED, NOT_STARTED, HelperProcess, describe_exit
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.solver import GraphProblem, GraphSolution, GraphSolver, is_begin, kept
from spslam.slam.graph.solver_launch import SOLVERS
from spslam.slam.graph.solver_message import Answer, Request
from spslam.slam.host_threads import give_way

_EXIT_TIMEOUT_S = 5.0


class SolverProcess:
    """Like `GraphSolver`, in another process.

    Args:
        config: options of the run.
        pool: threads of this process, for the case that the other one ends.

    Raises:
        OSError, TypeError: it can't be started.
    """

    def __init__(self, config: Config, pool: ThreadPoolExecutor | None = None):
        self._config, self._pool = config, pool
        self._helper: HelperProcess | None = SOLVERS.take()
        self._known: list[Keyframe] = []  # that the process has
        self._is_solving = self._gives_way = False
        self._here: GraphSolver | None = None

    def prepare(self) -> None:
        """See `GraphSolver.prepare`; the other process does so by itself."""

    def solve(self, keyframes: Sequence[Keyframe], problem: GraphProblem) -> GraphSolution:
        """See `GraphSolver.solve`."""
        if self._helper is not None:
            try:
                return self._answered(self._helper.connection, keyframes, problem)
            except DISCONNECTED:
                self._lose(self._helper)
        self._here = self._here or GraphSolver(self._config, self._pool)
        return self._here.solve(keyframes, problem)

    def give_way(self) -> None:
        """Lets the process wait for all others, where the system can."""
        if self._helper is not None:
            give_way(self._helper.process.pid)
            self._gives_way = True

    def close(self) -> None:
        """Leaves the process to the next run, or ends it where it still solves something. May be called again."""
        helper, self._helper = self._helper, None
        if helper is None:
            return
        if self._is_solving or self._gives_way:  # a priority can't be raised again
            helper.end()
        else:
            SOLVERS.give_back(helper)

    def _answered(self, connection: Connection, keyframes: Sequence[Keyframe], problem: GraphProblem) -> GraphSolution:
        if not is_begin(self._known, keyframes):
            self._known = []
        request = Request.of(self._config, len(self._known), keyframes[len(self._known) :], problem)
        self._is_solving = True
        connection.send_bytes(pickle.dumps(request, pickle.HIGHEST_PROTOCOL))
        answer = Answer(*connection.recv())
        self._is_solving = False
        if answer.content is None or answer.update is None:
            self._known = []
            raise RuntimeError(f"solving the keyframe graph failed:\n{answer.failure}")
        for number, features in answer.features.items():
            keyframes[number].know_features(features)
        self._known = kept(keyframes, answer.update)
        return GraphSolution(answer.content.content(), answer.update)

    def _lose(self, helper: HelperProcess) -> None:
        """Goes on without a process that has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            helper.process.wait(_EXIT_TIMEOUT_S)
        helper.end()
        self._helper, self._is_solving = None, False
        how = describe_exit(helper.process.returncode)
        warnings.warn(
            f"the process that solves the keyframe graph ended {how}; this one does it from now on", stacklevel=2
        )


def make_solver(config: Config, device: torch.device, pool: ThreadPoolExecutor | None) -> GraphSolver | SolverProcess:
    """What solves the graph of a run, by `run.graph_solver`: `auto` takes a process on standby for a GPU.

    Args:
        config: options of the run.
        device: of its map.
        pool: threads of this process.

    Raises:
        SpslamError: a process was asked for and can't be started.
    """
    choice = config.run.graph_solver
    has_standby = device.type == "cuda" and SOLVERS.waiting is not None
    if choice == "thread" or (choice == "auto" and not has_standby):
        return GraphSolver(config, pool)
    try:
        return SolverProcess(config, pool)
    except NOT_STARTED as error:
        raise SpslamError(
            f"run.graph_solver=process can't be used: the process can't be started ({brief(str(error))}); "
            "run.graph_solver=thread uses no separate process"
        ) from error
