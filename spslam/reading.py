"""Reading files that may hold anything: regular files only, and never more of one than a stated limit.

A name in a list can lead to a device that never ends, a text can lack its line ends, and a small JSON document can be
nested deeper than a parser's stack. Each function raises the error class that its caller names, with one line that
begins with the file.
"""

from __future__ import annotations

import errno
import io
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from spslam.errors import SpslamError, brief

MAX_TEXT_BYTES = 32 << 20  # 100,000 poses of 16 numbers
MAX_LINE_CHARACTERS = 1 << 20
MAX_JSON_BYTES = 4 << 20
# Whole numbers of more digits mean nothing in our files; Python refuses to read those of over 4,300 in its own words.
MAX_DIGITS = 20


def open_regular(path: Path, error: type[SpslamError]) -> BinaryIO:
    """Opens a file for reading; a pipe or a device is refused, where reading might never end.

    Args:
        path: the file.
        error: what to raise.

    Raises:
        SpslamError: of class `error`: no such file, not a regular file, or the system refuses.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for somebody to write to it.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except OSError as refusal:
        raise error(f"{path}: can't be read: {refusal.strerror}") from refusal
    except ValueError as refusal:  # a zero character in the name
        raise error(f"{str(path)!r}: can't be read: {refusal}") from None
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    reason = os.strerror(errno.EISDIR) if stat.S_ISDIR(mode) else "it must be a regular file"
    raise error(f"{path}: can't be read: {reason}")


def read_bytes(path: Path, max_bytes: int, error: type[SpslamError]) -> bytes:
    """The content of a file of at most `max_bytes` bytes.

    Args:
        path: the file.
        max_bytes: most bytes that it may have.
        error: what to raise.

    Raises:
        SpslamError: of class `error`: as `open_regular`, or the file is larger.
    """
    with open_regular(path, error) as file:
        size = _checked_size(path, file, max_bytes, error)
        try:
            return file.read(size)
        except OSError as refusal:
            raise error(f"{path}: can't be read: {refusal.strerror}") from refusal


def read_text(path: Path, max_bytes: int, error: type[SpslamError]) -> str:
    """The content of a UTF-8 file of at most `max_bytes` bytes; a mark of the byte order at its start is left out.

    Raises:
        SpslamError: of class `error`: as `read_bytes`, or it is no text.
    """
    try:
        return read_bytes(path, max_bytes, error).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(f"{path}: must be a text file") from None


def read_lines(path: Path, error: type[SpslamError], max_bytes: int = MAX_TEXT_BYTES) -> Iterator[str]:
    """The lines of a UTF-8 file one at a time, without their ends, so that memory follows the longest line only.

    A mark of the byte order at the start, which editors on Windows write, is left out.

    Args:
        path: the file.
        error: what to raise.
        max_bytes: most bytes that it may have.

    Raises:
        SpslamError: of class `error`: as `read_text`, or a line is longer than `MAX_LINE_CHARACTERS`.
    """
    with open_regular(path, error) as file:
        _checked_size(path, file, max_bytes, error)
        text, number = io.TextIOWrapper(file, encoding="utf-8-sig"), 0
        try:
            while line := text.readline(MAX_LINE_CHARACTERS + 1):
                number += 1
                if len(line) > MAX_LINE_CHARACTERS:
                    raise error(f"{path}, line {number}: must have at most {MAX_LINE_CHARACTERS} characters")
                yield line.rstrip("\n")
        except UnicodeDecodeError:
            raise error(f"{path}: must be a text file") from None
        except OSError as refusal:
            raise error(f"{path}: can't be read: {refusal.strerror}") from refusal


def parse_json(text: str, name: str, error: type[Exception]) -> dict[str, Any]:
    """The object that a JSON text holds.

    Args:
        text: the document.
        name: what the message begins with.
        error: what to raise.

    Raises:
        Exception: of class `error`: not JSON, nested too deep, a whole number of over 20 digits, or no object.
    """
    try:
        content = json.loads(text, parse_int=_whole_number)
    except RecursionError:
        raise error(f"{name}: isn't valid JSON: it is nested too deep") from None
    except ValueError as fault:
        raise error(f"{name}: isn't valid JSON: {brief(str(fault), 200)}") from None
    if not isinstance(content, dict):
        raise error(f"{name}: must contain an object with named values, got {type(content).__name__}")
    return content


def _whole_number(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"a whole number must have at most {MAX_DIGITS} digits, got {len(digits)}")
    return int(digits)


def _checked_size(path: Path, file: BinaryIO, max_bytes: int, error: type[SpslamError]) -> int:
    size = os.fstat(file.fileno()).st_size
    if size > max_bytes:
        raise error(f"{path}: must have at most {max_bytes} bytes, got {size}")
    return size
