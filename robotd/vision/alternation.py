"""Where brightness alternates in the pattern's rhythm: the flash detector's cheap look at every place.

With D(t) the change of an aperture over a lag of half a flash interval, -D(t) D(t - lag) is added up in blocks of
frames, of which those of the last seconds count. Places that stand out of their neighbourhood are worth a closer look.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

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
_SPREAD = 15  # steps in which a block's spread is kept
_LOW, _HIGH = -4 * _SPREAD, 8 * _SPREAD  # that a place counts for in one block, at most
_FAINT = 0.6  # limits from which a place is watched
_QUIET = 0.8  # of the spread in most tiles: what is white does not even change by noise
_BACKGROUND = 0.3  # limits: places that stand out less are all alike to what stands out
_STAYS = 1.15  # by which a place that is watched is preferred to its neighbours
_SLOPE = 0.1  # of the mean around a place, that is added to find its middle
_FORGET, _FORGOTTEN = 0.8, 0.05  # of a place's refusals, from one decision to the next; and so few are none
_TILE = (24, 32)  # cells over which the false alarm rate is held constant
_SEPARATION = 3  # cells around a known light that are no places of their own


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """How far every place stood out in some frames, in steps; `rate` (R, w) is one over each tile's spread."""

    frames: int
    rated: NDArray[np.int8]
    rate: Singles


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
        self._blocks: deque[_Block] = deque()
        self._refused: dict[int, float] = {}  # how often places, by their flat index, were examined in vain of late
        self._watched: Indices = np.zeros(0, np.intp)
        self._scratch = np.zeros((2, *shape), np.float32)  # because fresh memory costs more than what is done with it

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
        middle, rate = self._usual(self._block)
        rated = None
        while self._counted() + self.frames > most and self._blocks:
            rated = self._blocks.popleft().rated
        rated = np.empty(self.shape, np.int8) if rated is None else rated
        kernels.rate_block(self._block, middle, _SPREAD * rate, _LOW, _HIGH, rated)
        self._blocks.append(_Block(self.frames, rated, rate))
        self._block[:] = 0
        self.frames = 0

    @property
    def is_ready(self) -> bool:
        """Whether a block has ended, so that there are candidates."""
        return bool(self._blocks)

    def standing_out(self) -> Singles:
        """How far every place stands out of late, in limits from which on it is examined."""
        over = np.zeros(self.shape, np.float32)
        self._sum(over)
        return over

    def candidates(self, known: Iterable[tuple[int, int]], most: int) -> tuple[Indices, int]:
        """Places that stand out, away from `known` ones.

        Returns
        -------
        places : (N,) intp array
            Flat indices of apertures, those to be examined first; the others may stand out more later.
        examined : int
            How many are to be examined, at most `most`.
        """
        over, turn = self._scratch
        self._sum(over)
        # because in a camera that shakes whole edges alternate, and far more strongly than a label, which is small
        np.maximum(over, _BACKGROUND, out=turn)
        around = cv2.blur(turn, (11, 11))
        cv2.blur(turn, (3, 3), turn)
        turn /= around
        del around
        refused = np.fromiter(self._refused, np.intp, len(self._refused))
        turn.ravel()[refused] /= (np.fromiter(self._refused.values(), np.float32, len(refused)) + 1.0) ** 2
        over[-1] = over[:, -1] = 0.0
        over.ravel()[self._watched] *= _STAYS
        for row, column in known:
            top, left = max(row - _SEPARATION, 0), max(column - _SEPARATION, 0)
            over[top : row + _SEPARATION + 1, left : column + _SEPARATION + 1] = 0.0
        turn += 1.0
        np.copyto(over, turn, where=over > 1.0)  # what stands out less is watched, after what is to be examined
        places = self._peaks(over, max(WATCHED, most), _FAINT, turn)
        return places, min(int(np.count_nonzero(over.ravel()[places] > 1.0)), most)

    def watch(self, places: Indices) -> None:
        """Prefer these places to their neighbours from now on."""
        self._watched = places

    def refuse(self, rows: Indices, columns: Indices) -> None:
        """Note that these places were examined in vain, and forget a little of what was noted before."""
        self._refused = {place: _FORGET * times for place, times in self._refused.items() if times > _FORGOTTEN}
        for place in (rows * self.shape[1] + columns).tolist():
            self._refused[place] = self._refused.get(place, 0.0) + 1.0

    def refuse_around(self, row: int, column: int, times: float) -> None:
        """Note that a place and its neighbours were examined in vain so many times."""
        for r in range(max(row - 1, 0), min(row + 2, self.shape[0])):
            for c in range(max(column - 1, 0), min(column + 2, self.shape[1])):
                self._refused[r * self.shape[1] + c] = times

    def _counted(self) -> int:
        return sum(block.frames for block in self._blocks)

    def _sum(self, total: Singles) -> None:
        """How far every place stands out, in limits, into `total`.

        Who passes by makes a block loud where he passes: it counts by what it can tell, as of independent measurements.
        """
        total[:] = 0.0
        rates = np.stack([block.rate for block in self._blocks])
        weights = rates / (_SPREAD * self._minimum * np.sqrt((rates**2).sum(axis=0)))
        for block, weight in zip(self._blocks, weights, strict=True):
            kernels.add_block(block.rated, weight, total)

    @staticmethod
    def _peaks(image: Singles, most: int, least: float, scratch: Singles) -> Indices:
        """Flat indices of the highest local maxima, highest first."""
        # because a strong light's alternation is limited, and as high all over it
        sloped = cv2.blur(image, (5, 5), scratch)
        cv2.addWeighted(image, 1.0, sloped, _SLOPE, 0.0, sloped)
        peaks = np.flatnonzero((image > least) & (sloped >= cv2.dilate(sloped, np.ones((3, 3), np.uint8))))
        heights = image.ravel()[peaks]
        if len(peaks) > most:  # because sorting them all costs more than choosing
            high = np.sort(np.argpartition(-heights, most)[:most])
            peaks, heights = peaks[high], heights[high]
        return np.asarray(peaks[np.argsort(-heights, kind="stable")])

    def _usual(self, sums: NDArray[np.int16]) -> tuple[Singles, Singles]:
        """Median of each tile, and one over the spread about it, for every tile row and column (R, w)."""
        height, width = sums.shape
        tiles = max(1, height // _TILE[0]), max(1, width // _TILE[1])
        size = height // tiles[0], width // tiles[1]
        blocks = sums[: tiles[0] * size[0], : tiles[1] * size[1]].reshape(tiles[0], size[0], tiles[1], size[1])
        sample = blocks[:, 1::4, :, 1::4].transpose(0, 2, 1, 3).reshape(*tiles, -1)
        half = sample.shape[2] // 2
        middle = np.partition(sample, half, axis=2)[:, :, half].astype(np.float32)
        deviation = np.partition(np.abs(sample - middle[:, :, None]), half, axis=2)[:, :, half]
        spread = 1.48 * deviation + 0.5 * np.sqrt(np.float32(self.frames))
        rate = 1.0 / np.maximum(spread, _QUIET * np.median(spread))
        of_column = np.minimum(np.arange(width) // size[1], tiles[1] - 1)
        return np.ascontiguousarray(middle[:, of_column]), np.ascontiguousarray(rate[:, of_column], np.float32)
