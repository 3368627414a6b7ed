"""How a recording is cut into chunks, and what an output folder says of it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

from spslam.errors import OutputError
from spslam.io import atomic_write
from spslam.run_folder import RunFolder

OVERLAP = 60  # frames that two chunks share, 2 s at 30 Hz: several keyframes of both
CORES = 2  # of a chunk's run without GPU: it needs little less time with more


@dataclass(frozen=True)
class ChunkOptions:
    """How a recording is cut.

    Attributes:
        count: number of chunks, 2 at least.
        overlap: frames that neighbors share.
        device: of the chunks' runs, `cpu` or `cuda`; they are joined on the configuration's.
    """

    count: int
    overlap: int = OVERLAP
    device: str = "cpu"


@dataclass(frozen=True)
class ChunkPlan:
    """What the chunks in an output folder are of; while it is there, the run in chunks has not finished.

    Attributes:
        settings: fingerprint of the options.
        data: JSON object that identifies the frames.
        chunks: their number.
        overlap: frames that neighbors share.
    """

    settings: str
    data: dict[str, Any]
    chunks: int
    overlap: int

    @classmethod
    def read(cls, folder: RunFolder) -> ChunkPlan | None:
        """That of a folder; None where there is none.

        Raises:
            OutputError: the file is damaged.
        """
        if not folder.chunk_plan.is_file():
            return None
        try:
            plan = cls(**json.loads(folder.chunk_plan.read_text(encoding="utf-8")))
            if type(plan.chunks) is not int or type(plan.overlap) is not int:
                raise ValueError
        except (OSError, ValueError, TypeError):
            raise OutputError(f"{folder.chunk_plan}: is damaged; use another --output") from None
        return plan

    def write(self, folder: RunFolder) -> None:
        """Writes it."""
        atomic_write(folder.chunk_plan, json.dumps(asdict(self)) + "\n")

    def to_be_continued(self, folder: RunFolder) -> OutputError:
        """The error of a command that would not go on with these chunks; it names what does."""
        overlap = "" if self.overlap == OVERLAP else f" --overlap {self.overlap}"
        return OutputError(
            f"{folder.path}: contains an interrupted run in chunks; continue it with --chunks {self.chunks}{overlap} "
            "--resume, or use another --output"
        )
