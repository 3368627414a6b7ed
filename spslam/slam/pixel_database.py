"""Pixels of all processed frames, within a memory budget (section III.D)."""

import torch

from spslam.errors import SpslamError

RECORD_BYTES = 12
MIN_PIXELS_PER_FRAME = 64


class PixelDatabase:
    """Packed pixel records [F, P, 3] of all frames.

    When the budget is reached, every frame's pixels are thinned to the same smaller number: as records lie in random
    order, keeping a prefix keeps an even sample. So memory does not grow past the budget, while frames do.

    Attributes:
        pixels_per_frame: P, what each frame holds now.
        num_frames: F.
    """

    def __init__(
        self, pixels_per_frame: int, budget_mb: float, device: torch.device | str = "cpu", keyframe_every: int = 1
    ):
        """An empty database.

        Args:
            pixels_per_frame: records per frame, to start with.
            budget_mb: maximum memory, MB.
            device: where the records are.
            keyframe_every: frames whose number is not a multiple of this are dropped when the next one is added, as in
                keyframe-based systems; 1 keeps all.
        """
        self.pixels_per_frame = pixels_per_frame
        self.keyframe_every = keyframe_every
        self.budget_bytes = int(budget_mb * 2**20)
        self.num_frames = 0
        if self.budget_bytes < pixels_per_frame * RECORD_BYTES:
            raise SpslamError(
                f"pixels.budget_mb must hold at least one frame of {pixels_per_frame} pixels "
                f"({pixels_per_frame * RECORD_BYTES / 2**20:.2f} MB), got {budget_mb}"
            )
        self._storage = torch.zeros(0, pixels_per_frame, 3, dtype=torch.int32, device=device)
        self._has_pixels = torch.zeros(0, dtype=torch.bool)

    @property
    def records(self) -> torch.Tensor:
        """int32 [F, P, 3]."""
        return self._storage[: self.num_frames]

    @property
    def has_pixels(self) -> torch.Tensor:
        """bool [F] on the CPU: whether the frame had valid depth, and is still kept."""
        return self._has_pixels[: self.num_frames]

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self._storage.numel() * 4

    def add(self, records: torch.Tensor) -> None:
        """Appends a frame.

        Args:
            records: int32 [N, 3] in random order; N = 0 marks a frame without depth. Other N than P are cut or
                repeated. On the database's device this waits for nothing.
        """
        self._reserve(self.num_frames + 1)
        newest = self.num_frames - 1
        if newest > 0 and newest % self.keyframe_every:
            self._has_pixels[newest] = False
        count = self.pixels_per_frame
        if len(records):
            repeated = records.repeat(-(-count // len(records)), 1) if len(records) < count else records
            self._storage[self.num_frames].copy_(repeated[:count], non_blocking=True)
        self._has_pixels[self.num_frames] = len(records) > 0
        self.num_frames += 1

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The content, on the CPU; views where it is there already."""
        return {"records": self.records.cpu(), "has_pixels": self.has_pixels}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by that of `state_dict()`."""
        records = state["records"]
        self.num_frames, self.pixels_per_frame = records.shape[0], records.shape[1]
        self._storage = records.to(self._storage.device, copy=True)
        self._has_pixels = state["has_pixels"].clone()

    def _reserve(self, frames: int) -> None:
        if frames <= len(self._storage):
            return
        capacity = max(frames, 16, 2 * len(self._storage))
        while capacity * self.pixels_per_frame * RECORD_BYTES > self.budget_bytes:
            affordable = self.budget_bytes // (self.pixels_per_frame * RECORD_BYTES)
            if affordable >= frames:  # the budget holds what is needed, only not the spare capacity
                capacity = affordable
                break
            if self.pixels_per_frame // 2 < MIN_PIXELS_PER_FRAME:
                raise SpslamError(
                    f"pixels.budget_mb of {self.budget_bytes / 2**20:.0f} cannot hold {frames} frames of "
                    f"{MIN_PIXELS_PER_FRAME} pixels; raise it"
                )
            self.pixels_per_frame //= 2
        grown = torch.zeros(capacity, self.pixels_per_frame, 3, dtype=torch.int32, device=self._storage.device)
        grown[: self.num_frames] = self._storage[: self.num_frames, : self.pixels_per_frame]
        self._storage = grown
        flags = torch.zeros(capacity, dtype=torch.bool)
        flags[: self.num_frames] = self._has_pixels[: self.num_frames]
        self._has_pixels = flags
