"""Runs the tests that need a CUDA device, each file in a process of its own: a broken device breaks no other file.

    python tests/run_on_gpu.py [--jobs N] [--sanitizer TOOL] [-k EXPRESSION] [FILE ...]

Uses the kernels built in place if there are any, else the installed wheel. Needs pytest, and hypothesis for some files.
With a sanitizer each file runs under `compute-sanitizer --tool TOOL`, and an error that it reports inside a kernel of
spslam counts as a failed test; where no file is named these are the tests of the ops.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NONE_COLLECTED = 5


SANITIZERS = ("memcheck", "racecheck", "initcheck", "synccheck")
# None launches a kernel that the other tests of its file don't; gradcheck launches the same ones thousands of times.
UNSANITIZED = " and ".join(f"not {name}" for name in ("opcheck", "compile", "errors", "gradcheck"))
# Those that look at whole allocations; with torch's pool they see the pool, not the tensors in it.
SANITIZERS_OF_MEMORY = ("memcheck", "initcheck")
# It has to watch what torch's kernels write to know what was never written, and reports torch's own reads too.
WATCHES_ALL = "initcheck"
OWN_KERNELS = "spslam"


def main() -> int:
    """Exit code 0 if all passed, 1 if not, 2 where there is no device."""
    args = _parser().parse_args()
    import torch

    if not torch.cuda.is_available():
        print("torch finds no CUDA device", file=sys.stderr)
        return 2
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}, {args.sanitizer or 'no sanitizer'}", flush=True)
    with _folder_beside_the_package() as folder, ThreadPoolExecutor(args.jobs) as threads:
        files = args.files or _files_with_gpu_tests(folder, "tests/ops" if args.sanitizer else "tests")
        passed = list(threads.map(partial(_passes, args=args, folder=folder), files))
    failed = [file for file, passes in zip(files, passed, strict=True) if not passes]
    print(f"{len(files) - len(failed)} of {len(files)} files pass" + "".join(f"\nfailed: {file}" for file in failed))
    return 1 if failed or not files else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", metavar="FILE", nargs="*")
    parser.add_argument("--jobs", type=int, default=1, help="files at a time")
    parser.add_argument("--sanitizer", choices=SANITIZERS)
    parser.add_argument("-k", dest="expression", default="", help="only tests that match, as for pytest")
    return parser


@contextmanager
def _folder_beside_the_package() -> Iterator[Path]:
    """The repository; a copy of its tests where its own package has no kernels and would hide the installed one."""
    if any((ROOT / "spslam").glob("_ops_cpu*.so")):
        yield ROOT
        return
    with tempfile.TemporaryDirectory() as folder:
        # What tests import, run or read.
        for name in ("tests", "experiments", "examples", "docs"):
            shutil.copytree(ROOT / name, Path(folder) / name)
        for file in (*ROOT.glob("*.md"), ROOT / "pyproject.toml"):
            shutil.copy(file, folder)
        yield Path(folder)


def _files_with_gpu_tests(folder: Path, under: str) -> list[str]:
    command = [sys.executable, "-m", "pytest", "-m", "cuda", "--collect-only", "-o", "addopts=-q", under]
    listed = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if listed.returncode:
        # A file that can't be imported must not go unseen.
        print(listed.stdout[-4000:], listed.stderr, file=sys.stderr)
    return sorted({line.partition("::")[0] for line in listed.stdout.splitlines() if "::" in line})


def _passes(file: str, args: argparse.Namespace, folder: Path) -> bool:
    started = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-m", "cuda", "--no-header", "--disable-warnings", file]
    expression, environment = args.expression, dict(os.environ)
    if args.sanitizer:
        command = _sanitized(args.sanitizer) + command
        expression = f"({expression}) and {UNSANITIZED}" if expression else UNSANITIZED
        if args.sanitizer in SANITIZERS_OF_MEMORY:
            environment["PYTORCH_NO_CUDA_MEMORY_CACHING"] = "1"
    if expression:
        command += ["-k", expression]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    errors = _own_errors(done.stdout)
    passes = done.returncode in (0, NONE_COLLECTED) and not errors
    last = done.stdout.strip().splitlines()[-1:] or ["no output"]
    print(f"{'ok  ' if passes else 'FAIL'} {file} ({time.monotonic() - started:.1f} s): {last[0]}", flush=True)
    if not passes:
        print("\n".join(errors[:20]), done.stdout[-6000:], done.stderr[-2000:], flush=True)
    return passes


def _sanitized(tool: str) -> list[str]:
    command = ["compute-sanitizer", "--tool", tool, "--show-backtrace", "no"]
    if tool == WATCHES_ALL:
        return [*command, "--print-limit", "0"]
    return [*command, "--print-limit", "5", "--error-exitcode", "1", "--kernel-name", f"kernel_substring={OWN_KERNELS}"]


def _own_errors(output: str) -> list[str]:
    """The lines of a sanitizer's reports that say where in a kernel of spslam something happened."""
    return [line for line in output.splitlines() if re.match(r"=========.*\bat\b", line) and OWN_KERNELS in line]


if __name__ == "__main__":
    sys.exit(main())
