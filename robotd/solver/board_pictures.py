"""What pictures of a board must show before a lens can be told from them: enough places, tilts, distances, borders."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..records import Floats
from .lens_fit import LensFit, View

LEAST_VIEWS = 8  # different pictures: Zhang (PAMI 22(11), 2000) needs 3, and held-out pictures must stay out
LEAST_MOVE = 0.01  # of the picture's width, by which corners must differ between different pictures
LEAST_TURN = math.radians(20.0)  # between the boards' planes
LEAST_DEPTH = 1.3  # ratio of the farthest board to the nearest
BORDER = 0.25  # of the picture's side: corners must come as near to each border. Drawn lenses with 0.15 px of what no
# model has, corners up to a quarter from one border: errors there reach 0.46 px; up to 35 %, 0.92 px


def refusal(missing: Sequence[str]) -> str:
    return "the pictures do not determine the lens: " + "; ".join(missing)


def too_few(views: Sequence[View], size: tuple[int, int]) -> list[str]:
    """A board that stayed where it was tells nothing new."""
    different: list[dict[tuple[float, ...], Floats]] = []
    for view in views:
        seen = dict(zip(map(tuple, view.points.tolist()), view.pixels, strict=True))
        if not any(_same(seen, one, LEAST_MOVE * size[0]) for one in different):
            different.append(seen)
    if len(different) >= LEAST_VIEWS:
        return []
    again = f" ({len(views)}, but in some the board did not move)" if len(different) < len(views) else ""
    pictures = "picture" if len(different) == 1 else "pictures"
    return [f"{len(different)} different {pictures}{again}; take {LEAST_VIEWS} or more, 20 are better"]


def _same(a: dict[tuple[float, ...], Floats], b: dict[tuple[float, ...], Floats], most: float) -> bool:
    """Whether the corners that two pictures share, half of them or more, are within so many pixels of each other."""
    both = a.keys() & b.keys()
    return 2 * len(both) >= max(len(a), len(b)) and all(np.abs(a[one] - b[one]).max() < most for one in both)


def empty_borders(views: Sequence[View], size: tuple[int, int]) -> list[str]:
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


def distances_of(fit: LensFit, views: Sequence[View]) -> Floats:
    """(P,) metres from the camera to the middle of each board."""
    middles = [R @ view.points.mean(axis=0) + t for R, t, view in zip(fit.R, fit.t, views, strict=True)]
    return np.asarray(np.linalg.norm(middles, axis=1))


def too_alike(fit: LensFit, distances: Floats) -> list[str]:
    missing = []
    normals = fit.R[:, :, 2]
    turn = float(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0)).max())
    if turn < LEAST_TURN:
        missing.append(
            f"the boards are tilted by only {math.degrees(turn):.0f} degrees against each other, so the focal length"
            f" cannot be told from the distance; tilt them by 30 to 45 degrees, to all sides"
        )
    if distances.max() < LEAST_DEPTH * distances.min():
        missing.append(
            f"the boards are all at nearly the same distance ({distances.min():.2f} to {distances.max():.2f} m); hold"
            " some at half the distance and some at twice"
        )
    return missing
