"""Writes report.html, a self-contained page about one run, from the files in its output folder."""

from __future__ import annotations

import html
import os
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from spslam.config import Config, load_config, read_shipped
from spslam.datasets.prefetch import usable_cores
from spslam.errors import ConfigError
from spslam.evaluation.html_parts import section, security_policy, table, web_file
from spslam.evaluation.report_charts import error_section, time_section, tracking_section, trajectory_section
from spslam.evaluation.report_map import outward_mesh, overview_figure, views_section
from spslam.evaluation.report_view import LIBRARY, packed_mesh, view_3d
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.verdict import judge_run, number
from spslam.io import atomic_write

MAX_BYTES = 8_000_000
# For style, scripts and what is around the sections.
_RESERVED_BYTES = 100_000
# The mesh, and the pictures of it, of which each needs some 200 MB.
_THREADS = 5
_SCRIPTS = ("charts.js", "unpack.js", "scene.js", "view3d.js")
_STYLE = "report.css"
# The metrics at the top: label, key in metrics.json, format.
_TILES = (
    ("frames", "frames", "{:,.0f}"),
    ("frames/s", "fps", "{:.1f}"),
    ("ATE RMSE", "ate_rmse_cm", "{:.2f} cm"),
    ("F1 at 5 cm", "f1_5cm", "{:.1f} %"),
    ("lost frames", "lost_frames", "{:.0f}"),
    ("loops closed", "closed_loops", "{:.0f}"),
    ("frames/s of tracking", "tracking_fps", "{:.0f}"),
    ("model", "model_mb", "{:.1f} MB"),
    ("memory", "peak_rss_mb", "{:,.0f} MB"),
)


def write_report(output_dir: str | os.PathLike) -> Path:
    """Writes `report.html` of a finished run.

    The page is one file of at most 8 MB that requests nothing: styles, images, data and scripts are embedded. Charts
    are SVG; a script shows their values where they are pointed at, and another one the map in 3-D, by three.js. Without
    scripts or WebGL, and in print, pictures stand for the 3-D view.

    Args:
        output_dir: output folder of the run. `trajectory.txt` and `metrics.json` are required. `mesh.ply`,
            `log.jsonl`, `config.yaml` and `previews/` are optional: without one of them its sections are left out.
            `previews/` has `camera.json`, `ground_truth.txt`, `frame-NNNNNN.png` and `depth-NNNNNN.png` in 16-bit
            millimeters, numbered by row of the trajectory.

    Returns:
        Path of the report.

    Raises:
        OutputError: the folder is not the output folder of a finished run, a file in it is damaged, or the report
            cannot be written.
    """
    run = RunOutput.read(Path(output_dir))
    config = _options(run)
    mesh = outward_mesh(run)
    above = [_header(run), _verdict(run, config), _tiles(run.metrics), _warnings(run.metrics)]
    with ThreadPoolExecutor(min(usable_cores(), _THREADS)) as threads:  # they work without Python's lock
        packing = None if mesh is None else threads.submit(packed_mesh, mesh)  # takes longest
        picturing = None if mesh is None else threads.submit(overview_figure, run, mesh)
        below = [views_section(run, mesh, threads), error_section(run), time_section(run), tracking_section(run)]
        below += [_paper_table(run.metrics), _command(run, config), _figures(run.metrics), _settings(run)]
        still, packed = picturing.result() if picturing else "", packing.result() if packing else None
    used = _size([*above, *below, trajectory_section(run, "")]) + _RESERVED_BYTES
    view = view_3d(run, mesh, packed, still, MAX_BYTES - used) if len(run.trajectory) else ""
    of_map = "" if mesh is None else section("Map", view)
    trajectory = trajectory_section(run, view if mesh is None else "")
    path = run.folder.report
    atomic_write(path, _encoded(_page(run, [*above, of_map, below[0], trajectory, *below[1:]])))
    return path


def _size(parts: list[str]) -> int:
    return sum(map(len, map(_encoded, parts)))


def _encoded(text: str) -> bytes:
    """UTF-8; JSON may hold halves of characters, which it has no code for."""
    return text.encode("utf-8", "replace")


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
{scripts}
</body>
</html>
"""


def _page(run: RunOutput, sections: list[str]) -> str:
    scripts = [web_file(name) for name in _SCRIPTS]
    return _PAGE.format(
        policy=security_policy([*scripts, web_file(LIBRARY)]),
        title=html.escape(f"spslam: {_name(run)}"),
        style=web_file(_STYLE),
        body="\n".join(sections),
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
    )


def _name(run: RunOutput) -> str:
    return run.folder.path.resolve().name


def _options(run: RunOutput) -> Config | None:
    """The options of the run; None if config.yaml is missing or was changed to something else."""
    try:
        return load_config(run.folder.config) if run.config else None
    except ConfigError:
        return None


def _header(run: RunOutput) -> str:
    known = run.metrics
    facts = [known.get("device_name"), f"spslam {known['version']}" if "version" in known else None]
    facts.append(f"seed {known['seed']}" if "seed" in known else None)
    text = " · ".join(html.escape(str(fact)) for fact in facts if fact)
    return f"<header><h1>{html.escape(_name(run))}</h1><p>{text}</p></header>"


def _verdict(run: RunOutput, config: Config | None) -> str:
    verdict = judge_run(run, config)
    details = "".join(f"<li>{_prose(text)}</li>" for text in verdict.details)
    advice = "".join(f"<li>{_prose(text)}</li>" for text in verdict.advice)
    parts = f'<p class="headline">{html.escape(verdict.headline)}</p><ul>{details}</ul>'
    parts += f'<p class="to-try">What to try</p><ul>{advice}</ul>' if advice else ""
    return f'<section class="verdict {verdict.level}">{parts}</section>'


def _prose(text: str) -> str:
    """Escaped text, with what is in backticks as code."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text))


def _tiles(metrics: dict[str, Any]) -> str:
    known = [(name, form, number(metrics.get(key))) for name, key, form in _TILES]
    tiles = [
        f"<div><dt>{name}</dt><dd>{form.format(value)}</dd></div>" for name, form, value in known if value == value
    ]
    return f'<dl class="tiles">{"".join(tiles)}</dl>'


def _warnings(metrics: dict[str, Any]) -> str:
    items = "".join(f"<li>{html.escape(str(warning))}</li>" for warning in metrics.get("warnings", ()))
    note = "what a look at the first frames says of the data; `spslam check-data` shows more"
    return section("Doubts about the data", f"<ul>{items}</ul>" if items else "", note)


# Columns of the paper's Table I: title, keys in metrics.json, format.
_PAPER_COLUMNS = (
    ("Comp. (%)", ("completeness_5cm",), "{:.2f}"),
    ("Accu. (%)", ("accuracy_5cm",), "{:.2f}"),
    ("F1 (%)", ("f1_5cm",), "{:.2f}"),
    ("Track. (ms)", ("tracking_ms_per_iteration", "tracking_iterations"), "{:.2f} × {:.0f}"),
    ("Map. (ms)", ("mapping_ms_per_iteration", "mapping_iterations"), "{:.2f} × {:.0f}"),
    ("Track. FPS", ("tracking_fps",), "{:.2f}"),
    ("Avg. FPS", ("fps",), "{:.2f}"),
    ("#param (MB)", ("model_mb",), "{:.1f}"),
    ("GPU (MB)", ("peak_gpu_mb",), "{:.0f}"),
)


def _paper_table(metrics: dict[str, Any]) -> str:
    rows = []
    for title, keys, form in _PAPER_COLUMNS:
        values = [number(metrics.get(key)) for key in keys]
        rows += [(title, form.format(*values))] if all(value == value for value in values) else []
    note = "the columns of SP-SLAM's Table I: surface at 5 cm, time per iteration × iterations, size of the parameters"
    return section("As in the paper", table(rows) if rows else "", note)


def _command(run: RunOutput, config: Config | None) -> str:
    """The command of the run, and its options that differ from the defaults."""
    command = run.metrics.get("command")
    body = f'<pre class="command">{html.escape(command)}</pre>' if isinstance(command, str) and command else ""
    if config is not None:
        rows = _changed_options(config)
        body += table(rows, ("option", "this run", "default")) if rows else "<p>All options have their defaults.</p>"
    return section(
        "Command and options", body, "options that differ from the preset's defaults; Settings below has all"
    )


def _changed_options(config: Config) -> list[tuple[str, str, str]]:
    """Option, value, and default of the run's preset, of those that differ from it; the preset itself first."""
    defaults, preset = read_shipped("defaults.yaml"), read_shipped(f"presets/{config.preset}.yaml")
    rows = []
    for name, value in config.model_dump(mode="json").items():
        usual = defaults.get(name)
        if isinstance(value, dict):
            usual = {**(usual or {}), **preset.get(name, {})}
            pairs = [(f"{name}.{key}", this, usual.get(key)) for key, this in value.items()]
        else:
            pairs = [(name, value, usual)]
        rows += [(path, _option(this), _option(default)) for path, this, default in pairs if this != default]
    return rows


def _option(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _figures(metrics: dict[str, Any]) -> str:
    return section(
        "All metrics", table([(key, _format(value)) for key, value in metrics.items()]), "as in metrics.json"
    )


def _format(value: Any) -> str:
    return f"{value:,.4g}" if isinstance(value, float) and abs(value) < 1e5 else str(value)


def _settings(run: RunOutput) -> str:
    if not run.config:
        return ""
    return f"<section><details><summary>Settings</summary><pre>{html.escape(run.config)}</pre></details></section>"
