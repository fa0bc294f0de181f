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

import numpy as np

from ..errors import SolverError
from ..geometry.camera import Camera
from ..geometry.transforms import skew
from ..records import CameraModel, Floats
from .lens_fit import LensFit, LensKind, View, camera_model, fit_lens, lens_jacobian, pose_views, refine, without

LEAST_VIEWS = 8  # different pictures: Zhang (PAMI 22(11), 2000) needs 3, and held-out pictures must stay out
LEAST_MOVE = 0.01  # of the picture's width, by which corners must differ between different pictures
LEAST_TURN = math.radians(20.0)  # between the boards' planes
LEAST_DEPTH = 1.3  # ratio of the farthest board to the nearest
BORDER = (
    0.25  # of the picture's side: corners must come as near to each border; what lies beyond them `_reach` leaves out
)
MOST_RMS = 1.0  # px
MOST_SIGMA_FOCAL = 0.01  # of the focal length
MOST_SIGMA_PIXEL = 0.5  # px, up to which the lens is called valid
WORST = 5.0  # times the median of all pictures: the rms of one that does not belong to them
FOLDS = 5
TIE = 0.02  # of the held-out squared error: less is not worth another model
ORDER: tuple[LensKind, ...] = ("brown-conrady", "fisheye", "rational")  # on a tie the first one


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
    residuals : tuple of (N, 2) arrays, one per picture
        Fitted less seen corners, in pixels.
    """

    camera: CameraModel
    kind: LensKind
    rms_px: float
    held_out_px: dict[str, float]
    covariance: Floats
    reach_px: float
    residuals: tuple[Floats, ...]

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

    Chosen is the first of `ORDER` whose held-out squared error is not worse than the best one's by more than 2 %, or
    than twice the standard error of the difference over the pictures.

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
        Refuse corners that leave out a border of the picture. False for a fisheye's round image, or if only the middle
        is of use: `valid_radius_px` says how far the lens holds.

    Raises
    ------
    SolverError
        If the pictures do not determine the lens; the message names all that is missing.
    """
    missing = _too_few(views, size)
    if whole:
        missing += _border(views, size)
    if missing:
        raise SolverError(_refusal(missing))
    fits = {kind: fit for kind in ORDER if kind in kinds and (fit := fit_lens(kind, views, size)) is not None}
    if not fits:
        raise SolverError("no lens model fits the corners; is the board flat, and are all pictures from one camera?")
    errors = {kind: _held_out(fit, views, size) for kind, fit in fits.items()}
    kind = _choose(errors)
    fit = fits[kind]
    _consistent(fit, views)
    lens_covariance = _covariance(fit)
    missing = _flat(fit, views)
    relative = float((np.sqrt(np.diag(lens_covariance))[:2] / fit.lens[:2]).max())
    if not relative <= MOST_SIGMA_FOCAL and not missing:
        missing = [
            f"the focal length stays uncertain by {100.0 * relative:.1f} %; take more pictures, with the board larger"
            " in view and tilted by 30 to 45 degrees about both its sides"
        ]
    if missing:
        raise SolverError(_refusal(missing))
    record = camera_model(kind, fit.lens, size, name)
    reach = _reach(record, kind, fit.lens, lens_covariance, views)
    far = max(math.hypot(u - fit.lens[2], v - fit.lens[3]) for u in (0, size[0] - 1) for v in (0, size[1] - 1))
    return LensCalibration(
        record if reach >= far else replace(record, valid_radius_px=round(reach, 1)),
        kind,
        math.sqrt(fit.cost / fit.residuals.size),
        {one: math.sqrt(float(np.mean(each))) for one, each in errors.items()},
        lens_covariance[:4, :4],
        reach,
        tuple(np.split(fit.residuals, np.cumsum([len(view.points) for view in views])[:-1])),
    )


# ---- what is missing -------------------------------------------------------------------------------------------------


def _refusal(missing: Sequence[str]) -> str:
    return "the pictures do not determine the lens: " + "; ".join(missing)


def _too_few(views: Sequence[View], size: tuple[int, int]) -> list[str]:
    """A board that stayed where it was tells nothing new."""
    different: list[View] = []
    for view in views:
        if not any(
            one.pixels.shape == view.pixels.shape
            and np.abs(one.pixels - view.pixels).max() < LEAST_MOVE * size[0]
            and np.array_equal(one.points, view.points)
            for one in different
        ):
            different.append(view)
    if len(different) >= LEAST_VIEWS:
        return []
    again = f" ({len(views)}, but in some the board did not move)" if len(different) < len(views) else ""
    return [f"{len(different)} different pictures{again}; take {LEAST_VIEWS} or more, 20 are better"]


def _border(views: Sequence[View], size: tuple[int, int]) -> list[str]:
    corners = np.concatenate([view.pixels for view in views])
    low, high = corners.min(axis=0) / size, 1.0 - corners.max(axis=0) / size
    gaps = {"left": low[0], "right": high[0], "upper": low[1], "lower": high[1]}
    wide = {side: gap for side, gap in gaps.items() if gap > BORDER}
    if not wide:
        return []
    where = ", ".join(f"{side} ({math.ceil(100.0 * gap)} %)" for side, gap in wide.items())
    return [
        f"no corner lies near the {where} border, where the lens bends most; hold the board there, to within"
        f" {100.0 * BORDER:.0f} % of the picture"
    ]


def _flat(fit: LensFit, views: Sequence[View]) -> list[str]:
    missing = []
    normals = fit.R[:, :, 2]
    turn = float(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0)).max())
    if turn < LEAST_TURN:
        missing.append(
            f"the boards are tilted by only {math.degrees(turn):.0f} degrees against each other, so the focal length"
            f" cannot be told from the distance; tilt them by 30 to 45 degrees, to all sides"
        )
    middles = np.array([R @ view.points.mean(axis=0) + t for R, t, view in zip(fit.R, fit.t, views, strict=True)])
    distances = np.linalg.norm(middles, axis=1)
    if distances.max() < LEAST_DEPTH * distances.min():
        missing.append(
            f"the boards are all at nearly the same distance ({distances.min():.2f} to {distances.max():.2f} m); hold"
            " some at half the distance and some at twice"
        )
    return missing


def _consistent(fit: LensFit, views: Sequence[View]) -> None:
    """Raise SolverError if the corners do not fit one flat board and one lens, or one picture does not."""
    counts = np.cumsum([len(view.points) for view in views])[:-1]
    each = np.array([math.sqrt(float(np.mean(part**2))) for part in np.split(fit.residuals, counts)])
    rms = math.sqrt(fit.cost / fit.residuals.size)
    worst = int(np.argmax(each))
    if rms > MOST_RMS or each[worst] > max(WORST * float(np.median(each)), 0.5):
        raise SolverError(
            f"the corners fit one lens only to {rms:.2f} px rms, worst {views[worst].name} with {each[worst]:.2f} px;"
            " leave it out if it is blurred or of another camera; otherwise, is the board flat and stiff?"
        )


# ---- which model, how sure -------------------------------------------------------------------------------------------


def _held_out(fit: LensFit, views: Sequence[View], size: tuple[int, int]) -> Floats:
    """(P,) mean squared errors of every picture under a lens fitted to the others; infinite if it does not hold."""
    errors = np.full(len(views), np.inf)
    for fold in range(FOLDS):
        held = [k for k in range(len(views)) if k % FOLDS == fold]
        rest = [k for k in range(len(views)) if k % FOLDS != fold]
        lens = refine(without(fit, rest), [views[k] for k in rest], size)
        posed = pose_views(lens, [views[k] for k in held], size)
        if posed is not None:
            parts = np.split(posed.residuals, np.cumsum([len(views[k].points) for k in held])[:-1])
            errors[held] = [float(np.mean(part**2)) for part in parts]
    return errors


def _choose(errors: dict[LensKind, Floats]) -> LensKind:
    best = min(errors, key=lambda kind: float(np.mean(errors[kind])))
    for kind in ORDER:
        if kind in errors and np.isfinite(errors[kind]).all():
            worse = errors[kind] - errors[best]
            tie = max(2.0 * worse.std(ddof=1) / math.sqrt(len(worse)), TIE * float(np.mean(errors[best])))
            if worse.mean() <= tie:
                return kind
    return best


def _covariance(fit: LensFit) -> Floats:
    """(4 + K, 4 + K) of the lens, with the corners' scatter estimated from the residuals."""
    unknowns = len(fit.lens) + 6 * len(fit.t)
    scatter = fit.cost / max(fit.residuals.size - unknowns, 1)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fit.information), 1e-300))
    return np.asarray(
        scatter
        * np.linalg.pinv(fit.information * np.outer(scale, scale), 1e-13, hermitian=True)
        * np.outer(scale, scale)
    )


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


def _reach(model: CameraModel, kind: LensKind, lens: Floats, covariance: Floats, views: Sequence[View]) -> float:
    """Up to the farthest corner, but not to where the lens is uncertain or folds over."""
    corners = np.concatenate([view.pixels for view in views])
    reach = float(np.linalg.norm(corners - lens[2:4], axis=1).max())
    v, u = np.meshgrid(np.linspace(0.0, model.size[1] - 1.0, 25), np.linspace(0.0, model.size[0] - 1.0, 33))
    grid = np.column_stack([u.ravel(), v.ravel()])
    away = np.linalg.norm(grid - lens[2:4], axis=1)
    near = away <= reach
    bad = lens_sigmas(model, kind, covariance, grid[near]) > MOST_SIGMA_PIXEL
    return float(away[near][bad].min(initial=reach))
