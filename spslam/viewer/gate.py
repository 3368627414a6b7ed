"""Who may connect to the viewer's server: checked before viser sees a request.

viser serves everyone who reaches its port, and takes the next port where one is taken. Here it is given a socket that
listens already, and every request passes `Gate` first: the token, where one is asked for; the address that the browser
believes to be talking to, so that a page of another site can reach the server neither by a name that leads to this
machine nor by a web socket; and the number of clients.
"""

from __future__ import annotations

import contextlib
import hmac
import http
import io
import logging
from collections.abc import Awaitable, Callable
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from spslam.viewer.options import Listener, ViewerError, is_loopback

MAX_CLIENTS = 16
_OPEN_TIMEOUT_S = 5.0
# What a browser sends: camera poses and clicks, and screenshots.
_MAX_MESSAGE_BYTES = 32 << 20
_REFUSED = "This viewer needs the address with the token that the command printed.\n"
_FULL = "The viewer has as many clients as it takes; close one.\n"
_FOREIGN = "The viewer answers to its own address only.\n"
# Of viser's messages: a control has another value, and parts of a file, for which the page has no control.
_CONTROL, _UPLOADS = "GuiUpdateMessage", ("FileTransferStartUpload", "FileTransferPart")
# The page is one file. What it may load is itself, and what it has made of itself.
_POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self' ws: wss: data: blob:; frame-ancestors 'self'"
)


class Gate:
    """Decides on each HTTP request, those that become web sockets among them.

    Args:
        listener: whose visitors are checked.
    """

    def __init__(self, listener: Listener):
        self._token, self._is_local = listener.token, is_loopback(listener.host)
        self._cookie = f"spslam-viewer-{listener.port}"
        self._clients: set[Any] = set()

    def refusal(self, path: str, headers: Any) -> tuple[http.HTTPStatus, str] | None:
        """Why a request is refused; None where it is not.

        Args:
            path: with the query.
            headers: of the request; a mapping with `get`.
        """
        host, origin = _one(headers, "Host"), _one(headers, "Origin")
        if self._is_local and not _is_local_name(host):
            return http.HTTPStatus.FORBIDDEN, _FOREIGN
        if origin and urlsplit(origin).netloc.lower() != host.lower():
            return http.HTTPStatus.FORBIDDEN, _FOREIGN
        if self._token is not None and not self._knows_token(path, headers):
            return http.HTTPStatus.UNAUTHORIZED, _REFUSED
        return None

    def has_clients(self) -> bool:
        """Whether a web socket is open: a page, unless something else asked for it."""
        return any(not _has_ended(client) for client in tuple(self._clients))

    def wrap(self, answer: Callable[[Any, Any], Any] | None) -> Callable[[Any, Any], Any]:
        """`process_request` of websockets: refuses, or leaves the answer to viser's own."""

        def process_request(connection: Any, request: Any) -> Any:
            try:
                refused = self.refusal(request.path, request.headers)
            except ValueError:  # an address or a query that can't be parsed
                refused = http.HTTPStatus.BAD_REQUEST, "The request can't be read.\n"
            if refused is None and request.headers.get("Upgrade", "").lower() == "websocket":
                self._clients = {client for client in self._clients if not _has_ended(client)}
                if len(self._clients) < MAX_CLIENTS:
                    self._clients.add(connection)
                    return answer(connection, request) if answer else None
                refused = http.HTTPStatus.SERVICE_UNAVAILABLE, _FULL
            if refused is not None:
                return connection.respond(*refused)
            response = answer(connection, request) if answer else None
            if response is not None:
                self._mark(response)
            return response

        return process_request

    def _knows_token(self, path: str, headers: Any) -> bool:
        given = parse_qs(urlsplit(path).query).get("token", [])
        try:
            cookie = SimpleCookie(_one(headers, "Cookie")).get(self._cookie)
        except CookieError:
            cookie = None
        shown = [*given, *([cookie.value] if cookie else [])]
        return any(hmac.compare_digest(token.encode(), str(self._token).encode()) for token in shown)

    def _mark(self, response: Any) -> None:
        """Adds the policy, and the cookie by which the page's web socket is known."""
        response.headers["Content-Security-Policy"] = _POLICY
        response.headers["Referrer-Policy"] = "no-referrer"
        if self._token is not None:
            response.headers["Set-Cookie"] = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"


def open_server(listener: Listener, label: str) -> tuple[Any, Gate]:
    """A `viser.ViserServer` on a socket, and the `Gate` before it; reaches out to no other machine.

    Args:
        listener: the socket; the server closes it.
        label: title of the panel.

    Raises:
        ViewerError: this version of viser opens its server in another way.
    """
    import viser
    import websockets.asyncio.server as server_module

    for name in ("websockets", "asyncio", "viser"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # else each line of garbage is a line of the log
    gate, original, opened = Gate(listener), server_module.serve, []

    def serve(handler: Any, host: Any = None, port: Any = None, *, process_request: Any = None, **options: Any) -> Any:
        opened.append(True)
        options |= {"max_size": _MAX_MESSAGE_BYTES, "open_timeout": _OPEN_TIMEOUT_S, "server_header": None}
        return original(sifted(handler), sock=listener.socket, process_request=gate.wrap(process_request), **options)

    server_module.serve = serve  # type: ignore
    try:
        with silence():
            server = viser.ViserServer(host=listener.host, port=listener.port, label=label, verbose=False)
    finally:
        server_module.serve = original  # type: ignore
    if not opened:
        server.stop()
        raise ViewerError(
            f"viser {viser.__version__} can't be used; pip install 'spslam[viewer]' installs one that can"
        )
    # Any client may ask viser to publish the server through one on the internet.
    server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]
    return server, gate


def sifted(handler: Callable[[Any], Awaitable[None]]) -> Callable[[Any], Awaitable[None]]:
    """A web socket's handler that is given what the page sends; other messages that viser knows are left out.

    viser sets whatever attribute of a control a message names, such as that it is removed, after which every update of
    the page fails; and it keeps files that nothing asks for in memory.
    """

    async def handle(connection: Any) -> None:
        receive = connection.recv

        async def recv(*arguments: Any, **options: Any) -> Any:
            while not _is_of_the_page(content := await receive(*arguments, **options)):
                pass
            return content

        connection.recv = recv
        await handler(connection)

    return handle


def _is_of_the_page(content: bytes | str) -> bool:
    """Whether the page may have sent a message, or viser closes the connection for it."""
    import msgspec  # viser's own

    try:
        message = msgspec.msgpack.decode(content) if isinstance(content, bytes) else None
    except (msgspec.DecodeError, UnicodeDecodeError):
        return True
    if not isinstance(message, dict) or message.get("type") != _CONTROL:
        return not (isinstance(message, dict) and message.get("type") in _UPLOADS)
    updates = message.get("updates")
    return isinstance(updates, dict) and all(
        name == "value" and isinstance(value, (bool, int, float)) for name, value in updates.items()
    )


def silence() -> contextlib.AbstractContextManager:
    """Leaves out what viser prints about its server."""
    return contextlib.redirect_stdout(io.StringIO())


def _one(headers: Any, name: str) -> str:
    """A header that a request has once at most; ValueError where it is repeated."""
    values = headers.get_all(name) if hasattr(headers, "get_all") else [headers[name]] if name in headers else []
    if len(values) > 1:
        raise ValueError(f"{name} must be given once")
    return values[0] if values else ""


def _is_local_name(host: str) -> bool:
    name = urlsplit(f"//{host}").hostname or ""
    return is_loopback(name) or name.endswith(".localhost")


def _has_ended(connection: Any) -> bool:
    return getattr(connection, "state", 0) == 3  # websockets.protocol.State.CLOSED
