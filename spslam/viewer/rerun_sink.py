"""A recording of a run for the rerun viewer: the same content as in the browser, over the run's frames and time."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spslam.camera import Camera
from spslam.geometry import matrix_to_pose7
from spslam.viewer import segments
from spslam.viewer.curves import Curve, known_curves
from spslam.viewer.model import RunModel
from spslam.viewer.protocol import unfinished
from spslam.viewer.segments import Segments
from spslam.viewer.sink import Key, Sink

if TYPE_CHECKING:
    from spslam.meshing.mesh import TriangleMesh
    from spslam.viewer.images import FrameImages

_LINE_PX = -1.5  # rerun's unit for widths on the screen is below 0
_FRUSTUM_M = 0.25
_BLOCK = 256  # segments of a line


class RerunSink(Sink):
    """Writes a recording; the file appears when it is complete.

    Args:
        path: `.rrd`; an earlier file there is replaced at the end.
        title: name of the recording.
    """

    def __init__(self, path: Path, title: str):
        import rerun

        self._rerun: Any = rerun
        self._path, self._temporary = path, unfinished(path, os.getpid())
        self._recording = rerun.RecordingStream(title)
        self._recording.save(self._temporary)
        self._lock = threading.RLock()
        self._model: RunModel | None = None
        self._logged = 0
        self._size = (0, 0)  # of the pinhole, width and height
        self._lengths: dict[str, int] = {}  # of the lines, in segments

    def begin(self, model: RunModel) -> None:
        with self._lock:
            self._model = model
            # Up is where the first camera's is: y points down.
            self._log("world", self._rerun.ViewCoordinates.RDF, static=True)
            self._log_pinhole(model.info.camera)

    def show_frames(self) -> None:
        model = self._model
        if model is None:
            return
        with self._lock, model.lock:
            first, self._logged = self._logged, len(model)
            curves = known_curves(model)
            for frame in range(first, len(model)):
                self._log_frame(model, frame, curves)
            self._set_time(len(model) - 1)
            for name, lines in self._lines(model).items():
                if len(lines) > self._lengths.get(name, 0):
                    self._log_lines(name, lines, self._lengths.get(name, 0))

    def show_mesh(self, chunks: Mapping[Key, TriangleMesh | None]) -> None:
        with self._lock:
            self._set_time(self._logged - 1)
            for key, mesh in chunks.items():
                name = "world/mesh/" + "_".join(map(str, key))
                if mesh is None:
                    self._log(name, self._rerun.Clear(recursive=False))
                else:
                    shape = self._rerun.Mesh3D(
                        vertex_positions=mesh.vertices,
                        triangle_indices=mesh.faces,
                        vertex_normals=mesh.normals,
                        vertex_colors=mesh.colors,
                    )
                    self._log(name, shape)

    def show_images(self, images: FrameImages) -> None:
        height, width = images.color.shape[:2]
        with self._lock:
            if self._model is not None and (width, height) != self._size:
                # An image fills the frustum only where the pinhole is of its size, to which it was reduced.
                self._log_pinhole(self._model.info.camera.resized(width, height))
            self._set_time(images.row)
            self._log("world/camera/image", self._rerun.Image(images.color).compress(80))
            if images.depth is not None:
                self._log("images/depth", self._rerun.DepthImage(images.depth, meter=1.0))
            if images.map_color is not None and images.map_depth is not None:
                self._log("images/map_color", self._rerun.Image(images.map_color).compress(80))
                self._log("images/map_depth", self._rerun.DepthImage(images.map_depth, meter=1.0))

    def close(self) -> None:
        """Writes all lines as they are in the end, completes the file and gives it its name."""
        with self._lock:
            model = self._model
            if model is not None and len(model):
                with model.lock:
                    self._set_time(len(model) - 1)
                    for name, lines in self._lines(model).items():
                        self._log_lines(name, lines, 0)
            self._recording.flush()
            self._recording.disconnect()
            if model is None:  # no run began
                self._temporary.unlink(missing_ok=True)
            else:
                os.replace(self._temporary, self._path)

    def _log_pinhole(self, camera: Camera) -> None:
        """The camera of all frames; static, so that the last one logged holds for the whole recording."""
        self._size = camera.width, camera.height
        pinhole = self._rerun.Pinhole(
            image_from_camera=camera.matrix(),
            width=camera.width,
            height=camera.height,
            image_plane_distance=_FRUSTUM_M,
        )
        self._log("world/camera", pinhole, static=True)

    def _log_frame(self, model: RunModel, frame: int, curves: Sequence[Curve]) -> None:
        self._set_time(frame)
        pose = matrix_to_pose7(model.poses[frame][None])[0]
        w, x, y, z = pose[:4]
        self._log("world/camera", self._rerun.Transform3D(translation=pose[4:], quaternion=[x, y, z, w]))
        for curve in curves:
            value = curve.scale * model.column(curve.column)[frame]
            if np.isfinite(value):
                self._log(f"curves/{curve.column}", self._rerun.Scalars(value))

    @staticmethod
    def _lines(model: RunModel) -> dict[str, Segments]:
        return {
            "path": segments.path(model, len(model)),
            "lost": segments.lost_stretches(model),
            "keyframes": segments.keyframes(model),
            "loops": segments.loops(model),
            "ground_truth": segments.ground_truth(model),
        }

    def _log_lines(self, name: str, lines: Segments, first: int) -> None:
        """The blocks of lines from segment `first` on.

        One block is one entity: logged as one, a line that grows with the run would be written whole again with each
        new segment; with an entity for each segment there would be very many.
        """
        self._lengths[name] = len(lines)
        for block in range(first // _BLOCK, -(-len(lines) // _BLOCK)):
            part = slice(block * _BLOCK, (block + 1) * _BLOCK)
            shape = self._rerun.LineStrips3D(lines.points[part], colors=lines.colors[part, 0], radii=_LINE_PX)
            self._log(f"world/{name}/{block}", shape)

    def _set_time(self, frame: int) -> None:
        self._recording.set_time("frame", sequence=max(frame, 0))
        if self._model is not None and 0 <= frame < len(self._model):
            self._recording.set_time("time", duration=float(self._model.column("timestamp")[frame]))

    def _log(self, name: str, what: Any, static: bool = False) -> None:
        self._recording.log(name, what, static=static)
