"""Running the command as a user does."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from spslam.cli.main import main

ROOT = Path(__file__).parents[2]


def spslam(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run ``spslam ARGUMENTS`` in a folder, in this process: a new one would import torch again."""
    command, before = [str(argument) for argument in arguments], Path.cwd()
    with redirect_stdout(StringIO()) as output, redirect_stderr(StringIO()) as error:
        os.chdir(cwd)
        try:
            code = main(command)
        except SystemExit as end:  # of --help
            code = int(end.code or 0)
        finally:
            os.chdir(before)
    return subprocess.CompletedProcess(command, code, output.getvalue(), error.getvalue())


def spslam_process(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run ``python -m spslam ARGUMENTS`` in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "spslam", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )


def assert_refused(result: subprocess.CompletedProcess[str], message: str) -> None:
    """Exit code 2, exactly one line on stderr that holds the message, nothing on stdout."""
    assert result.returncode == 2, result.stderr
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("spslam: ")
    assert message in lines[0]
    assert result.stdout == ""
