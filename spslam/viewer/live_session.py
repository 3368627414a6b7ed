"""A live run as its viewer sees it: the model, the mesh and the images, each kept up as fast as it can be."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from spslam import ops
from spslam.datasets import open_dataset
from spslam.datasets.base import RgbdDataset, Subset
from spslam.errors import SpslamError
from spslam.meshing import Mesh
from spslam.scene import Scene
from spslam.viewer.images import FrameImages, read_images, reduced
from spslam.viewer.live_mesh import LiveMesh
from spslam.viewer.model import RunInfo, RunModel
from spslam.viewer.priority import Budget
from spslam.viewer.protocol import MapSnapshot, Request, RunBegins, Update
from spslam.viewer.sink import Sink
from spslam.viewer.worker import NewestWorker

# Of one core, all threads of the process together: where showing takes long, it is done less often.
_SHARE = 0.1
# Path and camera, which take little, go on while the processor time of a mesh is paid off; a mesh and images wait.
_FRAMES_DEBT_S, _MESH_DEBT_S, _IMAGES_DEBT_S = 0.5, 0.0, 0.1
_MESH_PAUSE_S, _IMAGE_PAUSE_S = 1.5, 1.0
_WATCH_S = 0.25  # until the next look whether anyone watches
_COMPLETION_S = 30.0


class _Shown(NamedTuple):
    """A frame whose images are to be shown."""

    row: int
    source_index: int
    pose: np.ndarray
    color: np.ndarray | None
    depth: np.ndarray | None


class LiveSession:
    """Takes a run's messages on one thread and works on them on others.

    Args:
        run: the message that began it.
        sinks: where it is shown.
        ask: passes a request to the run.
    """

    def __init__(self, run: RunBegins, sinks: Sequence[Sink], ask: Callable[[Request], None]):
        ops.set_num_threads(1)
        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        self._run, self._sinks, self._ask = run, sinks, ask
        options = run.config.dataset
        limits = options.min_depth_m, options.max_depth_m
        info = RunInfo(run.name, run.camera, run.total, limits, run.can_pause)
        self._model = RunModel(info, run.ground_truth)
        self._mesh = LiveMesh(run.camera, max(run.config.mesh.resolution_m, run.settings.voxel_size_m))
        self._dataset = _open_again(run)
        self._rendered: tuple[Scene, Mesh] | None = None
        for sink in sinks:
            sink.begin(self._model)
        self._ends = threading.Event()
        self._budget = Budget(_SHARE)
        self._frames: NewestWorker[bool] = NewestWorker(
            self._show_frames, "spslam-viewer-frames", self._rest_from_frames
        )
        self._maps = NewestWorker(self._show_map, "spslam-viewer-map", self._rest_from_map, spare_time_only=True)
        self._images = NewestWorker(
            self._show_images, "spslam-viewer-images", self._rest_from_images, spare_time_only=True
        )

    def update(self, update: Update) -> None:
        """New frames."""
        self._model.update(update)
        self._frames.submit(True)
        row = len(self._model) - 1
        index = int(np.nan_to_num(self._model.column("source_index")[row], nan=-1))
        self._images.submit(_Shown(row, index, self._model.poses[row].copy(), update.color, update.depth))

    def update_map(self, snapshot: MapSnapshot) -> None:
        """A newer map."""
        self._maps.submit(snapshot)

    def complete(self) -> None:
        """Returns when what came is shown, or after half a minute."""
        self._ends.set()
        deadline = time.monotonic() + _COMPLETION_S
        for worker in (self._frames, self._maps, self._images):
            worker.wait_until_idle(max(deadline - time.monotonic(), 0.0))

    def _show_frames(self, _: bool) -> None:
        for sink in self._sinks:
            sink.show_frames()

    def _rest_from_frames(self) -> None:
        self._budget.wait(_FRAMES_DEBT_S, self._ends)
        self._ask(Request(update=True))

    def _show_map(self, snapshot: MapSnapshot) -> None:
        self._model.set_poses(snapshot.poses)
        scene = Scene(self._run.settings, self._run.seed)
        scene.load_state_dict({name: torch.from_numpy(array) for name, array in snapshot.tensors.items()})
        made = self._mesh.update(scene, self._model.tracked_poses(len(snapshot.poses)))
        self._rendered = scene, Mesh(*self._mesh.merged())
        for sink in self._sinks:
            sink.show_mesh(made)
        self._frames.submit(True)

    def _rest_from_map(self) -> None:
        self._budget.wait(_MESH_DEBT_S, self._ends, _MESH_PAUSE_S)
        self._wait_until_watched()
        self._ask(Request(map=True))

    def _show_images(self, shown: _Shown) -> None:
        images: FrameImages | None = None
        if shown.color is not None:
            images = reduced(shown.row, shown.color, shown.depth)
        elif self._dataset is not None:
            images = read_images(self._dataset, shown.source_index, shown.row)
        if images is None:
            return
        if self._rendered is not None and len(self._rendered[1].faces):
            images = images.with_map(*self._rendered, self._run.camera, shown.pose)
        for sink in self._sinks:
            sink.show_images(images)

    def _rest_from_images(self) -> None:
        self._budget.wait(_IMAGES_DEBT_S, self._ends, _IMAGE_PAUSE_S)
        self._wait_until_watched()

    def _wait_until_watched(self) -> None:
        """Waits while nobody would see what is made."""
        while not any(sink.is_watched() for sink in self._sinks) and not self._ends.wait(_WATCH_S):
            pass


def _open_again(run: RunBegins) -> RgbdDataset | None:
    """The run's frames, to read those that are shown; None where they come with the updates."""
    if not run.can_read:
        return None
    try:
        dataset = open_dataset(run.config.dataset, run.data_dir)
        chosen = run.frames
        return dataset if chosen is None else Subset(dataset, chosen.start or 0, chosen.stop, chosen.step or 1)
    except SpslamError:
        return None
