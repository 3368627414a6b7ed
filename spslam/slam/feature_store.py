"""Image features of earlier frames, kept to find the camera again from anywhere."""

import itertools
from collections.abc import Mapping

import numpy as np
import torch

from spslam.config import Config
from spslam.geometry import compose, inverse, rotation_angle
from spslam.slam.image_features import DESCRIPTOR_BYTES, ImageFeatures

INTERVAL = 30  # frames between those whose features are kept in any case, a second of a camera
# So many frames are enough of one view; near to another are those less than so far from it.
ENOUGH, NEAR_M, NEAR_DEG = 3, 0.2, 12.0
MAX_FRAMES = 2048  # with features, 90 MB; then every second of the older half goes


def keeps_features(config: Config, number: int) -> bool:
    """Whether the image features of frame number `number` are kept, however well it is tracked."""
    return uses_features(config) and number % INTERVAL == 0


def needs_features(config: Config, number: int) -> bool:
    """Whether the image features of frame number `number` are needed in any case: the second has no speed to be
    predicted by, so that they find its pose."""
    return keeps_features(config, number) or (uses_features(config) and number == 1)


def uses_features(config: Config) -> bool:
    """Whether the image features of any frame may be asked for."""
    return config.tracking.features and config.tracking.recovery


class FeatureStore:
    """Features of some frames, in the order of their numbers, in the host's memory; only those with depth.

    Attributes:
        frames: numbers of these frames, ascending.
    """

    def __init__(self) -> None:
        self.frames: list[int] = []
        self._features: list[ImageFeatures] = []

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, i: int) -> ImageFeatures:
        """Features of frame number `frames[i]`; without positions, which are their points' projections."""
        return self._features[i]

    def add(self, frame: int, features: ImageFeatures) -> None:
        """Keeps the features of frame number `frame`, which is larger than those before."""
        self.frames.append(frame)
        self._features.append(_without_positions(features.with_depth()))
        self._thin()

    def insert(self, features: Mapping[int, ImageFeatures]) -> None:
        """Keeps features of frames by number, as another store has them; they need not be the newest."""
        known = {**dict(zip(self.frames, self._features, strict=True)), **features}
        self.frames = sorted(known)
        self._features = [known[frame] for frame in self.frames]
        self._thin()

    def _thin(self) -> None:
        while len(self.frames) > MAX_FRAMES:
            half = len(self.frames) // 2
            for content in (self.frames, self._features):
                del content[1:half:2]  # type: ignore[attr-defined]

    def has_enough(self, poses: np.ndarray, pose: np.ndarray) -> bool:
        """Whether features of `ENOUGH` frames are kept that stand close to where a frame stands.

        Args:
            poses: float64 [K, 4, 4] T_world_camera of the frames kept.
            pose: float64 [4, 4] of the frame.
        """
        relative = compose(inverse(pose), poses)
        near = np.linalg.norm(relative[:, :3, 3], axis=1) < NEAR_M
        near &= rotation_angle(relative[:, :3, :3]) < np.radians(NEAR_DEG)
        return int(near.sum()) >= ENOUGH

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that a checkpoint needs, as copies: frames and counts int64 [K], descriptors [N, 32], points [N, 3]."""
        descriptors = [np.zeros((0, DESCRIPTOR_BYTES), np.uint8), *(one.descriptors for one in self._features)]
        points = [np.zeros((0, 3), np.float32), *(one.points for one in self._features)]
        return {
            "frames": torch.tensor(self.frames, dtype=torch.int64),
            "counts": torch.tensor([len(one) for one in self._features], dtype=torch.int64),
            "descriptors": torch.from_numpy(np.concatenate(descriptors)),
            "points": torch.from_numpy(np.concatenate(points)),
        }

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by a copy of what `tensors()` returned."""
        self.frames = state["frames"].tolist()
        ends = [0, *state["counts"].cumsum(0).tolist()]
        descriptors, points = (state[name].cpu().numpy().copy() for name in ("descriptors", "points"))
        none = np.zeros((0, 2), np.float32)
        self._features = [
            ImageFeatures(descriptors[begin:end], none, points[begin:end]) for begin, end in itertools.pairwise(ends)
        ]


def _without_positions(features: ImageFeatures) -> ImageFeatures:
    return ImageFeatures(features.descriptors, np.zeros((0, 2), np.float32), features.points)
