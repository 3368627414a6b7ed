"""The command line: help, version, wrong arguments, and the output of errors."""

import argparse
import re
import subprocess
import sys

import pytest

import spslam as package
from spslam.cli import main as main_module
from spslam.cli.arguments import frame_range
from spslam.cli.command_name import command_name
from spslam.cli.doctor import cuda_archs
from spslam.cli.main import COMMANDS, main
from spslam.config import config_names
from spslam.errors import DatasetError
from tests.cli.command import ROOT, assert_refused, spslam


def test_help_lists_every_command(tmp_path):
    result = spslam("--help", cwd=tmp_path)
    assert result.returncode == 0
    assert all(command in result.stdout for command in COMMANDS)
    assert spslam(cwd=tmp_path).stdout == result.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_help(tmp_path, command):
    result = spslam(command, "--help", cwd=tmp_path)
    assert result.returncode == 0
    assert f"usage: spslam {command}" in result.stdout


def test_help_lists_every_configuration(tmp_path):
    for arguments in (["--help"], ["run", "--help"], ["check-data", "--help"]):
        words = re.findall(r"\w+", spslam(*arguments, cwd=tmp_path).stdout)
        assert set(config_names()) <= set(words)


@pytest.mark.parametrize(
    ("arguments", "code"), [(["--help"], 0), (["run", "--help"], 0), (["run", "tum", "--data", "absent"], 2)]
)
def test_help_and_wrong_data_come_without_torch(arguments, code):
    """Loading torch takes seconds."""
    script = f"import sys, runpy; sys.argv = {['spslam', *arguments]}\n"
    script += "try: runpy.run_module('spslam', run_name='__main__')\n"
    script += "except SystemExit as end: print(end.code, 'torch' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert ended.stdout.splitlines()[-1] == f"{code} False"


def test_version(tmp_path):
    assert spslam("--version", cwd=tmp_path).stdout == f"spslam {package.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "invalid choice: 'fly'"),
        (["run"], "the following arguments are required: CONFIG|PATH; see spslam run --help"),
        (["run", "7scenes", "--sed", "3"], "unrecognized arguments: --sed 3"),
        (["run", "7scenes", "--seed", "x"], "--seed: invalid int value: 'x'"),
        (["run", "7scenes", "--preset", "best"], "--preset: invalid choice: 'best'"),
        (["run", "7scenes", "--frames", "5"], "--frames: must be START:STOP[:STEP] with STEP at least 1, got '5'"),
        (["run", "7scenes", "--frames", "9:5"], "--frames: must select at least one frame, got '9:5'"),
        (["run", "7scenes", "--frames", "0:9:0"], "with STEP at least 1, got '0:9:0'"),
        (["run", "7scenes", "--resume"], "--resume needs the interrupted run's folder as --output"),
        (["run", "demo", "--data", "."], "dataset.path (--data) is not used with dataset.type=generated; remove it or"),
        (["check-data", "demo", "--data", "."], "dataset.path (--data) is not used with dataset.type=generated"),
        (["run", "demo", "--set", "tracking.rescue=false"], "tracking.rescue is now called tracking.recovery"),
        (["demo", "--frames", "0"], "--frames: must be a whole number of at least 1, got '0'"),
        (["mesh", "x", "--resolution", "-1"], "--resolution: must be a length in meters above 0, got '-1'"),
        (["mesh", "x", "--format", "stl"], "--format: invalid choice: 'stl'"),
    ],
)
def test_a_wrong_command_line_is_a_one_line_error(tmp_path, arguments, message):
    assert_refused(spslam(*arguments, cwd=tmp_path), message)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:300", slice(0, 300)),
        ("10:", slice(10, None)),
        (":50", slice(None, 50)),
        (":", slice(None, None)),
        ("0:100:5", slice(0, 100, 5)),
        ("-50:", slice(-50, None)),
        ("0:-10:2", slice(0, -10, 2)),
    ],
)
def test_frames_are_parsed(text, expected):
    assert frame_range(text) == expected


@pytest.mark.parametrize("text", ["", "5", "a:b", "5:5", "9:5", "-5:-9", "0:9:0", "0:9:-1", "1:2:3:4", "-:3", "1.5:3"])
def test_wrong_frames_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="got '"):
        frame_range(text)


class Raising:
    """A command that fails."""

    def __init__(self, error):
        self.error = error

    def add_arguments(self, parser):
        pass

    def execute(self, args):
        raise self.error


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (DatasetError("a: b\n  c"), 2, "spslam: a: b c"),
        (OSError(28, "No space left on device", "/x/log.jsonl"), 2, "spslam: /x/log.jsonl: No space left on device"),
        (RuntimeError("odd"), 1, "spslam: unexpected RuntimeError: odd; --debug shows where"),
        (KeyboardInterrupt(), 130, "spslam: interrupted"),
        (KeyboardInterrupt("continue with x"), 130, "spslam: interrupted; continue with x"),
    ],
)
def test_every_error_is_one_line_with_an_exit_code(monkeypatch, capsys, error, code, line):
    monkeypatch.setattr(main_module, "_module", lambda command: Raising(error))
    assert main(["doctor"]) == code
    assert capsys.readouterr().err == line + "\n"


@pytest.mark.parametrize("arguments", [["--debug", "doctor"], ["doctor", "--debug"]])
def test_debug_prints_the_traceback(monkeypatch, capsys, arguments):
    monkeypatch.setattr(main_module, "_module", lambda command: Raising(RuntimeError("odd")))
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert "Traceback" in error
    assert error.splitlines()[-1].startswith("spslam: unexpected RuntimeError")


def test_command_lines_on_the_screen_name_the_command_as_it_was_called(tmp_path, monkeypatch):
    environment = tmp_path / "my project" / ".venv" / "bin"
    environment.mkdir(parents=True)
    program = environment / "spslam"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(program)])
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    assert command_name() == "'my project/.venv/bin/spslam'"
    monkeypatch.chdir(environment.parent.parent)
    assert command_name() == ".venv/bin/spslam"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert command_name() == f"'{program}'"
    monkeypatch.setenv("PATH", str(environment))
    assert command_name() == "spslam"
    monkeypatch.setattr(sys, "argv", ["/somewhere/spslam/__main__.py"])
    monkeypatch.setattr(sys, "executable", "/opt/env/bin/python")
    assert command_name() == "/opt/env/bin/python -m spslam"


def test_doctor_names_kernels_and_why_cuda_is_off(tmp_path):
    result = spslam("doctor", cwd=tmp_path)
    assert result.returncode == 0
    assert "working" in result.stdout
    assert "CUDA kernels" in result.stdout


def test_doctor_reads_the_architectures_of_a_library(tmp_path):
    library = tmp_path / "_ops_cuda.so"
    assert cuda_archs(library) == []
    library.write_bytes(b"\x7fELF\0spslam-cuda-archs=75-real 120 90-virtual\0\xff")
    assert cuda_archs(library) == ["sm_75", "sm_120", "PTX 120", "PTX 90"]
    library.write_bytes(b"\x7fELF")
    assert cuda_archs(library) == []


def test_reader_that_goes_away_is_no_error():
    shell = f"{sys.executable} -m spslam run --help | head -c 1"
    result = subprocess.run(["bash", "-c", shell], cwd=ROOT, capture_output=True, text=True)
    assert result.stderr == ""


def test_frames_from_the_end_and_empty_paths(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("spslam.cli.run.execute", lambda args: asked.append(args.frames))
    for words in (["--frames", "-5:"], ["--frames=-5:"], ["--frames", "-9:-2"]):
        assert spslam("run", "demo", *words, cwd=tmp_path).returncode == 0
    assert asked == [slice(-5, None), slice(-5, None), slice(-9, -2)]
    assert_refused(spslam("run", "tum", "--data", "", cwd=tmp_path), "--data must be a path, got the empty text")
    assert_refused(spslam("run", "demo", "--output", "", cwd=tmp_path), "--output must be a path, got the empty text")


def test_a_mistyped_path_is_no_configuration(tmp_path):
    assert_refused(spslam("run", "data/tum_fr", cwd=tmp_path), "data/tum_fr: no such configuration, file or folder")
