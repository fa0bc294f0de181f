"""What the surfaces of a shop look like: procedural pictures of walls, shelves, floors and labels.

Every function returns linear reflectance, (H, W) float32 in 0..1, row 0 on top as seen from the front. Texels are
square, `texel` metres wide.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .floor_tiles import PITCH, floor_image, floor_tile
from .stores import Floor

Picture = NDArray[np.float32]

BOARD_GAP = 0.34  # m between shelf boards


def picture_size(width: float, height: float, texel: float) -> tuple[int, int]:
    """(rows, columns) of a picture that covers a surface."""
    return max(2, round(height / texel)), max(2, round(width / texel))


def wall(rng: np.random.Generator, style: str, width: float, height: float, texel: float) -> Picture:
    """A wall in one of the styles plaster, brick, wood, tiles or concrete, with a skirting board, posters and signs.

    An unknown style is painted as plaster, because a layout may name what only other programs can draw.
    """
    shape = picture_size(width, height, texel)
    if style in ("brick", "bricks"):
        picture = _bricks(rng, shape, (0.24 / texel, 0.08 / texel), joint=0.5, body=0.22)
    elif style == "tiles":
        picture = _bricks(rng, shape, (0.20 / texel, 0.20 / texel), joint=0.25, body=0.55, stagger=0.0)
    elif style == "wood":
        picture = _planks(rng, shape, 0.14 / texel)
    else:
        base = 0.33 if style == "concrete" else rng.uniform(0.42, 0.60)
        picture = np.full(shape, base, np.float32)
        picture += 0.035 * _clouds(rng, shape, 0.5 / texel) + 0.012 * _clouds(rng, shape, 0.02 / texel)
        dado = round(min(0.9, 0.4 * height) / texel)
        picture[-dado:] *= rng.uniform(0.45, 0.8)  # a darker lower half, as corridors are painted
    picture[-max(1, round(0.08 / texel)) :] = 0.12
    for _ in range(int(rng.poisson(0.8 * width))):
        w, h = rng.uniform(0.12, 0.7), rng.uniform(0.12, 0.8)
        x, y = rng.uniform(0.0, width), rng.uniform(0.2, max(0.3, height - 0.5))
        _paste(picture, _poster(rng, picture_size(w, h, texel)), round(y / texel), round(x / texel))
    return np.asarray(np.clip(picture, 0.02, 0.95), dtype=np.float32)


def shelf(rng: np.random.Generator, width: float, height: float, texel: float) -> Picture:
    """The front of a shelf: boards with price rails, goods in front of a dark back."""
    shape = picture_size(width, height, texel)
    picture = np.full(shape, 0.035, np.float32)
    levels = max(1, round(height / BOARD_GAP))
    gap = height / levels
    rail = max(1, round(0.035 / texel))
    for level in range(levels):
        bottom = round((level + 1) * gap / texel) - rail
        x = rng.uniform(0.0, 0.04)
        while x < width - 0.04:
            w, count = rng.uniform(0.05, 0.22), int(rng.integers(1, 5))
            pack = _pack(rng, picture_size(w, gap * rng.uniform(0.45, 0.86), texel))
            for _ in range(count):  # several of one kind beside each other
                _paste(picture, pack * np.float32(rng.uniform(0.9, 1.05)), bottom - pack.shape[0], round(x / texel))
                x += w + 0.004
            x += 0.02 if rng.random() < 0.85 else rng.uniform(0.05, 0.2)
        picture[bottom : bottom + rail] = 0.42
        picture[bottom : bottom + max(1, rail // 8)] = 0.15
        for tag in np.arange(rng.uniform(0.05, 0.2), width - 0.05, 0.17):
            _paste(picture, _text(rng, picture_size(0.05, 0.026, texel), 0.75), bottom + rail // 6, round(tag / texel))
    post = max(1, round(0.025 / texel))
    picture[:, :post] = 0.2
    picture[:, -post:] = 0.2
    return np.asarray(np.clip(picture, 0.02, 0.95), dtype=np.float32)


def shelf_top(rng: np.random.Generator, width: float, height: float, texel: float) -> Picture:
    """The upper side of a shelf."""
    shape = picture_size(width, height, texel)
    return np.asarray(0.4 + 0.03 * _clouds(rng, shape, 0.1 / texel), dtype=np.float32)


def floor(rng: np.random.Generator, layout: Floor, width: float, height: float, texel: float) -> Picture:
    """The floor, without the tape; row 0 is at the far end of the y axis. Raises ConfigError for a bad image."""
    if layout.image is not None:
        tile, pitch = floor_image(layout.image), layout.metres_per_pixel
    else:
        tile, pitch = floor_tile(layout.texture, rng), PITCH
    period = tile.shape[1] * pitch, tile.shape[0] * pitch
    size = max(1, round(period[0] / texel)), max(1, round(period[1] / texel))
    shrink = cv2.INTER_AREA if texel > pitch else cv2.INTER_LINEAR
    tile = cv2.resize(tile.astype(np.float32), size, interpolation=shrink).reshape(size[::-1])
    rows, columns = picture_size(width, height, texel)
    laid = tile[np.arange(rows) % size[1]][:, np.arange(columns) % size[0]]
    return np.ascontiguousarray(laid[::-1], dtype=np.float32)


def ceiling(rng: np.random.Generator, width: float, height: float, texel: float) -> Picture:
    """Ceiling panels."""
    shape = picture_size(width, height, texel)
    return _bricks(rng, shape, (0.6 / texel, 0.6 / texel), joint=0.4, body=0.7, stagger=0.0)


def label(rng: np.random.Generator) -> Picture:
    """The face of an electronic shelf label, 60 x 40 mm in texels of 1 mm."""
    picture = np.full((40, 60), 0.5, np.float32)
    picture[8:37, 3:57] = 0.62
    _paste(picture, _text(rng, (14, 40), 0.62), 10, 5)
    _paste(picture, _text(rng, (8, 50), 0.62), 27, 5)
    return picture


def _clouds(rng: np.random.Generator, shape: tuple[int, int], cell: float) -> Picture:
    """Smooth random values of mean 0 and deviation about 1 whose features are `cell` texels wide."""
    rows, columns = (max(2, int(np.ceil(n / cell)) + 1) for n in shape)
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    return np.asarray(cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def _bricks(
    rng: np.random.Generator,
    shape: tuple[int, int],
    brick: tuple[float, float],
    *,
    joint: float,
    body: float,
    stagger: float = 0.5,
) -> Picture:
    width, height = brick
    rows, columns = np.arange(shape[0]), np.arange(shape[1])
    course = (rows / height).astype(np.int64)
    across = columns[None, :] / width + stagger * (course[:, None] % 2)
    tones = rng.normal(1.0, 0.12, (course[-1] + 1, int(across.max()) + 1)).astype(np.float32)
    picture = body * tones[course[:, None], across.astype(np.int64)]
    picture *= 1.0 + 0.08 * _clouds(rng, shape, max(1.0, height / 12))
    edge = max(1.0, 0.04 * width)
    picture[(rows % height < edge)[:, None] | ((across % 1.0) * width < edge)] = joint
    return np.asarray(np.clip(picture, 0.02, 0.95), dtype=np.float32)


def _planks(rng: np.random.Generator, shape: tuple[int, int], width: float) -> Picture:
    """Upright boards."""
    columns = np.arange(shape[1])
    plank = (columns / width).astype(np.int64)
    tone = rng.normal(1.0, 0.15, plank[-1] + 1)[plank].astype(np.float32)
    grain = rng.standard_normal((max(2, shape[0] // 40), shape[1]), dtype=np.float32)
    grain = np.asarray(cv2.resize(grain, shape[::-1], interpolation=cv2.INTER_CUBIC), dtype=np.float32)
    picture = 0.30 * tone * (1.0 + 0.18 * grain)
    picture[:, columns % width < 1.0] *= 0.35
    return np.asarray(picture, dtype=np.float32)


def _poster(rng: np.random.Generator, shape: tuple[int, int]) -> Picture:
    paper, ink = (0.75, 0.08) if rng.random() < 0.6 else (0.10, 0.7)
    picture = np.full(shape, paper, np.float32)
    rows, columns = shape
    for _ in range(int(rng.integers(1, 5))):
        x, y = int(rng.integers(0, columns)), int(rng.integers(0, rows))
        size = int(rng.integers(2, max(3, min(shape) // 2)))
        tone = float(rng.uniform(0.05, 0.8))
        if rng.random() < 0.5:
            cv2.circle(picture, (x, y), size, tone, -1)
        else:
            cv2.rectangle(picture, (x, y), (x + 2 * size, y + size), tone, -1)
    title = max(2, rows // 5), max(2, columns * 4 // 5)
    _paste(picture, _text(rng, title, paper, ink), rows // 12, columns // 10)
    price = max(2, rows // 12), max(2, columns * 3 // 5)
    _paste(picture, _text(rng, price, paper, ink), rows * 4 // 5, columns // 10)
    picture[[0, -1]] = ink
    picture[:, [0, -1]] = ink
    return picture


def _pack(rng: np.random.Generator, shape: tuple[int, int]) -> Picture:
    """A carton, can or bottle: its own tone, round shading on some, a printed panel and a few lines of print."""
    rows, columns = shape
    picture = np.full(shape, np.exp(rng.uniform(np.log(0.06), np.log(0.75))), np.float32)
    other = float(rng.uniform(0.05, 0.85))
    top = int(rng.integers(0, max(1, rows // 2)))
    picture[top : top + max(2, rows // 3), columns // 8 : columns - columns // 8] = other
    print_ = _text(rng, (max(2, rows // 6), max(2, columns * 2 // 3)), other)
    _paste(picture, print_, top + rows // 12, columns // 6)
    if rng.random() < 0.5:
        across = np.linspace(-1.0, 1.0, columns, dtype=np.float32)
        picture *= 0.35 + 0.75 * np.sqrt(1.0 - 0.9 * across**2)
    picture[:, -1] *= 0.4
    return picture


def _text(rng: np.random.Generator, shape: tuple[int, int], paper: float, ink: float | None = None) -> Picture:
    """Something that looks like print from afar: bars of random width."""
    ink = (0.06 if paper > 0.3 else 0.7) if ink is None else ink
    bars = rng.random((1, shape[1] // 2 + 1)) < 0.5
    row = np.repeat(np.where(bars, ink, paper), 2, axis=1)[:, : shape[1]]
    picture = np.full(shape, paper, np.float32)
    picture[shape[0] // 6 : shape[0] - shape[0] // 6] = row
    return picture


def _paste(picture: Picture, patch: Picture, row: int, column: int) -> None:
    """Lay `patch` on `picture` with its upper left texel at row, column; what hangs over is cut off."""
    r0, c0 = max(row, 0), max(column, 0)
    r1, c1 = min(row + patch.shape[0], picture.shape[0]), min(column + patch.shape[1], picture.shape[1])
    if r0 < r1 and c0 < c1:
        picture[r0:r1, c0:c1] = patch[r0 - row : r1 - row, c0 - column : c1 - column]
