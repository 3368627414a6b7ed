"""Fetching one file over HTTP: what was cut goes on where it stopped, and the whole is checked."""

from __future__ import annotations

import hashlib
import http.client
import json
import re
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

from spslam.errors import DatasetError
from spslam.io import atomic_write

# Called with the bytes there and the bytes in all (None if the server doesn't say).
Progress = Callable[[int, int | None], None]

ATTEMPTS = 6
FIRST_PAUSE_S = 1.0
_TIMEOUT_S = 60.0
_CHUNK_BYTES = 1 << 20
# Kept free on the disk beside what is written.
SPARE_BYTES = 64 << 20


@dataclass
class _Part:
    """What was fetched so far of which version of the file; stands beside it as JSON."""

    url: str
    # ETag or Last-Modified: bytes of two versions must not be mixed.
    version: str | None = None
    total: int | None = None


class _CutError(Exception):
    """The connection ended before the file did."""


def fetch(
    url: str,
    target: Path,
    sha256: str | None = None,
    progress: Progress | None = None,
    first_pause_s: float = FIRST_PAUSE_S,
) -> str:
    """Download a file to ``target``; returns its SHA-256 in hexadecimal.

    The bytes go to ``target.part``. A connection that is cut is taken up again where it stopped, up to six times in a
    row without a byte; a later call goes on with what an earlier one left, if the server's file is still the same.

    Parameters
    ----------
    url : ``http`` or ``https``.
    target : the file to write; its folder must exist. Written at once or not at all.
    sha256 : expected checksum; None checks nothing.
    progress : told of every megabyte.
    first_pause_s : pause before the second attempt; doubled each time.

    Raises
    ------
    DatasetError
        When the server refuses, the connection stays cut (what was fetched is kept), the checksum is another (what was
        fetched is removed), or the disk is too small.
    """
    if not url.startswith(("http://", "https://")):
        raise DatasetError(f"{url}: must be an address with http or https")
    part_path, note_path = _beside(target, ".part"), _beside(target, ".part.json")
    failures, cause = 0, ""
    while failures < ATTEMPTS:
        if failures:
            time.sleep(first_pause_s * 2 ** (failures - 1))
        before = _size(part_path)
        try:
            _continue(url, part_path, note_path, progress)
            break
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code not in (408, 429):
                raise DatasetError(f"{url}: the server answers {error.code} {error.reason}") from error
            cause = f"{error.code} {error.reason}"
        except (_CutError, urllib.error.URLError, http.client.HTTPException, ConnectionError, TimeoutError) as error:
            cause = str(getattr(error, "reason", error)) or type(error).__name__
        failures = 1 if _size(part_path) > before else failures + 1
    else:
        raise DatasetError(
            f"{url}: can't be fetched: {cause}; {_size(part_path)} bytes are kept, the same command goes on from there"
        )
    return _finish(url, part_path, note_path, target, sha256)


def require_space(folder: Path, needed: int, what: str) -> None:
    """Raises DatasetError if the disk of ``folder`` can't take ``needed`` bytes more and a little to spare."""
    free = shutil.disk_usage(folder).free
    if free < needed + SPARE_BYTES:
        raise DatasetError(f"{folder}: {what} needs {needed / 1e9:.1f} GB, but only {free / 1e9:.1f} GB are free")


def _continue(url: str, part_path: Path, note_path: Path, progress: Progress | None) -> None:
    """One connection: asks for what is missing and appends it; raises if the end wasn't reached."""
    part, start = _read_note(note_path, url), _size(part_path)
    if part.version is None:
        start = 0  # nothing says that the server's file is still the one that was begun
    if part.total is not None and start == part.total:
        return
    headers = {"User-Agent": "spslam", "Accept-Encoding": "identity"}
    if start and part.version is not None:
        headers |= {"Range": f"bytes={start}-", "If-Range": part.version}
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S) as answer:
        start = start if answer.status == 206 and _first_byte(answer) == start else 0
        if answer.status == 206 and start == 0:
            raise _CutError("the server sent another range than was asked for")
        part = _Part(url, _version(answer), _total(answer, start))
        require_space(part_path.parent, (part.total or 0) - start, "the download")
        atomic_write(note_path, json.dumps(asdict(part)))
        with part_path.open("r+b" if start else "wb") as file:
            file.seek(start)
            file.truncate()
            _copy(answer, file, start, part.total, progress)
    if part.total is not None and _size(part_path) < part.total:
        raise _CutError(f"the connection was cut after {_size(part_path)} of {part.total} bytes")


def _copy(
    answer: http.client.HTTPResponse, file: BinaryIO, done: int, total: int | None, progress: Progress | None
) -> None:
    while True:
        try:
            chunk = answer.read1(_CHUNK_BYTES)
        except http.client.IncompleteRead as error:
            chunk = error.partial
        if not chunk:
            return
        file.write(chunk)
        done += len(chunk)
        if progress is not None:
            progress(done, total)


def _finish(url: str, part_path: Path, note_path: Path, target: Path, sha256: str | None) -> str:
    digest = hashlib.sha256()
    with part_path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    found = digest.hexdigest()
    note_path.unlink(missing_ok=True)
    if sha256 is not None and found != sha256.lower():
        part_path.unlink()
        raise DatasetError(f"{url}: SHA-256 must be {sha256}, got {found}; what was fetched is removed")
    part_path.replace(target)
    return found


def _read_note(path: Path, url: str) -> _Part:
    try:
        part = _Part(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return _Part(url)
    return part if part.url == url else _Part(url)


def _version(answer: http.client.HTTPResponse) -> str | None:
    tag = answer.headers.get("ETag")
    # A weak tag is no promise of equal bytes.
    return tag if tag and not tag.startswith("W/") else answer.headers.get("Last-Modified")


def _total(answer: http.client.HTTPResponse, start: int) -> int | None:
    length = answer.headers.get("Content-Length")
    return start + int(length) if length and length.isdecimal() else None


def _first_byte(answer: http.client.HTTPResponse) -> int | None:
    match = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range", ""))
    return int(match.group(1)) if match else None


def _beside(target: Path, suffix: str) -> Path:
    return target.with_name(target.name + suffix)


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
