"""The records of motion, surveys and maps, in SI units and the axes of ARCHITECTURE.md.

`Survey` and `Map` and what they contain carry the keys of the `robotd-survey/1` and `robotd-map/1` files. Everybody
imports them from `records`, where those of hardware and detectors are, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Vector3 = tuple[float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Floats = NDArray[np.float64]


# ---- motion ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Pose:
    """Planar pose of the robot: metres, heading in radians counter-clockwise from x, wrapped to (-pi, pi]."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True, slots=True)
class Move:
    """Motion between two stops (dx, dy in metres, dheading in radians) in the earlier robot frame, with covariance.

    `by_errors` are the derivatives of dx, dy and dheading (a row each) by what is wrong with all moves alike: the
    relative errors of scale and turns, and the drift in radians per metre. They depend on where between the stops the
    robot turned; None: all the way, as along an arc.
    """

    dx: float
    dy: float
    dheading: float
    covariance: Matrix3
    by_errors: Matrix3 | None = None


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
    odometry_correlation: float = 0.0  # of the errors of scale and turn: larger wheels make both larger


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
