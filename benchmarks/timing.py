"""Timing of alternatives in one process, and the record of what it was measured on."""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from spslam import ops
from spslam.benchmark.environment import describe_environment


def compare(
    contenders: dict[str, Callable[[], object]],
    rounds: int,
    device: torch.device,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median milliseconds of each contender.

    They take turns, so that a machine that others use slows all of them alike. Two warm-up turns are not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(rounds + 2):
        for name, function in contenders.items():
            _synchronize(device)
            start = clock()
            function()
            _synchronize(device)
            if turn >= 2:
                times[name].append((clock() - start) * 1e3)
    return {name: statistics.median(values) for name, values in times.items()}


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def arguments(description: str) -> argparse.ArgumentParser:
    """The options every benchmark has."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="CPU threads, of torch as well")
    parser.add_argument("--rounds", type=int, default=15, help="turns each contender gets")
    parser.add_argument("--json", type=Path, help="file to write the results to")
    return parser


def use_threads(threads: int) -> None:
    """Gives torch and the kernels the same number of threads."""
    torch.set_num_threads(threads)
    ops.set_num_threads(threads)


def report(title: str, rows: list[dict[str, object]], device: torch.device, path: Path | None) -> None:
    """Prints rows as a table, and writes them with their environment where a path is given."""
    columns = list(rows[0])
    cells = [columns] + [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    print(title)
    for line in cells:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)))
    if path is not None:
        path.write_text(json.dumps({"environment": describe_environment(device), "rows": rows}, indent=1) + "\n")
