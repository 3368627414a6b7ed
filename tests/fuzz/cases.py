"""One case: what is written, what reading it may come to, and how that is judged."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import resource
import shutil
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from random import Random

from spslam.errors import SpslamError
from tests.fuzz.formats import Format

MAX_MEMORY_BYTES = 1 << 30
# What is asked for beyond the limit on memory fails at once, so that no case harms the machine.
M_ARENA_MAX = -8  # of malloc.h
ADDRESS_SPACE_BYTES = MAX_MEMORY_BYTES + (256 << 20)
MAX_MESSAGE_CHARACTERS = 1000
# A failed allocation that was taken for a damaged file.
_OUT_OF_MEMORY = re.compile(
    r"(?i)insufficient memory|unable to allocate|can't allocate|bad_alloc|MemoryError|OutOfMemory"
)

OK, REFUSED = "ok", "refused"


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        kind: OK, REFUSED (a SpslamError of one line), or how it failed: `exception`, `message`, `memory`, `files`; the
            worker adds `crash`, `hang` and `harness`.
        text: what was raised or left.
        seconds: of processor time.
        memory_bytes: most resident memory beyond what the process had before.
    """

    kind: str
    text: str = ""
    seconds: float = 0.0
    memory_bytes: int = 0

    @property
    def failed(self) -> bool:
        """Whether it is none of the outcomes allowed."""
        return self.kind not in (OK, REFUSED)


def limit_memory() -> None:
    """Gives this process `ADDRESS_SPACE_BYTES` more of address space than it has; not under a sanitizer."""
    if "asan" not in os.environ.get("LD_PRELOAD", ""):
        # Else glibc reserves an arena of 64 MB for each of many threads that decode, which is no memory in use.
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)
        limit = _status_bytes("VmSize") + ADDRESS_SPACE_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def run_case(form: Format, seed: int, root: Path) -> Outcome:
    """Writes the case of a seed below an empty folder, reads it, and removes it.

    Args:
        form: prepared.
        seed: decides how the good example is spoiled.
        root: a folder of its own; left as it was.
    """
    folder = write_case(form, seed, root)
    try:
        before = _tree(root, form.may_write(folder))
        _reset_peak()
        resident, began = _status_bytes("VmRSS"), time.process_time()
        kind, text = _read(form, folder)
        seconds = time.process_time() - began
        memory = max(_status_bytes("VmHWM") - resident, 0)
        changed = sorted(before ^ _tree(root, form.may_write(folder)))
    finally:
        shutil.rmtree(root / "case", ignore_errors=True)
        shutil.rmtree(root / "home", ignore_errors=True)
    if kind in (OK, REFUSED) and memory > MAX_MEMORY_BYTES:
        kind, text = "memory", f"{memory >> 20} MB; {text}"
    if kind in (OK, REFUSED) and changed:
        kind, text = "files", f"left or changed {changed[:3]}"
    return Outcome(kind, text, seconds, memory)


def write_case(form: Format, seed: int, root: Path) -> Path:
    """Writes the case of a seed; returns its folder, `case/a/b` below `root`, so that `../..` leads to what is seen."""
    folder = root / "case" / "a" / "b"
    folder.mkdir(parents=True)
    (root / "home").mkdir()
    form.write(Random(f"{form.name}:{seed}"), folder)
    return folder


def _read(form: Format, folder: Path) -> tuple[str, str]:
    home = Path.cwd()
    os.chdir(folder.parents[2] / "home")
    try:
        form.read(folder)
    except SpslamError as error:
        text = str(error)
        if _OUT_OF_MEMORY.search(text):
            return "memory", text
        if len(text.splitlines()) != 1 or len(text) > MAX_MESSAGE_CHARACTERS:
            return "message", f"{len(text)} characters: {text[:300]!r}"
        return REFUSED, f"{type(error).__name__}: {text}"
    except Exception as error:
        return "memory" if isinstance(error, MemoryError) else "exception", traceback.format_exc()
    finally:
        os.chdir(home)
    return OK, ""


def _tree(root: Path, without: tuple[Path, ...]) -> set[tuple[str, int, int]]:
    """Name, size and time of all files and folders, but of those in the folders given."""
    found = set()
    for folder, folders, names in os.walk(root):
        folders[:] = [name for name in folders if Path(folder, name) not in without]
        for name in names:
            with contextlib.suppress(OSError):
                status = os.lstat(os.path.join(folder, name))
                found.add((os.path.join(folder, name), status.st_size, status.st_mtime_ns))
        found.update((os.path.join(folder, name), 0, 0) for name in folders)
    return found


def _status_bytes(name: str) -> int:
    with open("/proc/self/status") as file:
        for line in file:
            if line.startswith(name + ":"):
                return 1024 * int(line.split()[1])
    raise ValueError(f"_status_bytes: name must be in /proc/self/status, got {name}")


def _reset_peak() -> None:
    """Sets the peak of resident memory to what is resident now."""
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
