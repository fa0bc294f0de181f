"""Whether a roof camera still looks where it looked when it was calibrated.

Corners of the fixed scene are followed from a reference picture into the present one (Lucas and Kanade). Both are
medians over some seconds, so that people in them do not count. A camera that was pushed moves all corners alike; things
that were moved in the shop move some. So a similarity is fitted to most of them, and only a motion that most share,
that is larger than the corners' own scatter explains, is called one of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

CORNERS = 150
LEAST_CORNERS = 12
LEAST_SHARE = 0.5  # of the corners, that must be found again and agree
MOST_PX = 1.0  # of motion anywhere in the picture that is no motion: heat, compression
AGREE_PX = 1.5
SIGMAS = 5.0
SPREAD_PX, LEAST_CONTRAST = 12.0, 4.0  # over which light is evened out, and grey levels that count as noise
SHARPEST = 7  # px, of the window that is followed


@dataclass(frozen=True, slots=True)
class SceneCheck:
    """The result: `verdict`, `shift_px` the largest motion of a corner of the picture by the fit, and how sure.

    `sigma_px` is the standard deviation of that motion; `corners` were found again of `wanted`, `share` of them agree.
    """

    verdict: Literal["still", "moved", "unknown"]
    shift_px: float
    sigma_px: float
    corners: int
    wanted: int
    share: float


def median_picture(frames: Sequence[Image]) -> Image:
    """The median of some frames, taken seconds apart: what stands still."""
    return np.asarray(np.median(np.stack(frames), axis=0), np.uint8)


def check_scene(reference: Image, present: Image) -> SceneCheck:
    """Compare two pictures (H, W) of one camera.

    "unknown" means that too little of the reference was found again: darkness, a covered lens, a rebuilt shop.
    """
    if reference.shape != present.shape:
        return SceneCheck("moved", float("inf"), 0.0, 0, 0, 0.0)
    reference, present = _even(reference), _even(present)
    corners = cv2.goodFeaturesToTrack(reference, CORNERS, 0.02, 12.0)
    if corners is None or len(corners) < LEAST_CORNERS:
        return SceneCheck("unknown", 0.0, 0.0, 0, 0 if corners is None else len(corners), 0.0)
    window = (2 * SHARPEST + 1, 2 * SHARPEST + 1)
    # OpenCV's types do not know that the points to start from may be left out
    follow: Any = cv2.calcOpticalFlowPyrLK
    there, found, _ = follow(reference, present, corners, None, winSize=window, maxLevel=4)
    back, again, _ = follow(present, reference, there, None, winSize=window, maxLevel=4)
    a, b = corners.reshape(-1, 2).astype(np.float64), there.reshape(-1, 2).astype(np.float64)
    loop = np.linalg.norm(back.reshape(-1, 2) - a, axis=1)
    good = (found.ravel() > 0) & (again.ravel() > 0) & (loop < 0.5)
    wanted, count = len(a), int(good.sum())
    if count < LEAST_CORNERS or count < LEAST_SHARE * wanted * 0.5:
        return SceneCheck("unknown", 0.0, 0.0, count, wanted, 0.0)
    fit, inlier = cv2.estimateAffinePartial2D(a[good], b[good], method=cv2.RANSAC, ransacReprojThreshold=AGREE_PX)
    if fit is None:
        return SceneCheck("unknown", 0.0, 0.0, count, wanted, 0.0)
    agreeing = inlier.ravel() > 0
    share = float(agreeing.mean())
    height, width = reference.shape
    edge = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    shift = float(np.linalg.norm(edge @ fit[:, :2].T + fit[:, 2] - edge, axis=1).max())
    miss = b[good][agreeing] - (a[good][agreeing] @ fit[:, :2].T + fit[:, 2])
    scatter = float(np.sqrt(np.mean(miss**2)))
    # at the picture's corner a similarity is some three times less sure than in the middle of its points
    sigma = 3.0 * max(scatter, 0.05) / np.sqrt(max(1, int(agreeing.sum())))
    if share < LEAST_SHARE:
        return SceneCheck("unknown", shift, sigma, count, wanted, share)
    moved = shift > MOST_PX and shift > SIGMAS * sigma
    return SceneCheck("moved" if moved else "still", shift, sigma, count, wanted, share)


def _even(image: Image) -> Image:
    """The picture with its local mean and contrast taken out, because light changes through the day."""
    light = image.astype(np.float32)
    rest = light - cv2.GaussianBlur(light, (0, 0), SPREAD_PX)
    contrast = np.sqrt(cv2.GaussianBlur(rest * rest, (0, 0), SPREAD_PX))
    return np.asarray(np.clip(128.0 + 40.0 * rest / (contrast + LEAST_CONTRAST), 0, 255), np.uint8)
