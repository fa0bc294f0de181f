"""Where brightness alternates in the pattern's rhythm: the flash detector's cheap look at every place.

With D(t) the change of an aperture over a lag of half a flash interval, -D(t) D(t - lag) is added up in blocks of
frames, of which those of the last seconds count. Places that stand out of their neighbourhood are worth a closer look.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from .flash_memory import BEFORE
from .shake import Shake

try:
    from . import _blink as kernels
except ImportError:  # built without extensions
    from . import blink_reference as kernels  # type: ignore[no-redef]

Singles = NDArray[np.float32]
Indices = NDArray[np.intp]

BLOCK = 32  # frames whose alternation fits into 16 bits: 32 * kernels.LIMIT^2 < 2^15
WATCHED = 256  # places that are worth keeping an eye on
_STEPS = 16384.0  # of a pixel, in which the kernel takes moves
_LOW, _HIGH = 4.0, 375  # a block's alternation counts no further than so many typical ones below, and this above
_CLEAR = 1.8  # limits from which a place is clear enough to be examined at every decision
_FAINT = 0.6  # limits from which a place is watched
_STAYS = 1.15  # by which a place that is watched is preferred to its neighbours
_SLOPE = 0.1  # of the mean around a place, that is added to find its middle
_FORGET = 0.8  # of a place's refusals, from one decision to the next
_TILE = (24, 32)  # cells over which the false alarm rate is held constant
_SEPARATION = 3  # cells around a known light that are no places of their own


class Alternation:
    """Alternation of every aperture of 2x2 cells, by its first cell.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of cells.
    depth : int
        Frames within a lag, at most.
    minimum : float
        Standard deviations above its neighbourhood from which a place stands out.
    """

    def __init__(self, shape: tuple[int, int], depth: int, minimum: float) -> None:
        self.shape = shape
        self.depth = depth
        self.frames = 0  # in the block that has not ended
        self._minimum = minimum
        self._differences = np.zeros((depth, *shape), np.int8)
        self._block = np.zeros(shape, np.int16)
        self._blocks: deque[tuple[int, NDArray[np.int16], int]] = deque()  # frames, sums, lower limit
        self._refused = np.zeros(shape, np.float32)  # how often a place was examined in vain, of late
        self._watched: Indices = np.zeros(0, np.intp)
        self._scratch = np.zeros((3, *shape), np.float32)  # because fresh memory costs more than what is done with it

    def add(
        self,
        number: int,
        cells: NDArray[np.uint8],
        lagged: tuple[int, NDArray[np.uint8]] | None,
        move: NDArray[np.float64],
        shake: Shake,
    ) -> None:
        """Add a frame.

        Parameters
        ----------
        number, cells
            Of the frame, counted from 0; as of `kernels.sum_cells`.
        lagged
            The same of the frame one lag ago; None if there is none to compare with.
        move : (2,) array
            By how much the picture has moved since then, u and v in px, less than 2.
        shake : Shake
            Knows what that does to each aperture.
        """
        difference = self._differences[number % self.depth]
        if lagged is None:
            difference[:] = 0
        else:
            right, down = np.rint(_STEPS * move).astype(int)
            kernels.accumulate(
                cells,
                lagged[1],
                shake.down,
                shake.right,
                down,
                right,
                difference,
                self._differences[lagged[0] % self.depth],
                self._block,
                BEFORE,
            )
        self.frames += 1

    def end_block(self, most: float) -> None:
        """Begin a new block; of the oldest ones those are forgotten that hold more than `most` frames together."""
        # because who passes by weighs more in one block than a label in all others
        usual = float(np.median(np.abs(self._block[1::4, 1::4]))) + 1.0
        self._blocks.append((self.frames, self._block, -int(min(_LOW * usual, _HIGH))))
        free = None
        while self._counted() > most:
            _, free, _ = self._blocks.popleft()
        if free is None:
            self._block = np.zeros(self.shape, np.int16)
        else:
            self._block = free
            self._block[:] = 0
        self.frames = 0

    @property
    def is_ready(self) -> bool:
        """Whether a block has ended, so that there are candidates."""
        return bool(self._blocks)

    def energy(self) -> Singles:
        """Alternation of each aperture of late."""
        total, clipped = np.zeros((2, *self.shape), np.float32)
        self._sum(total, clipped)
        return np.asarray(np.maximum(total + self._block, 0.0))

    def candidates(self, known: Iterable[tuple[int, int]], most: int) -> tuple[Indices, int]:
        """Places that stand out, away from `known` ones.

        Returns
        -------
        places : (N,) intp array
            Flat indices of apertures, those to be examined first; the others may stand out more later.
        examined : int
            How many are to be examined, at most `most`.
        """
        total, clipped, strength = self._scratch
        self._sum(total, clipped)
        np.maximum(total, clipped, out=strength)
        self._divide(total)
        self._divide(clipped)
        over = np.maximum(total, clipped, out=total)
        over[-1] = over[:, -1] = 0.0
        over.ravel()[self._watched] *= _STAYS
        for row, column in known:
            top, left = max(row - _SEPARATION, 0), max(column - _SEPARATION, 0)
            over[top : row + _SEPARATION + 1, left : column + _SEPARATION + 1] = 0.0
        # because in a camera that shakes whole edges alternate, and far more strongly than a label, which is small
        np.maximum(strength, 1.0, out=strength)
        turn: Singles = clipped
        cv2.blur(strength, (3, 3), turn)
        cv2.blur(strength, (11, 11), strength)
        turn /= strength
        np.square(np.add(self._refused, 1.0, out=strength), out=strength)
        turn /= strength
        clear = self._peaks(np.multiply(turn, over > _CLEAR, out=strength), 2 * most // 3)
        # what is weaker, or found no room among the strong, has its turn before what was examined in vain
        turn *= over
        turn += 1.0
        np.copyto(over, turn, where=over > 1.0)
        over.ravel()[clear] = 0.0
        others = self._peaks(over, max(WATCHED, most) - len(clear), _FAINT)
        examined = len(clear) + int(np.count_nonzero(over.ravel()[others] > 1.0))
        return np.concatenate([clear, others]), min(examined, most)

    def watch(self, places: Indices) -> None:
        """Prefer these places to their neighbours from now on."""
        self._watched = places

    def refuse(self, rows: Indices, columns: Indices) -> None:
        """Note that these places were examined in vain, and forget a little of what was noted before."""
        self._refused *= _FORGET
        self._refused[rows, columns] += 1.0

    def refuse_around(self, row: int, column: int, times: float) -> None:
        """Note that a place and its neighbours were examined in vain so many times."""
        self._refused[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = times

    def _counted(self) -> int:
        return sum(block[0] for block in self._blocks)

    def _sum(self, total: Singles, clipped: Singles) -> None:
        """Sum of the blocks, and the same with each limited."""
        total[:] = clipped[:] = 0.0
        for _, block, low in self._blocks:
            kernels.add_block(block, low, _HIGH, total, clipped)

    @staticmethod
    def _peaks(image: Singles, most: int, least: float = 0.0) -> Indices:
        """Flat indices of the highest local maxima, highest first."""
        # because a strong light's alternation is limited, and as high all over it
        sloped = cv2.addWeighted(image, 1.0, cv2.blur(image, (5, 5)), _SLOPE, 0.0)
        peaks = np.flatnonzero((image > least) & (sloped >= cv2.dilate(sloped, np.ones((3, 3), np.uint8))))
        return peaks[np.argsort(-image.ravel()[peaks], kind="stable")][:most]

    def _divide(self, total: Singles) -> None:
        """Divide the alternation of every aperture by what it must pass: its tile's median and so many spreads more."""
        height, width = total.shape
        tiles = max(1, height // _TILE[0]), max(1, width // _TILE[1])
        size = height // tiles[0], width // tiles[1]
        blocks = total[: tiles[0] * size[0], : tiles[1] * size[1]].reshape(tiles[0], size[0], tiles[1], size[1])
        sample = blocks[:, 1::4, :, 1::4].transpose(0, 2, 1, 3).reshape(*tiles, -1)
        half = sample.shape[2] // 2
        middle = np.partition(sample, half, axis=2)[:, :, half]
        deviation = np.partition(np.abs(sample - middle[:, :, None]), half, axis=2)[:, :, half]
        spread = 1.48 * deviation + 0.5 * np.sqrt(self._counted())
        limit = (middle + self._minimum * spread).astype(np.float32)
        of_column = np.minimum(np.arange(width) // size[1], tiles[1] - 1)
        for k, row in enumerate(limit):
            last = height if k == tiles[0] - 1 else (k + 1) * size[0]
            total[k * size[0] : last] /= row[of_column]
