"""A light that was accepted: what is known of its light, and the image of its amplitude, which grows with every period.

The image holds per cell the regression of linear light on the pattern, over the frames that show the light and less
what lamps and the shift of the picture explain; its spot is fitted when asked for.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .flash_memory import BEFORE
from .matching import Cleared
from .pattern import Look
from .spot import Spot, fit_spot, grey_mean_bias

Floats = NDArray[np.float64]

_WHITE = 246  # grey level of four pixels, from which on noise alone makes some white
_LEAST_VARIANCE = 1e-3  # of linear light in a cell, that of a tenth of a grey level in the dark
_BIASED, _ROUNDS = 0.5, 3  # standard deviations of a cell from which on its bias is taken off, so many times at most
_LOOKS = 14  # kept, of one window each


@dataclass(slots=True, eq=False)
class Track:
    """A light that was accepted: the aperture's first cell, its light curve's best match and its growing image."""

    row: int
    column: int
    score: float
    start: float  # of the best match, seconds
    light: float  # summed linear light over the aperture when on
    variance: float  # of the light curve about the match
    last: float = -np.inf  # time up to which frames are in the sums
    numerator: Floats = field(default_factory=lambda: np.zeros((8, 8)))
    squares: Floats = field(default_factory=lambda: np.zeros((8, 8)))
    weight: float = 0.0  # energy of the pattern in units of the noise
    dof: int = 0
    clipped: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((8, 8), bool))
    base: Floats = field(default_factory=lambda: np.zeros((8, 8)))  # light of each cell between the flashes
    looks: deque[Look] = field(default_factory=lambda: deque(maxlen=_LOOKS))
    shift: Floats = field(default_factory=lambda: np.zeros(2))  # of the picture while the light was on, weighted
    spot: Spot | None = None
    fitted: float = -1.0

    def add(self, cells: NDArray[np.uint8], light: NDArray[np.float32], rest: Cleared, t: float) -> None:
        """Add M frames that show the light.

        Parameters
        ----------
        cells : (M, 8, 8) uint8 array
            Around the aperture.
        light : (256,) array
            Linear light of every grey level.
        rest : Cleared
            The frames, and what they are regressed on.
        t : float
            Time up to which frames are in the sums now.
        """
        values = light[cells].astype(float) / rest.lamps[:, None, None]
        numerator = np.tensordot(rest.wave, values, 1)
        explained = np.tensordot(rest.basis, values, 1)
        left = (values**2).sum(axis=0) - (explained**2).sum(axis=0) - numerator**2 / rest.weight
        dof = max(len(values) - 1 - len(rest.basis), 1)
        # frames between which the light changed, or that somebody crossed, count the less
        worth = 1.0 / max(float(np.median(left)) / dof, _LEAST_VARIANCE)
        self.numerator += worth * numerator
        self.squares += worth * left
        self.weight += worth * rest.weight
        self.dof += dof
        self.clipped |= cells[rest.wave > 0.5 * rest.wave.max()].mean(axis=0) >= _WHITE
        self.base = values.mean(axis=0) + numerator / rest.weight * rest.wave.min()
        self.shift += worth * rest.weight * rest.shift
        self.last = t
        if rest.look is not None:
            self.looks.append(rest.look)

    def fit(self, shape: tuple[int, int], gamma: float) -> Spot | None:
        """Where the light is, in pixels of the mean picture while it was on; None if its image has no spot.

        Parameters
        ----------
        shape : (int, int)
            Rows and columns of cells in the picture; what is beyond its border does not count.
        gamma : float
            grey = light^(1/gamma).
        """
        variance = self.squares / max(self.dof, 1) / max(self.weight, 1e-9)
        variance = np.maximum(variance, 0.1 * float(np.median(variance)) + 1e-9)
        top, left = max(0, BEFORE - self.row), max(0, BEFORE - self.column)
        inside = np.s_[top : shape[0] + BEFORE - self.row, left : shape[1] + BEFORE - self.column]
        image = self.numerator / max(self.weight, 1e-9)
        middle = 2.0 * (BEFORE - left) + 1.5, 2.0 * (BEFORE - top) + 1.5
        image, variance, valid = image[inside], variance[inside], ~self.clipped[inside]
        spot = fit_spot(image, variance, valid, pitch=2, start=middle)
        if spot is None:
            return None
        taken = np.zeros_like(image)
        for _ in range(_ROUNDS):
            bias = grey_mean_bias(spot, self.base[inside], gamma, pitch=2)
            if ((bias - taken) ** 2 / variance).max() <= _BIASED**2:
                break
            spot = fit_spot(image - bias, variance, valid, pitch=2, start=(spot.u, spot.v)) or spot
            taken = bias
        shift = self.shift / max(self.weight, 1e-9)
        return spot.moved(2.0 * (self.column - BEFORE + left) - shift[0], 2.0 * (self.row - BEFORE + top) - shift[1])
