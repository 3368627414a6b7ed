"""Results of a suite: summary.json, results.md, results.html, plots, and tables in regions of a Markdown page."""

from __future__ import annotations

import html
import json
import os
import re
from pathlib import Path
from typing import Any

from spslam.benchmark.figures import figure
from spslam.benchmark.study_plots import plot_study
from spslam.benchmark.summary import Summary
from spslam.benchmark.tables import Table, make_tables, to_markdown
from spslam.errors import OutputError
from spslam.io import atomic_write

PLOTS = "plots"
# A page's regions: <!-- bench NAME --> ... <!-- /bench -->, NAME a table's, `SUITE` for the measured machine, or
# `plots STUDY`.
_REGION = re.compile(r"(<!-- bench ([^>]+?) -->\n).*?(<!-- /bench -->)", re.DOTALL)


def write_results(summary: Summary, output: Path) -> list[Table]:
    """Writes summary.json, results.md, results.html and plots/ into a folder.

    Args:
        summary: of the suite.
        output: the folder.

    Returns:
        The tables.

    Raises:
        OutputError: a file can't be written.
    """
    tables = make_tables(summary)
    plots = write_plots(summary, output / PLOTS, f"{summary.suite.name}-")
    atomic_write(output / "summary.json", json.dumps(summary.to_dict(), indent=1) + "\n")
    atomic_write(output / "results.md", _markdown_page(summary, tables, plots))
    atomic_write(output / "results.html", _html_page(summary, tables, plots))
    return tables


def write_plots(summary: Summary, folder: Path, prefix: str) -> dict[str, list[Path]]:
    """Writes the plots of all studies.

    Args:
        summary: of the suite.
        folder: for the SVG files; created if there is a plot.
        prefix: of the file names.

    Returns:
        The files by study.
    """
    files: dict[str, list[Path]] = {}
    for study in summary.suite.studies:
        for name in study.plots:
            picture = plot_study(summary, study, name)
            if picture is not None:
                folder.mkdir(parents=True, exist_ok=True)
                path = folder / f"{prefix}{study.name}-{name}.svg"
                atomic_write(path, picture)
                files.setdefault(study.name, []).append(path)
    return files


def update_page(page: Path, summary: Summary) -> list[str]:
    """Replaces the content of a Markdown page's regions by tables and plots; the rest of the page is kept.

    The region from `<!-- bench SUITE NAME -->` to `<!-- /bench -->` holds the suite's table NAME, `SUITE machine` what
    it was measured on, and `SUITE plots STUDY` a study's plots, which are written into `images/` beside the page.

    Args:
        page: the file.
        summary: of the suite.

    Returns:
        Names of the regions replaced.

    Raises:
        OutputError: the page does not exist or has no region of this suite.
    """
    if not page.is_file():
        raise OutputError(f"{page}: no such page; it must have regions <!-- bench {summary.suite.name} NAME -->")
    plots = write_plots(summary, page.parent / "images", f"{summary.suite.name}-")
    content = {table.name: to_markdown(table) for table in make_tables(summary)}
    content["machine"] = describe_machine(summary)
    content |= {f"plots {study}": _pictures(summary, study, files, page) for study, files in plots.items()}
    return fill_regions(page, summary.suite.name, content)


def fill_regions(page: Path, prefix: str, content: dict[str, str]) -> list[str]:
    """Replaces the content of a Markdown page's regions `<!-- bench PREFIX NAME -->`.

    Args:
        page: the file.
        prefix: first word of the regions' names.
        content: new text by NAME; regions without one are kept.

    Returns:
        Names of the regions replaced.

    Raises:
        OutputError: the page has no region with this prefix.
    """
    filled: list[str] = []
    regions: list[str] = []

    def replace(match: re.Match[str]) -> str:
        first, _, name = match[2].partition(" ")
        regions.extend([name] if first == prefix else [])
        if first != prefix or name not in content:
            return match[0]
        filled.append(name)
        return f"{match[1]}{content[name].strip()}\n{match[3]}"

    text = _REGION.sub(replace, page.read_text(encoding="utf-8"))
    if not regions:
        raise OutputError(f"{page}: must have regions <!-- bench {prefix} NAME --> ... <!-- /bench -->, got none")
    atomic_write(page, text)
    return filled


def describe_machine(summary: Summary) -> str:
    """What the runs were measured on, as a list with a line per machine."""
    return "\n".join(f"- {line}" for line in _machines(summary)) or "Nothing was measured."


def describe_gaps(summary: Summary) -> list[str]:
    """What is missing in the tables: a line per skipped sequence and failed run."""
    lines = [f"skipped {name}: {reason}" for name, reason in summary.skipped.items()]
    return lines + [f"failed {line}" for line in summary.failed]


def _machines(summary: Summary) -> list[str]:
    return list(dict.fromkeys(_machine(environment) for environment in summary.environments))


def _machine(environment: dict[str, Any]) -> str:
    commit = f", commit {environment['commit']}" if environment.get("commit") else ""
    together = environment.get("runs_at_a_time", 1)
    return (
        f"{environment['device_name']}, {environment['kernel_threads']} kernel threads"
        f"{f', {together} runs at a time' if together > 1 else ''}; "
        f"spslam {environment['spslam']}{commit}, torch {environment['torch']}"
    )


def _pictures(summary: Summary, study: str, files: list[Path], page: Path) -> str:
    title = next(s.title for s in summary.suite.studies if s.name == study)
    lines = []
    for path in files:
        name = figure(path.stem.rpartition("-")[2]).label
        lines.append(f"![{title}: {name}]({os.path.relpath(path, page.parent)})")
    return "\n\n".join(lines)


def _markdown_page(summary: Summary, tables: list[Table], plots: dict[str, list[Path]]) -> str:
    parts = [f"# {summary.suite.title}", _seeds(summary), describe_machine(summary)]
    for table in tables:
        parts += [f"## {table.title}", to_markdown(table)]
        parts += [f"![{table.title}]({PLOTS}/{path.name})" for path in plots.get(table.name, [])]
    gaps = describe_gaps(summary)
    parts += ["## Not measured", "\n".join(f"- {line}" for line in gaps)] if gaps else []
    return "\n\n".join(parts) + "\n"


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body{{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:75em;padding:0 1em;color:#222;background:#fff}}
div{{overflow-x:auto}}table{{border-collapse:collapse;font-variant-numeric:tabular-nums}}
th,td{{padding:.3em .7em;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}}
th:first-child,td:first-child{{text-align:left}}
</style></head><body>
{body}
</body></html>
"""


def _html_page(summary: Summary, tables: list[Table], plots: dict[str, list[Path]]) -> str:
    parts = [f"<h1>{html.escape(summary.suite.title)}</h1><p>{html.escape(_seeds(summary))}</p>"]
    parts.append(_html_list(_machines(summary)))
    for table in tables:
        parts.append(f"<h2>{html.escape(table.title)}</h2><p>{html.escape(table.note)}</p>{_html_table(table)}")
        # Inline, so that the page is a single file.
        parts += [path.read_text(encoding="utf-8") for path in plots.get(table.name, [])]
    gaps = describe_gaps(summary)
    parts += [f"<h2>Not measured</h2>{_html_list(gaps)}"] if gaps else []
    return _PAGE.format(title=html.escape(summary.suite.title), body="\n".join(parts))


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in table.header)
    rows = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in table.rows)
    return f"<div><table><tr>{head}</tr>{rows}</table></div>"


def _html_list(lines: list[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>"


def _seeds(summary: Summary) -> str:
    seeds = summary.suite.seeds
    return "One run each, seed 0." if seeds == 1 else f"{seeds} runs each, seeds 0 to {seeds - 1}: mean ± deviation."
