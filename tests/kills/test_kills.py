"""Some runs are killed at random moments and resumed to the same bytes; `python -m tests.kills` kills a thousand."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_killed_runs_are_resumed_to_the_same_bytes():
    """In a process of its own, which changes its numbers of threads."""
    command = [sys.executable, "-m", "tests.kills", "--kills", "4", "--seed", "0"]
    result = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stdout + result.stderr
    assert ": 0 errors" in result.stdout
