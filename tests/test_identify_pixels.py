"""One stop from the requests through the pixels of a made-up room to the names."""

import numpy as np
import pytest

from robotd.identify import Identifier, IdentifyConfig
from robotd.records import Frame
from robotd.vision.blink import FlashPattern

GAMMA = 2.2
SIZE = (120, 160)
EXPOSURE = 0.010
CONFIG = IdentifyConfig()


# ---- one stop --------------------------------------------------------------------------------------------------------


def test_beginning_another_slot_than_the_planned_one_is_refused():
    identifier = Identifier(["A"], ["front"], CONFIG)
    slot = identifier.next_slot(0.0)
    identifier.begin(slot, 0.0)
    with pytest.raises(ValueError, match="slot 0"):
        identifier.begin(slot, 1.0)


def test_repeated_and_reordered_frames_are_passed_over():
    identifier = Identifier(["a"], ["front"], CONFIG)
    slot = identifier.next_slot(0.0)
    identifier.begin(slot, 0.0)
    for t in (0.1, 0.2, 0.2, 0.15, 0.3):
        identifier.update("front", Frame("front", t, np.zeros((120, 160), np.uint8)))
    assert identifier.finish(20.0) == ()


def test_without_labels_or_cameras_nothing_is_asked_or_found():
    assert Identifier([], ["front"], CONFIG).next_slot(0.0) is None
    assert Identifier([], ["front"], CONFIG).finish(0.0) == ()
    identifier = Identifier(["A"], [], CONFIG)
    t = 0.0
    while (slot := identifier.next_slot(t)) is not None:
        identifier.begin(slot, t)
        t += 20.0
    assert identifier.finish(t) == ()


# ---- from requests through pixels to names ---------------------------------------------------------------------------


class LabelSystem:
    """Polled every 3 s, 10 commands a second, lognormal delays (median 1 s, 95 % below 3 s), 2 % lost, clocks off."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.poll = self.rng.uniform(0.0, 3.0)
        self.free = 0.0
        self.runs = {}
        self.lost = 0

    def flash(self, t, requests):
        for request in requests:
            self.free = max(self.free, self.poll + np.ceil((t + request.after - self.poll) / 3.0) * 3.0)
            for label, duration in zip(request.labels, request.durations, strict=True):
                self.free += 0.1
                start = self.free + self.rng.lognormal(0.0, np.log(3.0) / 1.645)
                if self.rng.random() < 0.02:
                    self.lost += 1
                    continue
                runs = self.runs.setdefault(label, [])
                if runs and sum(runs[-1]) > start:
                    runs[-1] = (runs[-1][0], start - runs[-1][0])
                runs.append((start, duration))

    def share(self, label, t):
        x = np.linspace(t, t + EXPOSURE, 7)
        total = 0.0
        for start, duration in self.runs.get(label, ()):
            if start - EXPOSURE < t < start + duration + 1.0:
                since = (x - start) * (1.0 + 0.001 * np.sin(len(label) + ord(label[-1])))
                phase = since % 1.0
                total += np.mean((since >= 0) & (since < duration) & (phase < 0.5) & (phase % 0.2 < 0.1))
        return total


class Room:
    """What one camera sees: lights of labels (some twice, as reflections), noise, sometimes a passer-by."""

    def __init__(self, seed, visible, reflected):
        self.rng = rng = np.random.default_rng(seed)
        height, width = SIZE
        self.wall = 90.0 + 12.0 * np.sin(np.arange(width) / 4.0) * np.cos(np.arange(height)[:, None] / 6.0)
        places = [(u, v) for v in (20, 44, 68, 92) for u in (20, 44, 68, 92, 116, 140)]
        rng.shuffle(places)
        self.lights = []
        for label, (u, v) in zip([*visible, *reflected], places, strict=False):
            u, v = u + rng.uniform(-3, 3), v + rng.uniform(-3, 3)
            box = np.s_[round(v) - 6 : round(v) + 7, round(u) - 6 : round(u) + 7]
            rows, columns = np.mgrid[box]
            bell = np.exp(-0.5 * ((rows - v) ** 2 + (columns - u) ** 2) / 1.1**2)
            grey = self.wall[round(v), round(u)]
            light = ((grey + np.exp(rng.uniform(np.log(9), np.log(250)))) / 255.0) ** GAMMA - (grey / 255.0) ** GAMMA
            self.lights.append((label, u, v, box, bell * light))
        self.noise = rng.normal(0.0, 2.0, (height, 4 * width))

    def frame(self, t, system):
        grey = self.wall.copy()
        for label, _, v, box, light in self.lights:
            share = system.share(label, t + v * 0.03 / SIZE[0])
            if share:
                grey[box] = 255.0 * ((grey[box] / 255.0) ** GAMMA + share * light) ** (1.0 / GAMMA)
        left = int(60.0 * (t % 20.0)) - 20
        if left < SIZE[1]:
            grey[50:, max(left, 0) : max(left + 16, 0)] = 50.0
        shift = int(self.rng.integers(3 * SIZE[1]))
        return np.clip(np.rint(grey + self.noise[:, shift : shift + SIZE[1]]), 0, 255).astype(np.uint8)


def survey_one_stop(seed, labels, cameras=("left", "right"), config=CONFIG):
    rng = np.random.default_rng(seed)
    system = LabelSystem(seed)
    rooms = {}
    for k, camera in enumerate(cameras):
        visible = [str(label) for label in rng.choice(labels, 9, replace=False)]
        rooms[camera] = Room(seed + 10 * k, visible, visible[:1])
    identifier = Identifier(labels, cameras, config)
    offset = rng.uniform(-0.05, 0.05)
    t = 30.0
    lengths = []
    while (slot := identifier.next_slot(t)) is not None:
        system.flash(t, slot.requests)
        identifier.begin(slot, t)
        begun = t
        while t < begun + slot.timeout and not identifier.is_complete(t):
            t += 1 / 30
            taken = t - 0.1
            for camera, room in rooms.items():
                if rng.random() > 0.005:
                    stamp = taken + offset + float(np.clip(rng.normal(0.0, 0.002), -0.01, 0.01))
                    identifier.update(camera, Frame(camera, stamp, room.frame(taken, system)))
        lengths.append(t - begun)
    return identifier.finish(t), rooms, lengths


def test_visible_labels_are_named_and_none_wrongly():
    labels = [f"L{k:02}" for k in range(29)]
    for seed in (1, 2):
        sightings, rooms, lengths = survey_one_stop(seed, labels)
        named = wrong = 0
        residuals = []
        for camera, room in rooms.items():
            for label, u, v, _, _ in room.lights:
                here = [s for s in sightings if s.camera == camera and np.hypot(s.u - u, s.v - v) < 4.0]
                named += [s.label for s in here] == [label]
                wrong += any(s.label != label for s in here)
                residuals += [(s.u - u) / s.sigma_px for s in here] + [(s.v - v) / s.sigma_px for s in here]
                assert all(s.probability >= CONFIG.min_probability for s in here)
            first = room.lights[0][0]
            assert sum(s.camera == camera and s.label == first for s in sightings) <= 2
        assert wrong == 0
        assert named >= 18  # of 20 lights, one pair of rivals per camera among them
        assert len(sightings) <= 20
        assert np.median(np.abs(residuals)) < 1.5
        assert sum(lengths) < 80.0


def test_the_period_of_the_pattern_decides_how_many_bursts_a_duration_has():
    config = IdentifyConfig(pattern=FlashPattern(0.5, [(0.0, 0.1), (0.2, 0.3)]))
    assert config.flash_config().pattern.period == 0.5
    assert Identifier(["A"], ["front"], config).next_slot(0.0) is not None
