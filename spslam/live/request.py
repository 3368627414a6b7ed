"""What a live run is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from spslam.config import Config

MAX_WAIT_S = 0.06


@dataclass(frozen=True)
class LiveRequest:
    """A live run over one source.

    Attributes:
        config: all options; of `dataset`, the depth range, `border_px` and a `mask` have an effect.
        output_dir: created if needed; it must be empty.
        record_dir: where the input is recorded in the `folder` layout; None records nothing.
        data_dir: folder of the data that is replayed; None for a camera.
        max_wait_s: a frame that has waited for longer is dropped if a newer one is there.
        seconds: end after so long; None ends with the source or with Ctrl-C.
        mesh: whether to extract the mesh at the end.
    """

    config: Config
    output_dir: Path
    record_dir: Path | None = None
    data_dir: Path | None = None
    max_wait_s: float = MAX_WAIT_S
    seconds: float | None = None
    mesh: bool = True
