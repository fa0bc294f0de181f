"""The simulated world: everything that is true, and what a calibration of it would leave the robot to believe."""

from __future__ import annotations

import asyncio
import math
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..clock import stall
from ..config import Calibration
from ..geometry.transforms import rotation_matrix, rotation_vector
from ..odometry import Wheels, calibration_covariance
from ..records import CameraModel, Floats, KnownLabel, Pose, Priors, Transform, Vector3
from .body import Body
from .labels import LabelSystem
from .layout import StoreLayout
from .pins import PinStates
from .roof import BEACONS, RoofEye, calibration_points, roof_model
from .roomba import RoombaQuirks, SimRoomba
from .scene import Scene
from .settings import WorldSettings, load_settings

__all__ = ["FLOOR", "RIG", "World", "WorldSettings", "load_settings"]

RIG = {"front": 0.0, "left": math.pi / 2, "rear": math.pi, "right": -math.pi / 2}  # name to heading of each rig camera
RIG_HEIGHT, RIG_RADIUS = 0.50, 0.06  # m
RIG_LENS = (-0.06, 0.012, 0.0002, 0.0002, -0.001)
FLOOR = "floor"
FLOOR_POSITION, FLOOR_PITCH = (0.12, 0.0, 0.30), math.radians(35)
FLOOR_LENS = (-0.05, 0.010, 0.0002, -0.0002, 0.0)
LENS_SPREAD = 0.03  # by which lenses of one make differ, relative, one sigma


class World:
    """One store with one robot in it.

    Parameters
    ----------
    layout : StoreLayout
    settings : WorldSettings
    seed : int
        Decides everything that is random; equal seeds give equal bytes and pixels.
    folder : Path
        Which the label system watches for instruction files.

    Attributes
    ----------
    line : LineGeometry
        The tape's centre.
    rig, floor_camera : tuple of CameraModel, CameraModel
        The cameras as they truly are.
    body : Body
    roomba : SimRoomba
    label_system : LabelSystem
    pins : PinStates
        What hangs on the robot's pins.
    unplugged : set of str
        Devices that are not there; see `unplug`.
    """

    def __init__(
        self,
        layout: StoreLayout,
        settings: WorldSettings,
        seed: int,
        folder: Path,
        *,
        quirks: RoombaQuirks | None = None,
    ) -> None:
        self.layout = layout
        self.settings = settings
        self.seed = seed
        self.line = layout.geometry
        self.rig = tuple(self._rig_camera(name, heading) for name, heading in RIG.items())
        self.floor_camera = self._floor_camera()
        x, y = self.line.point_at(layout.line.stops[0])
        start = Pose(float(x), float(y), float(self.line.heading_at(layout.line.stops[0])))
        self.body = Body(layout, settings, self.rng("body"), start)
        self.roomba = SimRoomba(self.body, self.rng("roomba"), quirks)
        ids = tuple(label.id for label in layout.labels)
        self.label_system = LabelSystem(ids, settings.labels, folder, self.rng("labels"))
        self.pins = PinStates()
        self._scene: Scene | None = None
        self.unplugged: set[str] = set()
        self._plugs: dict[str, Callable[[], None]] = {}

    @property
    def scene(self) -> Scene:
        """What the rig's cameras see; made when the first of them is opened."""
        if self._scene is None:
            self._scene = Scene(self.layout, self.seed)
        return self._scene

    def rng(self, name: str) -> np.random.Generator:
        """A random generator of its own for each name, so that no part's draws depend on another's."""
        return np.random.default_rng([self.seed, zlib.crc32(name.encode())])

    async def run(self) -> None:
        """Let the world's own clockwork (the label system, hangs of the computer) run until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self.label_system.run())
            if self.settings.hang_interval > 0.0:
                group.create_task(self._hang())

    async def _hang(self) -> None:
        """Now and then nothing runs on the robot's computer for a while, as when a callback computes for too long.

        Virtual time would otherwise hide every lateness; in real time there is enough of it.
        """
        rng = self.rng("hangs")
        while True:
            await asyncio.sleep(rng.exponential(self.settings.hang_interval))
            stall(rng.uniform(0.0, self.settings.hang_longest))

    def lit(self, t0: Floats, t1: Floats) -> Floats:
        """(..., L) light of every label, averaged over intervals (..., L) between two times in seconds."""
        return self.label_system.lit(t0, t1)

    def camera_offset(self, name: str) -> float:
        """Constant error of a camera's time stamps in seconds, unknown to the robot."""
        limit = self.settings.camera_offset
        return float(self.rng(f"offset/{name}").uniform(-limit, limit))

    def believed_calibration(self) -> Calibration:
        """What the robot knows after a calibration: the truth with the errors that a calibration leaves.

        Wheels are believed nominal; their true scale and base are off by what remains after calibrating. The sigmas
        of these errors are the priors.
        """
        s = self.settings
        return Calibration(
            wheels=Wheels(
                base=s.wheel_base,
                travel_noise=s.travel_noise,
                covariance=calibration_covariance(s.wheel_scale_error, s.wheel_base_error * s.wheel_base),
                slip_length=s.slip_length,
                slip_distance=s.slip_distance,
            ),
            cameras=tuple(self._believed(camera) for camera in self.rig),
            floor_camera=self._believed(self.floor_camera),
            beacons=self._believed_beacons(),
            gamma=s.sensor.gamma,
            row_time_s=s.sensor.readout / self.rig[0].size[1],
            priors=Priors(
                tilt_rad=s.tilt,
                camera_rotation_rad=s.camera_rotation_error,
                camera_translation_m=s.camera_translation_error,
                focal_px=s.focal_error,
                centre_px=s.centre_error,
                odometry_scale=s.wheel_scale_error,
                odometry_turn=(turn := math.hypot(s.wheel_scale_error, s.wheel_base_error)),
                odometry_correlation=s.wheel_scale_error / turn if turn else 0.0,
                beacon_m=s.roof.beacon_error if self.layout.roof_cameras else 0.0,
            ),
        )

    def roof_eye(self, name: str) -> RoofEye:
        """What one of the layout's roof cameras sees."""
        layout = next(camera for camera in self.layout.roof_cameras if camera.name == name)
        return RoofEye(
            self.scene,
            roof_model(layout),
            self.settings.roof,
            self.settings.sensor,
            robot=self.body.T_store_robot,
            light=self.pins.level,
            lit=self.lit,
            seed=int(self.rng(f"renderer/{name}").integers(2**31)),
            radius=self.settings.robot_radius,
        )

    def roof_points(self, name: str, eye: RoofEye) -> list[tuple[float, float, float, float, float]]:
        """(u, v, x, y, z) of floor points as the operator measured them for one roof camera, in world axes."""
        return calibration_points(eye, self.layout, self.to_world, self.rng(f"points/{name}"))

    def _believed_beacons(self) -> dict[str, Vector3]:
        """The beacons' measured places on the robot; none in a store without roof cameras."""
        if not self.layout.roof_cameras:
            return {}
        rng, sigma = self.rng("beacons"), self.settings.roof.beacon_error
        return {name: _vector3(np.array(place) + sigma * rng.standard_normal(3)) for name, place in BEACONS.items()}

    def to_world(self, points: Floats) -> Floats:
        """(N, 3) points from store to world axes: the robot's true x, y, heading at its start, z from the floor."""
        start = self.body.start
        c, s = math.cos(start.heading), math.sin(start.heading)
        dx, dy = points[:, 0] - start.x, points[:, 1] - start.y
        return np.column_stack([c * dx + s * dy, c * dy - s * dx, points[:, 2]])

    def measured_labels(self) -> tuple[KnownLabel, ...]:
        """The layout's known labels as the operator measured them: in world axes, with the stated error."""
        where = {label.id: label.position for label in self.layout.labels}
        rng = self.rng("measured")
        return tuple(
            KnownLabel(
                known.id,
                _vector3(self.to_world(np.array([where[known.id]]))[0] + known.sigma * rng.standard_normal(3)),
                max(known.sigma, 1e-4),  # a survey knows nothing exactly
            )
            for known in self.layout.known_labels
        )

    def unplug(self, device: str) -> None:
        """Pull out a device: whoever has it open gets a DriverFault, and so does who opens it."""
        self.unplugged.add(device)
        release = self._plugs.pop(device, None)
        if release is not None:
            release()

    def plug(self, device: str) -> None:
        """Put a device back; it can be opened again."""
        self.unplugged.discard(device)

    def on_unplug(self, device: str, release: Callable[[], None]) -> None:
        """Have `release` called when the device is pulled out."""
        self._plugs[device] = release

    def _believed(self, camera: CameraModel) -> CameraModel:
        s, rng = self.settings, self.rng(f"calibration/{camera.name}")
        turn = rotation_matrix(s.camera_rotation_error * rng.standard_normal(3))
        shift = s.camera_translation_error * rng.standard_normal(3)
        fx, fy = np.array(camera.matrix[:2]) + s.focal_error * rng.standard_normal(2)
        cx, cy = np.array(camera.matrix[2:]) + s.centre_error * rng.standard_normal(2)
        mount = camera.T_robot_camera
        return CameraModel(
            camera.name,
            camera.size,
            (float(fx), float(fy), float(cx), float(cy)),
            Transform(
                _vector3(rotation_vector(turn @ rotation_matrix(mount.rotation))),
                _vector3(np.array(mount.translation) + shift),
            ),
            camera.model,
            camera.distortion,
            camera.valid_radius_px,
        )

    def _rig_camera(self, name: str, heading: float) -> CameraModel:
        position = (RIG_RADIUS * math.cos(heading), RIG_RADIUS * math.sin(heading), RIG_HEIGHT)
        mount = Transform(_vector3(rotation_vector(looking(heading, 0.0))), position)
        return CameraModel(
            name, (640, 480), (268.5, 268.5, 319.5, 239.5), mount, "brown-conrady", self._lens(name, RIG_LENS)
        )

    def _floor_camera(self) -> CameraModel:
        mount = Transform(_vector3(rotation_vector(looking(0.0, FLOOR_PITCH))), FLOOR_POSITION)
        lens = self._lens(FLOOR, FLOOR_LENS)
        return CameraModel(FLOOR, (320, 240), (228.5, 228.5, 159.5, 119.5), mount, "brown-conrady", lens)

    def _lens(self, name: str, lens: tuple[float, ...]) -> tuple[float, ...]:
        spread = 1.0 + LENS_SPREAD * self.rng(f"lens/{name}").standard_normal()
        return tuple(float(spread * coefficient) for coefficient in lens)


def looking(heading: float, pitch: float) -> Floats:
    """(3, 3) R_robot_camera of a camera that looks along `heading`, tipped down by `pitch` radians."""
    c, s = math.cos(heading), math.sin(heading)
    forward = np.array([c * math.cos(pitch), s * math.cos(pitch), -math.sin(pitch)])
    right = np.array([s, -c, 0.0])
    return np.column_stack([right, np.cross(forward, right), forward])


def _vector3(values: Floats) -> Vector3:
    return float(values[0]), float(values[1]), float(values[2])
