"""A test web server: files from memory, range requests, and simulated network failures."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Site:
    """What the server provides and how it behaves.

    Attributes:
        files: content by path.
        cuts: bytes of the body that each of the next responses sends before the connection is closed.
        faults: HTTP status codes of the next responses.
        ranges: whether range requests are supported.
        etag: of all files; None sends none.
        requested: start of the range of each request in order; None for the whole file.
        base_url: of the running server.
    """

    files: dict[str, bytes]
    cuts: list[int] = field(default_factory=list)
    faults: list[int] = field(default_factory=list)
    ranges: bool = True
    etag: str | None = '"1"'
    requested: list[int | None] = field(default_factory=list)
    base_url: str = ""

    def url(self, name: str) -> str:
        return f"{self.base_url}/{name}"


@contextlib.contextmanager
def serve(site: Site) -> Iterator[Site]:
    """Serves a site on a free local port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):  # noqa: N802 (the base class calls it so)
            respond(self, site)

        def log_message(self, *arguments):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    site.base_url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield site
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def respond(request: BaseHTTPRequestHandler, site: Site) -> None:
    content = site.files.get(request.path.lstrip("/"))
    wanted = re.fullmatch(r"bytes=(\d+)-", request.headers.get("Range", ""))
    start = int(wanted.group(1)) if wanted else None
    site.requested.append(start)
    if site.faults or content is None:
        request.send_error(site.faults.pop(0) if site.faults else 404)
        return
    partial = start is not None and site.ranges and request.headers.get("If-Range") == site.etag
    body = content[start:] if partial else content
    request.send_response(206 if partial else 200)
    request.send_header("Content-Length", str(len(body)))
    if partial:
        request.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
    if site.etag is not None:
        request.send_header("ETag", site.etag)
    request.end_headers()
    request.wfile.write(body[: site.cuts.pop(0)] if site.cuts else body)
