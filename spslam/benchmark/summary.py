"""Results of a suite: statistics of all cells, what was skipped, what failed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from spslam.benchmark.figures import Statistic
from spslam.benchmark.jobs import Plan
from spslam.benchmark.records import Outcome
from spslam.benchmark.suites import Study, Suite

Cell = tuple[str, str, str]


@dataclass(frozen=True)
class Summary:
    """Results of a suite.

    Attributes:
        suite: what was run.
        cells: statistics by figure, of each (study, sequence, variant) that has a finished run.
        skipped: sequences without data, and why.
        failed: one line per failed run.
        environments: what the runs were measured on, each once.
        finished: number of finished runs of each cell.
    """

    suite: Suite
    cells: dict[Cell, dict[str, Statistic]]
    skipped: dict[str, str]
    failed: tuple[str, ...]
    environments: tuple[dict[str, Any], ...]
    finished: dict[Cell, int]

    def value(self, study: Study, sequence: str, variant: str, figure: str) -> Statistic | None:
        """One statistic; None where it was not measured."""
        return self.cells.get((study.name, sequence, variant), {}).get(figure)

    def sequences(self, study: Study) -> list[str]:
        """Names of the study's sequences that have a result."""
        return [s.name for s in study.sequences if any(cell[:2] == (study.name, s.name) for cell in self.cells)]

    def average(self, study: Study, variant: str, figure: str) -> tuple[float, int] | None:
        """Mean of a variant's figure over the sequences that have it, and how many they are; None where none has."""
        found = [self.value(study, name, variant, figure) for name in self.sequences(study)]
        means = [statistic.mean for statistic in found if statistic is not None]
        return (sum(means) / len(means), len(means)) if means else None

    def without(self, study: Study, sequence: str, variant: str, figure: str) -> int:
        """How many finished runs lack a figure that others of the cell have, as where all frames are lost."""
        statistic = self.value(study, sequence, variant, figure)
        finished = self.finished.get((study.name, sequence, variant), 0)
        return 0 if statistic is None else finished - statistic.runs

    def to_dict(self) -> dict[str, Any]:
        """The content of summary.json."""
        return {
            "suite": self.suite.name,
            "title": self.suite.title,
            "seeds": self.suite.seeds,
            "environments": list(self.environments),
            "rows": [
                {
                    "study": study,
                    "sequence": sequence,
                    "variant": variant,
                    "figures": {name: asdict(statistic) for name, statistic in figures.items()},
                }
                for (study, sequence, variant), figures in self.cells.items()
            ],
            "skipped": self.skipped,
            "failed": list(self.failed),
        }


def summarize(suite: Suite, plan: Plan, outcomes: dict[str, Outcome]) -> Summary:
    """Statistics over the seeds of every cell of a plan."""
    cells, finished = {}, {}
    for cell, keys in plan.cells.items():
        records = [outcomes[key].record for key in keys if key in outcomes]
        figures = [record["figures"] for record in records if record is not None]
        if figures:
            cells[cell], finished[cell] = _statistics(figures), len(figures)
    failed = tuple(f"{key}: {outcome.error}" for key, outcome in outcomes.items() if outcome.record is None)
    return Summary(suite, cells, plan.skipped, failed, tuple(_environments(outcomes)), finished)


def _statistics(figures: list[dict[str, float]]) -> dict[str, Statistic]:
    names = dict.fromkeys(name for run in figures for name in run)
    return {name: Statistic.of([run[name] for run in figures if name in run]) for name in names}


def _environments(outcomes: dict[str, Outcome]) -> Iterator[dict[str, Any]]:
    seen: list[dict[str, Any]] = []
    for outcome in outcomes.values():
        if outcome.record is not None and outcome.record["environment"] not in seen:
            seen.append(outcome.record["environment"])
            yield outcome.record["environment"]
