"""How a label flashes, from the recording that `robotctl calibrate flash` makes of it."""

from __future__ import annotations

from pathlib import Path

from .errors import InputError
from .recording import read_frames
from .vision.learn_pattern import learn_pattern
from .vision.pattern_fit import LearntPattern

_LEAST_S = 3.0  # of footage from which a pattern is learnt


def learn_recorded(
    file: Path, camera: str, asked: float, seconds: float, exposure: float, gamma: float
) -> tuple[LearntPattern, float, float]:
    """The pattern in a recording, of which nobody knows when the label began to flash; and from when to when it shows.

    Parameters
    ----------
    file : Path
        MCAP.
    camera : str
    asked, seconds : float
        When the label was asked, on the recording's clock, and how long it flashes.
    exposure : float
        Seconds.
    gamma : float
        Of the camera's curve.

    Raises
    ------
    InputError
        If it shows no pattern; the message says what is missing.
    """
    frames = [frame for frame in read_frames(file, camera) if frame.t >= asked]
    problem = InputError(f"{file}: it has no frames of camera {camera} after the label was asked")
    start, length = asked, max(_LEAST_S, 0.6 * seconds)
    while frames and start + length <= frames[-1].t + 0.5:
        part = [frame for frame in frames if start <= frame.t < start + length]
        try:
            learnt = learn_pattern([frame.image for frame in part], [frame.t for frame in part], exposure, gamma)
        except InputError as error:
            problem = error
        else:
            return learnt, start, start + length
        start += 0.25 * length
    raise problem
