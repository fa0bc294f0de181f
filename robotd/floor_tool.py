"""`robotd-solver calibrate floor`: the floor camera's pose from pictures of a chessboard on the floor."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import Calibration, load_calibration, save_floor_camera
from .errors import InputError, SolverError
from .records import CameraModel, Floats
from .solver.calibrate_floor import (
    AHEAD,
    Board,
    FloorCalibration,
    Place,
    calibrate_floor,
    estimate_lens,
    find_board,
)
from .vision.figures import ORANGE, SKY, WHITE, Canvas, Picture, sheet
from .vision.top_view import TopView

Bytes = NDArray[np.uint8]
MAGNIFIED = 30.0  # times, the residuals in the picture


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code.

    Raises
    ------
    InputError
        If pictures, places or the calibration file are wrong; all pictures are checked before any is used.
    SolverError
        If they do not give the camera's pose: the message says what is missing.
    """
    board = Board(arguments.board[0], arguments.board[1], arguments.square)
    if len(arguments.at) > len(arguments.images):
        raise InputError(f"{len(arguments.at)} places but {len(arguments.images)} pictures; give each --at its picture")
    before = load_calibration(arguments.calibration) if arguments.calibration.exists() else Calibration()
    images, corners = _boards([*arguments.images, *arguments.held], board)
    floor = len(arguments.images)
    size = images[0].shape[1], images[0].shape[0]
    lens = _lens(arguments, before, corners[floor:], board, size)
    places: list[Place | None] = [Place(x, y, heading, arguments.at_sigma) for x, y, heading in arguments.at]
    places += [None] * (floor - len(places))
    result = calibrate_floor(lens, corners[:floor], board, places, [str(path) for path in arguments.images])
    note = (
        f"robotd-solver calibrate floor: {floor} boards, {result.rms_px:.2f} px rms; height +- "
        f"{1e3 * result.sigma_height:.1f} mm, tilt +- {math.degrees(result.sigma_tilt):.2f} degrees"
    )
    save_floor_camera(result.camera, arguments.calibration, note)
    if arguments.picture is not None and not cv2.imwrite(
        str(arguments.picture), residual_sheet(images[:floor], result)
    ):
        raise InputError(f"{arguments.picture}: cannot be written; name another file ending in .png")
    if arguments.json:
        print(json.dumps(_summary(result)))
    ahead = ", ".join(f"{1e3 * sigma:.1f} mm at {x:g} m" for x, sigma in zip(AHEAD, result.sigma_ahead, strict=True))
    print(f"{note}; floor points ahead +- {ahead}; written to {arguments.calibration}", file=sys.stderr)
    return 0


def _boards(paths: list[Path], board: Board) -> tuple[list[Bytes], list[Floats]]:
    """The pictures and the corners in them; raises InputError that names every one that is of no use."""
    problems: list[str] = []
    images: list[Bytes] = []
    found: list[Floats] = []
    for path in paths:
        if not path.is_file():
            problems.append(f"{path}: there is no such file")
            continue
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data := np.fromfile(path, np.uint8)) else None
        if image is None:
            problems.append(f"{path}: cannot be read as an image")
            continue
        if images and image.shape != images[0].shape:
            problems.append(
                f"{path}: is {image.shape[1]}x{image.shape[0]}, but {paths[0]} is"
                f" {images[0].shape[1]}x{images[0].shape[0]}; all must come from one camera"
            )
            continue
        corners = find_board(np.asarray(image, np.uint8), board)
        if corners is None:
            problems.append(
                f"{path}: no board of {board.columns}x{board.rows} inner corners seen; is all of it in view, with a"
                " white rim, and is --board its number of inner corners?"
            )
            continue
        images.append(np.asarray(image, np.uint8))
        found.append(corners)
    if problems:
        raise InputError(*problems)
    return images, found


def _lens(
    arguments: argparse.Namespace, before: Calibration, held: list[Floats], board: Board, size: tuple[int, int]
) -> CameraModel:
    if held:
        return estimate_lens(held, board, size)
    if before.floor_camera is None:
        raise SolverError(
            f"the lens is not known: {arguments.calibration} has no [floor_camera]; add 5 or more pictures of the board"
            " held at different tilts with --held"
        )
    if before.floor_camera.size != size:
        known = "x".join(map(str, before.floor_camera.size))
        raise InputError(
            f"{arguments.calibration} [floor_camera]: is for {known} pixels, the pictures have {size[0]}x{size[1]};"
            " take them at that size, or estimate the lens anew with --held"
        )
    return before.floor_camera


def _summary(result: FloorCalibration) -> dict[str, Any]:
    pose = result.camera.T_robot_camera
    return {
        "rms_px": round(result.rms_px, 4),
        "translation_m": list(pose.translation),
        "rotation": list(pose.rotation),
        "matrix": list(result.camera.matrix),
        "distortion": list(result.camera.distortion),
        "sigma_height_m": result.sigma_height,
        "sigma_tilt_rad": result.sigma_tilt,
        "sigma_ahead_m": {f"{x:g}": sigma for x, sigma in zip(AHEAD, result.sigma_ahead, strict=True)},
        "boards": result.boards.tolist(),
    }


def residual_sheet(images: list[Bytes], result: FloorCalibration) -> Picture:
    """Every picture with its corners (blue) and magnified residuals (orange), and the top view of the first."""
    panels = []
    for k, (image, found, fitted) in enumerate(zip(images, result.found, result.fitted, strict=True), start=1):
        canvas = Canvas(image, dim=0.6)
        canvas.dots(found, np.tile(np.array(SKY, np.uint8), (len(found), 1)), 2)
        canvas.segments(np.hstack([found, found + MAGNIFIED * (fitted - found)]), ORANGE)
        rms = math.sqrt(float(np.mean((fitted - found) ** 2)))
        panels.append(canvas.titled(f"picture {k}: {rms:.2f} px rms; residuals x {MAGNIFIED:.0f}"))
    panels.append(_seen_from_above(images[0], result, panels[0].shape[0]))
    return sheet(panels, 2 if len(panels) in (2, 4) else 3)


def _seen_from_above(image: Bytes, result: FloorCalibration, height: int) -> Picture:
    """The top view with a grid of 0.1 m, as high as the other panels."""
    view = TopView(result.camera)
    canvas = Canvas(view.apply(image), view.valid)
    for x in np.arange(0.3, 1.05, 0.1):
        canvas.line(view.to_pixels(np.array([[x, -0.45], [x, 0.45]])), WHITE)
        label = view.to_pixels(np.array([[x, 0.44]]))[0]
        if 0.0 <= label[1] < view.valid.shape[0]:
            canvas.text(label, f"{x:.1f} m")
    for y in np.arange(-0.4, 0.41, 0.1):
        canvas.line(view.to_pixels(np.array([[0.25, y], [1.05, y]])), WHITE)
    panel = canvas.titled("picture 1 from above, a grid of 0.1 m")[:height]
    return np.asarray(cv2.copyMakeBorder(panel, 0, height - len(panel), 0, 0, cv2.BORDER_CONSTANT), dtype=np.uint8)
