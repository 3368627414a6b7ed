"""The keyframe graph solved by another process: the same result, run after run, and what happens when it ends."""

import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from spslam import helper_process
from spslam.errors import SpslamError
from spslam.slam.graph import solver_launch
from spslam.slam.graph.edges import Link
from spslam.slam.graph.keyframe_graph import GraphContent
from spslam.slam.graph.solver import GraphProblem, GraphSolver, kept
from spslam.slam.graph.solver_launch import SOLVERS
from spslam.slam.graph.solver_process import SolverProcess, make_solver
from spslam.slam.graph.solver_service import serve
from tests.slam.graph.worlds import NOISE, keyframes, place, relative
from tests.system.sequences import settings

CPU = torch.device("cpu")
NUMBERS = tuple(range(0, 96, 8))
PATIENCE_S = 60


@pytest.fixture(scope="module")
def world():
    """Options, keyframes to and fro, and their poses, which are off: so some are left out."""
    frames, poses = keyframes("room", 96, NUMBERS)
    numbered = [each.changed(frame=number) for number, each in enumerate((*frames, *frames[::-1], *frames))]
    poses = np.concatenate([poses, poses[::-1], poses])
    drifted = poses.copy()
    drifted[:, 0, 3] += 0.001 * np.arange(len(poses))
    return place("room", 96)[0], numbered, drifted


@pytest.fixture(scope="module")
def solved(world):
    """By this process: the content and the solution, and the keyframes that are left."""
    return solve_in_parts(GraphSolver(world[0]), world)


@pytest.fixture(autouse=True)
def ended_in_the_end():
    yield
    SOLVERS.end()


def solve_in_parts(solver, world, parts=(12, 24, 36), before_part=None):
    """Solves the graph as keyframes come; returns the last solution and the keyframes that are left."""
    _, frames, poses = world
    left, content, known = [], GraphContent(), np.zeros((0, 4, 4))
    begin, solution = 0, None
    for end in parts:
        if before_part is not None:
            before_part(end)
        # As in the store: known ones at their solved poses, new ones where they were tracked.
        left, known = [*left, *frames[begin:end]], np.concatenate([known, poses[begin:end]])
        links = [Link(np.eye(4), False), *(Link(relative(known, i, i - 1), False) for i in range(1, len(left)))]
        problem = GraphProblem(links, known, content, {frames[0].camera: NOISE})
        solution = solver.solve(left, problem)
        content, update = solution
        left, known = kept(left, update), np.delete(update.poses, list(update.left_out), 0)
        begin = end
    return solution, left


def assert_same(one, other):
    (content, update), (other_content, other_update) = one, other
    assert np.array_equal(update.poses, other_update.poses)
    assert update.decisions == other_update.decisions and update.left_out == other_update.left_out
    assert content.tried == other_content.tried and content.done == other_content.done
    assert len(content.edges) == len(other_content.edges) > 0
    for edge, same in zip(content.edges, other_content.edges, strict=True):
        assert (edge.kind, edge.source, edge.target) == (same.kind, same.source, same.target)
        assert np.array_equal(edge.measured, same.measured) and np.array_equal(edge.information, same.information)


def test_the_function_that_the_process_runs_exists():
    """It is named by a string, as importing it would load torch."""
    module = importlib.import_module(solver_launch.SERVICE_MODULE)
    assert getattr(module, solver_launch.SERVICE_FUNCTION) is serve


def test_two_runs_after_each_other_are_solved_by_one_process(world, solved):
    want, left = solved
    assert len(left) < len(world[1])  # some are left out, so numbers change between solutions
    pids = []
    for _ in range(2):
        solver = SolverProcess(world[0])
        pids.append(solver._helper.process.pid)
        got, others = solve_in_parts(solver, world)
        assert_same(got, want)
        assert [keyframe.frame for keyframe in others] == [keyframe.frame for keyframe in left]
        solver.close()
        solver.close()
    assert pids[0] == pids[1] == SOLVERS.waiting.process.pid


def test_features_that_the_process_found_come_back(world):
    config, frames, poses = world
    fresh = [keyframe.changed() for keyframe in frames]
    for keyframe in fresh:
        keyframe.know_features(None)
    solver = SolverProcess(config)
    solve_in_parts(solver, (config, fresh, poses), parts=(12,))
    solver.close()
    found = [keyframe.found_features for keyframe in fresh[:12]]
    assert all(found_features is not None for found_features in found)
    for features, keyframe in zip(found, frames, strict=False):
        assert np.array_equal(features.descriptors, keyframe.features.descriptors)


def test_a_process_that_ends_is_done_without(world, solved):
    solver = SolverProcess(world[0])

    def end_second(end):
        if end == 24:
            os.kill(solver._helper.process.pid, signal.SIGKILL)
            solver._helper.process.wait()

    with pytest.warns(UserWarning, match="solves the keyframe graph ended by SIGKILL; this one does it from now on"):
        got, _ = solve_in_parts(solver, world, before_part=end_second)
    assert_same(got, solved[0])
    solver.close()
    assert SOLVERS.waiting is None


def test_a_failure_keeps_its_traceback_and_the_process_goes_on(world, solved):
    config, frames, poses = world
    solver = SolverProcess(config)
    no_noise = GraphProblem([Link(np.eye(4), False)] * 3, poses[:3], GraphContent(), {})
    with pytest.raises(RuntimeError, match="(?s)solving the keyframe graph failed:\n.*KeyError"):
        solver.solve(frames[:3], no_noise)
    assert_same(solve_in_parts(solver, world)[0], solved[0])
    solver.close()


def test_other_keyframes_after_a_state_was_loaded(world, solved):
    config, frames, poses = world
    solver = SolverProcess(config)
    solve_in_parts(solver, world, parts=(12, 24))
    loaded = [keyframe.changed() for keyframe in frames]
    assert_same(solve_in_parts(solver, (config, loaded, poses))[0], solved[0])
    solver.close()


def test_the_option_and_the_standby_decide():
    cuda = torch.device("cuda")
    assert isinstance(make_solver(settings("run.graph_solver=thread"), cuda, None), GraphSolver)
    assert isinstance(make_solver(settings(), cuda, None), GraphSolver)  # nobody started one
    SOLVERS.prepare()
    assert isinstance(make_solver(settings(), CPU, None), GraphSolver)
    solver = make_solver(settings(), cuda, None)
    assert isinstance(solver, SolverProcess) and SOLVERS.waiting is None
    solver.close()


def test_a_process_that_cannot_be_started_is_an_error_where_it_was_asked_for(monkeypatch):
    def fail(*_, **__):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(helper_process.subprocess, "Popen", fail)
    with pytest.raises(SpslamError, match=r"^run.graph_solver=process can't be used: .*run.graph_solver=thread uses"):
        make_solver(settings("run.graph_solver=process"), CPU, None)
    SOLVERS.prepare()  # is only an attempt
    assert SOLVERS.waiting is None


def test_the_process_ends_with_the_one_that_started_it():
    code = (
        "from spslam.slam.graph.solver_launch import SOLVERS; SOLVERS.prepare(); "
        "print(SOLVERS.waiting.process.pid, flush=True)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    stat, deadline = Path(f"/proc/{int(ran.stdout)}/stat"), time.monotonic() + PATIENCE_S
    while stat.exists() and stat.read_text().rsplit(")", 1)[1].split()[0] != "Z":
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_process_that_gave_way_is_not_left_to_the_next_run(world):
    solver = SolverProcess(world[0])
    process = solver._helper.process
    solver.give_way()
    solver.close()
    assert process.wait(60) is not None
    assert SOLVERS.waiting is None or SOLVERS.waiting.process is not process
