"""Recordings on the nodes of a cluster: read where their path is, or copied to a node's disk once."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spslam.errors import ClusterError

CHUNK_BYTES = 16 << 20  # of a file that is sent at a time

# Files up to this size are told apart by their content, which weights, images and tables of poses are; larger ones,
# videos and bags, would take longer to read than their names and sizes are likely to deceive.
HASHED_BYTES = 16 << 20


class ListedFile(NamedTuple):
    """A file of an input.

    Attributes:
        name: path below the input; empty for an input that is a file itself.
        size: bytes.
        content: SHA-256 in hexadecimal of a file of at most `HASHED_BYTES`, else empty.
        modified_ns: when a larger file was last written, ns; 0 of others, whose content says more.
    """

    name: str
    size: int
    content: str = ""
    modified_ns: int = 0


Listing = list[ListedFile]
Reader = Callable[[str, int, int], np.ndarray]


def file_names(path: Path) -> list[str]:
    """The files of an input by their paths below it, in a fixed order; one empty name for a file itself."""
    return [""] if path.is_file() else sorted(str(file.relative_to(path)) for file in _walk(path))


def list_files(path: Path) -> Listing:
    """The files of an input in the order of `file_names`; none where there is no such path, or it can't be read.

    Reads all files of at most `HASHED_BYTES`.
    """
    try:
        return [_listed(path, name) for name in file_names(path)]
    except OSError:
        return []


def has_files(path: Path, wanted: Listing) -> bool:
    """Whether there are the files of a listing at a path: of the same names, sizes and, where known, content.

    Names and sizes are compared first, so that files are read only where these are the same. When large files were
    written does not count: whoever copied them may have given them other times.
    """
    try:
        if [(name, _inside(path, name).stat().st_size) for name in file_names(path)] != [file[:2] for file in wanted]:
            return False
        return all(_listed(path, file.name)[:3] == file[:3] for file in wanted)
    except OSError:
        return False


def read_part(path: Path, name: str, offset: int, count: int) -> np.ndarray:
    """uint8 [N] bytes of a file of an input, `count` at most; none behind its end."""
    with _inside(path, name).open("rb") as file:
        file.seek(offset)
        return np.frombuffer(file.read(count), np.uint8)


def cache_folder() -> Path:
    """Where a node keeps recordings that were copied to it: `spslam/recordings` in `$XDG_CACHE_HOME` or `~/.cache`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "spslam" / "recordings"


def local_input(path: str, wanted: Listing, read: Reader, always_copy: bool) -> Path:
    """Where this machine has an input; it is copied here first if it is not here yet.

    Args:
        path: of the input on the machine that sends it. Where the same files are under it here they are used, by
            `has_files`. A copy of earlier files is not used: what was copied is known by its listing.
        wanted: its files.
        read: bytes of a file by name, offset and count.
        always_copy: copy them even where the path is here, as from a slow network disk.

    Returns:
        The same path, or that of the copy. Of several processes that ask for one input the first copies it.

    Raises:
        ClusterError: there is nothing at the path anywhere, the copy can't be written, or a file changed meanwhile.
    """
    here = Path(path)
    if not wanted:
        raise ClusterError(f"{path}: no such file or folder, or not to be read, on the machine that sends it")
    if not always_copy and has_files(here, wanted):
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
    for listed in wanted:
        file = _inside(part / root, listed.name)
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("wb") as out:
            offset = 0
            while offset < listed.size:
                piece = read(listed.name, offset, min(CHUNK_BYTES, listed.size - offset))
                if not len(piece):
                    raise ClusterError(f"{root}/{listed.name}: became shorter while it was copied")
                out.write(piece.data)
                offset += len(piece)
        if listed.content and _hash(file) != listed.content:
            raise ClusterError(f"{root}/{listed.name}: changed after the command began")
    os.replace(part, folder)


def _walk(path: Path) -> Iterator[Path]:
    for folder, _, names in os.walk(path, followlinks=True):
        for name in names:
            yield Path(folder, name)


def _inside(path: Path, name: str) -> Path:
    return path / name if name else path


def _listed(path: Path, name: str) -> ListedFile:
    file = _inside(path, name)
    status = file.stat()
    if status.st_size > HASHED_BYTES:
        return ListedFile(name, status.st_size, modified_ns=status.st_mtime_ns)
    return ListedFile(name, status.st_size, _hash(file))


def _hash(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
