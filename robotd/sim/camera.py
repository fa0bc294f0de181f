"""A camera of the rig: lens, rolling shutter, gamma, noise. Renders full frames of a `Scene`.

What stands still is ray-cast once per pose, blurred in linear light and encoded; a frame then is that picture with
fresh noise, and where people or lights are, the same done again with them in it. Grey level = 255 light^(1/gamma).
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..bind import ranged
from ..geometry.transforms import transform_matrix
from ..records import CameraModel, Floats
from .scene import LED_SIGMA, NOISE_BANK, Scene
from .sensor import DN_STEPS, SIGMA_STEPS, TILE, UNITY, reach

try:
    from ._sensor import add_lights, expose, paint_walkers, retouch, shine, trace, transmission
except ImportError:
    from .sensor import add_lights, expose, paint_walkers, retouch, shine, trace, transmission

Lit = Callable[[Floats, Floats], Floats]

BASE_EXPOSURE = 0.010  # s, at which radiance 1 clips
BRIGHTEST = 1.5  # radiance at which the tables end: 306 grey levels, above which noise never shows
TABLE = 1 << 15
PATCH = 32  # most rows and columns of a light's picture
REACH = 5.0  # standard deviations to which a light's picture extends
_NO_LIGHT: Floats = np.zeros(0)


@dataclass(frozen=True, slots=True)
class SensorSettings:
    """[world.sensor]: the rig cameras' sensors."""

    gamma: float = ranged(2.2, minimum=0.5, maximum=4.0, doc="grey level = 255 (light)^(1/gamma)")
    read_noise: float = ranged(1.4, minimum=0.0, maximum=5.0, doc="grey levels, one sigma")
    shot_noise: float = ranged(0.018, minimum=0.0, maximum=0.14, doc="variance in grey levels per grey level")
    blur: float = ranged(1.0, minimum=0.3, maximum=3.0, doc="optical blur, one sigma in pixels")
    readout: float = ranged(0.030, minimum=0.0, maximum=0.2, doc="rolling shutter: s from the first row to the last")
    lamp_share: float = ranged(0.65, minimum=0.0, maximum=1.0, doc="of the light that comes from lamps and flickers")


@functools.lru_cache(maxsize=8)
def undistorted_grid(camera: CameraModel) -> NDArray[np.float32]:
    """x/z, y/z (H + 1, W + 1, 2), read-only, of all pixels' corners, by Newton's method on the lens model to 1e-10.

    Raises
    ------
    ValueError
        The lens model cannot be inverted somewhere in the image.
    """
    width, height = camera.size
    fx, fy, cx, cy = camera.matrix
    u, v = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    wanted = np.stack([(u - cx) / fx, (v - cy) / fy], axis=-1).reshape(-1, 2)
    xy = wanted.copy()
    if camera.model == "fisheye":
        radius = np.linalg.norm(wanted, axis=1, keepdims=True)
        xy *= np.tan(np.minimum(radius, 1.45)) / np.maximum(radius, 1e-12)
    open_ = np.arange(len(xy))
    for _ in range(50):
        at = xy[open_]
        error = distort(camera, at) - wanted[open_]
        jx, jy = ((distort(camera, at + step) - distort(camera, at - step)) / 2e-6 for step in 1e-6 * np.eye(2))
        determinant = jx[:, 0] * jy[:, 1] - jx[:, 1] * jy[:, 0]
        if (determinant <= 1e-6).any():
            break
        xy[open_, 0] -= (jy[:, 1] * error[:, 0] - jy[:, 0] * error[:, 1]) / determinant
        xy[open_, 1] -= (jx[:, 0] * error[:, 1] - jx[:, 1] * error[:, 0]) / determinant
        open_ = open_[np.abs(error).max(axis=1) > 1e-10]
        if not len(open_):
            grid = xy.reshape(height + 1, width + 1, 2).astype(np.float32)
            grid.flags.writeable = False
            return grid
    raise ValueError(f"camera {camera.name}: its lens model {camera.distortion} folds over inside the image")


def distort(camera: CameraModel, xy: Floats) -> Floats:
    """Distorted (N, 2) of ideal x/z, y/z (N, 2), by OpenCV's equations for both lens models."""
    k = np.zeros(8)
    k[: len(camera.distortion)] = camera.distortion
    x, y = xy[:, 0], xy[:, 1]
    if camera.model == "fisheye":
        radius = np.hypot(x, y)
        angle = np.arctan(radius)
        bent = angle * (1.0 + angle**2 * (k[0] + angle**2 * (k[1] + angle**2 * (k[2] + angle**2 * k[3]))))
        return np.asarray(xy * np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)[:, None])
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    return np.column_stack(
        [
            x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
            y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y,
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Spots:
    """The N lights that the camera sees from its present pose, directly or in glass.

    Light comes along legs: the first N
    lead from the eye to the lights or to the glass, the others from the glass to the lights.
    """

    delays: Floats  # (K, L) of the rows at which the labels are looked at, in seconds
    pick: NDArray[np.int64]  # where in these each spot's first and last row are, -1 for a blinker
    blink: Floats
    peak: Floats  # radiance when on for the whole base exposure
    boxes: NDArray[np.int32]
    across: NDArray[np.float32]
    down: NDArray[np.float32]
    ends: Floats  # first and last row of the box
    strength: Floats  # (2, N) scratch: radiance in those rows
    leg_from: Floats
    leg_to: Floats
    leg_of: NDArray[np.int64]
    leg_delays: Floats


class RigRenderer:
    """Renders one camera. One frame at a time: `render` waits for its turn when several threads call it.

    Parameters
    ----------
    scene : Scene
    camera : CameraModel
        As it truly is.
    settings : SensorSettings
    seed : int
        Of the noise, together with the seed of each frame.
    """

    def __init__(self, scene: Scene, camera: CameraModel, settings: SensorSettings, seed: int) -> None:
        width, height = camera.size
        if width > 4096:
            raise ValueError(f"camera {camera.name}: {width} columns; the noise bank serves at most 4096")
        self.scene = scene
        self.camera = camera
        self.settings = settings
        self._seed = seed
        self._T_robot_camera = transform_matrix(camera.T_robot_camera)
        self._rays = undistorted_grid(camera)
        self._row_time = settings.readout / height
        self._still = np.zeros((height, width), np.float32)
        self._linear = np.zeros((height, width), np.float32)
        self._depth = np.zeros((height, width), np.float32)
        self._level = np.zeros((height, width), np.int16)
        self._sigma = np.zeros((height, width), np.uint8)
        self._tiles = -(-height // TILE) * -(-width // TILE)
        self._steady = np.full(height, UNITY, np.int32), np.ones(height, np.float32)
        self._T_store_robot: Floats | None = None
        self._exposure = 0.0
        self._turn = threading.Lock()
        light = (np.arange(TABLE) + 0.5) * BRIGHTEST / TABLE
        grey = 255.0 * light ** (1.0 / settings.gamma)
        noise = np.sqrt(settings.read_noise**2 + settings.shot_noise * np.minimum(grey, 255.0))
        level, sigma = np.rint(grey * DN_STEPS), np.clip(np.rint(noise * SIGMA_STEPS), 0, 255)
        self._code_of = (256.0 * level + sigma).astype(np.int32)

    def render(self, T_store_robot: Floats, t: float, exposure: float, lit: Lit, noise_seed: int) -> NDArray[np.uint8]:
        """One frame.

        Parameters
        ----------
        T_store_robot : (4, 4) array
            Where the robot truly stands, roll and pitch included.
        t : float
            True time at which the exposure of row 0 begins, seconds; row r begins r row times later.
        exposure : float
            Of every row, seconds.
        lit : callable
            Given begins and ends (K, L) of intervals, the share (K, L) of each in which label l of the layout is on.
        noise_seed : int
            Of this frame; equal seeds give equal noise.

        Returns
        -------
        (H, W) uint8 array
        """
        with self._turn:
            if self._T_store_robot is None or np.abs(T_store_robot - self._T_store_robot).max() > 1e-9:
                self._look_from(np.array(T_store_robot, dtype=np.float64))
                self._exposure = 0.0
            if exposure != self._exposure:
                self._encode(exposure)
            mask = NOISE_BANK - 1
            seed = (self._seed * 0x9E3779B97F4A7C15 + noise_seed * 0xD1B54A32D192ED03) & 0xFFFFFFFFFFFFFFFF
            gain, linear_gain = self._flicker(t, exposure)
            out = np.empty(self._level.shape, np.uint8)
            expose(self._level, self._sigma, gain, self.scene.noise, mask, seed, out)
            boxes = self._add_moving(t, exposure, lit, linear_gain)
            if len(boxes):
                retouch(
                    self._linear,
                    self._still,
                    boxes,
                    self._code_of,
                    self._scale,
                    linear_gain,
                    self.scene.noise,
                    mask,
                    seed,
                    out,
                )
            return out

    def _look_from(self, T_store_robot: Floats) -> None:
        scene = self.scene
        self._T_store_camera = T_store_robot @ self._T_robot_camera
        sharp = np.empty_like(self._still)
        trace(
            scene.quads,
            scene.textures,
            scene.texels,
            scene.unit,
            scene.empty,
            self._T_store_camera,
            self._rays,
            sharp,
            self._depth,
        )
        self._still[:] = cv2.GaussianBlur(sharp, (0, 0), self.settings.blur, borderType=cv2.BORDER_REPLICATE)
        self._linear[:] = self._still
        self._reach = reach(self._depth)
        self._spots = self._find_spots()
        self._boxes = np.zeros((4 * self._tiles + len(self._spots.peak), 4), np.int32)
        self._T_store_robot = T_store_robot

    def _encode(self, exposure: float) -> None:
        self._scale = exposure / BASE_EXPOSURE * TABLE / BRIGHTEST
        code = self._code_of[np.minimum(self._still * np.float32(self._scale), TABLE - 1).astype(np.int32)]
        self._level[:] = code >> 8
        self._sigma[:] = code & 255
        self._swings = list(self._find_swings(exposure))
        self._exposure = exposure

    def _find_swings(self, exposure: float) -> Iterator[tuple[float, float]]:
        """Angular frequency and depth of every part of the lamps' light that flickers in pictures so exposed.

        The mean of 1 + m cos(2 pi f t) over [t, t + e] is 1 + m sinc(f e) cos(2 pi f (t + e / 2)): no bands when the
        exposure is a multiple of the period.
        """
        lamps = self.scene.layout.lamps
        total = sum(lamp.brightness for lamp in lamps)
        for lamp in lamps:
            depth = lamp.flicker * np.sinc(lamp.frequency * exposure) * self.settings.lamp_share * lamp.brightness
            if lamp.frequency > 0.0 and abs(depth) > 1e-6 * total:
                yield 2.0 * math.pi * lamp.frequency, float(depth / total)

    def _flicker(self, t: float, exposure: float) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Gain of the rows, encoded and linear: the mean of the lamps' light over each row's exposure."""
        if not self._swings:
            return self._steady
        middle = t + 0.5 * exposure + self._row_time * np.arange(len(self._linear))
        linear = np.maximum(1.0 + sum(depth * np.cos(turn * middle) for turn, depth in self._swings), 0.0)
        encoded = np.rint(UNITY * linear ** (1.0 / self.settings.gamma)).astype(np.int32)
        return encoded, np.maximum(linear, 1e-3).astype(np.float32)

    # ---- what moves or blinks ----------------------------------------------------------------------------------------

    def _add_moving(self, t: float, exposure: float, lit: Lit, gain: NDArray[np.float32]) -> NDArray[np.int32]:
        """Put people and lights into `_linear`; returns the boxes (N, 4) that changed."""
        spots, crowd = self._spots, self.scene.crowd
        people = self.scene.people(t + 0.5 * exposure)
        used = 0
        if len(people):
            used = paint_walkers(
                self._linear,
                self._depth,
                self._reach,
                self._rays,
                self._T_store_camera,
                people,
                crowd.sprites,
                crowd.levels,
                crowd.cover,
                self._row_time,
                self._boxes[: 4 * self._tiles],
            )
        if not len(spots.peak):
            return self._boxes[:used]
        light = _NO_LIGHT
        if spots.delays.size:
            begins = t + spots.delays
            light = np.ascontiguousarray(lit(begins, begins + exposure), dtype=np.float64).ravel()
        shine(light, spots.pick, spots.blink, spots.ends, spots.peak, t, exposure, self._row_time, spots.strength)
        if used:
            transmission(
                spots.leg_from,
                spots.leg_to,
                spots.leg_delays,
                spots.leg_of,
                people,
                crowd.sprites,
                crowd.levels,
                spots.strength,
            )
        used += add_lights(
            self._linear, spots.boxes, spots.across, spots.down, spots.strength, gain, self._boxes[used:]
        )
        return self._boxes[:used]

    def _find_spots(self) -> _Spots:
        """Project every light that is in view, directly and in every glossy quad."""
        scene, T = self.scene, self._T_store_camera
        eye = T[:3, 3]
        position = scene.lights.position
        every = np.arange(len(position))
        clear = scene.visible(np.tile(eye, (len(every), 1)), position)
        images = [position[clear]]
        which, origins = [every[clear]], [np.tile(eye, (int(clear.sum()), 1))]
        strength = [scene.emission(every, np.tile(eye, (len(every), 1)))[clear]]
        for quad in scene.quads[scene.quads[:, 14] > 0.0]:
            points, seen = scene.mirrored(eye[None], every, quad)
            k = np.flatnonzero(seen[0])
            behind = (position[k] - quad[:3]) @ quad[9:12]
            images.append(position[k] - 2.0 * behind[:, None] * quad[9:12])
            which.append(k)
            origins.append(points[0, k])
            strength.append(quad[14] * scene.emission(k, points[0, k]))
        return self._project(
            np.concatenate(images), np.concatenate(which), np.concatenate(origins), np.concatenate(strength)
        )

    def _project(self, images: Floats, which: NDArray[np.int64], via: Floats, strength: Floats) -> _Spots:
        """Spots of lights that appear at `images` (N, 3), seen through the points `via` (the eye itself if direct)."""
        T, (height, width) = self._T_store_camera, self._still.shape
        fx, fy, cx, cy = self.camera.matrix
        inside = (images - T[:3, 3]) @ T[:3, :3]
        ahead = np.maximum(inside[:, 2], 1e-6)
        ideal = inside[:, :2] / ahead[:, None]
        low, high = self._rays.reshape(-1, 2).min(axis=0), self._rays.reshape(-1, 2).max(axis=0)
        keep = (inside[:, 2] > 0.02) & (ideal > low - 0.1).all(1) & (ideal < high + 0.1).all(1) & (strength > 0.0)
        which, via, images, strength = which[keep], via[keep], images[keep], strength[keep]
        centre = distort(self.camera, ideal[keep]) * (fx, fy) + (cx, cy)
        distance = np.linalg.norm(images - T[:3, 3], axis=1)
        sigma = np.hypot(self.settings.blur, np.minimum(fx * LED_SIGMA / distance, 2.5))
        reach = np.minimum(np.ceil(REACH * sigma), PATCH // 2 - 1)
        first = np.rint(centre) - reach[:, None]
        last = np.rint(centre) + reach[:, None] + 1.0
        first, last = np.maximum(first, 0.0).astype(np.int32), np.minimum(last, (width, height)).astype(np.int32)
        keep = (last > first).all(axis=1)
        k = np.arange(PATCH)
        spread = [
            np.exp(-0.5 * ((first[keep, i, None] + k - centre[keep, i, None]) / sigma[keep, None]) ** 2) for i in (0, 1)
        ]
        label = self.scene.lights.label[which[keep]]
        ends = np.column_stack([first[keep, 1], last[keep, 1] - 1]).astype(np.float64)
        # a label that is seen n times is asked about in n layers of two rows
        layer = np.array([int(np.sum(label[:n] == label[n])) for n in range(len(label))], np.int64)
        named = np.flatnonzero(label >= 0)
        layers, labels = int(layer[named].max(initial=-1)) + 1, len(self.scene.layout.labels)
        rows = np.full((2 * layers, labels), 0.5 * height)
        pick = np.full((2, len(label)), -1, np.int64)
        for end in (0, 1):
            rows[2 * layer[named] + end, label[named]] = ends[named, end]
            pick[end, named] = (2 * layer[named] + end) * labels + label[named]
        # a leg from the eye to the light, or to the glass, and another from there to the light
        light, glass = self.scene.lights.position[which[keep]], via[keep]
        eye = np.tile(T[:3, 3], (len(light), 1))
        bent = np.flatnonzero(np.abs(glass - eye).max(axis=1) > 1e-9)
        seen = light.copy()
        seen[bent] = glass[bent]
        leg_of = np.concatenate([np.arange(len(light)), bent])
        peak = strength[keep] / distance[keep] ** 2 / sigma[keep] ** 2
        return _Spots(
            delays=self._row_time * rows,
            pick=pick,
            blink=self.scene.lights.blink[which[keep]],
            peak=peak,
            boxes=np.ascontiguousarray(
                np.column_stack([first[keep, 1], last[keep, 1], first[keep, 0], last[keep, 0]]), dtype=np.int32
            ),
            across=np.ascontiguousarray(spread[0], dtype=np.float32),
            down=np.ascontiguousarray(spread[1], dtype=np.float32),
            ends=ends,
            strength=np.zeros((2, len(label))),
            leg_from=np.concatenate([eye, glass[bent]]),
            leg_to=np.concatenate([seen, light[bent]]),
            leg_of=leg_of,
            leg_delays=self._row_time * centre[keep, 1][leg_of],
        )
