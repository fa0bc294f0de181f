"""A camera's lens from pictures of a flat board: which model, how sure, how far out it holds. Thesis sections 2.1, 7.2.

A lens model with more coefficients always fits the pictures at hand better. What counts is how well it predicts
pictures that it has not seen, so the model is chosen by cross-validation over pictures. Pictures that cannot determine
the lens are refused with what is missing, because the fit alone would not show it: from frontal views any focal length
reprojects well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..errors import SolverError
from ..geometry.camera import Camera
from ..geometry.transforms import skew
from ..records import CameraModel, Floats
from .board_pictures import distances_of, empty_borders, refusal, too_alike, too_few
from .board_shape import BoardShape
from .lens_fit import (
    LensFit,
    LensKind,
    View,
    bent,
    camera_model,
    fit_lens,
    lens_jacobian,
    pose_views,
    refine,
    without,
    without_strays,
)

PARTLY = "; or, if what is seen there is of no use, --partial"
MOST_RMS = 1.0  # px
MOST_SIGMA_FOCAL = 0.01  # of the focal length
MOST_SIGMA_PIXEL = 0.5  # px, up to which the lens is called valid
WORST = 5.0  # times the median of all pictures: the rms of one that does not belong to them
MOST_STRANGERS = 4  # one picture of so many may be left out
STRANGE = 15.0  # times what the corners' scatter, or the median picture, explains: a lens of its own. Pictures of
# lenses 5 % longer reach 34, boards that bend by 1 mm from picture to picture 5 times their median
SHAKY = 1.5  # disagreement from which it is told
LEAST_SHARE = 0.5  # of the picture, in a circle around the lens's centre in which there are corners
FOLDS = 5
LEAST_INFORMATION = 1e-6  # of all pictures', in a direction: what one picture tells less of is rounding
HOPELESS = 25.0  # times the best squared error with a flat board: no shape of the board saves such a lens model
TINY = 1e-12  # square pixels: drawn pictures may have no error at all
TIE = 0.02  # of the held-out squared error: less is not worth another model
ORDER: tuple[LensKind, ...] = ("brown-conrady", "fisheye", "rational")  # on a tie the first one


@dataclass(frozen=True, slots=True)
class Bend:
    """A board that is not flat: from its lowest to its highest corner, and by how much longer its x side is than y.

    `height` in metres and `stretch` relative, each with its standard deviation.
    """

    height: float
    height_sigma: float
    stretch: float
    stretch_sigma: float


class Candidate(NamedTuple):
    """A lens model, with a board that is flat or whose shape is fitted, too."""

    kind: LensKind
    bent: bool

    @property
    def words(self) -> str:
        """As the held-out errors are listed."""
        return f"{self.kind} with a bent board" if self.bent else self.kind


@dataclass(frozen=True, slots=True, eq=False)
class LensCalibration:
    """A lens and how sure it is.

    Attributes
    ----------
    camera : CameraModel
        Its pose is not set. `valid_radius_px` is None if the lens holds in the whole picture.
    kind : str
        brown-conrady (five coefficients), rational (eight) or fisheye.
    rms_px : float
        Of the corners' reprojection errors, per coordinate.
    held_out_px : dict of str to float
        The same for pictures that the lens was not fitted to, of every model tried; infinite where a model does not
        hold at corners.
    covariance : (4, 4) array
        Of fx, fy, cx, cy, in square pixels.
    reach_px : float
        Distance from the principal point up to which the lens was seen and is known to half a pixel.
    views : tuple of View
        The corners that were used.
    left_out : int
        Number of corners found in the wrong place.
    residuals : tuple of (N, 2) arrays, one per picture
        Fitted less seen corners, in pixels.
    distances : (float, float)
        From the camera to the middle of the nearest and of the farthest board, in metres.
    strangers : tuple of str
        Pictures that were left out because they do not fit what the others show, and how.
    share : float
        Of the picture, within reach.
    bend : Bend or None
        Of the board; None if it is flat, so far as pictures show.
    disagreement : float
        By how much more than their corners' scatter the pictures disagree about the lens; what is above 1 has been
        applied to the covariance.
    """

    camera: CameraModel
    kind: LensKind
    rms_px: float
    held_out_px: dict[str, float]
    covariance: Floats
    reach_px: float
    views: tuple[View, ...]
    left_out: int
    residuals: tuple[Floats, ...]
    share: float
    bend: Bend | None
    disagreement: float
    distances: tuple[float, float]
    strangers: tuple[str, ...] = ()

    @property
    def held_out_words(self) -> str:
        """The held-out errors of every model tried."""
        flat, bends = (
            ", ".join(
                f"{one} "
                + (
                    f"{self.held_out_px[word]:.3f}"
                    if self.held_out_px[word] < np.inf
                    else "(not valid at some corners)"
                )
                for one in ORDER
                if (word := Candidate(one, bend).words) in self.held_out_px
            )
            for bend in (False, True)
        )
        return f"flat board {flat}; bent board {bends}"

    @property
    def doubts(self) -> tuple[str, ...]:
        """What a person must know about the board and the pictures."""
        words = list(self.strangers)
        if self.bend is not None:
            one = self.bend
            words.append(
                f"the board is not flat and square: {1e3 * one.height:.2f} +- {1e3 * one.height_sigma:.2f} mm from its"
                f" lowest to its highest corner, {100.0 * one.stretch:+.2f} +- {100.0 * one.stretch_sigma:.2f} % longer"
                " along its rows than across; the lens was fitted with that shape"
            )
        if self.share < LEAST_SHARE:
            words.append(
                f"beyond {self.reach_px:.0f} px from its centre the lens is not seen, or uncertain by more than"
                f" {MOST_SIGMA_PIXEL:g} px, and nothing seen there will be used; more and sharper pictures show more"
            )
        if self.disagreement > SHAKY:
            words.append(
                f"pictures disagree about the lens {self.disagreement:.1f} times as much as their corners scatter, and"
                " its standard deviations have been raised by as much; is the board stiff, and held still?"
            )
        return tuple(words)

    @property
    def sigmas(self) -> Floats:
        """(4,) standard deviations of fx, fy, cx, cy in pixels."""
        return np.sqrt(np.diag(self.covariance))


def calibrate_lens(
    views: Sequence[View],
    size: tuple[int, int],
    name: str,
    kinds: Sequence[LensKind] = ORDER,
    whole: bool = True,
) -> LensCalibration:
    """Fit and choose a lens model.

    Chosen is the first of `ORDER`, with a flat board or else with a bent one, whose held-out squared error is not worse
    than the best one's by more than 2 %, or than twice the standard error of the difference over the pictures.
    Up to one picture in four that does not fit what the others show is left out and named.

    Parameters
    ----------
    views : sequence of View
        Boards seen at different places and tilts.
    size : (width, height)
        Of the pictures, in pixels.
    name : str
        Of the camera.
    kinds : sequence of str
        Models to choose from.
    whole : bool
        Refuse corners that leave out a border or half of the picture. False for a fisheye's round image, or if only the
        middle is of use: `valid_radius_px` says how far the lens holds.

    Raises
    ------
    SolverError
        If the pictures do not determine the lens; the message names all that is missing.
    """
    given, strangers = views, list[_Stranger]()
    while True:
        try:
            found = _calibrated(views, size, name, kinds, whole)
        except _Stranger as stranger:
            if (1 + len(strangers)) * MOST_STRANGERS > len(given):
                raise (strangers or [stranger])[0] from None
            strangers.append(stranger)
            views = [view for view in views if view.name != stranger.picture]
        else:
            return replace(found, strangers=tuple(one.told for one in strangers))


class _Stranger(SolverError):
    """One picture does not fit what all others show."""

    def __init__(self, picture: str, words: str, how: str) -> None:
        super().__init__(words)
        self.picture, self.told = picture, f"{picture} was left out: {how}"


def _calibrated(
    views: Sequence[View], size: tuple[int, int], name: str, kinds: Sequence[LensKind], whole: bool
) -> LensCalibration:
    few, border = too_few(views, size), empty_borders(views, size) if whole else []
    if few or border:
        raise SolverError(refusal(few + border) + (PARTLY if border else ""))
    flat = {kind: fit for kind in ORDER if kind in kinds and (fit := fit_lens(kind, views, size)) is not None}
    if not flat:
        raise SolverError("no lens model fits the corners; is the board flat, and are all pictures from one camera?")
    given, (views, flat) = views, without_strays(views, flat, size)
    board = BoardShape(np.concatenate([view.points for view in views]))
    fits = {Candidate(kind, False): fit for kind, fit in flat.items()}
    errors = {one: _held_out(fit, views, size, board) for one, fit in fits.items()}
    least = min(float(np.mean(each)) for each in errors.values())
    for kind, fit in flat.items():
        if np.mean(errors[Candidate(kind, False)]) <= HOPELESS * least:
            one = Candidate(kind, True)
            fits[one] = refine(bent(fit, board), views, size, board=board)
            errors[one] = _held_out(fits[one], views, size, board)
    chosen = _choose(errors)
    kind, fit = chosen.kind, fits[chosen]
    _consistent(fit, views)
    apart, parts = _disagreement(fit)
    stranger = int(np.argmax(parts))
    if parts[stranger] > STRANGE * max(float(np.median(parts)), 1.0):
        raise _Stranger(
            views[stranger].name,
            f"{views[stranger].name} shows another lens than all other pictures do; leave it out if it is of another"
            " camera, of other settings (zoom, focus, cropping), or of another board",
            "it shows another lens than all other pictures do, or another board",
        )
    covariance = _covariance(fit) * max(apart, 1.0) ** 2
    lens_covariance = covariance[: len(fit.lens), : len(fit.lens)]
    distances = distances_of(fit, views)
    missing = too_alike(fit, distances)
    relative = float((np.sqrt(np.diag(lens_covariance))[:2] / fit.lens[:2]).max())
    if not relative <= MOST_SIGMA_FOCAL and not missing:
        missing = [
            f"the focal length stays uncertain by {100.0 * relative:.1f} %; take more pictures, with the board larger"
            " in view and tilted by 30 to 45 degrees about both its sides"
        ]
    if missing:
        raise SolverError(refusal(missing))
    record = camera_model(kind, fit.lens, size, name)
    reach = _reach(record, kind, fit.lens, lens_covariance, views)
    share, seen = _share(record, reach), _share(record, _farthest(record, views))
    if whole and seen < LEAST_SHARE:
        middle = f"all corners lie in a circle around the middle {100.0 * seen:.0f} % of the picture; hold the board"
        raise SolverError(refusal([f"{middle} into its corners, too"]) + PARTLY)
    far = max(math.hypot(u - fit.lens[2], v - fit.lens[3]) for u in (0, size[0] - 1) for v in (0, size[1] - 1))
    return LensCalibration(
        record if reach >= far else replace(record, valid_radius_px=round(reach, 1)),
        kind,
        math.sqrt(fit.cost / fit.residuals.size),
        {one.words: math.sqrt(float(np.mean(each))) for one, each in errors.items()},
        lens_covariance[:4, :4],
        reach,
        tuple(views),
        sum(len(view.points) for view in given) - sum(len(view.points) for view in views),
        tuple(np.split(fit.residuals, np.cumsum([len(view.points) for view in views])[:-1])),
        share,
        _bend(fit, covariance, board, views),
        apart,
        (float(distances.min()), float(distances.max())),
    )


def _consistent(fit: LensFit, views: Sequence[View]) -> None:
    """Raise _Stranger if the corners do not fit one flat board and one lens, or one picture does not."""
    counts = np.cumsum([len(view.points) for view in views])[:-1]
    each = np.array([math.sqrt(float(np.mean(part**2))) for part in np.split(fit.residuals, counts)])
    rms = math.sqrt(fit.cost / fit.residuals.size)
    worst = int(np.argmax(each))
    if rms > MOST_RMS or each[worst] > max(WORST * float(np.median(each)), 0.5):
        raise _Stranger(
            views[worst].name,
            f"the corners fit one lens only to {rms:.2f} px rms, worst {views[worst].name} with {each[worst]:.2f} px;"
            " leave it out if it is blurred or of another camera; otherwise, is the board flat and stiff?",
            f"its corners are off by {each[worst]:.2f} px rms, half of all by at most {np.median(each):.2f}",
        )


# ---- which model, how sure -------------------------------------------------------------------------------------------


@np.errstate(over="ignore", invalid="ignore")
def _held_out(fit: LensFit, views: Sequence[View], size: tuple[int, int], board: BoardShape) -> Floats:
    """(P,) mean squared errors of every picture under a lens fitted to the others; infinite if it does not hold."""
    errors = np.full(len(views), np.inf)
    for fold in range(FOLDS):
        rest = [k for k in range(len(views)) if k % FOLDS != fold]
        lens = refine(without(fit, rest), [views[k] for k in rest], size, board=board)
        held = list(range(fold, len(views), FOLDS))
        posed = pose_views(lens, [views[k] for k in held], size, board)
        if posed is not None:
            parts = np.split(posed.residuals, np.cumsum([len(views[k].points) for k in held])[:-1])
            errors[held] = [float(np.mean(part**2)) for part in parts]
    return np.where(np.isfinite(errors), errors, np.inf)


def _choose(errors: dict[Candidate, Floats]) -> Candidate:
    """The first that predicts pictures as well as the best one.

    Errors are compared by their logarithms, picture by picture: one at the border, in which a wrong model is far off,
    would otherwise make the scatter so large that it counts as a tie.
    """
    whole = {one: np.log(np.maximum(each, TINY)) for one, each in errors.items() if np.isfinite(each).all()}
    if not whole:
        return min(errors, key=lambda one: int(np.isinf(errors[one]).sum()))
    best = min(whole, key=lambda one: float(np.mean(whole[one])))
    for one in (Candidate(kind, bend) for bend in (False, True) for kind in ORDER):
        if one in whole:
            worse = whole[one] - whole[best]
            tie = max(2.0 * worse.std(ddof=1) / math.sqrt(len(worse)), math.log1p(TIE))
            if worse.mean() <= tie:
                return one
    return best


def _scatter(fit: LensFit) -> float:
    """Variance of a corner's coordinate, estimated from the residuals, in square pixels."""
    unknowns = len(fit.lens) + len(fit.shape) + 6 * len(fit.t)
    return fit.cost / max(fit.residuals.size - unknowns, 1)


def _covariance(fit: LensFit) -> Floats:
    """(4 + K + S, 4 + K + S) of the lens and the board's shape if all that is wrong is the corners' own scatter."""
    information = fit.information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information * np.outer(scale, scale), 1e-13, hermitian=True)
    return np.asarray(_scatter(fit) * inverse * np.outer(scale, scale))


def _bend(fit: LensFit, covariance: Floats, board: BoardShape, views: Sequence[View]) -> Bend | None:
    if not len(fit.shape):
        return None
    points = np.unique(np.concatenate([view.points for view in views]), axis=0)
    modes = board.modes(points)
    heights = modes[:, 2] @ fit.shape
    apart = modes[int(np.argmax(heights)), 2] - modes[int(np.argmin(heights)), 2]
    P = covariance[len(fit.lens) :, len(fit.lens) :]
    return Bend(
        float(np.ptp(heights)),
        math.sqrt(max(float(apart @ P @ apart), 0.0)),
        2.0 * float(fit.shape[0]),
        2.0 * math.sqrt(max(float(P[0, 0]), 0.0)),
    )


def _disagreement(fit: LensFit) -> tuple[float, Floats]:
    """By how much pictures disagree about the lens, as a multiple of what their corners' scatter explains.

    Cochran's Q over its degrees of freedom, and its root (the Birge ratio of metrology): 1 if all pictures show one
    lens and one board; more if the board bends from picture to picture or errors of neighbouring corners are alike.
    Also each picture's part (P,) of it, squared: about 1, and many times that of the others if it alone differs.
    """
    total = fit.information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    Q, freedom = np.zeros(len(fit.t)), np.ones(len(fit.t))
    for k, (information, score) in enumerate(zip(fit.information, fit.scores, strict=True)):
        values, axes = np.linalg.eigh(information * np.outer(scale, scale))
        shown = values > LEAST_INFORMATION
        Q[k] = np.sum((axes[:, shown].T @ (score * scale)) ** 2 / values[shown]) / _scatter(fit)
        freedom[k] = max(int(shown.sum()), 1)
    return math.sqrt(float(Q.sum() / max(freedom.sum() - len(total), 1.0))), Q / freedom


def lens_sigmas(model: CameraModel, kind: LensKind, covariance: Floats, pixels: Floats) -> Floats:
    """How far a pixel may be off because the lens is not known exactly.

    A turn of the camera looks much like a shifted principal point and is found with the camera's pose; it is left out.

    Parameters
    ----------
    model : CameraModel
    kind : str
    covariance : (4 + K, 4 + K) array
        Of the lens.
    pixels : (N, 2) array
        Spread over the picture.

    Returns
    -------
    (N,) array
        Standard deviations along the worse axis, in pixels; infinite where the model does not hold.
    """
    camera = Camera(model)
    rays, valid = camera.rays(pixels)
    out = np.full(len(pixels), np.inf)
    lens = np.array([*model.matrix, *model.distortion])
    by_lens = lens_jacobian(kind, lens, rays[valid])
    _, by_point, _ = camera.project_jacobian(rays[valid])
    by_turn = (-by_point @ skew(rays[valid])).reshape(-1, 3)
    flat = by_lens.reshape(-1, len(lens))
    flat = flat - by_turn @ np.linalg.lstsq(by_turn, flat, rcond=None)[0]
    left = flat.reshape(by_lens.shape)
    out[valid] = np.sqrt(np.maximum(np.linalg.eigvalsh(left @ covariance @ left.transpose(0, 2, 1))[:, -1], 0.0))
    return out


def _grid(size: tuple[int, int]) -> Floats:
    """(N, 2) pixels spread over a picture."""
    v, u = np.meshgrid(np.linspace(0.0, size[1] - 1.0, 25), np.linspace(0.0, size[0] - 1.0, 33))
    return np.column_stack([u.ravel(), v.ravel()])


def _farthest(model: CameraModel, views: Sequence[View]) -> float:
    corners = np.concatenate([view.pixels for view in views])
    return float(np.linalg.norm(corners - model.matrix[2:], axis=1).max())


def _share(model: CameraModel, reach: float) -> float:
    """Of the picture, within so many pixels of the lens's centre."""
    return float(np.mean(np.linalg.norm(_grid(model.size) - model.matrix[2:], axis=1) <= reach))


def _reach(model: CameraModel, kind: LensKind, lens: Floats, covariance: Floats, views: Sequence[View]) -> float:
    """Up to the farthest corner, but not to where the lens is uncertain or folds over."""
    reach = _farthest(model, views)
    grid = _grid(model.size)
    away = np.linalg.norm(grid - lens[2:4], axis=1)
    near = away <= reach
    bad = lens_sigmas(model, kind, covariance, grid[near]) > MOST_SIGMA_PIXEL
    return float(away[near][bad].min(initial=reach))
