"""What the flash detector remembers: whole pictures for a second or two, and for longer the light curves of places.

A picture has a byte for every cell of 2x2 pixels, a light curve eight bytes a frame. So the pictures serve to take a
place's light curve from when it first catches the eye, and some hundred places have theirs kept on from there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .spot import light_table

try:
    from . import _blink as kernels
except ImportError:  # built without extensions
    from . import blink_reference as kernels  # type: ignore[no-redef]

Bytes = NDArray[np.uint8]
Singles = NDArray[np.float32]
Indices = NDArray[np.intp]

BEFORE, AFTER = 3, 5  # cells around an aperture's first one that its ring needs: 8x8 in all
FRAMES = 96  # of a light curve
PICTURES = 60  # kept: 4.9 MB of 640x480 pixels, two seconds at 30 frames a second


class FlashMemory:
    """Pictures and light curves of one camera.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of cells.
    pictures : int
        Kept, at most FRAMES.
    gamma : float
        grey = light^(1/gamma).
    """

    def __init__(self, shape: tuple[int, int], pictures: int, gamma: float) -> None:
        self.depth = pictures
        self.light = light_table(gamma, 256)  # of every grey level
        self._columns = shape[1]
        self._pictures = np.zeros((pictures, shape[0] + BEFORE + AFTER, shape[1] + BEFORE + AFTER), np.uint8)
        self._places: Indices = np.zeros(0, np.intp)  # flat index of each aperture's first cell, sorted
        self._since: Indices = np.zeros(0, np.intp)  # number of the first frame that each curve has
        self._values = np.zeros((0, FRAMES), np.float32)
        self._levels = np.zeros((0, FRAMES), np.float32)
        self._count = 0  # frames taken,
        self._done = 0  # of which the curves have so many

    def take(self, image: Bytes) -> Bytes:
        """Take a picture (H, W); returns its cells, as of `kernels.sum_cells`."""
        if self._count - self._done == self.depth:
            self._catch_up()  # before the oldest picture is overwritten
        cells = self.cells(self._count)
        kernels.sum_cells(image, cells, BEFORE, AFTER)
        self._count += 1
        return cells

    def cells(self, number: int) -> Bytes:
        """Cells of one of the latest `depth` frames, by its number."""
        return np.asarray(self._pictures[number % self.depth])

    def has(self, numbers: Indices) -> NDArray[np.bool_]:
        """Of which frames the whole pictures are there."""
        return np.asarray(numbers >= self._count - self.depth)

    def patches(self, numbers: Indices, row: int, column: int) -> Bytes:
        """Cells (F, 8, 8) around the aperture whose first cell is given."""
        window = np.s_[row : row + BEFORE + AFTER, column : column + BEFORE + AFTER]
        return np.asarray(self._pictures[(numbers % self.depth, *window)])

    def watch(self, rows: Indices, columns: Indices) -> None:
        """Keep the light curves of these places on, and of no others."""
        self._catch_up()
        places = np.unique(rows * self._columns + columns)
        old, known = self._find(places)
        values = np.zeros((len(places), FRAMES), np.float32)
        levels = np.zeros_like(values)
        since = np.full(len(places), max(0, self._count - self.depth), np.intp)
        values[known], levels[known], since[known] = self._values[old], self._levels[old], self._since[old]
        fresh = np.flatnonzero(~known)
        numbers = np.arange(since[fresh[0]] if len(fresh) else self._count, self._count)
        slots = numbers % FRAMES
        curves = self._measured(numbers, places[fresh])
        values[fresh[:, None], slots], levels[fresh[:, None], slots] = curves
        self._places, self._since, self._values, self._levels = places, since, values, levels

    def move(self, row: int, column: int, to_row: int, to_column: int) -> None:
        """Watch one more aperture, on the light that a watched one shows off its centre.

        What the new one would have shown of frames whose pictures are gone is taken from the old one's light curve,
        scaled so that both have the same mean and spread over the frames whose pictures are there.
        """
        self._catch_up()
        place = np.array([to_row * self._columns + to_column])
        slot, known = self._find(np.array([row * self._columns + column]))
        if self._find(place)[1][0] or not known[0]:
            return
        (k,) = slot
        recent = np.arange(max(self._since[k], self._count - self.depth, 0), self._count)
        older = np.arange(max(self._since[k], self._count - FRAMES), recent[0]) % FRAMES
        at = int(np.searchsorted(self._places, place[0]))
        curves = []
        for all_curves, measured in zip((self._values, self._levels), self._measured(recent, place), strict=True):
            own, shown = all_curves[k], all_curves[k, recent % FRAMES]
            curve = np.zeros(FRAMES, np.float32)
            curve[recent % FRAMES] = measured[0]
            scale = measured[0].std() / max(float(shown.std()), 1e-6)
            curve[older] = measured[0].mean() + scale * (own[older] - shown.mean())
            curves.append(np.insert(all_curves, at, curve, axis=0))
        self._places = np.insert(self._places, at, place[0])
        self._since = np.insert(self._since, at, self._since[k])
        self._values, self._levels = curves

    def curves(self, numbers: Indices, rows: Indices, columns: Indices) -> tuple[Singles, Singles, NDArray[np.bool_]]:
        """Light curves of N apertures in F of the latest FRAMES frames.

        Returns
        -------
        values, levels : (N, F) float32 arrays
            As of `kernels.aperture_series`.
        known : (N, F) bool array
            Of other frames both are copies of later ones.
        """
        self._catch_up()
        places = rows * self._columns + columns
        slots, watched = self._find(places)
        values, levels = np.zeros((2, len(places), len(numbers)), np.float32)
        known = np.zeros(values.shape, bool)
        at = numbers % FRAMES
        values[watched], levels[watched] = self._values[slots[:, None], at], self._levels[slots[:, None], at]
        known[watched] = numbers >= self._since[slots, None]
        here = self.has(numbers)
        others = np.flatnonzero(~watched)
        if len(others) and here.any():
            chosen = np.ix_(others, np.flatnonzero(here))
            values[chosen], levels[chosen] = self._measured(numbers[here], places[others])
            known[others] = here
        first = np.argmax(known, axis=1)
        for begin in np.unique(first[first > 0]):
            filled = np.ix_(first == begin, np.arange(begin))
            copied = np.ix_(first == begin, np.resize(np.arange(begin, len(numbers)), begin))
            values[filled], levels[filled] = values[copied], levels[copied]
        return values, levels, known

    def _catch_up(self) -> None:
        """Go on with the light curves of the places that are watched."""
        numbers = np.arange(max(self._done, self._count - self.depth), self._count)
        if len(numbers) and len(self._places):
            slots = numbers % FRAMES
            self._values[:, slots], self._levels[:, slots] = self._measured(numbers, self._places)
        self._done = self._count

    def _find(self, places: Indices) -> tuple[Indices, NDArray[np.bool_]]:
        """Curves of the places that are watched, and which those are."""
        at = np.minimum(np.searchsorted(self._places, places), max(len(self._places) - 1, 0))
        known = self._places[at] == places if len(self._places) else np.zeros(len(places), bool)
        return at[known], known

    def _measured(self, numbers: Indices, places: Indices) -> tuple[Singles, Singles]:
        """Values and levels (N, F) of frames whose pictures are there."""
        values, levels = np.empty((2, len(places), len(numbers)), np.float32)
        if values.size:
            rows, columns = np.divmod(places, self._columns)
            order = numbers % self.depth
            kernels.aperture_series(self._pictures, order, rows + BEFORE, columns + BEFORE, self.light, values, levels)
        return values, levels
