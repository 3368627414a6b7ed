"""Functions of tasks, as their processes call them."""

import os
import signal
import time
from pathlib import Path

from spslam.errors import DatasetError


def write(call):
    """Writes what it was called with, after `seconds`; `begun` names a folder that gets a file with its process."""
    if "begun" in call.arguments:
        begun = Path(call.arguments["begun"])
        number = len(list(begun.iterdir()))
        (begun / f"{call.arguments['text']}-{number}").write_text(str(os.getppid()))
    time.sleep(call.arguments.get("seconds", 0))
    folder = call.output / "below"
    folder.mkdir(exist_ok=True)
    (folder / "text").write_text(call.arguments["text"])
    (call.output / "empty").write_bytes(b"")
    (call.output / "inputs").write_text("".join(Path(path).read_text() for path in call.paths.values()))


def fail(call):
    """Something is wrong with the data."""
    raise DatasetError(f"{call.arguments['text']}: no such thing")


def die(call):
    """The process is killed, unless `marker` says that it was killed before."""
    marker = Path(call.arguments["marker"])
    if not call.arguments.get("once") or not marker.exists():
        marker.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    write(call)
