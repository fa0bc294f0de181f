"""Frames out of footage: as pictures with a table of their times, e.g. to calibrate a camera, or as a recording."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import write_atomic
from ..footage import TABLE, Shot
from ..recording import FrameRecorder, read_contents
from ..records import Frame
from .sequence import Tagged, shifted
from .tags import save_tags, tags_path

Span = tuple[float, float]


def export_frames(
    tagged: Tagged, folder: Path, span: Span, suffix: str = "jpg", every: int = 1, sharp: int | None = None
) -> list[Path]:
    """Write frames as pictures into a folder, which is made, with times.csv; returns the files.

    Parameters
    ----------
    span : (since, until)
        Seconds.
    suffix : "jpg" or "png"
        A JPEG that the camera made is written as it came.
    every : int
        Every so-maniest frame.
    sharp : int, optional
        Only so many: the sharpest of each of so many equal parts of the span, as a calibration wants them.

    Raises
    ------
    InputError
        The folder has pictures already, or cannot be written; or there is no frame in the span.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists and is not an empty folder; name a new one")
    chosen = None if sharp is None else _sharpest(tagged, span, every, max(1, sharp))
    written, lines = [], ["file,seconds"]
    for number, shot in tagged.frames(*span):
        if number % max(1, every) or (chosen is not None and number not in chosen):
            continue
        path = folder / f"{folder.name}_{number:06d}.{suffix}"
        write_atomic_in(path, _encoded(shot, suffix))
        written.append(path)
        lines.append(f"{path.name},{shot.t:.6f}")
    if not written:
        raise InputError(f"{tagged.name}: has no frame from {span[0]:g} to {span[1]:g} s")
    write_atomic(folder / TABLE, ("\n".join(lines) + "\n").encode())
    return written


def write_atomic_in(path: Path, data: bytes) -> None:
    """Write a file into a folder that may have to be made; raises InputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path.parent}: cannot be made: {error.strerror or error}") from error
    write_atomic(path, data)


def _encoded(shot: Shot, suffix: str) -> bytes:
    if suffix == "jpg" and shot.encoded is not None:
        return shot.encoded
    options = [cv2.IMWRITE_JPEG_QUALITY, 95] if suffix == "jpg" else []
    return bytes(cv2.imencode(f".{suffix}", shot.image, options)[1])


def _sharpest(tagged: Tagged, span: Span, every: int, count: int) -> set[int]:
    """Numbers of the sharpest frame in each of `count` equal parts of the span."""
    rated = [(number, shot.t, _sharpness(shot.image)) for number, shot in tagged.frames(*span) if number % every == 0]
    if not rated:
        return set()
    begin, end = rated[0][1], rated[-1][1]
    best: dict[int, tuple[float, int]] = {}
    for number, t, value in rated:
        part = min(count - 1, int(count * (t - begin) / max(end - begin, 1e-9)))
        best[part] = max(best.get(part, (-1.0, 0)), (value, number))
    return {number for _, number in best.values()}


def _sharpness(image: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian."""
    return float(cv2.Laplacian(image, cv2.CV_32F).var())


def export_recording(tagged: Tagged, path: Path, span: Span, every: int = 1) -> int:
    """Write frames as a recording with what the footage tells of itself, and the marks; returns how many.

    Raises InputError if there is such a file, or no frame in the span.
    """
    if path.exists():
        raise InputError(f"{path}: exists; name a new file")
    about: dict[str, str] = {}
    ways: tuple[dict[str, str], ...] = ()
    if tagged.camera is not None:
        contents = read_contents(tagged.footage.path)
        about, ways = contents.about, contents.cameras.get(tagged.camera, ())
    way = ways[0] if len(ways) == 1 else {"channel": ways[0].get("channel", "gray")} if ways else {}
    if "pattern" not in about and "pattern" in tagged.taken:
        about = {**about, "pattern": json.dumps(tagged.taken["pattern"])}
    camera = tagged.camera or "camera"
    part = path.with_name(path.name + ".new")
    count, begin = 0, 0.0
    try:
        with FrameRecorder(part, about=about) as recorder:
            for number, shot in tagged.frames(*span):
                if number % max(1, every):
                    continue
                begin = shot.t if not count else begin
                recorder.frame(Frame(camera, shot.t, shot.image, number, shot.encoded), shot.t, way)
                count += 1
        if not count:
            raise InputError(f"{tagged.name}: has no frame from {span[0]:g} to {span[1]:g} s")
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    if tagged.tags:
        save_tags(shifted(tagged.tags, begin), tags_path(path))
    return count
