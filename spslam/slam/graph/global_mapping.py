"""When the graph is solved and the map made again: beside tracking, at fixed frames, so that results are the same.

A solution begins at a frame and is taken up `graph.every` frames later, whether it took long or not; where it moves a
keyframe by more than `graph.min_change_m`, the map is made again for it, and both are adopted between two frames, a
number of frames later that grows with the keyframes. A live run waits for nothing: it takes up what is ready. The
thread that works on it, and has another process solve the graph where there is one, shares nothing with the loop but
what neither changes.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import takewhile
from typing import Any

import numpy as np
import torch

from spslam.config import Config
from spslam.geometry import compose, inverse, matrix_to_pose7, pose7_to_matrix, rotation_angle
from spslam.prior import Prior
from spslam.scene import SparseVolume
from spslam.slam.device_events import DeviceEvent, event_recorder, fetch
from spslam.slam.fit import prediction_error
from spslam.slam.graph.edges import Link, LoopDecision
from spslam.slam.graph.joining import Component, find_frame
from spslam.slam.graph.keyframe import NEAR_SHARE, ArrivingKeyframe, Keyframe
from spslam.slam.graph.keyframe_graph import GraphUpdate
from spslam.slam.graph.keyframe_store import KeyframeStore
from spslam.slam.graph.registration import Registrar
from spslam.slam.graph.remap import (
    corrected_poses,
    empty_volume,
    encode_keyframe,
    encode_keyframes,
    handed_over,
    own_stream,
)
from spslam.slam.graph.solver import GraphProblem, GraphSolution
from spslam.slam.graph.solver_process import make_solver
from spslam.slam.host_threads import give_way, host_threads
from spslam.slam.pixels import FramePixels
from spslam.slam.state import SlamState

AHEAD_M = 2.0  # a turn by an angle moves what is seen by so much times the angle
# Where it falls behind for so many turns, a live run waits for it for so long after each frame, and drops frames rather
# than let the keyframes grow that wait for their edges.
OVERDUE_TURNS, OVERDUE_WAIT_S = 2, 0.03
ENCODED_AT_ONCE = 1  # keyframes that a live run encodes when it adopts a map; it waits for that


class GlobalMapping:
    """Keeps the keyframe graph of a state.

    Args:
        config: options of the run.
        prior: makes the map.
        state: of the system.
        store: the graph's part of the state.
    """

    def __init__(self, config: Config, prior: Prior, state: SlamState, store: KeyframeStore):
        self._config, self._prior, self._state, self._store = config, prior, state, store
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="spslam-graph")
        self._pool = host_threads(state.scene.device)
        self._solver = make_solver(config, state.scene.device, self._pool)
        self._worker.submit(self._solver.prepare)
        self._running: Future[Any] | None = None  # None also after the state was loaded
        self._abandoned = threading.Event()  # of the map that is being made again
        # The newest keyframe's number, the state's stamp when its pose was read, and that pose's seven numbers.
        self._reference: tuple[int, int, Sequence[float]] | None = None
        self._coming: tuple[int, torch.Tensor, DeviceEvent] | None = None  # the same on its way to the host
        self._next = 0  # number of the frame at which a live run may begin another solution
        self._taken_up = 0  # number of the frame after which it took up something last
        self._gives_way = False

    def close(self) -> None:
        """Ends the thread, once it is done with what it does."""
        self._abandoned.set()
        self._worker.shutdown(wait=True, cancel_futures=True)
        self._solver.close()
        if self._pool is not None:
            self._pool.shutdown(wait=True)

    def is_due(self, number: int) -> bool:
        """Whether `before_frame` does anything before frame `number`."""
        return number > 0 and number % self._config.graph.every == 0

    def adopts(self, number: int) -> bool:
        """Whether `before_frame` puts another map in place before frame `number`."""
        begun, target = self._store.begun, self._store.target
        return self.is_due(number) and begun is not None and target is not None and number >= self._due(begun, target)

    def before_frame(self, number: int) -> tuple[LoopDecision, ...]:
        """Takes up what is due before frame `number` and begins what comes next; returns decisions on loops."""
        store = self._store
        decisions: tuple[LoopDecision, ...] = ()
        if store.begun is not None and store.target is None:
            decisions = self._take_up_solution(number)
        elif store.target is not None and self.adopts(number):
            self._adopt(store.target, self._remade_volume(store.target))
            store.begun = store.target = None
        if store.begun is None:
            self._begin(number)
        return decisions

    def take_up_ready(self, number: int) -> tuple[LoopDecision, ...]:
        """What `before_frame` does, without waiting: what is not ready is taken up after a later frame."""
        store = self._store
        if not self._gives_way:
            self._gives_way = True
            self._worker.submit(_give_way)
            self._solver.give_way()
        if self._running is not None and not self._running.done():
            is_overdue = number - self._taken_up > OVERDUE_TURNS * self._config.graph.every
            if not is_overdue or wait([self._running], OVERDUE_WAIT_S).not_done:
                return ()
        self._taken_up = number
        if store.begun is None:
            if number >= self._next:
                self._begin(number)
                self._next = number + self._config.graph.every
        elif store.target is None:
            if self._running is not None:
                return self._take_up_solution(number)
            self._running = self._worker.submit(self._solution(store.start))  # after the state was loaded
        else:
            self._adopt_ready(store.target)
        return ()

    def before_tracking(self) -> None:
        """Sends the newest keyframe's pose to the host, for `after_frame`: tracking waits for the device anyway."""
        newest, self._coming = self._store.newest, None
        if newest is not None and not self._knows_last_pose():
            pose = fetch(self._state.frames.poses[newest])
            self._coming = newest, pose, event_recorder(self._state.scene.device)()

    def after_frame(self, number: int, pixels: FramePixels, pose: Sequence[float]) -> None:
        """Makes the newest frame a keyframe if it is far enough from the last one; else waits for no device.

        Args:
            number: of the frame.
            pixels: of the frame.
            pose: seven numbers of the frame's T_world_camera; every frame asks, and most need no matrix.
        """
        state, store, last = self._state, self._store, self._store.newest
        if last is None:
            store.add(ArrivingKeyframe.of(number, pixels, store.camera), Link(np.eye(4), False))
            return
        known = self._last_pose(last)
        if self._is_far(known, pose):
            moved = inverse(pose7_to_matrix(np.array(known))) @ pose7_to_matrix(np.array(pose))
            relocalized = bool(state.frames.lost[last:number].any()) or last < state.frames.opened
            store.add(ArrivingKeyframe.of(number, pixels, store.camera), Link(moved, relocalized))
            self._reference = number, state.stamp, pose

    def newest_pose(self) -> np.ndarray:
        """float64 [4, 4] T_world_camera of the newest keyframe; identity where there is none."""
        rows = self._store.rows
        return self._state.frames.matrices()[rows[-1]] if len(rows) else np.eye(4)

    def take_in(self, keyframes: Sequence[Keyframe], links: Sequence[Link], poses: Sequence[np.ndarray]) -> None:
        """Appends keyframes that were made elsewhere, and maps them.

        Args:
            keyframes: K, newer than those known.
            links: of each to the one before.
            poses: K of float64 [4, 4] T_world_camera.
        """
        state, prior = self._state, self._prior.to(self._state.scene.device)
        for keyframe, link, pose in zip(keyframes, links, poses, strict=True):
            self._store.add(keyframe, link)
            encode_keyframe(state.scene.volume, keyframe, pose, prior, self._config)
        if keyframes:
            state.replace_volume(state.scene.volume)

    def find(self, number: int, pixels: FramePixels) -> np.ndarray | None:
        """Where frame `number` is in the map that was opened, float64 [4, 4] T_world_camera; None where nobody knows.

        Args:
            number: of the frame.
            pixels: of the frame.
        """
        store, unknown = self._store, self._state.noise.model.cpu()
        noises = {store.camera: unknown, **store.opened_noise}
        registrar = Registrar.of_config(self._config, noises, self._state.scene.device, self._pool)
        known = Component(store.keyframes, self._keyframe_poses())
        return find_frame(registrar, Keyframe.of(number, pixels, store.camera), known, number)

    def finish(self) -> bool:
        """Solves once more with all keyframes and adopts it; returns whether the map was made again."""
        store = self._store
        if store.begun is not None and store.target is None:
            self._solved()
        self._abandoned.set()
        self._abandoned = threading.Event()
        store.begun = store.target = self._running = None
        if len(store.keyframes) < 2:
            return False
        store.noise = self._state.noise.model.cpu().clone()
        before = self._keyframe_poses()
        solved = self._solution(before)
        update = self._taken(self._worker.submit(solved).result())
        again = _change(before, update.poses) > self._config.graph.min_change_m
        target = _kept(update)
        self._adopt(target, self._remade(target)() if again else None)
        return again

    def _begin(self, number: int) -> None:
        """Begins a solution at frame `number` if there are new keyframes."""
        store = self._store
        if len(store.keyframes) > max(store.content.done, 1):
            store.begun, store.start = number, self._keyframe_poses()
            store.noise = self._state.noise.model.cpu().clone()
            self._running = self._worker.submit(self._solution(store.start))

    def _adopt_ready(self, target: np.ndarray) -> None:
        """Adopts the map that is ready, if next to all keyframes are in it; else has the thread add the others."""
        store = self._store
        if self._running is None:
            self._running = self._worker.submit(self._remade(target))  # after the state was loaded
        elif len(store.keyframes) - len(target) > ENCODED_AT_ONCE:
            volume, self._running = self._running.result(), None
            store.target = self._moved(target)
            self._running = self._worker.submit(self._remade(store.target, volume, len(target)))
        else:
            self._adopt(target, self._remade_volume(target))
            store.begun = store.target = None

    def _knows_last_pose(self) -> bool:
        """Whether the newest keyframe's pose is as it was last read: only mapping moves it."""
        if self._reference is None or self._reference[0] != self._store.newest:
            return False
        return self._reference[1] == self._state.stamp or self._config.mapping.pose_rate == 0

    def _last_pose(self, newest: int) -> Sequence[float]:
        """Seven numbers of T_world_camera of the newest keyframe, that of frame `newest`."""
        if self._reference is None or not self._knows_last_pose():
            if self._coming is not None and self._coming[0] == newest:
                _, pose, sent = self._coming
                sent.wait()
            else:
                pose = self._state.frames.poses[newest].cpu()
            self._reference = newest, self._state.stamp, pose.tolist()
        return self._reference[2]

    def _is_far(self, known: Sequence[float], pose: Sequence[float]) -> bool:
        """Whether a pose is to be a keyframe's, `known` being that of the newest one."""
        graph = self._config.graph
        distance_cm, angle_deg = prediction_error(known, pose)
        if angle_deg > graph.max_rotation_deg:
            return True
        distance = distance_cm / 100
        if distance > graph.max_translation_m:
            return True
        return distance > NEAR_SHARE * self._store.keyframes[-1].median_m

    def _keyframe_poses(self) -> np.ndarray:
        return pose7_to_matrix(self._state.frames.poses[self._store.rows].cpu().double().numpy())

    def _due(self, begun: int, target: np.ndarray) -> int:
        """The frame at which a map is adopted: to encode a keyframe takes about as long as to track a frame."""
        every = self._config.graph.every
        return begun + every * -(-len(target) // every)

    def _solved(self) -> GraphUpdate:
        """Waits for the solution that is being made, and takes its content over."""
        running, self._running = self._running, None
        return self._taken((running or self._worker.submit(self._solution(self._store.start))).result())

    def _taken(self, solution: GraphSolution) -> GraphUpdate:
        self._store.content, update = solution
        self._store.leave_out(update.left_out, update.poses)
        return update

    def _remade_volume(self, target: np.ndarray) -> SparseVolume:
        """The map that is being made again; waits for it."""
        running, self._running = self._running, None
        return self._remade(target)() if running is None else running.result()

    def _solution(self, poses: np.ndarray) -> Callable[[], GraphSolution]:
        """What solves the graph of the first K keyframes from their poses float64 [K, 4, 4], on any thread."""
        store, count = self._store, len(poses)
        problem = GraphProblem(store.links[:count], poses, store.content, store.noises)
        return functools.partial(self._solver.solve, store.keyframes[:count], problem)

    def _remade(
        self, poses: np.ndarray, volume: SparseVolume | None = None, first: int = 0
    ) -> Callable[[], SparseVolume]:
        """What makes the map of the first K keyframes at poses float64 [K, 4, 4], on any thread.

        A volume that has the first ones already is gone on with.
        """
        poses, keyframes = poses[first:], self._store.keyframes[first : len(poses)]
        scene, prior, abandoned = self._state.scene, self._prior.to(self._state.scene.device), self._abandoned

        def make() -> SparseVolume:
            with own_stream(scene.device):
                made = empty_volume(scene) if volume is None else volume
                posed = takewhile(lambda _: not abandoned.is_set(), zip(keyframes, poses, strict=True))
                encode_keyframes(made, posed, prior, self._config, self._pool)
            return made

        return make

    def _take_up_solution(self, number: int) -> tuple[LoopDecision, ...]:
        store = self._store
        update = self._solved()
        store.begun = None
        if _change(store.start, update.poses) > self._config.graph.min_change_m:
            store.begun, store.target = number, _kept(update)
            self._running = self._worker.submit(self._remade(store.target))
        return update.decisions

    def _moved(self, solved: np.ndarray) -> np.ndarray:
        """Poses float64 [K, 4, 4] of all keyframes; those after the first K' follow the last of these."""
        poses = self._keyframe_poses()
        correction = compose(solved[-1], inverse(poses[len(solved) - 1]))
        return np.concatenate([solved, compose(correction, poses[len(solved) :])])

    def _adopt(self, solved: np.ndarray, volume: SparseVolume | None) -> None:
        """Moves keyframes to poses float64 [K', 4, 4], all frames with them, and puts the new map in place."""
        state, store = self._state, self._store
        known, moved = state.frames.matrices(), self._moved(solved)
        rows, moved_rows = store.with_anchors(moved)
        frames = torch.from_numpy(matrix_to_pose7(corrected_poses(known, rows, moved_rows)))
        state.frames.poses.copy_(frames.to(state.frames.poses))
        self._reference = None
        if volume is None:
            return
        volume, prior = handed_over(volume), self._prior.to(state.scene.device)
        for keyframe, pose in zip(store.keyframes[len(solved) :], moved[len(solved) :], strict=True):
            encode_keyframe(volume, keyframe, pose, prior, self._config)
        state.replace_volume(volume)


def _kept(update: GraphUpdate) -> np.ndarray:
    """Poses float64 [K', 4, 4] of the keyframes that were not left out."""
    return np.delete(update.poses, list(update.left_out), 0)


def _give_way() -> None:
    """Lets this thread's work wait for that of the process's others, where the system can."""
    give_way(threading.get_native_id())  # under Linux each thread has a priority of its own


def _change(before: np.ndarray, after: np.ndarray) -> float:
    """By how much poses, or what they see ahead, have moved at most, m."""
    moved = compose(inverse(before), after)
    distance = np.linalg.norm(moved[:, :3, 3], axis=1) + AHEAD_M * rotation_angle(moved[:, :3, :3])
    return float(distance.max(initial=0.0))
