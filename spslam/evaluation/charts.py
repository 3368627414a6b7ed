"""Charts as inline SVG, colored by the style sheet of the report."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

WIDTH, HEIGHT = 1030, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 68, 12, 10, 30
_MAX_POINTS = 2000


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
    """Draws values over frame numbers.

    Args:
        series: lines of the same length F.
        unit: unit of the values, shown at the top label.
        marks: bool [F], frames to mark with a vertical line, such as lost frames.
        from_zero: start the value axis at 0.

    Returns:
        SVG with a legend; empty without a finite value.
    """
    finite = np.concatenate([line.values[np.isfinite(line.values)] for line in series] or [np.zeros(0)])
    if not len(finite):
        return ""
    count = len(series[0].values)
    low, high = (min(0.0, finite.min()) if from_zero else finite.min()), max(finite.max(), 1e-9)
    ticks = nice_ticks(low, high)
    low, high = min(low, ticks[0]), max(high, ticks[-1])

    def x(frame: np.ndarray) -> np.ndarray:
        return _LEFT + (WIDTH - _LEFT - _RIGHT) * frame / max(count - 1, 1)

    def y(value: np.ndarray) -> np.ndarray:
        return _TOP + (HEIGHT - _TOP - _BOTTOM) * (high - value) / max(high - low, 1e-12)

    parts = [_value_axis(ticks, y, unit), _frame_axis(count, x)]
    if marks is not None and marks.any():
        frames = np.flatnonzero(marks)
        parts += [f'<path class="lost" d="{"".join(f"M{v:.1f} {_TOP}V{HEIGHT - _BOTTOM}" for v in x(frames))}"/>']
    parts += [_draw(line, x, y) for line in series]
    return _svg(WIDTH, HEIGHT, "".join(parts)) + _legend([(line.name, line.kind) for line in series])


def trajectory_chart(estimate: np.ndarray, ground_truth: np.ndarray | None, lost: np.ndarray) -> str:
    """Draws a trajectory in the horizontal plane, in meters, with equal scale on both axes.

    Args:
        estimate: [F, 2].
        ground_truth: [F, 2] in the same axes, NaN where unknown, or None.
        lost: bool [F]; the estimated trajectory has a gap there.

    Returns:
        SVG with a legend; empty without a position.
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
    scale = min((WIDTH - 20) / (high[0] - low[0]), 460 / (high[1] - low[1]))
    width, height = (high - low) * scale

    def place(points: np.ndarray) -> np.ndarray:
        return (points - low) * scale * (1, -1) + (0, height)

    parts = [_grid(low, high, scale, height)]
    if ground_truth is not None:
        parts.append(f'<path class="line ground-truth" d="{_path(place(ground_truth))}"/>')
    tracked = np.where(lost[:, None], np.nan, estimate)
    parts.append(f'<path class="line estimate" d="{_path(place(tracked))}"/>')
    parts += [f'<circle class="dot lost" cx="{u:.1f}" cy="{v:.1f}" r="3"/>' for u, v in place(estimate[lost])]
    (u, v), (end_u, end_v) = place(estimate[0]), place(estimate[-1])
    parts.append(f'<circle class="dot estimate" cx="{u:.1f}" cy="{v:.1f}" r="5"><title>start</title></circle>')
    parts.append(f'<circle class="ring estimate" cx="{end_u:.1f}" cy="{end_v:.1f}" r="5"><title>end</title></circle>')
    names = [("estimate (disc: start, ring: end)", "estimate")]
    names += [("ground truth", "ground-truth")] if ground_truth is not None else []
    names += [("lost", "lost")] if lost.any() else []
    return _svg(width, height, "".join(parts)) + _legend(names)


def stacked_bar(shares: Sequence[tuple[str, str, float]], unit: str) -> str:
    """Draws parts of a total as a stacked bar.

    Args:
        shares: (name, CSS class, amount) in order; amounts of 0 are left out.
        unit: unit of the amounts.

    Returns:
        SVG with a legend; empty if the total is 0.
    """
    shares = [(name, kind, amount) for name, kind, amount in shares if amount > 0]
    total = sum(amount for _, _, amount in shares)
    if not total:
        return ""
    parts, x = [], 0.0
    for name, kind, amount in shares:
        width = WIDTH * amount / total
        title = html.escape(f"{name}: {amount:.3g} {unit}, {amount / total:.0%}")
        parts.append(f'<rect class="bar {kind}" x="{x:.1f}" y="0" width="{max(width - 2, 1):.1f}" height="34" rx="3">')
        parts.append(f"<title>{title}</title></rect>")
        if width > 70:
            parts.append(f'<text class="on-bar" x="{x + width / 2:.1f}" y="22">{amount / total:.0%}</text>')
        x += width
    legend = [(f"{name} {amount:.3g} {unit}", kind) for name, kind, amount in shares]
    return _svg(WIDTH, 34, "".join(parts)) + _legend(legend)


def nice_ticks(low: float, high: float, count: int = 5) -> np.ndarray:
    """About `count` round numbers that cover [low, high]."""
    step = max(high - low, 1e-12) / count
    magnitude = 10.0 ** np.floor(np.log10(step))
    step = magnitude * next(factor for factor in (1, 2, 2.5, 5, 10) if factor * magnitude >= step * 0.999)
    return np.arange(np.floor(low / step), np.ceil(high / step - 1e-9) + 1) * step


def _draw(line: Series, x, y) -> str:
    frames = np.arange(len(line.values))
    if line.dots:
        known = np.flatnonzero(np.isfinite(line.values))[: 2 * _MAX_POINTS]
        points = zip(x(known), y(line.values[known]), strict=True)
        return "".join(f'<circle class="dot {line.kind}" cx="{u:.1f}" cy="{v:.1f}" r="1.8"/>' for u, v in points)
    return f'<path class="line {line.kind}" d="{_path(np.stack([x(frames), y(line.values)], axis=1))}"/>'


def _path(points: np.ndarray) -> str:
    step = max(1, len(points) // _MAX_POINTS)
    parts, pen_up = [], True
    for u, v in points[::step]:
        if np.isfinite(u) and np.isfinite(v):
            parts.append(f"{'M' if pen_up else 'L'}{u:.1f} {v:.1f}")
            pen_up = False
        else:
            pen_up = True
    return "".join(parts)


def _value_axis(ticks: np.ndarray, y, unit: str) -> str:
    parts = []
    for tick, place in zip(ticks, y(ticks), strict=True):
        label = f"{tick:g}" if abs(tick) > 1e-9 else "0"
        suffix = f" {unit}" if tick == ticks[-1] else ""
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{place:.1f}" y2="{place:.1f}"/>')
        parts.append(f'<text class="label end" x="{_LEFT - 6}" y="{place + 4:.1f}">{label}{html.escape(suffix)}</text>')
    return "".join(parts)


def _frame_axis(count: int, x) -> str:
    ticks = [tick for tick in nice_ticks(0, max(count - 1, 1), 8) if tick <= count - 1 and tick == int(tick)]
    labels = [
        f'<text class="label middle" x="{x(np.float64(tick)):.1f}" y="{HEIGHT - 10}">{tick:g}</text>' for tick in ticks
    ]
    return "".join(labels) + f'<text class="label end" x="{WIDTH - _RIGHT}" y="{HEIGHT - 10}">frame</text>'


def _grid(low: np.ndarray, high: np.ndarray, scale: float, height: float) -> str:
    """A grid at round distances in meters, with a scale bar."""
    step = nice_ticks(0, float((high - low).max()), 6)[1]
    width = (high[0] - low[0]) * scale
    verticals = (np.arange(np.ceil(low[0] / step), np.floor(high[0] / step) + 1) * step - low[0]) * scale
    horizontals = height - (np.arange(np.ceil(low[1] / step), np.floor(high[1] / step) + 1) * step - low[1]) * scale
    lines = "".join(f"M{u:.1f} 0V{height:.1f}" for u in verticals) + "".join(
        f"M0 {v:.1f}H{width:.1f}" for v in horizontals
    )
    bar = f"M10 {height - 12:.1f}h{step * scale:.1f}"
    label = f'<text class="label" x="{16 + step * scale:.1f}" y="{height - 8:.1f}">{step:g} m</text>'
    return f'<path class="grid" d="{lines}"/><path class="scale-bar" d="{bar}"/>{label}'


def _legend(entries: Sequence[tuple[str, str]]) -> str:
    items = "".join(f'<li><span class="key {kind}"></span>{html.escape(name)}</li>' for name, kind in entries)
    return f'<ul class="legend">{items}</ul>'


def _svg(width: float, height: float, content: str) -> str:
    return f'<svg viewBox="0 0 {width:.0f} {height:.0f}" style="max-width:{width:.0f}px" role="img">{content}</svg>'
