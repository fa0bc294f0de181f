"""Surveys that hardly fit: which mistake of who wrote them would explain it.

With moves in feet, a camera's cable in its neighbour's socket, pictures of another size or a rig's poses the wrong way
round, some labels may still come out, at wrong places. Such a survey shows strain: sightings fit no map, or fit it
badly, moves contradict them, or the calibration does. Then the survey is read as if it held one of the usual mistakes;
where that takes the strain away, the mistake is named and nothing is placed on the survey as it stands.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from ..errors import InputError
from .breaks import carried
from .components import scatter
from .known_labels import slipped
from .problem import CAMERA, ODOMETRY, Problem, build_problem
from .readings import CAMERAS, LENSES, NEARLY, Reading, lengths, lenses, nearly, orders, rigs, signs
from .references import IMPOSSIBLE, MOST_TO_TRY, POSSIBLE, chance
from .robust import Optimum, optimise
from .strangers import ALONE, LEAST_LIGHTS, TOGETHER, shares

FITS = 0.5  # share of the survey's sightings below which its calibration or its units are doubted
FITS_NOT = 0.45  # and below which nothing is placed
_UNSURE = 0.8  # share below which the survey is doubted: a third of wrong sightings is possible, but rare
_MOSTLY = 0.9  # share below which sightings that scatter are doubted
_CLEARLY_BETTER = 0.25  # of that share, to blame two cameras or anything else
_RATHER_BETTER = 0.15  # to blame moves, if then nearly all fit
_NEARLY_ALL = 0.9
_SCATTERS, _SCATTERS_NOT = 1.8, 1.4  # times their stated standard deviations, or those of what lenses leave
_NO_LENS = 4.0  # times that, where many sightings do not fit at all
_SLIPPING = 0.25  # of the moves, and two: wheels slip once in twenty metres
_MOSTLY_SLIPPED, _MANY_SLIPPED = 0.8, 3  # of the moves from which nothing is placed
_MOST_LEGS, _TOGETHER, _BY_THEMSELVES = 8, 0.95, 0.9  # legs, and shares of the sightings, to hold legs apart
_APART, _ASUNDER = 0.05, 0.25  # by which legs fit better by themselves, to say so and to refuse them
_FEW_MOVED, _MOVED_SHARE = 3, 0.3  # labels, and of those that two legs share, from which things were moved
_SUNKEN_M = 0.05  # below the floor, that slopes and steps explain
_MANY_SUNKEN, _SUNKEN_SHARE = 3, 0.15  # labels, and of all labels, from which heights are doubted
_STRAINED = 4.0  # standard deviations, of one value; of a root mean square over a rig half of it


@dataclass(frozen=True, slots=True)
class Misfit:
    """Why a survey hardly fits, in words; `refused`: nothing is placed, because it is not as it should be read."""

    share: float
    text: str | None
    refused: bool


@dataclass(frozen=True, slots=True)
class Strain:
    """How well a survey fits its optimum.

    `share` of the sightings that the map explains, by how much they `scatter` more than they should, how many of the
    `moves` count as `slipped` and how many of these were left out because the robot seems to have been `carried`, the
    `chance` that rig, lenses and wheels are so far from what the priors say, and whether sightings of some
    cameras are `strange`: they do not fit where those of others do.
    """

    share: float
    scatter: float
    slipped: int
    carried: int
    moves: int
    chance: float
    strange: bool

    @property
    def scatters(self) -> bool:
        """Whether sightings fit worse than lenses and detectors explain."""
        return self.scatter > _SCATTERS and self.share < _MOSTLY

    @property
    def slips(self) -> bool:
        """Whether more moves contradict the sightings than wheels slip."""
        return self.slipped >= max(2, _SLIPPING * self.moves)

    @property
    def is_there(self) -> bool:
        """Whether the survey is doubtful."""
        return self.share < _UNSURE or self.scatters or self.slips or self.carried > 0 or self.chance < IMPOSSIBLE

    def is_relieved(self, other: Strain) -> bool:
        """Whether another reading of the survey has none of this strain."""
        if other.share < self.share - 0.02 or other.slipped > self.slipped:
            return False
        return (
            (not self.scatters or other.scatter < _SCATTERS_NOT)
            and (not self.slips or not other.slips)
            and (self.chance >= IMPOSSIBLE or other.chance > POSSIBLE)
            and (not self.carried or not other.carried)
            and (self.scatters or self.slips or self.carried > 0 or self.chance < IMPOSSIBLE)
            and other.share > min(_UNSURE, self.share + _RATHER_BETTER)
        )


def strain(optimum: Optimum) -> Strain:
    """How well the survey fits; scatter and calibration are not judged where too little shows."""
    problem = optimum.problem
    return Strain(
        explained_share(optimum),
        scatter(problem),
        slipped(problem),
        len(carried(problem, optimum.state)),
        len(problem.moves.before),
        chance(optimum.adjustment, optimum.state),
        _strange(optimum),
    )


def _strange(optimum: Optimum) -> bool:
    problem = optimum.problem
    share, total = shares(problem, optimum.inlier | optimum.reflected, problem.sightings.camera, len(problem.cameras))
    share = share[total >= LEAST_LIGHTS]
    return len(share) > 1 and bool(share.min() < ALONE and share.max() > TOGETHER)


def misfit(asked: Problem, optimum: Optimum) -> Misfit:
    """Judge how much of a survey its optimum explains, and look for the mistake if that is little."""
    seen = strain(optimum.stated or optimum)
    little = f"only {100 * seen.share:.0f} % of the sightings fit any map, so few labels are placed"
    apart = _legs_apart(asked, seen)
    if apart is not None and apart.refused:
        return apart
    if seen.is_there and len(asked.sightings) <= MOST_TO_TRY:
        found = _best_reading(asked, seen, int(np.count_nonzero(optimum.placed)))
        if found is not None:
            reading, said, other = found
            where = _where(reading)
            if seen.share >= _MOSTLY:
                doubt = f"the survey contradicts itself ({_complaints(seen)}); with {said} it does not: check {where}"
                return Misfit(seen.share, doubt, reading.kind not in (CAMERAS, LENSES))
            text = f"{little}; with {said} {100 * other.share:.0f} % do: check {where}"
            return Misfit(seen.share, text, True)
    if optimum.stated is not None:
        seen = strain(optimum)
    labels = optimum.adjustment.labels
    heights = zip(optimum.state.points[labels, 2].tolist(), optimum.covariance.points[:, 2, 2].tolist(), strict=True)
    sunken = sum(is_below_floor(z, variance) for z, variance in heights)
    if sunken >= max(_MANY_SUNKEN, _SUNKEN_SHARE * len(labels)):
        text = f"{sunken} of {len(labels)} labels come out below the floor, so the heights of all are doubtful"
        return Misfit(seen.share, f"{text}: check that v counts downward, and the cameras' heights and tilts", True)
    if seen.share < _UNSURE and seen.scatter > _NO_LENS:
        text = (
            f"only {100 * seen.share:.0f} % of the sightings fit, and these scatter {seen.scatter:.1f} times too much"
        )
        return Misfit(seen.share, f"{text}: check the lenses' distortion and the pictures' size", True)
    if seen.slipped >= max(_MANY_SLIPPED, _MOSTLY_SLIPPED * seen.moves) or seen.carried >= max(
        2, _SLIPPING * seen.moves
    ):
        text = f"{seen.slipped} of {seen.moves} moves are not what cameras saw, so size and axes are doubtful"
        return Misfit(seen.share, f"{text}: check the moves, and where the cameras look on the robot", True)
    if seen.strange:
        text = f"only {100 * seen.share:.0f} % of the sightings fit, of some cameras hardly any"
        return Misfit(seen.share, f"{text}: check the lenses, the pictures' size and which camera is which", True)
    if apart is not None:
        return apart
    if (moved := _moved_between_legs(optimum)) is not None:
        return Misfit(seen.share, moved, False)
    if seen.share >= FITS:
        text = f"only {100 * seen.share:.0f} % of the sightings fit; a label that two stops saw may be wrong by chance"
        return Misfit(seen.share, text if seen.share < _UNSURE else None, False)
    what = "the rig (which camera is which, metres, radians), the labels' ids and the moves' units"
    return Misfit(seen.share, f"{little}; check {what}", False)


def _legs_apart(asked: Problem, seen: Strain) -> Misfit | None:
    """A misfit if each leg fits by itself and the legs together do not; refused if they hardly do."""
    stops, survey = asked.survey.stops, asked.survey
    legs = sorted({stop.leg for stop in stops})
    if not 2 <= len(legs) <= _MOST_LEGS or seen.share > _TOGETHER or len(asked.sightings) > MOST_TO_TRY:
        return None
    explained, total = 0.0, 0
    for leg in legs:
        alone = build_problem(replace(survey, stops=tuple(stop for stop in stops if stop.leg == leg)))
        if len(alone.sightings) < LEAST_LIGHTS:
            continue
        explained += explained_share(optimise(alone, thorough=False)) * len(alone.sightings)
        total += len(alone.sightings)
    share = explained / max(total, 1)
    if share < _BY_THEMSELVES or share < seen.share + _APART:
        return None
    text = (
        f"each leg fits by itself ({100 * share:.0f} % of the sightings), together only {100 * seen.share:.0f} % do: "
        "are all of the same store, rig and label ids, and was anything moved between them?"
    )
    return Misfit(seen.share, text, share > seen.share + _ASUNDER)


def _moved_between_legs(optimum: Optimum) -> str | None:
    """A sentence if many of the labels that join a leg to the others hang elsewhere for one of them."""
    problem, s, found = optimum.problem, optimum.problem.sightings, list[str]()
    count, leg = len(problem.labels), problem.leg[s.stop]
    for number in sorted(set(leg.tolist()))[1:]:
        inside = leg == number
        seen = [np.bincount(s.label[mine], minlength=count) > 0 for mine in (inside, ~inside)]
        fits = [np.bincount(s.label[mine & optimum.inlier], minlength=count) > 0 for mine in (inside, ~inside)]
        both, agree = seen[0] & seen[1] & (fits[0] | fits[1]), fits[0] & fits[1]
        apart = int(np.count_nonzero(both & ~agree))
        if apart >= _FEW_MOVED and apart > _MOVED_SHARE * np.count_nonzero(both):
            found.append(f"leg {number} shares {np.count_nonzero(both)} labels with the others, of which {apart}")
    if not found:
        return None
    return f"{'; '.join(found[:3])} hang elsewhere there: was anything moved, or is it of another store?"


def _best_reading(asked: Problem, seen: Strain, placed: int) -> tuple[Reading, str, Strain] | None:
    """The mistake without which the survey fits clearly better, what to call it, and how it fits then."""
    best: tuple[Reading, Optimum, Strain] | None = None
    for reading in _readings(asked, seen):
        try:
            optimum = optimise(build_problem(reading.survey), thorough=False)
        except InputError:  # read like that it would be impossible
            continue
        other = strain(optimum)
        if int(np.count_nonzero(optimum.placed)) < placed:  # sightings that are left out fit nothing
            continue
        more = other.share - seen.share
        better = more > _CLEARLY_BETTER or (more > _RATHER_BETTER and other.share > _NEARLY_ALL)
        if not (better or seen.is_relieved(other)):
            continue
        if best is None or _merit(other) > _merit(best[2]):
            best = reading, optimum, other
            if other.share > _NEARLY_ALL and not (other.is_there or reading.kind == NEARLY):
                break  # the others concern something else
    return None if best is None else (best[0], best[0].described(best[1]), best[2])


def _merit(strain: Strain) -> float:
    """To compare readings by: sightings explained, less what contradicts them."""
    unlikely = -math.log10(max(strain.chance, 1e-30))
    return strain.share - 0.1 * (strain.scatter - 1.0) - 0.5 * strain.slipped / max(1, strain.moves) - 0.002 * unlikely


def _readings(asked: Problem, seen: Strain) -> Iterator[Reading]:
    """Those that could explain such a strain."""
    survey = asked.survey
    everything = seen.share < FITS or seen.slips or seen.carried > 0 or seen.scatters or seen.strange
    if asked.frame == "first stop":
        if seen.share >= _UNSURE:
            yield from nearly(survey)
        if seen.share < _UNSURE or seen.chance < IMPOSSIBLE:
            yield from lengths(survey)
    if seen.scatters:
        yield from lenses(survey)
    if everything or seen.share < 0.5 * (FITS + _MOSTLY):
        for reading in chain(signs(survey), orders(survey), rigs(survey)):
            if reading.kind != CAMERAS or seen.share < _MOSTLY:  # exchanged cameras leave no survey that fits
                yield reading
    if not seen.scatters and (everything or seen.share < 0.5 * (FITS + _MOSTLY)):
        yield from lenses(survey)


def _complaints(seen: Strain) -> str:
    said = []
    if seen.slips or seen.carried:
        said.append(f"{seen.slipped} of {seen.moves} moves are not what cameras saw")
    if seen.chance < IMPOSSIBLE:
        said.append("rig, lenses and wheels would all have to be far off their calibration")
    return "; ".join(said) or "sightings scatter too much"


def is_below_floor(z: float, variance: float) -> bool:
    """Whether a label's height and its variance put it clearly below the floor."""
    return z < -_SUNKEN_M - 3.0 * math.sqrt(variance)


def strained(optimum: Optimum) -> list[str]:
    """Sentences on priors that the optimum had to leave far behind, and on cameras whose sightings do not fit.

    Of priors that were widened the notes speak already.
    """
    problem, frame = optimum.problem, optimum.state.frame
    sigma, found = problem.prior_sigma, list[str]()
    names = ("scale", "turns", "drift")
    for name, value, one in zip(names, frame[-ODOMETRY:], sigma[-ODOMETRY:], strict=True):
        if one > 0.0 and abs(value) > _STRAINED * one:
            found.append(
                f"odometry's {name} came out {value:+.3g}, {abs(value) / one:.0f} times its prior; calibrate odometry, "
                "and check the moves' units"
            )
    for number, camera in enumerate(problem.cameras):
        first = problem.roof_entry - CAMERA * (len(problem.cameras) - number)
        prior, entries = sigma[first : first + CAMERA], frame[first : first + CAMERA]
        free = prior > 0.0
        size = float(np.sqrt(np.mean((entries[free] / prior[free]) ** 2))) if free.any() else 0.0
        if size > 0.5 * _STRAINED:
            found.append(
                f"camera {camera.name} came out {size:.1f} times as far from its calibration as its priors allow; "
                "calibrate the rig"
            )
    return found


def explained_share(optimum: Optimum) -> float:
    """Share of the lights that the map explains, among those of labels that two stops or more saw.

    What lies in glass or floor is explained too. Too few sightings say nothing.
    """
    problem = optimum.problem
    everyone = np.zeros(len(problem.sightings), dtype=np.int64)
    share, total = shares(problem, optimum.inlier | optimum.reflected, everyone, 1)
    return float(share[0]) if total[0] >= LEAST_LIGHTS else 1.0


def _where(reading: Reading) -> str:
    places = {
        CAMERAS: "rig.cameras and the robot's cables",
        LENSES: "the lenses' matrices and the size of the pictures that are taken",
    }
    return places.get(reading.kind, "the moves" if "moves" in reading.said else "the rig and the cameras' pictures")
