"""What lamps and camera do to a scene: shadows, glare, vignetting; blur, noise, JPEG, a tilt, and its top view."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from robotd.vision.polyline import directions, resample

from .floors import Generator, Single, fractal, turned
from .paths import Floats, TrueLine

Bytes = NDArray[np.uint8]
Light = Callable[[Generator, Single, int, float], Single]  # of an image at s samples a pixel, and the line's width


def even(rng: Generator, image: Single, s: int, w: float) -> Single:
    return image


def gradient(rng: Generator, image: Single, s: int, w: float) -> Single:
    """From one side to the other the light falls to a third."""
    x, _ = turned(rng, image.shape, s)
    x -= x.min()
    return np.asarray(image * (1.0 - rng.uniform(0.3, 0.68) * x / x.max()), dtype=np.float32)


def vignetting(rng: Generator, image: Single, s: int, w: float) -> Single:
    v, u = np.ogrid[-1.0 : 1.0 : 1j * image.shape[0], -1.0 : 1.0 : 1j * image.shape[1]]
    return np.asarray(image * (1.0 - rng.uniform(0.3, 0.6) * 0.5 * (u * u + v * v)), dtype=np.float32)


def hard_shadow(rng: Generator, image: Single, s: int, w: float) -> Single:
    """The straight edge of something large: a shelf, a wall."""
    return _shadow(rng, image, s, 0.6)


def soft_shadow(rng: Generator, image: Single, s: int, w: float) -> Single:
    """The same with a penumbra of 6 to 40 pixels."""
    return _shadow(rng, image, s, rng.uniform(6.0, 40.0))


def _shadow(rng: Generator, image: Single, s: int, edge: float) -> Single:
    x, _ = turned(rng, image.shape, s, rng.uniform(0.0, 2.0 * math.pi))
    at = float(x.min() + rng.uniform(0.25, 0.75) * (x.max() - x.min()))
    dark = np.clip((x - at) / edge + 0.5, 0.0, 1.0)
    return np.asarray(image * (1.0 - rng.uniform(0.35, 0.65) * dark), dtype=np.float32)


def shadow_stripes(rng: Generator, image: Single, s: int, w: float) -> Single:
    """Legs of tables and chairs: thin shadows, narrower than the line or wider, none of its width."""
    for _ in range(rng.integers(1, 4)):
        x, _ = turned(rng, image.shape, s, rng.uniform(0.0, math.pi))
        at = float(x.min() + rng.uniform(0.2, 0.8) * (x.max() - x.min()))
        wide = w * (rng.uniform(0.2, 0.5) if rng.random() < 0.5 else rng.uniform(2.0, 3.0))
        dark = np.clip((0.5 * wide - np.abs(x - at)) / rng.uniform(1.0, 4.0) + 0.5, 0.0, 1.0)
        image = np.asarray(image * (1.0 - rng.uniform(0.25, 0.5) * dark), dtype=np.float32)
    return image


def glare(rng: Generator, image: Single, s: int, w: float) -> Single:
    """One to three lamps mirrored in floor and tape: spots, many of them saturated."""
    v, u = np.ogrid[0 : image.shape[0], 0 : image.shape[1]]
    image = image.copy()
    for _ in range(rng.integers(1, 4)):
        at = rng.uniform((0.1, 0.1), (0.9, 0.9)) * image.shape
        reach = rng.uniform(0.04, 0.14) * min(image.shape)
        far = ((v - at[0]) ** 2 + (u - at[1]) ** 2) / reach**2
        image += (rng.uniform(60.0, 180.0) * np.exp(-far)).astype(np.float32)
    return image


def lamps(rng: Generator, image: Single, s: int, w: float) -> Single:
    """Fluorescent tubes mirrored in a glossy floor: long blurred bars, broken by the floor's unevenness."""
    _, y = turned(rng, image.shape, s)
    bend = 5.0 * fractal(rng, image.shape, 60.0 * s, octaves=3)
    wide, pitch = rng.uniform(2.2, 4.0) * w, rng.uniform(9.0, 14.0) * w
    inside = 0.5 * wide - np.abs((y + bend) % pitch - 0.5 * pitch)
    bar = np.clip(inside / rng.uniform(3.0, 12.0) + 0.5, 0.0, 1.0)
    return np.asarray(image + rng.uniform(25.0, 75.0) * bar, dtype=np.float32)


LIGHTS: dict[str, Light] = {
    light.__name__: light
    for light in (even, gradient, vignetting, hard_shadow, soft_shadow, shadow_stripes, glare, lamps)
}


def exposed(rng: Generator, image: Single, s: int, *, blur: float, motion: float, noise: float) -> Bytes:
    """The camera's picture: optics' and motion's blur (pixels, centred), pixels, noise (grey levels), 8 bits."""
    if motion > 0.0:
        image = cv2.filter2D(image, -1, _streak(rng, motion * s), borderType=cv2.BORDER_REPLICATE)
    if blur * s > 0.3:
        image = cv2.GaussianBlur(image, (0, 0), blur * s, borderType=cv2.BORDER_REPLICATE)
    pixels = cv2.resize(image, (image.shape[1] // s, image.shape[0] // s), interpolation=cv2.INTER_AREA)
    shot = np.sqrt(np.clip(pixels, 0.0, 255.0) / 128.0, dtype=np.float32)
    pixels = pixels + np.float32(noise) * shot * rng.standard_normal(pixels.shape, dtype=np.float32)
    return np.clip(np.rint(pixels), 0.0, 255.0).astype(np.uint8)


def _streak(rng: Generator, length: float) -> Single:
    """A kernel that smears along a random direction; its centre of mass is its middle."""
    half = max(math.ceil(0.5 * length), 1)
    angle = rng.uniform(0.0, math.pi)
    along = np.linspace(-0.5 * length, 0.5 * length, 16 * half + 1)
    kernel = np.zeros((2 * half + 3, 2 * half + 3), np.float32)
    u, v = along * math.cos(angle) + half + 1, along * math.sin(angle) + half + 1
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = np.abs(1 - di - (v - i)) * np.abs(1 - dj - (u - j))
        np.add.at(kernel, (i + di, j + dj), weight.astype(np.float32))
    return kernel / kernel.sum()


def compressed(image: Bytes, quality: int) -> Bytes:
    """Through JPEG and back."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _quad(*corners: tuple[float, float]) -> Single:
    return np.array(corners, dtype=np.float32)


def stretched(rng: Generator, image: Single, s: int, *, noise: float) -> tuple[Bytes, NDArray[np.bool_]]:
    """The top view of what a tilted camera would see of this floor, and where it sees it.

    The floor is projected into a camera image, whose pixels get blur and noise, and mapped back: far rows, at the top,
    come from few pixels, and the far corners beside the view are in sight while the near ones are not.
    """
    rows, columns = image.shape[0] // s, image.shape[1] // s
    near, far = rng.uniform(0.55, 0.8) * columns, rng.uniform(1.05, 1.3) * columns
    mid = 0.5 * (columns - 1)
    floor = _quad((mid - far / 2, 0), (mid + far / 2, 0), (mid + near / 2, rows - 1), (mid - near / 2, rows - 1))
    wide, high = round(1.1 * near), round(0.75 * near)
    camera = _quad((0, 0), (wide - 1, 0), (wide - 1, high - 1), (0, high - 1))
    down = cv2.getPerspectiveTransform(floor, camera)
    from_samples = down @ np.array([[1 / s, 0, 0.5 / s - 0.5], [0, 1 / s, 0.5 / s - 0.5], [0, 0, 1]])
    fine = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]]) @ from_samples
    # because one sample in 2 x 2 camera pixels would alias where the floor is far
    soft = cv2.GaussianBlur(image, (0, 0), 0.35 * s)
    taken = cv2.warpPerspective(soft, fine, (2 * wide, 2 * high), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    frame = exposed(rng, np.asarray(taken, dtype=np.float32), 2, blur=0.6, motion=0.0, noise=noise)
    view = cv2.warpPerspective(frame, np.linalg.inv(down), (columns, rows), flags=cv2.INTER_LINEAR)
    seen = cv2.warpPerspective(np.full(frame.shape, 255, np.uint8), np.linalg.inv(down), (columns, rows))
    return np.asarray(view, dtype=np.uint8), np.asarray(seen == 255)


def tapered(image: Single, lines: tuple[TrueLine, ...], taper: float, s: int) -> tuple[Single, tuple[TrueLine, ...]]:
    """What a tilted camera sees: the lower part is magnified, and a line's one width is the median along it."""
    rows, columns = image.shape[0] / s, image.shape[1] / s
    inset = 0.5 * (1.0 - taper) * columns
    corners = _quad((0, 0), (columns, 0), (columns - inset, rows), (inset, rows)) - np.float32(0.5)
    frame = _quad((0, 0), (columns, 0), (columns, rows), (0, rows)) - np.float32(0.5)
    H = cv2.getPerspectiveTransform(corners, frame)
    samples = np.array([[s, 0.0, 0.5 * s - 0.5], [0.0, s, 0.5 * s - 0.5], [0.0, 0.0, 1.0]])
    warped = cv2.warpPerspective(image, samples @ H @ np.linalg.inv(samples), image.shape[::-1])

    def seen(points: Floats) -> Floats:
        homogeneous = np.column_stack([points, np.ones(len(points))]) @ H.T
        return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])

    size = np.array([columns, rows])
    seen_lines, sides = [], []
    for line in lines:
        points = resample(line.points, 1.0)
        points = points[(np.abs(points - 0.5 * size) < size).all(axis=1)]  # because beyond the horizon nothing is seen
        if len(points) > 1:
            along = directions(points)
            half = 0.5 * line.width * np.column_stack([-along[:, 1], along[:, 0]])
            inside = ((seen(points) > 0.0) & (seen(points) < size)).all(axis=1)
            sides.append(np.hypot(*(seen(points + half) - seen(points - half))[inside].T))
            seen_lines.append(replace(line, points=seen(points)))
    width = float(np.median(np.concatenate(sides))) if sides else 0.0
    return np.asarray(warped, dtype=np.float32), tuple(replace(line, width=width) for line in seen_lines)
