"""Images of keyframes in files without a name, so that the system can put them out of memory."""

from __future__ import annotations

import mmap
import os
import tempfile

import numpy as np
import torch

IMAGES = 64  # of each kind in a file


class ImagePool:
    """Keeps depth and intensity images of one size.

    They are in temporary files (in the folder that `TMPDIR` names) which are mapped into memory and vanish with the
    process: what is not looked at takes no memory where it is scarce. Where no file can be had, they are in memory.

    Args:
        rows, columns: of the images.
    """

    def __init__(self, rows: int, columns: int):
        self._shape = rows, columns
        self._count = 0
        self._free: list[tuple[torch.Tensor, torch.Tensor]] = []
        self._depth = np.zeros((0, rows, columns), np.uint16)
        self._intensity = np.zeros((0, rows, columns), np.uint8)

    def keep(self, depth: torch.Tensor, intensity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Copies images uint16 and uint8 [rows, columns] on the CPU; returns the copies."""
        kept = self._free.pop() if self._free else self._new()
        for one, other in zip(kept, (depth, intensity), strict=True):
            one.copy_(other)
        return kept

    def give_back(self, depth: torch.Tensor, intensity: torch.Tensor) -> None:
        """Takes the copies that `keep` returned, which nobody looks at any more: others will be in their place."""
        self._free.append((depth, intensity))

    def _new(self) -> tuple[torch.Tensor, torch.Tensor]:
        at = self._count % IMAGES
        if at == 0:
            self._begin_file()
        self._count += 1
        return torch.from_numpy(self._depth[at]), torch.from_numpy(self._intensity[at])

    def _begin_file(self) -> None:
        pixels = IMAGES * self._shape[0] * self._shape[1]
        content = np.frombuffer(_mapped(3 * pixels), np.uint8)
        self._depth = content[: 2 * pixels].view(np.uint16).reshape(IMAGES, *self._shape)
        self._intensity = content[2 * pixels :].reshape(IMAGES, *self._shape)


def _mapped(size: int) -> mmap.mmap | bytearray:
    """Zeros in a file that is mapped into memory, or in memory where there is no room for one."""
    try:
        with tempfile.TemporaryFile(prefix="spslam-") as file:
            os.posix_fallocate(file.fileno(), 0, size)
            return mmap.mmap(file.fileno(), size)
    except OSError:
        return bytearray(size)
