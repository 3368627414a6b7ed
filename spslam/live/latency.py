"""How long frames took from complete images to a known pose."""

from __future__ import annotations

from array import array

import numpy as np

RECENT = 300  # frames that the progress display tells of


class Latencies:
    """Latencies of all frames of a run, 4 bytes each."""

    def __init__(self) -> None:
        self._ms = array("f")

    def add(self, ms: float) -> None:
        """Adds a frame's."""
        self._ms.append(ms)

    def figures(self) -> dict[str, float]:
        """Median, 99th percentile and maximum, as metrics.json has them; empty without frames."""
        if not self._ms:
            return {}
        median, high, most = np.percentile(np.array(self._ms), [50, 99, 100])
        return {"latency_p50_ms": float(median), "latency_p99_ms": float(high), "latency_max_ms": float(most)}

    def last(self) -> float:
        """The last frame's, ms; NaN without frames."""
        return self._ms[-1] if self._ms else float("nan")

    def recent_p99(self) -> float:
        """The 99th percentile of the last `RECENT` frames, ms; NaN without frames."""
        return float(np.percentile(np.array(self._ms[-RECENT:]), 99)) if self._ms else float("nan")

    def __len__(self) -> int:
        return len(self._ms)
