"""Colors of the points that rays meet: finish, light by orientation, and broad stains."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from spslam.datasets.places.caster import Rays
from spslam.datasets.places.finish import Atlas, Finish
from spslam.datasets.places.textures import SIZE_PX, variation
from spslam.datasets.primitives import Box, Cylinder, Primitive, Sphere

# Light by orientation, so that each flat surface has one shade.
_LIGHT = np.array([0.36, 0.27, 0.89], dtype=np.float32)
_AMBIENT, _DIRECT = 0.78, 0.22
_STAINS_PERIOD_M = 13.0
# Of the third coordinate, so that facing walls have different stains.
_STAINS_SLANT = 0.37
_FACES = 6
_AXES_OF_FACE = ((1, 2), (0, 2), (0, 1))


class Shader:
    """Colors of the surface points of a scene.

    Args:
        shell: the box around the scene; its number is -1.
        solids: what stands in it.
        finishes: six for each solid and then six for the shell, by face: low x, high x, low y, high y, low z, high z.
            Round solids take the first for their side and the last for their caps.
        seed: of the textures, and of where a texture begins on a solid.
        contrast: 0 is a plain color for each solid, 1 the texture as it is.
    """

    def __init__(
        self, shell: Box, solids: Sequence[Primitive], finishes: Sequence[Sequence[Finish]], seed: int, contrast: float
    ) -> None:
        parts: list[Primitive] = [*solids, shell]
        self._atlas = Atlas(seed, contrast)
        stains = 1 + np.float32(contrast) * (variation(seed) - 1)
        self._stains = np.pad(stains, ((0, 1), (0, 1)), "wrap")
        self._centers = np.array([part.center for part in parts], dtype=np.float32).T.copy()
        self._halves = np.array([part.half_size for part in parts], dtype=np.float32).T.copy()
        self._turns = np.array([[np.cos(part.yaw), np.sin(part.yaw)] for part in parts], dtype=np.float32).T.copy()
        self._round = np.array([0 if isinstance(p, Box) else 1 if isinstance(p, Cylinder) else 2 for p in parts])
        self._fill_faces(parts, finishes, np.random.default_rng([seed, 13]))

    def _fill_faces(
        self, parts: Sequence[Primitive], finishes: Sequence[Sequence[Finish]], generator: np.random.Generator
    ) -> None:
        flat = [finish for faces in finishes for finish in faces]
        count = len(parts) * _FACES
        self._texture = np.array([self._atlas.number[finish.texture] for finish in flat], dtype=np.float32)
        self._color = np.array([finish.color for finish in flat], dtype=np.float32)
        self._scale = np.empty((2, count), dtype=np.float32)
        self._offset = np.empty((2, count), dtype=np.float32)
        for index, finish in enumerate(flat):
            part, axis = parts[index // _FACES], index % _FACES // 2
            self._scale[:, index], self._offset[:, index] = _placement(part, axis, finish, generator)
        self._texels_per_m = SIZE_PX * np.abs(self._scale).max(axis=0)
        signs = np.repeat([[-1.0], [1.0]], len(parts), axis=1)
        signs[:, -1] *= -1
        normals = np.zeros((3, len(parts), _FACES), dtype=np.float32)
        c, s = self._turns
        for side in (0, 1):
            normals[0, :, side], normals[1, :, side] = c * signs[side], s * signs[side]
            normals[0, :, 2 + side], normals[1, :, 2 + side] = -s * signs[side], c * signs[side]
            normals[2, :, 4 + side] = signs[side]
        self._normals = normals.reshape(3, count)
        boxes = np.repeat(self._round == 0, _FACES)
        shade = np.where(boxes, _AMBIENT + _DIRECT * (_LIGHT @ self._normals), 1.0)
        self._color *= shade.astype(np.float32)[:, None]

    def colors(self, rays: Rays, depth: np.ndarray, owner: np.ndarray, focal_px: float) -> np.ndarray:
        """Colors uint8 [H, W, 3] of what rays meet.

        Args:
            rays: of the image.
            depth: [H, W], m, along the rays.
            owner: int16 [H, W], which solid; -1 for the shell.
            focal_px: of the camera; far texture is smoothed by it.
        """
        solid = np.where(owner < 0, self._round.size - 1, owner).astype(np.intp)
        points = rays.points(depth)
        local = self._to_local(points, solid)
        face, u, v = self._on_boxes(local, solid)
        light = np.ones(depth.shape, np.float32)
        self._on_round(local, solid, (face, u, v, light))
        cosine = np.abs(sum(self._normals[axis].take(face) * rays.directions[axis] for axis in range(3)))
        cosine = np.where(self._round.take(solid) > 0, np.float32(1), np.maximum(cosine, np.float32(0.05)))
        texels = depth * self._texels_per_m.take(face) / (np.sqrt(cosine) * np.float32(focal_px))
        u = u * self._scale[0].take(face) + self._offset[0].take(face)
        v = v * self._scale[1].take(face) + self._offset[1].take(face)
        image = self._atlas.sample(self._texture.take(face), u, v, texels)
        light *= self._stain(points)
        tint = self._color.take(face, axis=0)
        tint *= light[..., None]
        return cv2.multiply(image, tint, dtype=cv2.CV_8U)

    def _to_local(self, points: np.ndarray, solid: np.ndarray) -> np.ndarray:
        x, y, z = (points[axis] - self._centers[axis].take(solid) for axis in range(3))
        c, s = self._turns[0].take(solid), self._turns[1].take(solid)
        return np.stack((c * x + s * y, c * y - s * x, z))

    def _on_boxes(self, local: np.ndarray, solid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Face index, and both coordinates on the face; v is downward."""
        gaps = [np.abs(np.abs(local[axis]) - self._halves[axis].take(solid)) for axis in range(3)]
        is_x = (gaps[0] <= gaps[1]) & (gaps[0] <= gaps[2])
        is_z = ~is_x & (gaps[2] < gaps[1])
        axis = np.where(is_x, 0, np.where(is_z, 2, 1))
        along = np.where(is_x, local[0], np.where(is_z, local[2], local[1]))
        face = solid * _FACES + 2 * axis + (along > 0)
        return face, np.where(is_x, local[1], local[0]), np.where(is_z, local[1], -local[2])

    def _on_round(self, local: np.ndarray, solid: np.ndarray, image: tuple[np.ndarray, ...]) -> None:
        """Replaces face, u and v, and sets the light, where a cylinder or a sphere is seen."""
        kinds = self._round.take(solid)
        if not kinds.any():
            return
        face, u, v, light = image
        where = np.nonzero(kinds)
        number, (x, y, z) = solid[where], local[:, where[0], where[1]]
        radius, height = self._halves[0][number], self._halves[2][number]
        ball = kinds[where] == 2
        cap = ~ball & (np.abs(np.abs(z) - height) < np.abs(np.hypot(x, y) - radius))
        face[where] = number * _FACES + np.where(cap, 5, 0)
        angle = np.arctan2(y, x)
        u[where] = np.where(cap, x, angle * radius)
        latitude = np.arcsin(np.clip(z / radius, -1, 1)) * radius
        v[where] = np.where(cap, y, -np.where(ball, latitude, z))
        across = np.where(ball, np.sqrt(np.maximum(1 - (z / radius) ** 2, 0)), 1)
        up = np.where(cap, np.sign(z), np.where(ball, z / radius, 0))
        across = np.where(cap, 0, across)
        normal_light = across * (np.cos(angle) * _LIGHT[0] + np.sin(angle) * _LIGHT[1]) + up * _LIGHT[2]
        light[where] = _AMBIENT + _DIRECT * normal_light

    def _stain(self, points: np.ndarray) -> np.ndarray:
        scale = np.float32(1 / _STAINS_PERIOD_M)
        u = (points[0] + np.float32(_STAINS_SLANT) * points[1]) * scale
        v = (points[2] + np.float32(_STAINS_SLANT) * points[0] + np.float32(0.9) * points[1]) * scale
        x = (u - np.floor(u)) * np.float32(SIZE_PX)
        y = (v - np.floor(v)) * np.float32(SIZE_PX)
        return cv2.remap(self._stains, x, y, cv2.INTER_LINEAR)


def _placement(
    part: Primitive, axis: int, finish: Finish, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Scale and offset [2] that turn coordinates on a face into periods of its texture."""
    first, second = _AXES_OF_FACE[axis]
    half, center = part.half_size, np.asarray(part.center)
    if finish.period_m is None:
        return 0.5 / half[[first, second]], np.array([0.5, 0.5])
    scale = np.full(2, 1 / finish.period_m)
    if isinstance(part, Box) and part.yaw == 0:
        # One pattern through the world: it goes on over parts of a wall.
        signs = np.array([1, 1 if axis == 2 else -1])
        depth = center[axis] * _STAINS_SLANT
        return scale, (center[[first, second]] * signs + depth) * scale
    if isinstance(part, (Cylinder, Sphere)) and axis == 0:
        # A whole number of periods around.
        around = 2 * np.pi * part.half_size[0]
        scale[0] = max(round(around / finish.period_m), 1) / around
    return scale, generator.uniform(0, 1, 2)
