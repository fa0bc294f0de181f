"""Passers-by: people who walk along their path and back, as pictures that turn towards whoever looks.

A person is drawn once in every phase of a step, from the front, from aslant and from the side; frames only choose
among these pictures (`robotd.sim.sensor.paint_walkers`), in front of what is farther away.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .sensor import BLOCK
from .stores import Walker

PHASES = 12
VIEWS = (0.15, 0.6, 1.0)  # how far limbs swing across the picture: from the front, aslant, from the side
SPRITE = (192, 96)  # texels of a picture, height and width
STRIDE = 0.8  # of the person's height, for two steps
WIDTH = 0.5  # of the height: what the picture spans


@dataclass(frozen=True, slots=True, eq=False)
class Crowd:
    """Everybody who walks in a store.

    Attributes
    ----------
    walkers : tuple of Walker
    sprites : (N,) uint8 array
        Coverage and reflectance of all pictures, interleaved, level after level of their pyramids.
    levels : (3, 4) int64 array
        First texel, height, width, and pictures per person, of each level.
    cover : (N / 32,) uint8 array
        Greatest coverage in every `BLOCK` by `BLOCK` texels of all pictures and the texels that follow, in the same
        order: where it is 0 there is nothing to blend.
    """

    walkers: tuple[Walker, ...]
    sprites: NDArray[np.uint8]
    levels: NDArray[np.int64]
    cover: NDArray[np.uint8]

    def at(self, t: float) -> Floats:
        """Where everybody is at time `t`, in seconds.

        Returns
        -------
        (K, 9) array
            x, y in metres, velocity in m/s, height, 0 (for their light), phase of the step, person, half the picture's
            width.
        """
        rows = []
        for k, walker in enumerate(self.walkers):
            x, y, vx, vy, travelled = along_path(walker, t)
            phase = int(travelled / (STRIDE * walker.height) * PHASES) % PHASES
            half = 0.5 * WIDTH * walker.height * walker.radius / 0.2
            rows.append((x, y, vx, vy, walker.height, 0.0, phase, k, half))
        return np.array(rows, dtype=np.float64)


def along_path(walker: Walker, t: float) -> tuple[float, float, float, float, float]:
    """x, y, velocity and metres travelled at time `t` of one who walks to the end of the path and back for ever."""
    path = walker.path
    lengths = [math.dist(a, b) for a, b in itertools.pairwise(path)]
    total = sum(lengths)
    if total <= 0.0:
        return path[0][0], path[0][1], 0.0, 0.0, 0.0
    travelled = walker.speed * t
    ahead = travelled % (2.0 * total)
    sign = 1.0
    if ahead > total:
        ahead, sign = 2.0 * total - ahead, -1.0
    for index, length in enumerate(lengths):
        if length > 0.0 and (ahead <= length or index == len(lengths) - 1):
            break
        ahead -= length
    (x0, y0), (x1, y1) = path[index], path[index + 1]
    dx, dy = (x1 - x0) / length, (y1 - y0) / length
    speed = sign * walker.speed
    return x0 + ahead * dx, y0 + ahead * dy, speed * dx, speed * dy, travelled


def make_crowd(walkers: tuple[Walker, ...], rng: np.random.Generator) -> Crowd:
    """Draw everybody in all phases and views; a person of zero speed stands."""
    count = PHASES * len(VIEWS)
    pictures = np.empty((len(walkers) * count, *SPRITE, 2), np.uint8)
    for k in range(len(walkers)):
        clothes = rng.uniform(0.05, 0.6, 4)
        pattern = (
            rng.random((24, 1)).astype(np.float32) if rng.random() < 0.5 else rng.random((1, 12), dtype=np.float32)
        )
        for phase in range(PHASES):
            for view, swing in enumerate(VIEWS):
                pictures[k * count + phase * len(VIEWS) + view] = _person(
                    2.0 * math.pi * phase / PHASES, swing, clothes, pattern
                )
    buffers, covers, levels, first = [], [], [], 0
    for scale in (1, 2, 4):
        h, w = SPRITE[0] // scale, SPRITE[1] // scale
        shrunk = pictures.reshape(len(pictures), h, scale, w, scale, 2).mean(axis=(2, 4)).round().astype(np.uint8)
        buffers.append(shrunk.ravel())
        covers.append(_cover(shrunk[..., 0]).ravel())
        levels.append((first, h, w, count))
        first += len(pictures) * h * w
    # never empty, so that they have an address
    sprites, cover = (np.concatenate([*parts, np.zeros(2, np.uint8)]) for parts in (buffers, covers))
    return Crowd(walkers, sprites, np.array(levels, np.int64), cover)


def _cover(coverage: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Maximum (P, H / BLOCK, W / BLOCK) of every block and of the row and the column that follow it."""
    pictures, h, w = coverage.shape
    padded = np.pad(coverage, ((0, 0), (0, 1), (0, 1)))
    for axis in (1, 2):
        ahead = np.take(padded, np.arange(1, padded.shape[axis]), axis)
        padded = np.maximum(np.take(padded, np.arange(padded.shape[axis] - 1), axis), ahead)
    return np.asarray(padded.reshape(pictures, h // BLOCK, BLOCK, w // BLOCK, BLOCK).max(axis=(2, 4)))


def _person(phase: float, swing: float, clothes: Floats, pattern: NDArray[np.float32]) -> NDArray[np.uint8]:
    """One picture, (*SPRITE, 2): coverage and reflectance. Lengths below are shares of the height."""
    rows, columns = 2 * SPRITE[0], 2 * SPRITE[1]  # drawn twice as large, then shrunk, for soft edges
    coverage = np.zeros((rows, columns), np.float32)
    tone = np.zeros((rows, columns), np.float32)

    def capsules(points: list[tuple[float, float]], width: float, reflectance: float, *, striped: bool = False) -> None:
        mask = np.zeros((rows, columns), np.uint8)
        pixels = [(round((0.5 + x / WIDTH) * columns), round((1.0 - z) * rows)) for x, z in points]
        for a, b in itertools.pairwise(pixels):
            cv2.line(mask, a, b, 255, max(1, round(width * rows)), cv2.LINE_AA)
        share = mask.astype(np.float32) / 255.0
        # a blurred outline shades the limb as if it were round, brighter towards the upper left
        small = cv2.resize(share, (columns // 4, rows // 4), interpolation=cv2.INTER_AREA)
        round_ = cv2.resize(cv2.GaussianBlur(small, (0, 0), width * rows * 0.1), (columns, rows))
        shade = 0.35 + 0.65 * np.clip(round_ + 0.4 * (np.roll(round_, 3, 1) - np.roll(round_, -3, 1)), 0.0, 1.0)
        paint = np.full_like(tone, reflectance)
        if striped:
            paint *= 0.5 + cv2.resize(pattern, (columns, rows), interpolation=cv2.INTER_NEAREST)
        tone[:] = tone * (1.0 - share) + paint * shade * share
        coverage[:] = np.maximum(coverage, share)

    def arm(side: float, angle: float) -> None:
        shoulder = (side * (apart * 2.2), 0.80 + bob)
        elbow = (shoulder[0] + 0.03 * side * (1.0 - swing) + swing * 0.17 * math.sin(angle), 0.64 + bob)
        hand = (elbow[0] + swing * 0.16 * math.sin(angle + 0.4), 0.50 + bob)
        capsules([shoulder, elbow], 0.05, 0.8 * shirt)
        capsules([elbow, hand], 0.04, skin)

    shirt, trousers, skin, hair = clothes[0], clothes[1] * 0.5, 0.35 + 0.3 * clothes[2], clothes[3] * 0.4
    bob = 0.01 * math.cos(2.0 * phase)
    apart = 0.05 * (1.0 - swing)
    for side, beat in ((-1.0, math.pi), (1.0, 0.0)):  # the far side first
        angle = 0.45 * math.sin(phase + beat)
        lift = 0.06 * max(0.0, math.cos(phase + beat))
        hip = (side * apart, 0.50 + bob)
        knee = (hip[0] + swing * 0.25 * math.sin(angle), 0.27 + bob + lift * 0.5)
        foot = (hip[0] + swing * 0.25 * (math.sin(angle) + math.sin(angle - 4.0 * lift)), 0.035 + lift)
        capsules([hip, knee, foot], 0.075, trousers)
        capsules([foot, (foot[0] + 0.07 * swing, foot[1])], 0.05, 0.06)
        if side < 0.0:
            arm(side, -angle)
    capsules([(0.0, 0.54 + bob), (0.0, 0.76 + bob)], 0.13 + 0.09 * (1.0 - swing), shirt, striped=True)
    arm(1.0, -0.45 * math.sin(phase))
    capsules([(0.0, 0.84 + bob), (0.01 * swing, 0.91 + bob)], 0.05, skin)
    capsules([(0.0, 0.905 + bob), (0.01 * swing, 0.93 + bob)], 0.10, skin)
    capsules([(-0.015 * swing, 0.955 + bob), (0.0, 0.96 + bob)], 0.08, hair)
    picture = np.stack([coverage, np.clip(tone, 0.0, 1.0)], axis=-1)
    picture[..., 1] = np.where(coverage > 0.0, picture[..., 1] / np.maximum(coverage, 1e-3), 0.0)
    small = cv2.resize(np.clip(picture, 0.0, 1.0), SPRITE[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(np.rint(255.0 * small), dtype=np.uint8)
