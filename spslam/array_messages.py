"""Messages between processes whose arrays go beside the pickle: no copy of them holds up Python's interpreter.

A pickle is made, and read, in one go, while no other thread can do anything.
"""

from __future__ import annotations

import pickle
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

_WITH_BUFFERS = 5  # protocol from which arrays may go beside the pickle


def send_message(connection: Connection, message: object) -> None:
    """Sends anything that can be pickled; another process's `receive_message` returns it.

    Raises:
        ConnectionError: the other end is closed.
    """
    buffers: list[pickle.PickleBuffer] = []
    content = pickle.dumps(message, _WITH_BUFFERS, buffer_callback=buffers.append)
    parts = [buffer.raw() for buffer in buffers]
    connection.send_bytes(np.array([len(part) for part in parts], np.int64).tobytes())
    connection.send_bytes(content)
    for part in parts:
        connection.send_bytes(part)


def receive_message(connection: Connection) -> Any:
    """Waits for a message; its arrays can be written to.

    Raises:
        EOFError, ConnectionError: the other end is closed.
    """
    sizes = np.frombuffer(connection.recv_bytes(), np.int64)
    content = connection.recv_bytes()
    buffers = [np.empty(size, np.uint8) for size in sizes]
    for buffer in buffers:
        connection.recv_bytes_into(buffer)
    return pickle.loads(content, buffers=buffers)
