"""Datasets by name: the catalog, downloading, and resuming."""

import re

import pytest

from spslam.cli import download as command
from spslam.cli.main import main
from spslam.config import config_names
from spslam.download import SOURCES, Archive, Source, datasets, download, find_source, is_complete
from spslam.errors import DatasetError
from tests.download.server import Site, serve
from tests.download.test_unpacking import FILES, tarred, tree, zipped


@pytest.fixture
def site():
    files = {"Rooms.zip": zipped(FILES), "desk.tgz": tarred({"desk/rgb.txt": b"1 a.png"})}
    with serve(Site(files)) as site:
        yield site


def source_of(site, sha256=None):
    archives = Archive(site.url("Rooms.zip"), sha256=sha256), Archive(site.url("desk.tgz"), "tum")
    return Source("rooms", "rooms of a test", "public domain", 0.001, archives, "replica", "room")


EXPECTED = {**FILES, "tum/desk/rgb.txt": b"1 a.png"}


def data_files(folder):
    return {name: content for name, content in tree(folder).items() if not name.startswith(datasets.RECORDS_FOLDER)}


def test_a_dataset_is_downloaded_once(site, tmp_path):
    reported = set()
    source = source_of(site)
    assert not is_complete(source, tmp_path)
    assert download(source, tmp_path, lambda name, done, total: reported.add(name)) == ["Rooms.zip", "desk.tgz"]
    assert data_files(tmp_path) == EXPECTED
    assert reported == {"Rooms.zip", "desk.tgz"}
    assert is_complete(source, tmp_path)
    (tmp_path / "room_mesh.ply").write_bytes(b"mine")
    assert download(source, tmp_path) == []
    assert len(site.requested) == 2
    assert (tmp_path / "room_mesh.ply").read_bytes() == b"mine"
    left = {name for name in tree(tmp_path) if name.startswith(datasets.RECORDS_FOLDER)}
    assert left == {f"{datasets.RECORDS_FOLDER}/{name}.json" for name in ("Rooms.zip", "desk.tgz")}


def test_an_interrupted_download_resumes(site, tmp_path):
    source = source_of(site)
    site.cuts = [100] + [0] * 10
    with pytest.raises(DatasetError, match="100 bytes are kept"):
        download(source, tmp_path, first_pause_s=0)
    site.cuts, site.requested = [], []
    download(source, tmp_path)
    assert site.requested == [100, None]
    assert data_files(tmp_path) == EXPECTED


def test_interrupted_unpacking_does_not_download_again(site, tmp_path):
    records = tmp_path / datasets.RECORDS_FOLDER
    records.mkdir()
    (records / "Rooms.zip").write_bytes(zipped(FILES))
    download(source_of(site), tmp_path)
    assert data_files(tmp_path) == EXPECTED
    assert len(site.requested) == 1


def test_a_wrong_checksum_leaves_no_files(site, tmp_path):
    with pytest.raises(DatasetError, match="Rooms.zip: SHA-256 must be "):
        download(source_of(site, sha256="0" * 64), tmp_path)
    assert tree(tmp_path) == {}


def test_a_damaged_archive_is_removed_and_downloaded_again(site, tmp_path):
    good = site.files["Rooms.zip"]
    site.files["Rooms.zip"] = b"<html>moved</html>"
    with pytest.raises(DatasetError, match="Rooms.zip: must be a zip or tar file"):
        download(source_of(site), tmp_path)
    site.files["Rooms.zip"] = good
    download(source_of(site), tmp_path)
    assert data_files(tmp_path) == EXPECTED


def test_sources_are_found_by_name():
    assert find_source("7scenes/chess").archives[0].name == "chess.zip"
    for name in ("tum/freiburg1_rpy", "tum/rgbd_dataset_freiburg1_rpy"):
        (archive,) = find_source(name).archives
        assert archive.url.endswith("/rgbd/dataset/freiburg1/rgbd_dataset_freiburg1_rpy.tgz")
    assert find_source("tum/fr3_office").archives[0].name == "rgbd_dataset_freiburg3_long_office_household.tgz"
    for name, message in {
        "replca": "replca: not a dataset that can be downloaded; did you mean replica?",
        "tum/../../x": "not a dataset that can be downloaded",
        "kitti": "`spslam download` lists the names",
        "scannet": "scannet can't be downloaded without signing",
        "scannet/scene0000_00": "scannet can't be downloaded without signing",
    }.items():
        with pytest.raises(DatasetError, match=message):
            find_source(name)


def test_the_catalog_is_consistent():
    assert len({source.name for source in SOURCES}) == len(SOURCES)
    for source in SOURCES:
        assert source.config in config_names()
        assert all(archive.url.startswith("http") for archive in source.archives)
        assert "http" in source.terms


def test_download_command(site, tmp_path, monkeypatch, capsys):
    sources = [source_of(site)]
    monkeypatch.setattr(command, "SOURCES", sources)
    monkeypatch.setattr(command, "find_source", lambda name: sources[0])
    assert main(["download", "--data", str(tmp_path)]) == 0
    listed = capsys.readouterr().out
    assert "rooms" in listed
    assert "public domain" in listed
    assert "scannet can't be downloaded without signing" in listed
    assert main(["download", "rooms", "--data", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert re.search(
        rf"^downloaded to {tmp_path}; next:\n  .* -m spslam run replica --data {tmp_path}/room$", printed.out, re.M
    )
    assert "Rooms.zip: 100% of 0 MB" in printed.err
    assert main(["download", "rooms", "--data", str(tmp_path), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    main(["download", "--data", str(tmp_path)])
    assert "(downloaded)" in capsys.readouterr().out


def test_a_wrong_name_is_a_one_line_error(tmp_path, capsys):
    assert main(["download", "scannet", "--data", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("spslam: scannet can't be downloaded without signing")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
