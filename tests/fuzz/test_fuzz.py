"""The harness finds each kind of failure, the same seed gives the same case, and a minute of fixed seeds is clean."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from spslam.errors import DatasetError
from tests.fuzz import worker
from tests.fuzz.cases import run_case, write_case
from tests.fuzz.formats import Format, all_formats
from tests.fuzz.worker import run_cases

ROOT = Path(__file__).parents[2]
NAMES = list(all_formats())
CASES = 200  # of each format
HELD: list[bytearray] = []


class Planted(Format):
    """A format whose reading fails in one way at every third seed."""

    name = "planted"

    def __init__(self, fault) -> None:
        self.fault = fault

    def write(self, random, folder):
        (folder / "file").write_text(str(random.random()))

    def read(self, folder):
        if self.fault is not None:
            self.fault(folder)


def refuse(folder):
    raise DatasetError(f"{folder}: must be better")


def raise_key_error(folder):
    raise KeyError("data")


class TwoLinesError(DatasetError):
    """What `SpslamError` prevents."""

    def __str__(self) -> str:
        return "one\ntwo"


def speak_in_lines(folder):
    raise TwoLinesError


def read_null(folder):
    ctypes.string_at(0)


def leave_early(folder):
    os._exit(3)


def spin(folder):
    while True:
        pass


def sleep(folder):
    time.sleep(60)


def leave_a_file(folder):
    (folder / "left").touch()


def leave_a_file_outside(folder):
    (folder / ".." / ".." / "left").touch()


def leave_a_file_at_home(folder):
    Path("left").touch()


def change_the_file(folder):
    (folder / "file").write_text("")


def take_memory(folder):
    HELD.append(bytearray(b"x") * (1100 << 20))


def ask_for_memory(folder):
    try:
        bytearray(1 << 40)
    except MemoryError:
        raise DatasetError("can't be read: MemoryError") from None


FAULTS = {
    refuse: "refused",
    None: "ok",
    raise_key_error: "exception",
    speak_in_lines: "message",
    read_null: "crash",
    leave_early: "crash",
    spin: "hang",
    sleep: "hang",
    leave_a_file: "files",
    leave_a_file_outside: "files",
    leave_a_file_at_home: "files",
    change_the_file: "files",
    take_memory: "memory",
    ask_for_memory: "memory",
}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: getattr(fault, "__name__", "none"))
def test_each_kind_of_failure_is_found_and_the_next_case_still_runs(monkeypatch, fault):
    if fault is spin:  # the others may be slow beside other work
        monkeypatch.setattr(worker, "MAX_SECONDS", 0.5)
    monkeypatch.setattr(worker, "MAX_SLEEPING_SECONDS", 2.0)
    outcomes = list(run_cases(Planted(fault), range(7, 9)))
    assert [seed for seed, _ in outcomes] == [7, 8]
    assert [outcome.kind for _, outcome in outcomes] == [FAULTS[fault]] * 2


def test_a_crash_says_by_which_signal():
    ((_, outcome),) = run_cases(Planted(read_null), range(1))
    assert outcome.text == "ended by SIGSEGV"


def test_cases_end_in_time():
    began = time.monotonic()
    seeds = [seed for seed, _ in run_cases(Planted(None), range(10**6), began + 0.5)]
    assert 0 < len(seeds) < 10**6
    assert time.monotonic() - began < 30


@pytest.fixture(scope="module")
def prepared():
    """Every format with its good example; what is read has one thread, as forked processes have none of the others."""
    forms = all_formats()
    for form in forms.values():
        form.prepare()
    return forms


@pytest.mark.parametrize("name", NAMES)
def test_a_seed_gives_the_same_files(prepared, tmp_path, name):
    contents = []
    for copy in ("a", "b"):
        folder = write_case(prepared[name], 5, tmp_path / copy)
        contents.append({str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()})
    assert contents[0] == contents[1]


@pytest.mark.parametrize("name", NAMES)
def test_some_cases_are_read_and_some_refused(prepared, tmp_path, name):
    """Else the mutations say nothing: either all are refused at the first byte, or none does harm."""
    (tmp_path / "root").mkdir()
    kinds = set()
    for seed in range(40):
        kinds.add(run_case(prepared[name], seed, tmp_path / "root").kind)
        if kinds >= {"ok", "refused"}:
            break
    assert kinds == {"ok", "refused"}


@pytest.mark.slow
def test_fixed_seeds_end_in_success_or_one_line():
    """A minute of `make fuzz`, in a process of its own, as that of pytest has threads."""
    command = [sys.executable, "-m", "tests.fuzz", "--start", "0", "--cases", str(CASES)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert result.returncode == 0, result.stdout + result.stderr
