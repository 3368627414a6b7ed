"""Downloads one file over HTTP, with resume and checksum."""

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

# Called with the bytes downloaded and the total bytes (None if the server does not report it).
Progress = Callable[[int, int | None], None]

ATTEMPTS = 6
FIRST_PAUSE_S = 1.0
_TIMEOUT_S = 60.0
_CHUNK_BYTES = 1 << 20
# Left free on the disk.
SPARE_BYTES = 64 << 20


@dataclass
class _PartialDownload:
    """Which version of the file the `.part` file belongs to; saved beside it as JSON."""

    url: str
    # ETag or Last-Modified, so that bytes of two versions are never mixed.
    version: str | None = None
    total: int | None = None


class _InterruptedError(Exception):
    """The connection ended before the file was complete."""


def fetch(
    url: str,
    target: Path,
    sha256: str | None = None,
    progress: Progress | None = None,
    first_pause_s: float = FIRST_PAUSE_S,
) -> str:
    """Downloads a file to `target`.

    The bytes are written to `target.part`. An interrupted connection is resumed where it stopped, with up to six
    attempts in a row that receive nothing. A later call resumes what an earlier call left, if the file on the server is
    still the same version.

    Args:
        url: `http` or `https`.
        target: the file to write, atomically; its folder must exist.
        sha256: expected checksum; None skips the check.
        progress: called for every megabyte.
        first_pause_s: pause before the second attempt, in seconds; doubled each time.

    Returns:
        SHA-256 of the file in hexadecimal.

    Raises:
        DatasetError: the server refuses, all attempts fail (the downloaded part is kept), the checksum does not match
            (the downloaded file is removed), or the disk is too small.
    """
    if not url.startswith(("http://", "https://")):
        raise DatasetError(f"{url}: must be a URL with http or https")
    part_path, record_path = _with_suffix(target, ".part"), _with_suffix(target, ".part.json")
    failures, cause = 0, ""
    while failures < ATTEMPTS:
        if failures:
            time.sleep(first_pause_s * 2 ** (failures - 1))
        before = _size(part_path)
        try:
            _resume(url, part_path, record_path, progress)
            break
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code not in (408, 429):
                raise DatasetError(f"{url}: the server responds {error.code} {error.reason}") from error
            cause = f"{error.code} {error.reason}"
        except (
            _InterruptedError,
            urllib.error.URLError,
            http.client.HTTPException,
            ConnectionError,
            TimeoutError,
        ) as error:
            cause = str(getattr(error, "reason", error)) or type(error).__name__
        failures = 1 if _size(part_path) > before else failures + 1
    else:
        raise DatasetError(
            f"{url}: can't be downloaded: {cause}; {_size(part_path)} bytes are kept and the same command resumes"
        )
    return _finish(url, part_path, record_path, target, sha256)


def require_space(folder: Path, needed: int, what: str) -> None:
    """Raises DatasetError if the disk of `folder` has less than `needed` bytes and `SPARE_BYTES` free.

    Args:
        folder: on the disk.
        needed: bytes.
        what: what needs them, for the message.
    """
    free = shutil.disk_usage(folder).free
    if free < needed + SPARE_BYTES:
        raise DatasetError(f"{folder}: {what} needs {needed / 1e9:.1f} GB, but only {free / 1e9:.1f} GB are free")


def _resume(url: str, part_path: Path, record_path: Path, progress: Progress | None) -> None:
    """Requests the missing bytes over one connection and appends them; raises if the file is still incomplete."""
    part, start = _read_record(record_path, url), _size(part_path)
    if part.version is None:
        start = 0  # the file on the server may have changed since
    if part.total is not None and start == part.total:
        return
    headers = {"User-Agent": "spslam", "Accept-Encoding": "identity"}
    if start and part.version is not None:
        headers |= {"Range": f"bytes={start}-", "If-Range": part.version}
    with _open(urllib.request.Request(url, headers=headers)) as response:
        start = start if response.status == 206 and _first_byte(response) == start else 0
        if response.status == 206 and start == 0:
            raise _InterruptedError("the server sent another range than requested")
        part = _PartialDownload(url, _version(response), _total(response, start))
        require_space(part_path.parent, (part.total or 0) - start, "the download")
        atomic_write(record_path, json.dumps(asdict(part)))
        with part_path.open("r+b" if start else "wb") as file:
            file.seek(start)
            file.truncate()
            _copy(response, file, start, part.total, progress)
    if part.total is not None and _size(part_path) < part.total:
        raise _InterruptedError(f"the connection ended after {_size(part_path)} of {part.total} bytes")


def _open(request: urllib.request.Request) -> http.client.HTTPResponse:
    try:
        return urllib.request.urlopen(request, timeout=_TIMEOUT_S)  # type: ignore[no-any-return]
    except urllib.error.URLError:
        raise
    except OSError as error:  # while the response was waited for, which urllib doesn't wrap
        raise _InterruptedError(error.strerror or str(error) or type(error).__name__) from error


def _copy(
    response: http.client.HTTPResponse, file: BinaryIO, done: int, total: int | None, progress: Progress | None
) -> None:
    while True:
        try:
            chunk = response.read1(_CHUNK_BYTES)
        except http.client.IncompleteRead as error:
            chunk = error.partial
        except OSError as error:  # of the network, as of TLS or of routing; those of the disk are raised below
            raise _InterruptedError(error.strerror or str(error) or type(error).__name__) from error
        if not chunk:
            return
        file.write(chunk)
        done += len(chunk)
        if progress is not None:
            progress(done, total)


def _finish(url: str, part_path: Path, record_path: Path, target: Path, sha256: str | None) -> str:
    digest = hashlib.sha256()
    with part_path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    found = digest.hexdigest()
    record_path.unlink(missing_ok=True)
    if sha256 is not None and found != sha256.lower():
        part_path.unlink()
        raise DatasetError(f"{url}: SHA-256 must be {sha256}, got {found}; the downloaded file is removed")
    part_path.replace(target)
    return found


def _read_record(path: Path, url: str) -> _PartialDownload:
    try:
        part = _PartialDownload(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return _PartialDownload(url)
    return part if part.url == url else _PartialDownload(url)


def _version(response: http.client.HTTPResponse) -> str | None:
    tag = response.headers.get("ETag")
    # A weak tag does not guarantee equal bytes.
    return tag if tag and not tag.startswith("W/") else response.headers.get("Last-Modified")


def _total(response: http.client.HTTPResponse, start: int) -> int | None:
    length = response.headers.get("Content-Length")
    return start + int(length) if length and length.isdecimal() else None


def _first_byte(response: http.client.HTTPResponse) -> int | None:
    match = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    return int(match.group(1)) if match else None


def _with_suffix(target: Path, suffix: str) -> Path:
    return target.with_name(target.name + suffix)


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
