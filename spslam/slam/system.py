"""The SLAM system as programs use it: frames in; poses, trajectory and mesh out."""

import os
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.datasets.base import RgbdFrame
from spslam.datasets.frame_arrays import UNNUMBERED, check_frame, check_time
from spslam.errors import ConfigError
from spslam.geometry import pose7_to_matrix
from spslam.meshing import TriangleMesh, extract_mesh
from spslam.run_folder import RunFolder
from spslam.scene import Scene
from spslam.slam.arrival import FrameArrival
from spslam.slam.frame_pipeline import FramePipeline, PoseCallback
from spslam.slam.frame_report import FrameReport
from spslam.slam.graph.joining import MIN_LOOPS
from spslam.slam.interpreter import interpreter_shared
from spslam.slam.opened_map import check_settings, load_archive, map_settings, open_map
from spslam.slam.poses import check_first_pose
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.saved_system import SystemSettings, load_state, read_settings, save_system
from spslam.trajectory import Trajectory


class SlamSystem(FramePipeline):
    """Tracks and maps RGB-D frames, one `process` call each. Systems are independent of one another.

    `SlamSystem(config, camera, first_pose, device)`: see `FramePipeline` for the arguments.

    Example:
        >>> system = SlamSystem(load_config("folder"), camera)          # doctest: +SKIP
        >>> for frame in frames: print(system.process(frame).pose)      # doctest: +SKIP
        >>> system.finish()                                             # doctest: +SKIP
        >>> system.trajectory().save_tum("path.txt")                    # doctest: +SKIP
        >>> system.mesh().save("mesh.ply")                              # doctest: +SKIP
    """

    @interpreter_shared()
    def process(
        self, frame: RgbdFrame, on_pose: PoseCallback | None = None, defer_mapping: bool = False
    ) -> FrameReport:
        """Tracks and maps the next frame, and waits until the device is done with it.

        Args:
            frame: color, depth, timestamp; `RgbdFrame.from_arrays` makes one.
            on_pose: called once with the frame's pose as soon as it is known: `trajectory()` has the frame, and the map
                is optimized, only after it. Where it raises, the frame is left out (but the first).
            defer_mapping: leave the optimization to `optimize_map`, to be called while no frame waits; what is left of
                it is taken up by the next mapped frame. `finish`, `save` complete it.

        Returns:
            What happened to the frame. Its `pose` is None where it is lost.

        Raises:
            TypeError, ValueError: an image of another dtype, or not of the camera's size, or a time that is no finite
                number. Nothing was done.
            SpslamError: the map or the pixels would pass a limit of the configuration. The frame has then been
                processed in part, and the system must not be given another.
        """
        check_frame("SlamSystem.process", frame.color, frame.depth, self.camera)
        check_time("SlamSystem.process", frame.timestamp)
        if frame.index == UNNUMBERED:
            frame = replace(frame, index=self.state.frames.processed)
        return self.submit(self.prepare(frame), on_pose, defer_mapping).result()

    def prepare(self, frame: RgbdFrame) -> PreparedFrame:
        """The next frame as `submit` takes it; its images are checked already."""
        return self._arrival.prepare(frame, self.state.frames.processed, self.features.are_expected)

    def close(self) -> None:
        """Ends helper threads and processes; no frame can follow, unless after `reset`."""
        if "_arrival" in vars(self):
            self._arrival.close()
            del self._arrival
        super().close()

    @cached_property
    def _arrival(self) -> FrameArrival:
        return FrameArrival(self.config, self.camera, self.device)

    def begin_at(self, first_pose: np.ndarray) -> None:
        """Says where the next frame is, if the map begins with it: no frame before could be used.

        Args:
            first_pose: float64 [4, 4] T_world_camera. No effect where a number isn't finite, or once there is a map.

        Raises:
            ValueError, DatasetError: as of the system's first pose.
        """
        if self._has_map or not np.isfinite(first_pose).all():
            return
        check_first_pose(first_pose)
        self.first_pose = np.array(first_pose, np.float64)
        self.state.scene.origin = torch.from_numpy(self.first_pose[:3, 3].copy())

    def open_map(self, folder: str | os.PathLike) -> None:
        """Goes on in the map of a finished run; call it before the first frame.

        Frames are lost until the camera is found in the map, by image features and all that verifies a lost frame; from
        then on the poses are in the map's world, and the map grows. The finished run is not changed.

        Args:
            folder: output folder of the run.

        Raises:
            OutputError: the folder is not that of a finished run with a keyframe graph, its map has a single keyframe,
                or a file is damaged.
            ConfigError: an option by which the maps can't be one.
            ValueError: frames were processed already.
        """
        if len(self.state.frames):
            raise ValueError("SlamSystem.open_map: must be called before the first frame")
        if self.state.graph is None:
            raise ConfigError("a map can be opened with graph.enabled=true and prior.enabled=true only")
        if not self.config.tracking.features:
            raise ConfigError("a map can be opened with tracking.features=true only: they find the camera")
        path = Path(folder)
        archive = load_archive(RunFolder(path), MIN_LOOPS)
        check_settings(path, archive, self.map_settings())
        open_map(self.state, Scene.load(RunFolder(path).map, self.device), archive)

    def map_settings(self) -> dict[str, Any]:
        """What must be alike in maps that are joined, by option."""
        return map_settings(self.config, self._prior)

    def trajectory(self) -> Trajectory:
        """Poses of all frames as they are refined up to now."""
        frames, first = self.state.frames, self.state.frames.opened
        timestamps, lost = (column[first:].numpy().copy() for column in (frames.timestamps, frames.lost))
        return Trajectory(timestamps, frames.matrices(first), lost)

    def segments(self) -> list[Trajectory]:
        """Poses of frames that are lost in `trajectory()`, but known among themselves.

        Each is of a map that was begun while the camera was lost, and has its first frame's axes. One that is joined
        with the map later is part of `trajectory()` instead.
        """
        frames, found = self.state.frames, []
        for each in self.state.unjoined:
            kept = frames.lost[each.rows]
            times, poses = frames.timestamps[each.rows][kept].numpy(), each.poses[kept].double().numpy()
            found.append(Trajectory(times, pose7_to_matrix(poses)))
        return [each for each in found if len(each)]

    def mesh(self, resolution_m: float | None = None) -> TriangleMesh:
        """The colored mesh of the map as it is now; frames can follow.

        Args:
            resolution_m: edge of a marching-cubes cell, m; `mesh.resolution_m` of the options where not given.

        Returns:
            In the trajectory's world, without surface that no tracked frame sees; empty before the first frame.

        Raises:
            ValueError: `resolution_m` is not positive.
            SpslamError: it is too small for the size of the map.
        """
        trajectory = self.trajectory()
        resolution_m = self.config.mesh.resolution_m if resolution_m is None else resolution_m
        return extract_mesh(self.state.scene, resolution_m, self.camera, trajectory.poses[~trajectory.lost])

    def save(self, path: str | os.PathLike) -> None:
        """Writes the whole system, from which `load` goes on as this one would; one file, written atomically.

        Raises:
            OutputError: the file can't be written; one that was there is left as it was.
        """
        self.optimize_map()
        save_system(Path(path), self.state, SystemSettings(self.config, self.camera, self.first_pose))

    @classmethod
    def load(cls, path: str | os.PathLike, device: torch.device | str = "cpu") -> "SlamSystem":
        """A system as it was when `save` wrote it: map, trajectory, options and camera.

        Args:
            path: the file.
            device: where the map lives from now on.

        Raises:
            OutputError: no such file, a damaged one, or one of another version's options.
        """
        settings = read_settings(Path(path))
        system = cls(settings.config, settings.camera, settings.first_pose, device)
        load_state(Path(path), system.state, settings.config)
        return system

    def __repr__(self) -> str:
        frames, lost = self.state.frames.processed, int(self.state.frames.lost.sum())
        size = f"{self.camera.width}x{self.camera.height}"
        voxels = self.state.scene.volume.num_voxels
        return f"SlamSystem({size}, {self.device}, {frames} frames ({lost} lost), {voxels} voxels)"
