"""What the process that solves the keyframe graph runs, for a `SolverProcess`."""

from __future__ import annotations

import contextlib
import pickle
import traceback
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection

import cv2
import torch

from spslam import ops
from spslam.helper_process import DISCONNECTED
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.solver import GraphSolver, kept
from spslam.slam.graph.solver_message import Answer, Request
from spslam.slam.host_threads import host_thread_count


def serve(socket: int) -> None:
    """Main function of the process: solves what it is sent, until the connection is closed.

    Args:
        socket: file descriptor of the connection to the frame loop.
    """
    threads = host_thread_count()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    ops.set_num_threads(threads)
    with (
        contextlib.suppress(*DISCONNECTED),
        Connection(socket) as connection,
        ThreadPoolExecutor(threads) as pool,
    ):
        service = SolverService(pool)
        GraphSolver.prepare()
        while True:
            request: Request = pickle.loads(connection.recv_bytes())
            try:
                answer = service.answer(request)
            except Exception:
                answer = Answer(failure=traceback.format_exc())
            connection.send(answer)


class SolverService:
    """Solves the graph of a run, and keeps its keyframes until those of another one come.

    Args:
        pool: threads for what is done of each keyframe.
    """

    def __init__(self, pool: ThreadPoolExecutor):
        self._pool = pool
        self._keyframes: list[Keyframe] = []
        self._solver: GraphSolver | None = None

    def answer(self, request: Request) -> Answer:
        """Solves what is asked for."""
        if self._solver is None or request.known == 0:
            self._solver, self._keyframes = GraphSolver(request.config, self._pool), []
        keyframes = [*self._keyframes, *request.new_keyframes()]
        without = [number for number, keyframe in enumerate(keyframes) if keyframe.found_features is None]
        solution = self._solver.solve(keyframes, request.problem())
        self._keyframes = kept(keyframes, solution.update)
        found = {number: keyframes[number].found_features for number in without}
        return Answer.of(solution, {number: features for number, features in found.items() if features is not None})
