"""How a board deviates from a plane with square squares: bent paper, a warped plate, a printer that stretches.

A board that is bent by one millimetre fits a lens almost as well as a flat one, with a focal length 1 to 2 % wrong.
What it does to the corners is the same in every picture, so a few numbers are fitted together with the lens (Strobl and
Hirzinger, ICCV workshops 2011, fit every corner). All modes look the same from both ends of the board, because of many
boards it cannot be seen which end the detector began at.
"""

from __future__ import annotations

import numpy as np

from ..records import Floats

_HEIGHTS = ((2, 0), (1, 1), (0, 2), (4, 0), (3, 1), (2, 2), (1, 3), (0, 4))  # powers of x and y
_WEAK = 1e-2  # of the largest: singular value of a combination of heights that few corners could show


class BoardShape:
    """The modes in which a board may deviate.

    Parameters
    ----------
    points : (N, 3) array
        Corners of the flat board in metres; those seen often may be there often.
    """

    def __init__(self, points: Floats) -> None:
        self._middle: Floats = 0.5 * (points.min(axis=0) + points.max(axis=0))
        self._half = float(np.abs(points - self._middle).max())
        corners = np.unique(points, axis=0)
        flat = np.column_stack([np.ones(len(corners)), (corners - self._middle)[:, :2] / self._half])
        heights = self._powers(corners)
        tilt = np.linalg.lstsq(flat, heights, rcond=None)[0]  # a height and a tilt are part of the pose
        _, values, V = np.linalg.svd(heights - flat @ tilt, full_matrices=False)
        keep = values > _WEAK * values[0]
        self._mix: Floats = V[keep].T / values[keep] * np.sqrt(len(corners))
        self._tilt: Floats = tilt @ self._mix

    def __len__(self) -> int:
        return 2 + int(self._mix.shape[1])

    def _powers(self, points: Floats) -> Floats:
        x, y = ((points - self._middle)[:, :2] / self._half).T
        return np.column_stack([x**i * y**j for i, j in _HEIGHTS])

    def modes(self, points: Floats) -> Floats:
        """Displacements (N, 3, S) of points (N, 3) by each mode.

        The first two stretch and shear the squares: by one, so far as the point is from the board's middle. The others
        are heights: one metre, rms over the corners, perpendicular to each other.
        """
        out = np.zeros((len(points), 3, len(self)))
        x, y = (points - self._middle)[:, :2].T
        out[:, 0, 0], out[:, 1, 0] = x, -y
        out[:, 0, 1], out[:, 1, 1] = y, x
        flat = np.column_stack([np.ones(len(points)), x / self._half, y / self._half])
        out[:, 2, 2:] = self._powers(points) @ self._mix - flat @ self._tilt
        return out
