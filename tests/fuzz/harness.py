"""Many cases of many formats: the work is shared by processes, failures and a table are printed."""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from multiprocessing.queues import SimpleQueue
from typing import TextIO

import cv2
import torch

from spslam import ops
from tests.fuzz.cases import OK, REFUSED, Outcome
from tests.fuzz.formats import Format
from tests.fuzz.worker import run_cases

_SHOWN = 3  # failures of one kind and place


@dataclass
class Tally:
    """What became of the cases of one format."""

    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    seconds: float = 0.0
    slowest_seconds: float = 0.0
    most_bytes: int = 0

    @property
    def cases(self) -> int:
        """All of them."""
        return sum(self.counts.values())

    @property
    def failures(self) -> int:
        """Those that ended in anything but success or a SpslamError."""
        return self.cases - self.counts[OK] - self.counts[REFUSED]

    def add(self, outcome: Outcome) -> None:
        """Counts one more."""
        self.counts[outcome.kind] += 1
        self.seconds += outcome.seconds
        self.slowest_seconds = max(self.slowest_seconds, outcome.seconds)
        self.most_bytes = max(self.most_bytes, outcome.memory_bytes)


def prepare(forms: Iterable[Format]) -> None:
    """Makes the good examples, with one thread everywhere: a child of a process with threads has none of them."""
    ops.set_num_threads(1)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for form in forms:
        form.prepare()


def run_for(forms: Mapping[str, Format], minutes: float, jobs: int, start: int) -> dict[str, Tally]:
    """Runs cases for a time that the formats share equally; prints failures as they come, and a table.

    Args:
        forms: prepared, by name.
        minutes: in all.
        jobs: processes at a time.
        start: the first seed.
    """
    context = multiprocessing.get_context("fork")
    queue: SimpleQueue = context.SimpleQueue()
    processes = [
        context.Process(target=_work, args=(list(forms.values()), 60 * minutes, start + job, jobs, queue))
        for job in range(jobs)
    ]
    began = time.monotonic()
    for process in processes:
        process.start()
    tallies, shown, running = {name: Tally() for name in forms}, defaultdict(int), jobs
    while running:
        message = queue.get()
        if message is None:
            running -= 1
            continue
        name, seed, outcome = message
        tallies[name].add(outcome)
        if outcome.failed:
            place = (name, outcome.kind, outcome.text.strip().splitlines()[-1:] or [""])
            shown[str(place)] += 1
            if shown[str(place)] <= _SHOWN:
                print_failure(name, seed, outcome, sys.stdout)
    for process in processes:
        process.join()
    print_table(tallies, time.monotonic() - began, sys.stdout)
    return tallies


def run_some(forms: Mapping[str, Format], seeds: Mapping[str, range]) -> dict[str, Tally]:
    """Runs the given cases here, one format after the other; prints failures and a table."""
    tallies, began = {name: Tally() for name in forms}, time.monotonic()
    for name, form in forms.items():
        for seed, outcome in run_cases(form, seeds[name]):
            tallies[name].add(outcome)
            if outcome.failed:
                print_failure(name, seed, outcome, sys.stdout)
    print_table(tallies, time.monotonic() - began, sys.stdout)
    return tallies


def print_failure(name: str, seed: int, outcome: Outcome, file: TextIO) -> None:
    """The command that repeats a case, and what became of it."""
    lines = outcome.text.strip().splitlines()
    print(f"python -m tests.fuzz --format {name} --seed {seed}  # {outcome.kind}", file=file)
    for line in lines[-12:]:
        print(f"    {line[:300]}", file=file)
    file.flush()


def print_table(tallies: Mapping[str, Tally], wall_seconds: float, file: TextIO) -> None:
    """Cases and outcomes by format."""
    head = ("format", "cases", "ok", "refused", "failed", "ms/case", "slowest s", "most MB")
    rows = [
        (
            *(name, tally.cases, tally.counts[OK], tally.counts[REFUSED], tally.failures),
            f"{1e3 * tally.seconds / max(tally.cases, 1):.1f}",
            f"{tally.slowest_seconds:.2f}",
            tally.most_bytes >> 20,
        )
        for name, tally in tallies.items()
    ]
    total = [sum(row[column] for row in rows) for column in range(1, 5)]
    seconds = sum(tally.seconds for tally in tallies.values())
    rows.append(
        (
            *("all", *total, f"{1e3 * seconds / max(total[0], 1):.1f}"),
            f"{max((tally.slowest_seconds for tally in tallies.values()), default=0):.2f}",
            max((tally.most_bytes for tally in tallies.values()), default=0) >> 20,
        )
    )
    for row in (head, ("---", *["---:"] * (len(head) - 1)), *rows):
        print("| " + " | ".join(map(str, row)) + " |", file=file)
    print(f"{total[0]} cases in {wall_seconds / 60:.1f} minutes, {total[3]} failed", file=file, flush=True)


def _work(forms: list[Format], seconds: float, start: int, step: int, queue: SimpleQueue) -> None:
    """One process's share: every format for an equal time, and what is left over once more for all."""
    end, place = time.monotonic() + seconds, start
    try:
        rounds = max(int(seconds / 300), 1)
        for number in range(rounds):
            for i, form in enumerate(forms):
                slices = len(forms) * (rounds - number) - i
                until = time.monotonic() + max(end - time.monotonic(), 0) / slices
                for seed, outcome in run_cases(form, range(place, place + step * 10**9, step), until):
                    queue.put((form.name, seed, outcome))
            place += step * 10**9
    finally:
        queue.put(None)
