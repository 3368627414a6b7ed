"""The command line: help, version, wrong arguments, and the output of errors."""

import argparse
import subprocess
import sys

import pytest

import spslam as package
from spslam.cli import main as main_module
from spslam.cli.arguments import parse_frames
from spslam.cli.doctor import cuda_archs
from spslam.cli.main import COMMANDS, main
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


def test_help_comes_without_torch():
    code = "import sys; from spslam.cli.main import main; main([]); print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.stdout.splitlines()[-1] == "False"


def test_version(tmp_path):
    assert spslam("--version", cwd=tmp_path).stdout == f"spslam {package.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "invalid choice: 'fly'"),
        (["run"], "the following arguments are required: CONFIG; see spslam run --help"),
        (["run", "7scenes", "--sed", "3"], "unrecognized arguments: --sed 3"),
        (["run", "7scenes", "--seed", "x"], "--seed: invalid int value: 'x'"),
        (["run", "7scenes", "--preset", "best"], "--preset: invalid choice: 'best'"),
        (["run", "7scenes", "--frames", "5"], "--frames: must be START:STOP[:STEP] with STEP at least 1, got '5'"),
        (["run", "7scenes", "--frames", "9:5"], "--frames: must select at least one frame, got '9:5'"),
        (["run", "7scenes", "--frames", "0:9:0"], "with STEP at least 1, got '0:9:0'"),
        (["run", "7scenes", "--resume"], "--resume needs the interrupted run's folder as --output"),
        (["run", "demo", "--data", "."], "--data has no meaning here"),
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
    assert parse_frames(text) == expected


@pytest.mark.parametrize("text", ["", "5", "a:b", "5:5", "9:5", "-5:-9", "0:9:0", "0:9:-1", "1:2:3:4", "-:3", "1.5:3"])
def test_wrong_frames_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="got '"):
        parse_frames(text)


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
        (KeyboardInterrupt("go on with x"), 130, "spslam: interrupted; go on with x"),
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
    shell = f"{sys.executable} -m spslam.cli.main run --help | head -c 1"
    result = subprocess.run(["bash", "-c", shell], cwd=ROOT, capture_output=True, text=True)
    assert result.stderr == ""
