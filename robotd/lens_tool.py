"""`robotd-solver calibrate camera`: a camera's lens from pictures of a board, or from MATLAB."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import Calibration, load_calibration, save_lens
from .errors import InputError
from .files import read_bytes
from .records import CameraModel, Floats, Priors
from .solver.calibrate_floor import Board, find_board
from .solver.calibrate_lens import ORDER, LensCalibration, calibrate_lens
from .solver.lens_fit import View
from .solver.lens_picture import draw_residuals
from .solver.matlab_lens import load_matlab

Bytes = NDArray[np.uint8]
Finder = Callable[[Bytes], tuple[Floats, Floats] | None]
LEAST_CORNERS = 8  # of a ChArUco board in a picture
FORMAT = "robotd-calibration-data/1"
_WINDOW = 0.3  # of the smallest square: half the side of the window in which a corner is refined


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code.

    Raises
    ------
    InputError
        If pictures, options or the calibration file are wrong; all pictures are checked before any is used.
    SolverError
        If the pictures do not determine the lens: the message says what is missing.
    """
    before = load_calibration(arguments.calibration) if arguments.calibration.exists() else Calibration()
    if arguments.matlab is not None:
        return _from_matlab(arguments, before)
    paths, board, square = _pictures(arguments)
    finder = _charuco(arguments, square) if arguments.charuco else _chessboard(Board(*board, square))
    views, size = _views(paths, finder)
    kinds = ORDER if arguments.model == "auto" else (arguments.model,)
    result = calibrate_lens(views, size, arguments.camera, kinds, not arguments.partial)
    sigmas = result.sigmas.tolist()
    raised = Priors(focal_px=round(max(sigmas[:2]), 3), centre_px=round(max(sigmas[2:]), 3))
    if arguments.picture is not None:
        draw_residuals(arguments.picture, result, views)
    save_lens(result.camera, arguments.calibration, raised)
    if arguments.json:
        print(json.dumps(_summary(result, views)))
    numbers = ", ".join(
        f"{what} {value:.2f} +- {sigma:.2f}"
        for what, value, sigma in zip(("fx", "fy", "cx", "cy"), result.camera.matrix, sigmas, strict=True)
    )
    _say(f"{len(views)} pictures, {result.kind} {result.rms_px:.3f} px rms; {numbers} px")
    _say(f"held out, px rms: {result.held_out_words}")
    for words in result.doubts:
        _say(words)
    _say(
        f"the lens holds up to {result.reach_px:.0f} px from its centre, in {100.0 * result.share:.0f} % of the picture"
    )
    return _done(arguments, before)


def _from_matlab(arguments: argparse.Namespace, before: Calibration) -> int:
    if arguments.images:
        raise InputError(f"{arguments.images[0]}: give pictures or --matlab, not both")
    camera = load_matlab(read_bytes(arguments.matlab), str(arguments.matlab), arguments.camera, arguments.size)
    save_lens(camera, arguments.calibration, Priors())
    if arguments.json:
        print(json.dumps({"model": camera.model, **_numbers(camera)}))
    fx, fy, cx, cy = camera.matrix
    _say(f"fx {fx:.2f}, fy {fy:.2f}, cx {cx:.2f}, cy {cy:.2f} px: MATLAB's principal point less one pixel")
    return _done(arguments, before)


def _done(arguments: argparse.Namespace, before: Calibration) -> int:
    _say(f"written to {arguments.calibration}")
    known = [camera.name for camera in (*before.cameras, before.floor_camera) if camera is not None]
    if arguments.camera not in known:
        _say(f"{arguments.camera} is new there: its T_robot_camera is not measured yet and stands at zero")
    return 0


def _say(words: str) -> None:
    print(f"robotd-solver calibrate camera: {words}", file=sys.stderr)


# ---- pictures --------------------------------------------------------------------------------------------------------


def _pictures(arguments: argparse.Namespace) -> tuple[list[Path], tuple[int, int], float]:
    """The pictures, the chessboard's inner corners (of no meaning with --charuco) and the side of a square."""
    paths, board, square = arguments.images, arguments.board or arguments.charuco, arguments.square
    if len(paths) == 1 and paths[0].is_dir():
        paths, told, side = _folder(paths[0], arguments.camera)
        if board is None:
            board, square = told, square or side
    problems = []
    if not paths:
        problems.append("no pictures given; name them, or a folder that robotctl calibrate camera made")
    if board is None:
        problems.append("the board is not known; give --board COLSxROWS or --charuco COLSxROWS")
    if square is None:
        problems.append("the side of a square is not known; give --square in metres")
    if problems:
        raise InputError(*problems)
    return paths, board, square


def _folder(folder: Path, camera: str) -> tuple[list[Path], tuple[int, int], float]:
    """The pictures of a folder's data.json in which the robot saw the board, and the board."""
    where = folder / "data.json"
    try:
        data = json.loads(read_bytes(where))
        if data["format"] != FORMAT or data["what"] != "camera":
            raise InputError(f"{where}: is {data['format']} of {data['what']}; expected {FORMAT} of a camera")
        board = data["board"]
        told = int(board["columns"]), int(board["rows"])
        files = [folder / str(one["file"]) for one in data["pictures"] if one["board_found"]]
        square, seen_by = float(board["square_m"]), str(data["camera"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: is not what robotctl calibrate camera writes: {error!r}") from error
    if seen_by != camera:
        raise InputError(f"{where}: pictures of camera {seen_by}, but --camera says {camera}")
    return files, told, square


def _views(paths: list[Path], finder: Finder) -> tuple[list[View], tuple[int, int]]:
    """The corners in every picture that shows the board, and the pictures' size.

    Pictures without it are left out, and told, as long as most have it. Raises InputError that names every useless one.
    """
    problems: list[str] = []
    blank: list[str] = []
    views: list[View] = []
    size: tuple[int, int] | None = None
    for path in paths:
        if not path.is_file():
            problems.append(f"{path}: there is no such file")
            continue
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
        if image is None:
            problems.append(f"{path}: cannot be read as an image")
            continue
        height, width = image.shape
        size = size or (width, height)
        if (width, height) != size:
            problems.append(
                f"{path}: is {width}x{height}, but {paths[0]} is {size[0]}x{size[1]}; all must come from one camera"
            )
            continue
        found = finder(np.asarray(image, np.uint8))
        if found is None:
            blank.append(f"{path}: the board is not seen")
            continue
        views.append(View(str(path), *found))
    if problems or size is None or len(blank) >= len(views):
        raise InputError(*problems, *(f"{one}; leave it out, or check the board's numbers" for one in blank))
    for one in blank:
        _say(f"{one}; it is left out")
    return views, size


def _chessboard(board: Board) -> Finder:
    points = _flat(board.corners * [1.0, -1.0])  # y down, so that z points away from the camera

    def find(image: Bytes) -> tuple[Floats, Floats] | None:
        corners = find_board(image, board)
        return None if corners is None else (points, _refined(image, corners, board))

    return find


def _refined(image: Bytes, corners: Floats, board: Board) -> Floats:
    """Corners where the grey levels around them turn: the detector's are off by 0.1 px where boards are much tilted."""
    grid = corners.reshape(board.rows, board.columns, 2)
    apart = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
    half = max(2, int(_WINDOW * apart))
    start = corners.astype(np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    return np.asarray(cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop), dtype=np.float64).reshape(-1, 2)


def _charuco(arguments: argparse.Namespace, square: float) -> Finder:
    number = getattr(cv2.aruco, arguments.dictionary, None)
    if not arguments.dictionary.startswith("DICT_") or not isinstance(number, int):
        names = ", ".join(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise InputError(f"--dictionary: found {arguments.dictionary!r}; expected one of {names}")
    marker = arguments.marker or 0.75 * square
    if marker >= square:
        raise InputError(f"--marker: found {marker:g} m; expected less than --square, {square:g} m")
    detectors = []
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    if arguments.charuco[0] * arguments.charuco[1] // 2 > len(dictionary.bytesList):
        raise InputError(f"--dictionary: {arguments.dictionary} has too few markers for that board; name a larger one")
    for legacy in (False, True):  # boards printed before OpenCV 4.6 begin with the other colour
        board = cv2.aruco.CharucoBoard(arguments.charuco, square, marker, dictionary)
        board.setLegacyPattern(legacy)
        detectors.append(cv2.aruco.CharucoDetector(board))
    points = np.asarray(detectors[0].getBoard().getChessboardCorners(), dtype=np.float64)

    def find(image: Bytes) -> tuple[Floats, Floats] | None:
        best: tuple[Floats, Floats] | None = None
        for detector in detectors:
            corners, ids, _, _ = detector.detectBoard(image)
            if ids is None or len(ids) < LEAST_CORNERS or (best is not None and len(ids) <= len(best[0])):
                continue
            there = points[np.asarray(ids).ravel()]
            if (
                np.linalg.matrix_rank(there - there.mean(axis=0), 0.3 * square) == 2
            ):  # corners of one row say too little
                best = there, np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        return best

    return find


def _flat(corners: Floats) -> Floats:
    return np.column_stack([corners, np.zeros(len(corners))])


def _numbers(camera: CameraModel) -> dict[str, Any]:
    return {
        "camera": camera.name,
        "size": list(camera.size),
        "matrix": list(camera.matrix),
        "distortion": list(camera.distortion),
        "valid_radius_px": camera.valid_radius_px,
    }


def _summary(result: LensCalibration, views: list[View]) -> dict[str, Any]:
    return {
        "model": result.kind,
        **_numbers(result.camera),
        "rms_px": result.rms_px,
        "held_out_px": {kind: error if np.isfinite(error) else None for kind, error in result.held_out_px.items()},
        "sigma_px": result.sigmas.tolist(),
        "covariance_px2": result.covariance.tolist(),
        "reach_px": result.reach_px,
        "share": result.share,
        "disagreement": result.disagreement,
        "board": None if result.bend is None else asdict(result.bend),
        "pictures": {
            view.name: float(np.sqrt(np.mean(left**2))) for view, left in zip(views, result.residuals, strict=True)
        },
    }
