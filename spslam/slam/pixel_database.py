"""Pixels of all processed frames, within a memory budget (section III.D)."""

import mmap

import numpy as np
import torch

from spslam.errors import SpslamError
from spslam.slam.row_copies import RowCopies, write_rows

RECORD_BYTES = 12
RECORD_WORDS = 3
MIN_PIXELS_PER_FRAME = 64
_FIRST_CAPACITY = 16  # frames
_FRAMES_AT_ONCE = 64  # moved while thinning


class PixelDatabase:
    """Packed pixel records [F, P, 3] of all frames.

    When the budget is reached, every frame's pixels are thinned to the same smaller number: as records lie in random
    order, keeping a prefix keeps an even sample. So memory does not grow past the budget, while frames do.

    On the CPU addresses for the budget are reserved at once, and memory comes as records are written: adding
    a frame never moves the others, for which a live camera would not wait. Thinning moves them within that memory, and
    gives back what is left of it.

    Attributes:
        pixels_per_frame: P, what each frame holds now.
        num_frames: F.
    """

    def __init__(
        self,
        pixels_per_frame: int,
        budget_mb: float,
        device: torch.device | str = "cpu",
        keyframe_every: int = 1,
        bytes_beside: int = 0,
    ):
        """An empty database.

        Args:
            pixels_per_frame: records per frame, to start with.
            budget_mb: maximum memory, MB.
            device: where the records are.
            keyframe_every: frames whose number is not a multiple of this are dropped when the next one is added, as in
                keyframe-based systems; 1 keeps all.
            bytes_beside: what is kept of every frame elsewhere, but counts within the budget.
        """
        self.pixels_per_frame = pixels_per_frame
        self.keyframe_every = keyframe_every
        self.budget_bytes = int(budget_mb * 2**20)
        self.num_frames = 0
        self._bytes_beside = bytes_beside
        if self.budget_bytes < self._bytes_of(1, pixels_per_frame):
            raise SpslamError(
                f"pixels.budget_mb must hold at least one frame of {pixels_per_frame} pixels "
                f"({self._bytes_of(1, pixels_per_frame) / 2**20:.2f} MB), got {budget_mb}"
            )
        self._memory: mmap.mmap | None = None  # that the words are in, where addresses for all of them are reserved
        self._words = torch.zeros(0, dtype=torch.int32, device=device)
        self._has_pixels = np.zeros(0, bool)  # each frame writes to it, which an array of NumPy's does at once

    @property
    def records(self) -> torch.Tensor:
        """int32 [F, P, 3]."""
        return self._words[: self.num_frames * self._words_per_frame].view(-1, self.pixels_per_frame, RECORD_WORDS)

    @property
    def has_pixels(self) -> torch.Tensor:
        """bool [F] on the CPU: whether the frame had valid depth, and is still kept."""
        return torch.from_numpy(self.pixel_flags)

    @property
    def pixel_flags(self) -> np.ndarray:
        """bool [F], `has_pixels` for NumPy: the same memory."""
        return self._has_pixels[: self.num_frames]

    @property
    def nbytes(self) -> int:
        """Bytes of all records."""
        return 4 * self.num_frames * self._words_per_frame

    @property
    def _words_per_frame(self) -> int:
        return self.pixels_per_frame * RECORD_WORDS

    def _bytes_of(self, frames: int, pixels: int) -> int:
        """What so many frames of so many pixels take of the budget."""
        return frames * (pixels * RECORD_BYTES + self._bytes_beside)

    def make_room(self) -> None:
        """Makes room for a frame, so that `add` can't fail.

        Raises:
            SpslamError: the budget holds no further frame.
        """
        self._reserve(self.num_frames + 1)

    def add(self, records: torch.Tensor, copies: RowCopies | None = None) -> None:
        """Appends a frame.

        Args:
            records: int32 [N, 3] in random order; N = 0 marks a frame without depth. Other N than P are cut or
                repeated. On the database's device this waits for nothing.
            copies: the records are written when these are made; None writes them now.
        """
        self.make_room()
        newest = self.num_frames - 1
        if newest > 0 and newest % self.keyframe_every:
            self._has_pixels[newest] = False
        count, given = self.pixels_per_frame, records.shape[0]
        self.num_frames += 1
        if given:
            repeated = records.repeat(-(-count // given), 1) if given < count else records
            kept = repeated if given == count else repeated[:count]
            kept = kept.to(self._words.device, non_blocking=True)
            write_rows(copies, [self.records], [self.num_frames - 1], [kept])
        else:
            self.records[-1].zero_()
        self._has_pixels[self.num_frames - 1] = given > 0

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The content, on the CPU; views where it is there already."""
        return {"records": self.records.cpu(), "has_pixels": self.has_pixels}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by that of `state_dict()`."""
        records = state["records"]
        self.num_frames, self.pixels_per_frame = records.shape[0], records.shape[1]
        self._words, self._memory = records.to(self._words.device, copy=True).view(-1), None
        self._has_pixels = state["has_pixels"].numpy().copy()

    def _reserve(self, frames: int) -> None:
        """Makes room for so many frames, thinning all of them if the budget requires it."""
        if frames > len(self._has_pixels):
            flags = np.zeros(max(frames, _FIRST_CAPACITY, 2 * len(self._has_pixels)), bool)
            flags[: self.num_frames] = self._has_pixels[: self.num_frames]
            self._has_pixels = flags
        pixels = self._affordable_pixels(frames)
        if pixels == self.pixels_per_frame and frames * self._words_per_frame <= self._words.numel():
            return
        if pixels < self.pixels_per_frame and self._memory is not None:
            self._thin_in_place(pixels, self._memory)
        else:
            self._move(frames, pixels)

    def _affordable_pixels(self, frames: int) -> int:
        """P halved until the budget holds so many frames; raises SpslamError where it can't."""
        pixels = self.pixels_per_frame
        while self._bytes_of(frames, pixels) > self.budget_bytes:
            if pixels // 2 < MIN_PIXELS_PER_FRAME:
                raise SpslamError(
                    f"pixels.budget_mb of {self.budget_bytes / 2**20:.0f} cannot hold {frames} frames of "
                    f"{MIN_PIXELS_PER_FRAME} pixels; raise it"
                )
            pixels //= 2
        return pixels

    def _thin_in_place(self, pixels: int, memory: mmap.mmap) -> None:
        end = 0
        for first in range(0, self.num_frames, _FRAMES_AT_ONCE):
            kept = self.records[first : first + _FRAMES_AT_ONCE, :pixels].reshape(-1)
            begin = first * pixels * RECORD_WORDS
            end = begin + len(kept)
            self._words[begin:end] = kept.clone()
        self.pixels_per_frame = pixels
        unused = -(-4 * end // mmap.PAGESIZE) * mmap.PAGESIZE
        if unused < len(memory):
            memory.madvise(mmap.MADV_DONTNEED, unused, len(memory) - unused)

    def _move(self, frames: int, pixels: int) -> None:
        """Brings the first `pixels` records of every frame to a larger buffer."""
        kept, self.pixels_per_frame = self.records[:, :pixels], pixels
        self._memory = self._reserved_budget() if self._words.device.type == "cpu" else None
        if self._memory is not None:
            grown = torch.frombuffer(self._memory, dtype=torch.int32)
        else:
            affordable = self.budget_bytes // self._bytes_of(1, pixels)
            capacity = min(max(frames, _FIRST_CAPACITY, 2 * self.num_frames), affordable)
            grown = torch.zeros(capacity * self._words_per_frame, dtype=torch.int32, device=self._words.device)
        grown[: kept.numel()].view(kept.shape).copy_(kept)
        self._words = grown

    def _reserved_budget(self) -> mmap.mmap | None:
        """Zeros that take memory only where they are written; None where the system refuses so many.

        Not on a GPU, where a snapshot may share the buffer.
        """
        private = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
        try:
            return mmap.mmap(-1, self.budget_bytes // 4 * 4, flags=private)
        except (OSError, OverflowError):
            return None
