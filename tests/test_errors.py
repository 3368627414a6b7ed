"""Messages of errors: one line of bounded length, whatever a file put into them."""

import pytest

from spslam.errors import DatasetError, brief


@pytest.mark.parametrize("separator", ["\n", "\r\n", "\u2028", "\x85", "\x0c"])
def test_a_message_is_one_line(separator):
    assert str(DatasetError(f"a.json: unknown key wid{separator}th")) == "a.json: unknown key wid th"


def test_a_long_message_keeps_its_ends():
    text = str(DatasetError("a.json: " + "x" * 5000 + " must be shorter"))
    assert text.startswith("a.json: xxx") and text.endswith("xxx must be shorter")
    assert len(text) <= 900


def test_a_value_is_brief():
    text = brief([1] * 1000)
    assert text.startswith("[1, 1,") and text.endswith("...") and len(text) == 80
