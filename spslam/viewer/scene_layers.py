"""The 3-D scene in the browser: layers that can be switched, of which only what changed is sent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from spslam.geometry import matrix_to_pose7
from spslam.viewer import segments
from spslam.viewer.colors import CAMERA, RELOCALIZED, linear
from spslam.viewer.glb import to_glb
from spslam.viewer.model import RunModel
from spslam.viewer.segments import Segments
from spslam.viewer.sink import Key

if TYPE_CHECKING:
    from spslam.meshing.mesh import TriangleMesh

LAYERS = {
    "mesh": "Mesh",
    "camera": "Camera",
    "trajectory": "Trajectory",
    "lost": "Lost stretches",
    "keyframes": "Keyframes",
    "loops": "Loops",
    "relocalized": "Relocalized frames",
    "ground_truth": "Ground truth",
}
FRUSTUM_M = 0.25
_PIECE = 512  # segments of a line that are sent together
_WIDTH_PX = 3.0
_THIN_PX = 1.5
_POINT_M = 0.03
_AMBIENT = 1.0


class Line:
    """A long line in pieces; a piece is sent again only where it changed.

    Args:
        server: viser's.
        name: of the layer's node.
        width_px: on the screen.
    """

    def __init__(self, server: Any, name: str, width_px: float):
        self._server, self._name, self._width_px = server, name, width_px
        self._sent: dict[int, tuple[bytes, bytes]] = {}
        self._nodes: dict[int, Any] = {}

    def show(self, line: Segments) -> None:
        """Replaces the line."""
        pieces = math.ceil(len(line) / _PIECE)
        for number in range(pieces):
            part = slice(number * _PIECE, (number + 1) * _PIECE)
            points, colors = line.points[part], line.colors[part]
            content = points.tobytes(), colors.tobytes()
            if self._sent.get(number) != content:
                self._sent[number] = content
                self._nodes[number] = self._server.scene.add_line_segments(
                    f"{self._name}/{number}", points, linear(colors), thickness=self._width_px, thickness_units="screen"
                )
        for number in [number for number in self._nodes if number >= pieces]:
            self._nodes.pop(number).remove()
            self._sent.pop(number)


class SceneLayers:
    """Draws a run.

    Args:
        server: viser's.
        model: the frames.
    """

    def __init__(self, server: Any, model: RunModel):
        self._server, self._model = server, model
        self._roots = {name: server.scene.add_frame(f"/{name}", show_axes=False) for name in LAYERS}
        self._path = Line(server, "/trajectory", _WIDTH_PX)
        self._lost = Line(server, "/lost", _WIDTH_PX)
        self._keyframes = Line(server, "/keyframes", _THIN_PX)
        self._loops = Line(server, "/loops", _THIN_PX)
        self._truth = Line(server, "/ground_truth", _THIN_PX)
        self._frustum: Any = None
        self._relocalized: tuple[bytes, Any] = (b"", None)
        self._chunks: dict[Key, Any] = {}
        self._has_view = False

    def set_visible(self, layer: str, visible: bool) -> None:
        """Switches one of `LAYERS`."""
        self._roots[layer].visible = visible

    def show_lines(self, shown: int) -> None:
        """Draws everything but mesh and camera, as of frame `shown`."""
        self._path.show(segments.path(self._model, shown))
        self._lost.show(segments.lost_stretches(self._model))
        self._keyframes.show(segments.keyframes(self._model))
        self._loops.show(segments.loops(self._model))
        self._truth.show(segments.ground_truth(self._model))
        self._show_relocalized()

    def show_camera(self, shown: int) -> None:
        """Moves the frustum to frame `shown`."""
        pose = matrix_to_pose7(self._model.poses[shown][None])[0]
        if not self._has_view:
            self._set_view(self._model.poses[shown])
        if self._frustum is None:
            camera = self._model.info.camera
            self._frustum = self._server.scene.add_camera_frustum(
                "/camera/frustum",
                fov=2 * math.atan(camera.height / 2 / camera.fy),
                aspect=camera.width * camera.fy / (camera.height * camera.fx),
                scale=FRUSTUM_M,
                thickness=2.0,
                thickness_units="screen",
                color=CAMERA,
                jpeg_quality=80,
            )
        self._frustum.wxyz, self._frustum.position = pose[:4], pose[4:]

    def show_image(self, color: np.ndarray) -> None:
        """Puts an image, uint8 [h, w, 3] RGB, into the frustum."""
        if self._frustum is not None:
            self._frustum.image = color

    def show_mesh(self, chunks: Mapping[Key, TriangleMesh | None]) -> None:
        """Replaces chunks of the mesh."""
        for key, mesh in chunks.items():
            node = self._chunks.get(key)
            if mesh is None or not len(mesh.faces):
                if node is not None:
                    self._chunks.pop(key).remove()
            elif node is None:
                name = "/mesh/" + "_".join(map(str, key))
                self._chunks[key] = self._server.scene.add_glb(
                    name, to_glb(mesh), cast_shadow=False, receive_shadow=False
                )
            else:
                node.glb_data = to_glb(mesh)

    def _show_relocalized(self) -> None:
        model = self._model
        rows = np.flatnonzero((model.column("relocalized") > 0) & ~model.lost)
        points = model.poses[rows, :3, 3].astype(np.float32)
        if points.tobytes() != self._relocalized[0]:
            node = self._server.scene.add_point_cloud(
                "/relocalized/points", points, RELOCALIZED, point_size=_POINT_M, point_shape="circle"
            )
            self._relocalized = points.tobytes(), node

    def _set_view(self, pose: np.ndarray) -> None:
        """Up is where the first camera's was, and a new visitor looks over its shoulder."""
        self._has_view = True
        scene = self._server.scene
        up, forward, center = -pose[:3, 1], pose[:3, 2], pose[:3, 3]
        scene.set_up_direction(tuple(up))
        # The page's own surroundings light the shapes; with light from everywhere beside, colors are the map's.
        scene.configure_default_lights(False)
        scene.add_light_ambient("/ambient_light", intensity=_AMBIENT)
        self._server.initial_camera.up = tuple(up)
        self._server.initial_camera.position = tuple(center - 1.8 * forward + 0.9 * up)
        self._server.initial_camera.look_at = tuple(center + 0.8 * forward)
