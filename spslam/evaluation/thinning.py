"""Which frames of a long run a chart draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# A page is some 1,000 px wide, so up to two values per pixel are drawn as they are.
MAX_FRAMES = 2000
_BUCKETS = 500


def thin_frames(lines: Sequence[tuple[np.ndarray, bool]], max_frames: int = MAX_FRAMES) -> np.ndarray:
    """Chooses frames that show all peaks and gaps of lines.

    Up to `max_frames` frames are all kept. Of more, the run is divided into 500 stretches, and of each those frames are
    kept at which a line is lowest and highest, and at which it is interrupted first.

    Args:
        lines: (values [F] with NaN for gaps, whether gaps are to be kept) of each line, all of the same F.
        max_frames: number of frames up to which nothing is left out.

    Returns:
        int64 [K], ascending, the first and the last frame among them.
    """
    count = len(lines[0][0])
    if count <= max_frames:
        return np.arange(count)
    kept = [np.array([0, count - 1])]
    starts = (np.arange(_BUCKETS) * count) // _BUCKETS
    bucket = np.searchsorted(starts, np.arange(count), side="right") - 1
    for values, with_gaps in lines:
        finite = np.flatnonzero(np.isfinite(values))
        by_value = finite[np.lexsort((values[finite], bucket[finite]))]
        kept += [_first_of_each(by_value, bucket), _first_of_each(by_value[::-1], bucket)]
        if with_gaps:
            kept.append(_first_of_each(np.flatnonzero(~np.isfinite(values)), bucket))
    return np.unique(np.concatenate(kept))


def _first_of_each(frames: np.ndarray, bucket: np.ndarray) -> np.ndarray:
    """The first of the frames in each bucket; the frames are sorted by bucket, up or down."""
    return frames[np.unique(bucket[frames], return_index=True)[1]]
