"""Registration of lines: point to line, with an odometry prior, and honest about what a line cannot show.

Iterative closest point (Besl and McKay 1992) in the point-to-line form of Chen and Medioni 1991; thesis section 5.2.4.
Points slide freely along the line they lie on, so the direction of a straight line does not enter the residuals: the
normal equations are singular there. What the prior does not fix is left alone and reported with zero information.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..records import Floats, LineMotion, Pose
from .line_sight import to_robot
from .polyline import directions

HUBER = 2.0  # standard deviations beyond which a residual counts less
SLIPPED = 16.0  # chi squared of a correction that odometry's noise does not explain
UNSEEN = 8000.0  # information (1 / m^2, headings at LEVER) below which a direction is not seen: 11 mm
KEY_DISTANCE, KEY_TURN = 0.08, 0.12  # metres and radians between two views whose motion is reported
KEY_LONGEST = 1.5  # seconds between them
LEVER = 0.5  # m: heading times this is comparable with a displacement


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """Where points (N, 2) lie against a polyline: their feet."""

    on: NDArray[np.bool_]  # (N,) near it, along it and not beyond its ends
    along: Floats  # (N,) arc length of the foot
    offset: Floats  # (N,) to its left
    gap: Floats  # (N,) distance, whatever the direction
    normal: Floats  # (N, 2) of the polyline there

    @property
    def covered(self) -> float:
        """Metres of the polyline between the first and the last foot."""
        return float(np.ptp(self.along[self.on]))


def nearest(points: Floats, path: Floats, within: float, lengths: Floats) -> Nearest:
    """Project an ordered run of points onto a polyline.

    A point is on it if it is nearer than `within`, does not lie beyond an end, and the run passes there in about the
    polyline's direction, because a hairpin's other leg is not this one.

    Parameters
    ----------
    points, path : (N, 2) and (M, 2) arrays
        In the same axes, metres; N, M >= 2.
    within : float
        Metres.
    lengths : (M,) array
        Arc lengths of the path.
    """
    start, step = path[:-1], np.diff(path, axis=0)
    size = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
    unit = step / size[:, None]
    origin = start[0].copy()
    points, start = points - origin, start - origin
    along = points @ unit.T - (start * unit).sum(axis=1)
    share = np.clip(along, 0.0, size)
    # |p - start - share unit|^2, multiplied out so that only (points, segments) arrays are made
    square = (points**2).sum(axis=1)[:, None] + (start**2).sum(axis=1) - 2.0 * points @ start.T
    square += share * (share - 2.0 * along)
    gap = np.sqrt(np.maximum(square.min(axis=1), 0.0))
    square = np.where(directions(points) @ unit.T < 0.7, square + 1.0, square)
    best = square.argmin(axis=1)
    rows = np.arange(len(best))
    place = lengths[best] + share[rows, best]
    beyond = ((best == 0) & (along[rows, best] < 0.0)) | ((best == len(size) - 1) & (along[rows, best] > size[-1]))
    normal = np.column_stack([-unit[best, 1], unit[best, 0]])
    offset = ((points - start[best]) * normal).sum(axis=1)
    return Nearest((square[rows, best] < within**2) & ~beyond, place, offset, gap, normal)


def solve(
    H: Floats, residual: Floats, noise: Floats, prior: Floats, independent: float
) -> tuple[Floats, Floats, float]:
    """The correction that explains residuals, given a prior about it; robust by Huber's weights.

    Parameters
    ----------
    H : (N, K) array
        Derivatives of the residuals by the correction.
    residual, noise : (N,) arrays
        Metres, and their standard deviations.
    prior : (K, K) array
        Covariance of the correction, mean zero.
    independent : float
        So many points of a view count as independent.

    Returns
    -------
    estimate : (K,) array
    posterior : (K, K) array
    surprise : float
        Chi squared of the estimate under the prior.
    """
    few = min(1.0, independent / len(residual))
    estimate = np.zeros(H.shape[1])
    for _ in range(3):
        whitened = np.abs(residual - H @ estimate) / noise
        weight = few * np.minimum(1.0, HUBER / np.maximum(whitened, 1e-9)) / noise**2
        posterior = np.linalg.inv(np.linalg.inv(prior) + (H.T * weight) @ H)
        estimate = posterior @ (H.T @ (weight * residual))
    return estimate, 0.5 * (posterior + posterior.T), float(estimate @ np.linalg.solve(prior, estimate))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A line as one frame showed it, in robot axes at the stamp, for `motion_between`."""

    t: float
    points: Floats  # (N, 2)
    sigma: Floats  # (N,) of each point along the view
    toward: Floats  # (N, 2) unit vectors from the camera
    speed: float
    turn_rate: float


def motion_between(
    one: View,
    two: View,
    odometry: Pose,
    *,
    point_sigma: float,
    whole: tuple[float, float],
    jitter: float,
    late: float,
    independent: float,
) -> tuple[Pose, Floats] | None:
    """How the robot moved between two views of one line, by the line alone.

    Parameters
    ----------
    one, two : View
        The earlier and the later one.
    odometry : Pose
        The motion as odometry has it: where the search starts, and what is returned where the line shows nothing.
    point_sigma : float
        Metres, of a point across the line.
    whole : (shift, turn)
        Metres and radians by which all of a view is off together: the floor's tilt, and turning while rows are read.
    jitter : float
        Seconds, of a stamp.
    late : float
        Seconds, one sigma of what both stamps are off by: it matters where the robot changes its motion.
    independent : float
        So many points of a view count as independent.

    Returns
    -------
    motion : Pose
        Of the robot at `two` in its axes at `one`.
    information : (3, 3) array
        Of x, y and heading; zero along what the line does not show.
    None
        If the views do not overlap.
    """
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(one.points, axis=0).T))])
    x, y, heading = odometry.x, odometry.y, odometry.heading
    scale = np.array([1.0, 1.0, 1.0 / LEVER])
    for _ in range(6):
        c, s = math.cos(heading), math.sin(heading)
        turned = two.points @ np.array([[c, s], [-s, c]])
        found = nearest(turned + [x, y], one.points, 0.05, lengths)
        on = found.on
        if on.sum() < 6:
            return None
        normal, arm = found.normal[on], turned[on]
        H = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
        toward = two.toward[on] @ np.array([[c, s], [-s, c]])
        across = ((normal * toward).sum(axis=1) * two.sigma[on]) ** 2
        noise = np.sqrt(2.0 * point_sigma**2 + 2.0 * across)
        few = min(1.0, independent / len(noise))
        residual = found.offset[on]
        weight = few * np.minimum(1.0, HUBER * noise / np.maximum(np.abs(residual), 1e-9)) / noise**2
        scaled = H * scale
        values, vectors = np.linalg.eigh((scaled.T * weight) @ scaled)
        seen = values > UNSEEN
        gain = np.where(seen, 1.0 / np.maximum(values, 1e-12), 0.0)
        step = -scale * (vectors @ (gain * (vectors.T @ (scaled.T @ (weight * residual)))))
        x, y, heading = x + step[0], y + step[1], heading + step[2]
        if np.abs(step).max() < 1e-5:
            break
    # a late stamp moves the whole view along the robot's motion
    slid = np.array([math.cos(heading) * two.speed, math.sin(heading) * two.speed, two.turn_rate]) / scale
    changed = slid - np.array([one.speed - one.turn_rate * y, one.turn_rate * x, one.turn_rate]) / scale
    misfit = max(1.0, float(np.mean((residual / noise) ** 2)))  # of views that show different lines in part
    kept = vectors[:, seen]
    shift, change = kept.T @ slid, kept.T @ changed
    together = 2.0 * np.array([whole[0], whole[0], LEVER * whole[1]]) ** 2
    covariance = misfit * np.diag(gain[seen]) + (kept.T * together) @ kept
    covariance += 2.0 * jitter**2 * np.outer(shift, shift) + late**2 * np.outer(change, change)
    information = (kept @ np.linalg.inv(covariance) @ kept.T) / np.outer(scale, scale)
    return Pose(x, y, math.remainder(heading, 2.0 * math.pi)), 0.5 * (information + information.T)


class LineOdometer:
    """Motion by the line alone, from each view to the next one that is some way on.

    Parameters
    ----------
    point_sigma, whole, jitter, independent
        As `motion_between` takes them.
    """

    def __init__(self, point_sigma: float, whole: tuple[float, float], jitter: float, independent: float) -> None:
        self._point_sigma = point_sigma
        self._whole = whole
        self._jitter = jitter
        self._independent = independent
        self._key: tuple[View, Pose, float] | None = None

    def reset(self) -> None:
        """Begin anew."""
        self._key = None

    def observe(self, view: View, pose: Pose, stamp_error: float, late: float) -> LineMotion | None:
        """Take a view from where odometry has the robot at `pose`; returns the motion that it shows, if it is time.

        `stamp_error` is added to the views' stamps; `late` is its standard deviation, both in seconds.
        """
        key, self._key = self._key, (view, pose, stamp_error)
        if key is None or view.t - key[0].t > KEY_LONGEST:
            return None
        before, start, error_then = key
        turn = math.remainder(pose.heading - start.heading, 2.0 * math.pi)
        x, y = to_robot(np.array([[pose.x, pose.y]]), start)[0].tolist()
        if math.hypot(x, y) < KEY_DISTANCE and abs(turn) < KEY_TURN:
            self._key = key
            return None
        moved = motion_between(
            before,
            view,
            Pose(x, y, turn),
            point_sigma=self._point_sigma,
            whole=self._whole,
            jitter=self._jitter,
            late=math.hypot(late, stamp_error - error_then),  # an estimate that still moves is no better than it moves
            independent=self._independent,
        )
        if moved is None or not moved[1].any():
            return None
        (a, b, c), (d, e, f), (g, h, i) = moved[1].tolist()
        times = before.t + stamp_error, view.t + stamp_error
        return LineMotion(*times, moved[0].x, moved[0].y, moved[0].heading, ((a, b, c), (d, e, f), (g, h, i)))
