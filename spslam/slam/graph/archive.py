"""What a finished run keeps, so that its map can be opened again and joined with others: keyframes and trajectories.

One safetensors file beside the map. A map may be of several recordings, whose frames are numbered one after the other.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.camera import Camera
from spslam.errors import OutputError, brief
from spslam.geometry import compose, inverse
from spslam.slam.graph.edges import GraphEdge, Link
from spslam.slam.graph.keyframe import Keyframe, KeyframeCamera
from spslam.slam.graph.keyframe_tensors import (
    cameras_of,
    edge_tensors,
    edges_of,
    keyframe_tensors,
    keyframes_of,
    link_tensors,
    links_of,
    pair_tensor,
    pairs_of,
)
from spslam.slam.graph.redundancy import with_anchors
from spslam.tensor_file import TensorFile, load_header, load_tensors, save_tensors
from spslam.tensor_schema import KEYFRAMES
from spslam.trajectory import Trajectory

FORMAT = "spslam-keyframes-1"
_FILE = TensorFile("keyframe archive", KEYFRAMES, FORMAT, error=OutputError)
RECORDS = 4096  # pixels with color of a keyframe that are kept, 48 kB


def no_anchors() -> np.ndarray:
    """int64 [0, 2]."""
    return np.zeros((0, 2), np.int64)


@dataclass(frozen=True)
class Recording:
    """The frames of one run in a map.

    Attributes:
        name: of the sequence or the camera.
        source: JSON object by which the frames are read again; empty where they came once.
        camera: of the frames.
        trajectory: of all frames.
    """

    name: str
    source: Mapping[str, Any]
    camera: Camera
    trajectory: Trajectory


@dataclass(frozen=True)
class KeyframeArchive:
    """The keyframes of a map, the edges between them, and the trajectories of its recordings.

    Attributes:
        recordings: in the order of their frames' numbers.
        keyframes: of all recordings; their frames are numbered over all recordings.
        links: of each keyframe to the one before.
        records: int32 [K, P, 3] packed pixels of the keyframes, in the images of their recording's camera.
        edges: measured between keyframes.
        tried: pairs of keyframes that were registered.
        noise: float32 [4] of each camera's sensor.
        settings: what must be alike in maps that are joined, by option.
        anchors: int64 [N, 2], frame and reference of each `Anchor`, ascending; trajectories have their poses.
    """

    recordings: Sequence[Recording]
    keyframes: Sequence[Keyframe]
    links: Sequence[Link]
    records: torch.Tensor
    edges: Sequence[GraphEdge]
    tried: set[tuple[int, int]]
    noise: Mapping[KeyframeCamera, torch.Tensor]
    settings: Mapping[str, Any] = field(default_factory=dict)
    anchors: np.ndarray = field(default_factory=no_anchors)

    @property
    def rows(self) -> np.ndarray:
        """int64 [K], numbers of the keyframes' frames."""
        return np.array([keyframe.frame for keyframe in self.keyframes], np.int64)

    @property
    def ends(self) -> np.ndarray:
        """int64 [R], the number after the last frame of each recording."""
        return np.cumsum([len(recording.trajectory) for recording in self.recordings])

    @property
    def poses(self) -> np.ndarray:
        """float64 [K, 4, 4] T_world_camera of the keyframes."""
        return np.concatenate([recording.trajectory.poses for recording in self.recordings])[self.rows]

    def with_anchors(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames and poses as the function of this name has them, where keyframes are now at poses [K, 4, 4]."""
        rows, (frames, references) = self.rows, self.anchors.T
        before = np.concatenate([recording.trajectory.poses for recording in self.recordings])
        relative = compose(inverse(before[rows[references]]), before[frames])
        return with_anchors(rows, poses, (frames, references, relative))

    def recording_of(self, keyframe: int) -> int:
        """Number of the recording that a keyframe is of."""
        return int(np.searchsorted(self.ends, self.keyframes[keyframe].frame, "right"))

    def timestamps(self) -> np.ndarray:
        """float64 [K], s, of the keyframes."""
        return np.concatenate([recording.trajectory.timestamps for recording in self.recordings])[self.rows]

    def save(self, path: Path) -> None:
        """Writes the file, atomically; the same content gives the same bytes.

        Raises:
            OutputError: it can't be written; what was there is left as it was.
        """
        trajectories = [recording.trajectory for recording in self.recordings]
        poses, timestamps, lost = (
            np.concatenate([getattr(each, name) for each in trajectories]) for name in ("poses", "timestamps", "lost")
        )
        cameras = list(self.noise)
        tensors = {
            **keyframe_tensors(self.keyframes, cameras),
            **link_tensors(self.links),
            **edge_tensors("edge_", self.edges),
            "tried": pair_tensor(self.tried),
            "noise": torch.stack([self.noise[camera] for camera in cameras]),
            "records": self.records.contiguous(),
            "anchors": torch.from_numpy(self.anchors),
            "recordings": torch.tensor([len(each) for each in trajectories], dtype=torch.int64),
            "frames.poses": torch.from_numpy(poses),
            "frames.timestamps": torch.from_numpy(timestamps),
            "frames.lost": torch.from_numpy(lost),
        }
        recordings = [
            {"name": each.name, "source": dict(each.source), "camera": asdict(each.camera)} for each in self.recordings
        ]
        save_tensors(path, tensors, {"format": FORMAT, "recordings": recordings, "settings": dict(self.settings)})

    @classmethod
    def load(cls, path: Path) -> KeyframeArchive:
        """Reads a file that `save` wrote.

        Raises:
            OutputError: no such file, another format, or damaged.
        """
        header, tensors = load_header(path, _FILE), load_tensors(path, _FILE, {})
        try:
            cameras = cameras_of(tensors["cameras"])
            return cls(
                _recordings(header, tensors),
                list(keyframes_of(tensors, cameras)),
                links_of(tensors),
                tensors["records"],
                edges_of("edge_", tensors),
                pairs_of(tensors["tried"]),
                dict(zip(cameras, tensors["noise"], strict=True)),
                dict(header["settings"]),
                tensors["anchors"].numpy().copy() if "anchors" in tensors else no_anchors(),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise OutputError(f"{path}: a damaged keyframe archive ({brief(str(error), 300)})") from None


def same_length(records: Sequence[torch.Tensor]) -> torch.Tensor:
    """Packed pixels int32 [K, P, 3] of lists [N, 3] of any length above 0, of which shorter ones are repeated."""
    count = max((len(each) for each in records), default=0)
    return torch.stack([each.repeat(-(-count // len(each)), 1)[:count] for each in records])


def _recordings(header: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> list[Recording]:
    """Raises KeyError, TypeError or ValueError where the header does not fit the tensors."""
    poses, timestamps, lost = (tensors[f"frames.{name}"].numpy().copy() for name in ("poses", "timestamps", "lost"))
    ends = [0, *tensors["recordings"].cumsum(0).tolist()]
    recordings = []
    for values, (begin, end) in zip(header["recordings"], itertools.pairwise(ends), strict=True):
        part = slice(begin, end)
        trajectory = Trajectory(timestamps[part], poses[part], lost[part])
        source = dict(values["source"])
        recordings.append(Recording(str(values["name"]), source, Camera(**values["camera"]), trajectory))
    return recordings
