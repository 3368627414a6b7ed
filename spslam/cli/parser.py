"""A command-line parser whose errors are one line, like all others."""

from __future__ import annotations

import argparse
from typing import NoReturn

from spslam.errors import SpslamError


class UsageError(SpslamError):
    """A wrong command line."""


class Parser(argparse.ArgumentParser):
    """Raises UsageError instead of printing its usage and exiting."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message.removeprefix('argument ')}; see {self.prog} --help")
