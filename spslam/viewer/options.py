"""Where a viewer listens, what it needs installed, and who may look."""

from __future__ import annotations

import importlib.util
import ipaddress
import os
import secrets
import socket
from dataclasses import dataclass
from pathlib import Path

from spslam.errors import SpslamError

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080
# A token of one's own choice, for scripts that must know it beforehand.
TOKEN_VARIABLE = "SPSLAM_VIEWER_TOKEN"
_TOKEN_BYTES = 16
# A token that can be guessed is none.
_MIN_TOKEN_CHARACTERS = 8


class ViewerError(SpslamError):
    """The viewer can't be opened: a port that is taken, an address of another machine, a package that is missing."""


@dataclass(frozen=True)
class ViewerOptions:
    """What to open.

    Attributes:
        browser: whether to serve the view in a browser.
        host: address to listen on; any but a loopback address asks its visitors for a token.
        port: port to listen on; 0 takes a free one.
        recording: file to record the run to, for rerun; None for none.
    """

    browser: bool = True
    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT
    recording: Path | None = None


@dataclass(frozen=True)
class Listener:
    """A socket that listens, and what its visitors need.

    Attributes:
        socket: bound and listening.
        host: the address as it was asked for.
        token: what visitors must show; None where everyone who reaches the socket may look.
    """

    socket: socket.socket
    host: str
    token: str | None

    @property
    def port(self) -> int:
        """Port that it listens on."""
        return self.socket.getsockname()[1]

    @property
    def url(self) -> str:
        """Address to open in a browser, with the token."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::", "") else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")


def listen(options: ViewerOptions) -> Listener:
    """Binds the viewer's port.

    Raises:
        ViewerError: the port is taken or not allowed, the address is not one of this machine's, or the token of the
            environment is too short.
    """
    try:
        found = socket.getaddrinfo(options.host, options.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        raise ViewerError(f"the viewer can't listen on {options.host}: {error.strerror or error}") from None
    family, kind, protocol, _, address = found[0]
    bound = socket.socket(family, kind, protocol)
    try:
        # Connections of a viewer that has just ended must not keep its port.
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen(socket.SOMAXCONN)
    except OSError as error:
        bound.close()
        raise ViewerError(
            f"the viewer can't listen on port {options.port} of {options.host}: {error.strerror or error}; "
            "choose another with --port (0 takes a free one)"
        ) from None
    try:
        return Listener(bound, options.host, None if is_loopback(options.host) else _token())
    except BaseException:
        bound.close()
        raise


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def require_viser() -> None:
    """Raises ViewerError where viser is not installed."""
    _require("viser", "the viewer", "viewer")


def require_rerun() -> None:
    """Raises ViewerError where rerun is not installed."""
    _require("rerun", "--rerun", "rerun")


def _require(module: str, what: str, extra: str) -> None:
    if importlib.util.find_spec(module) is None:
        raise ViewerError(f"{what} needs {module}, which is not installed: pip install 'spslam[{extra}]'")


def _token() -> str:
    chosen = os.environ.get(TOKEN_VARIABLE, "")
    if not chosen:
        return secrets.token_urlsafe(_TOKEN_BYTES)
    if len(chosen) < _MIN_TOKEN_CHARACTERS or not chosen.isascii() or not chosen.replace("-", "_").isidentifier():
        raise ViewerError(
            f"{TOKEN_VARIABLE} must be {_MIN_TOKEN_CHARACTERS} or more letters, digits, - or _, and begin with a letter"
        )
    return chosen
