"""The time that a run takes, also over interruptions."""

import time
from dataclasses import asdict, dataclass


@dataclass
class RunClock:
    """Time and frames of a run so far. Checkpoints save it, and a resumed run continues it.

    Attributes:
        frames: frames read, including those skipped.
        wall_s: wall-clock time of the frame loop.
        decode_s: time spent on reading, decoding and sampling frames, summed over the reading threads.
        start_s: time before the frame loop, of the last start only.
    """

    frames: int = 0
    wall_s: float = 0.0
    decode_s: float = 0.0
    start_s: float = 0.0

    def __post_init__(self) -> None:
        self._earlier = self.frames, self.wall_s, self.decode_s
        self._loop_started = time.perf_counter()

    def start_loop(self) -> None:
        """Starts timing the frame loop; to be called once."""
        self._loop_started = time.perf_counter()

    def leave_out(self, seconds: float) -> None:
        """Leaves out time in which the loop waited for its user."""
        self._loop_started += seconds

    def update(self, frames: int, decode_s: float) -> None:
        """Sets the totals: those of earlier sessions plus this one's.

        Args:
            frames: frames read since `start_loop`.
            decode_s: time spent on reading them, in seconds.
        """
        earlier_frames, earlier_wall_s, earlier_decode_s = self._earlier
        self.frames = earlier_frames + frames
        self.wall_s = earlier_wall_s + time.perf_counter() - self._loop_started
        self.decode_s = earlier_decode_s + decode_s

    def to_dict(self) -> dict[str, float]:
        """The attributes, as a checkpoint saves them; `RunClock(**saved)` restores them."""
        return asdict(self)
