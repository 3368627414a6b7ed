"""Data sets by name: what is listed, what is fetched, and what is left alone."""

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
    return {name: content for name, content in tree(folder).items() if not name.startswith(datasets.NOTES_FOLDER)}


def test_a_data_set_is_fetched_once(site, tmp_path):
    told = set()
    source = source_of(site)
    assert not is_complete(source, tmp_path)
    assert download(source, tmp_path, lambda name, done, total: told.add(name)) == ["Rooms.zip", "desk.tgz"]
    assert data_files(tmp_path) == EXPECTED
    assert told == {"Rooms.zip", "desk.tgz"}
    assert is_complete(source, tmp_path)
    (tmp_path / "room_mesh.ply").write_bytes(b"mine")
    assert download(source, tmp_path) == []
    assert len(site.asked) == 2
    assert (tmp_path / "room_mesh.ply").read_bytes() == b"mine"
    left = {name for name in tree(tmp_path) if name.startswith(datasets.NOTES_FOLDER)}
    assert left == {f"{datasets.NOTES_FOLDER}/{name}.json" for name in ("Rooms.zip", "desk.tgz")}


def test_what_was_interrupted_goes_on(site, tmp_path):
    source = source_of(site)
    site.cuts = [100] + [0] * 10
    with pytest.raises(DatasetError, match="100 bytes are kept"):
        download(source, tmp_path, first_pause_s=0)
    site.cuts, site.asked = [], []
    download(source, tmp_path)
    assert site.asked == [100, None]
    assert data_files(tmp_path) == EXPECTED


def test_an_interrupted_unpacking_needs_no_second_download(site, tmp_path):
    notes = tmp_path / datasets.NOTES_FOLDER
    notes.mkdir()
    (notes / "Rooms.zip").write_bytes(zipped(FILES))
    download(source_of(site), tmp_path)
    assert data_files(tmp_path) == EXPECTED
    assert len(site.asked) == 1


def test_a_wrong_checksum_leaves_nothing(site, tmp_path):
    with pytest.raises(DatasetError, match="Rooms.zip: SHA-256 must be "):
        download(source_of(site, sha256="0" * 64), tmp_path)
    assert tree(tmp_path) == {}


def test_a_damaged_archive_is_removed_so_that_it_is_fetched_anew(site, tmp_path):
    good = site.files["Rooms.zip"]
    site.files["Rooms.zip"] = b"<html>moved</html>"
    with pytest.raises(DatasetError, match="Rooms.zip: must be a zip or tar file"):
        download(source_of(site), tmp_path)
    site.files["Rooms.zip"] = good
    download(source_of(site), tmp_path)
    assert data_files(tmp_path) == EXPECTED


def test_names():
    assert find_source("7scenes/chess").archives[0].name == "chess.zip"
    for name in ("tum/freiburg1_rpy", "tum/rgbd_dataset_freiburg1_rpy"):
        (archive,) = find_source(name).archives
        assert archive.url.endswith("/rgbd/dataset/freiburg1/rgbd_dataset_freiburg1_rpy.tgz")
    assert find_source("tum/fr3_office").archives[0].name == "rgbd_dataset_freiburg3_long_office_household.tgz"
    for name, message in {
        "replca": "replca is no data set to download; did you mean replica?",
        "tum/../../x": "is no data set to download",
        "kitti": "spslam download lists the names",
        "scannet": "scannet can't be downloaded without a form",
        "scannet/scene0000_00": "scannet can't be downloaded without a form",
    }.items():
        with pytest.raises(DatasetError, match=message):
            find_source(name)


def test_the_catalog_is_consistent():
    assert len({source.name for source in SOURCES}) == len(SOURCES)
    for source in SOURCES:
        assert source.config in config_names()
        assert all(archive.url.startswith("http") for archive in source.archives)
        assert "http" in source.terms


def test_the_command(site, tmp_path, monkeypatch, capsys):
    sources = [source_of(site)]
    monkeypatch.setattr(command, "SOURCES", sources)
    monkeypatch.setattr(command, "find_source", lambda name: sources[0])
    assert main(["download", "--data", str(tmp_path)]) == 0
    listed = capsys.readouterr().out
    assert "rooms" in listed
    assert "public domain" in listed
    assert "scannet can't be downloaded without a form" in listed
    assert main(["download", "rooms", "--data", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert re.search(
        rf"^ready in {tmp_path}; next:\n  .* -m spslam run replica --data {tmp_path}/room$", printed.out, re.M
    )
    assert "Rooms.zip: 100% of 0 MB" in printed.err
    assert main(["download", "rooms", "--data", str(tmp_path), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    main(["download", "--data", str(tmp_path)])
    assert "(there)" in capsys.readouterr().out


def test_wrong_names_are_one_line(tmp_path, capsys):
    assert main(["download", "scannet", "--data", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("spslam: scannet can't be downloaded without a form")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
