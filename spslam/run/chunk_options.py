"""How a recording is cut into chunks; loads nothing else."""

from dataclasses import dataclass

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

    def arguments(self) -> str:
        """The command line's for the same cut."""
        return f"--chunks {self.count}" + ("" if self.overlap == OVERLAP else f" --overlap {self.overlap}")
