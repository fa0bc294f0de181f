"""`robotd-solver calibrate camera`: a camera's lens from pictures of a board, or from MATLAB."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .config import Calibration, load_calibration, save_lens
from .errors import InputError
from .files import read_bytes
from .records import CameraModel, Priors
from .solver.board_corners import Bytes, Charuco, Chessboard, Finder, dictionary_size
from .solver.calibrate_floor import Board
from .solver.calibrate_lens import ORDER, LensCalibration, calibrate_lens
from .solver.lens_fit import View
from .solver.lens_picture import draw_residuals
from .solver.matlab_lens import load_matlab

FORMAT = "robotd-calibration-data/1"
KINDS = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")  # taken of a folder
LEAST_SEEN = 3  # pictures with the board, from which the lens itself says what is missing


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
    finder: Finder = _charuco(arguments, square) if arguments.charuco else Chessboard(Board(*board, square))
    views, size = _views(paths, finder)
    kinds = ORDER if arguments.model == "auto" else (arguments.model,)
    result = calibrate_lens(views, size, arguments.camera, kinds, not arguments.partial)
    sigmas = result.sigmas.tolist()
    raised = Priors(focal_px=round(max(sigmas[:2]), 3), centre_px=round(max(sigmas[2:]), 3))
    if arguments.picture is not None:
        draw_residuals(arguments.picture, result)
    save_lens(result.camera, arguments.calibration, raised)
    if arguments.json:
        print(json.dumps(_summary(result)))
    numbers = ", ".join(
        f"{what} {value:.2f} +- {sigma:.2f}"
        for what, value, sigma in zip(("fx", "fy", "cx", "cy"), result.camera.matrix, sigmas, strict=True)
    )
    corners = sum(len(view.points) for view in result.views)
    _say(f"{len(result.views)} pictures, {corners} corners, {result.kind} {result.rms_px:.3f} px rms; {numbers} px")
    if result.left_out:
        _say(f"{result.left_out} corners were found in the wrong place and left out")
    _say(f"held out, px rms: {result.held_out_words}")
    for words in result.doubts:
        _say(words)
    near, far = result.distances
    _say(
        f"the board was held {near:.2f} to {far:.2f} m away; if that is wrong, so is --square, on which the lens does"
        " not depend (a floor camera's place does)"
    )
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
    paths: list[Path] = []
    board, square = arguments.board or arguments.charuco, arguments.square
    problems = []
    for path in arguments.images:
        if not path.is_dir():
            paths.append(path)
        elif (path / "data.json").exists():
            some, told, side = _folder(path, arguments.camera)
            paths += some
            if board is None:
                board, square = told, square or side
        else:
            found = sorted(one for one in path.iterdir() if one.suffix.lower() in KINDS)
            paths += found
            if not found:
                problems.append(f"{path}: holds no picture ({', '.join(KINDS)}), nor data.json of robotctl calibrate")
    if not paths and not problems:
        problems.append("no pictures given; name them, or a folder of them, such as robotctl calibrate camera makes")
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

    Pictures without it are left out, and told. Raises InputError that names every useless one if a file is of no use,
    or hardly any shows the board.
    """
    images: dict[Path, Bytes] = {}
    problems: list[str] = []
    for path in paths:
        if not path.is_file():
            problems.append(f"{path}: there is no such file")
        elif (image := _read(path)) is None:
            problems.append(f"{path}: cannot be read as an image")
        else:
            images[path] = image
    sizes = Counter((image.shape[1], image.shape[0]) for image in images.values())
    size = max(sizes, key=lambda one: sizes[one], default=(0, 0))
    for path, image in images.items():
        height, width = image.shape
        if (width, height) != size:
            turned = "; it is turned by 90 degrees" if (height, width) == size else ""
            problems.append(
                f"{path}: is {width}x{height}, but {sizes[size]} of {len(images)} are {size[0]}x{size[1]}{turned}; all"
                " must come from one camera, as it delivers them"
            )
    views: list[View] = []
    blank: list[Path] = []
    for path, image in images.items():
        if (image.shape[1], image.shape[0]) != size:
            continue
        found = finder.find(image)
        if found is None:
            blank.append(path)
        else:
            views.append(View(str(path), *found))
    unseen = [f"{path}: the board is not seen" for path in blank]
    if problems:
        raise InputError(*problems, *unseen)
    if blank and len(blank) >= len(views):
        why = finder.explain([images[path] for path in blank])
        if len(views) < LEAST_SEEN:
            raise InputError(
                *unseen,
                f"the board is seen in {len(views)} of {len(images)} pictures: {why}",
            )
        _say(f"the board is seen in {len(views)} of {len(images)} pictures only: {why}")
    for words in unseen:
        _say(f"{words}; it is left out")
    return views, size


def _read(path: Path) -> Bytes | None:
    """A picture in grey, as the camera delivered it; None if it is none. Deeper ones are scaled to their brightest."""
    data = np.fromfile(path, np.uint8)
    how = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, how) if len(data) else None
    if image is None or image.dtype == np.uint8:
        return None if image is None else np.asarray(image, np.uint8)
    top = float(np.max(image, initial=0.0, where=np.isfinite(image)))
    return np.asarray(np.clip(np.nan_to_num(image) * (255.0 / max(top, 1e-9)), 0.0, 255.0), np.uint8)


def _charuco(arguments: argparse.Namespace, square: float) -> Charuco:
    count = dictionary_size(arguments.dictionary)
    if not count:
        names = ", ".join(name for name in dir(cv2.aruco) if dictionary_size(name))
        raise InputError(f"--dictionary: found {arguments.dictionary!r}; expected one of {names}")
    marker = arguments.marker or 0.75 * square
    if marker >= square:
        raise InputError(f"--marker: found {marker:g} m; expected less than --square, {square:g} m")
    if arguments.charuco[0] * arguments.charuco[1] // 2 > count:
        raise InputError(f"--dictionary: {arguments.dictionary} has too few markers for that board; name a larger one")
    columns, rows = arguments.charuco
    return Charuco(columns, rows, square, marker, arguments.dictionary)


def _numbers(camera: CameraModel) -> dict[str, Any]:
    return {
        "camera": camera.name,
        "size": list(camera.size),
        "matrix": list(camera.matrix),
        "distortion": list(camera.distortion),
        "valid_radius_px": camera.valid_radius_px,
    }


def _summary(result: LensCalibration) -> dict[str, Any]:
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
        "corners": sum(len(view.points) for view in result.views),
        "corners_left_out": result.left_out,
        "pictures_left_out": list(result.strangers),
        "distances_m": list(result.distances),
        "board": None if result.bend is None else asdict(result.bend),
        "pictures": {
            view.name: float(np.sqrt(np.mean(left**2)))
            for view, left in zip(result.views, result.residuals, strict=True)
        },
    }
