"""The lights that flash at one stop, found in the cameras' frames and named.

The detectors learn where lights blink; from then on each place's light curve is scored for bursts, which says in every
slot for how long it flashed and since when. That is what `inquiry` asks for and `decoder` reads. Reflections flash with
their lamp: they are reported as rival sightings of its label, and the solver's geometry decides.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from ..records import Floats, Frame, Pose, Sighting
from ..vision.blink import FLOOR_PX, FlashDetector
from ..vision.bursts import BurstScorer
from ..vision.patches import PatchRecorder
from ..vision.spot import Spot
from .decoder import Posterior, Prior
from .delays import STAMP_S, DelayModel
from .inquiry import Candidates, Inquiry, requests
from .memory import LabelMemory
from .settings import IdentifyConfig, Slot

SCORING_S = 0.25  # time between two looks at whether the known lights flash
SURE = 8.0  # log-likelihood ratio from which a flash may refine a position


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

    def place(self, index: int) -> tuple[float, float]:
        """Where a light is, to a cell at least."""
        track = self.detector.tracks[index]
        spot = self.spot(index)
        return (spot.u, spot.v) if spot is not None else (2.0 * track.column + 1.5, 2.0 * track.row + 1.5)

    def begin(self) -> None:
        """Look for this slot's first and last bursts."""
        with self.lock:
            self.bursts.forget_activity()
            self.activity = (self.bursts.scored_until, self.bursts.active_first.copy(), self.bursts.active_last.copy())


class Identifier:
    """Finds and names the labels that flash at one stop; the robot stands still.

    Call `next_slot`, send its requests, `begin`, feed every camera's frames to `update` until `is_complete` or the
    slot's timeout, and again until `next_slot` returns None; then `finish`. All but `begin` and `is_complete` may take
    a while: call them in a worker thread.

    Parameters
    ----------
    labels : sequence of str
        Every label of the store.
    cameras : sequence of str
        Names that frames carry.
    config : IdentifyConfig
    delays : DelayModel, optional
        What earlier stops taught about the label system's timing; this stop adds to it.
    memory : LabelMemory, optional
        What earlier stops taught about where labels are; `finish` adds this stop's sightings to it.
    pose, travelled
        Where the robot stands, in odometry axes and metres along the line; for `memory`.

    Attributes
    ----------
    undecided : int
        Lights that flashed but got no name, known after `finish`.
    mistaken : tuple of str
        Labels that were named by their place, and asked again turned out to be others; known after `finish`.
    """

    def __init__(
        self,
        labels: Sequence[str],
        cameras: Sequence[str],
        config: IdentifyConfig,
        *,
        delays: DelayModel | None = None,
        memory: LabelMemory | None = None,
        pose: Pose | None = None,
        travelled: float = 0.0,
    ) -> None:
        self.labels = tuple(labels)
        self.config = config
        self.undecided = 0
        self.mistaken: tuple[str, ...] = ()
        self._memory = memory
        self._pose = pose or Pose(0.0, 0.0, 0.0)
        self._travelled = travelled
        if memory is None:
            self._candidates = Candidates.anything(len(self.labels))
        else:
            self._candidates = memory.candidates(self._pose, travelled, cameras)
        self._cameras = {name: _Camera(config) for name in cameras}
        self._inquiry = Inquiry(self._candidates, config, delays or DelayModel(config), seed=round(1000.0 * travelled))
        self._lights: list[tuple[str, int]] = []  # camera and number of the track, in the order of their discovery
        self._posterior: Posterior | None = None
        self._waiting: Slot | None = None
        self._number = 0
        self._begun: float | None = None  # the running slot's time

    def next_slot(self, t: float) -> Slot | None:
        """The next slot to be flashed, or None when nothing is left that one more would tell.

        Parameters
        ----------
        t : float
            Now, of the frames' clock.
        """
        self._collect(t)
        question = self._inquiry.next_question(self._posterior, t)
        if question is None:
            return None
        asked = requests(question, self.labels, self.config, self._inquiry.delays)
        self._waiting = Slot(self._number, asked, self._inquiry.longest)
        self._number += 1
        return self._waiting

    def begin(self, slot: Slot, t: float) -> None:
        """The slot's first request is sent now, at time `t` of the frames' clock (within 0.1 s)."""
        if self._waiting is None or slot is not self._waiting:
            raise ValueError(f"slot {slot.number} is not the one that next_slot() returned last")
        self._waiting = None
        self._begun = t
        self._inquiry.begin(t)
        for camera in self._cameras.values():
            camera.begin()

    def update(self, camera: str, frame: Frame) -> None:
        """Take one frame; may run in a worker thread, one call at a time per camera."""
        self._cameras[camera].update(frame)

    def is_complete(self, t: float) -> bool:
        """True when the slot may end early: what was to flash has flashed and is dark again."""
        if self._begun is None:
            return False
        earliest, latest = np.inf, -np.inf
        flashed: dict[tuple[str, int], bool] = {}
        for name, camera in self._cameras.items():
            until, first, last = camera.activity
            here = last >= self._begun - STAMP_S
            if np.any(here & (until < last + self.config.pattern.period + 0.05)):
                return False
            flashed.update(((name, track), bool(lit)) for track, lit in enumerate(here))
            earliest = min(earliest, float(first.min(initial=np.inf, where=first >= self._begun - STAMP_S)))
            latest = max(latest, float(last.max(initial=-np.inf, where=here)))
        known = [flashed.pop(light, False) for light in self._lights]
        return self._inquiry.is_over(t, earliest, latest, np.array([*known, *flashed.values()], bool))

    def finish(self, t: float) -> tuple[Sighting, ...]:
        """Every light that was identified; several lights of one label in one camera are rivals."""
        self._collect(t)
        posterior = self._posterior
        if posterior is None:
            return ()
        doubted = self._doubted(posterior)
        decided = posterior.decided(self.config.min_probability)
        self.undecided = int(posterior.open(self.config.min_probability).sum())
        sightings = []
        for light in np.flatnonzero(decided):
            name, track = self._lights[light]
            label = self.labels[posterior.label[light]]
            spot = self._cameras[name].spot(track)
            if spot is not None and label not in doubted:
                sigma = float(np.hypot(spot.sigma, FLOOR_PX))
                probability = float(posterior.probability[light])
                sightings.append(Sighting(name, label, spot.u, spot.v, sigma, probability))
        self.mistaken = tuple(sorted(doubted))
        self._inquiry.learn(posterior)
        if self._memory is not None:
            for label in doubted:
                self._memory.forget(label)
            audited = len(self._inquiry.audited)
            self._memory.record(self._pose, self._travelled, sightings, self._inquiry.asked, audited)
        return tuple(sightings)

    # ---- what the cameras saw ----------------------------------------------------------------------------------------

    def _collect(self, t: float) -> None:
        """End the running slot: hand its flashes to the inquiry, and refine the lights' positions by them."""
        if self._begun is None:
            return
        begun, self._begun = self._begun, None
        periods = tuple(max(1, round(length / self.config.pattern.period)) for length in self.config.durations_s)
        runs = {}
        for name, camera in self._cameras.items():
            with camera.lock:
                if camera.bursts.places:
                    runs[name] = found = camera.bursts.runs(begun - STAMP_S, t, periods, *camera.strengths())
                    best = np.argmax(found.score, axis=1)
                    for track, column in enumerate(best):
                        if found.score[track, column] > SURE:
                            camera.patches.grow(track, float(found.start[track, column]), periods[column])
                camera.patches.forget()
        known = set(self._lights)
        self._lights += [
            (name, track)
            for name, found in runs.items()
            for track in range(len(found.score))
            if (name, track) not in known
        ]
        scores = np.array([runs[name].score[track] for name, track in self._lights]).reshape(-1, len(periods))
        starts = np.array([runs[name].start[track] for name, track in self._lights]).reshape(-1, len(periods))
        self._inquiry.answer(scores, starts - begun, t)
        if self._memory is None:
            self._posterior = self._inquiry.posterior(Prior(self._candidates.weights), len(self._lights))
            return
        cameras, places = [name for name, _ in self._lights], self._places()
        for _ in range(2):  # the lights that get names tell where exactly the others must be
            prior = self._memory.prior(self._candidates, cameras, places)
            self._posterior = posterior = self._inquiry.posterior(prior, len(self._lights))
            named = np.flatnonzero(posterior.decided(self.config.min_probability))
            if not self._memory.align([cameras[light] for light in named], places[named], posterior.label[named]):
                break

    def _places(self) -> Floats:
        """Pixels (N, 2) of the lights."""
        places = np.zeros((len(self._lights), 2))
        for light, (name, track) in enumerate(self._lights):
            places[light] = self._cameras[name].place(track)
        return places

    def _doubted(self, posterior: Posterior) -> set[str]:
        """Audited labels whose light flashes like another label's when its place does not count."""
        if self._memory is None or not len(self._inquiry.audited):
            return set()
        blind = self._inquiry.posterior(Prior(self._candidates.weights), len(self._lights))
        named = posterior.decided(self.config.min_probability) & np.isin(posterior.label, self._inquiry.audited)
        other = named & (blind.label != posterior.label) & (blind.probability >= 0.9) & (blind.none < 0.05)
        return {self.labels[label] for label in posterior.label[other]}
