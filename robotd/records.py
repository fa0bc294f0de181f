"""Every record that flows between the parts, in SI units and the axes of ARCHITECTURE.md.

Records are immutable. Those that hold arrays compare by identity and their arrays are read-only.
`Survey` and `Map` and what they contain carry the keys of the `robotd-survey/1` and `robotd-map/1` files.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Vector3 = tuple[float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Floats = NDArray[np.float64]


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


# ---- motion ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Pose:
    """Planar pose of the robot: metres, heading in radians counter-clockwise from x, wrapped to (-pi, pi]."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True, slots=True)
class Move:
    """Motion between two stops (dx, dy in metres, dheading in radians) in the earlier robot frame, with covariance."""

    dx: float
    dy: float
    dheading: float
    covariance: Matrix3


@dataclass(frozen=True, slots=True)
class Motion:
    """The same motion as another sensor than the wheels saw it; `source` names it, e.g. "gyro" or "line".

    `information` is the inverse of the covariance of (dx, dy, dheading): zero along what the sensor does not show, as
    all of dx and dy are for a gyro.
    """

    source: str
    dx: float
    dy: float
    dheading: float
    information: Matrix3


@dataclass(frozen=True, slots=True)
class OdometryState:
    """Dead reckoning at time `t`: pose in the odometry frame and metres driven since the start of the leg."""

    t: float
    pose: Pose
    travelled: float
    speed: float = 0.0
    turn_rate: float = 0.0


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


# ---- survey: what the robot brings home (robotd-survey/1) ------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Transform:
    """Rigid transform: rotation vector in radians, translation in metres."""

    rotation: Vector3
    translation: Vector3


@dataclass(frozen=True, slots=True)
class CameraModel:
    """One calibrated camera: `matrix` is fx, fy, cx, cy in pixels; `distortion` in OpenCV's order."""

    name: str
    size: tuple[int, int]
    matrix: tuple[float, float, float, float]
    T_robot_camera: Transform
    model: Literal["brown-conrady", "fisheye"] = "brown-conrady"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    valid_radius_px: float | None = None


@dataclass(frozen=True, slots=True)
class Rig:
    """The robot's set of fixed cameras, seen as one generalised camera, and its beacons (robot axes, metres)."""

    cameras: tuple[CameraModel, ...]
    beacons: dict[str, Vector3] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Default standard deviations of image measurements, in pixels."""

    pixel_px: float = 1.0
    roof_px: float = 1.0


@dataclass(frozen=True, slots=True)
class Priors:
    """One-sigma bounds on what the solver refines; 0 means exact and held fixed."""

    tilt_rad: float = 0.0
    camera_rotation_rad: float = 0.0
    camera_translation_m: float = 0.0
    focal_px: float = 0.0
    centre_px: float = 0.0
    odometry_scale: float = 0.0
    odometry_turn: float = 0.0
    odometry_drift: float = 0.0  # rad/m, by which unequal wheels turn the robot on a straight
    beacon_m: float = 0.0


@dataclass(frozen=True, slots=True)
class KnownLabel:
    """A label whose world position was measured by hand."""

    label: str
    position: Vector3
    sigma_m: float = 0.005


@dataclass(frozen=True, slots=True)
class RoofCamera:
    """A camera on the ceiling; `H_world_image` maps undistorted pixels to world x, y at the beacons' height.

    `covariance` (9 x 9) is that of the inverse's numbers, row by row, at unit norm; None: the homography is exact.
    """

    name: str
    size: tuple[int, int]
    H_world_image: Matrix3
    covariance: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True, slots=True)
class Sighting:
    """A flash matched to a label id; several of one label by one camera at one stop are rival candidates."""

    camera: str
    label: str
    u: float
    v: float
    sigma_px: float | None = None
    probability: float | None = None


@dataclass(frozen=True, slots=True)
class BeaconSighting:
    """A beacon of the robot found by a roof camera, in undistorted pixels."""

    roof_camera: str
    beacon: str
    u: float
    v: float
    sigma_px: float | None = None


@dataclass(frozen=True, slots=True)
class Stop:
    """A halt at which labels were mapped; `move` and `motions` lead here from the stop before it in the same leg."""

    leg: int
    stop: int
    time: str
    odometry: Pose
    move: Move | None
    sightings: tuple[Sighting, ...] = ()
    beacon_sightings: tuple[BeaconSighting, ...] = ()
    motions: tuple[Motion, ...] = ()


@dataclass(frozen=True, slots=True)
class Survey:
    """Calibration and stops: everything the solver needs."""

    survey: str
    rig: Rig
    stops: tuple[Stop, ...]
    created: str | None = None
    sigmas: Sigmas = field(default_factory=Sigmas)
    priors: Priors = field(default_factory=Priors)
    known_labels: tuple[KnownLabel, ...] = ()
    roof_cameras: tuple[RoofCamera, ...] = ()
    format: Literal["robotd-survey/1"] = "robotd-survey/1"


# ---- map: what the solver returns (robotd-map/1) ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Candidate:
    """One of several positions that explain an ambiguous label; `cost` is half its whitened squared residuals."""

    position: Vector3
    cost: float


@dataclass(frozen=True, slots=True)
class MappedLabel:
    """Where a label is (world metres, with covariance), or the reason why that is not known."""

    label: str
    status: Literal["placed", "known", "ambiguous", "unplaced"]
    position: Vector3 | None = None
    covariance: Matrix3 | None = None
    sightings: int = 0
    inliers: int = 0
    reason: str | None = None
    candidates: tuple[Candidate, ...] = ()


@dataclass(frozen=True, slots=True)
class MappedStop:
    """Where the robot stood: planar pose in the world, covariance of (x, y, heading)."""

    leg: int
    stop: int
    x: float
    y: float
    heading: float
    covariance: Matrix3 = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class MappedSighting:
    """What became of one sighting: residual in pixels (null if the label has no position) and inlier weight 0..1."""

    leg: int
    stop: int
    camera: str
    label: str
    residual_px: tuple[float, float] | None
    weight: float


@dataclass(frozen=True, slots=True)
class SolverRun:
    """How the solver ended."""

    iterations: int
    converged: bool
    method: Literal["bundle", "linear"]


@dataclass(frozen=True, slots=True)
class Map:
    """Label positions with covariance, robot poses, and for every label without a position the reason."""

    survey: str
    frame: str
    labels: tuple[MappedLabel, ...]
    stops: tuple[MappedStop, ...]
    sightings: tuple[MappedSighting, ...]
    cost: float
    rms_px: float
    solver: SolverRun
    notes: tuple[str, ...] = ()
    format: Literal["robotd-map/1"] = "robotd-map/1"


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
