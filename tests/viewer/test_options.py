"""Where the viewer listens: loopback freely, elsewhere with a token; what is wrong is named."""

import importlib.util
import socket

import pytest

from spslam.viewer import options as module
from spslam.viewer.options import TOKEN_VARIABLE, ViewerError, ViewerOptions, is_loopback, listen
from spslam.viewer.run_viewer import open_viewer


def test_loopback_needs_no_token():
    listener = listen(ViewerOptions(port=0))
    with listener.socket:
        assert listener.url == f"http://127.0.0.1:{listener.port}/"
        assert listener.token is None


def test_other_addresses_get_a_token_of_their_own():
    first, second = listen(ViewerOptions(host="0.0.0.0", port=0)), listen(ViewerOptions(host="0.0.0.0", port=0))
    with first.socket, second.socket:
        assert first.token != second.token
        assert len(first.token) >= 20
        assert first.url == f"http://{socket.gethostname()}:{first.port}/?token={first.token}"


def test_taken_port_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ViewerError, match=rf"port {port} of 127.0.0.1: .* choose another with --port"):
            listen(ViewerOptions(port=port))


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_address_of_another_machine_is_named(host):
    with pytest.raises(ViewerError, match=host):
        listen(ViewerOptions(host=host, port=0))


def test_token_may_be_chosen_but_not_be_guessable(monkeypatch):
    monkeypatch.setenv(TOKEN_VARIABLE, "chosen-token-1")
    listener = listen(ViewerOptions(host="0.0.0.0", port=0))
    listener.socket.close()
    assert listener.token == "chosen-token-1"
    monkeypatch.setenv(TOKEN_VARIABLE, "short")
    with pytest.raises(ViewerError, match=TOKEN_VARIABLE):
        listen(ViewerOptions(host="0.0.0.0", port=0))


@pytest.mark.parametrize(
    "host, expected", [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False)]
)
def test_loopback_is_known(host, expected):
    assert is_loopback(host) is expected


@pytest.mark.parametrize("package, asked", [("viser", {}), ("rerun", {"browser": False, "recording": "x.rrd"})])
def test_missing_package_is_named_with_its_extra(monkeypatch, package, asked):
    find = importlib.util.find_spec
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None if name == package else find(name))
    with pytest.raises(ViewerError, match=rf"needs {package}, .*pip install 'spslam\[(viewer|rerun)\]'"):
        open_viewer(ViewerOptions(**asked))
