"""What a run came to, in words: which frames are lost, the likely reasons, and what to try."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from spslam.evaluation.run_output import RunOutput
from spslam.options import Config

# Of a loss, only the beginning tells why: later frames are lost because the ones before are.
_FIRST_FRAMES = 3
_MAX_LOSSES = 5
# More motion than hand-held cameras make between two frames of 30 per second (docs/tracking-failure.md).
_FAST_CM, _FAST_DEG = 10.0, 8.0
# Limits of runs without faults (docs/tracking-failure.md).
_OCCLUDED_SHARE, _MIN_EIGENVALUE, _FREE_SPACE_VIOLATION, _BRIGHTNESS_CORRELATION = 0.15, 0.002, 0.05, 0.64
# A gap in time by this factor of the usual one.
_GAP_FACTOR = 4.0
# A path that deviates by more than this and this share of its length is wrong somewhere, though no frame is lost.
_LARGE_ERROR_M, _LARGE_ERROR_SHARE = 0.1, 0.02

# A place that is 10 % larger, or mirrored, gives the same images as a path of that size in it.
UNKNOWN_ERROR = (
    "There is no ground truth, so the error of the path is unknown; whether depth has the right scale, or all images "
    "are mirrored, images alone can't tell."
)


@dataclass(frozen=True)
class Verdict:
    """A run in words.

    Attributes:
        level: `good`, `doubtful` (something deserves a look) or `bad` (a large part of the path is unknown or wrong).
        headline: one sentence.
        details: sentences, those of single losses first.
        advice: what to try, each once.
    """

    level: str
    headline: str
    details: list[str]
    advice: list[str]


def judge_run(run: RunOutput, config: Config | None) -> Verdict:
    """Says in words how a run went.

    Args:
        run: the run. What it did not measure is left out.
        config: its options, by whose thresholds frames were judged; None where they are unknown.

    Returns:
        The verdict. It depends on nothing but the arguments.
    """
    lost = run.trajectory.lost
    losses = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(int))).reshape(-1, 2)
    details, advice = [], []
    for first, end in _longest(losses):
        reasons = _reasons(run, config, first, end)
        details.append(_describe_loss(run, first, end, [reason for reason, _ in reasons]))
        advice += [hint for _, hint in reasons]
    if len(losses) > _MAX_LOSSES:
        details.append(f"{len(losses) - _MAX_LOSSES} shorter losses are not listed; log.jsonl has every frame.")
    for text, hint in (_accuracy(run), _data(run), _doubtful_pose(run, config), _skipped(run), _speed(run)):
        details += [text] if text else []
        advice += [hint] if hint else []
    return Verdict(_level(run, bool(advice)), _headline(lost, losses), details, list(dict.fromkeys(advice)))


def _longest(losses: np.ndarray) -> np.ndarray:
    """The longest losses, in order of time."""
    chosen = np.argsort(-(losses[:, 1] - losses[:, 0]), kind="stable")[:_MAX_LOSSES]
    return losses[np.sort(chosen)]


def _headline(lost: np.ndarray, losses: np.ndarray) -> str:
    count = len(lost)
    if not count:
        return "There is no frame."
    if not lost.any():
        return "The only frame is tracked." if count == 1 else f"All {count:,} frames are tracked."
    if lost.all():
        return "No frame is tracked."
    share = f"{lost.sum():,} of {count:,} frames ({100 * lost.mean():.2g} %)"
    verb = "is" if lost.sum() == 1 else "are"
    if lost[-1] and len(losses) == 1:
        return f"Tracking is lost from frame {losses[0, 0]:,} to the end: {share} {verb} lost."
    where = "once" if len(losses) == 1 else f"{len(losses):,} times"
    ending = ", and not found again at the end" if lost[-1] else ", and found again each time"
    ending = ", and found again" if len(losses) == 1 else ending
    return f"Tracking is lost {where}{ending}: {share} {verb} lost."


def _describe_loss(run: RunOutput, first: int, end: int, reasons: list[str]) -> str:
    frames = f"Frame {first:,} is" if end - first == 1 else f"Frames {first:,} to {end - 1:,} are"
    times = run.trajectory.timestamps
    when = f"{times[first] - times[0]:.1f} s after the start"
    because = f" because {' and '.join(reasons)}" if reasons else ", and the log does not say why"
    if end == len(times):
        after = ""
    elif _value(run, end, "relocalized") == 1:
        after = f" Frame {end:,} was relocalized against a stored frame."
    elif _value(run, end, "recovered") == 1:
        after = f" Frame {end:,} was recovered from the last trusted one."
    else:
        after = f" Frame {end:,} was tracked again."
    return f"{frames} lost ({when}){because}.{after}"


def _reasons(run: RunOutput, config: Config | None, first: int, end: int) -> list[tuple[str, str]]:
    """What the log says of the first frames of a loss, and what helps against it; the likeliest causes."""
    rows = range(first, min(end, first + _FIRST_FRAMES))
    extreme = {name: _extreme(run, rows, name, pick) for name, pick in _MEASURES.items()}
    # A frame without depth was not tracked, so no other measure says anything.
    if config is not None and extreme["valid_depth_share"] < config.tracking.min_valid_depth_share:
        near, far = config.dataset.min_depth_m, config.dataset.max_depth_m
        text = f"only {_percent(extreme['valid_depth_share'])} of the image has depth from {near:g} to {far:g} m"
        return [(text, _ADVICE["depth"])]
    found = []
    if gap := _gap(run, first):
        found.append((f"there is no frame for {gap:.2g} s before it", _ADVICE["gap"]))
    moved_cm, moved_deg = extreme["prediction_error_cm"], extreme["prediction_error_deg"]
    if extreme["occluded_share"] > _OCCLUDED_SHARE:
        text = f"something hides {_percent(extreme['occluded_share'])} of the known surface"
        found.append((text, _ADVICE["occluded"]))
    elif moved_cm > _FAST_CM or moved_deg > _FAST_DEG:
        text = f"the best pose is {moved_cm:.2g} cm and {moved_deg:.2g} degrees from the predicted one"
        found.append((text, _ADVICE["fast"]))
    if config is not None and extreme["inlier_share"] < config.tracking.min_inlier_share:
        text = f"only {_percent(extreme['inlier_share'])} of its pixels lie on mapped surface"
        found.append((text, _ADVICE["unmapped"]))
    elif extreme["free_space_violation"] > _FREE_SPACE_VIOLATION:
        text = "its depth contradicts surface that other frames have seen"
        found.append((text, _ADVICE["contradiction"]))
    if extreme["min_eigenvalue"] < _MIN_EIGENVALUE:
        found.append(("the surface in view leaves the pose undetermined, as a bare wall does", _ADVICE["plain"]))
    if extreme["brightness_correlation"] < _BRIGHTNESS_CORRELATION:
        found.append(("its brightness does not match that of earlier frames", _ADVICE["brightness"]))
    if not found and config is not None and extreme["error_probability"] > config.tracking.lost_threshold:
        text = f"its pose is wrong with a probability of {extreme['error_probability']:.2g}, by no single measure"
        found.append((text, _ADVICE["unclear"]))
    return found[:2]


# The measures of log.jsonl that tell reasons, and which of their values tells most.
_MEASURES: dict[str, Callable] = {
    "valid_depth_share": min,
    "inlier_share": min,
    "min_eigenvalue": min,
    "brightness_correlation": min,
    "occluded_share": max,
    "prediction_error_cm": max,
    "prediction_error_deg": max,
    "free_space_violation": max,
    "error_probability": max,
}
_ADVICE = {
    "depth": "Keep surface within the sensor's range in view: glass, black and far surface have no depth. "
    "`spslam check-data` shows how much depth the frames have and whether the depth scale is right.",
    "gap": "Record without gaps, say onto a faster disk, and pass every frame (`--frames` without a step).",
    "occluded": "Keep hands and people out of the view, or look back at a place seen before.",
    "fast": "Move and turn more slowly, or record more frames per second.",
    "unmapped": "Turn slowly enough that most of each image shows surface seen before, or map more often "
    "(`--set mapping.every=3`).",
    "contradiction": "Check the intrinsics, the depth scale and that color and depth belong together "
    "(`spslam check-data`).",
    "plain": "Keep corners, furniture or texture in view, and a distance at which more than one wall is seen.",
    "brightness": "Check that color and depth are of the same time, and keep what moves, or changes its light, out of "
    "view.",
    "unclear": "Look at this place in the recording; log.jsonl has all measures of these frames "
    "(docs/tracking-failure.md).",
    "wrong": "Look for the place where the error grows in the charts below; a wrong depth scale or wrong intrinsics "
    "bend a whole path (`spslam check-data`).",
    "data": "Mend what the doubts about the data say, and run again.",
    "doubtful": "Look at this frame in the recording and in the charts below.",
    "skipped": "skipped.jsonl names these frames and why.",
}


def _extreme(run: RunOutput, rows: range, name: str, pick: Callable) -> float:
    """The lowest or highest value in rows of the log; NaN, which no comparison holds for, if there is none."""
    values = [value for value in (_value(run, row, name) for row in rows) if np.isfinite(value)]
    return pick(values) if values else np.nan


def _value(run: RunOutput, row: int, name: str) -> float:
    """A number of the log, NaN where it has none; a log of other frames than the trajectory's has none at all."""
    if len(run.log) != len(run.trajectory):
        return np.nan
    return number(run.log[row].get(name))


def number(value: Any) -> float:
    """A number of a JSON file as float; NaN for anything else."""
    return float(value) if isinstance(value, (int, float)) and abs(value) < 1e300 else np.nan


def _gap(run: RunOutput, row: int) -> float | None:
    """Seconds from the frame before to a frame, if they are much more than usual."""
    steps = np.diff(run.trajectory.timestamps)
    if row == 0 or len(steps) < 3:
        return None
    usual = float(np.median(steps))
    return float(steps[row - 1]) if usual > 0 and steps[row - 1] > _GAP_FACTOR * usual else None


def _accuracy(run: RunOutput) -> tuple[str, str]:
    error_cm = number(run.metrics.get("ate_rmse_cm"))
    if not np.isfinite(error_cm):
        return UNKNOWN_ERROR, ""
    text = f"The path deviates from the ground truth by {error_cm:.2f} cm (ATE RMSE)."
    return text, _ADVICE["wrong"] if _is_large(run) else ""


def _data(run: RunOutput) -> tuple[str, str]:
    count = len(run.metrics.get("warnings", ()))
    if not count:
        return "", ""
    return f"The look at the data raised {count} doubt{'s' if count > 1 else ''}, listed below.", _ADVICE["data"]


def _is_large(run: RunOutput) -> bool:
    error_m = number(run.metrics.get("ate_rmse_cm")) / 100
    return bool(error_m > max(_LARGE_ERROR_M, _LARGE_ERROR_SHARE * path_length_m(run)))


def path_length_m(run: RunOutput) -> float:
    """Length of the path through the known poses, in meters."""
    known = run.trajectory.poses[~run.trajectory.lost, :3, 3]
    return float(np.linalg.norm(np.diff(known, axis=0), axis=1).sum())


def _doubtful_pose(run: RunOutput, config: Config | None) -> tuple[str, str]:
    if config is None or len(run.log) != len(run.trajectory):
        return "", ""
    values = np.array([number(entry.get("error_probability")) for entry in run.log])
    values = np.where(run.trajectory.lost | ~np.isfinite(values), 0.0, values)
    if not len(values) or values.max() <= config.tracking.verify_threshold:
        return "", ""
    row = int(values.argmax())
    text = f"The least certain pose that was accepted is that of frame {row:,}: "
    return f"{text}it is wrong with a probability of {values[row]:.2g}.", _ADVICE["doubtful"]


def _skipped(run: RunOutput) -> tuple[str, str]:
    count = number(run.metrics.get("skipped_frames"))
    if not count > 0:
        return "", ""
    what = "frame could not be read, or its depth was" if count == 1 else "frames could not be read, or their depth was"
    return f"{count:,.0f} {what} frozen; such frames are left out.", _ADVICE["skipped"]


def _speed(run: RunOutput) -> tuple[str, str]:
    rate = number(run.metrics.get("fps"))
    steps = np.diff(run.trajectory.timestamps)
    usual = float(np.median(steps)) if len(steps) else 0.0
    if not rate > 0:
        return "", ""
    text = f"The run made {rate:.3g} frames/s"
    return f"{text}; the camera recorded {1 / usual:.3g} per second." if usual > 1e-6 else f"{text}.", ""


def _level(run: RunOutput, has_advice: bool) -> str:
    lost = run.trajectory.lost
    if not len(lost) or lost.mean() > 0.2 or (len(lost) and lost[-1]) or _is_large(run):
        return "bad"
    return "doubtful" if has_advice or lost.any() else "good"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
