"""Image patches around known lights at full resolution: every flash they are seen to make refines their positions."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .blink import kernels
from .pattern import FlashPattern
from .spot import Spot, fit_spot, light_table

Floats = NDArray[np.float64]

KEPT_BYTES = 12 << 20  # of patches: half a minute of sixty lights
SIZE = 15  # px; a light of sigma 2 px with room for the constant around it
_WHITE = 250  # grey level from which a pixel counts as clipped
_HIDDEN = 0.12  # relative change of the patch's border that says somebody stands before it


@dataclass(slots=True, eq=False)
class _Place:
    row: int
    column: int
    numerator: Floats = field(default_factory=lambda: np.zeros((SIZE, SIZE)))
    squares: Floats = field(default_factory=lambda: np.zeros((SIZE, SIZE)))
    clipped: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((SIZE, SIZE), bool))
    weight: float = 0.0
    dof: int = 0


class PatchRecorder:
    """Keeps patches of the latest frames (KEPT_BYTES) until `forget`.

    `grow` turns those of one flash into a better amplitude image.
    """

    def __init__(self, pattern: FlashPattern, exposure: float, gamma: float) -> None:
        self._pattern = pattern
        self._exposure = exposure
        self._light = light_table(gamma, 256)
        self._places: list[_Place] = []
        self._corners = np.zeros((2, 0), np.intp)  # first row and column of each place
        self._times: deque[float] = deque()
        self._patches: deque[NDArray[np.uint8]] = deque()
        self.kept_bytes = 0

    def add(self, u: float, v: float, shape: tuple[int, ...]) -> None:
        """Begin to record around pixel (u, v) of images of this shape (H, W)."""
        half = SIZE // 2
        row = int(np.clip(round(v) - half, 0, shape[0] - SIZE))
        column = int(np.clip(round(u) - half, 0, shape[1] - SIZE))
        self._places.append(_Place(row, column))
        self._corners = np.array(
            [[place.row for place in self._places], [place.column for place in self._places]], np.intp
        )

    def record(self, image: NDArray[np.uint8], t: float) -> None:
        """Keep the patches of one frame."""
        if not self._places:
            return
        patches = np.empty((len(self._places), SIZE, SIZE), np.uint8)
        kernels.cut_patches(np.ascontiguousarray(image), self._corners[0], self._corners[1], patches)
        self._times.append(t)
        self._patches.append(patches)
        self.kept_bytes += patches.nbytes
        while self.kept_bytes > KEPT_BYTES:
            self._times.popleft()
            self.kept_bytes -= self._patches.popleft().nbytes

    def forget(self) -> None:
        """Drop the recorded frames; what `grow` made of them stays."""
        self._times.clear()
        self._patches.clear()
        self.kept_bytes = 0

    def grow(self, index: int, start: float, periods: int) -> None:
        """Add the flash of place `index` that began at `start` to its amplitude image.

        Notes
        -----
        Per pixel the regression of linear light on the pattern, over the flash and half a period before and after
        it; frames in which the patch's border changed are left out, because somebody stood before the light.
        """
        place = self._places[index]
        period = self._pattern.period
        chosen = [
            (t, patches[index])
            for t, patches in zip(self._times, self._patches, strict=True)
            if -0.5 * period <= t - start <= (periods + 0.3) * period and len(patches) > index
        ]
        if len(chosen) < 8:
            return
        grey = np.stack([patch for _, patch in chosen])
        border = np.concatenate([grey[:, 0], grey[:, -1], grey[:, :, 0], grey[:, :, -1]], axis=1).mean(axis=1)
        usual = float(np.median(border))
        clear = np.abs(border - usual) <= _HIDDEN * usual + 1.0
        times = np.array([t for t, _ in chosen])[clear]
        pattern = self._pattern.coverage(times - start, self._exposure, periods)
        wave = pattern - pattern.mean()
        weight = float(wave @ wave)
        if weight < 1.0:
            return
        light = self._light[grey[clear]].astype(float)
        numerator = np.tensordot(wave, light, 1)
        place.numerator += numerator
        place.squares += ((light - light.mean(axis=0)) ** 2).sum(axis=0) - numerator**2 / weight
        place.clipped |= (grey[clear] >= _WHITE).any(axis=0)
        place.weight += weight
        place.dof += len(times) - 2

    def spot(self, index: int) -> Spot | None:
        """The light of place `index` in image pixels, from all flashes so far; None if there is none to fit."""
        place = self._places[index]
        if place.dof < 8:
            return None
        variance = place.squares / place.dof / place.weight
        variance = np.maximum(variance, 0.1 * float(np.median(variance)) + 1e-9)
        spot = fit_spot(place.numerator / place.weight, variance, ~place.clipped)
        if spot is None:
            return None
        return Spot(spot.u + place.column, spot.v + place.row, spot.covariance, spot.peak, spot.width)
