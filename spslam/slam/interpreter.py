"""How long one thread may keep others from Python's interpreter."""

import contextlib
import sys
from collections.abc import Iterator

# s, for which a thread may hold the interpreter while another waits for it. Python's own 5 ms are as long as a frame on
# a GPU: tracking would wait for them when it comes back from a kernel while the keyframe graph's thread runs.
INTERPRETER_SHARE_S = 2e-5
_HALF_A_STEP_S = 5e-7  # Python cuts intervals to whole microseconds; what it says of one may be less than that


@contextlib.contextmanager
def interpreter_shared() -> Iterator[None]:
    """Has threads hand the interpreter to one another early, so that none keeps a frame waiting; also a decorator."""
    interval_s = sys.getswitchinterval()
    if interval_s <= INTERPRETER_SHARE_S:
        yield
        return
    sys.setswitchinterval(INTERPRETER_SHARE_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s + _HALF_A_STEP_S)
