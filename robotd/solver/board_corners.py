"""Corners of chessboards and ChArUco boards in pictures, and which board it is where it is not the one asked for.

A wide lens shows a board small and bent, so markers are sought in the enlarged picture as well, and a corner counts
that has one marker beside it. Such a corner may be found in the wrong place: each must lie where its neighbours on the
board expect it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .calibrate_floor import Board, find_board

Bytes = NDArray[np.uint8]
Corners = tuple[Floats, Floats]  # (N, 3) on the board in metres, z 0 and y down; (N, 2) pixels
LEAST_CORNERS = 8  # of a ChArUco board in a picture
LEAST_MARKERS = 4  # in a picture, from which it shows a board of that dictionary
SMALLEST = (3, 3)  # inner corners of a board that is recognised
_WINDOW = 0.3  # of the smallest square: half the side of the window in which a corner is refined
_ENLARGED = 2.0  # times: markers of 12 px are read in the picture enlarged, of 20 px without
_MOST_SIDE = 2000  # px of a picture that is enlarged: larger ones show markers large enough, and cost seconds
_AROUND = 2.3  # squares, within which corners tell where one between them lies
_STRAY = 0.5  # of a square that a corner may lie away from there: at a board's edge perspective makes a third
_LEAST_AROUND = 4
_TRIED = 4  # pictures from which it is told which board it is


class Finder(Protocol):
    """Finds one board in grey pictures."""

    def find(self, image: Bytes) -> Corners | None:
        """The corners seen in a picture; None if the board is not, or too little of it."""

    def explain(self, images: Sequence[Bytes]) -> str:
        """Which other board these pictures show, in which this one was not found; empty if none is recognised."""


class Chessboard:
    """A chessboard, of which all inner corners must be in view.

    Parameters
    ----------
    board : Board
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self._points = np.column_stack([board.corners * [1.0, -1.0], np.zeros(len(board.corners))])

    def find(self, image: Bytes) -> Corners | None:
        """All corners, refined; see `Finder`."""
        corners = find_board(image, self.board)
        return None if corners is None else (self._points, self._refined(image, corners))

    def _refined(self, image: Bytes, corners: Floats) -> Floats:
        """Corners where the grey levels around them turn: the detector's are off by 0.1 px on much tilted boards."""
        grid = corners.reshape(self.board.rows, self.board.columns, 2)
        apart = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
        half = max(2, int(_WINDOW * apart))
        start = corners.astype(np.float32).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
        refined = cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop)
        return np.asarray(refined, dtype=np.float64).reshape(-1, 2)

    def explain(self, images: Sequence[Bytes]) -> str:
        """The largest board that several pictures show; see `Finder`."""
        name, count = _other_dictionary(images[:2])
        if count >= LEAST_MARKERS:
            return f"others show a ChArUco board, with {count} markers of {name}: --charuco, --dictionary {name}?"
        sizes = _chessboards(images[: 2 * _TRIED])
        asked = (max(self.board.columns, self.board.rows), min(self.board.columns, self.board.rows))
        tried = min(len(images), 2 * _TRIED)
        # what is smaller is a part of the board, unless most pictures show the same
        often = [
            size
            for size, count in sizes.items()
            if size != asked and 2 * count >= (min(tried, 4) if max(np.subtract(size, asked)) > 0 else tried)
        ]
        if not often:
            return "all inner corners of a chessboard must be in view, with a white border around it"
        columns, rows = max(often, key=lambda size: (sizes[size], size[0] * size[1]))
        return (
            f"{sizes[columns, rows]} of {tried} others tried show {columns}x{rows} inner"
            f" corners, not {asked[0]}x{asked[1]}: --board {columns}x{rows}? (inner corners are one less than squares)"
        )


class Charuco:
    """A ChArUco board, of which a part may be in view.

    Parameters
    ----------
    columns, rows : int
        Squares.
    square, marker : float
        Sides in metres.
    dictionary : str
        Name of a dictionary of OpenCV's that has enough markers.
    """

    def __init__(self, columns: int, rows: int, square: float, marker: float, dictionary: str) -> None:
        self.columns, self.rows, self.square, self.marker, self.dictionary = columns, rows, square, marker, dictionary
        # boards printed before OpenCV 4.6 begin with the other colour, which shows where rows are even
        self._detectors = [self._detector(legacy) for legacy in ((False, True) if rows % 2 == 0 else (False,))]
        self._points = np.asarray(self._detectors[0].getBoard().getChessboardCorners(), dtype=np.float64)

    def _detector(self, legacy: bool) -> cv2.aruco.CharucoDetector:
        known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, known)
        board.setLegacyPattern(legacy)
        how = cv2.aruco.CharucoParameters()
        how.minMarkers = 1
        how.tryRefineMarkers = True
        return cv2.aruco.CharucoDetector(board, how)

    def find(self, image: Bytes) -> Corners | None:
        """All corners that agree with their neighbours; see `Finder`."""
        best: Corners | None = None
        for scale in (_ENLARGED, 1.0) if max(image.shape) <= _MOST_SIDE else (1.0,):
            large = image if scale == 1.0 else _enlarged(image, scale)
            for detector in self._detectors:
                corners, ids, _, _ = detector.detectBoard(large)
                if ids is None or len(ids) < LEAST_CORNERS or (best is not None and len(ids) <= len(best[0])):
                    continue
                there = self._points[np.asarray(ids).ravel()]
                pixels = (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
                kept = agreeing(there, pixels, self.square)
                if 2 * kept.sum() < len(kept) or kept.sum() < LEAST_CORNERS:
                    continue  # another board's corners
                there, pixels = there[kept], pixels[kept]
                flat = np.linalg.matrix_rank(there - there.mean(axis=0), 0.3 * self.square)
                if flat == 2 and (best is None or len(there) > len(best[0])):  # corners of one row say too little
                    best = there, pixels
            if best is not None and len(best[0]) == len(self._points):
                break
        return best

    def explain(self, images: Sequence[Bytes]) -> str:
        """The board, or the dictionary, under which these pictures show most; see `Finder`."""
        some = [_enlarged(one, _ENLARGED) if max(one.shape) <= _MOST_SIDE else one for one in images[:_TRIED]]
        markers = [_markers(image, self.dictionary) for image in some]
        if max(map(len, markers), default=0) < LEAST_MARKERS:
            name, count = _other_dictionary(images[:2])
            if count >= LEAST_MARKERS:
                return f"others show no markers of {self.dictionary}, but {count} of {name}: --dictionary {name}?"
            sizes = _chessboards(images[:_TRIED])
            if sizes:
                (columns, rows), _ = sizes.most_common(1)[0]
                return f"others show a chessboard without markers, {columns}x{rows} inner corners: --board?"
            return (
                f"others show no markers of {self.dictionary}; is the board near, sharp, lit, and --dictionary right?"
            )
        c, r = self.columns, self.rows
        near = {(c + i, r + j) for i in (-1, 0, 1) for j in (-1, 0, 1)} | {
            (r + i, c + j) for i in (-1, 0, 1) for j in (-1, 0, 1)
        }
        scores: dict[tuple[int, int], int] = {}
        for columns, rows in near - {(c, r)}:
            if min(columns, rows) >= 3 and columns * rows // 2 <= dictionary_size(self.dictionary):
                other = Charuco(columns, rows, self.square, self.marker, self.dictionary)
                found = [other.find(image) for image in images[:_TRIED]]
                scores[columns, rows] = sum(len(one[0]) for one in found if one is not None)
        best = max(scores.values(), default=0)
        if best >= LEAST_CORNERS * len(some) // 2:
            every = set[int]().union(*markers)
            # a board with a row too many shows the same corners: the markers say how many rows there are
            columns, rows = min(
                (size for size, score in scores.items() if 4 * score >= 3 * best),
                key=lambda size: len(every ^ set(range(size[0] * size[1] // 2))),
            )
            return (
                f"the markers lie as on a board of {columns}x{rows} squares, not {c}x{r}: --charuco {columns}x{rows}?"
                " (--charuco counts squares, across before down)"
            )
        return "others show markers, but not as they lie on that board; check --charuco COLSxROWS and --marker"


def dictionary_size(name: str) -> int:
    """Number of markers in one of OpenCV's dictionaries; 0 if there is none of that name."""
    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or not isinstance(number, int):
        return 0
    return len(cv2.aruco.getPredefinedDictionary(number).bytesList)


def agreeing(points: Floats, pixels: Floats, square: float) -> NDArray[np.bool_]:
    """Which corners of a board lie where the corners around them expect it.

    Parameters
    ----------
    points : (N, 3) array
        On the board, in metres.
    pixels : (N, 2) array
    square : float
        Side of a square in metres.

    Returns
    -------
    (N,) bool array
        The one that is farthest off is taken out first, since it misleads its neighbours. Corners with too few others
        around them are kept: nothing speaks against them.
    """
    kept = np.ones(len(points), dtype=np.bool_)
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < _AROUND * square
    np.fill_diagonal(near, False)
    off = np.array([_off(points, pixels, k, near[k], square) for k in range(len(points))])
    while off.max(initial=0.0) > _STRAY:
        worst = int(np.argmax(off))
        kept[worst], near[:, worst], off[worst] = False, False, 0.0
        for k in np.flatnonzero(near[worst] & kept).tolist():
            off[k] = _off(points, pixels, k, near[k], square)
    return kept


def _off(points: Floats, pixels: Floats, k: int, around: NDArray[np.bool_], square: float) -> float:
    """How far a corner is from where an affine map of those around it has it, in squares as seen there."""
    if np.count_nonzero(around) < _LEAST_AROUND:
        return 0.0
    flat = np.column_stack([points[around, :2] - points[k, :2], np.ones(np.count_nonzero(around))])
    affine, _, rank, _ = np.linalg.lstsq(flat, pixels[around], rcond=1e-6)
    if rank < 3:
        return 0.0
    seen = square * float(np.linalg.svd(affine[:2], compute_uv=False)[-1])
    return float(np.linalg.norm(affine[2] - pixels[k])) / max(seen, 1e-9)


def _chessboards(images: Sequence[Bytes]) -> Counter[tuple[int, int]]:
    """How many pictures show how many inner corners along the longer and the shorter side of what is seen."""
    sizes: Counter[tuple[int, int]] = Counter()
    for image in images:
        done, _, meta = cv2.findChessboardCornersSBWithMeta(image, SMALLEST, cv2.CALIB_CB_LARGER)
        if done and meta is not None:
            rows, columns = np.shape(meta)[:2]
            sizes[max(columns, rows), min(columns, rows)] += 1
    return sizes


def _enlarged(image: Bytes, scale: float) -> Bytes:
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def _markers(image: Bytes, dictionary: str) -> set[int]:
    """Numbers of the markers of a dictionary in a picture."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    _, ids, _ = cv2.aruco.ArucoDetector(known).detectMarkers(image)
    return set() if ids is None else {int(one) for one in np.asarray(ids).ravel()}


def _other_dictionary(images: Sequence[Bytes]) -> tuple[str, int]:
    """The dictionary of which pictures show most markers, and how many different ones.

    The larger dictionaries of a family begin with the smaller ones: the largest is tried, and the smallest named that
    has all numbers seen.
    """
    names = sorted((name for name in dir(cv2.aruco) if dictionary_size(name)), key=dictionary_size)
    families = {_family(name): name for name in names}  # of each the last, which is the largest
    seen = {name: set[int]().union(*(_markers(image, name) for image in images)) for name in families.values()}
    most = max(seen, key=lambda name: len(seen[name]))
    largest = max(seen[most], default=0)
    name = next(name for name in names if _family(name) == _family(most) and dictionary_size(name) > largest)
    return name, len(seen[most])


def _family(name: str) -> str:
    start, _, count = name.rpartition("_")
    return start if count.isdecimal() else name
