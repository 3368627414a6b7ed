"""Tables of a suite's results: spslam's, the baseline's and the paper's published figures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from spslam.benchmark.figures import figure
from spslam.benchmark.published import AVERAGE, Number, PublishedTable, published
from spslam.benchmark.suites import Study
from spslam.benchmark.summary import Summary

NOTHING = ""
_OF_EVERY_RUN = ("ate_rmse_cm",)  # unless all its frames are lost; other figures need more, such as a ground-truth mesh


@dataclass(frozen=True)
class Table:
    """A table of text; a Markdown page refers to it by `name`."""

    name: str
    title: str
    note: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def make_tables(summary: Summary) -> list[Table]:
    """All tables of a suite that are not empty, in order."""
    tables: list[Table] = []
    for study in summary.suite.studies:
        if summary.suite.name == "ablation":
            tables.append(_study_table(summary, study))
        else:
            papers = published(summary.suite.published)
            tables.append(_ate_table(summary, study, papers.get("ate")))
            tables.append(_averages_table(summary, study, papers.get("averages")))
            tables.append(_runs_table(summary, study))
    return [table for table in tables if table.rows]


def _ate_table(summary: Summary, study: Study, paper: PublishedTable | None) -> Table:
    """A row per method, a column per sequence."""
    names = summary.sequences(study)
    rows = [
        (variant.name, *(_cell(summary, study, name, variant.name, "ate_rmse_cm") for name in names))
        for variant in study.variants
    ]
    averages = [_average(summary, study, variant.name, "ate_rmse_cm", 2) for variant in study.variants]
    lines = [(*row, average) for row, average in zip(rows, averages, strict=True) if any(row[1:])]
    note = _frames_note(summary, study)
    if paper is not None and names:
        lines = [(method, *(_printed(paper.value(method, name)) for name in (*names, AVERAGE)))
                 for method in paper.rows] + lines  # fmt: skip
        note = f"First the paper's {paper.table}, {AVERAGE} of all its scenes; then ours. {note}"
    return Table("ate", "ATE RMSE in cm", note, ("method", *names, AVERAGE), tuple(lines))


def _averages_table(summary: Summary, study: Study, paper: PublishedTable | None) -> Table:
    """A row per method, columns as in the paper's table; empty without one."""
    if paper is None or not summary.sequences(study):
        return Table("averages", "", "", (), ())
    lines = [(method, *(_printed(value) for value in values)) for method, values in paper.rows.items()]
    for variant in study.variants:
        means = [_average(summary, study, variant.name, name, figure(name).digits) for name in paper.columns]
        if any(means):
            lines.append((variant.name, *means))
    note = f"First the paper's {paper.table} (RTX 3090 Ti), over all its scenes; then ours, over those that were run."
    header = ("method", *(figure(name).label for name in paper.columns))
    return Table("averages", "Reconstruction and speed, averages", note, header, tuple(lines))


def _runs_table(summary: Summary, study: Study) -> Table:
    """A row per sequence and method, a column per figure."""
    columns = _known_columns(summary, study)
    rows = [
        (name, variant.name, *(_cell(summary, study, name, variant.name, column) for column in columns))
        for name in summary.sequences(study)
        for variant in study.variants
    ]
    header = ("sequence", "method", *(figure(column).label for column in columns))
    note = "Mean and standard deviation over seeds." if summary.suite.seeds > 1 else ""
    return Table("runs", "All figures", note, header, tuple(row for row in rows if any(row[2:])))


def _study_table(summary: Summary, study: Study) -> Table:
    """A row per variant, a column per sequence and figure of the study."""
    pairs = [
        (name, column)
        for name in summary.sequences(study)
        for column in study.columns
        if any(summary.value(study, name, variant.name, column) for variant in study.variants)
    ]
    rows = [
        (variant.name, *(_cell(summary, study, name, variant.name, column) for name, column in pairs))
        for variant in study.variants
    ]
    header = ("variant", *(f"{name}: {figure(column).label}" for name, column in pairs))
    notes = [study.note, _frames_note(summary, study), _paper_note(study)]
    return Table(
        study.name, study.title, " ".join(filter(None, notes)), header, tuple(row for row in rows if any(row[1:]))
    )


def _paper_note(study: Study) -> str:
    """The paper's figures for a study, measured on other data."""
    table = published("ablation").get(study.name)
    if table is None:
        return ""
    rows = (
        f"{method}: {', '.join(f'{_printed(v)} ({c})' for c, v in zip(table.columns, values, strict=True))}"
        for method, values in table.rows.items()
    )
    return f"The paper's {table.table}: {'; '.join(rows)}."


def _frames_note(summary: Summary, study: Study) -> str:
    counts = []
    for name in summary.sequences(study):
        found = (summary.value(study, name, variant.name, "frames") for variant in study.variants)
        frames = next((statistic for statistic in found if statistic is not None), None)
        counts += [f"{name} {frames.mean:.0f}"] if frames is not None else []
    return f"Frames: {', '.join(counts)}." if counts else ""


def _known_columns(summary: Summary, study: Study) -> list[str]:
    measured = {name for cell, figures in summary.cells.items() if cell[0] == study.name for name in figures}
    return [column for column in study.columns if column in measured]


def _cell(summary: Summary, study: Study, sequence: str, variant: str, name: str) -> str:
    statistic = summary.value(study, sequence, variant, name)
    if statistic is None:
        return NOTHING
    lacking = summary.without(study, sequence, variant, name) if name in _OF_EVERY_RUN else 0
    some = f" ({statistic.runs} of {statistic.runs + lacking})" if lacking else ""
    return f"{statistic.text(figure(name).digits)}{some}"


def _average(summary: Summary, study: Study, variant: str, name: str, digits: int) -> str:
    """A mean over sequences, and of how many it is where others have results and these have not the figure."""
    found, count = summary.average(study, variant, name), len(summary.sequences(study))
    if found is None:
        return NOTHING
    mean, sequences = found
    some = f" ({sequences} of {count})" if name in _OF_EVERY_RUN and sequences < count else ""
    return f"{mean:.{digits}f}{some}"


def _printed(value: Number) -> str:
    return NOTHING if value is None else str(value)


def to_text(table: Table) -> str:
    """The table for a terminal."""
    lines = [table.header, *table.rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.header))]
    # The first columns are names, the others numbers.
    names = 2 if table.name == "runs" else 1
    body = "\n".join(
        "  ".join(
            cell.ljust(width) if i < names else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
    return "\n".join(filter(None, [table.title, table.note, body]))


def to_markdown(table: Table) -> str:
    """The table as Markdown, without its title."""

    def escape(cells: Iterable[str]) -> Iterator[str]:
        return (cell.replace("|", "\\|") for cell in cells)

    lines = [table.header, ("---",) * len(table.header), *table.rows]
    grid = "\n".join(f"| {' | '.join(escape(line))} |" for line in lines)
    return f"{table.note}\n\n{grid}" if table.note else grid
