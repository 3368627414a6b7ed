"""Color features on three axis-aligned planes that grow as the camera moves (section III.B)."""

from collections.abc import Sequence

import numpy as np
import torch

from spslam import ops
from spslam.errors import SpslamError
from spslam.tensor_schema import check_plane_layout

FEATURES = 32
MARGIN_M = 1.0  # planes grow by this much more than needed, so that they grow rarely
INITIAL_STD = 0.01
AXES = ((0, 1), (0, 2), (1, 2))  # axes of the xy, xz and yz planes
_BLOCK = 32  # edge, in texels, of the square blocks that are initialized with one Philox key
_Rectangle = tuple[int, int, int, int]  # origin u, origin v, size u, size v; of texels
_FIRST_KEY = 2**31  # the keys of blocks are near this one, apart from the keys of other initial values


class TriPlanes:
    """Feature texels of the xy, xz and yz planes, as the rows of one table.

    A plane is a rectangle of texels (iu, iv) at world position (iu, iv) * cell_size_m. The initial value of a texel
    depends only on the seed, its plane and its (iu, iv), so it does not depend on the order in which a plane grew.

    Attributes:
        cell_size_m: edge length of a texel, m.
        seed: seed of the initial values.
        max_texels: largest number of texels in total; None is no limit.
        texels: float32 [P, 32].
        layout: 15 ints, (first row, origin u, origin v, size u, size v) of each plane, as `ops.tri_plane_interpolate`
            takes them.
    """

    def __init__(
        self,
        cell_size_m: float,
        seed: int = 0,
        device: torch.device | str = "cpu",
        max_texels: int | None = None,
    ):
        """Creates empty planes.

        Args:
            cell_size_m: edge length of a texel, m.
            seed: seed of the initial values.
            device: where the texels are.
            max_texels: largest number of texels in total; None is no limit.

        Raises:
            ValueError: `cell_size_m` is not positive.
        """
        if not cell_size_m > 0:
            raise ValueError(f"TriPlanes: cell_size_m must be positive, got {cell_size_m}")
        self.cell_size_m = float(cell_size_m)
        self.seed = seed
        self.max_texels = max_texels
        self.texels = torch.zeros(0, FEATURES, dtype=torch.float32, device=device)
        self.layout = [0] * 15

    def interpolate(self, points: torch.Tensor) -> torch.Tensor:
        """Sum of the features of the three planes at points (eq. 3).

        Args:
            points: float32 [N, 3], m.

        Returns:
            float32 [N, 32].
        """
        return ops.tri_plane_interpolate(self.texels, points, self.cell_size_m, self.layout)

    def cover(self, points: torch.Tensor) -> torch.Tensor | None:
        """Grows the planes until they cover all points; existing texels are kept.

        Args:
            points: float [N, 3], m; rows with NaN or infinity are ignored.

        Returns:
            int64 [old P], the new row of each old row, to move other buffers with a row per texel; None if no plane
            grew.

        Raises:
            SpslamError: more than `max_texels` texels are needed. The planes are not changed then.
        """
        known = points.cpu().numpy()
        known = known[np.isfinite(known).all(1)]
        if len(known) == 0:
            return None
        cell_size_m = known.dtype.type(self.cell_size_m)
        low = np.floor(known.min(0) / cell_size_m).astype(np.int64).tolist()
        high = np.ceil(known.max(0) / cell_size_m).astype(np.int64).tolist()
        margin = round(MARGIN_M / self.cell_size_m)
        planes = [self._extended(plane, low, high, margin) for plane in range(3)]
        if planes == [self._rectangle(plane) for plane in range(3)]:
            return None
        self._check_limit(planes)
        return self._regrow(planes)

    def restore(self, texels: torch.Tensor, layout: Sequence[int]) -> None:
        """Replaces texels and layout by saved ones.

        Args:
            texels: float32 [P, 32].
            layout: as `layout` of the class.

        Raises:
            ValueError: the planes do not fill the texels exactly, one after the other.
        """
        if texels.dim() != 2 or texels.shape[1] != FEATURES:
            raise ValueError(f"TriPlanes.restore: texels must have shape [P, {FEATURES}], got {list(texels.shape)}")
        try:
            check_plane_layout(layout, len(texels))
        except ValueError as fault:
            raise ValueError(f"TriPlanes.restore: {fault}") from None
        self.texels = texels.to(self.texels.device, torch.float32).clone()
        self.layout = [int(value) for value in layout]

    def _check_limit(self, planes: list[_Rectangle]) -> None:
        wanted = sum(size_u * size_v for _, _, size_u, size_v in planes)
        if self.max_texels is not None and wanted > self.max_texels:
            raise SpslamError(
                f"TriPlanes.cover: texels must stay within scene.max_texels = {self.max_texels}, got {wanted}; raise "
                "it, choose a larger scene.plane_cell_m, or leave out far points by a smaller dataset.max_depth_m"
            )

    def _rectangle(self, plane: int) -> _Rectangle:
        _, u, v, size_u, size_v = self.layout[5 * plane : 5 * plane + 5]
        return u, v, size_u, size_v

    def _extended(self, plane: int, low: list[int], high: list[int], margin: int) -> _Rectangle:
        """The rectangle of a plane extended to contain low..high; each side that must grow gets a margin."""
        origins, sizes = [], []
        for slot, axis in enumerate(AXES[plane]):
            begin, size = self._rectangle(plane)[slot], self._rectangle(plane)[slot + 2]
            end = begin + size
            if size == 0:
                begin, end = low[axis] - margin, high[axis] + 1 + margin
            if low[axis] < begin:
                begin = low[axis] - margin
            if high[axis] >= end:
                end = high[axis] + 1 + margin
            origins.append(begin)
            sizes.append(end - begin)
        return origins[0], origins[1], sizes[0], sizes[1]

    def _regrow(self, planes: list[_Rectangle]) -> torch.Tensor:
        texels, layout, moved, first = [], [], [], 0
        for plane, (u, v, size_u, size_v) in enumerate(planes):
            old_first, old_u, old_v, old_size_u, old_size_v = self.layout[5 * plane : 5 * plane + 5]
            grown = self._initial(plane, (u, v, size_u, size_v), (old_u, old_v, old_size_u, old_size_v))
            rows = torch.arange(size_u * size_v, device=self.texels.device).view(size_u, size_v)
            inside = (slice(old_u - u, old_u - u + old_size_u), slice(old_v - v, old_v - v + old_size_v))
            old = self.texels[old_first : old_first + old_size_u * old_size_v]
            if len(old):
                grown[inside] = old.view(old_size_u, old_size_v, FEATURES)
                moved.append(first + rows[inside].reshape(-1))
            texels.append(grown.reshape(-1, FEATURES))
            layout += [first, u, v, size_u, size_v]
            first += size_u * size_v
        self.texels, self.layout = torch.cat(texels), layout
        return torch.cat(moved) if moved else torch.zeros(0, dtype=torch.int64, device=self.texels.device)

    def _initial(self, plane: int, rectangle: _Rectangle, known: _Rectangle) -> torch.Tensor:
        """Initial texels [size_u, size_v, 32], N(0, 0.01), of blocks at fixed world positions.

        Args:
            plane: its number.
            rectangle: of the texels.
            known: of those that are known already; what lies in blocks wholly inside is left undefined.
        """
        u, v, size_u, size_v = rectangle
        device = self.texels.device
        texels = torch.empty(size_u, size_v, FEATURES, dtype=torch.float32, device=device)
        blocks = [
            (block_u, block_v)
            for block_u in range(u // _BLOCK, (u + size_u - 1) // _BLOCK + 1)
            for block_v in range(v // _BLOCK, (v + size_v - 1) // _BLOCK + 1)
            if not _is_inside((block_u * _BLOCK, block_v * _BLOCK, _BLOCK, _BLOCK), known)
        ]
        uniform = (self._uniform_block(plane, *block) for block in blocks)
        # A CPU takes blocks one by one: the last bits of its logarithms depend on how many there are at a time.
        is_together = device.type == "cuda" and len(blocks) > 0
        normal = iter(_normal(torch.stack(list(uniform)))) if is_together else map(_normal, uniform)
        for (block_u, block_v), block in zip(blocks, normal, strict=True):
            first_u, first_v = block_u * _BLOCK - u, block_v * _BLOCK - v
            begin_u, begin_v = max(first_u, 0), max(first_v, 0)
            part = texels[begin_u : first_u + _BLOCK, begin_v : first_v + _BLOCK]
            rows, columns = begin_u - first_u, begin_v - first_v
            part.copy_(block[rows : rows + part.shape[0], columns : columns + part.shape[1]])
        return texels

    def _uniform_block(self, plane: int, block_u: int, block_v: int) -> torch.Tensor:
        """Numbers [_BLOCK, _BLOCK, 2, 32] in [0, 1) that the texels of the block with these coordinates are made of."""
        count = _BLOCK * _BLOCK * 2 * FEATURES
        frame, iteration = block_u & 0xFFFFFFFF, _FIRST_KEY + 4 * block_v + plane
        stream = ops.RandomStream.INITIALIZATION
        uniform = ops.philox_uniform(self.seed, stream, frame, iteration, count, self.texels.device)
        return uniform.view(_BLOCK, _BLOCK, 2, FEATURES)


def _is_inside(one: _Rectangle, other: _Rectangle) -> bool:
    return all(
        begin >= first and begin + size <= first + whole
        for begin, size, first, whole in zip(one[:2], one[2:], other[:2], other[2:], strict=True)
    )


def _normal(uniform: torch.Tensor) -> torch.Tensor:
    """N(0, 0.01) [..., 32] of numbers [..., 2, 32] in [0, 1), by the Box-Muller transform."""
    first, second = uniform.unbind(-2)
    return INITIAL_STD * (-2 * torch.log(1 - first)).sqrt() * torch.cos(2 * torch.pi * second)  # 1 - u lies in (0, 1]
