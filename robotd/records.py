"""Every record that flows between the parts, in SI units and the axes of ARCHITECTURE.md.

Records are immutable. Those that hold arrays compare by identity and their arrays are read-only.
`Survey` and `Map` and what they contain carry the keys of the `robotd-survey/1` and `robotd-map/1` files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .survey_records import (
    BeaconSighting as BeaconSighting,
    CameraModel as CameraModel,
    Candidate as Candidate,
    Floats as Floats,
    KnownLabel as KnownLabel,
    Map as Map,
    MappedLabel as MappedLabel,
    MappedSighting as MappedSighting,
    MappedStop as MappedStop,
    Matrix3 as Matrix3,
    Motion as Motion,
    Move as Move,
    OdometryState as OdometryState,
    Pose as Pose,
    Priors as Priors,
    Rig as Rig,
    RoofCamera as RoofCamera,
    Sighting as Sighting,
    Sigmas as Sigmas,
    SolverRun as SolverRun,
    Stop as Stop,
    Survey as Survey,
    Transform as Transform,
    Vector3 as Vector3,
)

# ---- from the hardware -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image.

    `t` is the loop time of the camera's own stamp (start of the exposure of the first row), in seconds.
    `image` is (H, W) uint8 grey, read-only. `sequence` counts frames of one stream; a gap is a dropped frame.
    `encoded` is the JPEG as the camera sent it, of which `image` is one channel, perhaps at a reduced size.
    """

    camera: str
    t: float
    image: NDArray[np.uint8]
    sequence: int = 0
    encoded: bytes | None = None

    def __post_init__(self) -> None:
        self.image.flags.writeable = False


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """What the base reported in one tick of its sensor stream.

    `t` is the loop time at which the base took the values (transmission time subtracted).
    `left` and `right` are metres travelled by each wheel since the driver was opened, forward positive.
    `mode` is "off", "passive", "safe", "full" or "unknown".
    """

    t: float
    left: float
    right: float
    mode: str
    bump_left: bool = False
    bump_right: bool = False
    wheel_drop_left: bool = False
    wheel_drop_right: bool = False
    cliff: bool = False
    overcurrent: bool = False
    voltage: float | None = None
    charge_fraction: float | None = None
    slipping: bool = False  # wheels and floor disagree: odometry is worse than usual
    docked: bool = False
    charging: bool = False
    resets: int = 0  # how often the wheel travel was interrupted: across a change unknown motion is missing


OPERATOR = "operator"  # the source whose wishes to move beat those of all others


@dataclass(frozen=True, slots=True)
class DriveCommand:
    """A wish to move: `speed` in m/s forward, `turn_rate` in rad/s counter-clockwise; valid for 0.2 s from `t`.

    `source` is the instance's name of a driver, or OPERATOR for a person.
    `line_t` is when the line that it follows was last seen (the stamp of that frame); None if it follows no line.
    """

    t: float
    speed: float
    turn_rate: float
    source: str
    line_t: float | None = None


@dataclass(frozen=True, slots=True)
class Withdrawal:
    """A source takes back its wishes to move up to `t` and says why: "line lost: ...", "the connection is gone".

    Its next wish to move counts again. `source` None is an operator's stop: it takes back everybody's wishes, and
    none counts until the operator asks for motion anew or resumes the mission.
    """

    t: float
    source: str | None
    cause: str


@dataclass(frozen=True, slots=True)
class Event:
    """Something an operator would want to read, in words."""

    t: float
    source: str
    level: Literal["info", "warning", "error"]
    text: str


MissionState = Literal["idle", "driving", "settling", "observing", "paused", "fault", "uploading", "done"]


@dataclass(frozen=True, slots=True)
class MissionStatus:
    """Where the mission is: `state` as drawn in ARCHITECTURE.md, stop `stop` of `stops`, and what it does in words."""

    t: float
    state: MissionState
    stop: int
    stops: int
    text: str = ""


# ---- from the detectors ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Flash:
    """A blinking light found in one camera.

    `u`, `v` in pixels with standard deviation `sigma` per axis; `score` is the log-likelihood ratio against noise;
    `phase` is the start of the pattern modulo its period in seconds; `amplitude` in grey levels;
    `saturated` says that the light clips the sensor, so that its centroid leans on the flanks; `covariance` is that of
    (u, v) in px^2 as (uu, uv, vv); `reflection` is the probability that it is another flash's reflection.
    """

    u: float
    v: float
    sigma: float
    score: float
    phase: float = 0.0
    amplitude: float = 0.0
    saturated: bool = False
    covariance: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reflection: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A line in the top view.

    Attributes
    ----------
    points : (N, 2) array
        u, v in pixels of the centre, ordered along the line, sub-pixel.
    width : float
        Pixels.
    confidence : float
        0..1.
    normals : (N, 2) array, optional
        Unit normals at the points: the tangent (along the points) turned by +90 degrees from u towards v.
    curvature : (N,) array, optional
        Radians per pixel, positive where the line turns from u towards v, fitted over three widths.
    polarity : "dark" or "bright", optional
        Of the line against the floor.
    closed : bool
        It comes back to its start.
    """

    points: Floats
    width: float
    confidence: float
    normals: Floats | None = None
    curvature: Floats | None = None
    polarity: Literal["dark", "bright"] | None = None
    closed: bool = False

    def __post_init__(self) -> None:
        for array in (self.points, self.normals, self.curvature):
            if array is not None:
                array.flags.writeable = False


LineState = Literal[
    "standing",  # nobody asks to follow
    "acquiring",  # no line yet
    "tracking",  # seen in the last frame
    "predicting",  # not seen in the last frame, or not in view at present: driving on what is remembered
    "searching near",  # found again by a search with relaxed limits around the prediction
    "searching all",  # found again by one of the whole view
    "coasting",  # nothing found: slowly on, what is remembered is wrong or covered
    "turning",  # on the spot, to the side on which the line was last
    "ended",  # its end was seen, and the robot stops there
    "lost",  # given up
]


@dataclass(frozen=True, slots=True)
class LineStatus:
    """How the follower is getting on, at every frame and every change of state.

    `confidence` 0..1 that what is followed is the line; `offset` metres of the robot to the left of the path,
    `heading_error` its heading against the path's; `unseen` metres driven since the line should have been seen.
    """

    t: float
    source: str
    state: LineState
    confidence: float
    offset: float = 0.0
    heading_error: float = 0.0
    unseen: float = 0.0


@dataclass(frozen=True, slots=True)
class LineMotion:
    """Motion between two frames as the line alone shows it, in robot axes at `t0`; odometry has no part in it.

    `information` is the inverse of the covariance of (dx, dy, dheading). Along a direction that the line does not
    show, e.g. that of a straight line, it is zero (the variance is infinite) and the motion given there means nothing.
    """

    t0: float
    t1: float
    dx: float
    dy: float
    dheading: float
    information: Matrix3


@dataclass(frozen=True, slots=True, eq=False)
class LinePoints:
    """Pieces of the line that are finished, because they lie behind the robot.

    `points` (N, 2) metres in odometry axes; `travelled` (N,) metres driven when the robot was abreast of them.
    """

    t: float
    source: str
    points: Floats
    travelled: Floats

    def __post_init__(self) -> None:
        self.points.flags.writeable = False
        self.travelled.flags.writeable = False


@dataclass(frozen=True, slots=True)
class Prompt:
    """A driver asks a person to do something; `number` is unique among the source's prompts of one run.

    An empty `text` takes back what the source asked before.
    """

    t: float
    source: str
    number: int
    text: str


@dataclass(frozen=True, slots=True)
class Answer:
    """What a person answers to a prompt of `source`, in words that the prompt explains."""

    t: float
    source: str
    number: int
    text: str


def assert_record_equal(left: Any, right: Any, *, atol: float = 0.0) -> None:
    """Compare two records field by field, arrays by value; raises AssertionError that names the field."""
    if type(left) is not type(right):
        raise AssertionError(f"{type(left).__name__} is not {type(right).__name__}")
    for name in left.__dataclass_fields__:
        a, b = getattr(left, name), getattr(right, name)
        if isinstance(a, np.ndarray):
            np.testing.assert_allclose(a, b, rtol=0.0, atol=atol, err_msg=name)
        elif a != b:
            raise AssertionError(f"{type(left).__name__}.{name}: {a!r} != {b!r}")
