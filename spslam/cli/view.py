"""`spslam view`: shows a finished run in a browser, with a slider over its frames."""

from __future__ import annotations

import argparse

from spslam.cli.arguments import add_run_folder, require_run_file
from spslam.cli.viewing import add_address, announce
from spslam.run_folder import RunFolder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_folder(parser)
    add_address(parser)


def execute(args: argparse.Namespace) -> None:
    require_run_file(RunFolder(args.output).trajectory)

    from spslam.viewer.options import DEFAULT_HOST, DEFAULT_PORT, ViewerOptions
    from spslam.viewer.replay import open_replay

    port = DEFAULT_PORT if args.port is None else args.port
    with open_replay(args.output, ViewerOptions(True, args.host or DEFAULT_HOST, port)) as replay:
        announce(replay.url, replay.has_token)
        replay.wait()
