"""Place recognition: earlier frames with a similar depth thumbnail or the same image features."""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from spslam.camera import Camera
from spslam.geometry import compose, matrix_to_pose7, pose7_to_matrix
from spslam.slam.frame_history import EarlierFrame, FrameHistory
from spslam.slam.pixels import THUMBNAIL_STEP_PX, FramePixels
from spslam.slam.recovery.feature_alignment import FeatureAlignment

# Difference per cell: of the log depths, at most the first; the second where only one thumbnail has depth.
MAX_LOG_DIFFERENCE, ONE_SIDED_DIFFERENCE = 0.3, 0.15
MIN_SEPARATION = 5  # frames; of similar frames in a row only the best is a candidate
TURNED_CANDIDATES = 32  # the best are also compared as if the camera had turned
TURN_COLUMNS, TURN_ROWS = 0.15, 0.2  # share of the image by which it may have turned, or twice that to the side
MIN_OVERLAP = 0.4  # share of an image that must remain to be compared
MIN_DEPTH_M = 0.05
_OUTSIDE = -1.0
# Of a frame's image features those of so many stored frames are compared: the newest, and others in turn, so that
# while a camera is lost all are.
NEWEST_COMPARED, OTHERS_COMPARED = 16, 32
MATCHED = 3  # of these, the most alike are matched with all features


@dataclass(frozen=True)
class RelocalizationCandidate:
    """An earlier frame that looks like the present one.

    Attributes:
        earlier: the earlier frame.
        start: float32 [7], the pose from which the present frame would look most like it.
    """

    earlier: EarlierFrame
    start: torch.Tensor


def retrieve(history: FrameHistory, pixels: FramePixels, count: int, camera: Camera) -> list[RelocalizationCandidate]:
    """Earlier frames whose depth thumbnail is most like that of the given pixels, best first.

    Of similar frames in a row only the best is taken, so that a slow camera does not fill the list. The best are also
    compared as they would look if the camera had turned.

    Args:
        history: the frames before.
        pixels: of the present frame.
        count: most candidates; 0 gives none.
        camera: of all frames.
    """
    rows = history.usable_rows().to(history.depth_thumbnails.device)
    if len(rows) == 0 or count == 0:
        return []
    difference = thumbnail_difference(pixels.depth_thumbnail, history.depth_thumbnails[rows])
    least = -F.max_pool1d(-difference[None, None], 2 * MIN_SEPARATION + 1, 1, MIN_SEPARATION)[0, 0]
    separate = torch.where(difference == least, difference, torch.inf)
    order = separate.argsort(stable=True)[:TURNED_CANDIDATES]
    rows = rows[order[separate[order].isfinite()]]
    shifts, differences = turned_differences(pixels.depth_thumbnail, history.depth_thumbnails[rows])
    smallest, turn = differences.min(0)
    order = smallest.argsort(stable=True)[:count]
    frames = [history.frame(row) for row in rows[order].tolist()]
    turns = [shifts[i] for i in turn[order].tolist()]
    return [
        RelocalizationCandidate(earlier, turned(earlier.pose, shift, camera))
        for earlier, shift in zip(frames, turns, strict=True)
    ]


def retrieve_by_features(history: FrameHistory, image: FeatureAlignment, frame: int) -> list[int]:
    """Rows of stored frames with the most image features of a frame, best first, at most `MATCHED`.

    Args:
        history: the frames before.
        image: the frame's features.
        frame: number of the frame; decides which of many stored frames are compared.
    """
    rows = history.feature_rows()
    newest, others = rows[-NEWEST_COMPARED:], rows[:-NEWEST_COMPARED]
    begin = frame * OTHERS_COMPARED % max(len(others), 1)
    compared = [*newest, *[*others, *others][begin : begin + min(OTHERS_COMPARED, len(others))]]
    alike = [(features, row) for row in compared if (features := history.features(row)) is not None]
    counts = [(image.likeness(features), row) for features, row in alike]
    return [row for count, row in sorted(counts, reverse=True)[:MATCHED] if count]


def thumbnail_difference(depth_thumbnail: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Mean difference of the logarithms of depth between depth thumbnails, clamped to `MAX_LOG_DIFFERENCE`.

    Args:
        depth_thumbnail: float16 [..., h, w], m, 0 where unknown, `_OUTSIDE` where the image does not reach.
        others: float16 [..., h, w]; leading dimensions are broadcast.

    Returns:
        float32 [...]; cells that neither image knows do not count, nor those that the first does not reach.
    """
    one, known = depth_thumbnail.float().clamp(min=MIN_DEPTH_M).log(), depth_thumbnail > 0
    other, others_known = others.float().clamp(min=MIN_DEPTH_M).log(), others > 0
    difference = (one - other).abs().clamp(max=MAX_LOG_DIFFERENCE)
    difference = torch.where(known & others_known, difference, ONE_SIDED_DIFFERENCE)
    either = (known | others_known) & (depth_thumbnail >= 0)
    return (difference * either).sum((-2, -1)) / either.sum((-2, -1)).clamp(min=1)


def turned_differences(
    depth_thumbnail: torch.Tensor, others: torch.Tensor
) -> tuple[list[tuple[int, int]], torch.Tensor]:
    """Differences of depth thumbnails with the first one shifted over the others by rows and columns.

    Args:
        depth_thumbnail: float16 [h, w], m.
        others: float16 [F, h, w].

    Returns:
        The S shifts (rows, columns), (0, 0) among them; float32 [S, F] differences where the images overlap.
    """
    height, width = depth_thumbnail.shape
    down, right = max(round(TURN_ROWS * height), 1), max(round(TURN_COLUMNS * width), 1)
    shifts = [(y, x) for y in (0, -down, down) for x in (0, -right, right, -2 * right, 2 * right)]
    shifts = [(y, x) for y, x in shifts if (height - abs(y)) * (width - abs(x)) >= MIN_OVERLAP * height * width]
    margin = 2 * right
    padded = F.pad(depth_thumbnail, (margin, margin, down, down), value=_OUTSIDE)
    shifted = [padded[down - y :, margin - x :][:height, :width] for y, x in shifts]
    return shifts, thumbnail_difference(torch.stack(shifted)[:, None], others)


def turned(pose: torch.Tensor, shift: tuple[int, int], camera: Camera) -> torch.Tensor:
    """The pose float32 [7] of a camera that has turned from `pose` so that its image moved by thumbnail cells.

    Args:
        pose: float32 [7].
        shift: rows and columns; what is at a cell now was that much further down and to the right.
        camera: of the image.
    """
    down, right = (math.atan(n * THUMBNAIL_STEP_PX / f) / 2 for n, f in zip(shift, (camera.fy, camera.fx), strict=True))
    yaw = pose7_to_matrix(np.array([math.cos(right), 0, math.sin(right), 0, 0, 0, 0]))
    pitch = pose7_to_matrix(np.array([math.cos(down), -math.sin(down), 0, 0, 0, 0, 0]))
    matrix = compose(pose7_to_matrix(pose.cpu().double().numpy()), yaw, pitch)
    return torch.from_numpy(matrix_to_pose7(matrix)).to(pose)
