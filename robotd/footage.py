"""Footage: the time-stamped images of one camera from a recording, a folder of images or a video file.

Times come from the recording itself, from the video, from a table, from the images' names, or from a given frame rate.
They are seconds on whatever clock the footage was taken by; only their differences mean anything.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .capture_clock import UNITS
from .errors import InputError
from .jpeg import Channel
from .recording import read_contents, read_frames

IMAGES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".tif", ".tiff", ".webp")
VIDEOS = (".avi", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ogv", ".ts", ".webm")
TABLE = "times.csv"
STAMP_DIGITS = 10  # a number in a name with so many digits, or with a point, is a time

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Shot:
    """One image, (H, W) uint8, taken at `t` seconds; `name` says which in messages.

    `encoded` is the JPEG as the camera sent it, where a recording has it.
    """

    t: float
    image: Image
    name: str
    encoded: bytes | None = None


@dataclass(frozen=True, slots=True)
class Footage:
    """Images of one camera; `play` begins at the first one each time, and raises InputError at a damaged one."""

    path: Path
    count: int | None  # None if that is known only after reading all
    play: Callable[[], Generator[Shot]]


def open_footage(
    path: Path,
    *,
    camera: str | None = None,
    fps: float | None = None,
    times: Path | None = None,
    channel: Channel = "gray",
) -> Footage:
    """Find out what lies at `path` and how its images are dated.

    Parameters
    ----------
    path : Path
        A recording (.mcap), a folder of images, or a video file.
    camera : str, optional
        Which of a recording's cameras; needed if it has several.
    fps : float, optional
        Frames a second, instead of the times of a video or of a folder.
    times : Path, optional
        A table of file name and seconds for a folder; default: times.csv in it, if it is there.
    channel : "gray" or "red"
        Of colour images.

    Raises
    ------
    InputError
        There is nothing, nothing that can be read, or nothing that tells the times; the message names the mend.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.is_dir():
        return _open_folder(path, fps, times, channel)
    if times is not None:
        raise InputError(f"{path}: is no folder; a table of times belongs to a folder of images")
    if path.suffix.lower() == ".mcap":
        if fps is not None:
            raise InputError(f"{path}: a recording has its own times; leave fps out")
        return _open_recording(path, camera)
    return _open_video(path, fps, channel)


def _checked(shots: Iterator[Shot], path: Path) -> Generator[Shot]:
    """The same, as long as times increase and the size stays."""
    last: Shot | None = None
    for shot in shots:
        if last is not None and shot.t <= last.t:
            raise InputError(f"{path}: {shot.name} is dated {shot.t:.6f} s, not after {last.name} ({last.t:.6f} s)")
        if last is not None and shot.image.shape != last.image.shape:
            sizes = ("x".join(map(str, item.image.shape[::-1])) for item in (shot, last))
            raise InputError("{}: {} has {} pixels, those before it {}".format(path, shot.name, *sizes))
        yield shot
        last = shot


def _one_channel(image: Image, channel: Channel) -> Image:
    if image.ndim == 2:
        return image
    if channel == "red":
        return np.asarray(cv2.extractChannel(image, 2), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


# ---- recordings ------------------------------------------------------------------------------------------------------


def _open_recording(path: Path, camera: str | None) -> Footage:
    cameras = read_contents(path).frames
    names = ", ".join(sorted(cameras)) or "none"
    if camera is None and len(cameras) != 1:
        raise InputError(f"{path}: holds frames of {names}; say which camera")
    name = camera if camera is not None else next(iter(cameras))
    if name not in cameras:
        raise InputError(f"{path}: no frames of camera '{name}'; it has {names}")

    def play() -> Iterator[Shot]:
        for frame in read_frames(path, name):
            yield Shot(frame.t, frame.image, f"frame {frame.sequence}", frame.encoded)

    return Footage(path, cameras[name], lambda: _checked(play(), path))


# ---- folders ---------------------------------------------------------------------------------------------------------


def _open_folder(path: Path, fps: float | None, times: Path | None, channel: Channel) -> Footage:
    files = sorted((file for file in path.iterdir() if file.suffix.lower() in IMAGES), key=_natural)
    if not files:
        raise InputError(f"{path}: no images in this folder; expected {', '.join(IMAGES)}")
    dated = _date(path, files, fps, times)

    def play() -> Iterator[Shot]:
        for file, t in dated:
            try:
                data = np.fromfile(file, np.uint8)
            except OSError as error:
                raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
            flag = cv2.IMREAD_GRAYSCALE if channel == "gray" else cv2.IMREAD_COLOR
            image = cv2.imdecode(data, flag | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
            if image is None:
                raise InputError(f"{file}: is not an image, or damaged; remove it or its line in the table")
            yield Shot(t, _one_channel(np.asarray(image, dtype=np.uint8), channel), file.name)

    return Footage(path, len(dated), lambda: _checked(play(), path))


def _natural(file: Path) -> list[tuple[int, int, str]]:
    """Orders frame2 before frame10."""
    parts = re.findall(r"\d+|\D+", file.name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _date(path: Path, files: list[Path], fps: float | None, times: Path | None) -> list[tuple[Path, float]]:
    if fps is not None:
        return [(file, number / fps) for number, file in enumerate(files)]
    table = times if times is not None else path / TABLE
    if times is not None or table.exists():
        return _from_table(table, {file.name: file for file in files})
    stamps = [_stamp_in(file.stem) for file in files]
    dated = [(file, stamp) for file, stamp in zip(files, stamps, strict=True) if stamp is not None]
    if len(dated) < len(files):
        without = next(file for file, stamp in zip(files, stamps, strict=True) if stamp is None)
        raise InputError(
            f"{path}: nothing tells when {without.name} was taken; give fps, a table {TABLE} (name, seconds), or names "
            "with a time such as 1712345678.250.jpg"
        )
    return sorted(dated, key=lambda item: item[1])


def _stamp_in(name: str) -> float | None:
    """The last number of a name that looks like a time, in seconds."""
    for text in reversed(re.findall(r"\d+\.\d+|\d+", name)):
        if "." in text or len(text) >= STAMP_DIGITS:
            value = float(text)
            return value * next((unit for least, unit in UNITS if value >= least), 1.0)
    return None


def _from_table(table: Path, files: Mapping[str, Path]) -> list[tuple[Path, float]]:
    """Read lines of file name and seconds; a first line without a number is a heading."""
    try:
        with table.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{table}: cannot be read: {error}") from error
    problems: list[str] = []
    dated: list[tuple[Path, float]] = []
    for number, row in enumerate(rows, 1):
        name, text = row[0].strip(), row[1].strip() if len(row) > 1 else ""
        try:
            t = float(text)
        except ValueError:
            t = math.nan
        if number == 1 and not math.isfinite(t) and name not in files:
            continue
        if not math.isfinite(t):
            problems.append(f"{table} line {number}: found '{text[:20]}'; expected seconds")
        elif name not in files:
            problems.append(f"{table} line {number}: there is no image '{name[:60]}' in the folder")
        else:
            dated.append((files[name], t))
    if not dated and not problems:
        problems.append(f"{table}: has no lines; expected a file name and seconds in each")
    if problems:
        raise InputError(*problems)
    return dated


# ---- videos ----------------------------------------------------------------------------------------------------------


def _open_video(path: Path, fps: float | None, channel: Channel) -> Footage:
    if path.suffix.lower() not in VIDEOS:  # because the decoder takes any text for a film
        raise InputError(f"{path}: no recording (.mcap), folder of images or video ({', '.join(VIDEOS)})")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not (capture.isOpened() and capture.read()[0]):
            raise InputError(f"{path}: no recording of images that can be read; it is empty, damaged or no video")
        count = round(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        own = capture.get(cv2.CAP_PROP_FPS)
    finally:
        capture.release()
    if fps is None and not 0.1 < own < 1001.0:
        raise InputError(f"{path}: the video does not say how many frames a second it has; give fps")

    def play() -> Iterator[Shot]:
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        try:
            number, last = 0, -1.0
            while True:
                done, image = capture.read()
                if not done:
                    return
                if fps is not None:
                    t = number / fps
                else:
                    t = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                    t = t if t > last else last + 1.0 / own  # because some containers have no times
                yield Shot(t, _one_channel(np.asarray(image, dtype=np.uint8), channel), f"frame {number}")
                number, last = number + 1, t
        finally:
            capture.release()

    return Footage(path, count if count > 0 else None, lambda: _checked(play(), path))
