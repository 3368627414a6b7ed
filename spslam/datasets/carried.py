"""What moves along with the camera: a robot's arm or body in view, whose depth is the same in all frames.

Nothing else in a recording tells tracking so firmly that the camera stands still. So its pixels have no depth, see
`RgbdDataset.left_out`. It is known by depth alone, in frames spread over the recording: it stays the same while that of
other pixels changes, and all around its outline lies something farther. A floor before a robot stays the same as well,
but goes on beyond any outline.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from spslam.datasets.base import RgbdDataset
from spslam.datasets.prefetch import prefetch

# Frames that are looked at, and how many must be readable; cells across the image.
FRAMES, _FEWEST_FRAMES = 16, 8
_CELLS = 64
_READING_THREADS = 4
# A cell stays the same if it has depth in nearly all frames, and most of them agree up to a share of it.
_KNOWN, _MIDDLE, _SAME = 0.8, (0.15, 0.85), 0.03
# It changes if it has some, and most of them do not agree. So must a quarter of an image do, or the camera stood.
_SOMETIMES, _CHANGES, _CAMERA_MOVES = 0.3, 0.15, 0.25
# What is carried is near; a surface does not jump by more from one cell to the next.
_NEAR_M, _JUMP = 1.5, 0.08
_LEAST_SHARE = 0.01  # of the image; less is neither seen with certainty nor does it harm
# Around the outline most depth is farther by this factor and distance, in most of the frames.
_FARTHER, _FARTHER_M, _MOSTLY, _LEAST_AROUND = 1.25, 0.03, 0.5, 8
_MARGIN = 2  # cells around it that are left out too: its edges are not sharp


def find_carried(dataset: RgbdDataset) -> np.ndarray | None:
    """The pixels of what moves along with the camera of a recording.

    Args:
        dataset: the recording; frames that can't be read do not count.

    Returns:
        bool [H, W]; None where nothing does, or too few frames tell.
    """
    chosen = np.unique(np.linspace(0, len(dataset) - 1, FRAMES).round().astype(int)).tolist()
    if len(chosen) < _FEWEST_FRAMES:
        return None
    with prefetch(_Depths(dataset, chosen), _READING_THREADS if dataset.is_random_access else 1, FRAMES) as read:
        depths = [image for image in read if isinstance(image, np.ndarray)]
    return carried_in(depths) if len(depths) >= _FEWEST_FRAMES else None


def carried_in(depths: Sequence[np.ndarray]) -> np.ndarray | None:
    """What moves along with the camera by some of its frames.

    Args:
        depths: float32 [H, W] each, m, 0 unknown; of frames that are far apart in time.

    Returns:
        As of `find_carried`.
    """
    step = -(-depths[0].shape[1] // _CELLS)
    cells = np.stack([depth[step // 2 :: step, step // 2 :: step] for depth in depths])
    known = cells > 0
    share = known.mean(axis=0)
    middle, spread = _middle_and_spread(cells)
    same = (share >= _KNOWN) & (spread < _SAME) & (middle < _NEAR_M)
    sometimes = share >= _SOMETIMES
    if np.count_nonzero(sometimes & (spread > _CHANGES)) < _CAMERA_MOVES * np.count_nonzero(sometimes):
        return None
    carried = np.zeros_like(same)
    for surface in _surfaces(same, middle):
        if surface.mean() >= _LEAST_SHARE and _stands_out(surface, middle, cells):
            carried |= surface
    if not carried.any():
        return None
    height, width = depths[0].shape
    wide = _grown(carried, _MARGIN).repeat(step, axis=0).repeat(step, axis=1)
    return np.pad(wide, [(0, max(height - len(wide), 0)), (0, max(width - wide.shape[1], 0))], "edge")[:height, :width]


class _Depths:
    """The depth images of some frames of a dataset."""

    def __init__(self, dataset: RgbdDataset, indices: Sequence[int]) -> None:
        self._dataset, self._indices = dataset, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, number: int) -> np.ndarray:
        return self._dataset.depth(self._indices[number])


def _middle_and_spread(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median depth (m) of cells [h, w] over frames [N, h, w], and the spread of most as a share of it; 0 unknown."""
    count = np.count_nonzero(cells > 0, axis=0)
    ordered = np.sort(cells, axis=0)  # what is unknown comes first

    def quantile(share: float) -> np.ndarray:
        row = len(cells) - count + np.round(share * (count - 1)).astype(int)
        return np.take_along_axis(ordered, np.minimum(row, len(cells) - 1)[None], axis=0)[0]

    low, middle, high = quantile(_MIDDLE[0]), quantile(0.5), quantile(_MIDDLE[1])
    return middle, np.divide(high - low, middle, out=np.zeros_like(middle), where=middle > 0)


def _surfaces(same: np.ndarray, middle: np.ndarray) -> list[np.ndarray]:
    """The connected surfaces, bool [h, w] each, of cells that stay the same."""
    left = np.ones((same.shape[0] + 2, same.shape[1] + 2), np.uint8)
    left[1:-1, 1:-1] = ~same
    inner, image = left[1:-1, 1:-1], np.log(np.where(same, middle, 1)).astype(np.float32)
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | (2 << 8)
    found = []
    while not inner.all():
        row, column = np.unravel_index(int(inner.argmin()), inner.shape)
        cv2.floodFill(image, left, (int(column), int(row)), 0, _JUMP, _JUMP, flags)
        found.append(inner == 2)
        inner[inner == 2] = 1
    return found


def _stands_out(surface: np.ndarray, middle: np.ndarray, cells: np.ndarray) -> bool:
    """Whether something farther lies all around a surface bool [h, w], in frames [N, h, w]."""
    around = _grown(surface, 2) & ~_grown(surface, 1)
    beside_m = cv2.dilate(np.where(surface, middle, 0).astype(np.float32), np.ones((5, 5), np.uint8))[around]
    depth = cells[:, around]
    known, farther = depth > 0, depth > _FARTHER * beside_m + _FARTHER_M
    counts = np.count_nonzero(known, axis=0)
    told = counts >= _SOMETIMES * len(cells)
    if np.count_nonzero(told) < _LEAST_AROUND:
        return False
    return bool(np.mean(np.count_nonzero(farther, axis=0)[told] > _MOSTLY * counts[told]) > _MOSTLY)


def _grown(cells: np.ndarray, by: int) -> np.ndarray:
    return cv2.dilate(cells.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1), np.uint8)) > 0
