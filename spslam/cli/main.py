"""Entry point: picks the command, and turns every error into one line and an exit code."""

from __future__ import annotations

import argparse
import importlib
import os
import shlex
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import TextIO

from spslam.cli.parser import Parser, UsageError
from spslam.errors import SpslamError
from spslam.loading import collector_paused

EXIT_UNEXPECTED = 1
EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130

# Modules of this package with `HELP`, `add_arguments(parser)` and `execute(args)`, imported when they are asked for.
COMMANDS = {
    "run": "track and map an RGB-D sequence",
    "demo": "track and map a generated room with known ground truth; needs no data",
    "live": "track and map a camera as its frames come, or a recording played back at its own pace",
    "eval": "evaluate a finished run against ground truth",
    "view": "show a finished run in a browser",
    "merge": "join the maps of finished runs that share a place",
    "mesh": "make a mesh of a finished run: fuse its frames, or extract its map",
    "download": "download a public dataset",
    "import": "copy a recording of any format into a folder of images",
    "check-data": "check a dataset for problems before running on it",
    "bench": "run a benchmark suite and compare the results with the paper",
    "pretrain": "train the scene prior on procedurally generated solids",
    "doctor": "show which kernels, devices and versions are in use",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 for what the user can put right, 130 interrupted, 1 unexpected."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    # Streams that were closed, as by `2>&-`, are None: what is written to them goes nowhere.
    sys.stdout, sys.stderr = (stream or _nowhere() for stream in (sys.stdout, sys.stderr))
    return exit_code(lambda: _run(arguments), arguments)


def _nowhere() -> TextIO:
    return os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")


def exit_code(run: Callable[[], None], arguments: Sequence[str]) -> int:
    """The exit code of what `run` does, as of `main`; errors are printed in one line."""
    try:
        run()
        sys.stdout.flush()
    except KeyboardInterrupt as interrupt:
        return _fail("interrupted" + "".join(f"; {hint}" for hint in interrupt.args), EXIT_INTERRUPTED, arguments)
    except BrokenPipeError:
        # Whoever read our output has gone; a further write at exit would only complain again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_UNEXPECTED
    except SpslamError as error:
        return _fail(str(error), EXIT_USER_ERROR, arguments)
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        return _fail(f"{name}{error.strerror or error}", EXIT_USER_ERROR, arguments)
    except Exception as error:
        text = f"unexpected {type(error).__name__}: {error}; --debug shows where"
        return _fail(text, EXIT_UNEXPECTED, arguments)
    return 0


def _run(arguments: list[str]) -> None:
    command = next((argument for argument in arguments if not argument.startswith("-")), None)
    with collector_paused():
        parser = _build_parser(command)
    args = parser.parse_args(_joined(arguments))
    if args.command is None:
        parser.print_help()
        return
    args.command_line = shlex.join(["spslam", *arguments])
    _module(args.command).execute(args)


def _joined(arguments: list[str]) -> list[str]:
    """The arguments, with `--frames -5:` as one: argparse takes what begins with a minus for an option.

    Raises:
        UsageError: the empty text where a path is expected, as an unset shell variable leaves it.
    """
    joined: list[str] = []
    for argument in arguments:
        before = joined[-1] if joined else ""
        if before == "--frames" and argument.startswith("-") and ":" in argument:
            joined[-1] = f"{before}={argument}"
            continue
        if before in ("--data", "--output") and argument == "":
            raise UsageError(f"{before} must be a path, got the empty text (an unset variable of the shell?)")
        if argument == "":
            raise UsageError("an argument is the empty text (an unset variable of the shell?)")
        joined.append(argument)
    return joined


def _build_parser(command: str | None) -> Parser:
    """The parser; only the chosen command's module is imported, so that help comes at once."""
    from spslam import __version__
    from spslam.config import config_names

    parser = Parser(
        prog="spslam",
        description="Dense RGB-D SLAM: a trajectory and a colored mesh from RGB-D frames.",
        epilog=f"configurations: {', '.join(config_names())}; spslam COMMAND --help shows the options of a command",
    )
    parser.add_argument("--version", action="version", version=f"spslam {__version__}")
    _add_debug(parser)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name, text in COMMANDS.items():
        subparser = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        _add_debug(subparser)
        if name == command:
            _module(name).add_arguments(subparser)
    return parser


def _add_debug(parser: Parser) -> None:
    parser.add_argument(
        "--debug", action="store_true", default=argparse.SUPPRESS, help="show where an error comes from"
    )


def _module(command: str):
    name = {"import": "import_recording"}.get(command, command.replace("-", "_"))  # `import` is a keyword
    return importlib.import_module(f"spslam.cli.{name}")


def _fail(text: str, code: int, arguments: Sequence[str]) -> int:
    if "--debug" in arguments:
        traceback.print_exc()
    print(f"spslam: {' '.join(text.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
