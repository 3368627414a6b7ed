"""Ctrl-C at a moment that suits."""

import signal
import threading
from types import FrameType, TracebackType


class Interruption:
    """Notes the first Ctrl-C instead of raising it, so that a loop can end between two frames; a second one raises.

    Outside the main thread, or where the program has a handler of its own, nothing is changed.

    Attributes:
        noted: whether there was one.
    """

    def __init__(self) -> None:
        self.noted = False
        self._installed = False

    def __enter__(self) -> "Interruption":
        in_main_thread = threading.current_thread() is threading.main_thread()
        if in_main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._note)
            self._installed = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._installed:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.noted:
            raise KeyboardInterrupt
        self.noted = True
