"""Plots of a study as SVG: one panel per sequence, one line per series, a bar from the lowest to the highest seed."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from spslam.benchmark.figures import Statistic, figure
from spslam.benchmark.suites import Study
from spslam.benchmark.summary import Summary

WIDTH, HEIGHT = 330, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 30, 42
_LEGEND_HEIGHT = 26
# Distinguishable with color-vision deficiencies; in print the markers tell the lines apart.
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_STYLE = (
    "text{font:12px sans-serif;fill:#222}.title{font-weight:600}.grid{stroke:#ddd}.axis{stroke:#888}"
    ".line{fill:none;stroke-width:2}"
)


@dataclass(frozen=True)
class Line:
    """A series: its points (x, statistic) in order of x."""

    name: str
    points: tuple[tuple[float, Statistic], ...]


@dataclass(frozen=True)
class Panel:
    """One set of axes."""

    title: str
    lines: tuple[Line, ...]


def plot_study(summary: Summary, study: Study, name: str) -> str | None:
    """A figure over a study's axis, one panel per sequence; None where nothing was measured."""
    panels = [
        Panel(sequence, lines)
        for sequence in summary.sequences(study)
        if (lines := tuple(_lines(summary, study, sequence, name)))
    ]
    return draw(panels, study.x_label, figure(name).label, study.x_log) if panels else None


def _lines(summary: Summary, study: Study, sequence: str, name: str) -> list[Line]:
    lines = []
    for series in dict.fromkeys(variant.series for variant in study.variants):
        found = [
            (variant.x, statistic)
            for variant in study.variants
            if variant.series == series
            and variant.x is not None
            and (statistic := summary.value(study, sequence, variant.name, name)) is not None
        ]
        if found:
            lines.append(Line(series, tuple(sorted(found, key=lambda point: point[0]))))
    return lines


def draw(panels: Sequence[Panel], x_label: str, y_label: str, x_log: bool) -> str:
    """An SVG file with panels side by side above one legend.

    A value axis is logarithmic if its values span more than a factor of 20.

    Args:
        panels: at least one.
        x_label: of the horizontal axis.
        y_label: of the value axis; part of each panel's title.
        x_log: whether the horizontal axis is logarithmic.
    """
    names = list(dict.fromkeys(line.name for panel in panels for line in panel.lines))
    parts = [_panel(panel, i * WIDTH, names, x_label, y_label, x_log) for i, panel in enumerate(panels)]
    parts.append(_legend(names, HEIGHT))
    width = max(WIDTH * len(panels), 60 + sum(34 + 7 * len(name) for name in names))
    size = f"{width} {HEIGHT + _LEGEND_HEIGHT}"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" width="{width}">'
    return f'{head}<style>{_STYLE}</style><rect width="100%" height="100%" fill="#fff"/>{"".join(parts)}</svg>\n'


def _panel(panel: Panel, left: float, names: list[str], x_label: str, y_label: str, x_log: bool) -> str:
    points = [point for line in panel.lines for point in line.points]
    x_ticks = sorted({x for x, _ in points})
    values = [value for _, s in points for value in (s.low, s.high)]
    y_log = min(values) > 0 and max(values) > 20 * min(values)
    y_ticks = _log_ticks(min(values), max(values)) if y_log else _ticks(max(values))
    x = _scale(x_ticks[0], x_ticks[-1], left + _LEFT, left + WIDTH - _RIGHT, x_log and x_ticks[0] > 0)
    y = _scale(y_ticks[0], y_ticks[-1], HEIGHT - _BOTTOM, _TOP, y_log)
    right = left + WIDTH - _RIGHT
    parts = [f'<text class="title" x="{left + _LEFT}" y="18">{html.escape(panel.title)}: {html.escape(y_label)}</text>']
    for tick in y_ticks:
        parts.append(f'<path class="grid" d="M{left + _LEFT} {y(tick):.1f}H{right}"/>')
        parts.append(f'<text x="{left + _LEFT - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in x_ticks:
        parts.append(f'<path class="axis" d="M{x(tick):.1f} {HEIGHT - _BOTTOM}v4"/>')
        parts.append(f'<text x="{x(tick):.1f}" y="{HEIGHT - _BOTTOM + 17}" text-anchor="middle">{tick:g}</text>')
    middle = (left + _LEFT + right) / 2
    parts.append(f'<text x="{middle:.1f}" y="{HEIGHT - 8}" text-anchor="middle">{html.escape(x_label)}</text>')
    return "".join([*parts, *(_line(line, names.index(line.name), x, y) for line in panel.lines)])


def _line(line: Line, index: int, x: Callable[[float], float], y: Callable[[float], float]) -> str:
    color = _COLORS[index % len(_COLORS)]
    path = "L".join(f"{x(at):.1f} {y(s.mean):.1f}" for at, s in line.points)
    parts = [f'<path class="line" stroke="{color}" d="M{path}"/>']
    for at, statistic in line.points:
        if statistic.high > statistic.low:
            parts.append(f'<path stroke="{color}" d="M{x(at):.1f} {y(statistic.low):.1f}V{y(statistic.high):.1f}"/>')
        parts.append(_marker(index, x(at), y(statistic.mean), color))
    return "".join(parts)


def _marker(index: int, x: float, y: float, color: str) -> str:
    if index % 3 == 0:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{color}"/>'
    if index % 3 == 1:
        return f'<rect x="{x - 3:.1f}" y="{y - 3:.1f}" width="6" height="6" fill="{color}"/>'
    return f'<path d="M{x - 4:.1f} {y + 3:.1f}h8l-4 -7z" fill="{color}"/>'


def _legend(names: list[str], top: float) -> str:
    parts, left = [], 20.0
    for index, name in enumerate(names):
        parts.append(_marker(index, left, top + 8, _COLORS[index % len(_COLORS)]))
        parts.append(f'<text x="{left + 10:.0f}" y="{top + 12:.0f}">{html.escape(name)}</text>')
        left += 34 + 7 * len(name)
    return "".join(parts)


def _scale(low: float, high: float, start: float, stop: float, log: bool) -> Callable[[float], float]:
    """Maps [low, high] to [start, stop] in the picture."""
    place = math.log10 if log else float
    span = place(high) - place(low) or 1.0
    return lambda value: start + (stop - start) * (place(value) - place(low)) / span


def _ticks(high: float) -> list[float]:
    """About five round numbers from 0 to at least `high`."""
    step = max(high, 1e-9) / 4
    magnitude = 10.0 ** math.floor(math.log10(step))
    step = magnitude * next(factor for factor in (1, 2, 2.5, 5, 10) if factor * magnitude >= step * 0.999)
    return [round(step * i, 12) for i in range(math.ceil(high / step - 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """The powers of ten that enclose [low, high]."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    return [10.0**power for power in range(first, last + 1)]
