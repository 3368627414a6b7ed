"""Cases in children of a process that has imported and prepared everything, so that a case costs no start.

A child runs many cases one after the other and tells of each. Where it dies or takes too long, the case at fault is
known, and another child goes on with the next.
"""

from __future__ import annotations

import faulthandler
import os
import pickle
import select
import signal
import struct
import tempfile
import time
import traceback
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

from tests.fuzz.cases import Outcome, limit_memory, run_case
from tests.fuzz.formats import Format

MAX_SECONDS = 10.0  # of processor time
MAX_WAITING_SECONDS = 60.0  # without using the processor that long; another process may have it
CASES_PER_CHILD = 200
_POLL_SECONDS = 0.25
_TICKS = os.sysconf("SC_CLK_TCK")
_SIZE = struct.Struct("<I")


def run_cases(form: Format, seeds: range, until: float | None = None) -> Iterator[tuple[int, Outcome]]:
    """Runs cases in children; gives each seed with its outcome.

    Args:
        form: prepared.
        seeds: of the cases.
        until: no further child is started after this moment of `time.monotonic`.
    """
    with tempfile.TemporaryDirectory(prefix="spslam-fuzz-") as folder:
        place = 0
        while place < len(seeds) and (until is None or time.monotonic() < until):
            batch = seeds[place : place + CASES_PER_CHILD]
            for seed, outcome in _run_child(form, batch, Path(folder), until):
                place += 1
                yield seed, outcome


def _run_child(form: Format, seeds: range, folder: Path, until: float | None) -> Iterator[tuple[int, Outcome]]:
    """Outcomes of the first cases: all of them, up to the one that ended the child, or those until then."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read_end)
        _serve(form, seeds, Path(tempfile.mkdtemp(dir=folder)), write_end, until)
    os.close(write_end)
    ended = False
    try:
        with os.fdopen(read_end, "rb", buffering=0) as pipe:
            for seed in seeds:
                outcome = _receive(pipe, child)
                if outcome is None:
                    break
                if outcome.kind in ("crash", "hang", "harness"):
                    os.kill(child, signal.SIGKILL)
                    _, status = os.waitpid(child, 0)
                    ended = True
                    yield seed, Outcome("crash", _epitaph(status)) if outcome.kind == "crash" else outcome
                    break
                yield seed, outcome
    finally:
        if not ended:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def _serve(form: Format, seeds: range, root: Path, write_end: int, until: float | None) -> None:
    """The child's side; never returns."""
    try:
        os.environ["HOME"] = os.environ["TMPDIR"] = str(root)
        tempfile.tempdir = None
        silence = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(silence, descriptor)
        limit_memory()
        faulthandler.disable()  # pytest's would print the stack of each crash that is looked for
        for seed in seeds:
            if until is not None and time.monotonic() > until:
                break
            _send(write_end, run_case(form, seed, root))
        _send(write_end, None)
    except BaseException:
        _send(write_end, Outcome("harness", traceback.format_exc()))
    finally:
        os._exit(0)


def _send(pipe: int, outcome: Outcome | None) -> None:
    content = pickle.dumps(outcome)
    content = _SIZE.pack(len(content)) + content
    while content:
        content = content[os.write(pipe, content) :]


def _receive(pipe: FileIO, child: int) -> Outcome | None:
    """The next outcome; None where the child has no further one, a crash where it ended, a hang where it must be."""
    began, used_before = time.monotonic(), _processor_seconds(child)
    while not select.select([pipe], [], [], _POLL_SECONDS)[0]:
        used = _processor_seconds(child) - used_before
        if used > MAX_SECONDS or time.monotonic() - began > MAX_WAITING_SECONDS + used:
            return Outcome("hang", f"{used:.1f} s of processor time, {time.monotonic() - began:.1f} s in all", used)
    try:
        (size,) = _SIZE.unpack(_exactly(pipe, _SIZE.size))
        return pickle.loads(_exactly(pipe, size))
    except EOFError:
        return Outcome("crash")


def _exactly(pipe: FileIO, count: int) -> bytes:
    content = b""
    while len(content) < count:
        part = pipe.read(count - len(content))
        if not part:
            raise EOFError
        content += part
    return content


def _processor_seconds(process: int) -> float:
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / _TICKS


def _epitaph(status: int) -> str:
    if os.WIFSIGNALED(status):
        return f"ended by {signal.Signals(os.WTERMSIG(status)).name}"
    return f"ended with code {os.WEXITSTATUS(status)}"
