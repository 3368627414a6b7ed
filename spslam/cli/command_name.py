"""How the command was called, so that a command line on the screen can be pasted."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path


def command_name() -> str:
    """`spslam` where the shell would find this very one, else its path, or `python -m spslam` as it was called."""
    called = Path(sys.argv[0])
    return _for_shell(called) if called.name == "spslam" else f"{_for_shell(Path(sys.executable))} -m spslam"


def _for_shell(program: Path) -> str:
    """The program's name if the shell finds it by that, else a path: relative where it lies below this folder."""
    found = shutil.which(program.name)
    path = Path(os.path.abspath(program))  # links are kept: that of a virtual environment is the environment
    if found is not None and Path(os.path.abspath(found)) == path:
        return program.name
    return shlex.quote(str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path))
