"""What this machine has for tasks: cores, and memory that is free."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

PROC, CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")
# Of a control group of version 1 and 2: files of the limit and of what is used, and the line of `memory.stat` that says
# how much of that is copies of files, which go when memory is needed.
_FILES = {
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    2: ("memory.max", "memory.current", "inactive_file"),
}


def core_count() -> int:
    """Processor cores of this machine."""
    return os.cpu_count() or 1


def free_memory_mb() -> int | None:
    """Main memory in MB that new processes can take: of the machine, and of the container this process runs in.

    Returns:
        None where the system does not say.
    """
    free = [_of_machine(), *(_of_group(folder, version) for folder, version in _groups())]
    known = [each for each in free if each is not None]
    return max(min(known), 0) >> 20 if known else None


def _of_machine() -> int | None:
    """Bytes."""
    for line in _text(PROC / "meminfo").splitlines():
        name, _, value = line.partition(":")
        if name == "MemAvailable":
            return int(value.split()[0]) << 10
    return None


def _groups() -> Iterator[tuple[Path, int]]:
    """Folders of this process's control groups that may limit memory, and their version; outer ones last."""
    for line in _text(PROC / "self" / "cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root = CGROUPS / "memory" if controllers else CGROUPS
        folder = root / path.lstrip("/")
        for each in (folder, *folder.parents):
            if each.is_relative_to(root):
                yield each, 1 if controllers else 2


def _of_group(folder: Path, version: int) -> int | None:
    """Bytes; None where the group has no limit."""
    limit_file, used_file, cached = _FILES[version]
    limit, used = _text(folder / limit_file).strip(), _text(folder / used_file).strip()
    if not limit.isdecimal() or not used.isdecimal():
        return None
    stat = dict(line.split()[:2] for line in _text(folder / "memory.stat").splitlines() if " " in line)
    return int(limit) - int(used) + int(stat.get(cached, 0))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
