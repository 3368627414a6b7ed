"""Kills many short runs, and checks that each can be resumed to the same bytes.

    python -m tests.kills [--kills 1000] [--seed 0]

Prints a line every 50 kills and what was wrong; exits with 1 if anything was. The same seed kills at the same shares of
a run's time.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.kills.trial import measure, try_kills

EVERY = 50


def main() -> int:
    """Exit code 0 if all runs were resumed to the same bytes, 1 if not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="of the first run; each further one has the next")
    args = parser.parse_args()
    started, kills, runs, wrong = time.monotonic(), 0, 0, []
    with tempfile.TemporaryDirectory() as folder:
        reference = measure(Path(folder))
        while kills < args.kills:
            more, errors = try_kills(Path(folder) / "run", args.seed + runs, reference)
            for error in errors:
                print(error, flush=True)
            if (kills + more) // EVERY > kills // EVERY:
                print(f"{kills + more} kills, {time.monotonic() - started:.0f} s", flush=True)
            kills, runs, wrong = kills + more, runs + 1, wrong + errors
            if errors:
                break
    print(f"{kills} kills of {runs} runs in {time.monotonic() - started:.0f} s: {len(wrong)} errors")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
