"""A finished run in the browser, with a slider over its frames."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import numpy as np

from spslam.camera import Camera
from spslam.config import Config, load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import RgbdDataset
from spslam.errors import OutputError, SpslamError
from spslam.evaluation.run_output import RunOutput, match_times
from spslam.geometry import matrix_to_pose7
from spslam.meshing import Mesh
from spslam.meshing.mesh import TriangleMesh, compact, vertex_normals
from spslam.scene import Scene
from spslam.viewer.browser_sink import BrowserSink
from spslam.viewer.images import FrameImages, read_images, reduced
from spslam.viewer.live_mesh import CHUNK_M, split_mesh
from spslam.viewer.model import RunInfo, RunModel
from spslam.viewer.options import ViewerOptions, listen, require_viser
from spslam.viewer.player import ReplayPlayer
from spslam.viewer.protocol import Row, Update, closed_loops
from spslam.viewer.sink import Key
from spslam.viewer.worker import NewestWorker

_RATE_FRAMES = 20
_CLOSING_S = 5.0
# Of a run that saved no camera.
_ANY_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


class FrameSource:
    """The images of a finished run's frames: from its data where that is still there, else the saved previews.

    Args:
        run: the run.
    """

    def __init__(self, run: RunOutput):
        self._run = run
        self._dataset, self.indices = _data_of(run)
        self._previews = {preview.row: preview for preview in ([] if self._dataset else run.previews())}

    def read(self, row: int) -> FrameImages | None:
        """The images of a frame; of the nearest saved one where the data is gone; None where there is none."""
        if self._dataset is not None:
            return read_images(self._dataset, int(self.indices[row]), row) if self.indices[row] >= 0 else None
        if not self._previews:
            return None
        nearest = min(self._previews, key=lambda saved: abs(saved - row))
        return reduced(nearest, self._previews[nearest].color, self._previews[nearest].depth)


class Replay(contextlib.AbstractContextManager):
    """Shows a finished run until it is closed.

    Attributes:
        url: address to open in a browser.
        has_token: whether the address carries a token.
    """

    def __init__(self, run: RunOutput, options: ViewerOptions):
        """Use `open_replay`."""
        self._run, self._source = run, FrameSource(run)
        self._model = _model(run)
        mesh = run.mesh()
        self._rendered: tuple[Scene, Mesh] | None = None
        if mesh is not None and run.folder.map.is_file() and run.camera is not None:
            self._rendered = Scene.load(run.folder.map), mesh
        self._ended = threading.Event()
        self._failure: Exception | None = None
        self._player: ReplayPlayer | None = None
        listener = listen(options)
        self.url, self.has_token = listener.url, listener.token is not None
        self._sink = BrowserSink(listener, f"spslam view {run.folder.path.name}", self._make_player)
        self._frames = NewestWorker(self._guarded(self._show_frame), "spslam-viewer-frames")
        self._images = NewestWorker(self._guarded(self._show_images), "spslam-viewer-images")
        self._sink.begin(self._model)
        if mesh is not None:
            self._sink.show_mesh(_chunks(mesh))
        self.show(len(self._model) - 1)

    def show(self, frame: int) -> None:
        """Moves to a frame, 0 <= frame < F."""
        self._frames.submit(frame)
        self._images.submit(frame)

    def wait(self) -> None:
        """Returns when the replay was closed; raises what made it fail."""
        self._ended.wait()
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Ends the player, the workers and the server. May be called again."""
        self._ended.set()
        if self._player is not None:
            self._player.close()  # or it would go on to give the workers frames
        for worker in (self._frames, self._images):
            worker.close()
            worker.wait_until_idle(_CLOSING_S)
        self._sink.close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _make_player(self, model: RunModel) -> ReplayPlayer:
        self._player = ReplayPlayer(model.column("timestamp").copy(), self.show)
        return self._player

    def _show_frame(self, frame: int) -> None:
        self._sink.show(frame)

    def _show_images(self, frame: int) -> None:
        images = self._source.read(frame)
        if images is None:
            return
        if self._rendered is not None:
            pose = self._model.poses[images.row]
            images = images.with_map(*self._rendered, self._model.info.camera, pose)
        self._sink.show_images(images)

    def _guarded(self, work: Callable[[int], None]) -> Callable[[int], None]:
        """The same work; a failure ends the replay."""

        def guarded(frame: int) -> None:
            try:
                work(frame)
            except Exception as error:
                if not self._ended.is_set():
                    self._failure = error
                    self._ended.set()

        return guarded


def open_replay(output: Path, options: ViewerOptions) -> Replay:
    """Opens a viewer for a finished run.

    Args:
        output: its output folder.
        options: where to listen.

    Returns:
        The replay; use it as a context manager, which ends it.

    Raises:
        ViewerError: viser is missing, or the address can't be listened on.
        OutputError: the folder is not the output folder of a finished run, or a file in it is damaged.
    """
    require_viser()
    run = RunOutput.read(output)
    if not len(run.trajectory):
        raise OutputError(f"{output}: has a trajectory without a frame; there is nothing to show")
    return Replay(run, options)


def _model(run: RunOutput) -> RunModel:
    """The frames of the run; the log adds what the trajectory does not know."""
    trajectory = run.trajectory
    camera = run.camera or _ANY_CAMERA
    options = _options(run)
    limits = (0.0, 10.0) if options is None else (options.dataset.min_depth_m, options.dataset.max_depth_m)
    model = RunModel(RunInfo(run.folder.path.name, camera, len(trajectory), limits), _aligned_truth(run))
    lines = run.log if len(run.log) == len(trajectory) else [{}] * len(trajectory)
    rows = [
        Row.of_log(line)._replace(
            source_index=row, timestamp=float(trajectory.timestamps[row]), lost=bool(trajectory.lost[row])
        )
        for row, line in enumerate(lines)
    ]
    rates = _smoothed(np.array([row.fps for row in rows]))
    rows = [row._replace(fps=float(rate)) for row, rate in zip(rows, rates, strict=True)]
    model.update(Update(0, rows, matrix_to_pose7(trajectory.poses), loops=closed_loops(lines)))
    return model


def _smoothed(fps: np.ndarray) -> np.ndarray:
    """Frames per second over `_RATE_FRAMES` each: a single frame's says little, as every fifth one is mapped."""
    seconds = np.nan_to_num(1 / fps, nan=0.0)
    known = np.isfinite(fps).astype(float)
    window = np.ones(min(_RATE_FRAMES, len(fps)))
    counts, sums = np.convolve(known, window, "same"), np.convolve(seconds, window, "same")
    return np.divide(counts, sums, out=np.full(len(fps), np.nan), where=sums > 0)


def _aligned_truth(run: RunOutput) -> np.ndarray | None:
    return None if run.ground_truth is None else run.ground_truth.copy()


def _options(run: RunOutput) -> Config | None:
    try:
        return load_config(run.folder.config)
    except SpslamError:
        return None


def _data_of(run: RunOutput) -> tuple[RgbdDataset | None, np.ndarray]:
    """The dataset of the run and the index in it of each frame; none where the data is not where it was."""
    nothing = np.full(len(run.trajectory), -1)
    options = _options(run)
    if options is None:
        return None, nothing
    try:
        dataset = open_dataset(options.dataset)
        indices = match_times(dataset.timestamps(), run.trajectory.timestamps)
    except SpslamError:
        return None, nothing
    return (dataset, indices) if (indices >= 0).any() else (None, nothing)


def _chunks(mesh: Mesh) -> dict[Key, TriangleMesh]:
    """A mesh in cubes, so that a browser gets it in parts."""
    vertices = mesh.vertices.astype(np.float32)
    faces, used = compact(mesh.faces, len(vertices))
    vertices = vertices[used]
    whole = TriangleMesh(vertices, faces, mesh.colors[used], vertex_normals(vertices, faces))
    keys = np.floor(vertices[faces].mean(axis=1) / CHUNK_M).astype(np.int64)
    return dict(split_mesh(whole, np.unique(keys, axis=0), CHUNK_M))
