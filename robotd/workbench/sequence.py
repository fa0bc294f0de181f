"""Footage with its marks, and what detectors make of it: whole, in clips, or frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..footage import Footage, Shot, open_footage
from ..jpeg import Channel
from ..recording import Contents, read_contents
from ..records import Flash
from .detectors import Detector, recorded_settings
from .score import Score
from .tags import Tag, is_inside, load_tags, moved, tags_path

WHOLE = 0.8  # a mark that holds for so much of a clip counts in it; one that holds for less is not judged there
SHORT = 0.75  # of a clip: a shorter rest of the footage is left out
REACH = 1.5  # px by which a trigger's middle may be off
FIRST = 2  # frames that a detector needs

Make = Callable[["Tagged"], Detector]


@dataclass(frozen=True, slots=True)
class Tagged:
    """Footage of one camera with its marks; times are seconds after its first frame.

    `taken` are the settings that the footage itself tells (exposure, gamma, pattern).
    """

    footage: Footage
    camera: str | None
    tags: tuple[Tag, ...]
    taken: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """For messages."""
        path = str(self.footage.path)
        return path if self.camera is None else f"{path}:{self.camera}"

    def frames(self, since: float = 0.0, until: float = math.inf) -> Generator[tuple[int, Shot]]:
        """Number and image of every frame in a span of time.

        Raises InputError at a damaged one, and if a mark lies outside of the images.
        """
        shots = self.footage.play()
        begin: float | None = None
        try:
            for number, shot in enumerate(shots):
                if begin is None:
                    begin = shot.t
                    self._check((shot.image.shape[1], shot.image.shape[0]))
                t = shot.t - begin
                if t > until:
                    return
                if t >= since:
                    yield number, replace(shot, t=t)
        finally:
            shots.close()

    def _check(self, size: tuple[int, int]) -> None:
        file, image = tags_path(self.footage.path), f"{size[0]}x{size[1]}"
        problems = [
            f"{file}: mark at {tag.u:g},{tag.v:g} is outside of the image of {image}; correct or remove it"
            for tag in self.tags
            if not is_inside(tag, size)
        ]
        if problems:
            raise InputError(*problems)


def open_tagged(
    path: Path,
    *,
    camera: str | None = None,
    fps: float | None = None,
    times: Path | None = None,
    channel: Channel = "gray",
) -> Tagged:
    """Open footage and its marks; raises InputError, e.g. if a recording has several cameras and none is named."""
    footage = open_footage(path, camera=camera, fps=fps, times=times, channel=channel)
    contents = read_contents(path) if path.suffix.lower() == ".mcap" else None
    if contents is not None and camera is None:
        camera = next(iter(contents.frames))
    return Tagged(
        footage,
        camera if contents is not None else None,
        tuple(load_tags(tags_path(path), camera)),
        _taken(contents, camera),
    )


def open_all(paths: Sequence[Path], *, camera: str | None = None, **options: Any) -> list[Tagged]:
    """Open several; of a recording with several cameras every one, unless one is named."""
    found: list[Tagged] = []
    problems: list[str] = []
    for path in paths:
        try:
            names: list[str | None] = [camera]
            if camera is None and path.suffix.lower() == ".mcap":
                names = [*read_contents(path).frames] or [None]
            found += [open_tagged(path, camera=name, **options) for name in names]
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(*problems)
    return found


def _taken(contents: Contents | None, camera: str | None) -> dict[str, Any]:
    if contents is None or camera is None:
        return {}
    modes = contents.cameras.get(camera, ({},))
    return recorded_settings(contents.about, modes[0] if len(modes) == 1 else {})


# ---- running a detector ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Step:
    """A frame that a detector has taken; `decided` says whether its flashes may have changed."""

    number: int
    shot: Shot
    decided: bool


def steps(tagged: Tagged, detector: Detector, since: float = 0.0, until: float = math.inf) -> Iterator[Step]:
    """Feed a detector and let the caller look at it after each frame."""
    for number, shot in tagged.frames(since, until):
        yield Step(number, shot, detector.feed(shot.image, shot.t))


@dataclass(frozen=True, slots=True)
class Appearance:
    """A light that a detector began, or ceased, to report at `t` seconds."""

    t: float
    frame: int
    appears: bool
    flash: Flash


def appearances(before: Sequence[Flash], now: Sequence[Flash], t: float, frame: int) -> list[Appearance]:
    """What has changed between two lists of flashes; lights within 2.5 px are the same."""

    def missing(ones: Sequence[Flash], others: Sequence[Flash]) -> list[Flash]:
        return [a for a in ones if not any(math.hypot(a.u - b.u, a.v - b.v) < 2.5 for b in others)]

    return [
        *(Appearance(t, frame, True, flash) for flash in missing(now, before)),
        *(Appearance(t, frame, False, flash) for flash in missing(before, now)),
    ]


def judge_clips(
    tagged: Tagged,
    make: Make,
    scores: dict[float, Score],
    *,
    clip_s: float | None = None,
    since: float = 0.0,
    until: float = math.inf,
) -> None:
    """Run a detector on footage, cut into clips that are judged each by itself, and add up scores.

    Parameters
    ----------
    scores : dict of float to Score
        By the time in seconds after a clip's begin at which findings are taken; inf: at its end.
    clip_s : float, optional
        Length of the clips; default: all of the footage in one.
    """
    clip = _Clip(tagged, make, scores, since, since + (clip_s or math.inf))
    last = since
    for _, shot in tagged.frames(since, until):
        while clip_s is not None and shot.t >= clip.begin + clip_s:
            clip.close(clip.begin + clip_s)
            clip = _Clip(tagged, make, scores, clip.begin + clip_s, clip.begin + 2.0 * clip_s)
        clip.feed(shot)
        last = shot.t
    if clip.frames >= FIRST and (clip_s is None or last - clip.begin >= SHORT * clip_s or clip.begin == since):
        clip.close(last)


class _Clip:
    """A part of footage under judgement, with a detector of its own."""

    def __init__(self, tagged: Tagged, make: Make, scores: dict[float, Score], begin: float, end: float) -> None:
        self.tagged = tagged
        self.begin = begin
        self.frames = 0
        self._end = end
        self._detector = make(tagged)
        self._scores = scores
        self._waiting = sorted(scores)

    def feed(self, shot: Shot) -> None:
        while self._waiting and shot.t - self.begin >= self._waiting[0]:
            self._add(self._waiting.pop(0), shot.t)
        self._detector.feed(shot.image, shot.t)
        self.frames += 1

    def close(self, end: float) -> None:
        for cut in self._waiting:
            if not math.isfinite(cut) or end - self.begin >= cut:
                self._add(cut, end)

    def _add(self, cut: float, end: float) -> None:
        tags = [(tag, number, tag.share(self.begin, end)) for number, tag in enumerate(self.tagged.tags, 1)]
        labels = [(tag, number) for tag, number, share in tags if tag.kind == "label" and share >= WHOLE]
        self._scores[cut].add(
            self._detector.flashes(),
            [tag for tag, _ in labels],
            [tag for tag, _, share in tags if tag.kind == "reflection" and share > 0.0],
            f"{self.tagged.name}@{self.begin:g}",
            ignored=[
                tag
                for tag, _, share in tags
                if share > 0.0 and (tag.kind == "ignore" or (tag.kind == "label" and share < WHOLE))
            ],
            keys=[(self.tagged.name, number) for _, number in labels],
        )


def tags_at(tags: Sequence[Tag], t: float) -> list[Tag]:
    """The marks that hold at `t` seconds."""
    return [tag for tag in tags if tag.since <= t and (tag.until is None or t <= tag.until)]


def shifted(tags: Sequence[Tag], seconds: float) -> list[Tag]:
    """The marks in footage that begins so much later, without those that are over by then."""
    return [moved(tag, seconds) for tag in tags if tag.until is None or tag.until > seconds]


# ---- what detectors measure at labels and elsewhere ------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Measured:
    """One trigger: what the detector measured, and whether it lay on a marked label."""

    t: float
    on_label: bool
    passed: bool
    values: dict[str, float]


def measure(tagged: Tagged, detector: Detector, since: float = 0.0, until: float = math.inf) -> list[Measured]:
    """Every trigger of a detector at its decisions; those in places that are not judged are left out.

    Thesis section 6.3.2 and figure 25: all that passes the threshold beside what lies on true labels.
    """
    found: list[Measured] = []
    for step in steps(tagged, detector, since, until):
        if not step.decided:
            continue
        tags = [
            tag for tag in tagged.tags if tag.since <= step.shot.t <= (math.inf if tag.until is None else tag.until)
        ]
        for trigger in detector.explain().triggers:
            near = [tag for tag in tags if math.hypot(tag.u - trigger.u, tag.v - trigger.v) < tag.radius + REACH]
            if any(tag.kind != "label" for tag in near):
                continue
            found.append(Measured(step.shot.t, bool(near), trigger.passed, trigger.values))
    return found
