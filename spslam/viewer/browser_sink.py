"""The view in the browser: viser's server, the 3-D scene and the panel, kept up to date."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from spslam.viewer.gate import open_server, silence
from spslam.viewer.model import RunModel
from spslam.viewer.options import Listener
from spslam.viewer.panel import Panel
from spslam.viewer.player import Player
from spslam.viewer.scene_layers import SceneLayers
from spslam.viewer.sink import Key, Sink
from spslam.viewer.visitors import Visitors

if TYPE_CHECKING:
    from spslam.meshing.mesh import TriangleMesh
    from spslam.viewer.images import FrameImages

_SECONDS_BETWEEN_CURVES = 1.0


class BrowserSink(Sink):
    """Shows a run to all browsers that connect.

    Args:
        listener: where it listens.
        title: of the page.
        make_player: called with the model; what pause, step and slider act on.
    """

    def __init__(self, listener: Listener, title: str, make_player: Callable[[RunModel], Player]):
        self._server, self._gate = open_server(listener, title)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._make_player = make_player
        self._lock = threading.RLock()
        self._curves_due_s = 0.0
        self._model: RunModel | None = None
        self._layers: SceneLayers
        self._panel: Panel
        self._visitors: Visitors

    def begin(self, model: RunModel) -> None:
        with self._lock:
            self._layers = SceneLayers(self._server, model)
            self._panel = Panel(self._server, model, self._make_player(model), self._layers.set_visible)
            self._visitors = Visitors(self._server, model.info.name)
            self._model = model

    def show_frames(self) -> None:
        if self._model is not None and len(self._model):
            self.show(len(self._model) - 1)

    def show(self, frame: int) -> None:
        """Shows the run as of a frame."""
        model = self._model
        if model is None or not 0 <= frame < len(model):
            return
        with self._lock, model.lock:
            with self._server.atomic():
                self._layers.show_lines(frame)
                self._layers.show_camera(frame)
                self._panel.show_state(frame)
            self._visitors.follow(frame, model.poses[frame])
            if time.monotonic() >= self._curves_due_s:
                self._curves_due_s = time.monotonic() + _SECONDS_BETWEEN_CURVES
                self._panel.show_curves()

    def show_mesh(self, chunks: Mapping[Key, TriangleMesh | None]) -> None:
        with self._lock:
            self._layers.show_mesh(chunks)

    def show_images(self, images: FrameImages) -> None:
        with self._lock:
            self._layers.show_image(images.color)
            self._panel.show_images(images)

    def is_watched(self) -> bool:
        return self._gate.has_clients()

    def close(self) -> None:
        with silence():
            self._server.stop()

    @property
    def server(self) -> Any:
        """viser's."""
        return self._server
