"""Timing of alternatives in one process, and the description of the machine."""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from spslam import ops
from spslam.benchmark.environment import describe_environment

TURN_MS, MAX_CALLS = 5.0, 20  # length of a turn on a GPU
IDLE_CYCLES = 30_000_000  # 15 to 20 ms, in which Python launches a turn


def compare(
    contenders: dict[str, Callable[[], object]],
    rounds: int,
    device: torch.device,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median milliseconds per call of each contender, launches from Python included.

    The contenders take turns, so that other load on the machine slows all of them equally; warm-up is not counted. On a
    GPU a turn is several calls that together take some milliseconds, and one synchronization at the end.
    """
    return _in_turns(contenders, rounds, device, lambda function, calls: _wall_ms(function, calls, device, clock))


def compare_on_gpu(contenders: dict[str, Callable[[], object]], rounds: int, device: torch.device) -> dict[str, float]:
    """The same with GPU time: launches queue behind an idle kernel, so the time that Python needs does not count.

    Time that a contender spends on the CPU or synchronizing with the GPU does count.
    """
    return _in_turns(contenders, rounds, device, _gpu_ms)


def _in_turns(
    contenders: dict[str, Callable[[], object]],
    rounds: int,
    device: torch.device,
    milliseconds: Callable[[Callable[[], object], int], float],
) -> dict[str, float]:
    """Medians of `milliseconds(contender, calls)`."""
    calls = {name: _calls_a_turn(function, device) for name, function in contenders.items()}
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, function in contenders.items():
            times[name].append(milliseconds(function, calls[name]))
    return {name: statistics.median(values) for name, values in times.items()}


def _calls_a_turn(function: Callable[[], object], device: torch.device) -> int:
    """One on the CPU; also warms up, on both devices."""
    for _ in range(2):
        once = _wall_ms(function, 1, device, time.perf_counter)
    return max(1, min(MAX_CALLS, int(TURN_MS / max(once, 1e-3)))) if device.type == "cuda" else 1


def _wall_ms(function: Callable[[], object], calls: int, device: torch.device, clock: Callable[[], float]) -> float:
    _synchronize(device)
    start = clock()
    for _ in range(calls):
        function()
    _synchronize(device)
    return (clock() - start) * 1e3 / calls


def _gpu_ms(function: Callable[[], object], calls: int) -> float:
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda.synchronize()
    torch.cuda._sleep(IDLE_CYCLES)
    start.record()
    for _ in range(calls):
        function()
    end.record()
    torch.cuda.synchronize()
    return start.elapsed_time(end) / calls


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def arguments(description: str) -> argparse.ArgumentParser:
    """A parser with the options that every script has."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="CPU threads of kernels and torch")
    parser.add_argument("--rounds", type=int, default=15, help="turns per contender")
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
