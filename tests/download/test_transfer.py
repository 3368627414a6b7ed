"""Downloads over interrupted connections, and of files that change on the server."""

import errno
import hashlib
import http.client
import shutil
import ssl

import numpy as np
import pytest

from spslam.download import transfer
from spslam.download.transfer import ATTEMPTS, fetch
from spslam.errors import DatasetError
from tests.download.server import Site, serve

CONTENT = np.random.default_rng(0).bytes(300_000)
DIGEST = hashlib.sha256(CONTENT).hexdigest()
NO_PAUSE = {"first_pause_s": 0.0}


@pytest.fixture
def site():
    with serve(Site({"room.zip": CONTENT})) as site:
        yield site


def get(site, folder, **options):
    return fetch(site.url("room.zip"), folder / "room.zip", **NO_PAUSE, **options)


def check_whole(folder):
    assert (folder / "room.zip").read_bytes() == CONTENT
    assert [path.name for path in folder.iterdir()] == ["room.zip"]


def test_a_complete_download(site, tmp_path):
    reported = []
    assert (
        get(site, tmp_path, sha256=DIGEST.upper(), progress=lambda done, total: reported.append((done, total)))
        == DIGEST
    )
    check_whole(tmp_path)
    assert reported[-1] == (len(CONTENT), len(CONTENT))
    assert site.requested == [None]


def test_an_interrupted_connection_is_resumed_where_it_stopped(site, tmp_path):
    site.cuts = [100_000, 50_000, 1]
    get(site, tmp_path, sha256=DIGEST)
    check_whole(tmp_path)
    assert site.requested == [None, 100_000, 150_000, 150_001]


NETWORK_ERRORS = [
    ssl.SSLError(1, "[SSL: DECRYPTION_FAILED_OR_BAD_RECORD_MAC] bad record"),
    OSError(errno.EHOSTUNREACH, "No route to host"),
    TimeoutError("timed out"),
]


@pytest.mark.parametrize("error", NETWORK_ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("where", ["read1", "begin"])
def test_a_connection_that_fails_is_resumed_whatever_the_error(site, tmp_path, monkeypatch, error, where):
    """Of the network, that is, and not of the disk: while the body is read, or the response waited for."""
    site.cuts, responses, failed, method = [120_000], [], [], getattr(http.client.HTTPResponse, where)

    def failing(response, *arguments):
        if response not in responses:
            responses.append(response)
        if len(responses) == 2 and not failed:
            failed.append(where)
            raise error
        return method(response, *arguments)

    monkeypatch.setattr(http.client.HTTPResponse, where, failing)
    get(site, tmp_path, sha256=DIGEST)
    check_whole(tmp_path)
    assert failed and site.requested[0] is None and set(site.requested[1:]) == {120_000}


def test_a_failing_network_is_named(site, tmp_path, monkeypatch):
    def failing(response, count):
        raise NETWORK_ERRORS[1]

    monkeypatch.setattr(http.client.HTTPResponse, "read1", failing)
    with pytest.raises(DatasetError, match="can't be downloaded: No route to host; 0 bytes are kept"):
        get(site, tmp_path)


def test_a_failing_disk_is_not_tried_again(site, tmp_path, monkeypatch):
    def full(response, file, *arguments):
        return copy(response, Full(file), *arguments)

    class Full:
        def __init__(self, file):
            self.file = file

        def write(self, content):
            raise OSError(errno.ENOSPC, "No space left on device")

    copy = transfer._copy
    monkeypatch.setattr(transfer, "_copy", full)
    with pytest.raises(OSError, match="No space left on device"):
        get(site, tmp_path)
    assert site.requested == [None]


def test_a_later_call_resumes(site, tmp_path):
    site.cuts = [120_000] + [0] * ATTEMPTS
    with pytest.raises(DatasetError, match=r"room.zip: can't be downloaded: .*; 120000 bytes are kept and the same"):
        get(site, tmp_path)
    assert not (tmp_path / "room.zip").exists()
    site.cuts, site.requested = [], []
    get(site, tmp_path, sha256=DIGEST)
    check_whole(tmp_path)
    assert site.requested == [120_000]


def test_a_complete_part_file_is_not_downloaded_again(site, tmp_path):
    site.cuts = [120_000] + [0] * ATTEMPTS
    with pytest.raises(DatasetError):
        get(site, tmp_path)
    (tmp_path / "room.zip.part").write_bytes(CONTENT)
    site.requested = []
    get(site, tmp_path, sha256=DIGEST)
    check_whole(tmp_path)
    assert site.requested == []


@pytest.mark.parametrize("change", [{"ranges": False}, {"etag": '"2"'}, {"etag": None}])
def test_another_version_or_no_range_support_starts_from_the_beginning(site, tmp_path, change):
    site.cuts = [120_000] + [0] * ATTEMPTS
    with pytest.raises(DatasetError):
        get(site, tmp_path)
    for name, value in change.items():
        setattr(site, name, value)
    site.cuts = []
    get(site, tmp_path, sha256=DIGEST)
    check_whole(tmp_path)


def test_without_a_version_nothing_is_resumed(site, tmp_path):
    site.etag, site.cuts = None, [100_000]
    get(site, tmp_path, sha256=DIGEST)
    check_whole(tmp_path)
    assert site.requested == [None, None]


def test_a_record_of_another_download_is_ignored(site, tmp_path):
    (tmp_path / "room.zip.part").write_bytes(b"x" * 1000)
    for record in ("no json", '{"url": "http://elsewhere", "version": "1", "total": 1000}', '{"wrong": 1}'):
        (tmp_path / "room.zip.part.json").write_text(record)
        get(site, tmp_path, sha256=DIGEST)
        check_whole(tmp_path)
        (tmp_path / "room.zip.part").write_bytes(b"x" * 1000)


def test_a_wrong_checksum_removes_the_download(site, tmp_path):
    with pytest.raises(DatasetError, match=rf"room.zip: SHA-256 must be {'0' * 64}, got {DIGEST}; the downloaded"):
        get(site, tmp_path, sha256="0" * 64)
    assert not list(tmp_path.iterdir())


def test_a_busy_server_is_tried_again_and_a_refusal_is_not(site, tmp_path):
    site.faults = [503, 429]
    get(site, tmp_path, sha256=DIGEST)
    check_whole(tmp_path)
    site.requested = []
    with pytest.raises(DatasetError, match="absent.zip: the server responds 404"):
        fetch(site.url("absent.zip"), tmp_path / "absent.zip", **NO_PAUSE)
    assert len(site.requested) == 1
    site.faults = [503] * ATTEMPTS
    with pytest.raises(DatasetError, match="can't be downloaded: 503 .*; 0 bytes are kept"):
        fetch(site.url("room.zip"), tmp_path / "other.zip", **NO_PAUSE)


def test_no_server_and_another_protocol(tmp_path):
    with pytest.raises(DatasetError, match="can't be downloaded: .*refused"):
        fetch("http://127.0.0.1:9/room.zip", tmp_path / "room.zip", **NO_PAUSE)
    with pytest.raises(DatasetError, match="file:///etc/passwd: must be a URL with http or https"):
        fetch("file:///etc/passwd", tmp_path / "room.zip")


def test_a_full_disk_is_reported_before_the_download(site, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**9, 10**9, transfer.SPARE_BYTES))
    with pytest.raises(DatasetError, match="the download needs 0.0 GB, but only 0.1 GB are free"):
        get(site, tmp_path)
