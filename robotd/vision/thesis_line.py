"""The thesis's own line detector, as the baseline that ours is measured against: sections 5.2.3, 5.2.4 and 6.3.7.

It is kept to the letter, with the errata's readings where the letter contradicts itself (B9, B11-B13, B15, B16): start
and end pixels by the sign of the column gradient (blind to horizontal lines, B10), the first end pixel on the way, the
minimum map, the score by equal neighbours, density clusters in four dimensions, and 10:1 as the length of a line. Only
the order of a cluster's points, which the thesis leaves open, is ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats, Line
from . import polyline_reference
from .cluster import dbscan

try:
    from . import _polyline as tracing
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    tracing = polyline_reference  # type: ignore[misc]

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ThesisConfig:
    """The thesis's thresholds; those that it names without a number are the ones that its pictures suggest."""

    threshold: int = 120  # t of equations 76 and 77
    deviation: float = math.radians(10.0)  # delta of section 5.2.3 and figure 46
    kernel: int = 7  # d of equation 61
    ratio: float = 1.25  # r of equation 61
    score: float = 0.3  # least v of equation 62
    weights: tuple[float, float, float] = (1.0, 0.5, 8.0)  # c1, c2, c3 of the paper's equation 15: px, px, rad
    eps: float = 6.0
    neighbours: int = 6
    length_to_width: float = 10.0  # t_l:w of equation 64, section 7.4.3


def detect_thesis(
    gray: Bytes,
    valid: Bytes | None,
    polarity: Literal["dark", "bright", "both"],
    width_px: tuple[float, float],
    config: ThesisConfig = ThesisConfig(),
) -> list[Line]:
    """Lines in a top view, as the thesis finds them, the one with most strokes first.

    Parameters
    ----------
    gray : (H, W) uint8 array
    valid : (H, W) uint8 array, 1 where the view may be used, or None for everywhere.
    width_px : (least, greatest) stroke length.

    Returns
    -------
    list of Line
        Their confidence is the mean score (equation 62) of the cluster's strokes.
    """
    signs = {"dark": (-1.0,), "bright": (1.0,), "both": (-1.0, 1.0)}[polarity]
    lines: list[tuple[int, Line]] = []
    for sign in signs:
        centres, lengths, gamma, score = _strokes(gray, valid, sign, width_px, config)
        kept = score >= config.score
        centres, lengths, gamma, score = centres[kept], lengths[kept], gamma[kept], score[kept]
        if len(centres) < config.neighbours:
            continue
        c1, c2, c3 = config.weights
        # equation 15 of the paper; half of the doubled angle's cosine and sine, because the angle is periodic
        turned = 0.5 * c3 * np.column_stack([np.cos(2.0 * gamma), np.sin(2.0 * gamma)])
        vector = np.column_stack([c1 * centres, c2 * lengths, turned])
        labels, _ = dbscan(vector, config.eps, config.neighbours)
        for label in range(int(labels.max()) + 1):
            members = np.flatnonzero(labels == label)
            width = float(lengths[members].mean())
            extent = float(np.ptp(centres[members], axis=0).max())  # equation 65
            if extent <= config.length_to_width * width:  # equation 64
                continue
            points = _ordered(centres[members], gamma[members], width)
            if len(points) > 1:
                name: Literal["dark", "bright"] = "dark" if sign < 0.0 else "bright"
                lines.append((len(members), Line(points, width, float(score[members].mean()), polarity=name)))
    lines.sort(key=lambda item: -item[0])
    return [line for _, line in lines]


def _strokes(
    gray: Bytes, valid: Bytes | None, sign: float, width_px: tuple[float, float], config: ThesisConfig
) -> tuple[Floats, Floats, Floats, Floats]:
    """Centres (N, 2), lengths, angles of the strokes modulo pi, and scores at their centres."""
    column, row = cv2.Sobel(gray, cv2.CV_16S, 1, 0), cv2.Sobel(gray, cv2.CV_16S, 0, 1)
    magnitude = np.abs(column.astype(np.int32)) + np.abs(row.astype(np.int32))  # equation 75
    strong = magnitude > config.threshold
    if valid is not None:
        strong &= cv2.erode(valid, np.ones((3, 3), np.uint8)) > 0
    start, end = strong & (column > 0), strong & (column <= 0)  # equations 76 and 77
    v, u = np.nonzero(start)
    alpha = np.arctan2(row[v, u].astype(np.float64), column[v, u].astype(np.float64))
    step = sign * np.column_stack([np.cos(alpha), np.sin(alpha)])
    place = np.column_stack([u, v]).astype(np.float64)
    length = np.zeros(len(u))
    height, width = gray.shape
    walking = np.ones(len(u), dtype=bool)
    for far in range(1, int(width_px[1]) + 2):
        active = np.flatnonzero(walking)
        at = np.floor(place[active] + far * step[active] + 0.5).astype(int)
        inside = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
        walking[active[~inside]] = False
        active, at = active[inside], at[inside]
        hit = end[at[:, 1], at[:, 0]]
        length[active[hit]] = far
        walking[active[hit]] = False
    found = (length > width_px[0]) & (length < width_px[1])  # equation 11 of the paper
    place, step, length, alpha = place[found], step[found], length[found], alpha[found]
    stop = np.floor(place + length[:, None] * step + 0.5).astype(int)
    beta = np.arctan2(row[stop[:, 1], stop[:, 0]].astype(np.float64), column[stop[:, 1], stop[:, 0]].astype(np.float64))
    delta = np.abs(np.remainder(alpha - beta, 2.0 * np.pi) - np.pi)  # alpha - pi - beta, wrapped
    found = delta < config.deviation
    place, step, length, alpha = place[found], step[found], length[found], alpha[found]
    score = _scores(gray.shape, place, step, length, config)
    centres = place + 0.5 * length[:, None] * step
    at = np.floor(centres + 0.5).astype(int)
    gamma = np.remainder(alpha, np.pi)
    return centres, length, gamma, score[at[:, 1], at[:, 0]]


def _scores(size: tuple[int, ...], place: Floats, step: Floats, length: Floats, config: ThesisConfig) -> Floats:
    """The share of each pixel's neighbours with about its stroke length: the minimum map, and equations 61 and 62."""
    marks = np.full(size, np.inf)
    for far in range(int(length.max(initial=0.0)) + 1):
        covered = length >= far
        at = np.floor(place[covered] + far * step[covered] + 0.5).astype(int)
        np.minimum.at(marks, (at[:, 1], at[:, 0]), length[covered])  # equation 12 of the paper
    reach = config.kernel // 2
    padded = np.pad(marks, reach, constant_values=np.inf)
    here = np.where(np.isfinite(marks), marks, 1.0)
    equal = np.zeros(size)
    for dv in range(config.kernel):
        for du in range(config.kernel):
            other = padded[dv : dv + size[0], du : du + size[1]] / here
            equal += (other >= 1.0 / config.ratio) & (other <= config.ratio)
    return np.where(np.isfinite(marks), equal / config.kernel**2, 0.0)


def _ordered(centres: Floats, gamma: Floats, width: float) -> Floats:
    """The centres of a cluster as one polyline (N, 2): the longest way through it."""
    along = int(np.ptp(centres[:, 1]) > np.ptp(centres[:, 0]))
    order = np.argsort(centres[:, along].astype(int), kind="stable")
    rows = np.column_stack(
        [centres, -np.sin(gamma), np.cos(gamma), np.full(len(centres), width), np.ones(len(centres))]
    )[order].astype(np.float32)
    count = len(rows)
    points, pieces = np.empty((4 * count + 64, 2), np.float32), np.empty((8, 11), np.float32)
    found = tracing.trace(
        rows, np.ones(count, np.int32), np.array([0, count], np.int32), np.array([along], np.int32),
        math.cos(math.radians(45.0)), 0.5, 1.0, np.empty(count, np.uint8), np.empty((count, 2), np.float32),
        np.empty((count + 32, 2), np.float32), np.empty((count + 32, 2), np.float32), points, pieces,
    )  # fmt: skip
    if found == 0:
        return np.empty((0, 2))
    start, size = (int(x) for x in pieces[int(pieces[:found, 10].argmax()), :2])
    return points[start : start + size].astype(np.float64)
