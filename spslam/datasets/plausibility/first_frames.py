"""Checks the first frames of a recording before a run, and other stretches of it: does everything fit together?

Looks at a few views, and at more where they do not settle whether the intrinsics are right, up to a share of the
recording that keeps the check at a few percent of a run's time. Deterministic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spslam.datasets.base import RgbdDataset
from spslam.datasets.findings import Finding, folded
from spslam.datasets.plausibility.edges import match_edges
from spslam.datasets.plausibility.flow_fit import Points, depth_at, fit_flows
from spslam.datasets.plausibility.intrinsics import LensEstimate, center_findings, estimate_lens, lens_finding
from spslam.datasets.plausibility.lens import Lens
from spslam.datasets.plausibility.pairing import pairing_findings
from spslam.datasets.plausibility.pose_check import pose_findings
from spslam.datasets.plausibility.streams import (
    depth_findings,
    order_findings,
    repetition_findings,
    time_findings,
    unit_findings,
)
from spslam.datasets.plausibility.support import PREFERRED, depth_prefers, is_supported
from spslam.datasets.plausibility.tracks import Followed, Segment, Tracks, follow
from spslam.datasets.plausibility.turning import lag_findings
from spslam.datasets.plausibility.views import SECONDS_BETWEEN_VIEWS, Stretch, View, read_views, stretch_of, view_stride
from spslam.errors import DatasetError

# Views that are read at a time, and how many a run may be worth: reading and judging one takes about a third of the
# time that a frame takes in a run on two cores.
_VIEWS_AT_A_TIME = 24
_MOST_VIEWS = 96
_FRAMES_PER_FURTHER_VIEW = 20
_LEAST_POINTS = 30
# Steps from view to view that nothing could follow.
_MANY_BROKEN, _LEAST_STEPS = 0.5, 8
_BROKEN = "steps"


@dataclass(frozen=True)
class Judgment:
    """What a stretch says.

    Attributes:
        findings: one for each kind.
        is_settled: whether more views would hardly change them.
        estimate: of the lens; None where no points could be followed.
    """

    findings: list[Finding]
    is_settled: bool
    estimate: LensEstimate | None = None

    @property
    def is_certain(self) -> bool:
        """Whether something is wrong beyond doubt."""
        return any(finding.certain for finding in self.findings)


def check_first_frames(dataset: RgbdDataset) -> list[Finding]:
    """What looks wrong in the first frames; empty where all fits.

    Args:
        dataset: of a run.
    """
    further = max(0, len(dataset) - 10 * _VIEWS_AT_A_TIME) // _FRAMES_PER_FURTHER_VIEW
    return with_whole(dataset, check_stretch(dataset, 0, min(_MOST_VIEWS, _VIEWS_AT_A_TIME + further)).findings)


def with_whole(dataset: RgbdDataset, findings: Sequence[Finding]) -> list[Finding]:
    """Findings of stretches, and what is known of the recording as a whole.

    Args:
        dataset: the recording.
        findings: of its stretches.
    """
    has_overlap = all(finding.kind != _BROKEN for finding in findings)
    return folded([*findings, *dataset.doubts, *unit_findings(dataset.timestamps(), has_overlap)])


def check_stretch(dataset: RgbdDataset, start: int, most_views: int = _MOST_VIEWS) -> Judgment:
    """Judges views from a frame on, and more of them until they settle the judgment.

    Args:
        dataset: the recording.
        start: frame to begin with.
        most_views: at most.
    """
    stride = min(view_stride(dataset.timestamps()), max(1, len(dataset) // _VIEWS_AT_A_TIME))
    indices = np.arange(start, len(dataset), stride)[:most_views]
    views: list[View] = []
    judgment, followed = Judgment([], True), Followed()
    for begin in range(0, len(indices), _VIEWS_AT_A_TIME):
        views += read_views(dataset, [int(index) for index in indices[begin : begin + _VIEWS_AT_A_TIME]])
        if len(views) > 1:
            judgment = judge(dataset, views, followed)
        if judgment.is_certain or (judgment.is_settled and len(views) > 1):
            break
    return judgment


def judge(dataset: RgbdDataset, views: Sequence[View], followed: Followed | None = None) -> Judgment:
    """Judges views.

    Args:
        dataset: what they are of: its camera, its poses and its range of depth count.
        views: two or more, in order.
        followed: as of `follow`.
    """
    stretch = stretch_of(dataset, views)
    is_whole = views[-1].index - views[0].index > 0.8 * len(dataset)
    findings = depth_findings(stretch, dataset.depth_range, dataset.scale_remedy)
    findings += repetition_findings(stretch, is_whole)
    findings += center_findings(stretch.camera)
    has_depth = any(view.known_share > 0 for view in views)
    if not has_depth or any(finding.certain for finding in findings):
        return Judgment(folded(findings), True)
    findings += [] if dataset.is_timed else order_findings(views)
    findings += time_findings(dataset.timestamps())
    tracks = follow(views, followed)
    lens = Lens(stretch.camera, float(np.median(stretch.known_depth()[::7])))
    segments, points = _with_depth(views, tracks.segments)
    estimate = estimate_lens(points, lens, [_seconds(views, segment) for segment in segments])
    findings += _broken_findings(tracks)
    if estimate is not None:
        findings += _geometry_findings(stretch, segments, points, estimate, dataset)
    if not any(finding.kind == "pairing" for finding in findings):
        findings += lag_findings(views, lens, followed)
    return Judgment(folded(findings), estimate is not None and estimate.is_settled, estimate)


def require_sound(findings: Sequence[Finding], name: str) -> None:
    """Raises DatasetError where a finding is certain.

    Args:
        findings: of the first frames.
        name: of the dataset, for the message.
    """
    certain = [finding for finding in findings if finding.certain]
    if certain:
        raise DatasetError(
            f"{name}: the first frames do not fit together: {'; '.join(map(str, certain))}. "
            "`spslam check-data` shows more; run.data_check=warn runs all the same"
        )


def _geometry_findings(
    stretch: Stretch, segments: list[Segment], points: list[Points], estimate: LensEstimate, dataset: RgbdDataset
) -> list[Finding]:
    lens, is_registered = estimate.lens, dataset.is_registered
    edges = match_edges(stretch.views) if is_registered else None
    findings: list[Finding] = []
    finding = lens_finding(estimate, supported=True, preferred=True)
    if finding is not None:
        preference = depth_prefers(stretch.views, segments, points, (lens, estimate.corrected))
        supported = is_supported(estimate.gain, preference, edges)
        finding = lens_finding(estimate, supported, preference <= PREFERRED)
    if is_registered and (finding is None or not finding.certain):
        findings += pairing_findings(stretch.views, segments, lens, edges)
    if finding is not None and (is_registered or finding.certain) and not any(found.certain for found in findings):
        findings.append(finding)
    if not any(found.certain for found in findings):
        findings += pose_findings(stretch, segments, fit_flows(points, lens), lens, dataset)
    return findings


def _with_depth(views: Sequence[View], segments: Sequence[Segment]) -> tuple[list[Segment], list[Points]]:
    """The segments that have enough points with depth, and those points."""
    kept, points = [], []
    for segment in segments:
        depth = depth_at(views[segment.first].depth, segment.pixels_first)
        known = depth > 0
        if np.count_nonzero(known) >= _LEAST_POINTS:
            kept.append(segment)
            points.append(Points(segment.pixels_first[known], depth[known], segment.pixels_last[known]))
    return kept, points


def _seconds(views: Sequence[View], segment: Segment) -> float:
    """From a segment's first view to its last; as views are meant to be apart where time stamps do not ascend."""
    seconds = views[segment.last].timestamp - views[segment.first].timestamp
    return seconds if seconds > 0 else (segment.last - segment.first) * SECONDS_BETWEEN_VIEWS


def _broken_findings(tracks: Tracks) -> list[Finding]:
    if tracks.steps < _LEAST_STEPS or tracks.broken < _MANY_BROKEN * tracks.steps:
        return []
    text = f"{tracks.broken} of {tracks.steps} views have too little in common with the one before"
    return [Finding(_BROKEN, text, "check the order of the frames; record more slowly, or at a higher rate")]
