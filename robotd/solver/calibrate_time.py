"""By how much a camera's stamps are late against odometry, from a robot that turns to and fro on the spot.

A view turns when the wheels do. How far it has turned from one frame to the next is measured in its middle, by phase
correlation (Kuglin and Hines 1975) and least squares on grey levels (Lucas and Kanade 1981), and compared with the
heading that the wheels had at both stamps, less the lateness sought. Only changes of the turning rate tell it: a steady
turn looks the same earlier and later.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ..errors import SolverError
from ..records import Floats, Frame

WIDEST_S = 0.35  # lateness that is looked for
LEAST_TURNS = 3  # changes of direction
LEAST_FRAMES = 60
LEAST_CORRELATION = 0.8  # of the view's turns with the wheels'
_MOST_GAP_S = 0.12  # between frames whose views are compared
_WIDTH = 320  # px to which views are reduced
_BLOCKS = 10  # that are left out in turn, for the uncertainty
_STEPS = 3
_GRID_S = 0.005
_SETTLED_S = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ViewTurns:
    """By how much a view moved between frames: `before`, `after` (N,) their stamps, `shift` (N,) px along its turn."""

    before: Floats
    after: Floats
    shift: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Lateness:
    """What a camera's stamps are later than odometry's, in seconds, with its standard deviation.

    `correlation` of the view's turns with the wheels', `frames` that were compared, `rms_px` of what is left of them.
    `at` (N,) are their stamps in seconds, `seen` and `expected` (N,) px by how much the view moved, and would have by
    the wheels.
    """

    seconds: float
    sigma: float
    correlation: float
    frames: int
    rms_px: float
    at: Floats
    seen: Floats
    expected: Floats


def view_turns(frames: Iterable[Frame]) -> ViewTurns:
    """Measure how a camera's view moves from each frame to the next.

    The direction in which it moves most is taken for that of the turn, so that a camera may be mounted at any angle.
    """
    before, after, moves = [], [], []
    last: Frame | None = None
    reduced: Any = None
    window: Any = None
    for frame in frames:
        previous, view = reduced, _middle(frame)
        if window is None or window.shape != view.shape:
            window = cv2.createHanningWindow(view.shape[::-1], cv2.CV_32F)
            previous = None
        if last is not None and previous is not None and 0.0 < frame.t - last.t <= _MOST_GAP_S:
            before.append(last.t)
            after.append(frame.t)
            moves.append(_moved(previous, view, window))
        last, reduced = frame, view
    shift = np.array(moves, dtype=np.float64).reshape(-1, 2)
    if len(shift):
        near = shift[np.linalg.norm(shift, axis=1) < 0.25 * _WIDTH]
        _, vectors = np.linalg.eigh(near.T @ near)
        shift = shift @ vectors[:, -1:]
    return ViewTurns(np.array(before), np.array(after), shift.ravel())


def _moved(previous: Any, view: Any, window: Any) -> Floats:
    """By how much a view moved, (2,) px: phase correlation, and then Gauss-Newton steps on the grey levels.

    The peak of a phase correlation alone is drawn to whole pixels, by a tenth of a pixel and more.
    """
    # copies, because OpenCV applies the window in place where the size suits its Fourier transform
    move = np.array(cv2.phaseCorrelate(previous.copy(), view.copy(), window)[0], dtype=np.float64)
    for _ in range(_STEPS):
        back = cv2.warpAffine(
            view,
            np.array([[1.0, 0.0, -move[0]], [0.0, 1.0, -move[1]]]),
            view.shape[::-1],
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        du, dv = cv2.Sobel(back, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(back, cv2.CV_32F, 0, 1, scale=0.125)
        left = window * (previous - back)
        H = np.array([[(window * du * du).sum(), 0.0], [(window * du * dv).sum(), (window * dv * dv).sum()]])
        H[0, 1] = H[1, 0]
        gradient = np.array([(left * du).sum(), (left * dv).sum()])
        if np.linalg.det(H) < 1e-6 * np.trace(H) ** 2:
            break
        move += np.linalg.solve(H, gradient)
    return move


def _middle(frame: Frame) -> Any:
    """The middle half of a view's height and three quarters of its width, reduced: there a turn is nearly a shift."""
    height, width = frame.image.shape
    part = frame.image[height // 4 : height - height // 4, width // 8 : width - width // 8]
    scale = min(1.0, _WIDTH / part.shape[1])
    small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else part
    return cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.5)  # so that gradients hold for a pixel around


def lateness(turns: ViewTurns, t: Floats, heading: Floats, camera: str) -> Lateness:
    """Find at which lateness a view turned as the wheels did.

    Parameters
    ----------
    turns : ViewTurns
    t, heading : (M,) array
        Odometry: seconds on the stamps' clock, radians.
    camera : str
        For messages.

    Raises
    ------
    SolverError
        If the recording does not show it; the message says what is missing.
    """
    heading = np.unwrap(np.asarray(heading, dtype=np.float64))
    _check(turns, t, heading, camera)
    inside = (turns.before > t[0] + WIDEST_S) & (turns.after < t[-1] - WIDEST_S)
    before, after, shift = turns.before[inside], turns.after[inside], turns.shift[inside]

    def turned(late: float) -> Floats:
        return np.asarray(np.interp(after - late, t, heading) - np.interp(before - late, t, heading))

    def misfit(late: float) -> float:
        p = turned(late)
        return float(np.abs(shift - (p @ shift) / max(p @ p, 1e-12) * p).sum())

    grid = np.arange(-WIDEST_S, WIDEST_S + 0.5 * _GRID_S, _GRID_S)
    start = float(grid[int(np.argmin([misfit(late) for late in grid]))])
    rates = np.gradient(heading, t)

    def refined(late: float, use: Floats) -> tuple[float, float, Floats]:
        """Gauss-Newton steps on lateness and gain with Cauchy weights."""
        p = turned(late)
        gain = float((use * p) @ shift / max((use * p) @ p, 1e-12))
        for _ in range(30):
            p = turned(late)
            left = shift - gain * p
            scale = max(1.5 * float(np.median(np.abs(left[use > 0.0]))), 1e-3)
            weight = use / (1.0 + (left / (2.0 * scale)) ** 2)
            slope = -gain * (np.interp(after - late, t, rates) - np.interp(before - late, t, rates))
            J = np.column_stack([slope, p])
            H = J.T @ (weight[:, None] * J)
            step = np.linalg.solve(H + 1e-12 * np.trace(H) * np.eye(2), J.T @ (weight * left))
            late, gain = late + float(np.clip(step[0], -0.02, 0.02)), gain + float(step[1])
            if abs(step[0]) < _SETTLED_S:
                break
        return late, gain, np.asarray(left)

    late, _, left = refined(start, np.ones(len(shift)))
    correlation = abs(float(np.corrcoef(turned(late), shift)[0, 1]))
    if abs(late) > WIDEST_S - _GRID_S or correlation < LEAST_CORRELATION:
        raise SolverError(
            f"camera {camera}: its view does not turn as the wheels do (correlation {correlation:.2f}); it needs "
            "light, and something with edges to see, 0.5 m away or farther, that does not move"
        )
    block = np.minimum(np.arange(len(shift)) * _BLOCKS // len(shift), _BLOCKS - 1)
    without = np.array([refined(late, (block != k).astype(np.float64))[0] for k in range(_BLOCKS)])
    sigma = float(np.sqrt((_BLOCKS - 1) * np.mean((without - without.mean()) ** 2)))  # jackknife
    middle = 1.4826 * float(np.median(np.abs(left)))
    return Lateness(late, sigma, correlation, len(shift), middle, after, shift, shift - left)


def _check(turns: ViewTurns, t: Floats, heading: Floats, camera: str) -> None:
    if len(t) < 2 or (np.diff(t) <= 0.0).any():
        raise SolverError("odometry: fewer than two rows, or times that do not ascend; record it again")
    inside = (turns.before > t[0] + WIDEST_S) & (turns.after < t[-1] - WIDEST_S)
    if np.count_nonzero(inside) < LEAST_FRAMES:
        raise SolverError(
            f"camera {camera}: {np.count_nonzero(inside)} frames while odometry was recorded; {LEAST_FRAMES} or "
            "more are needed: record longer, or at more frames a second"
        )
    swing = np.diff(heading[:: max(1, len(heading) // 400)])
    moving = np.sign(swing[np.abs(swing) > 1e-3])
    reversals = int(np.count_nonzero(np.diff(moving)))
    if reversals < LEAST_TURNS:
        raise SolverError(
            f"the robot changed its turning direction {reversals} times; {LEAST_TURNS} or more are needed, because a "
            "steady turn looks the same earlier and later"
        )
