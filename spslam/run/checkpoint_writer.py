"""Asynchronous writing of checkpoints."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from spslam.config import Config
from spslam.slam.checkpoint import Snapshot, take_snapshot, write_snapshot
from spslam.slam.state import SlamState


class CheckpointWriter:
    """Writes one checkpoint at a time: on CUDA on a thread, from a snapshot on the device; on the CPU in the loop.

    On the CPU a thread would need a copy of the whole state, and would take cores from the kernels.

    Args:
        path: file of the checkpoint.
        threaded: whether to write on a thread.
    """

    def __init__(self, path: Path, threaded: bool):
        self.path, self.threaded = path, threaded
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None

    @property
    def is_busy(self) -> bool:
        """Whether the last checkpoint is still being written."""
        return self._thread is not None and self._thread.is_alive()

    def write(self, state: SlamState, config: Config, source: dict[str, Any], sync_log: Callable[[], None]) -> None:
        """Writes the current state. The log is flushed to disk before, so that it has the frames of every checkpoint.

        Args:
            state: after a complete frame.
            config: of the run.
            source: returned by `load_checkpoint`.
            sync_log: brings the log, which has the rows of all processed frames, to the disk.

        Raises:
            OutputError: this or the last checkpoint can't be written; the file of the one before is left unchanged.
        """
        self.wait()
        snapshot = take_snapshot(state, config, source, copy=self.threaded)
        if not self.threaded:
            _write(self.path, snapshot, sync_log)
            return
        device = state.scene.device
        taken = torch.cuda.current_stream(device).record_event() if device.type == "cuda" else None
        write = _on_own_stream(device, taken, lambda: _write(self.path, snapshot, sync_log))
        self._thread = threading.Thread(target=self._keep_error, args=(write,), name="spslam-checkpoint")
        self._thread.start()

    def wait(self) -> None:
        """Waits until the checkpoint is written; raises its error, if any."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def close(self) -> None:
        """The same as `wait`, for `contextlib.closing`."""
        self.wait()

    def _keep_error(self, write: Callable[[], None]) -> None:
        try:
            write()
        except BaseException as error:  # raised again by `wait`
            self._error = error


def _write(path: Path, snapshot: Snapshot, sync_log: Callable[[], None]) -> None:
    # The log must have the frames of every checkpoint, also after a power failure.
    sync_log()
    write_snapshot(path, snapshot)


def _on_own_stream(
    device: torch.device, taken: torch.cuda.Event | None, write: Callable[[], None]
) -> Callable[[], None]:
    """`write` on a new CUDA stream, which waits for the snapshot but not for later work of the loop."""
    if taken is None:
        return write

    def write_on_stream() -> None:
        stream = torch.cuda.Stream(device)
        stream.wait_event(taken)
        with torch.cuda.stream(stream):
            write()

    return write_on_stream
