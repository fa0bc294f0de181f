"""How a camera that shakes moved against a reference picture, in pixels, cheaply enough for every frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

try:
    from . import _blink as kernels
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    from . import blink_reference as kernels  # type: ignore[no-redef]

Floats = NDArray[np.float64]
Shorts = NDArray[np.int16]

BANDS = 6  # of rows, because a rolling shutter sees lamps flicker in waves
_TILES = (BANDS, 8)
_ROW_STEP = 4  # every fourth row of apertures is looked at


class Shake:
    """Estimates the picture's shift of every frame against the first one.

    A Gauss-Newton step on 4x4-pixel apertures, as of Lucas and Kanade (1981), in tiles that are weighted by how well
    they agree with the rest (iteratively reweighted), because people who walk by move part of the picture only. The
    mean change of a tile does not count: lamps flicker.
    """

    def __init__(self, before: int) -> None:
        self._before = before
        self.offset = np.zeros(2)  # of the reference against the first picture
        self.brightness = np.zeros(BANDS)  # relative change of the last picture's grey levels against the first one
        self._brightness = np.zeros(BANDS)  # of the reference
        self._moments = np.zeros((*_TILES, 3), np.float32)
        self._reference = np.zeros((0, 0), np.int16)
        self._down = np.zeros((0, 0), np.int16)
        self._right = np.zeros((0, 0), np.int16)
        self.down = self._down  # change of each aperture per px that the picture moves up
        self.right = self._right

    def refer(self, image: NDArray[np.uint8], offset: Floats) -> None:
        """Take a picture (H, W) as the reference; it is shifted by `offset` (u, v) against the first one."""
        self.offset = np.asarray(offset, float).copy()
        pixels = _padded(image)
        height, width = image.shape[0] // 2, image.shape[1] // 2
        self._reference = np.ascontiguousarray(_fours(_fours(pixels[1:, 1:]).T).T[:height, :width])
        self._down, self._right = self.down, self.right = _gradients(pixels)
        del pixels  # because what follows needs as much memory again
        tiles_down, tiles_right = self._tiled(self._down), self._tiled(self._right)
        self._mean = np.stack([tiles_right.mean(axis=1), tiles_down.mean(axis=1)])
        tiles_right, tiles_down = tiles_right - self._mean[0][:, None], tiles_down - self._mean[1][:, None]
        products = ((tiles_right**2), tiles_right * tiles_down, tiles_down**2)
        self._tiles = np.stack([product.sum(axis=1) for product in products] + list(self._mean), axis=1)
        self._sums = np.maximum(self._tiled(self._reference).sum(axis=1), 1.0)
        self._counted = tiles_right.shape[1]
        self._brightness = self.brightness

    def look(self, image: NDArray[np.uint8]) -> None:
        """Take `down` and `right` from a picture: people stand elsewhere than in the reference by now."""
        self.down, self.right = _gradients(_padded(image))

    def _tiled(self, picture: NDArray[np.int16]) -> Floats:
        high, wide = picture.shape[0] // _TILES[0], picture.shape[1] // _TILES[1]
        tiles = picture[: _TILES[0] * high, : _TILES[1] * wide].reshape(_TILES[0], high, _TILES[1], wide)
        return tiles[:, ::_ROW_STEP].transpose(0, 2, 1, 3).reshape(_TILES[0] * _TILES[1], -1).astype(float)

    def measure(self, cells: NDArray[np.uint8]) -> Floats:
        """Shift (u, v) in px of a picture against the first one; the reference's while noise could be the cause.

        Its change of `brightness` is measured as well, by the tiles' median, because people cover some.
        """
        kernels.shift_moments(cells, self._reference, self._down, self._right, self._before, _ROW_STEP, self._moments)
        shift = np.array(kernels.agreed_shift(self._moments.reshape(-1, 3), self._tiles))
        moved = self._counted * (shift @ self._mean)
        change = (self._moments[:, :, 2].ravel() - moved) / self._sums
        middle = np.sort(change.reshape(_TILES), axis=1)[:, _TILES[1] // 2 - 1 : _TILES[1] // 2 + 1]
        self.brightness = self._brightness + 0.5 * (middle[:, 0] + middle[:, 1])
        return np.asarray(self.offset - shift)


def _padded(image: NDArray[np.uint8]) -> Shorts:
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return np.pad(image[: 2 * height, : 2 * width], ((1, 4), (1, 4)), "edge").astype(np.int16)


def _gradients(pixels: Shorts) -> tuple[Shorts, Shorts]:
    """Change of each aperture per px that a picture moves up, and left."""
    height, width = (pixels.shape[0] - 5) // 2, (pixels.shape[1] - 5) // 2
    down = _fours(_edges(pixels)[:, 1:].T).T[:height, :width] // 2
    right = _fours(_edges(pixels.T)[:, 1:].T)[:height, :width] // 2
    return np.ascontiguousarray(down), np.ascontiguousarray(right)


def _pairs(pixels: Shorts) -> Shorts:
    """Sums of rows 0 and 1, 2 and 3, and so on."""
    return np.asarray(pixels[: len(pixels) // 2 * 2 : 2] + pixels[1::2])


def _fours(pixels: Shorts) -> Shorts:
    """Sums of rows 0..3, 2..5, and so on."""
    pairs = _pairs(pixels)
    return np.asarray(pairs[:-1] + pairs[1:])


def _edges(pixels: Shorts) -> Shorts:
    """Twice the derivative along the rows of the sums of rows 1..4, 3..6, and so on: what enters less what leaves.

    Differences of neighbouring sums would be far too small on fine texture.
    """
    pairs = _pairs(pixels)
    return np.asarray(pairs[2:] - pairs[:-2])
