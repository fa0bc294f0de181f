"""A label system and cameras without pixels: flashes as events, for thousands of labels and hundreds of stops."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from robotd.geometry.camera import Camera
from robotd.geometry.transforms import (
    invert_rigid,
    pose_matrix,
    rotation_matrix,
    se2_compose,
    transform_points,
    transform_record,
)
from robotd.identify.decoder import Prior
from robotd.identify.delays import DelayModel
from robotd.identify.inquiry import Candidates, Inquiry, requests
from robotd.identify.memory import LabelMemory
from robotd.records import CameraModel, Pose, Sighting

LIT, DARK, STEP = 25.0, -7.0, 7.0  # log-likelihoods of clear flashes, as vision.bursts gives them, per flash and second


@dataclass
class System:
    """Polled every 3 s, 10 commands a second, lognormal delays (median 1 s, 95 % below 3 s), 2 % lost."""

    rng: np.random.Generator
    poll_s: float = 3.0
    commands_per_s: float = 10.0
    median_s: float = 1.0
    p95_s: float = 3.0
    lost: float = 0.02
    free: float = -np.inf

    def __post_init__(self):
        self.phase = self.rng.uniform(0.0, self.poll_s) if self.poll_s else 0.0

    def start(self, t, count):
        """When so many labels begin to flash whose commands were handed over at time t; inf if they do not."""
        fetched = self.phase + np.ceil((t - self.phase) / self.poll_s) * self.poll_s if self.poll_s else t
        sent = max(fetched, self.free) + np.arange(count) / self.commands_per_s
        self.free = sent[-1] + 1.0 / self.commands_per_s
        spread = np.log(self.p95_s / self.median_s) / 1.6448536
        starts = sent + self.median_s * np.exp(spread * self.rng.standard_normal(count))
        return np.where(self.rng.random(count) < self.lost, np.inf, starts)


@dataclass
class Outcome:
    """What one stop came to: lights named rightly, wrongly and not at all, its time, its slots."""

    right: int = 0
    wrong: int = 0
    undecided: int = 0
    unseen: int = 0  # visible labels that were asked and that no camera saw
    unasked: int = 0  # visible labels that there was no time to ask
    seconds: float = 0.0
    slots: list = field(default_factory=list)
    trust: list = field(default_factory=list)  # probability of every light's best name, and whether it is right
    named: dict = field(default_factory=dict)  # label to its light's place (camera, u, v)


def observe(
    visible,
    config,
    system,
    delays,
    rng,
    t,
    *,
    candidates=None,
    places=None,
    prior=None,
    align=None,
    labels=None,
    miss=0.03,
    false=0.01,
):
    """One stop: the labels `visible` (indices) can be seen; returns its Outcome, and the time at its end."""
    total = labels if labels is not None else len(candidates.weights)
    candidates = candidates or Candidates.anything(total)
    inquiry = Inquiry(candidates, config, delays, seed=int(rng.integers(1 << 30)))
    names = range(total)
    durations = np.array(config.durations_s)
    outcome = Outcome()
    light_of = {}
    truth = []
    where = []
    begun_at = t
    posterior = None

    def priors():
        if prior is None or not truth:
            return Prior(candidates.weights)
        return prior(np.array(where))

    def add(label, place):
        truth.append(label)
        where.append(place)
        return len(truth) - 1

    place_of = {int(label): None if places is None else places[k] for k, label in enumerate(visible)}
    while (question := inquiry.next_question(posterior, t)) is not None:
        known = len(truth)
        inquiry.begin(t)
        begun = t
        start = np.full(total, np.inf)
        turn = 0
        for request in requests(question, names, config, delays):
            count = len(request.labels)
            start[question.labels[turn : turn + count]] = system.start(begun + request.after, count)
            turn += count
        length = np.zeros(total, int)
        length[question.labels] = durations[question.symbols]
        events = []  # start, duration, light
        for label in visible:
            if np.isfinite(start[label]) and rng.random() >= miss:
                light = light_of.get(int(label))
                if light is None:
                    light = light_of[int(label)] = add(int(label), place_of[int(label)])
                events.append((start[label] + 0.02 * rng.standard_normal(), length[label], light))
        ends = begun + question.times[-1] + 5.0
        for light in range(known):
            if rng.random() < false:
                events.append((rng.uniform(begun, ends), int(rng.choice(durations)), light))
        for _ in range(rng.poisson(false * len(visible))):
            place = None if places is None else (rng.integers(4), rng.uniform(0, 640), rng.uniform(0, 480))
            events.append((rng.uniform(begun, ends), int(rng.choice(durations)), add(-1, place)))
        seen = np.array([event[0] for event in events] or [np.inf])
        over = seen + np.array([event[1] for event in events] or [0])
        lights = np.array([event[2] for event in events] or [0])
        noticed = seen + np.where(lights < known, 1.3, 2.5)
        limit = begun + inquiry.longest
        t = begun
        while t < limit:
            t += 0.25
            if np.any((noticed <= t) & (over + 1.3 > t)):
                continue
            flashed = np.zeros(len(truth), bool)
            flashed[lights[noticed <= t]] = True
            earliest = float(seen[noticed <= t].min(initial=np.inf))
            latest = float(over[noticed <= t].max(initial=-np.inf))
            if inquiry.is_over(t, earliest, latest, flashed):
                break
        scores = np.tile(DARK * durations.astype(float), (len(truth), 1))
        starts = np.zeros((len(truth), len(durations)))
        for begin, duration, light in rng.permutation(np.array(events or np.zeros((0, 3)))):
            if begin + duration <= t:
                scores[int(light)] = LIT - STEP * np.abs(durations - duration)
                starts[int(light)] = begin - begun
        scores[known:][scores[known:].max(axis=1) < 0.0] = 0.0  # not found yet: nothing is known of them
        inquiry.answer(scores, starts, t)
        for _ in range(2):  # as the Identifier does
            posterior = inquiry.posterior(priors(), len(truth))
            if align is None or not align(np.array(where), posterior):
                break
        outcome.slots.append((len(question.labels), round(t - begun, 1), len(set(question.symbols.tolist()))))
    if posterior is not None:
        inquiry.learn(posterior)
        decided = posterior.decided(config.min_probability)
        for light, label in enumerate(truth):
            outcome.trust.append((float(posterior.probability[light]), posterior.label[light] == label))
            if decided[light]:
                good = posterior.label[light] == label
                outcome.right += int(good)
                outcome.wrong += int(not good)
                outcome.named[int(posterior.label[light])] = where[light]
            elif label >= 0:
                outcome.undecided += 1
        outcome.unseen = sum(bool(inquiry.asked[label]) and int(label) not in light_of for label in visible)
        outcome.unasked = sum(not inquiry.asked[label] for label in visible)
    outcome.seconds = t - begun_at
    outcome.inquiry = inquiry
    outcome.truth = truth
    return outcome, t


def coded_stops(number, seen, config, seeds, stops=1, **system):
    """So many first stops, at which nothing is known of the labels; one Outcome a seed (the last stop's)."""
    outcomes = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        made = System(rng, **system)
        delays = DelayModel(config)
        t = 100.0 + rng.uniform(0, 3)
        for _ in range(stops):
            visible = rng.choice(number, min(seen, number), replace=False)
            outcome, t = observe(visible, config, made, delays, rng, t, labels=number)
            t += 5.0
        outcomes.append(outcome)
    return outcomes


def summary(outcomes):
    """Fractions of lights and median and 95th percentile of time."""
    lights = sum(o.right + o.wrong + o.undecided for o in outcomes)
    return {
        "wrong %": 100.0 * sum(o.wrong for o in outcomes) / max(1, lights),
        "undecided %": 100.0 * sum(o.undecided for o in outcomes) / max(1, lights),
        "unseen %": 100.0 * sum(o.unseen for o in outcomes) / max(1, lights),
        "unasked %": 100.0 * sum(o.unasked for o in outcomes) / max(1, lights),
        "s median": float(np.median([o.seconds for o in outcomes])),
        "s 95 %": float(np.quantile([o.seconds for o in outcomes], 0.95)),
        "s max": max(o.seconds for o in outcomes),
        "slots": float(np.mean([len(o.slots) for o in outcomes])),
    }


# ---- a store: labels on both sides of an aisle, a robot with four cameras and odometry that drifts -------------------


def rig():
    """Four cameras of 640x480 and 100 degrees, outward, half a metre high."""
    front = rotation_matrix((-1.2092, 1.2092, -1.2092))
    cameras = []
    for name, turn in (("front", 0.0), ("left", 0.5 * np.pi), ("rear", np.pi), ("right", -0.5 * np.pi)):
        matrix = np.eye(4)
        turned = rotation_matrix((0.0, 0.0, turn))
        matrix[:3, :3] = turned @ front
        matrix[:3, 3] = turned @ (0.06, 0.0, 0.0) + (0.0, 0.0, 0.5)
        cameras.append(CameraModel(name, (640, 480), (268.5, 268.5, 319.5, 239.5), transform_record(matrix)))
    return tuple(cameras)


@dataclass
class Survey:
    """What became of a simulated store."""

    seconds: float = 0.0
    right: int = 0
    wrong: int = 0
    undecided: int = 0
    per_stop: list = field(default_factory=list)
    visible: set = field(default_factory=set)  # labels that some stop could see
    slots: list = field(default_factory=list)
    seen_at: dict = field(default_factory=dict)  # label to the number of stops that named it rightly


def store(seed, config, number=1000, stops=100, step=0.75, given=0, back=0, **system):
    """A mission along an aisle of `stops * step` metres with `number` labels, and `back` stops back.

    At the first `given` stops nothing is asked: all that is visible there is known without it.
    """
    rng = np.random.default_rng(seed)
    cameras = rig()
    names = [camera.name for camera in cameras]
    views = [Camera(camera) for camera in cameras]
    length = stops * step
    labels = np.column_stack(
        [
            rng.uniform(-1.0, length + 0.5, number),
            rng.choice([-1.0, 1.0], number) * rng.uniform(1.0, 1.4, number),
            rng.choice([0.25, 0.6, 0.95, 1.3, 1.65], number),
        ]
    )
    ids = [f"L{k}" for k in range(number)]
    memory = LabelMemory(ids, cameras, config)
    made, delays = System(rng, **system), DelayModel(config)
    true, odometry, travelled, t = np.zeros(3), np.zeros(3), 0.0, 50.0
    survey = Survey()
    for stop in range(stops + back):
        if stop:
            along = step if stop < stops else -step
            move = np.array([along, 0.0, -true[2] + 0.01 * rng.standard_normal()])
            true = se2_compose(true, move)
            noise = rng.standard_normal(3) * (0.004, 0.006, 0.018) * np.sqrt(step)
            odometry = se2_compose(odometry, move + noise)
            travelled += step
            t += step / 0.22 + 3.0
        pose = Pose(*map(float, odometry))
        tilt = 0.005 * rng.standard_normal(2)
        T_robot_world = invert_rigid(pose_matrix(*true, *tilt))
        away = labels - (*true[:2], 0.5)
        near = np.hypot(away[:, 0], away[:, 1])
        faces = np.abs(away[:, 1]) > near * np.cos(np.radians(65.0))
        shown, places = [], []
        for label in np.flatnonzero((near < 2.9) & faces & (rng.random(number) > 0.1)):
            for camera, view in enumerate(views):
                point = transform_points(invert_rigid(view.T_robot_camera) @ T_robot_world, labels[label : label + 1])
                pixel, valid = view.project(point)
                if valid[0] and view.in_image(pixel, 4.0)[0]:
                    shown.append(label)
                    places.append((camera, *(pixel[0] + 0.1 * rng.standard_normal(2))))
                    break
        survey.visible.update(map(int, shown))
        candidates = memory.candidates(pose, travelled, names)
        if stop < given:
            sightings = [Sighting(names[c], ids[k], u, v) for k, (c, u, v) in zip(shown, places, strict=True)]
            memory.record(pose, travelled, sightings, np.isin(np.arange(number), shown), number)
            continue

        def prior(where, candidates=candidates):
            return memory.prior(candidates, [names[int(k)] for k in where[:, 0]], where[:, 1:])

        def align(where, posterior):
            named = np.flatnonzero(posterior.decided(config.min_probability))
            cameras = [names[int(where[k, 0])] for k in named]
            return memory.align(cameras, where[named, 1:], posterior.label[named])

        outcome, t = observe(
            shown, config, made, delays, rng, t, candidates=candidates, places=places, prior=prior, align=align
        )
        sightings = [Sighting(names[int(c)], ids[label], u, v) for label, (c, u, v) in outcome.named.items()]
        audited = len(outcome.inquiry.audited)
        memory.record(pose, travelled, sightings, outcome.inquiry.asked, audited)
        survey.right += outcome.right
        survey.wrong += outcome.wrong
        survey.undecided += outcome.undecided
        survey.per_stop.append(outcome.seconds)
        survey.slots.append(outcome.slots)
        for label in set(map(int, shown)) & set(outcome.named):
            survey.seen_at[label] = survey.seen_at.get(label, 0) + 1
    survey.seconds = t - 50.0
    return survey
