"""Figures published in the paper, from `data/published.yaml`."""

from __future__ import annotations

import functools
import importlib.resources
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

AVERAGE = "average"
Number = float | int | str | None


@dataclass(frozen=True)
class PublishedTable:
    """A table of the paper: its number, its columns, and the values of each method (None where the paper has none)."""

    table: str
    columns: tuple[str, ...]
    rows: dict[str, tuple[Number, ...]]

    def value(self, method: str, column: str) -> Number:
        """One cell; None where there is none."""
        if method not in self.rows or column not in self.columns:
            return None
        return self.rows[method][self.columns.index(column)]


def published(suite: str | None) -> dict[str, PublishedTable]:
    """The paper's tables for a suite, by kind (`ate`, `averages`, or a study of the ablation); may be empty."""
    tables = _read().get(suite, {}) if suite else {}
    return {
        kind: PublishedTable(
            table["table"], tuple(table["columns"]), {name: tuple(row) for name, row in table["rows"].items()}
        )
        for kind, table in tables.items()
    }


@functools.cache
def _read() -> dict[str, Any]:
    path = Path(str(importlib.resources.files("spslam.benchmark"))) / "data" / "published.yaml"
    return yaml.safe_load(path.read_text(encoding="utf-8"))
