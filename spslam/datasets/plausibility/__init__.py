"""Is a recording plausible? Evidence from the images themselves that intrinsics, scale, pairing and order are right."""

from spslam.datasets.findings import Finding, folded
from spslam.datasets.plausibility.first_frames import (
    Judgment,
    check_first_frames,
    check_stretch,
    judge,
    require_sound,
    with_whole,
)

__all__ = [
    "Finding",
    "Judgment",
    "check_first_frames",
    "check_stretch",
    "folded",
    "judge",
    "require_sound",
    "with_whole",
]
