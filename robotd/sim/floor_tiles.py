"""Procedural floors: periodic tiles of linear reflectance with the structure of the real material."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError
from ..records import Floats

TILE = 1024  # px a side
PITCH = 0.002  # m per px


def floor_tile(texture: str, rng: np.random.Generator) -> Floats:
    """(1024, 1024) reflectance 0..1 of a floor at 2 mm per pixel, periodic in both directions.

    Parameters
    ----------
    texture : str
        carpet, wood, concrete, tiles or asphalt.
    rng : numpy Generator
    """
    tile = {"carpet": _carpet, "wood": _wood, "concrete": _concrete, "tiles": _tiles, "asphalt": _asphalt}[texture](rng)
    return np.asarray(np.clip(tile, 0.01, 0.95))


def floor_image(path: Path) -> Floats:
    """(H, W) linear reflectance of an image file, row 0 along the store's x axis; raises ConfigError if unreadable."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ConfigError(f"{path}: not an image that can be read; expected PNG or JPEG")
    return np.asarray((image[::-1] / 255.0) ** 2.2)


def dirt_tile(rng: np.random.Generator, size: tuple[int, int]) -> Floats:
    """(H, W) wear 0..1 of tape: mostly none, in blotches and scuffs of some centimetres."""
    blotches = _smooth(rng, size, 8.0) + 0.6 * _smooth(rng, size, 2.0) + 0.5 * _smooth(rng, size, (1.0, 20.0))
    return np.asarray(np.clip(0.6 * blotches - 0.4, 0.0, 1.0))


def _smooth(rng: np.random.Generator, size: tuple[int, int], sigma: float | tuple[float, float]) -> Floats:
    """Periodic Gaussian noise of unit variance; `sigma` px, or (across rows, along rows)."""
    down, across = (sigma, sigma) if isinstance(sigma, float) else sigma
    fv, fu = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None]
    kernel = np.exp(-2 * np.pi**2 * ((down * fv) ** 2 + (across * fu) ** 2)).astype(np.float32)
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(size, dtype=np.float32)) * kernel, size)
    return np.asarray(noise / noise.std(), dtype=np.float64)


def _white(rng: np.random.Generator) -> NDArray[np.float64]:
    return rng.standard_normal((TILE, TILE))


def _carpet(rng: np.random.Generator) -> Floats:
    """Loops in rows of 6 mm, flecked yarn."""
    v, u = np.mgrid[0:TILE, 0:TILE]
    loops = 0.5 * np.sin(2 * np.pi * u / 4) * np.sin(2 * np.pi * (v + 2 * ((u // 4) % 2)) / 4)
    yarn = 0.6 * _white(rng) + 0.5 * _smooth(rng, (TILE, TILE), (0.5, 4.0))
    return np.asarray(0.20 * np.exp(0.22 * (loops + yarn) + 0.08 * _smooth(rng, (TILE, TILE), 40.0)))


def _wood(rng: np.random.Generator) -> Floats:
    """Planks of 128 mm by 1.02 m, each with a shade and grain of its own, staggered, with dark seams."""
    tile = np.empty((TILE, TILE))
    height, length = 64, 512
    for row in range(TILE // height):
        start = int(rng.integers(TILE))
        band = np.empty((height, TILE))
        for plank in range(TILE // length):
            grain = 0.10 * _smooth(rng, (height, length), (0.8, 60.0)) + 0.06 * _smooth(
                rng, (height, length), (4.0, 150.0)
            )
            board = 0.30 * np.exp(0.14 * rng.standard_normal() + grain + 0.03 * rng.standard_normal((height, length)))
            board[:, :1] *= 0.3  # the seams
            board[:1] *= 0.35
            band[:, plank * length : (plank + 1) * length] = board
        tile[row * height : (row + 1) * height] = np.roll(band, start, axis=1)
    return tile


def _concrete(rng: np.random.Generator) -> Floats:
    """Cloudy cement with pores and a few hair cracks."""
    size = (TILE, TILE)
    clouds = 0.08 * _smooth(rng, size, 60.0) + 0.05 * _smooth(rng, size, 12.0) + 0.05 * _smooth(rng, size, 1.5)
    tile = 0.36 * np.exp(clouds + 0.04 * _white(rng))
    tile[_smooth(rng, size, 1.0) > 3.2] *= 0.5
    ridges = np.abs(_smooth(rng, size, 40.0))
    cracks = (ridges < 0.012) & (_smooth(rng, size, 90.0) > 0.9)
    tile[cracks] *= 0.55
    return np.asarray(tile)


def _tiles(rng: np.random.Generator) -> Floats:
    """Tiles of 256 mm with 6 mm joints."""
    size, pitch = (TILE, TILE), 128
    shades = np.kron(0.06 * rng.standard_normal((TILE // pitch, TILE // pitch)), np.ones((pitch, pitch)))
    tile = 0.45 * np.exp(shades + 0.04 * _smooth(rng, size, 10.0) + 0.03 * _smooth(rng, size, 1.2) + 0.02 * _white(rng))
    joint = np.arange(TILE) % pitch < 3
    joints = joint[:, None] | joint[None]
    tile[joints] = 0.22 * np.exp(0.1 * _white(rng)[joints])
    return np.asarray(tile)


def _asphalt(rng: np.random.Generator) -> Floats:
    """Gravel grains of 4 to 12 mm in dark bitumen, some of them bright."""
    size = (TILE, TILE)
    coarse, fine = _smooth(rng, size, 2.2), _smooth(rng, size, 1.1)
    tile = 0.075 * np.exp(0.15 * _smooth(rng, size, 50.0) + 0.15 * _white(rng))
    tile[fine > 0.9] *= 1.6
    tile[coarse > 1.0] *= 2.0
    tile[(coarse > 1.9) | (fine > 2.6)] *= 1.7
    tile[(coarse < -1.6)] *= 0.6
    return np.asarray(tile * 1.2)
