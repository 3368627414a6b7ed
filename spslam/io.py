"""Writing files so that a reader sees the old content or the new, never a part."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

from spslam.errors import OutputError


def atomic_write(path: str | os.PathLike, content: bytes | str | Callable[[Path], object]) -> None:
    """Write a file by way of a temporary one beside it: write, fsync, rename, fsync the folder.

    Parameters
    ----------
    path : the file to write. Its folder must exist.
    content : the bytes, the text (encoded as UTF-8), or a function that is given the temporary file's path,
        which has the same suffix, and writes it.

    Raises
    ------
    OutputError
        When the system refuses. Whatever goes wrong, ``path`` is left as it was and the temporary file is
        removed; only a killed process leaves one (``.NAME.PID.tmp.SUFFIX``), and no reader looks at it.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        _write(temporary, content)
        _flush_to_disk(temporary)
        os.replace(temporary, path)
        _flush_to_disk(path.parent)
    except OSError as error:
        raise OutputError(f"{path}: can't be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _write(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    if callable(content):
        # Some writers make files that only their owner may read; a result is as readable as any other new file.
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
