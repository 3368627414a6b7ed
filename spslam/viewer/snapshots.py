"""What the frame loop hands to the viewer's thread: clones on the device, which the thread fetches and converts."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.slam.frame_report import FrameReport
from spslam.slam.state import SlamState
from spslam.viewer.protocol import MapSnapshot, Row, Update, closed_loops

_STATUS = Path("/proc/self/statm")
_MB = 1 << 20


@dataclass(frozen=True)
class DeviceClone:
    """Tensors as they are at this place in the device's queue; taking them does not wait.

    Attributes:
        tensors: clones, on the device.
        taken: the stream that has them; None on the CPU, where they are there.
    """

    tensors: dict[str, torch.Tensor]
    taken: torch.cuda.Event | None

    @classmethod
    def take(cls, tensors: Mapping[str, torch.Tensor]) -> DeviceClone:
        """Clones the tensors, on the thread that changes them."""
        clones = {name: tensor.detach().clone() for name, tensor in tensors.items()}
        device = next((tensor.device for tensor in clones.values() if tensor.device.type == "cuda"), None)
        event = torch.cuda.current_stream(device).record_event() if device is not None else None
        return cls(clones, event)

    def fetch(self) -> dict[str, np.ndarray]:
        """The tensors as arrays, on any thread; waits for them but for no later work of the loop."""
        device = next((tensor.device for tensor in self.tensors.values() if tensor.device.type == "cuda"), None)
        with self._on_own_stream(device):
            return {name: tensor.cpu().numpy() for name, tensor in self.tensors.items()}

    @contextlib.contextmanager
    def _on_own_stream(self, device: torch.device | None) -> Iterator[None]:
        if device is None or self.taken is None:
            yield
            return
        stream = torch.cuda.Stream(device)
        stream.wait_event(self.taken)
        with torch.cuda.stream(stream):
            yield
        stream.synchronize()


@dataclass(frozen=True)
class PoseClone:
    """Poses of the run's frames number `first` and later.

    Attributes:
        first: number of the first one.
        clone: the poses.
    """

    first: int
    clone: DeviceClone

    @classmethod
    def take(cls, state: SlamState, first: int, last: int) -> PoseClone:
        """Clones those up to but without frame `last`."""
        return cls(first, DeviceClone.take({"poses": _poses(state)[first:last]}))

    def fetch(self) -> np.ndarray:
        """float32 [last - first, 7]."""
        return self.clone.fetch()["poses"]


@dataclass(frozen=True)
class UpdateDraft:
    """An `Update` as the loop leaves it.

    Attributes:
        reports: of the new frames.
        poses: theirs.
        fps: frames per second since the last draft. A single frame's time says little, as every fifth one is mapped.
        color, depth: see `Update`.
        log: lines of log.jsonl, of frames that have no report.
    """

    reports: Sequence[FrameReport]
    poses: PoseClone
    fps: float = math.nan
    color: np.ndarray | None = None
    depth: np.ndarray | None = None
    log: Sequence[Mapping[str, Any]] = ()

    def message(self) -> Update:
        """Fetches and converts."""
        memory_mb = _resident_mb()
        rows = [Row.of_log(line) for line in self.log] + [_row(report, self.fps, memory_mb) for report in self.reports]
        loops = closed_loops(self.log)
        loops += [(loop.source, loop.target) for report in self.reports for loop in report.loops if loop.accepted]
        return Update(self.poses.first, rows, self.poses.fetch(), self.color, self.depth, loops)


@dataclass(frozen=True)
class MapClone:
    """A `MapSnapshot` as the loop leaves it."""

    clone: DeviceClone

    @classmethod
    def take(cls, state: SlamState, frames: int) -> MapClone:
        """Clones the map, and the poses of the first `frames` frames."""
        return cls(DeviceClone.take({**state.scene.tensors(), "poses": _poses(state)[:frames]}))

    def message(self) -> MapSnapshot:
        """Fetches it."""
        arrays = self.clone.fetch()
        return MapSnapshot({name: array for name, array in arrays.items() if name != "poses"}, arrays["poses"])


def _poses(state: SlamState) -> torch.Tensor:
    """float32 [F, 7] of the run's frames, without the keyframes of a map that was opened."""
    return state.frames.poses[state.frames.opened :]


def _row(report: FrameReport, fps: float, memory_mb: float) -> Row:
    return Row(
        report.index,
        report.timestamp,
        report.lost,
        report.error_probability,
        report.fit.residual_cm,
        report.encode_ms > 0,
        report.relocalized,
        report.voxels,
        fps,
        memory_mb,
    )


def _resident_mb() -> float:
    try:
        pages = int(_STATUS.read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return math.nan
    return pages * os.sysconf("SC_PAGE_SIZE") / _MB
