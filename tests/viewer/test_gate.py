"""Who is let in: by token where one is asked for, by the viewer's own address only, and not without limit."""

import http
import urllib.error
import urllib.request

import pytest

from spslam.viewer import gate as module
from spslam.viewer.gate import Gate
from spslam.viewer.options import Listener, ViewerOptions, listen
from tests.viewer.test_run_viewer import wait_for
from tests.viewer.worlds import connected, replay

pytest.importorskip("viser", reason="viser is not installed: pip install 'spslam[viewer]'")


@pytest.fixture
def gate():
    def make(host, token=None):
        bound = listen(ViewerOptions(port=0)).socket
        with bound:
            return Gate(Listener(bound, host, token))

    return make


def fetch(url, **headers):
    """Status, headers and body."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(urllib.request.Request(url, headers=headers), timeout=30) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read()


@pytest.mark.parametrize(
    "headers, status",
    [
        ({"Host": "127.0.0.1:8080"}, None),
        ({"Host": "localhost:9000", "Origin": "http://localhost:9000"}, None),
        ({"Host": "[::1]:8080"}, None),
        ({"Host": "evil.example"}, http.HTTPStatus.FORBIDDEN),
        ({"Host": "127.0.0.1:8080", "Origin": "http://evil.example"}, http.HTTPStatus.FORBIDDEN),
        ({"Host": "127.0.0.1:8080", "Origin": "null"}, http.HTTPStatus.FORBIDDEN),
        ({}, http.HTTPStatus.FORBIDDEN),
    ],
)
def test_loopback_answers_to_its_own_names_only(gate, headers, status):
    refused = gate("127.0.0.1").refusal("/", headers)
    assert (refused and refused[0]) == status


@pytest.mark.parametrize(
    "path, cookie, allowed",
    [
        ("/?token=right-token", "", True),
        ("/", "COOKIE=right-token", True),
        ("/", "a=b; COOKIE=right-token", True),
        ("/", "", False),
        ("/?token=wrong", "", False),
        ("/?token=", "", False),
        ("/?token=wrong", "COOKIE=wrong", False),
        ("/?token=%ff%fe", "COOKIE", False),
    ],
)
def test_token_is_asked_for(gate, path, cookie, allowed):
    made = gate("0.0.0.0", "right-token")
    headers = {"Host": "server:8080", **({"Cookie": cookie.replace("COOKIE", made._cookie)} if cookie else {})}
    refused = made.refusal(path, headers)
    assert (refused is None) == allowed
    assert allowed or refused[0] == http.HTTPStatus.UNAUTHORIZED


def test_page_and_socket_need_the_token():
    with replay(host="0.0.0.0") as opened:
        base, _, token = opened.url.partition("?token=")
        base = f"http://127.0.0.1:{base.rstrip('/').rsplit(':', 1)[1]}"
        assert fetch(base)[0] == fetch(f"{base}/?token=x{token}")[0] == 401
        status, headers, body = fetch(f"{base}/?token={token}")
        assert (status, b"<html" in body) == (200, True)
        cookie = headers["Set-Cookie"].split(";")[0]
        with pytest.raises(Exception, match="401"):
            connected(base)
        with connected(base, Cookie=cookie) as connection:
            assert len(connection.recv(timeout=30)) > 0


def test_page_may_load_nothing_from_elsewhere_and_no_files_of_the_server():
    with replay() as opened:
        headers = fetch(opened.url)[1]
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        assert fetch(opened.url + "../../pyproject.toml")[0] == 404
        assert fetch(opened.url, Host="evil.example")[0] == 403


def test_clients_have_a_limit(monkeypatch):
    monkeypatch.setattr(module, "MAX_CLIENTS", 2)
    with replay() as opened, connected(opened.url), connected(opened.url), pytest.raises(Exception, match="503"):
        connected(opened.url)


def test_mesh_and_images_are_made_for_a_page_that_is_open():
    with replay() as opened:
        assert not opened._sink.is_watched()
        with connected(opened.url) as connection:
            connection.recv(timeout=30)
            assert opened._sink.is_watched()
        wait_for(lambda: not opened._sink.is_watched())


def test_server_publishes_itself_for_nobody():
    """A client may ask viser for an address on the internet."""
    with replay() as opened:
        assert opened._sink.server.request_share_url() is None
