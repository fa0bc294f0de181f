"""Where the line can go on in more than one way: forks, crossings, corners and ends, and which way is ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..records import Floats
from .line_icp import Nearest, nearest
from .line_map import LineMap
from .line_sight import Sight
from .polyline import arc_length, end_direction

Rule = Literal["straight", "left", "right", "heading"]

REACH = 0.20  # m of a branch that say where it goes
LEAST = 0.14  # m of a branch that are worth looking at
PASSING = 0.10  # m from the line's middle to where a branch may begin: strokes end before a junction
LEAVES = 0.015  # m from the line's middle at which a branch leaves it
PARALLEL = math.radians(20.0)  # branches that differ by less are one line
BACK = math.radians(135.0)  # nobody turns by more at a junction
STRAIGHT_ON = math.radians(37.0)  # across a gap
SHORTEST = 0.05  # m of it straight on, from 5 cm behind a crossing to a gap
BRIDGE = 0.28  # m from where the line is crossed to where it goes on behind a gap
CROSSES = 0.08  # m to either side of that place that a crossing line shows
VOTES = 4  # frames that must agree before the path changes
SURE_VOTES = 8  # the same if the path as remembered is seen as well
SURE = 0.6  # confidence of a line that may change the path
STRAIGHT_END = 8  # points at the memory's end that say where it would go on
STRAIGHT_BOW = 0.006  # m that these may be off a straight line
SLIP_TURN = 0.22  # radians that a slip out of sight may have turned the line by
NEAR = 0.12  # m between the places of one junction in different frames


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """A way on from arc length `s` of the remembered line; `turn` against the line's direction before it.

    One that is short or lies behind a gap counts only if another line crosses there.
    """

    s: float
    points: Floats
    turn: float
    direction: float
    if_crossed: bool = False


class Junctions:
    """Chooses among ways on, by a rule and by what several frames agree on.

    Parameters
    ----------
    rule : "straight", "left", "right" or "heading"
        At forks and crossings: the way that turns least, the leftmost, the rightmost, or the one nearest to `heading`.
    heading : float
        Radians in odometry axes, for the rule of that name.
    """

    def __init__(self, rule: Rule, heading: float) -> None:
        self._rule = rule
        self._heading = heading
        self.forget()

    def forget(self) -> None:
        """No junction is in sight."""
        self._place: Floats = np.zeros(2)
        self._direction = 0.0
        self._votes = 0.0

    def choose(self, line: LineMap, sights: Sequence[Sight], here: float) -> Branch | None:
        """The branch that the line should go on with instead of its remembered rest, or None.

        Parameters
        ----------
        line : LineMap
            After this frame's sights were averaged in.
        sights : sequence of Sight
            Of this frame, in both directions.
        here : float
            Arc length where the robot is: nothing changes behind it.
        """
        if len(line) < 4:
            return None
        length = float(line.lengths[-1])
        sure = [sight for sight in sights if sight.confidence >= SURE]
        found = [branch for sight in sure if (branch := self._branch(line, sight)) is not None]
        best: tuple[float, Branch, int] | None = None
        for branch in found:
            votes = VOTES
            if branch.s < here + 0.03 or abs(branch.turn) > BACK:
                continue
            score = self._score(branch.turn, branch.direction)
            own_length = length - branch.s
            if own_length >= LEAST:
                own = line.direction_at(branch.s + 0.04, REACH)
                before = line.direction_at(branch.s, -0.10)
                own_direction = math.atan2(own[1], own[0])
                own_turn = math.atan2(before[0] * own[1] - before[1] * own[0], float(before @ own))
                differs = abs(math.remainder(branch.direction - own_direction, 2 * math.pi)) > PARALLEL
                beyond = (line.lengths > branch.s + 0.04) & (line.lengths < branch.s + 0.04 + BRIDGE + REACH)
                seen = np.count_nonzero(line.missed[beyond] < VOTES) * line.spacing  # perhaps only behind a gap
                is_real = seen > 0.5 * min(REACH, own_length)
                if is_real and (not differs or score > self._score(own_turn, own_direction) - 0.1):
                    continue
                if branch.if_crossed and not (differs and _is_crossed(sights, line.point_at(branch.s), own)):
                    continue
                votes = SURE_VOTES if is_real else VOTES
            elif branch.if_crossed:
                continue  # the end itself grows across a gap
            elif own_length > 2.5 * line.spacing and abs(branch.turn) < STRAIGHT_ON:
                continue  # the end itself grows by what is seen beyond it
            elif self._rule == "straight" and abs(branch.turn) > STRAIGHT_ON and _goes_both_ways(branch, found):
                continue  # a line that ends at another one: there is no way straight on
            if best is None or score < best[0]:
                best = score, branch, votes
        if best is None:
            self._votes = max(0.0, self._votes - 0.5)
            return None
        return self._voted(line, best[1], best[2])

    def _score(self, turn: float, direction: float) -> float:
        """The smaller the better, in radians."""
        if self._rule == "left":
            return -turn
        if self._rule == "right":
            return turn
        if self._rule == "heading":
            return abs(math.remainder(direction - self._heading, 2 * math.pi))
        return abs(turn)

    def _voted(self, line: LineMap, branch: Branch, needed: int) -> Branch | None:
        place = line.point_at(branch.s)
        same = np.hypot(*(place - self._place)) < NEAR
        same &= abs(math.remainder(branch.direction - self._direction, 2 * math.pi)) < 0.5
        self._votes = self._votes + 1.0 if same else 1.0
        self._place, self._direction = place, branch.direction
        if self._votes < needed:
            return None
        self.forget()
        return branch

    def _branch(self, line: LineMap, sight: Sight) -> Branch | None:
        """What of a sight leads away from the line, if anything does."""
        lengths = line.lengths
        found = nearest(sight.points, line.path, 0.05, lengths)
        on = np.flatnonzero(found.on)
        if len(on) >= 3:
            middle = on[np.abs(found.offset[on]) < LEAVES]
            last = int((middle if len(middle) else on)[-1])
            first, s = last + 1, float(found.along[last])
        else:
            first = int(found.gap.argmin())
            passes = bool(found.gap[first] <= PASSING)
            on_ahead = _straight_on(line, sight, if_crossed=not passes)
            if on_ahead is not None or not passes:
                return on_ahead
            away = np.hypot(*(line.path - sight.points[first]).T)
            s = float(lengths[int(away.argmin())])
        points = sight.points[first:]
        length = arc_length(points)[-1] if len(points) >= 3 else 0.0
        if length < SHORTEST or s < 0.05:
            return None
        chord = -end_direction(points[::-1], REACH)
        before = line.direction_at(s, -0.10)
        turn = math.atan2(before[0] * chord[1] - before[1] * chord[0], float(before @ chord))
        if length < LEAST and abs(turn) > PARALLEL:
            return None
        return Branch(s, points, turn, math.atan2(chord[1], chord[0]), if_crossed=bool(length < LEAST))


def _straight_on(line: LineMap, sight: Sight, *, if_crossed: bool) -> Branch | None:
    """A sight as the straight way on from where the line turns off: its beginning, prolonged backwards, lies on it."""
    back = end_direction(sight.points[::-1], REACH)
    bridge = sight.points[0] + np.arange(BRIDGE, 0.0, -line.spacing)[:, None] * back
    found = nearest(bridge, line.path, 0.05, line.lengths)
    middle = np.flatnonzero(found.on & (np.abs(found.offset) < LEAVES))
    if len(middle) < 3 or arc_length(sight.points)[-1] < LEAST:
        return None
    s = float(found.along[middle[-1]]) - line.spacing  # the last one may lie on what turns off
    before = line.direction_at(s, -0.10)
    turn = math.atan2(before[1] * back[0] - before[0] * back[1], -float(before @ back))
    if abs(turn) > STRAIGHT_ON:
        return None
    return Branch(s, sight.points, turn, math.atan2(-back[1], -back[0]), if_crossed)


def _is_crossed(sights: Sequence[Sight], place: Floats, direction: Floats) -> bool:
    """Whether a line runs through `place` in this direction: what turns off there is then not ours but that line's.

    The crossed line's middle is often seen as a corner at first, because with a gap behind the crossing, or one arm
    out of view, nothing else is there to go on with.
    """
    for sight in sights:
        away = sight.points - place
        along, beside = away @ direction, np.abs(away[:, 0] * direction[1] - away[:, 1] * direction[0])
        along = along[beside < 2.0 * LEAVES + 0.1 * np.abs(along)]
        if len(along) and along.min() < -CROSSES and along.max() > CROSSES:
            return True
    return False


def _goes_both_ways(branch: Branch, found: Sequence[Branch]) -> bool:
    return any(abs(other.s - branch.s) < NEAR and other.turn * branch.turn < 0.0 for other in found)


def past_the_end(line: LineMap, sights: Sequence[Sight], within: float, reach: float) -> tuple[Nearest, Sight] | None:
    """The sight that goes on where the line ends, off by what a slip out of sight explains, and its match.

    It is matched with the line's end prolonged, which must be straight for that.

    Parameters
    ----------
    line : LineMap
    sights : sequence of Sight
        Of one frame, in both directions; none lies on the line.
    within : float
        Metres that the sight may be off.
    reach : float
        Longest gap in metres.
    """
    straight = line.path[-STRAIGHT_END:]
    out = end_direction(straight, math.inf)
    away = straight - straight[0]
    if len(straight) < STRAIGHT_END or np.abs(away[:, 0] * out[1] - away[:, 1] * out[0]).max() > STRAIGHT_BOW:
        return None
    steps = np.arange(1.0, (reach + within) / line.spacing + STRAIGHT_END)[:, None] * line.spacing
    prolonged = np.vstack([straight, straight[-1] + steps * out])
    best: tuple[Nearest, Sight] | None = None
    for sight in sights:
        into = -end_direction(sight.points[::-1], REACH)
        if sight.confidence < SURE or math.acos(np.clip(out @ into, -1.0, 1.0)) > SLIP_TURN:
            continue
        match = nearest(sight.points, prolonged, within, arc_length(prolonged))
        if match.on.sum() >= STRAIGHT_END and (best is None or match.covered > best[0].covered):
            best = match, sight
    return best
