"""The process of one task of `spslam.tasks`: what its first line of input says; it ends when its input does.

Started by `spslam.tasks.child` as `python -m spslam.cli.task`; not a command for users.
"""

from __future__ import annotations

import os
import sys
import threading

from spslam.cli.main import exit_code


def main() -> int:
    """Runs the task; returns the exit code, as `spslam` does."""
    # Not sys.stdin, whose lock the thread would hold at the exit of the interpreter.
    line = b""
    while not line.endswith(b"\n"):
        piece = os.read(0, 1 << 16)
        if not piece:
            return 1  # whoever started this has ended
        line += piece
    threading.Thread(target=_exit_at_end_of_input, daemon=True).start()
    return exit_code(lambda: _execute(line.decode()), ())


def _execute(line: str) -> None:
    from spslam.tasks.child import call_of_line, execute

    execute(call_of_line(line))


def _exit_at_end_of_input() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
