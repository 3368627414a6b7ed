"""The voxel hash as a Python dictionary, and lookup by brute force."""

import itertools
import math

import torch

LIMIT = 2**20


class DictVolume:
    """Coordinates to ids, by the rules of the ops: new ids in lexicographic order of the absent coordinates."""

    def __init__(self):
        self.ids: dict[tuple[int, int, int], int] = {}

    def insert(self, coords) -> list[tuple[int, int, int]]:
        absent = sorted({tuple(c) for c in coords} - self.ids.keys())
        for coord in absent:
            self.ids[coord] = len(self.ids)
        return absent

    def find(self, coords) -> list[int]:
        return [self.ids.get(tuple(c), -1) for c in coords]

    def cell(self, coord) -> list[int]:
        """Ids of the eight corners, x fastest; all -1 where one is missing."""
        x, y, z = coord
        corners = [(x + i, y + j, z + k) for k, j, i in itertools.product((0, 1), repeat=3)]
        ids = self.find(corners)
        return ids if min(ids) >= 0 else [-1] * 8

    def corner_rows(self) -> list[list[int]]:
        return [self.cell(coord) for coord in self.ids]

    def lookup(self, points: torch.Tensor, voxel_size: float) -> tuple[torch.Tensor, torch.Tensor]:
        rows, locals_ = [], []
        for point in points.tolist():
            scaled = [p / voxel_size for p in point]
            finite = all(map(math.isfinite, scaled))
            base = [math.floor(s) for s in scaled] if finite else None
            row = self.cell(base) if base else [-1] * 8
            rows.append(row)
            locals_.append([s - b for s, b in zip(scaled, base, strict=True)] if row[0] >= 0 else [0.0] * 3)
        shape = (len(points), -1)
        return (
            torch.tensor(rows, dtype=torch.int32).reshape(shape[0], 8),
            torch.tensor(locals_, dtype=points.dtype).reshape(shape[0], 3),
        )
