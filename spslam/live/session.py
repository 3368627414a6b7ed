"""A live run: from a camera to an output folder, as a run over a sequence leaves it."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam import ops
from spslam.config import dump_config
from spslam.errors import OutputError, SourceError, SpslamError
from spslam.image_library import images_shared
from spslam.io import atomic_write
from spslam.live.capture import Capture
from spslam.live.frame_queue import FrameQueue
from spslam.live.loop import LiveLoop, LiveProgress
from spslam.live.recorder import FolderRecorder
from spslam.live.request import LiveRequest
from spslam.live.source import LiveSource
from spslam.run.clock import RunClock
from spslam.run.device import explained_failures, resolve_device
from spslam.run.interruption import Interruption
from spslam.run.observer import ObservedRun, RunObserver
from spslam.run.output_folder import OutputFolder
from spslam.run.provenance import provenance
from spslam.run.request import RunRequest
from spslam.run.results import RunInput, write_results
from spslam.run.session import RunSession, with_absolute_path
from spslam.run.threads import kernel_threads_limited, library_threads_limited
from spslam.run.warm_up import warm_up
from spslam.slam.interpreter import interpreter_shared
from spslam.slam.system import SlamSystem
from spslam.trajectory import Trajectory

FRAME_THREADS = 4  # that share the extraction of a frame's image features beside a GPU


def run_live(
    request: LiveRequest,
    source: LiveSource,
    progress: LiveProgress | None = None,
    first_pose: np.ndarray | None = None,
    observer: RunObserver | None = None,
) -> dict[str, Any]:
    """Tracks and maps a camera's frames until it ends, or until Ctrl-C; then writes what `run_sequence` writes.

    Args:
        request: options and output folder.
        source: the camera; it is closed at the end.
        progress: called after each frame.
        first_pose: float64 [4, 4] T_world_camera of the first frame; where not given, by `scene.first_pose`, the
            `RgbdFrame.pose` of the frame that the map begins with, or the identity where it has none.
        observer: watches the run, as the viewer does (`spslam.viewer`); it can't pause it. It is told of a frame after
            its pose is, so that its latency does not count this; the next frame waits for it.

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: one line about what is wrong. If frames were tracked before, their results are written, and the
            line says so.
        KeyboardInterrupt: after a second Ctrl-C; results are then not written.
        Exception: what a source or `progress` of the program's own raised, after the results of the frames before are
            written.
    """
    with contextlib.ExitStack() as unused:
        unused.callback(source.close)  # where something fails before `Capture` takes it over
        return _run_on_device(request, source, progress, first_pose, observer, unused)


def _run_on_device(
    request: LiveRequest,
    source: LiveSource,
    progress: LiveProgress | None,
    first_pose: np.ndarray | None,
    observer: RunObserver | None,
    unused: contextlib.ExitStack,
) -> dict[str, Any]:
    device = resolve_device(request.config.device)
    with (
        library_threads_limited(),
        kernel_threads_limited(device, FRAME_THREADS),
        images_shared(ops.get_num_threads() if device.type == "cuda" else 1),
        interpreter_shared(),
        explained_failures(device),
    ):
        started = time.perf_counter()
        with contextlib.closing(SlamSystem(request.config, source.camera, first_pose, device)) as system:
            warm_up(request.config, source.camera, device)
            if device.type == "cuda":
                torch.cuda.reset_peak_memory_stats(device)
            folder = OutputFolder(Path(request.output_dir))
            with folder.locked(), _removed_if_empty(folder):
                _refuse_interrupted(folder)
                folder.create(resume=False)
                config = dump_config(with_absolute_path(system.config), provenance(system.config, device))
                atomic_write(folder.config, config)
                clock = RunClock(start_s=time.perf_counter() - started)
                at_truth = first_pose is None and request.config.scene.first_pose == "dataset"
                return _run(request, source, system, folder, progress, observer, clock, unused, at_truth)


def _refuse_interrupted(folder: OutputFolder) -> None:
    """A live run can't be resumed, so another advice than that of `OutputFolder.create` is needed."""
    if folder.config.exists() and not folder.metrics.exists():
        raise OutputError(f"{folder.path}: holds a run that did not end; use another --output")


def _run(
    request: LiveRequest,
    source: LiveSource,
    system: SlamSystem,
    folder: OutputFolder,
    progress: LiveProgress | None,
    observer: RunObserver | None,
    clock: RunClock,
    unused: contextlib.ExitStack,
    begins_at_truth: bool,
) -> dict[str, Any]:
    recorder = None
    if request.record_dir is not None:
        recorder = FolderRecorder(request.record_dir, source.camera, source.depth_scale)
    # Over the results too: nothing else has what they hold, so it takes a second Ctrl-C to leave them out.
    with Interruption() as interruption:
        with contextlib.ExitStack() as stack:
            if recorder is not None:
                stack.enter_context(recorder)
            if observer is not None:
                observer.begin(_observed(source, system), system.state)
            capture = stack.enter_context(Capture(source, FrameQueue(request.max_wait_s), recorder))
            unused.pop_all()
            loop = LiveLoop(system, capture, folder, clock, progress, observer, begins_at_truth)
            loop.run(interruption, request.seconds)
        metrics = _write(request, source, system, folder, loop)
    _raise_failure(loop, recorder, folder)
    return metrics


def _observed(source: LiveSource, system: SlamSystem) -> ObservedRun:
    """Its frames come once: the observer is given them, and nothing can wait for it."""
    truth = source.ground_truth
    return ObservedRun(source.name, system.config, source.camera, can_pause=False, ground_truth=truth)


def _write(
    request: LiveRequest, source: LiveSource, system: SlamSystem, folder: OutputFolder, loop: LiveLoop
) -> dict[str, Any]:
    """Writes the results; raises the camera's error where there are no frames."""
    status, capture = loop.status, loop.capture
    if status.frames == 0:
        failure = capture.failure if isinstance(capture.failure, SpslamError) else loop.failure
        if failure is not None:
            raise failure
        reason = f": {capture.failure}" if capture.failure else f"; {status.skipped} could not be used"
        raise SourceError(f"{source.name}: ended before a frame was tracked{reason}")
    timestamps = system.state.frames.timestamps.numpy()
    identity = {
        "folder": str(Path(request.data_dir).resolve()) if request.data_dir else "",
        "source": source.name,
        "frames": status.received,
        "timestamps": hashlib.sha256(timestamps.tobytes()).hexdigest()[:16],
    }
    figures: dict[str, Any] = {
        **status.latencies.figures(),
        "received_frames": status.received,
        "dropped_frames": status.dropped,
    }
    if capture.recorder is not None:
        figures |= {"recorded_frames": capture.recorder.frames, "unrecorded_frames": capture.recorder.left_out}
    run_request = RunRequest(request.config, request.data_dir, request.output_dir, mesh=request.mesh)
    session = RunSession(folder, identity, status.frames, 0, loop.clock)
    return write_results(system, _input(source, loop, timestamps), run_request, session, figures)


def _input(source: LiveSource, loop: LiveLoop, timestamps: np.ndarray) -> RunInput:
    poses = np.full((len(timestamps), 4, 4), np.nan)
    for row, pose in enumerate(loop.poses[: len(timestamps)]):
        if pose is not None:
            poses[row] = pose
    known = np.isfinite(poses).all((1, 2))
    if not known.any():
        return RunInput(source.name, None, None, loop.previews.frames())
    return RunInput(source.name, poses, Trajectory(timestamps[known], poses[known]), loop.previews.frames())


def _raise_failure(loop: LiveLoop, recorder: FolderRecorder | None, folder: OutputFolder) -> None:
    """Raises what went wrong although there are results; says where they are."""
    failure = loop.failure or loop.capture.failure or (recorder.failure if recorder else None)
    if failure is None:
        return
    if not isinstance(failure, SpslamError):
        raise failure
    results = f"the results of {loop.status.frames} frames are in {folder.path}"
    raise type(failure)(f"{failure}; {results}") from failure


@contextlib.contextmanager
def _removed_if_empty(folder: OutputFolder) -> Iterator[None]:
    """Removes the run's files again where it fails, or is ended, before a frame is logged: nobody could use them."""
    before = set(folder.path.iterdir())
    try:
        yield
    except BaseException:
        if not folder.log.is_file() or folder.log.stat().st_size == 0:
            for path in set(folder.files()) - before:
                path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                folder.path.rmdir()
        raise
