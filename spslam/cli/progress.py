"""Progress display of a run, and the summary at its end."""

from __future__ import annotations

import contextlib
import math
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spslam.run_folder import RunFolder

SECONDS_BETWEEN_LINES = 5.0


def make_progress(quiet: bool) -> ProgressBar | ProgressLines | None:
    """A callback for `run_sequence`: a progress bar on a terminal, else a line every few seconds; None if quiet."""
    if quiet:
        return None
    return ProgressBar() if sys.stderr.isatty() else ProgressLines()


class ProgressBar:
    """A progress bar on a terminal: completed frames, frames per second, and the state of the last frame."""

    def __init__(self) -> None:
        self._bar: Any = None

    def __call__(self, done: int, total: int, report: Any) -> None:
        if self._bar is None:
            from tqdm import tqdm

            bar = (
                "{desc}{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_noinv_fmt}{postfix}]"
            )
            # Some terminals report a size of 0 by 0; tqdm would then show an empty bar.
            columns, rows = shutil.get_terminal_size()
            self._bar = tqdm(total=total, initial=done - 1, unit=" frames", ncols=columns, nrows=rows, bar_format=bar)
        self._bar.set_postfix_str(describe(report), refresh=False)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """Ends the line of the progress bar."""
        if self._bar is not None:
            self._bar.close()


class ProgressLines:
    """Progress as plain lines, one every few seconds and one at the end."""

    def __init__(self) -> None:
        self._last = time.monotonic()
        self._rate = Rate()

    def __call__(self, done: int, total: int, report: Any) -> None:
        self._rate.count()
        now = time.monotonic()
        if done < total and now - self._last < SECONDS_BETWEEN_LINES:
            return
        self._last = now
        with contextlib.suppress(BrokenPipeError):  # whoever read this has gone, which is no reason to end
            text = f"{done}/{total} frames, {self._rate.fps():.1f} frames/s, {describe(report)}"
            print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Nothing to do."""


class Rate:
    """Counts frames per second since its creation."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._frames = 0

    def count(self) -> None:
        self._frames += 1

    def fps(self) -> float:
        return self._frames / max(time.monotonic() - self._started, 1e-9)


def describe(report: Any) -> str:
    """The state of a frame: ok, LOST or skipped; its tracking residual, and the mapping loss if it was mapped."""
    if report is None:
        return "unreadable frame skipped"
    parts = ["LOST" if report.lost else "ok"]
    if not math.isnan(report.fit.residual_cm):
        parts.append(f"residual {report.fit.residual_cm:.2f} cm")
    if report.loss is not None:
        parts.append(f"loss {report.loss:.3f}")
    return ", ".join(parts)


def print_summary(metrics: Mapping[str, Any], output: Path) -> None:
    """Prints the most important metrics and the paths of the results."""
    for name, value in summarize(metrics, output):
        print(f"{name:<14}{value}")
    for warning in metrics.get("warnings", ()):
        print(f"! {warning}")


def summarize(metrics: Mapping[str, Any], output: Path) -> list[tuple[str, str]]:
    """Rows (name, value) of the summary of a run; metrics that were not measured are left out."""
    rows = [("frames", _frames(metrics)), *_verdict(metrics)]
    for name, key, form in (
        ("speed", "fps", "{:.1f} frames/s"),
        ("latency", "latency_p50_ms", "{:.0f} ms"),
        ("latency p99", "latency_p99_ms", "{:.0f} ms"),
        ("ATE RMSE", "ate_rmse_cm", "{:.2f} cm"),
        ("ATE, scaled", "ate_scaled_rmse_cm", "{:.2f} cm"),
        ("scale", "ate_scale", "{:.4f}"),
        ("RPE", "rpe_cm", "{:.2f} cm/frame"),
        ("accuracy", "accuracy_cm", "{:.2f} cm"),
        ("completeness", "completeness_cm", "{:.2f} cm"),
        ("F1 at 5 cm", "f1_5cm", "{:.1f} %"),
        ("F1 at 1 cm", "f1_1cm", "{:.1f} %"),
        ("depth L1", "depth_l1_cm", "{:.2f} cm"),
        ("PSNR", "psnr_db", "{:.1f} dB"),
        ("memory", "peak_rss_mb", "{:.0f} MB"),
        ("GPU memory", "peak_gpu_mb", "{:.0f} MB"),
    ):
        if metrics.get(key) is not None:
            rows.append((name, form.format(metrics[key])))
    folder = RunFolder(output)
    for path in (folder.trajectory, folder.mesh, folder.report):
        if path.is_file():
            rows.append((path.stem, str(path)))
    return rows


def _verdict(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    if "verdict" not in metrics:
        return []
    unknown = "" if "ate_rmse_cm" in metrics else "; scale and error unknown, as there is no ground truth"
    return [("verdict", f"{metrics['verdict']}{unknown}")]


def _frames(metrics: Mapping[str, Any]) -> str:
    details = [
        f"{metrics[key]} {word}"
        for key, word in (
            ("lost_frames", "lost"),
            ("skipped_frames", "skipped"),
            ("dropped_frames", "dropped"),
            ("unrecorded_frames", "not recorded"),
        )
        if metrics.get(key)
    ]
    return f"{metrics.get('frames', 0)}" + (f" ({', '.join(details)})" if details else "")
