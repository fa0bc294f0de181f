"""The arguments of `robotd-solver calibrate camera`; what it runs is in lens_tool.

Apart from it, because a command line that only prints its help should not load OpenCV.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path


def add_calibrate_camera(kinds: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The arguments of `robotd-solver calibrate camera`."""
    camera = kinds.add_parser(
        "camera",
        help="a camera's lens, from pictures of a chessboard or ChArUco board, or from MATLAB",
        description="Hold a flat, stiff board before the camera in 20 pictures: near and far, tilted by 30 to 45"
        " degrees to all sides, and out to every border of the picture. An IMAGE may be a folder: of pictures, or"
        " one that `robotctl calibrate camera` made, which says which board it was.",
    )
    camera.add_argument("images", nargs="*", type=Path, metavar="IMAGE", help="pictures, or folders of them")
    board = camera.add_mutually_exclusive_group()
    board.add_argument("--board", type=_inner, metavar="COLSxROWS", help="chessboard: its inner corners, such as 9x6")
    board.add_argument("--charuco", type=_inner, metavar="COLSxROWS", help="ChArUco board: its squares, such as 8x5")
    board.add_argument("--matlab", type=Path, metavar="FILE", help=".mat or .json with toStruct(cameraParams)")
    camera.add_argument(
        "--square", type=metres, metavar="M", help="side of a square in metres; the lens does not depend on it"
    )
    camera.add_argument(
        "--marker", type=metres, metavar="M", help="side of a ChArUco marker (default: 3/4 of a square)"
    )
    camera.add_argument("--dictionary", default="DICT_4X4_50", metavar="NAME", help="of its markers: DICT_4X4_50, ...")
    camera.add_argument("--size", type=_size, metavar="WxH", help="of the picture, if the MATLAB file lacks it")
    camera.add_argument(
        "--model",
        choices=("auto", "brown-conrady", "rational", "fisheye"),
        default="auto",
        help="default: auto, the one that predicts held-out pictures best",
    )
    camera.add_argument(
        "--partial", action="store_true", help="accept that no corner is near some border: a round image, for example"
    )
    camera.add_argument("--camera", required=True, metavar="NAME", help="as in the calibration; a new one is added")
    camera.add_argument(
        "--calibration", type=Path, required=True, metavar="FILE", help="gets the lens; all else in it stays"
    )
    camera.add_argument("--picture", type=Path, metavar="PNG", help="also draw the residuals")
    camera.add_argument("--json", action="store_true", help="print one JSON object")
    camera.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> int:
    from .lens_tool import run

    return run(arguments)


def _inner(text: str) -> tuple[int, int]:
    return _pair(text, 3, 50, "COLUMNSxROWS, each 3 to 50, such as 9x6")


def _size(text: str) -> tuple[int, int]:
    return _pair(text, 16, 16384, "WIDTHxHEIGHT in pixels, such as 1280x720")


def _pair(text: str, low: int, high: int, wanted: str) -> tuple[int, int]:
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdecimal() and low <= int(part) <= high for part in parts):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected {wanted}")
    return int(parts[0]), int(parts[1])


def metres(text: str) -> float:
    """A length of a board, above 0 and at most 1 m; raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= 1.0:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected metres, above 0 and at most 1, such as 0.025")
    return value
