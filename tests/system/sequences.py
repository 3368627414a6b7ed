"""Small sequences and settings for the tests of the whole system."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from spslam.config import Config, load_config
from spslam.datasets import registry
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.generated import GeneratedDataset
from spslam.run.sequence import RunRequest, run_sequence
from tests.datasets.layouts import matrix_text, write_color, write_depth

WIDTH, HEIGHT = 160, 120
FAST_SETTINGS = ("mapping.first_iterations=30", "run.previews=0", "run.prefetch_workers=1")

Change = Callable[[RgbdFrame], None]


@functools.cache
def _rendered(count: int) -> tuple[GeneratedDataset, list[RgbdFrame]]:
    room = GeneratedDataset(count, WIDTH, HEIGHT)
    return room, [room[i] for i in range(count)]


class Recorded(RgbdDataset):
    """The generated room's first frames, rendered once; `change(frame)` may modify a copy, or raise."""

    name = "recorded"

    def __init__(
        self, count: int, change: Change | None = None, known_poses: bool = True, is_random_access: bool = False
    ) -> None:
        self.is_random_access = is_random_access
        self.room, frames = _rendered(max(count, 25))
        self.frames, self.change, self.known_poses = frames[:count], change, known_poses
        self.camera = self.room.camera

    def __len__(self) -> int:
        return len(self.frames)

    def timestamps(self) -> np.ndarray:
        return self.room.timestamps()[: len(self)]

    def poses(self) -> np.ndarray | None:
        return self.room.poses()[: len(self)] if self.known_poses else None

    def read(self, index: int) -> RgbdFrame:
        source = self.frames[index]
        frame = RgbdFrame(index, source.timestamp, source.color.copy(), source.depth.copy(), source.pose)
        if self.change:
            self.change(frame)
        return frame


def settings(*overrides: str, preset: str | None = None) -> Config:
    """The generated room's configuration, with fewer first iterations."""
    return load_config("demo", preset, [*FAST_SETTINGS, *overrides])


def without_depth(*indices: int) -> Change:
    """Frames in which no pixel has depth."""

    def change(frame: RgbdFrame) -> None:
        if frame.index in indices:
            frame.depth[:] = 0

    return change


def run_on(monkeypatch, dataset: RgbdDataset, output: Path, *overrides: str, **arguments) -> dict:
    """`run_sequence` over a dataset made by a test; returns the metrics."""
    config = settings(*overrides, preset=arguments.pop("preset", None))
    monkeypatch.setattr(registry, "open_dataset", lambda *_: dataset)
    progress = arguments.pop("progress", None)
    return run_sequence(RunRequest(config, None, output, **{"mesh": False, **arguments}), progress)


def write_room(scene: Path, count: int) -> Path:
    """The same frames as a folder in the layout of 7-Scenes."""
    dataset = Recorded(count)
    for i, frame in enumerate(dataset.frames):
        stem = scene / "seq-01" / f"frame-{i:06d}"
        write_color(Path(f"{stem}.color.png"), frame.color)
        write_depth(Path(f"{stem}.depth.png"), frame.depth)
        Path(f"{stem}.pose.txt").write_text(matrix_text(frame.pose))
    (scene / "camera-intrinsics.txt").write_text(matrix_text(dataset.camera.matrix()))
    return scene


def results(output: Path) -> tuple[bytes, bytes]:
    """The bytes of trajectory and map."""
    return (output / "trajectory.txt").read_bytes(), (output / "map.safetensors").read_bytes()
