"""Upright glass that mirrors labels, found by the images that labels show in it.

A label's image in a pane is as consistent as the label. A label that was never seen directly would be placed behind
the pane; other labels, seen directly and in the same pane, give it away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from ..records import Floats
from .initial import world_rays
from .problem import Bools, Ints, Problem, Sightings, State

_PANES = 8  # that are looked for
_TRIALS = 64  # images from which a pane is proposed
_STEEPEST = 0.05  # sine of the elevation from which a ray meets its label's height well enough to propose one
_NEARER_M = 0.2  # than its image a label must be
_FARTHEST_M = 12.0  # from the robot an image is
_ALIKE = 0.01  # rad between a ray and the image that a pane predicts; panes are not perfectly flat
_IMAGES, _LABELS = 4, 3  # sightings of so many labels, that a pane must explain
_BESIDE_M = 0.3  # the farthest image that was seen in it, a pane may reach
_BEHIND_M = 0.15  # a pane a label must lie to be an image in it
_APART_M, _LEAST = 1.5, 12  # outside so many others at least, nothing hangs that few stops saw


@dataclass(frozen=True, slots=True, eq=False)
class Pane:
    """The upright plane `normal` (2,) . (x, y) = `distance`, robot on the smaller side, and what of it mirrors.

    `along` (2,) and `height` (2,) are the ranges in which it was seen to mirror, metres along (-normal y, normal x)
    and above the floor; `labels` (K,) those that show in it.
    """

    normal: Floats
    distance: float
    along: Floats
    height: Floats
    labels: Ints

    def image(self, points: Floats) -> Floats:
        """(N, 3) points mirrored in it."""
        result: Floats = points.copy()
        result[:, :2] -= 2.0 * (points[:, :2] @ self.normal - self.distance)[:, None] * self.normal
        return result

    def shows(self, origin: Floats, points: Floats) -> Bools:
        """(N,) whether the way from each origin (N, 3) to a point (N, 3) behind it passes through what mirrors."""
        before, behind = origin[:, :2] @ self.normal - self.distance, points[:, :2] @ self.normal - self.distance
        along, height = _crossing(self.normal, origin, points, before, behind)
        return np.asarray(
            (before < 0.0)
            & (behind > _BEHIND_M)
            & (along > self.along[0] - _BESIDE_M)
            & (along < self.along[1] + _BESIDE_M)
            & (height > self.height[0] - _BESIDE_M)
            & (height < self.height[1] + _BESIDE_M)
        )


def panes(problem: Problem, state: State, inlier: Bools, located: Bools) -> list[Pane]:
    """Panes in which labels are mirrored.

    Every sighting of a located label that does not fit may show the label's image, which is as high as the label: that
    proposes a pane. One that explains such sightings of several labels is one.

    Parameters
    ----------
    problem, state
        Of the whole survey, and where everything is.
    inlier : (N,) array
        Sightings that fit their labels' positions.
    located : (L,) array
        Labels that have a position.
    """
    odd = np.flatnonzero(~inlier & located[problem.sightings.label])
    found: list[Pane] = []
    while len(odd) >= _IMAGES and len(found) < _PANES:
        sightings = problem.sightings.select(odd)
        origin, direction = world_rays(problem, sightings, state)
        pane, shown = _most_images(sightings, origin, direction, state.points[sightings.label])
        if pane is None:
            break
        found.append(pane)
        odd = odd[~shown]
    return found


def images(problem: Problem, state: State, inlier: Bools, located: Bools) -> dict[int, tuple[Floats, Pane]]:
    """Located labels all of whose sightings go through a pane, with the positions (3,) that they would be images of."""
    s = problem.sightings.select(inlier)
    origin, _ = world_rays(problem, s, state)
    result: dict[int, tuple[Floats, Pane]] = {}
    for pane in panes(problem, state, inlier, located):
        past = np.bincount(s.label[~pane.shows(origin, state.points[s.label])], minlength=len(located))
        behind = located & (past == 0) & (np.bincount(s.label, minlength=len(located)) > 0)
        for label in np.setdiff1d(np.flatnonzero(behind), pane.labels).tolist():
            result[label] = pane.image(state.points[label : label + 1])[0], pane
    return result


def apart(labels: Floats, few: Bools, stops: Floats) -> dict[int, float]:
    """Labels, numbers in (L, 2), that `few` (L,) stops saw and that lie far outside everything else; metres outside.

    An image in glass in which no other label shows looks like that.
    """
    if len(labels) < _LEAST:
        return {}
    everything = np.vstack([labels, stops])
    try:
        corners = ConvexHull(everything).vertices
    except (QhullError, ValueError):
        return {}
    found = {}
    for i in corners[corners < len(labels)].tolist():
        others = np.delete(everything, i, axis=0)
        if few[i] and np.linalg.norm(others - labels[i], axis=1).min() > _APART_M:
            far = outside(others, labels[i])
            if far > _APART_M:
                found[i] = far
    return found


def outside(around: Floats, point: Floats) -> float:
    """Metres by which a point lies outside the convex hull of others (N, 2); 0 if there is no hull."""
    try:
        hull = ConvexHull(around)
    except (QhullError, ValueError):  # fewer than three, or all on one line
        return 0.0
    return float(np.max(hull.equations[:, :2] @ point + hull.equations[:, 2]))


def _most_images(sightings: Sightings, origin: Floats, direction: Floats, points: Floats) -> tuple[Pane | None, Bools]:
    """The pane that explains most of these rays (N, 3) as images of `points` (N, 3), and which (N,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (points[:, 2] - origin[:, 2]) / direction[:, 2]
        there = origin + reach[:, None] * direction
    aside = there[:, :2] - points[:, :2]
    size = np.linalg.norm(aside, axis=1)
    good = (np.abs(direction[:, 2]) > _STEEPEST) & (reach > 0.0) & (reach < _FARTHEST_M) & (size > _NEARER_M)
    proposals = np.flatnonzero(good)
    proposals = proposals[np.argsort(-np.abs(direction[proposals, 2]), kind="stable")][:_TRIALS]
    best, nothing = None, np.zeros(len(points), np.bool_)
    shown = nothing
    for k in proposals.tolist():
        normal = aside[k] / size[k]
        distance = float(0.5 * (there[k, :2] + points[k, :2]) @ normal)
        fits = _explained(normal, distance, origin, direction, points)
        if np.count_nonzero(fits) > np.count_nonzero(shown):
            best, shown = (normal, distance), fits
    if best is None or not _enough(sightings, shown):
        return None, nothing
    normal, distance = _refined(*best, origin[shown], direction[shown], points[shown])
    again = _explained(normal, distance, origin, direction, points)
    if _enough(sightings, again):
        shown = again
    else:
        normal, distance = best
    mirrored = Pane(normal, distance, np.zeros(2), np.zeros(2), np.unique(sightings.label[shown]))
    images = mirrored.image(points[shown])
    before, behind = origin[shown, :2] @ normal - distance, images[:, :2] @ normal - distance
    along, height = _crossing(normal, origin[shown], images, before, behind)
    return replace(
        mirrored, along=np.array([along.min(), along.max()]), height=np.array([height.min(), height.max()])
    ), shown


def _enough(sightings: Sightings, shown: Bools) -> bool:
    return bool(np.count_nonzero(shown) >= _IMAGES and len(np.unique(sightings.label[shown])) >= _LABELS)


def _explained(normal: Floats, distance: float, origin: Floats, direction: Floats, points: Floats) -> Bools:
    """(N,) rays that point at the images of their labels, robot and label being on the same side."""
    depth = points[:, :2] @ normal - distance
    way: Floats = points - origin
    way[:, :2] -= 2.0 * depth[:, None] * normal
    miss = np.linalg.norm(np.cross(way, direction), axis=1)
    ahead = (way * direction).sum(axis=1)
    front = (depth < -0.5 * _NEARER_M) & (origin[:, :2] @ normal < distance)
    return np.asarray(front & (ahead > 0.0) & (miss < _ALIKE * ahead))


def _refined(
    normal: Floats, distance: float, origin: Floats, direction: Floats, points: Floats
) -> tuple[Floats, float]:
    """The plane that brings the images nearest to their rays; Gauss-Newton over its angle and distance."""
    angle = float(np.arctan2(normal[1], normal[0]))
    for _ in range(5):
        normal, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        depth, turn = points[:, :2] @ normal - distance, points[:, :2] @ across
        way: Floats = points - origin
        way[:, :2] -= 2.0 * depth[:, None] * normal
        by_angle, by_distance = np.zeros_like(way), np.zeros_like(way)
        by_angle[:, :2] = -2.0 * (turn[:, None] * normal + depth[:, None] * across)
        by_distance[:, :2] = 2.0 * normal
        far = np.linalg.norm(way, axis=1)[:, None]
        J = np.stack([np.cross(d, direction) / far for d in (by_angle, by_distance)], axis=-1).reshape(-1, 2)
        r = (np.cross(way, direction) / far).ravel()
        step = np.linalg.lstsq(J, -r, rcond=None)[0]
        angle, distance = angle + float(step[0]), distance + float(step[1])
    return np.array([np.cos(angle), np.sin(angle)]), distance


def _crossing(normal: Floats, origin: Floats, points: Floats, before: Floats, behind: Floats) -> tuple[Floats, Floats]:
    """Where along a pane and how high (N,) the ways from origins to points go through it; `before`, `behind` (N,) are
    the distances of their ends from it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        part = (before / (before - behind))[:, None]
        there = origin + part * (points - origin)
    return there[:, :2] @ np.array([-normal[1], normal[0]]), np.asarray(there[:, 2])
