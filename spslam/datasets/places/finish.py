"""How a solid looks: a texture, its color and its scale; and all textures with their smaller versions in one image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.datasets.places.textures import SIZE_PX, make_textures

Color = tuple[float, float, float]
_LEVELS = 7
# What posters fade to: the tone of a plain wall.
_BARE = 0.86
# Around each texture, so that interpolation finds its neighbors beyond the seam.
_MARGIN_PX = 1


@dataclass(frozen=True)
class Finish:
    """The look of a solid or of one of its faces.

    Attributes:
        texture: a name of `spslam.datasets.places.textures.make_textures`.
        color: RGB, 0 to 1, multiplied with the texture.
        period_m: length over which the texture repeats; None stretches it over each face once, as on a poster.
    """

    texture: str
    color: Color = (1.0, 1.0, 1.0)
    period_m: float | None = 1.0


class Atlas:
    """All textures at all scales in one image, so that a single `cv2.remap` reads any mixture of them.

    Args:
        seed: of the textures.
        contrast: 0 leaves each texture's mean color, and of posters a light gray; 1 is the texture as it is.

    Attributes:
        number: index of each texture by name.
    """

    def __init__(self, seed: int, contrast: float) -> None:
        textures = make_textures(seed)
        self.number = {name: index for index, name in enumerate(textures)}
        self._sides = SIZE_PX >> np.arange(_LEVELS)
        cells = self._sides + 2 * _MARGIN_PX
        self._tops = np.concatenate(([0], np.cumsum(cells)[:-1]))
        self._cells = cells.astype(np.float32)
        self._image = np.zeros((int(cells.sum()), int(cells[0]) * len(textures), 3), np.uint8)
        for column, (name, texture) in enumerate(textures.items()):
            mean = np.full(3, _BARE) if name.startswith("poster") else texture.mean(axis=(0, 1))
            self._place(column, (255 * (mean + contrast * (texture - mean)) + 0.5).astype(np.uint8))

    def sample(self, texture: np.ndarray, u: np.ndarray, v: np.ndarray, texels: np.ndarray) -> np.ndarray:
        """Colors uint8 [H, W, 3].

        Args:
            texture: [H, W], indices of textures.
            u: float32 [H, W], across, in periods.
            v: as `u`, downward.
            texels: float32 [H, W], how many texels of the largest version fall in a pixel.
        """
        level = np.clip(np.log2(np.maximum(texels, 1)) + np.float32(0.3), 0, _LEVELS - 1).astype(np.intp)
        side = self._sides.astype(np.float32)[level]
        # Texel centers lie at half texels.
        shift = np.float32(_MARGIN_PX - 0.5)
        x = (u - np.floor(u)) * side + texture * self._cells[level] + shift
        y = (v - np.floor(v)) * side + self._tops.astype(np.float32)[level] + shift
        return cv2.remap(self._image, x, y, cv2.INTER_LINEAR)

    def _place(self, column: int, texture: np.ndarray) -> None:
        for side, top in zip(self._sides, self._tops, strict=True):
            cell = side + 2 * _MARGIN_PX
            padded = np.pad(texture, ((_MARGIN_PX,) * 2, (_MARGIN_PX,) * 2, (0, 0)), "wrap")
            self._image[top : top + cell, column * cell : (column + 1) * cell] = padded
            texture = cv2.resize(texture, (side // 2, side // 2), interpolation=cv2.INTER_AREA)
