"""Command line of the fuzzing: `python -m tests.fuzz --minutes 60`, or one case again by its seed."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

from tests.fuzz import worker
from tests.fuzz.cases import write_case
from tests.fuzz.formats import all_formats
from tests.fuzz.harness import prepare, print_failure, run_for, run_some
from tests.fuzz.worker import run_cases


def main() -> int:
    """Runs what the arguments ask for; 1 where a case failed."""
    names = list(all_formats())
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--format", choices=names, action="append", help="only this format; may be repeated")
    parser.add_argument("--seed", type=int, help="run this one case of a format again")
    parser.add_argument("--keep", metavar="DIR", type=Path, help="with --seed: only write the case's files below DIR")
    parser.add_argument("--cases", metavar="N", type=int, help="run N cases of each format")
    parser.add_argument("--minutes", metavar="M", type=float, default=60, help="run for M minutes, 60 if not given")
    parser.add_argument("--jobs", metavar="J", type=int, default=os.cpu_count() or 1, help="processes at a time")
    parser.add_argument("--start", metavar="SEED", type=int, help="first seed; the time of day if not given")
    parser.add_argument("--seconds", metavar="S", type=float, help="of processor time for a case, 10 if not given")
    args = parser.parse_args()
    worker.MAX_SECONDS = args.seconds or worker.MAX_SECONDS
    if args.seed is not None and len(args.format or ()) != 1:
        parser.error("--seed needs one --format")
    forms = {name: form for name, form in all_formats().items() if not args.format or name in args.format}
    prepare(forms.values())
    if args.seed is not None:
        return _run_again(forms[args.format[0]], args.seed, args.keep)
    start = int(time.time()) if args.start is None else args.start
    print(f"seeds from {start}", flush=True)
    if args.cases is not None:
        tallies = run_some(forms, dict.fromkeys(forms, range(start, start + args.cases)))
    else:
        tallies = run_for(forms, args.minutes, args.jobs, start)
    return int(any(tally.failures for tally in tallies.values()))


def _run_again(form, seed: int, keep: Path | None) -> int:
    if keep is not None:
        keep.mkdir(parents=True)
        print(write_case(form, seed, keep))
        return 0
    ((_, outcome),) = run_cases(form, range(seed, seed + 1))
    if outcome.failed:
        print_failure(form.name, seed, outcome, sys.stdout)
    else:
        print(f"{outcome.kind} {outcome.text}")
    print(f"{outcome.seconds:.2f} s, {outcome.memory_bytes >> 20} MB")
    return int(outcome.failed)


if __name__ == "__main__":
    sys.exit(main())
