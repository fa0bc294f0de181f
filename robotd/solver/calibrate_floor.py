"""Where the floor camera sits and looks, from chessboards that lie flat on the floor. Thesis section 5.2.2.

One homography would do for one picture (thesis Figure 13), but it mixes lens, place and noise. Here the lens is known,
every board has three unknowns on the floor (x, y, heading), the camera has six, and all corners are fitted together; so
boards whose place nobody measured still say how high and how tilted the camera is. The places that were measured tie
the result to the robot, as observations with their own uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from ..errors import InputError, SolverError
from ..geometry.camera import Camera
from ..geometry.transforms import invert_rigid, rotation_matrix, transform_record
from ..records import CameraModel, Floats

MOST_RMS = 1.0  # px; a flat board and a right lens model leave a tenth of it
MOST_SIGMA = 0.010  # m at 0.6 m ahead; a line follower wants a tenth of the tape's width
MOST_SIGMAS = 4.0  # of a measured place from where the fit has it
FARTHEST = 0.6  # m from the robot's origin: no camera is mounted beyond
LEAST_HELD = 5  # pictures from which a lens can be estimated (Zhang, PAMI 22(11), 2000: 3, without distortion)
LEAST_TURN = math.radians(15.0)  # between the boards' planes; parallel ones say nothing about the lens
FIRST_PX, LEAST_PX = 0.3, 0.05  # scatter of corners before it is known, and that no detector goes below
AHEAD = (0.3, 0.6, 1.0)  # m in front of the robot, where the uncertainty is reported


@dataclass(frozen=True, slots=True)
class Board:
    """A chessboard: inner corners along its rows and its columns, and the side of a square in metres."""

    columns: int
    rows: int
    square: float

    @property
    def corners(self) -> Floats:
        """(N, 2) inner corners around the middle of the pattern in metres, row by row, in axes x right and y up."""
        v, u = np.mgrid[0 : self.rows, 0 : self.columns].astype(np.float64)
        x = (u.ravel() - 0.5 * (self.columns - 1)) * self.square
        return np.column_stack([x, (0.5 * (self.rows - 1) - v.ravel()) * self.square])


@dataclass(frozen=True, slots=True)
class Place:
    """Where the middle of a board's corners was measured to be, robot axes, and where its columns point (radians)."""

    x: float
    y: float
    heading: float
    sigma_m: float = 0.003
    sigma_rad: float = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class FloorCalibration:
    """A floor camera's pose and how sure it is.

    Attributes
    ----------
    camera : CameraModel
    rms_px : float
        Of the corners' reprojection errors, per coordinate.
    found, fitted : tuple of (N, 2) arrays, one per picture
        Corners as seen and as the fit has them, in pixels.
    boards : (P, 3) array
        x, y, heading of the boards in robot axes.
    sigma_height, sigma_tilt : float
        Standard deviations of the camera's height in metres and of its optical axis against the floor in radians.
    sigma_ahead : tuple of float
        Standard deviation in metres of a floor point on the robot's axis, `AHEAD` of it.
    """

    camera: CameraModel
    rms_px: float
    found: tuple[Floats, ...]
    fitted: tuple[Floats, ...]
    boards: Floats
    sigma_height: float
    sigma_tilt: float
    sigma_ahead: tuple[float, ...]


def find_board(image: NDArray[np.uint8], board: Board) -> Floats | None:
    """The inner corners (N, 2) of a board in a grey image in the order of `board.corners`, or None if it is not seen.

    Which of the two ends of a board comes first cannot be seen; the order is never mirrored.
    """
    size = (board.columns, board.rows)
    done, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE)
    if not done or corners is None:
        return None
    grid = np.asarray(corners, dtype=np.float64).reshape(board.rows, board.columns, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0.0:
        grid = grid[:, ::-1]
    return grid.reshape(-1, 2)


def estimate_lens(pictures: Sequence[Floats], board: Board, size: tuple[int, int]) -> CameraModel:
    """Focal lengths, centre and distortion from corners of boards held at different tilts; the pose stays unknown.

    Raises
    ------
    SolverError
        If there are too few pictures, or the boards are too parallel to each other.
    """
    if len(pictures) < LEAST_HELD:
        raise SolverError(
            f"the lens is not known and cannot be estimated from {len(pictures)} pictures of a held board; give"
            f" {LEAST_HELD} or more, the board tilted differently in each, or a calibration file with [floor_camera]"
        )
    flat = np.column_stack([board.corners * [1.0, -1.0], np.zeros(len(board.corners))]).astype(np.float32)
    seen = [corners.astype(np.float32).reshape(-1, 1, 2) for corners in pictures]
    start = np.array([[size[0], 0.0, 0.5 * size[0]], [0.0, size[0], 0.5 * size[1]], [0.0, 0.0, 1.0]])
    rms, matrix, distortion, turns, _ = cv2.calibrateCamera(
        [flat] * len(seen), seen, size, start, np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    )
    axes = np.array([rotation_matrix(turn.ravel())[:, 2] for turn in turns])
    between = np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    if between.max() < LEAST_TURN:
        raise SolverError(
            f"the held boards are tilted by {math.degrees(between.max()):.0f} degrees against each other, so the lens"
            f" cannot be told from the distance; tilt them by {math.degrees(LEAST_TURN):.0f} degrees or more"
        )
    if rms > 2.0 * MOST_RMS:
        raise SolverError(f"the held boards fit the lens only to {rms:.1f} px; are they flat, and is --square right?")
    k = np.asarray(distortion, dtype=np.float64).ravel()[:5]
    numbers = (float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2]))
    return CameraModel("floor", size, numbers, transform_record(np.eye(4)), distortion=tuple(float(one) for one in k))


def calibrate_floor(
    lens: CameraModel, pictures: Sequence[Floats], board: Board, places: Sequence[Place | None], names: Sequence[str]
) -> FloorCalibration:
    """Fit the camera's pose to boards on the floor.

    Minimised is the sum of squared reprojection errors, over their rms, and of the measured places' errors over their
    standard deviations.

    Parameters
    ----------
    lens : CameraModel
        Its pose is not used.
    pictures : sequence of (N, 2) arrays
        Corners from `find_board`.
    board : Board
    places : sequence of Place or None
        For each picture; at least one is measured.
    names : sequence of str
        Of the pictures, for messages.

    Raises
    ------
    InputError
        If no place is given, or the numbers of pictures, places and names differ.
    SolverError
        If the corners do not fit one floor and one camera on the robot, or leave its pose too uncertain; the message
        says which picture is wrong or what is missing.
    """
    if not len(pictures) == len(places) == len(names):
        raise InputError(f"{len(pictures)} pictures but {len(places)} places and {len(names)} names")
    anchors = [k for k, place in enumerate(places) if place is not None]
    if not anchors:
        raise InputError("no board's place on the floor is known; measure at least one and give it with --at")
    optics = Camera(replace(lens, T_robot_camera=transform_record(np.eye(4))))
    start = _start(optics, pictures[anchors[0]], board, places[anchors[0]], names[anchors[0]])
    boards = np.array([_board_place(optics, start, corners, board, places[k]) for k, corners in enumerate(pictures)])
    order = [_ordered(optics, start, corners, board, row) for corners, row in zip(pictures, boards, strict=True)]
    fit = _FloorFit(optics, start, board, order, places)
    result, errors = fit.solve(boards)
    rms = math.sqrt(float(np.mean(np.concatenate(errors) ** 2)))
    if not rms <= MOST_RMS:
        each = [math.sqrt(float(np.mean(error**2))) for error in errors]
        raise SolverError(
            f"the boards do not fit one flat floor: {rms:.1f} px rms, worst {names[int(np.argmax(each))]} with"
            f" {max(each):.1f} px; leave it out, and check that every board lies flat and --square is its real size"
        )
    T = fit.pose(result.x)
    _on_robot(T)
    _agree(places, result.x[6:].reshape(-1, 3), names)
    covariance = np.linalg.pinv(result.jac.T @ result.jac)[:6, :6]
    axis_tilt = np.cross(T[:3, 2], [0.0, 0.0, 1.0])
    axis_tilt /= max(float(np.linalg.norm(axis_tilt)), 1e-9)
    camera = replace(lens, T_robot_camera=transform_record(T))
    calibration = FloorCalibration(
        camera,
        rms,
        tuple(order),
        tuple(fit.fitted(result.x)),
        result.x[6:].reshape(-1, 3),
        math.sqrt(covariance[5, 5]),
        math.sqrt(float(axis_tilt @ covariance[:3, :3] @ axis_tilt)),
        tuple(_sigma_at(T, covariance, np.array([ahead, 0.0, 0.0])) for ahead in AHEAD),
    )
    if calibration.sigma_ahead[1] > MOST_SIGMA:
        raise SolverError(
            f"the camera's pose stays uncertain: {1e3 * calibration.sigma_ahead[1]:.0f} mm at {AHEAD[1]:g} m ahead;"
            " more pictures are missing, with the board nearer the far edge of the view and at its sides, or a larger"
            " board"
        )
    return calibration


class _FloorFit:
    """What is fitted: turn and shift of the camera from a start (6 values), then x, y, heading of every board.

    `corners` are the pictures', in the order of `Board.corners`; `places` those of the boards that were measured.
    """

    def __init__(
        self, optics: Camera, start: Floats, board: Board, corners: Sequence[Floats], places: Sequence[Place | None]
    ) -> None:
        self.optics, self.start, self.board = optics, start, board
        self.corners, self.places = corners, places

    def pose(self, values: Floats) -> Floats:
        """T_robot_camera (4, 4)."""
        T = self.start.copy()
        T[:3, :3] = rotation_matrix(values[:3]) @ T[:3, :3]
        T[:3, 3] += values[3:6]
        return T

    def fitted(self, values: Floats) -> list[Floats]:
        """Pixels (N, 2) of each board's corners."""
        T = invert_rigid(self.pose(values))
        rows = values[6:].reshape(-1, 3)
        return [self.optics.project(_on_floor(self.board, row) @ T[:3, :3].T + T[:3, 3])[0] for row in rows]

    def residuals(self, values: Floats, pixel: float) -> Floats:
        """Errors of the corners over `pixel`, then of the measured places over their standard deviations."""
        errors = [(a - b).ravel() / pixel for a, b in zip(self.fitted(values), self.corners, strict=True)]
        for (x, y, heading), place in zip(values[6:].reshape(-1, 3), self.places, strict=True):
            if place is not None:
                turn = math.remainder(heading - place.heading, 2.0 * math.pi)
                at = (x - place.x) / place.sigma_m, (y - place.y) / place.sigma_m, turn / place.sigma_rad
                errors.append(np.array(at))
        return np.nan_to_num(np.concatenate(errors), nan=1e6)

    def solve(self, boards: Floats) -> tuple[OptimizeResult, list[Floats]]:
        """The optimum from the boards' places (P, 3) on, and its errors in pixels (N, 2), picture by picture."""
        values, pixel = np.concatenate([np.zeros(6), boards.ravel()]), FIRST_PX
        for _ in range(2):  # the second time with the corners' own scatter
            result = least_squares(self.residuals, values, x_scale="jac", args=(pixel,), max_nfev=200)
            values = result.x
            errors = [a - b for a, b in zip(self.fitted(values), self.corners, strict=True)]
            pixel = max(math.sqrt(float(np.mean(np.concatenate(errors) ** 2))), LEAST_PX)
        return result, errors


def _on_floor(board: Board, place: Floats) -> Floats:
    """Corners (N, 3) in robot axes of a board at x, y, heading."""
    c, s = math.cos(place[2]), math.sin(place[2])
    at = board.corners @ np.array([[c, s], [-s, c]]) + place[:2]
    return np.column_stack([at, np.zeros(len(at))])


def _pose_from(optics: Camera, corners: Floats, points: Floats, name: str) -> Floats:
    """T_robot_camera from corners (N, 2) in pixels and their places (N, 3) on the floor."""
    rays, valid = optics.rays(corners)
    if not valid.all():
        raise SolverError(f"{name}: corners lie where the lens model does not hold; move the board to the middle")
    plain = rays[:, :2] / rays[:, 2:]
    done, turn, shift = cv2.solvePnP(points, plain, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    if not done:
        raise SolverError(f"{name}: the board gives no camera pose; is it seen at too flat an angle?")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(turn.ravel()), shift.ravel()
    return invert_rigid(T)


def _start(optics: Camera, corners: Floats, board: Board, place: Place | None, name: str) -> Floats:
    """The pose from one measured board; of its two ends that look alike, the one with the camera nearer the robot."""
    assert place is not None
    points = _on_floor(board, np.array([place.x, place.y, place.heading]))
    poses = [_pose_from(optics, way, points, name) for way in (corners, corners[::-1])]
    far = [math.hypot(T[0, 3], T[1, 3]) for T in poses]
    if abs(far[0] - far[1]) < 0.1:
        raise SolverError(
            f"{name}: the board could lie either way round, the camera is equally far from the robot in both; lay a"
            " board farther ahead and measure its place"
        )
    return poses[int(np.argmin(far))]


def _board_place(optics: Camera, T: Floats, corners: Floats, board: Board, place: Place | None) -> Floats:
    """x, y, heading of a board, from where the camera pose T puts its corners on the floor, or as measured."""
    if place is not None:
        return np.array([place.x, place.y, place.heading])
    rays, _ = optics.rays(corners)
    rays = rays @ T[:3, :3].T
    floor = T[:2, 3] - T[2, 3] / np.minimum(rays[:, 2:], -1e-3) * rays[:, :2]
    away = floor - floor.mean(axis=0)
    model = board.corners
    heading = math.atan2(
        float((model[:, 0] * away[:, 1] - model[:, 1] * away[:, 0]).sum()), float((model * away).sum())
    )
    return np.array([*floor.mean(axis=0), heading])


def _ordered(optics: Camera, T: Floats, corners: Floats, board: Board, place: Floats) -> Floats:
    """The corners from the end that fits the board's place."""
    inverse = invert_rigid(T)
    expected, _ = optics.project(_on_floor(board, place) @ inverse[:3, :3].T + inverse[:3, 3])
    ways = (corners, corners[::-1])
    return ways[int(np.argmin([float(np.nansum((way - expected) ** 2)) for way in ways]))]


def _on_robot(T: Floats) -> None:
    """Raise SolverError unless the pose T_robot_camera is one that a floor camera can have."""
    x, y, z = T[:3, 3].tolist()
    if math.hypot(x, y) > FARTHEST or not 0.02 < z < 2.0:
        raise SolverError(
            f"the camera would sit at x {x:.2f}, y {y:.2f}, z {z:.2f} m, which is not on the robot; check --at (metres"
            " from the robot's centre, x ahead, y to the left; degrees) and --square"
        )
    if T[2, 2] > -0.05:
        raise SolverError("the camera would look up or level, not at the floor; check --at")


def _agree(places: Sequence[Place | None], boards: Floats, names: Sequence[str]) -> None:
    """Raise SolverError if a board came out far from where it was measured to lie."""
    for place, board, name in zip(places, boards, names, strict=True):
        if place is None:
            continue
        off, turn = (
            math.hypot(board[0] - place.x, board[1] - place.y),
            math.remainder(board[2] - place.heading, math.tau),
        )
        if off > MOST_SIGMAS * place.sigma_m or abs(turn) > MOST_SIGMAS * place.sigma_rad:
            raise SolverError(
                f"the measured places contradict each other: the board in {name} lies {1e3 * off:.0f} mm and"
                f" {math.degrees(abs(turn)):.1f} degrees from where --at says; measure them again"
            )


def _sigma_at(T: Floats, covariance: Floats, point: Floats) -> float:
    """Standard deviation (the larger axis) of where the camera's ray to a floor point meets the floor, in metres.

    A small turn w about the camera and a shift t move the ray's foot by t + w x r, less what brings it back to the
    floor along the ray r.
    """
    ray = point - T[:3, 3]
    turn = -np.array([[0.0, -ray[2], ray[1]], [ray[2], 0.0, -ray[0]], [-ray[1], ray[0], 0.0]])  # w x r = turn @ w
    moved = np.hstack([turn, np.eye(3)])
    jacobian = moved[:2] - np.outer(ray[:2] / ray[2], moved[2])
    spread = np.linalg.eigvalsh(jacobian @ covariance @ jacobian.T)
    return math.sqrt(max(float(spread[-1]), 0.0))
