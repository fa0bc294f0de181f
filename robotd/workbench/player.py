"""Playing footage with marks and findings: at its own pace, frame by frame, or into a video for any player."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np
from numpy.typing import NDArray

from ..clock import in_thread, now
from ..errors import InputError
from ..files import write_atomic
from ..footage import Shot
from ..records import Flash
from ..vision.figures import Picture
from .detectors import Detector
from .pictures import Seen, overlay
from .sequence import Tagged, tags_at

ZOOM = 2.0

Tell = Callable[[int, Shot, Seen], None]


class Player:
    """Shows frames: tells `tell` of each, and keeps the present one in the picture `view`.

    Parameters
    ----------
    make : callable
        Makes a fresh detector, or None for none; again when going back.
    """

    def __init__(
        self, tagged: Tagged, make: Callable[[], Detector | None], tell: Tell, view: Path | None = None
    ) -> None:
        self._tagged = tagged
        self._make = make
        self._tell = tell
        self._view = view

    async def play(self, since: float, until: float, speed: float = 1.0) -> int:
        """Show frames when they are due on the loop's clock, and leave out those that are late; returns how many."""
        shown, begun = 0, now()
        waiting = _fed(self._tagged, self._make(), since, until)
        ahead = await in_thread(next, waiting, None)
        while ahead is not None:
            number, shot, flashes = ahead
            due = begun + (shot.t - since) / speed
            ahead = await in_thread(next, waiting, None)
            if ahead is not None and begun + (ahead[1].t - since) / speed < now():
                continue
            await asyncio.sleep(max(0.0, due - now()))
            seen = self._shown(number, shot, flashes)
            await in_thread(self._draw, number, shot, seen)
            shown += 1
        return shown

    def step(self, commands: TextIO, since: float, until: float) -> None:
        """Show one frame after the other, each when a line was read: see the command line's help."""
        frames = _fed(self._tagged, self._make(), since, until)
        present = next(frames, None)
        wanted: int | None = None
        while present is not None:
            number, shot, flashes = present
            if wanted is None or number >= wanted:
                self._draw(number, shot, self._shown(number, shot, flashes))
                line = commands.readline()
                order = line.strip()
                if not line or order == "q":
                    return
                wanted = number - 1 if order == "b" else int(order) if order.isdecimal() else None
                if wanted is not None and wanted <= number:
                    frames = _fed(self._tagged, self._make(), since, until)
            present = next(frames, None)

    def _shown(self, number: int, shot: Shot, flashes: list[Flash] | None) -> Seen:
        seen = seen_at(self._tagged, shot, flashes)
        self._tell(number, shot, seen)
        return seen

    def _draw(self, number: int, shot: Shot, seen: Seen) -> None:
        if self._view is not None:
            write_picture(self._view, overlay(shot.image, seen, f"frame {number}, {shot.t:.3f} s", ZOOM))


def seen_at(tagged: Tagged, shot: Shot, flashes: list[Flash] | None) -> Seen:
    """Marks that hold at a frame, and findings so far."""
    return Seen(tags_at(tagged.tags, shot.t), flashes)


def _fed(
    tagged: Tagged, detector: Detector | None, since: float, until: float
) -> Iterator[tuple[int, Shot, list[Flash] | None]]:
    flashes: list[Flash] | None = None if detector is None else []
    for number, shot in tagged.frames(since, until):
        if detector is not None and detector.feed(shot.image, shot.t):
            flashes = detector.flashes()
        yield number, shot, flashes


def write_video(path: Path, tagged: Tagged, detector: Detector | None, since: float, until: float) -> int:
    """Write frames with marks and findings as Motion JPEG; returns how many. Raises InputError.

    A video has one rate, so the median of the frames' is taken.
    """
    if path.suffix.lower() != ".avi":
        raise InputError(f"{path}: expected a name that ends in .avi")
    times = [shot.t for _, shot in tagged.frames(since, until)]
    if len(times) < 2:
        raise InputError(f"{tagged.name}: has {len(times)} frames there; a video needs two")
    rate = float(1.0 / np.median(np.diff(times)))
    writer: cv2.VideoWriter | None = None
    count = 0
    try:
        for number, shot, flashes in _fed(tagged, detector, since, until):
            picture = overlay(shot.image, seen_at(tagged, shot, flashes), f"frame {number}, {shot.t:.3f} s", ZOOM)
            if writer is None:
                size = picture.shape[1], picture.shape[0]
                writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, size)
                if not writer.isOpened():
                    raise InputError(f"{path}: cannot be written; choose another folder")
            writer.write(picture)
            count += 1
    finally:
        if writer is not None:
            writer.release()
    return count


def mean_picture(tagged: Tagged) -> NDArray[np.uint8]:
    """The mean of the first 60 frames, in which walkers and noise are faint."""
    images: list[NDArray[np.uint8]] = []
    for _, shot in tagged.frames():
        images.append(shot.image)
        if len(images) == 60:
            break
    return np.asarray(np.rint(np.mean(images, axis=0, dtype=np.float32)), dtype=np.uint8)


def write_picture(path: Path, picture: Picture) -> None:
    """Write a picture, whole or not at all; raises InputError."""
    suffix = path.suffix.lower()
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"{path}: expected a name that ends in .png or .jpg")
    done, data = cv2.imencode(suffix, picture)
    if not done or not math.prod(picture.shape):
        raise InputError(f"{path}: cannot be encoded")
    write_atomic(path, data.tobytes())
