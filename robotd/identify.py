"""Which label is which light: flash requests in slots, and the decoding of what the cameras then see.

The label system gives no feedback: it is polled, sends commands one after the other, every label starts after its own
unknown delay, and some commands are lost. The length of a flash is ours, though. So in each slot every label flashes
for a number of seconds that is one digit of its code word, over an alphabet of q durations. The words are a
Reed-Solomon code, which is maximum distance separable: with k digits of information (q^k >= number of labels) and c
check digits any two labels differ in c + 1 slots or more, so a lost command or a hidden light costs a digit, not the
identity. Starts are unknown and summed over; an identity is a posterior probability over all labels and "none of
them", and below a threshold the light is left undecided.

Reed and Solomon, Polynomial Codes over Certain Finite Fields, J. SIAM 8 (1960); one digit for infinity makes the
extended code, of length q + 1.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .bind import ranged
from .records import Floats, Frame, Sighting
from .vision.blink import FLOOR_PX, FlashConfig, FlashDetector, FlashPattern
from .vision.bursts import BurstScorer
from .vision.patches import PatchRecorder
from .vision.spot import Spot

Digits = NDArray[np.int64]

SCORING_S = 0.25  # time between two looks at whether the known lights flash
STAMP_S = 0.15  # frame stamps and the time of a request may disagree by so much
SURE = 8.0  # log-likelihood ratio from which a flash may refine a position
NONE_FLASHES = 0.1  # probability that a light which is no label of ours flashes in a slot


@dataclass(frozen=True, slots=True)
class IdentifyConfig:
    """[identify] settings: the label system's habits, the code, and the cameras as the detector needs them."""

    find_duration_s: int = ranged(
        3, minimum=0, maximum=60, doc="all labels flash for so long in slot 0; 0: no such slot"
    )
    poll_s: float = ranged(3.0, minimum=0.0, maximum=60.0, doc="the label system looks for requests this often")
    commands_per_s: float = ranged(10.0, minimum=0.01, doc="commands that it sends per second")
    delay_normal_s: float = ranged(
        3.0, minimum=0.0, maximum=60.0, doc="delay of a command within which most labels start"
    )
    delay_tail_s: float = ranged(6.0, minimum=0.0, maximum=120.0, doc="delay after which a command counts as lost")
    lost_fraction: float = ranged(0.02, minimum=1e-4, maximum=0.5, doc="fraction of commands that are lost")
    durations_s: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8)
    check_digits: int = ranged(1, minimum=0, maximum=6, doc="digits of a code word beyond those that tell labels apart")
    max_repeats: int = ranged(2, minimum=0, maximum=3, doc="further slots for what is still undecided")
    repeat_fraction: float = ranged(0.05, minimum=0.0, maximum=1.0, doc="undecided fraction that is worth such a slot")
    min_probability: float = ranged(0.99, minimum=0.5, maximum=1.0, doc="below it a light is undecided")
    surprise: float = ranged(0.003, minimum=1e-6, maximum=0.2, doc="fraction of flashes with another length than asked")
    none_fraction: float = ranged(
        0.02, minimum=1e-6, maximum=0.5, doc="fraction of found lights that are no label of ours"
    )
    strength: float = ranged(1.0, minimum=0.01, maximum=1.0, doc="brightness asked of the labels")
    pattern: FlashPattern = field(default_factory=FlashPattern)
    gamma: float = ranged(2.2, minimum=0.3, maximum=4.0, doc="the cameras' curve: grey = light^(1/gamma)")
    exposure_s: float = ranged(0.010, minimum=0.0, maximum=0.2, doc="exposure time while looking for flashes")
    row_time_s: float = ranged(
        0.0, minimum=0.0, maximum=0.001, doc="time from one image row's exposure to the next one's"
    )

    def __post_init__(self) -> None:
        durations = self.durations_s
        if len(durations) < 2 or any(len(durations) % n == 0 for n in range(2, len(durations))):
            raise ValueError(
                f"durations_s has {len(durations)} entries; expected a prime number of them, such as 5 or 7"
            )
        if durations[0] < 1 or list(durations) != sorted(set(durations)):
            raise ValueError(f"durations_s = {list(durations)}: expected whole seconds of 1 or more that increase")

    def flash_config(self) -> FlashConfig:
        """Settings of the cameras' detectors."""
        return FlashConfig(
            pattern=self.pattern, gamma=self.gamma, exposure_s=self.exposure_s, row_time_s=self.row_time_s
        )


@dataclass(frozen=True, slots=True)
class FlashRequest:
    """Ask the label system that these labels flash for `duration` whole seconds."""

    labels: tuple[str, ...]
    duration: int


@dataclass(frozen=True, slots=True)
class Slot:
    """An interval in which chosen labels flash; it ends `timeout` seconds after its requests at the latest."""

    number: int
    requests: tuple[FlashRequest, ...]
    timeout: float


def code_words(number: int, symbols: int, check_digits: int, extra: int = 0) -> tuple[Digits, int]:
    """Reed-Solomon code words for so many labels, those with the shortest durations first.

    Parameters
    ----------
    number : int
        Labels.
    symbols : int
        Prime size q of the alphabet.
    check_digits, extra : int
        Digits beyond those of information, and further columns for repeated slots.

    Returns
    -------
    words : (number, length) array
        Digits 0..q-1. Any two rows agree in fewer than k columns, over any choice of up to q + 1 columns.
    planned : int
        Columns to be sent; the rest is `extra`, as far as the code allows.
    """
    information = 1
    while symbols**information < number:
        information += 1
    planned = min(information + check_digits, max(symbols + 1, information))
    length = max(planned, min(planned + extra, symbols + 1))
    messages = np.arange(symbols**information)[:, None] // symbols ** np.arange(information)[None, :] % symbols
    if length > symbols + 1:  # more information than the alphabet can protect: the plain number
        return messages[:number], information
    columns = []
    for point in range(min(length, symbols)):
        value = np.zeros(len(messages), np.int64)
        for digit in messages.T[::-1]:
            value = (value * point + digit) % symbols
        columns.append(value)
    if length == symbols + 1:
        columns.append(messages[:, -1])
    words = np.stack(columns, axis=1)
    sent = words[:, :planned]
    order = np.lexsort((sent.sum(axis=1), sent.max(axis=1)))
    return words[order[:number]], planned


def posterior(scores: Sequence[Floats], digits: Sequence[Digits], config: IdentifyConfig) -> Floats:
    """Probability of every label for every light.

    Parameters
    ----------
    scores : sequence of (N, Q) arrays
        Per slot, log-likelihood of a flash of each duration at each light, relative to darkness.
    digits : sequence of (L,) arrays
        Per slot, the duration's index asked of each label; -1: the label was not asked.
    config : IdentifyConfig
        Its `lost_fraction`, `surprise` and `none_fraction` are the model.

    Returns
    -------
    (N, L + 1) array
        Rows sum to 1; the last column is "no label of ours", which flashes, or not, for any duration in any slot.
    """
    labels = len(digits[0])
    total = np.full((len(scores[0]), labels + 1), np.log((1.0 - config.none_fraction) / labels))
    total[:, -1] = np.log(config.none_fraction)
    lost, surprise = config.lost_fraction, config.surprise
    for score, digit in zip(scores, digits, strict=True):
        top = np.maximum(score.max(axis=1, initial=0.0), 0.0)[:, None]
        flash, dark = np.exp(score - top), np.exp(-top)
        other = flash.mean(axis=1, keepdims=True)
        asked = (1.0 - lost) * ((1.0 - surprise) * flash + surprise * other) + lost * dark
        unasked = (1.0 - surprise) * dark + surprise * other
        likelihood = np.log(
            np.maximum(
                np.concatenate([asked, unasked, NONE_FLASHES * other + (1.0 - NONE_FLASHES) * dark], axis=1), 1e-300
            )
        )
        total[:, :-1] += likelihood[:, np.where(digit < 0, score.shape[1], digit)]
        total[:, -1] += likelihood[:, -1]
    total = np.exp(total - total.max(axis=1, keepdims=True))
    return np.asarray(total / total.sum(axis=1, keepdims=True))


class _Camera:
    """One camera's detector, burst scores and patches; `update` runs in a worker thread."""

    def __init__(self, config: IdentifyConfig) -> None:
        flash = config.flash_config()
        self.lock = threading.Lock()
        self.detector = FlashDetector(flash)
        self.bursts = BurstScorer(flash.pattern, flash.exposure_s)
        self.patches = PatchRecorder(flash.pattern, flash.exposure_s, flash.gamma)
        self.latest = -np.inf
        self.scored = -np.inf
        self.activity = (-np.inf, np.zeros(0), np.zeros(0))  # scored until; first and last burst of each light

    def update(self, frame: Frame) -> None:
        with self.lock:
            if frame.t <= self.latest:  # a camera that repeats or reorders its frames tells nothing new with them
                return
            self.latest = frame.t
            decided = self.detector.update(frame.image, frame.t)
            self.patches.record(frame.image, frame.t)
            tracks = self.detector.tracks
            fresh = len(tracks) > len(self.bursts.active_last)
            if not tracks or (not (decided and fresh) and frame.t - self.scored < SCORING_S):
                return
            rows = np.array([track.row for track in tracks], np.intp)
            columns = np.array([track.column for track in tracks], np.intp)
            for track in tracks[len(self.bursts.active_last) :]:
                self.patches.add(2.0 * track.column + 1.5, 2.0 * track.row + 1.5, frame.image.shape)
            since = -np.inf if fresh else self.bursts.scored_until - 0.05
            self.bursts.extend(*self.detector.light_curves(rows, columns, since), *self.strengths())
            self.scored = frame.t
            self.activity = (
                self.bursts.scored_until,
                self.bursts.active_first.copy(),
                self.bursts.active_last.copy(),
            )

    def strengths(self) -> tuple[Floats, Floats]:
        """Light of every track when on, and the variance of its light curve."""
        tracks = self.detector.tracks
        return np.array([track.light for track in tracks]), np.array([track.variance for track in tracks])

    def spot(self, index: int) -> Spot | None:
        """Where a light is: from its patches, unless these say less than the detector's cells, or something else."""
        coarse, fine = self.detector.spot(self.detector.tracks[index]), self.patches.spot(index)
        if coarse is None or fine is None:
            return coarse or fine
        agree = np.hypot(fine.u - coarse.u, fine.v - coarse.v) < 1.0 + 3.0 * coarse.sigma
        return fine if agree and fine.sigma < coarse.sigma else coarse

    def begin(self) -> None:
        with self.lock:
            self.bursts.forget_activity()
            self.activity = (self.bursts.scored_until, self.bursts.active_first.copy(), self.bursts.active_last.copy())


class Identifier:
    """Finds and names the labels that flash at one stop; the robot stands still.

    Call `next_slot`, send its requests, `begin`, feed every camera's frames to `update` until `is_complete` or the
    slot's timeout, and again until `next_slot` returns None; then `finish`.

    Parameters
    ----------
    labels : sequence of str
        Every label that may be visible.
    cameras : sequence of str
        Names that frames carry.
    config : IdentifyConfig
    """

    def __init__(self, labels: Sequence[str], cameras: Sequence[str], config: IdentifyConfig) -> None:
        self.labels = tuple(labels)
        self.config = config
        self.undecided = 0  # lights that flashed but got no name, known after `finish`
        self._cameras = {name: _Camera(config) for name in cameras}
        self._words, self._planned = code_words(
            len(self.labels), len(config.durations_s), config.check_digits, config.max_repeats
        )
        self._slots: list[tuple[Slot, Digits | None, float]] = []  # with the digits sent and the time of the requests
        self._waiting: tuple[Slot, Digits | None] | None = None
        self._column = 0

    def next_slot(self) -> Slot | None:
        """The next slot to be flashed, or None when all were, or nothing is left that one more would tell."""
        if not self.labels:
            return None
        self._refine()
        if not self._slots and self.config.find_duration_s:
            request = FlashRequest(self.labels, self.config.find_duration_s)
            return self._plan((request,), None)
        everyone = np.ones(len(self.labels), bool)
        if self._column >= self._planned:
            everyone = self._doubtful()
            if self._column >= self._words.shape[1] or not everyone.any():
                return None
        digits = np.where(everyone, self._words[:, self._column], -1)
        self._column += 1
        requests = tuple(
            FlashRequest(tuple(self.labels[index] for index in np.flatnonzero(digits == digit)), duration)
            for digit, duration in reversed(list(enumerate(self.config.durations_s)))  # the longest are sent first
            if (digits == digit).any()
        )
        return self._plan(requests, digits)

    def begin(self, slot: Slot, t: float) -> None:
        """The slot's requests were just sent, at time `t` of the frames' clock (within 0.1 s)."""
        if self._waiting is None or slot is not self._waiting[0]:
            raise ValueError(f"slot {slot.number} is not the one that next_slot() returned last")
        self._slots.append((*self._waiting, t))
        self._waiting = None
        for camera in self._cameras.values():
            camera.begin()

    def update(self, camera: str, frame: Frame) -> None:
        """Take one frame; may run in a worker thread, one call at a time per camera."""
        self._cameras[camera].update(frame)

    def is_complete(self, t: float) -> bool:
        """True when the slot may end early: what was to flash has flashed and is dark again."""
        if not self._slots or self._waiting is not None:
            return False
        slot, _, begun = self._slots[-1]
        config = self.config
        period = config.pattern.period
        sent = sum(len(request.labels) for request in slot.requests) / config.commands_per_s
        earliest, lights, finished = np.inf, 0, 0
        for camera in self._cameras.values():
            until, first, last = camera.activity
            flashed = last >= begun - STAMP_S
            if np.any(flashed & (until < last + period + 0.05)):
                return False
            lights += len(last)
            finished += int(flashed.sum())
            earliest = min(earliest, float(first.min(initial=np.inf, where=first >= begun - STAMP_S)))
        polled = min(earliest, begun + config.poll_s)
        if t >= polled + sent + config.delay_tail_s + 2.0 * period:
            return True
        if len(self._slots) == 1:
            return lights > 0 and t >= polled + sent + config.delay_normal_s + 2.0 * period
        return finished == lights > 0

    def finish(self) -> tuple[Sighting, ...]:
        """Every light that was identified; several lights of one label in one camera are rivals."""
        self._refine()
        sightings = []
        self.undecided = 0
        for name, camera in self._cameras.items():
            for index, odds in enumerate(self._odds(camera)):
                best = int(np.argmax(odds[:-1]))
                if odds[best] < self.config.min_probability:
                    self.undecided += int(odds[-1] < 0.5)
                elif (spot := camera.spot(index)) is not None:
                    sigma = float(np.hypot(spot.sigma, FLOOR_PX))
                    sightings.append(Sighting(name, self.labels[best], spot.u, spot.v, sigma, float(odds[best])))
        return tuple(sightings)

    # ---- planning and decoding ---------------------------------------------------------------------------------------

    def _plan(self, requests: tuple[FlashRequest, ...], digits: Digits | None) -> Slot:
        config = self.config
        sent = sum(len(request.labels) for request in requests) / config.commands_per_s
        longest = max(request.duration for request in requests)
        timeout = config.poll_s + sent + config.delay_tail_s + longest + 2.0 * config.pattern.period + 0.5
        slot = Slot(len(self._slots), requests, timeout)
        self._waiting = (slot, digits)
        return slot

    def _window(self, number: int) -> tuple[float, float]:
        """Times between which a flash that answers slot `number` can begin."""
        following = self._slots[number + 1][2] if number + 1 < len(self._slots) else np.inf
        return self._slots[number][2] - STAMP_S, following - STAMP_S

    def _periods(self, slot: Slot, digits: Digits | None) -> tuple[int, ...]:
        durations = self.config.durations_s if digits is not None else (slot.requests[0].duration,)
        return tuple(max(1, round(duration / self.config.pattern.period)) for duration in durations)

    def _refine(self) -> None:
        """Add what the slot that just ended showed to the positions."""
        if not self._slots:
            return
        slot, digits, _ = self._slots[-1]
        periods = self._periods(slot, digits)
        for camera in self._cameras.values():
            with camera.lock:
                if camera.bursts.places:
                    runs = camera.bursts.runs(*self._window(len(self._slots) - 1), periods, *camera.strengths())
                    best = np.argmax(runs.score, axis=1)
                    for index, column in enumerate(best):
                        if runs.score[index, column] > SURE:
                            camera.patches.grow(index, float(runs.start[index, column]), periods[column])
                camera.patches.forget()

    def _odds(self, camera: _Camera) -> Floats:
        """Probabilities (N, L + 1) of the labels, and of none of them, for every light of one camera."""
        scores, sent = [], []
        with camera.lock:
            for number, (slot, digits, _) in enumerate(self._slots):
                if digits is not None and camera.bursts.places:
                    periods = self._periods(slot, digits)
                    scores.append(camera.bursts.runs(*self._window(number), periods, *camera.strengths()).score)
                    sent.append(digits)
        return posterior(scores, sent, self.config) if scores else np.zeros((0, len(self.labels) + 1))

    def _doubtful(self) -> NDArray[np.bool_]:
        """Labels that one more slot should tell apart; none if too few lights are undecided."""
        odds = np.concatenate([np.zeros((0, len(self.labels) + 1)), *map(self._odds, self._cameras.values())])
        named = odds[:, -1] < 0.5
        undecided = named & (odds[:, :-1].max(axis=1) < self.config.min_probability)
        if undecided.sum() < max(1.0, self.config.repeat_fraction * named.sum()):
            return np.zeros(len(self.labels), bool)
        return np.asarray((odds[undecided, :-1] > 1e-3).any(axis=0))
