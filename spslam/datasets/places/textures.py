"""Procedural textures that repeat without a seam: plaster, planks, tiles, fabric and the like, and posters.

Each is float32 [SIZE_PX, SIZE_PX, 3], RGB, 0 to 1, with edges and details of many sizes, as image features need them.
Colors are near white where a finish gives the color, so that the two can be multiplied.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

SIZE_PX = 512
POSTERS = 10
Random = np.random.Generator


def make_textures(seed: int) -> dict[str, np.ndarray]:
    """All textures by name; the seed decides on every detail."""
    makers: dict[str, Callable[[Random], np.ndarray]] = {
        "plaster": _plaster,
        "wallpaper": _wallpaper,
        "planks": _planks,
        "tiles": _tiles,
        "terrazzo": _terrazzo,
        "carpet": _carpet,
        "bricks": _bricks,
        "concrete": _concrete,
        "wood": _wood,
        "fabric": _fabric,
        "paint": _paint,
        "print": _print,
    }
    makers |= {f"poster{number}": _poster for number in range(POSTERS)}
    return {name: _finish(make(np.random.default_rng([seed, 11, i]))) for i, (name, make) in enumerate(makers.items())}


def variation(seed: int) -> np.ndarray:
    """Broad stains, float32 [SIZE_PX, SIZE_PX] about 1: laid over large surfaces, no two spots of them look alike."""
    generator = np.random.default_rng([seed, 12])
    stains = 1 + 0.05 * _fractal(generator, (8, 16, 32, 64)) + 0.04 * np.abs(_fractal(generator, (32, 64, 128)))
    return np.clip(stains, 0.7, 1.25).astype(np.float32)


def _finish(texture: np.ndarray) -> np.ndarray:
    return np.clip(texture, 0, 1).astype(np.float32)


def _noise(generator: Random, cells: int) -> np.ndarray:
    """Smooth periodic noise of mean 0 and deviation 1 with so many cells across."""
    scale, margin = SIZE_PX // cells, 2
    grid = np.pad(generator.standard_normal((cells, cells)).astype(np.float32), margin, "wrap")
    side = (cells + 2 * margin) * scale
    image = cv2.resize(grid, (side, side), interpolation=cv2.INTER_CUBIC)
    image = image[margin * scale : -margin * scale, margin * scale : -margin * scale]
    return (image - image.mean()) / image.std()


def _fractal(generator: Random, cells: tuple[int, ...]) -> np.ndarray:
    octaves = [_noise(generator, count) * (cells[0] / count) ** 0.5 for count in cells]
    image = np.sum(octaves, axis=0)
    return (image / image.std()).astype(np.float32)


def _gray(image: np.ndarray) -> np.ndarray:
    return np.repeat(image[..., None], 3, axis=2).astype(np.float32)


def _lines(generator: Random, count: int, length_px: tuple[int, int], thickness: int) -> np.ndarray:
    """A mask, 0 to 1, of short crooked lines: cracks and scratches; periodic."""
    mask = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    for _ in range(count):
        steps = generator.normal(0, 0.35, 8).cumsum() + generator.uniform(0, 2 * np.pi)
        reach = generator.uniform(*length_px) / 8
        points = np.stack((np.cos(steps), np.sin(steps)), axis=1).cumsum(axis=0) * reach
        points += generator.uniform(0, SIZE_PX, 2)
        for shift in ((0, 0), (SIZE_PX, 0), (0, SIZE_PX), (SIZE_PX, SIZE_PX)):
            cv2.polylines(mask, [(points - shift).astype(np.int32)], False, 255, thickness, cv2.LINE_AA)
    return mask.astype(np.float32) / 255


def _spots(generator: Random, count: int, radius_px: tuple[float, float]) -> np.ndarray:
    """A mask, 0 to 1, of round spots; periodic."""
    mask = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    for _ in range(count):
        center, radius = generator.uniform(0, SIZE_PX, 2), generator.uniform(*radius_px)
        strength = int(generator.integers(90, 255))
        for shift in ((0, 0), (SIZE_PX, 0), (0, SIZE_PX), (SIZE_PX, SIZE_PX)):
            x, y = (center - shift).round().astype(int)
            cv2.circle(mask, (int(x), int(y)), max(round(radius), 1), strength, -1, cv2.LINE_AA)
    return mask.astype(np.float32) / 255


def _plaster(generator: Random) -> np.ndarray:
    image = 0.86 + 0.035 * _fractal(generator, (8, 16, 32, 64, 128)) + 0.03 * _noise(generator, 256)
    image -= 0.35 * _lines(generator, 26, (20, 150), 1) + 0.25 * _spots(generator, 60, (1, 3))
    image -= 0.1 * _spots(generator, 8, (6, 20))
    return _gray(image)


def _wallpaper(generator: Random) -> np.ndarray:
    image = np.full((SIZE_PX, SIZE_PX, 3), 0.85, np.float32)
    stripes = np.repeat(generator.uniform(0.72, 0.95, (32, 3)), SIZE_PX // 32, axis=0)
    image *= stripes[None].astype(np.float32)
    for x in range(0, SIZE_PX, 64):
        for y in range(0, SIZE_PX, 64):
            color = tuple(float(c) for c in generator.uniform(0.35, 0.8, 3))
            center = (x + 32 + int(generator.integers(-6, 7)), y + 32 + int(generator.integers(-6, 7)))
            axes = (int(generator.integers(6, 16)), int(generator.integers(6, 16)))
            cv2.ellipse(image, center, axes, float(generator.uniform(0, 180)), 0, 360, color, 2, cv2.LINE_AA)
            cv2.circle(image, center, 3, color, -1, cv2.LINE_AA)
    return image * (1 + 0.04 * _fractal(generator, (16, 64, 256)))[..., None]


def _planks(generator: Random) -> np.ndarray:
    rows, image = 8, np.zeros((SIZE_PX, SIZE_PX, 3), np.float32)
    height = SIZE_PX // rows
    grain = _fractal(generator, (64, 128, 256))
    for row in range(rows):
        band = slice(row * height, (row + 1) * height)
        joints = np.sort(generator.integers(0, SIZE_PX, 3))
        tone = generator.uniform(0.62, 0.98, 3)[np.searchsorted(joints, np.arange(SIZE_PX)) % 3]
        image[band] = (tone[:, None] * np.array([1.0, 0.95, 0.88]))[None]
        image[band, joints % SIZE_PX] *= 0.35
        image[band.start : band.start + 2] *= 0.4
    stretched = np.roll(cv2.resize(grain[:, :64], (SIZE_PX, SIZE_PX)), int(generator.integers(SIZE_PX)), axis=0)
    stretched = stretched + stretched[:, ::-1]
    image *= (1 + 0.06 * stretched + 0.03 * _noise(generator, 256))[..., None]
    return image * (1 - 0.6 * _spots(generator, 10, (2, 5)))[..., None]


def _tiles(generator: Random) -> np.ndarray:
    count = 8
    side = SIZE_PX // count
    tone = np.repeat(np.repeat(generator.uniform(0.66, 0.98, (count, count)), side, axis=0), side, axis=1)
    image = tone + 0.05 * _fractal(generator, (16, 32, 64, 128)) - 0.25 * _lines(generator, 30, (30, 120), 1)
    offset = np.arange(SIZE_PX) % side
    joint = (offset < 3)[:, None] | (offset < 3)[None]
    image = np.where(joint, 0.42 + 0.05 * _noise(generator, 128), image)
    return _gray(image - 0.4 * _spots(generator, 40, (1, 2.5)))


def _terrazzo(generator: Random) -> np.ndarray:
    image = np.full((SIZE_PX, SIZE_PX, 3), 0.8, np.float32)
    for _ in range(420):
        center, radius = generator.uniform(0, SIZE_PX, 2), generator.uniform(3, 15)
        angles = np.sort(generator.uniform(0, 2 * np.pi, 6))
        shape = np.stack((np.cos(angles), np.sin(angles)), axis=1) * radius * generator.uniform(0.5, 1, (6, 1))
        color = tuple(float(c) for c in np.clip(generator.uniform(0.35, 1.0) + generator.normal(0, 0.06, 3), 0, 1))
        for shift in ((0, 0), (SIZE_PX, 0), (0, SIZE_PX), (SIZE_PX, SIZE_PX)):
            cv2.fillPoly(image, [(center + shape - shift).astype(np.int32)], color, cv2.LINE_AA)
    return image * (1 + 0.03 * _fractal(generator, (8, 64, 256)))[..., None]


def _carpet(generator: Random) -> np.ndarray:
    image = np.full((SIZE_PX, SIZE_PX, 3), 0.7, np.float32)
    for x in range(0, SIZE_PX, 128):
        for y in range(0, SIZE_PX, 128):
            color = tuple(float(c) for c in generator.uniform(0.4, 1.0, 3))
            side = int(generator.integers(20, 50))
            corners = np.array([[0, -side], [side, 0], [0, side], [-side, 0]]) + (x + 64, y + 64)
            cv2.fillPoly(image, [corners.astype(np.int32)], color, cv2.LINE_AA)
            cv2.polylines(image, [corners.astype(np.int32) * 1], True, (0.95, 0.92, 0.8), 3, cv2.LINE_AA)
    return image * (1 + 0.1 * _noise(generator, 256) + 0.05 * _fractal(generator, (8, 32, 128)))[..., None]


def _bricks(generator: Random) -> np.ndarray:
    rows, columns = 16, 8
    height, width = SIZE_PX // rows, SIZE_PX // columns
    y, x = np.indices((SIZE_PX, SIZE_PX))
    x = (x + (y // height % 2) * (width // 2)) % SIZE_PX
    tone = generator.uniform(0.6, 1.0, (rows, columns)).astype(np.float32)[y // height, x // width]
    image = tone + 0.06 * _fractal(generator, (32, 64, 128, 256)) - 0.3 * _spots(generator, 120, (1, 3))
    return _gray(np.where((y % height < 4) | (x % width < 4), 0.55 + 0.06 * _noise(generator, 128), image))


def _concrete(generator: Random) -> np.ndarray:
    image = 0.76 + 0.06 * _fractal(generator, (8, 16, 32, 64, 128, 256)) - 0.45 * _spots(generator, 150, (1, 3.5))
    image -= 0.4 * _lines(generator, 12, (80, 260), 1) + 0.12 * _spots(generator, 10, (10, 30))
    image[SIZE_PX // 2 : SIZE_PX // 2 + 3] *= 0.7
    image[:, SIZE_PX // 4 : SIZE_PX // 4 + 3] *= 0.7
    for x in range(SIZE_PX // 8, SIZE_PX, SIZE_PX // 4):
        cv2.circle(image, (x, SIZE_PX // 4), 6, 0.35, -1, cv2.LINE_AA)
    return _gray(image)


def _wood(generator: Random) -> np.ndarray:
    bend = _fractal(generator, (2, 4, 8)) * 14
    rings = np.sin(2 * np.pi * (np.arange(SIZE_PX)[:, None] * 16 / SIZE_PX + bend / 32))
    image = 0.82 + 0.09 * np.sign(rings) * np.abs(rings) ** 0.4 + 0.04 * _fractal(generator, (64, 128, 256))
    return _gray(image - 0.45 * _spots(generator, 9, (3, 9)) - 0.25 * _lines(generator, 24, (20, 120), 1))


def _fabric(generator: Random) -> np.ndarray:
    y, x = np.indices((SIZE_PX, SIZE_PX)) // 8
    weave = np.where((x + y) % 2 == 0, 0.95, 0.8)
    broad = np.where((np.indices((SIZE_PX, SIZE_PX))[1] // 64) % 4 == 0, 0.8, 1.0)
    image = weave * broad * (1 + 0.06 * _fractal(generator, (16, 64, 256)))
    return _gray(image - 0.25 * _spots(generator, 30, (2, 6)))


def _paint(generator: Random) -> np.ndarray:
    image = 0.88 + 0.025 * _fractal(generator, (16, 64, 256)) - 0.3 * _lines(generator, 40, (10, 90), 1)
    return _gray(image - 0.4 * _spots(generator, 50, (1, 4)))


def _print(generator: Random) -> np.ndarray:
    image = np.full((SIZE_PX, SIZE_PX, 3), 0.92, np.float32)
    for _ in range(14):
        low = generator.integers(0, SIZE_PX - 60, 2)
        high = low + generator.integers(25, 160, 2)
        color = tuple(float(c) for c in generator.uniform(0.25, 1.0, 3))
        cv2.rectangle(image, low.tolist(), np.minimum(high, SIZE_PX - 4).tolist(), color, -1)
    _write(image, generator, 26)
    return image


def _poster(generator: Random) -> np.ndarray:
    top, bottom = generator.uniform(0.25, 1.0, (2, 3))
    ramp = np.linspace(0, 1, SIZE_PX)[:, None, None]
    image = np.ascontiguousarray(np.broadcast_to(top + (bottom - top) * ramp, (SIZE_PX, SIZE_PX, 3)), np.float32)
    for _ in range(int(generator.integers(14, 26))):
        color = tuple(float(c) for c in generator.uniform(0.05, 1.0, 3))
        center = generator.integers(0, SIZE_PX, 2)
        radius = int(generator.integers(12, 90))
        if generator.uniform() < 0.4:
            cv2.circle(image, center.tolist(), radius, color, int(generator.choice([-1, 6, 12])), cv2.LINE_AA)
        else:
            shape = center + generator.integers(-radius, radius + 1, (int(generator.integers(3, 6)), 2))
            cv2.fillPoly(image, [shape.astype(np.int32)], color, cv2.LINE_AA)
    _write(image, generator, 8)
    image *= 1 + 0.02 * _noise(generator, 128)[..., None]
    border = tuple(float(c) for c in generator.uniform(0.1, 0.9, 3))
    cv2.rectangle(image, (0, 0), (SIZE_PX - 1, SIZE_PX - 1), border, 24)
    return image


def _write(image: np.ndarray, generator: Random, lines: int) -> None:
    """Lines of text in letters of 3 x 5 dots each; OpenCV's fonts differ between its versions."""
    for _ in range(lines):
        letters = generator.uniform(size=(int(generator.integers(4, 14)), 5, 3)) < 0.6
        dots = np.concatenate([np.pad(letter, ((0, 0), (0, 1))) for letter in letters], axis=1)
        mask = np.kron(dots, np.ones((int(generator.integers(3, 8)),) * 2)) > 0
        mask = mask[:, : SIZE_PX - 80]
        x, y = (int(generator.integers(30, SIZE_PX - 30 - side)) for side in mask.shape[::-1])
        image[y : y + mask.shape[0], x : x + mask.shape[1]][mask] = generator.uniform(0.0, 0.5, 3)
