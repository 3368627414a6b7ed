"""Entry point: picks the command, and turns every error into one line and an exit code."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import traceback
from collections.abc import Sequence

from spslam.cli.parser import Parser
from spslam.errors import SpslamError

EXIT_UNEXPECTED = 1
EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130

# Modules of this package with `HELP`, `add_arguments(parser)` and `execute(args)`, imported when they are asked for.
COMMANDS = {
    "run": "track and map an RGB-D sequence",
    "demo": "track and map a generated room with known truth; needs no data",
    "eval": "compare a run's trajectory and mesh with the truth",
    "mesh": "extract a mesh from a run's map",
    "download": "fetch a public data set from its official address",
    "check-data": "look through a data set before running on it",
    "bench": "run a suite of sequences and compare with the paper's figures",
    "pretrain": "train the scene prior on procedural solids",
    "doctor": "say which kernels, device and versions are in use",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 for what the user can put right, 130 interrupted, 1 unexpected."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        _run(arguments)
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
    parser = _build_parser(command)
    args = parser.parse_args(arguments)
    if args.command is None:
        parser.print_help()
        return
    _module(args.command).execute(args)


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
    return importlib.import_module(f"spslam.cli.{command.replace('-', '_')}")


def _fail(text: str, code: int, arguments: Sequence[str]) -> int:
    if "--debug" in arguments:
        traceback.print_exc()
    print(f"spslam: {' '.join(text.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
