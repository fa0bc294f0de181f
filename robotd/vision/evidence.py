"""How sure a traced piece is a line and not a pattern of the floor."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..records import Floats, Line

Singles = NDArray[np.float32]

# What `judge` measures, with the weight of each in a logistic sum. They were fitted, with the signs that reason
# demands, to what is traced with and without tape: tape drawn over photographs of wood, tiles, stone, steel, brick,
# grass and gravel, drawn scenes of `tests/lines`, and drawn stains. What fitted to nothing is kept at 0, so that a new
# fit can weigh it. Four were set by hand, because few of the fit's floors have what they refuse. The borders' share: of
# that tape 99 % has 0.65 or more, smooth stains have about 0.5. The weaker side, the floor farther off, the change
# of the width: of that tape 95 % pays nothing, strips between joints and shadows have shares about 0.1.
WITNESSES = {
    "bias": -11.04,
    "length in widths, log": 0.99,  # a close camera sees 3 to 6
    "change of the width along the line beyond 0.08, in tenths": -2.0,  # two borders that merely converge
    "share of the contrast that lies right at the borders, as far as it is below 0.7, log": 8.0,  # tape has edges
    "deviation of the stroke widths, in tenths of a width": -1.09,
    "distance of stroke centres from the polyline, in tenths of a width": 0.0,
    "contrast over its scatter along the line, log": 0.0,
    "contrast in grey levels, log": 0.71,
    "contrast of the weaker side, as far as its share is below 0.65, log": 3.0,  # a strip along a shadow's edge
    "share of cuts with contrast on both sides": 0.0,
    "contrast over the scatter of grey levels across the line, log": 2.00,
    "contrast over their change along it, log": 0.46,
    "turn from width to width, log": 0.0,
    "share of all strokes in the image, log": 1.10,  # a pattern fills the picture
    "share of the length of all pieces, log": 0.06,
    "working width, log": 2.20,  # fine texture pairs up by chance
    # what looks like the line again within 1.25 widths is a strip beside a joint, or one stripe of many
    "contrast with the floor farther off, as far as its share is below 0.5, log": 2.0,
}
WEIGHTS = np.array(list(WITNESSES.values()))
FEW = 4.0  # lines that one picture of a floor may well hold: a crossing, a fork, two parallels
RIVAL = 1.0
# Beside a sure line a doubtful one of its width and colour is likely more of the same tape, as weak edges that touch
# strong ones are edges (Canny 1986); on a bare floor nothing is sure.
SUPPORTED = 0.15  # confidence that is enough there
SAME_WIDTH = 0.22  # by which the logarithms of two widths of one tape may differ


def confidence(evidence: Singles, lengths: Singles, doubt: float) -> Floats:
    """How sure each piece is a line, 0..1: a logistic sum of the evidence (P, 17), less `doubt`.

    Then the pieces compete: one that shares the picture with more than `FEW` as long and as likely is part of a pattern
    (boards, stripes, a checkerboard), and loses `RIVAL` for each that is too many. `lengths` (P,) are the pieces'.
    """
    logit = np.clip(evidence[:, 1:] @ WEIGHTS[1:] + (WEIGHTS[0] - doubt), -30.0, 30.0)
    sure = np.where(evidence[:, 0] > 0.0, 1.0 / (1.0 + np.exp(-logit)), 0.0)
    if sure.sum() > FEW:
        rivals = np.minimum(lengths[None, :] / lengths[:, None], 1.0) @ sure
        logit -= RIVAL * np.maximum(rivals - FEW, 0.0)
        sure = np.where(evidence[:, 0] > 0.0, 1.0 / (1.0 + np.exp(-logit)), 0.0)
    return np.asarray(sure)


def believed(lines: Sequence[Line], least: float) -> list[Line]:
    """Those that are `least` sure, and those that are less so but support one that is; in the same order."""
    sure = [line for line in lines if line.confidence >= least]
    return [
        line
        for line in lines
        if line.confidence >= least
        or (line.confidence >= SUPPORTED and any(_is_same_tape(line, other) for other in sure))
    ]


def _is_same_tape(one: Line, other: Line) -> bool:
    return one.polarity == other.polarity and abs(math.log(one.width / other.width)) <= SAME_WIDTH


def without_doubles(lines: list[Line]) -> list[Line]:
    """Best first, without those that mostly lie on a better one: the same tape found at two scales."""
    kept: list[Line] = []
    for line in sorted(lines, key=lambda line: -line.confidence):
        for other in kept:
            gaps = line.points[::2, None, :] - other.points[None, ::2, :]
            nearest = np.sqrt((gaps**2).sum(axis=2).min(axis=1))
            if np.mean(nearest < 0.5 * max(line.width, other.width)) > 0.5:
                break
        else:
            kept.append(line)
    return kept
