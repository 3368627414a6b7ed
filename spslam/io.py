"""Atomic writing of files: a reader sees the old content or the new, never a part of it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
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


def atomic_write_all(files: Mapping[Path, bytes]) -> None:
    """Writes files that belong together, the last of which names the others: all of them are complete under temporary
    names before the last one's predecessor is removed and they are renamed, in order.

    So the last file never goes with others than its own. A killed process leaves the files as they were or, between two
    renames, no last one.

    Args:
        files: contents by path, in one folder, which must exist.

    Raises:
        OutputError: the operating system refuses. Temporary files are removed.
    """
    temporaries = {path: path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}") for path in files}
    *_, last = files
    try:
        for path, content in files.items():
            with writing(path):
                _write(temporaries[path], content)
                _flush_to_disk(temporaries[path])
        with writing(last):
            last.unlink(missing_ok=True)
            for path, temporary in temporaries.items():
                os.replace(temporary, path)
            _flush_to_disk(last.parent)
    finally:
        for temporary in temporaries.values():
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
