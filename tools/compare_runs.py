"""Compares output folders of runs byte by byte: the trajectory and every tensor of the map.

    python tools/compare_runs.py BEFORE AFTER

BEFORE and AFTER hold output folders of the same names (or are two output folders). Prints a line per run and exits with
1 if any differs. Times, versions and the map's header are not compared.
"""

import argparse
import sys
from pathlib import Path

from safetensors.torch import load_file

TRAJECTORY, MAP = "trajectory.txt", "map.safetensors"


def main() -> int:
    """Exit code 0 if all runs are the same, 1 if not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    args = parser.parse_args()
    runs = sorted(path.parent.relative_to(args.before) for path in args.before.glob(f"**/{MAP}"))
    if not runs:
        print(f"{args.before}: holds no {MAP}", file=sys.stderr)
        return 1
    different = [run for run in runs if not _is_same(args.before / run, args.after / run)]
    print(f"{len(runs) - len(different)} of {len(runs)} runs are the same to the byte")
    return 1 if different else 0


def _is_same(before: Path, after: Path) -> bool:
    differences = list(_differences(before, after))
    print(f"{'same' if not differences else 'DIFFERENT'}  {before.name}", *differences, sep="  ")
    return not differences


def _differences(before: Path, after: Path):
    if (before / TRAJECTORY).read_bytes() != (after / TRAJECTORY).read_bytes():
        yield TRAJECTORY
    old, new = load_file(before / MAP), load_file(after / MAP)
    yield from sorted(set(old) ^ set(new))
    for name in sorted(set(old) & set(new)):
        one, other = old[name], new[name]
        if one.dtype != other.dtype or one.shape != other.shape or one.numpy().tobytes() != other.numpy().tobytes():
            yield name


if __name__ == "__main__":
    sys.exit(main())
