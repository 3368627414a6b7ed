"""Keyframes and edges of the graph, as the state keeps them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from spslam.slam.graph.archive import KeyframeArchive
from spslam.slam.graph.content_tensors import content_of, content_tensors
from spslam.slam.graph.edges import Link
from spslam.slam.graph.image_pool import ImagePool
from spslam.slam.graph.keyframe import ArrivingKeyframe, Keyframe, KeyframeCamera
from spslam.slam.graph.keyframe_graph import GraphContent
from spslam.slam.graph.keyframe_tensors import (
    cameras_of,
    keyframe_tensors,
    keyframes_of,
    link_tensors,
    links_of,
    stacked,
)
from spslam.slam.graph.redundancy import Anchor, moved_anchors, with_anchors

NO_NOISE = torch.zeros((0, 4))


class KeyframeStore:
    """The graph's keyframes, what was measured between them, and the solution that is being made.

    Attributes:
        camera: of the keyframes that are added; those of an opened map may have others.
        links: of each keyframe to the one before; only that of new ones is used.
        anchors: of keyframes that were left out, ascending.
        content: edges, as of the last solution.
        begun: number of the frame at which the solution that is being made began; None where none is.
        start: float64 [K', 4, 4] poses of the keyframes at that frame.
        noise: float32 [4] of the sensor at that frame.
        target: float64 [K', 4, 4] the solution for which the map is being made again; None where it is not.
        opened_noise: float32 [4] of the sensors of an opened map's cameras.
        opened: the map that was opened, as it was; None without one.
    """

    def __init__(self, camera: KeyframeCamera):
        self.camera = camera
        self._keyframes: list[Keyframe] = []
        self._arriving: ArrivingKeyframe | None = None
        self._images: dict[KeyframeCamera, ImagePool] = {}
        self.links: list[Link] = []
        self.anchors: list[Anchor] = []
        self.content = GraphContent()
        self.begun: int | None = None
        self.start = np.zeros((0, 4, 4))
        self.noise = torch.zeros(4)
        self.target: np.ndarray | None = None
        self.opened_noise: dict[KeyframeCamera, torch.Tensor] = {}
        self.opened: KeyframeArchive | None = None

    @property
    def keyframes(self) -> list[Keyframe]:
        """In the order of their frames; waits for one that is on its way from the device."""
        self._settle()
        return self._keyframes

    @property
    def newest(self) -> int | None:
        """Number of the newest keyframe's frame, also while its images are on their way; None where there is none."""
        if self._arriving is not None:
            return self._arriving.frame
        return self._keyframes[-1].frame if self._keyframes else None

    @property
    def rows(self) -> np.ndarray:
        """int64 [K] numbers of the keyframes' frames."""
        return np.array([keyframe.frame for keyframe in self.keyframes], np.int64)

    @property
    def noises(self) -> dict[KeyframeCamera, torch.Tensor]:
        """float32 [4] of every camera's sensor, as of the last solution."""
        return {**self.opened_noise, self.camera: self.noise}

    def add(self, keyframe: Keyframe | ArrivingKeyframe, link: Link) -> None:
        """Appends a keyframe; its images move to a file that the system can put out of memory."""
        self._settle()
        if isinstance(keyframe, ArrivingKeyframe):
            self._arriving = keyframe
        else:
            self._keep(keyframe)
        self.links.append(link)

    def leave_out(self, out: Mapping[int, int], poses: np.ndarray) -> None:
        """Leaves out keyframes, given with their references, of the first K, at poses float64 [K, 4, 4].

        Nothing may read their images any more.
        """
        frames = [keyframe.frame for keyframe in self.keyframes]
        kept = [one for one in range(len(frames)) if one not in out]
        numbers = {one: number for number, one in enumerate(kept)}
        moved = moved_anchors(self.anchors, out, frames, poses)
        self.anchors = [replace(anchor, reference=numbers[anchor.reference]) for anchor in moved]
        for one in out:
            keyframe = self.keyframes[one]
            self._images[keyframe.camera].give_back(keyframe.depth, keyframe.intensity)
        self._keyframes, self.links = [self.keyframes[one] for one in kept], [self.links[one] for one in kept]

    def with_anchors(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers int64 [N], ascending, and poses float64 [N, 4, 4] of keyframes and those left out.

        Args:
            poses: float64 [K, 4, 4] of the keyframes.
        """
        if not self.anchors:
            return self.rows, poses
        frames, references = np.array([(anchor.frame, anchor.reference) for anchor in self.anchors], np.int64).T
        return with_anchors(self.rows, poses, (frames, references, np.stack([one.pose for one in self.anchors])))

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that a checkpoint needs, on the CPU."""
        content, cameras = self.content, [self.camera, *(one for one in self.opened_noise if one != self.camera)]
        return {
            **keyframe_tensors(self.keyframes, cameras),
            **link_tensors(self.links),
            "anchors": torch.tensor([(one.frame, one.reference) for one in self.anchors], dtype=torch.int64).view(
                -1, 2
            ),
            "anchor_poses": stacked([anchor.pose for anchor in self.anchors], 4),
            **content_tensors(content),
            "start": torch.from_numpy(self.start),
            "target": torch.from_numpy(np.zeros((0, 4, 4)) if self.target is None else self.target),
            "noise": torch.stack([self.noise, *(self.opened_noise[camera] for camera in cameras[1:])]),
            # Of a camera like the run's, which has a noise of its own.
            "opened_noise": self.opened_noise[self.camera][None] if self.camera in self.opened_noise else NO_NOISE,
            "numbers": torch.tensor([content.done, -1 if self.begun is None else self.begun]),
        }

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by a copy of what `tensors()` returned; raises ValueError for another camera's."""
        cameras = cameras_of(state["cameras"])
        if cameras[:1] != [self.camera]:
            raise ValueError("the keyframes are of another camera")
        self._keyframes, self._arriving = [], None
        self._images.clear()
        for keyframe in keyframes_of(state, cameras):
            self._keep(keyframe)
        self.links = links_of(state)
        anchored = zip(state["anchors"].tolist(), state["anchor_poses"].cpu().numpy().copy(), strict=True)
        self.anchors = [Anchor(frame, to, pose) for (frame, to), pose in anchored]
        done, begun = state["numbers"].tolist()
        self.content = content_of(state, done)
        self.begun = None if begun < 0 else begun
        self.start = state["start"].cpu().numpy().copy()
        self.target = state["target"].cpu().numpy().copy() if len(state["target"]) else None
        self.noise, *others = state["noise"].cpu().clone()
        self.opened_noise = dict(zip(cameras[1:], others, strict=True))
        for noise in state.get("opened_noise", NO_NOISE).cpu().clone():
            self.opened_noise[self.camera] = noise

    def _settle(self) -> None:
        if self._arriving is not None:
            arriving, self._arriving = self._arriving, None
            self._keep(arriving.arrived())

    def _keep(self, keyframe: Keyframe) -> None:
        camera = keyframe.camera
        if camera not in self._images:
            self._images[camera] = ImagePool(camera.camera.height, camera.camera.width)
        depth, intensity = self._images[camera].keep(keyframe.depth, keyframe.intensity)
        self._keyframes.append(keyframe.changed(depth=depth, intensity=intensity))
