"""The camera: frames of a scene, with shake, lamps that flicker, shot and read noise, grey levels, JPEG."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from .scenes import Light, Scene, stamps
from .world import MARGIN, Singles

_STEPS = 1 << 15  # of linear light up to twice white
Grey = NDArray[np.uint8]


def frames(scene: Scene) -> tuple[Iterator[Grey], NDArray[np.float64]]:
    """The film as an iterator of (H, W) uint8 frames, and their stamps in seconds."""
    true, measured = stamps(scene)
    return _expose(scene, true), measured


def _expose(scene: Scene, times: NDArray[np.float64]) -> Iterator[Grey]:
    options = scene.options
    rng = np.random.default_rng([scene.number, int(1e6 * scene.noise), 1])
    width, height = options.size
    bank = rng.standard_normal((height, 3 * width), dtype=np.float32)
    level = np.linspace(0.0, 2.0, _STEPS)
    grey_of = (255.0 * level ** (1.0 / options.gamma)).astype(np.float32)
    sigma_of = np.sqrt(scene.noise**2 + 0.015 * np.minimum(grey_of, 255.0)).astype(np.float32)
    bumps = _bumps(rng, times) if scene.shaken else np.zeros((len(times), 2))
    flicker = 0.35 * np.sinc(2.0 * scene.mains_hz * scene.exposure)
    still = scene.wall[MARGIN:-MARGIN, MARGIN:-MARGIN]
    lights = (*scene.labels, *scene.mirrored, *scene.distractors)
    picture = np.zeros(1, np.float32)
    for k, t in enumerate(times):
        shift = bumps[k]
        if shift.any():
            move = np.array([[1.0, 0.0, shift[0] - MARGIN], [0.0, 1.0, shift[1] - MARGIN]])
            light = cv2.warpAffine(scene.wall, move, (width, height), flags=cv2.INTER_LANCZOS4)
            share = scene.lamps[MARGIN:-MARGIN, MARGIN:-MARGIN]
        else:
            light, share = still.copy(), scene.lamps[MARGIN:-MARGIN, MARGIN:-MARGIN]
        if scene.screen is not None:
            row, column, tall, wide = scene.screen
            phase = int(t * 3.1)
            light[row : row + tall, column : column + wide] = 0.05 + 0.25 * ((phase * 7919) % 101) / 101.0
        for lamp in lights:
            add(light, lamp, shift, lamp.share(float(t), scene.exposure))
        for person in scene.walkers:
            person.paint(light, float(t), 1.0)
        if abs(flicker) > 1e-4:
            wave = np.cos(2.0 * np.pi * 2.0 * scene.mains_hz * (t + scene.exposure / 2.0))
            light *= 1.0 + np.float32(flicker * wave) * share
        np.multiply(np.clip(light, 0.0, 1.999), 0.5 * (_STEPS - 1), out=light)
        index = (light + 0.5).astype(np.uint16)
        picture = grey_of.take(index)
        offset = int(rng.integers(2 * width))
        picture += sigma_of.take(index) * bank[:, offset : offset + width][:: 1 if k % 2 else -1]
        frame = np.clip(picture + 0.5, 0.0, 255.0).astype(np.uint8)
        if options.jpeg is not None:
            _, coded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, options.jpeg])
            frame = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
        yield frame


def add(light: Singles, lamp: Light, shift: NDArray[np.float64], share: float) -> None:
    """Add a light's spot, a Gaussian integrated over the pixels."""
    if share <= 0.0:
        return
    u, v = lamp.u + shift[0], lamp.v + shift[1]
    reach = int(5.0 * lamp.width) + 1
    first_u, first_v = max(0, int(u) - reach), max(0, int(v) - reach)
    last_u, last_v = min(light.shape[1], int(u) + reach + 1), min(light.shape[0], int(v) + reach + 1)
    if first_u >= last_u or first_v >= last_v:
        return
    profiles = []
    for first, last, centre in ((first_v, last_v, v), (first_u, last_u, u)):
        edges = np.arange(first, last + 1) - 0.5 - centre
        profiles.append(np.diff(_normal(edges / lamp.width)) * lamp.width * np.sqrt(2.0 * np.pi))
    light[first_v:last_v, first_u:last_u] += (lamp.gain * share * np.outer(*profiles)).astype(np.float32)


def _normal(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normal distribution function, by Abramowitz and Stegun 7.1.26 to 1.5e-7."""
    z = np.abs(x) / np.sqrt(2.0)
    k = 1.0 / (1.0 + 0.3275911 * z)
    terms = k * (0.254829592 + k * (-0.284496736 + k * (1.421413741 + k * (-1.453152027 + k * 1.061405429))))
    erf = 1.0 - terms * np.exp(-z * z)
    return np.asarray(0.5 * (1.0 + np.sign(x) * erf))


def _bumps(rng: np.random.Generator, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift of the picture in px at every frame: a tremor, and a bump every few seconds that rings down."""
    t = times - times[0]
    tremor = [
        0.08 * np.sin(2.0 * np.pi * hertz * t + rng.uniform(0.0, 6.28))[:, None] * rng.normal(size=2)
        for hertz in rng.uniform(0.3, 9.0, 4)
    ]
    shift = np.sum(tremor, axis=0)
    for begin in np.cumsum(rng.exponential(4.0, 6)):
        after = np.maximum(t - begin, 0.0)
        ring = (t > begin) * np.exp(-after / 0.25) * np.sin(2.0 * np.pi * rng.uniform(4.0, 9.0) * after)
        shift = shift + rng.normal(0.0, 1.2, 2) * ring[:, None]
    return np.asarray(np.clip(shift, -MARGIN + 3, MARGIN - 3))
