"""Messages between processes: arrays of any size and layout arrive as they were sent."""

from multiprocessing import Pipe
from threading import Thread

import numpy as np
import pytest

from spslam.array_messages import receive_message, send_message


def sent(message):
    """What the other end receives."""
    one, other = Pipe()
    with one, other:
        sender = Thread(target=send_message, args=(one, message))
        sender.start()
        received = receive_message(other)
        sender.join()
    return received


@pytest.mark.parametrize(
    "array",
    [
        np.arange(3_000_000, dtype=np.uint16),
        np.zeros((0, 3)),
        np.arange(24.0).reshape(4, 6)[::2, ::3],
        np.asfortranarray(np.arange(24).reshape(4, 6)),
        np.array(2.5),
    ],
    ids=["large", "empty", "strided", "column-major", "number"],
)
def test_arrays_arrive_as_they_were_sent_and_can_be_written_to(array):
    received = sent({"array": array, "text": "rest"})
    assert received["text"] == "rest" and received["array"].dtype == array.dtype
    assert np.array_equal(received["array"], array)
    received["array"][...] = 1


def test_message_without_arrays():
    assert sent((1, "two", None)) == (1, "two", None)


def test_closed_connection_is_reported():
    one, other = Pipe()
    one.close()
    with other, pytest.raises(EOFError):
        receive_message(other)
    with pytest.raises(OSError):
        send_message(one, "anything")
