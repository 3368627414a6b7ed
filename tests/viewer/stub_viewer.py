"""A process in place of the viewer's, which does what the environment says and keeps what it is sent."""

from __future__ import annotations

import os
import pickle
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from spslam.viewer.protocol import Message, Request, RunBegins, RunEnds, Update, receive


def serve(descriptor: int) -> None:
    """Receives until the run ends."""
    connection = Connection(descriptor)
    if _order("stalls"):
        time.sleep(600)
    asks, pauses = _order("asks", "1"), _order("pauses")
    with (Path(os.environ["STUB_FOLDER"]) / "messages.pickle").open("wb") as file:
        while True:
            message = receive(connection)
            pickle.dump(message, file)
            if isinstance(message, RunBegins) and _order("fails"):
                raise ValueError("of the stub")
            if isinstance(message, RunEnds):
                return
            if isinstance(message, Update) and pauses:
                pauses = False
                connection.send_bytes(Request(paused=True).encode())
                if _order("dies"):
                    time.sleep(0.3)
                    os.abort()
                for _ in range(2):
                    connection.send_bytes(Request(step=True).encode())
                time.sleep(1.0)
                connection.send_bytes(Request(paused=False).encode())
            if isinstance(message, (RunBegins, Update)) and asks:
                connection.send_bytes(Request(update=True, map=True).encode())


def received(folder: Path) -> list[Message]:
    """What a stub was sent."""
    messages: list[Any] = []
    with (folder / "messages.pickle").open("rb") as file:
        while True:
            try:
                messages.append(pickle.load(file))
            except EOFError:
                return messages


def _order(name: str, default: str = "0") -> bool:
    return os.environ.get(f"STUB_{name.upper()}", default) == "1"
