"""Loading modules without the garbage collector."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def collector_paused() -> Iterator[None]:
    """Switches Python's garbage collector off while modules are loaded, and keeps what they made from it for good.

    Modules make hundreds of thousands of objects, torch's above all, that stay until the end. A collector that finds
    more and more of them goes through all of them again and again: that is a fifth of the time that loading takes. Only
    for a process of our own: in a program that uses the library, it is the program's to decide.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.freeze()
            gc.enable()
