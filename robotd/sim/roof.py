"""Network cameras under the simulated store's ceiling: colour pictures with the robot and its beacons in them.

The room comes from the rig's renderer (robotd.sim.camera); the robot, a dark disc with a lighter top, and its two LEDs,
lit as the pins of the Pi are, are drawn into it in linear light, row by row of the rolling shutter. What leaves the
camera is a JPEG with chroma at half resolution.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from ..bind import ranged
from ..geometry.transforms import invert_rigid, rotation_vector, transform_points
from ..records import CameraModel, Floats, Transform, Vector3
from .camera import RigRenderer, SensorSettings, distort
from .layout import RoofCameraLayout, StoreLayout
from .scene import Scene
from .sensor import SIGMA_STEPS

Image = NDArray[np.uint8]

PINS = {"front": 22, "rear": 27}  # as etc/robotd.toml has them
BEACONS: dict[str, Vector3] = {"front": (0.10, 0.0, 0.65), "rear": (-0.10, 0.0, 0.65)}
HULL_HEIGHT, TOP_HEIGHT, TOP_RADIUS = 0.09, 0.62, 0.11  # m
HULL_LIGHT, TOP_LIGHT = 0.05, 0.20  # radiance
LED_COLOUR = np.array([0.10, 0.16, 1.0], np.float32)  # blue, green, red: what leaks through the sensor's filters
LED_SIGMA_M = 0.0025
PATCH = 12  # px around an LED
RADIUS_OF_PEOPLE = 0.2  # m
MOUNT_HEIGHT = 2.3  # m, of cameras that are put up for a store without any
MOST_POINTS = 12
SHADE_NOISE = 1.6  # grey levels, of the robot in the picture
TINT = (0.96, 1.0, 1.02)  # of the shop's light in blue, green and red, in grey levels


@dataclass(frozen=True, slots=True)
class RoofCameraSettings:
    """[world.roof]: the network cameras, their network, and how they were calibrated."""

    fps: float = ranged(12.9, minimum=1.0, maximum=60.0, doc="frames a second (thesis 6.3.4)")
    quality: int = ranged(75, minimum=5, maximum=100, doc="JPEG quality")
    exposure: float = ranged(0.010, minimum=0.001, maximum=0.04, doc="s")
    readout: float = ranged(0.020, minimum=0.0, maximum=0.1, doc="rolling shutter: s from the first row to the last")
    stamps: bool = False  # the time of capture is sent with each frame
    delay_min: float = ranged(0.050, minimum=0.0, maximum=5.0, doc="s from the exposure to sending")
    delay_max: float = ranged(0.090, minimum=0.0, maximum=5.0, doc="s from the exposure to sending")
    drop: float = ranged(0.01, minimum=0.0, maximum=1.0, doc="share of frames that never arrive")
    beacon_radiance: float = ranged(6.0, minimum=0.0, maximum=1000.0, doc="peak at 1 m in a picture of sigma 1 px")
    point_error: float = ranged(0.005, minimum=0.0, maximum=0.5, doc="m, of the measured floor points, one sigma")
    pick_error: float = ranged(0.5, minimum=0.0, maximum=20.0, doc="px, of picking them in the picture, one sigma")
    beacon_error: float = ranged(0.001, minimum=0.0, maximum=0.1, doc="m, of the beacons' places on the robot")

    def __post_init__(self) -> None:
        if self.delay_min > self.delay_max:
            raise ValueError(f"delay_min = {self.delay_min:g}; expected at most delay_max = {self.delay_max:g}")


def with_roof_cameras(layout: StoreLayout) -> StoreLayout:
    """The layout with two roof cameras in opposite corners if it has none."""
    if layout.roof_cameras:
        return layout
    (width, depth), inset = layout.size, 0.35
    middle = (0.5 * width, 0.5 * depth, 0.0)
    corners = ((inset, inset, MOUNT_HEIGHT), (width - inset, depth - inset, MOUNT_HEIGHT))
    names = ("roof-1", "roof-2")
    cameras = tuple(RoofCameraLayout(name, at, middle, 100.0) for name, at in zip(names, corners, strict=True))
    return replace(layout, roof_cameras=cameras)


def roof_model(camera: RoofCameraLayout) -> CameraModel:
    """The camera as it truly is; its pose is T_store_camera."""
    eye, target = np.array(camera.position), np.array(camera.target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-6:
        right = np.array([0.0, -1.0, 0.0])
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(forward, right), forward])
    width, height = camera.size
    focal = 0.5 * width / math.tan(math.radians(0.5 * camera.hfov_deg))
    turn = rotation_vector(R)
    pose = Transform((float(turn[0]), float(turn[1]), float(turn[2])), camera.position)
    lens = (-0.04, 0.006, 0.0, 0.0, 0.0)
    return CameraModel(
        camera.name, camera.size, (focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5), pose, "brown-conrady", lens
    )


class RoofEye:
    """Draws what one roof camera sees.

    Parameters
    ----------
    scene : Scene
    camera : CameraModel
        With T_store_camera as its pose.
    settings : RoofCameraSettings
    sensor : SensorSettings
        Gamma, noise and blur; the readout is this camera's own.
    robot : callable
        From a time to T_store_robot (4, 4).
    light : callable
        From a pin and (N,) begins and ends of intervals to the shares of them in which it was high.
    lit : callable
        Of the labels; see RigRenderer.
    seed : int
    radius : float
        Of the robot's hull in metres.
    """

    def __init__(
        self,
        scene: Scene,
        camera: CameraModel,
        settings: RoofCameraSettings,
        sensor: SensorSettings,
        *,
        robot: Callable[[float], Floats],
        light: Callable[[int, Floats, Floats], Floats],
        lit: Callable[[Floats, Floats], Floats],
        seed: int,
        radius: float,
    ) -> None:
        self.camera = camera
        self.settings = settings
        self._scene = scene
        self._sensor = replace(sensor, readout=settings.readout)
        self._renderer = RigRenderer(scene, camera, self._sensor, seed)
        self._robot, self._light, self._lit = robot, light, lit
        self._seed = seed
        self._radius = radius
        self._pose = np.eye(4)
        self._pose[:3, :3] = cv2.Rodrigues(np.array(camera.T_robot_camera.rotation))[0]
        self._pose[:3, 3] = camera.T_robot_camera.translation
        self._row_time = settings.readout / camera.size[1]
        grey = np.arange(256) / 255.0
        self._linear = (grey**sensor.gamma).astype(np.float32)
        levels = np.arange(256)
        self._tints = [np.clip(np.rint(levels * tint), 0, 255).astype(np.uint8) for tint in TINT]

    @property
    def span(self) -> float:
        """Seconds from the first light on the first row to the last light on the last."""
        return self.settings.exposure + self.settings.readout

    def prepare(self, t: float) -> Callable[[], Image]:
        """The frame whose first row began to be exposed at `t`, once it is over; drawn when called, in any thread."""
        return partial(self._draw, t, self._robot(t + 0.5 * self.span), self._lights(t))

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """(N, 2) pixels of points in store axes, and (N,) their depths."""
        inside = transform_points(invert_rigid(self._pose), points)
        depth = np.maximum(inside[:, 2], 1e-6)
        fx, fy, cx, cy = self.camera.matrix
        return distort(self.camera, inside[:, :2] / depth[:, None]) * (fx, fy) + (cx, cy), inside[:, 2]

    def sees(self, point: Floats) -> bool:
        """Whether a point in store axes is in the picture and nothing that stands still hides it."""
        pixel, depth = self.project(point[None])
        size = np.array(self.camera.size)
        inside = depth[0] > 0.1 and (pixel[0] > 4.0).all() and (pixel[0] < size - 5.0).all()
        return bool(inside and self._scene.visible(self._pose[None, :3, 3], point[None])[0])

    def _lights(self, t: float) -> list[tuple[Floats, float, float]]:
        """(pixel, share of the exposure, peak) of every LED that the camera sees."""
        found = []
        for name, pin in PINS.items():
            at = t + 0.5 * self.span
            for _ in range(2):  # the row decides when it was exposed, and the robot moves meanwhile
                point = transform_points(self._robot(at), np.array([BEACONS[name]]))[0]
                pixel, depth = self.project(point[None])
                at = t + self._row_time * float(np.clip(pixel[0, 1], 0, self.camera.size[1])) + 0.5 * self.exposure
            if not self.sees(point) or self._behind_people(point, at):
                continue
            begin = np.array([at - 0.5 * self.exposure])
            share = float(self._light(pin, begin, begin + self.exposure)[0])
            spread = math.hypot(self._sensor.blur, self.camera.matrix[0] * LED_SIGMA_M / depth[0])
            peak = self.settings.beacon_radiance / depth[0] ** 2 / spread**2
            found.append((pixel[0], share * peak, spread))
        return found

    @property
    def exposure(self) -> float:
        """Of each row, seconds."""
        return self.settings.exposure

    def _behind_people(self, point: Floats, t: float) -> bool:
        """Whether a passer-by, an upright cylinder, stands between the camera and a point."""
        eye = self._pose[:3, 3]
        step = point - eye
        for person in self._scene.people(t):
            along = float(np.clip((person[:2] - eye[:2]) @ step[:2] / max(float(step[:2] @ step[:2]), 1e-9), 0.0, 1.0))
            nearest = eye + along * step
            if np.hypot(*(nearest[:2] - person[:2])) < RADIUS_OF_PEOPLE and nearest[2] < person[4]:
                return True
        return False

    def _draw(self, t: float, T_store_robot: Floats, lights: list[tuple[Floats, float, float]]) -> Image:
        noise_seed = int(np.random.default_rng([self._seed, round(1e6 * t)]).integers(2**31))
        grey = self._renderer.render(np.eye(4), t, self.exposure, self._lit, noise_seed)
        picture = np.asarray(cv2.merge([cv2.LUT(grey, table) for table in self._tints]), np.uint8)
        self._draw_robot(picture, T_store_robot, t, noise_seed)
        height, width = grey.shape
        for pixel, peak, spread in lights:
            u0, v0 = (round(float(value)) for value in pixel)
            left, right = max(0, u0 - PATCH), min(width, u0 + PATCH + 1)
            top, bottom = max(0, v0 - PATCH), min(height, v0 + PATCH + 1)
            across = np.exp(-0.5 * ((np.arange(left, right) - pixel[0]) / spread) ** 2)
            down = np.exp(-0.5 * ((np.arange(top, bottom) - pixel[1]) / spread) ** 2)
            light = self._linear[picture[top:bottom, left:right]]
            light += peak * np.outer(down, across)[:, :, None].astype(np.float32) * LED_COLOUR
            picture[top:bottom, left:right] = self._encoded(light)
        return picture

    def _encoded(self, light: NDArray[np.float32]) -> Image:
        """Grey levels of linear light."""
        return np.asarray(np.rint(255.0 * np.clip(light, 0.0, 1.0) ** np.float32(1.0 / self._sensor.gamma)), np.uint8)

    def _draw_robot(self, picture: Image, T_store_robot: Floats, t: float, seed: int) -> None:
        """The hull and the top, as discs at their heights; not where somebody stands before it."""
        turn = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
        for height, radius, light in ((HULL_HEIGHT, self._radius, HULL_LIGHT), (TOP_HEIGHT, TOP_RADIUS, TOP_LIGHT)):
            ring = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.full(len(turn), height)])
            points = transform_points(T_store_robot, ring)
            middle = points.mean(axis=0)
            if not self.sees(middle) or self._behind_people(middle, t):
                continue
            pixels, _ = self.project(points)
            fixed = np.rint(16.0 * pixels).astype(np.int32).reshape(-1, 1, 2)
            low, high = np.floor(pixels.min(axis=0)).astype(int) - 2, np.ceil(pixels.max(axis=0)).astype(int) + 3
            left, top = np.maximum(low, 0)
            right, bottom = np.minimum(high, self.camera.size)
            if right <= left or bottom <= top:
                continue
            mask = np.zeros((bottom - top, right - left), np.uint8)
            cv2.fillPoly(mask, [fixed - np.array([left * 16, top * 16])], 255, cv2.LINE_AA, 4)
            share = mask.astype(np.float32) / 255.0
            part = self._linear[picture[top:bottom, left:right]]
            part += share[:, :, None] * (light - part)
            first = seed % (len(self._scene.noise) - share.size)
            noise = self._scene.noise[first : first + share.size].reshape(*share.shape, 1) * (SHADE_NOISE / SIGMA_STEPS)
            picture[top:bottom, left:right] = np.clip(self._encoded(part) + share[:, :, None] * noise, 0, 255)


def calibration_points(
    eye: RoofEye, layout: StoreLayout, to_world: Callable[[Floats], Floats], rng: np.random.Generator
) -> list[tuple[float, float, float, float, float]]:
    """(u, v, x, y, z) of floor points that an operator measured in world axes and picked in the picture."""
    settings = eye.settings
    width, depth = layout.size
    grid = [
        np.array([x, y, 0.0]) for x in np.linspace(0.12, width - 0.12, 9) for y in np.linspace(0.12, depth - 0.12, 7)
    ]
    seen = [point for point in grid if eye.sees(point)]
    chosen = rng.permutation(len(seen))[:MOST_POINTS]
    points = np.array([seen[k] for k in chosen]).reshape(-1, 3)
    pixels = eye.project(points)[0] + settings.pick_error * rng.standard_normal((len(points), 2))
    pixels = np.clip(pixels, 0.0, np.array(eye.camera.size) - 1.0)
    world = to_world(points)
    world[:, :2] += settings.point_error * rng.standard_normal((len(points), 2))
    return [(float(u), float(v), float(x), float(y), float(z)) for (u, v), (x, y, z) in zip(pixels, world, strict=True)]
