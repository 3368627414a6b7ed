"""What the tests of the viewer show: a small finished run, and servers to connect to."""

from __future__ import annotations

import atexit
import contextlib
import functools
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.run.sequence import RunRequest, run_sequence
from spslam.viewer.model import RunInfo, RunModel
from spslam.viewer.options import ViewerOptions
from spslam.viewer.protocol import Row, Update
from spslam.viewer.replay import Replay, open_replay
from tests.system.sequences import settings

FRAMES = 12
CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
SIZES = ("dataset.width=160", "dataset.height=120")


@functools.cache
def finished_run() -> Path:
    """The output folder of a run over the generated room; made once."""
    made = Path(tempfile.mkdtemp(prefix="spslam-viewer-test-"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    folder = made / "run"
    run_sequence(RunRequest(settings(*SIZES, "run.previews=3"), None, folder, slice(0, FRAMES, 1)))
    return folder


@contextlib.contextmanager
def replay(**options: object) -> Iterator[Replay]:
    """A viewer of that run."""
    with open_replay(finished_run(), ViewerOptions(**{"port": 0, **options})) as opened:  # type: ignore[arg-type]
        yield opened


def connected(url: str, **headers: str) -> Any:
    """A web socket as the page opens it, to be used in `with`."""
    client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed: pip install '.[dev]'")
    viser = pytest.importorskip("viser", reason="viser is not installed: pip install 'spslam[viewer]'")
    kind = [f"viser-v{viser.__version__}"]
    address = url.replace("http", "ws")
    options = {"subprotocols": kind, "proxy": None, "max_size": None, "open_timeout": 90}
    return client.connect(address, additional_headers=headers, **options)


def row(frame: int, **values: object) -> Row:
    """A tracked frame."""
    plain = Row(frame, 0.1 * frame, False, 0.1, 0.5, frame % 5 == 0, False, 100, 10.0)
    return plain._replace(**values)


def straight(first: int, count: int) -> np.ndarray:
    """Poses float32 [count, 7] along x, 10 cm per frame."""
    poses = np.zeros((count, 7), np.float32)
    poses[:, 0], poses[:, 4] = 1, 0.1 * np.arange(first, first + count)
    return poses


def model(count: int, **values: object) -> RunModel:
    """The first `count` frames of a straight path."""
    made = RunModel(RunInfo("test", CAMERA, count, (0.1, 5.0)))
    made.update(Update(0, [row(frame, **values) for frame in range(count)], straight(0, count)))
    return made
