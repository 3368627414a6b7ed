"""Files that may hold anything: one line that names the file, and no more memory than the limits say."""

import os

import pytest

from spslam.errors import DatasetError, OutputError
from spslam.reading import MAX_LINE_CHARACTERS, open_regular, parse_json, read_bytes, read_lines, read_text


def test_a_file_is_read_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("one\n\ntwo")
    assert read_bytes(path, 100, DatasetError) == b"one\n\ntwo"
    assert read_text(path, 8, DatasetError) == "one\n\ntwo"
    assert list(read_lines(path, DatasetError)) == ["one", "", "two"]


def test_a_mark_of_the_byte_order_is_left_out(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("one\ntwo\n", encoding="utf-8-sig")
    assert path.read_bytes().startswith(b"\xef\xbb\xbf")
    assert read_text(path, 100, DatasetError) == "one\ntwo\n"
    assert list(read_lines(path, DatasetError)) == ["one", "two"]


def test_what_is_no_regular_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for path, message in {
        tmp_path / "absent": "absent: no such file",
        tmp_path / "folder": "folder: can't be read: Is a directory",
        tmp_path / "pipe": "pipe: can't be read: it must be a regular file",
        "/dev/zero": "/dev/zero: can't be read: it must be a regular file",
        tmp_path / "a\0b": "can't be read: embedded null byte",
        tmp_path / ("n" * 300): "can't be read: File name too long",
    }.items():
        with pytest.raises(DatasetError, match=message):
            open_regular(path, DatasetError)


def test_larger_files_are_refused_before_they_are_read(tmp_path):
    path = tmp_path / "sparse"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    for read in (lambda: read_bytes(path, 1 << 20, OutputError), lambda: list(read_lines(path, OutputError))):
        with pytest.raises(OutputError, match="sparse: must have at most .* bytes, got 1099511627776"):
            read()


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "a").write_bytes(b"\xff\xfe\x00")
    for read in (
        lambda: read_text(tmp_path / "a", 10, DatasetError),
        lambda: list(read_lines(tmp_path / "a", DatasetError)),
    ):
        with pytest.raises(DatasetError, match="a: must be a text file"):
            read()


def test_a_line_without_end_is_refused(tmp_path):
    (tmp_path / "a").write_text("short\n" + "1" * (MAX_LINE_CHARACTERS + 1))
    with pytest.raises(DatasetError, match="a, line 2: must have at most 1048576 characters"):
        list(read_lines(tmp_path / "a", DatasetError))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "isn't valid JSON: Expecting"),
        ("[" * 100_000, "isn't valid JSON: it is nested too deep"),
        ('{"a": ' + "9" * 5000 + "}", "isn't valid JSON: a whole number must have at most 20 digits, got 5000"),
        ("[1]", "must contain an object with named values, got list"),
    ],
)
def test_json_that_holds_no_object_is_refused(text, message):
    with pytest.raises(OutputError, match=f"camera.json: {message}") as error:
        parse_json(text, "camera.json", OutputError)
    assert "\n" not in str(error.value)


def test_json():
    assert parse_json('{"a": 12345678901234567890, "b": 1.5}', "x", OutputError) == {
        "a": 12345678901234567890,
        "b": 1.5,
    }
