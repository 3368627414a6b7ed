"""Charts as inline SVG with labels in HTML, so that they stretch from a phone's width to a printed page.

The SVG holds lines alone and is stretched to the width there is; texts keep their size. The style sheet colors them,
and `web/charts.js` shows the values where a chart is pointed at.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spslam.evaluation.thinning import MAX_FRAMES, thin_frames
from spslam.evaluation.web_data import encode_json

# User units of a line chart's SVG, which is stretched.
WIDTH, HEIGHT = 1000, 100
_PLANE_WIDTH, _PLANE_HEIGHT = 1000, 440
_LEAST = 1e-6  # what is smaller is drawn as 0
_DIGITS = 4  # of the values that are shown


@dataclass(frozen=True)
class Series:
    """One line of a chart.

    Attributes:
        name: label in the legend.
        kind: CSS class, which sets the color.
        values: [F]; NaN values interrupt the line.
        dots: draw dots instead of a line.
    """

    name: str
    kind: str
    values: np.ndarray
    dots: bool = False


def line_chart(series: Sequence[Series], unit: str, marks: np.ndarray | None = None, from_zero: bool = True) -> str:
    """Draws values over frame numbers; of many frames those that show all peaks and gaps.

    Args:
        series: lines of the same length F.
        unit: unit of the values, shown at the top label.
        marks: bool [F], frames to mark with a vertical band, such as lost frames.
        from_zero: start the value axis at 0.

    Returns:
        HTML with a legend; empty without a finite value.
    """
    finite = np.concatenate([line.values[np.isfinite(line.values)] for line in series] or [np.zeros(0)])
    if not len(finite):
        return ""
    count = len(series[0].values)
    low, high = (min(0.0, finite.min()) if from_zero else finite.min()), max(finite.max(), _LEAST)
    ticks = nice_ticks(low, high)
    low, high = min(low, ticks[0]), max(high, ticks[-1])
    frames = thin_frames([(line.values, not line.dots) for line in series])

    def x(frame: np.ndarray) -> np.ndarray:
        return WIDTH * frame / max(count - 1, 1)

    def y(value: np.ndarray) -> np.ndarray:
        return HEIGHT * (high - value) / max(high - low, 1e-12)

    parts = ["".join(f'<path class="grid" d="M0 {place:.2f}H{WIDTH}"/>' for place in y(ticks))]
    parts.append(_bands(marks, count) if marks is not None and len(marks) == count else "")
    parts += [_draw(line, frames, x, y) for line in series]
    data = {
        "count": count,
        "low": float(low),
        "high": float(high),
        "unit": unit,
        "frames": frames.tolist(),
        "series": [{"name": line.name, "kind": line.kind, "values": _rounded(line.values[frames])} for line in series],
    }
    marked = [("lost", "lost")] if marks is not None and len(marks) == count and marks.any() else []
    svg = _svg((WIDTH, HEIGHT), "".join(parts), "none")
    plot = f'<div class="plot" tabindex="0">{svg}</div>{_value_labels(ticks, y, unit)}{_frame_labels(count)}'
    legend = _legend([*((line.name, line.kind) for line in series), *marked])
    return _chart("line-chart", plot, data, legend)


def trajectory_chart(estimate: np.ndarray, ground_truth: np.ndarray | None, lost: np.ndarray) -> str:
    """Draws a trajectory in the horizontal plane, in meters, with equal scale on both axes.

    Args:
        estimate: [F, 2].
        ground_truth: [F, 2] in the same axes, NaN where unknown, or None.
        lost: bool [F]; the estimated trajectory has a gap there.

    Returns:
        HTML with a legend; empty without a position.
    """
    known = (
        estimate
        if ground_truth is None
        else np.concatenate([estimate, ground_truth[np.isfinite(ground_truth).all(axis=1)]])
    )
    if not len(known):
        return ""
    low, high = known.min(axis=0), known.max(axis=0)
    margin = 0.08 * max(float((high - low).max()), 0.1)
    low, high = low - margin, high + margin
    scale = min(_PLANE_WIDTH / (high[0] - low[0]), _PLANE_HEIGHT / (high[1] - low[1]))
    width, height = (high - low) * scale

    def place(points: np.ndarray) -> np.ndarray:
        return (points - low) * scale * (1, -1) + (0, height)

    tracked = np.where(lost[:, None], np.nan, estimate)
    frames = thin_frames([(column, True) for column in tracked.T])
    step = nice_ticks(0, float((high - low).max()), 6)[1]
    parts = [_grid(low, high, step, scale, height)]
    if ground_truth is not None:
        parts.append(f'<path class="line ground-truth" d="{_path(place(ground_truth[frames]))}"/>')
    parts.append(f'<path class="line estimate" d="{_path(place(tracked[frames]))}"/>')
    # All frames of a loss have the same placeholder.
    parts.append(f'<path class="dots lost" d="{_dots(np.unique(place(estimate[lost]).round(1), axis=0))}"/>')
    ends = place(estimate[[0, -1]])
    parts.append(f'<path class="dots ends estimate" d="{_dots(ends)}"/><path class="dots end" d="{_dots(ends[1:])}"/>')
    data = {"unit": "m", "frames": frames.tolist(), "points": _rounded(place(tracked[frames]).reshape(-1), 1)}
    data["meters"] = _rounded(estimate[frames].reshape(-1))
    names = [("estimate (disc: start, ring: end)", "estimate")]
    names += [("ground truth", "ground-truth")] if ground_truth is not None else []
    names += [("lost", "lost")] if lost.any() else []
    names += [(f"grid of {step:g} m", "scale")]
    plot = f'<div class="plot" tabindex="0">{_svg((width, height), "".join(parts), "xMidYMid meet")}</div>'
    return _chart("plane-chart", plot, data, _legend(names))


def stacked_bar(shares: Sequence[tuple[str, str, float]], unit: str) -> str:
    """Draws parts of a total as a stacked bar.

    Args:
        shares: (name, CSS class, amount) in order; amounts of 0 are left out.
        unit: unit of the amounts.

    Returns:
        HTML with a legend; empty if the total is 0.
    """
    shares = [(name, kind, amount) for name, kind, amount in shares if amount > 0]
    total = sum(amount for _, _, amount in shares)
    if not total:
        return ""
    parts = []
    for name, kind, amount in shares:
        share = amount / total
        title = html.escape(f"{name}: {amount:.3g} {unit}, {share:.0%}")
        label = f"<span>{share:.0%}</span>" if share > 0.1 else ""
        parts.append(f'<div class="bar {kind}" style="flex-grow:{share:.4f}" title="{title}">{label}</div>')
    legend = [(f"{name} {amount:.3g} {unit} ({amount / total:.0%})", kind) for name, kind, amount in shares]
    return f'<div class="whole"><div class="stacked-bar">{"".join(parts)}</div>{_legend(legend)}</div>'


def nice_ticks(low: float, high: float, count: int = 5) -> np.ndarray:
    """About `count` round numbers that cover [low, high]."""
    step = max(high - low, 1e-12) / count
    magnitude = 10.0 ** np.floor(np.log10(step))
    step = magnitude * next(factor for factor in (1, 2, 2.5, 5, 10) if factor * magnitude >= step * 0.999)
    return np.arange(np.floor(low / step), np.ceil(high / step - 1e-9) + 1) * step


def _chart(kind: str, plot: str, data: dict, legend: str) -> str:
    values = f'<script type="application/json">{encode_json(data)}</script>'
    return f'<div class="whole"><div class="chart {kind}">{plot}{values}</div>{legend}</div>'


def _draw(line: Series, frames: np.ndarray, x, y) -> str:
    points = np.stack([x(frames), y(line.values[frames])], axis=1)
    if line.dots:
        return f'<path class="dots {line.kind}" d="{_dots(points)}"/>'
    return f'<path class="line {line.kind}" d="{_path(points)}"/>'


def _path(points: np.ndarray) -> str:
    """A line through points [N, 2] with a gap where one is NaN; one between two gaps is a dot."""
    parts, pen_up, length = [], True, 0
    for u, v in points:
        if np.isfinite(u) and np.isfinite(v):
            parts.append(f"{'M' if pen_up else 'L'}{u:.1f} {v:.2f}")
            pen_up, length = False, length + 1
        else:
            parts += ["h.01"] if length == 1 else []
            pen_up, length = True, 0
    return "".join(parts) + ("h.01" if length == 1 else "")


def _dots(points: np.ndarray) -> str:
    """Dots at the finite ones of points [N, 2]: lines of almost no length with round ends, whatever the stretch."""
    return "".join(f"M{u:.1f} {v:.2f}h.01" for u, v in points[np.isfinite(points).all(axis=1)])


def _bands(marks: np.ndarray, count: int) -> str:
    """Bands over runs of marked frames, half a frame wider on both sides; of many frames at a coarser resolution."""
    if count > MAX_FRAMES:
        places = np.flatnonzero(marks) * MAX_FRAMES // count
        marks, count = np.isin(np.arange(MAX_FRAMES), places), MAX_FRAMES
    runs = np.flatnonzero(np.diff(np.concatenate([[False], marks, [False]]).astype(int))).reshape(-1, 2)
    sides = WIDTH * np.clip((runs - 0.5) / max(count - 1, 1), 0, 1)
    return f'<path class="lost" d="{"".join(f"M{a:.1f} 0H{b:.1f}V{HEIGHT}H{a:.1f}Z" for a, b in sides)}"/>'


def _value_labels(ticks: np.ndarray, y, unit: str) -> str:
    parts = []
    for tick, place in zip(ticks, y(ticks), strict=True):
        label = f"{tick:g}" if abs(tick) > 1e-6 * abs(ticks[-1] - ticks[0]) else "0"
        suffix = f" {html.escape(unit)}" if tick == ticks[-1] else ""
        parts.append(f'<span style="top:{100 * place / HEIGHT:.2f}%">{label}{suffix}</span>')
    return f'<div class="value-labels">{"".join(parts)}</div>'


def _frame_labels(count: int) -> str:
    last = max(count - 1, 1)
    ticks = [tick for tick in nice_ticks(0, last, 8) if tick <= count - 1 and tick == int(tick)]
    # The last label says what is counted, so nothing else stands near it.
    labels = [f'<span style="left:{100 * tick / last:.2f}%">{tick:g}</span>' for tick in ticks if tick <= 0.93 * last]
    return f'<div class="frame-labels">{"".join(labels)}<span class="axis-name">frame</span></div>'


def _grid(low: np.ndarray, high: np.ndarray, step: float, scale: float, height: float) -> str:
    """A grid at round distances in meters."""
    width = (high[0] - low[0]) * scale
    verticals = (np.arange(np.ceil(low[0] / step), np.floor(high[0] / step) + 1) * step - low[0]) * scale
    horizontals = height - (np.arange(np.ceil(low[1] / step), np.floor(high[1] / step) + 1) * step - low[1]) * scale
    lines = "".join(f"M{u:.1f} 0V{height:.1f}" for u in verticals) + "".join(
        f"M0 {v:.1f}H{width:.1f}" for v in horizontals
    )
    return f'<path class="grid" d="{lines}"/>'


def _legend(entries: Sequence[tuple[str, str]]) -> str:
    items = "".join(f'<li><span class="key {kind}"></span>{html.escape(name)}</li>' for name, kind in entries)
    return f'<ul class="legend">{items}</ul>'


def _svg(size: tuple[float, float], content: str, aspect: str) -> str:
    view_box = f"0 0 {size[0]:.0f} {size[1]:.0f}"
    return f'<svg viewBox="{view_box}" preserveAspectRatio="{aspect}" aria-hidden="true">{content}</svg>'


def _rounded(values: np.ndarray, decimals: int | None = None) -> list[float | None]:
    """Values with the digits that are shown, None for NaN."""
    if decimals is not None:
        return [round(float(value), decimals) if np.isfinite(value) else None for value in values]
    return [float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None for value in values]
