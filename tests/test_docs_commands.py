"""Every command in a code block of the documentation has arguments and options that exist today; nothing is run."""

import argparse
import importlib
import importlib.util
import re
import shlex
import sys

import pytest

from experiments.settings import parse_job
from spslam.cli.arguments import overrides
from spslam.cli.main import main
from spslam.config import load_config
from spslam.errors import ConfigError
from tests.test_docs import CURRENT, ROOT, page_id

PROGRAM = re.compile(r"(spslam|python -m experiments\.\w+|python (?:examples|tools)/\w+\.py)(?= |$)")


def commands(page):
    """Commands of a page's shell blocks, without comments."""
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.join(shlex.split(line, comments=True)) for line in lines if PROGRAM.match(line)]


COMMANDS = [pytest.param(command, id=f"{page_id(page)}: {command}") for page in CURRENT for command in commands(page)]


# Recordings that pages name in place of a configuration: which one reads them is found out when they are there.
RECORDINGS = {"recording", "recording.bag"}


class ParsedArgumentsError(BaseException):
    """Ends a command once its arguments are parsed; no command catches it."""


def entry_point(monkeypatch, program):
    """The main function of a program, which parses `sys.argv`; a script finds the modules beside it."""
    if program == "spslam":
        return main
    if program.startswith("python -m "):
        return importlib.import_module(program.removeprefix("python -m ")).main
    path = ROOT / program.removeprefix("python ")
    monkeypatch.syspath_prepend(path.parent)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def parse(monkeypatch, command):
    """The arguments as the command's own parser reads them."""
    parse_args = argparse.ArgumentParser.parse_args

    def parse_and_stop(self, *arguments, **keywords):
        raise ParsedArgumentsError(parse_args(self, *arguments, **keywords))

    program = PROGRAM.match(command)[1]
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)
    monkeypatch.setattr(sys, "argv", [program, *shlex.split(command[len(program) :])])
    with pytest.raises(ParsedArgumentsError) as parsed:
        entry_point(monkeypatch, program)()
    return parsed.value.args[0]


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_accepted(monkeypatch, command):
    args = parse(monkeypatch, command)
    if getattr(args, "config", None) and args.config not in RECORDINGS:
        presets = getattr(args, "preset", None)
        for preset in presets if isinstance(presets, list) else [presets]:
            load_config(args.config, preset, [*overrides(args), *getattr(args, "set", [])])
    for sequence in getattr(args, "sequence", None) or []:
        for setting in args.setting:
            parse_job(sequence, setting, 0).load_config(args.threads)


def test_a_refused_command_is_noticed(monkeypatch):
    command = "python -m experiments.settings --sequence room=demo::0:9 --setting balanced,mapping.pose_rate=1e-3"
    with pytest.raises(ConfigError, match="mapping.pose_rate is not used with mapping.optimize_poses=false"):
        test_commands_are_accepted(monkeypatch, command)
