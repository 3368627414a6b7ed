"""Runs the tests that need a CUDA device, each file in a process of its own: a broken device breaks no other file.

    python tests/run_on_gpu.py [FILE ...]

Uses the kernels built in place if there are any, else the installed wheel. Needs pytest, and hypothesis for some files.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NONE_COLLECTED = 5


def main() -> int:
    """Exit code 0 if all passed, 1 if not, 2 where there is no device."""
    import torch

    if not torch.cuda.is_available():
        print("torch finds no CUDA device", file=sys.stderr)
        return 2
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}", flush=True)
    with _folder_beside_the_package() as folder:
        files = sys.argv[1:] or _files_with_gpu_tests(folder)
        failed = [file for file in files if not _passes(file, folder)]
    print(f"{len(files) - len(failed)} of {len(files)} files pass" + "".join(f"\nfailed: {file}" for file in failed))
    return 1 if failed or not files else 0


@contextmanager
def _folder_beside_the_package() -> Iterator[Path]:
    """The repository; a copy of its tests where its own package has no kernels and would hide the installed one."""
    if any((ROOT / "spslam").glob("_ops_cpu*.so")):
        yield ROOT
        return
    with tempfile.TemporaryDirectory() as folder:
        for name in ("tests", "benchmarks"):
            shutil.copytree(ROOT / name, Path(folder) / name)
        shutil.copy(ROOT / "pyproject.toml", folder)
        yield Path(folder)


def _files_with_gpu_tests(folder: Path) -> list[str]:
    command = [sys.executable, "-m", "pytest", "-m", "cuda", "--collect-only", "-o", "addopts=-q", "tests"]
    listed = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if listed.returncode:
        # A file that can't be imported must not go unseen.
        print(listed.stdout, listed.stderr, file=sys.stderr)
    return sorted({line.partition("::")[0] for line in listed.stdout.splitlines() if "::" in line})


def _passes(file: str, folder: Path) -> bool:
    started = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-m", "cuda", "--no-header", "--disable-warnings", file]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    passes = done.returncode in (0, NONE_COLLECTED)
    last = done.stdout.strip().splitlines()[-1:] or ["no output"]
    print(f"{'ok  ' if passes else 'FAIL'} {file} ({time.monotonic() - started:.1f} s): {last[0]}", flush=True)
    if not passes:
        print(done.stdout[-6000:], done.stderr[-2000:], flush=True)
    return passes


if __name__ == "__main__":
    sys.exit(main())
