"""Atomic writing of files: a reader sees the old content or the new, never a part of it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from spslam.errors import OutputError


def atomic_write(path: str | os.PathLike, content: bytes | str | Callable[[Path], object]) -> None:
    """Writes a file atomically: write a temporary file beside it, fsync, rename, fsync the folder.

    On any error `path` is left as it was, and the temporary file is removed. Only a killed process leaves one behind
    (`.NAME.PID.tmp.SUFFIX`), which no reader looks at.

    Args:
        path: the file to write. Its folder must exist.
        content: bytes, text (encoded as UTF-8), or a function that takes the path of the temporary file, which has the
            same suffix, and writes it.

    Raises:
        OutputError: the operating system refuses.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        with writing(path):
            _write(temporary, content)
            _flush_to_disk(temporary)
            os.replace(temporary, path)
            _flush_to_disk(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


@contextlib.contextmanager
def writing(path: str | os.PathLike) -> Iterator[None]:
    """Turns an error of the operating system, say a full disk, into one line that names the file being written.

    Raises:
        OutputError: the operating system refuses.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: can't be written: {error.strerror or error}") from error


def _write(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    if callable(content):
        # Some writers create files that only their owner can read. Results get the default permissions instead.
        path.touch()
        mode = path.stat().st_mode
        content(path)
        path.chmod(mode)
    elif isinstance(content, str):
        path.write_bytes(content.encode())
    else:
        path.write_bytes(content)


def _flush_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
