"""Recordings on the nodes of a cluster: read where their path is, or copied to a node's disk once."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from spslam.errors import ClusterError

CHUNK_BYTES = 16 << 20  # of a file that is sent at a time

# Of each file below an input, its path there, `` for an input that is a file itself, and its bytes.
Listing = list[tuple[str, int]]
Reader = Callable[[str, int, int], np.ndarray]


def list_files(path: Path) -> Listing:
    """The files of an input in a fixed order; none where there is no such path, or it can't be read."""
    try:
        if path.is_file():
            return [("", path.stat().st_size)]
        found = [Path(folder, name) for folder, _, names in os.walk(path, followlinks=True) for name in names]
        return sorted((str(file.relative_to(path)), file.stat().st_size) for file in found)
    except OSError:
        return []


def read_part(path: Path, name: str, offset: int, count: int) -> np.ndarray:
    """uint8 [N] bytes of a file of an input, `count` at most; none behind its end."""
    with (path / name if name else path).open("rb") as file:
        file.seek(offset)
        return np.frombuffer(file.read(count), np.uint8)


def cache_folder() -> Path:
    """Where a node keeps recordings that were copied to it: `spslam/recordings` in `$XDG_CACHE_HOME` or `~/.cache`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "spslam" / "recordings"


def local_input(path: str, wanted: Listing, read: Reader, always_copy: bool) -> Path:
    """Where this machine has an input; it is copied here first if it is not here yet.

    Args:
        path: of the input on the machine that sends it. Where the same files are under it here they are used, by
            their names and sizes.
        wanted: its files.
        read: bytes of a file by name, offset and count.
        always_copy: copy them even where the path is here, as from a slow network disk.

    Returns:
        The same path, or that of the copy. Of several processes that ask for one input the first copies it.

    Raises:
        ClusterError: there is nothing at the path anywhere, or the copy can't be written.
    """
    here = Path(path)
    if not wanted:
        raise ClusterError(f"{path}: no such file or folder on the machine that sends it")
    if not always_copy and list_files(here) == wanted:
        return here
    digest = hashlib.sha256(json.dumps([path, wanted]).encode()).hexdigest()[:16]
    folder = cache_folder() / digest
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with (folder.parent / f"{digest}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.is_dir():
                _copy(folder, here.name, wanted, read)
    except OSError as error:
        raise ClusterError(f"{folder}: {path} can't be copied there: {error.strerror or error}") from error
    return folder / here.name


def _copy(folder: Path, root: str, wanted: Listing, read: Reader) -> None:
    """Copies files to a folder that appears at once when all are there."""
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name, size in wanted:
        file = part / root / name if name else part / root
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("wb") as out:
            offset = 0
            while offset < size:
                piece = read(name, offset, min(CHUNK_BYTES, size - offset))
                if not len(piece):
                    raise ClusterError(f"{root}/{name}: became shorter while it was copied")
                out.write(piece.data)
                offset += len(piece)
    os.replace(part, folder)
