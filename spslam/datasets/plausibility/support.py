"""Second opinions on an estimate of the lens: do depth images alone agree, and do the edges of depth lie on color's?

Optical flow sees the color camera. Where color and depth are not registered, as in 7-Scenes, its focal length is not
depth's, and depth is what a map is made of. So an estimate counts as certain only if depth images lie on one another
better with it, or if the edges show that color and depth are one camera's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spslam.datasets.plausibility.edges import EdgeMatch
from spslam.datasets.plausibility.flow_fit import Points, fit_flow
from spslam.datasets.plausibility.lens import Lens
from spslam.datasets.plausibility.surface_fit import Surface, fit_surfaces
from spslam.datasets.plausibility.tracks import Segment
from spslam.datasets.plausibility.views import View

# Sum over segments of the log of errors, corrected over given: below it, depth alone prefers the correction; above the
# other, it prefers what was given.
PREFERRED, _REJECTED = -0.15, 0.15
_MOST_SEGMENTS = 5
_LARGE_GAIN = 2.5


def depth_prefers(
    views: Sequence[View], segments: Sequence[Segment], points: Sequence[Points], lenses: tuple[Lens, Lens]
) -> float:
    """Sum of log errors of depth on depth with the second lens, less that with the first; 0 where nothing overlaps.

    Args:
        views: of the stretch.
        segments: pairs of views.
        points: of each segment, for the motion to begin with.
        lenses: as given, and corrected.
    """
    longest = sorted(range(len(segments)), key=lambda k: segments[k].first - segments[k].last)[:_MOST_SEGMENTS]
    total = 0.0
    for k in longest:
        errors = []
        for lens in lenses:
            first, last = (Surface.of(views[view].depth, lens) for view in (segments[k].first, segments[k].last))
            fit = fit_surfaces(first, last, lens, fit_flow(points[k], lens).motion)
            errors.append(np.nan if fit is None else np.log(fit.error))
        if np.isfinite(errors).all():
            total += float(errors[1] - errors[0])
    return total


def is_supported(gain: float, preference: float, edges: EdgeMatch | None) -> bool:
    """Whether an estimate is more than a matter of registration.

    Args:
        gain: of the estimate; what is off by so much that errors are twice as large is not registration.
        preference: of `depth_prefers`.
        edges: None where there are too few.
    """
    if preference <= PREFERRED or gain > _LARGE_GAIN:
        return True
    return preference < _REJECTED and edges is not None and edges.is_registered
