"""Watching the robot through roof cameras: frames in, dwells on disk, the robot's pose at any time.

Each camera has its driver under a supervisor, as on the robot, and a detector in a thread. A camera that stalls costs
its own sightings alone: what stood when it fell silent is closed, the driver connects again, and the beacons are
searched for anew. A camera that was moved since its calibration is not believed until it is calibrated again.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from .bus import Bus
from .clock import in_executor, in_thread, now, ticks
from .config import Calibration
from .daemon import Plan, plan_cameras
from .errors import ConfigError, InputError
from .files import write_atomic
from .hardware import CameraMode, Hardware
from .plugin import Camera, Driver
from .records import Event, Floats, Frame
from .roof.dwell import DwellBuilder, RoofLog
from .roof.guard import SceneCheck, check_scene, median_picture
from .roof.motion import OdometryTrack
from .roof.pose import Lens, RoofPose, Seen, plausible_pair, solve_pose
from .roof.setup import RoofCalibration, RoofSetup
from .supervisor import Supervisor
from .vision.beacon import BeaconDetector, BeaconFix

Image = NDArray[np.uint8]

STATUS_S = 1.0
SILENT_S = 3.0  # without a frame: the operator is told
RECENT_S = 1.5  # fixes that make up the present pose
PICTURES, PICTURE_EVERY_S = 7, 2.0  # of a median picture
CONFIRMED = 2  # checks in a row that say "moved"


class RoofCameraWatch:
    """One camera: its driver, its detector, and what they found."""

    def __init__(
        self, driver: Driver, calibration: RoofCalibration, setup: RoofSetup, odometry: OdometryTrack, folder: Path
    ) -> None:
        self.name = calibration.name
        self.driver = driver
        self.supervisor = Supervisor(driver)
        self.calibration = calibration
        self.lens = Lens(calibration.lens)
        self.homography = calibration.homography
        self.fixes: dict[str, BeaconFix] = {}
        self.frames = 0
        self.last_frame = float("-inf")
        self.moved = False
        self.scene: SceneCheck | None = None
        self._suspicions = 0
        self._setup = setup
        self._odometry = odometry
        self._reference = folder / f"{calibration.name}-{calibration.digest}.png"
        self._pictures: deque[Image] = deque(maxlen=PICTURES)
        self._picture_at = self._check_at = float("-inf")
        self._builders = {beacon: DwellBuilder(self.name, beacon, calibration.digest) for beacon in setup.roof.beacons}

        def plausible(front: tuple[float, float], rear: tuple[float, float]) -> bool:
            return plausible_pair(calibration, self.lens, setup.roof.spacing, front, rear)

        self._detector = BeaconDetector(setup.detector, plausible)
        self._detector.motion = self._motion

    def update(self, frame: Frame) -> tuple[list[BeaconFix], SceneCheck | None]:
        """Look at a frame: milliseconds, or a tenth of a second where beacons are searched for."""
        return self._detector.update(frame.image, frame.t), self._look_around(frame)

    def _motion(self, beacon: str, t: Floats, place: Floats, t0: float) -> Floats | None:
        return self._odometry.places(self.calibration, self.lens, self._setup.roof.beacons[beacon], t, place, t0)

    def dwells(self, fixes: list[BeaconFix], offset: float) -> list[Any]:
        """The dwells' lines that fixes made; `offset` is the date at loop time 0."""
        lines = []
        for fix in fixes:
            self.fixes[fix.beacon] = fix
            lines += self._builders[fix.beacon].add(fix, offset + fix.until)
        return [] if self.moved else lines

    def idle(self, date: float) -> list[Any]:
        """Lines of dwells that are over because nothing is seen any more."""
        lines = [line for builder in self._builders.values() for line in builder.idle(date)]
        return [] if self.moved else lines

    def close(self) -> list[Any]:
        """Lines of the dwells under way."""
        return [] if self.moved else [line for builder in self._builders.values() for line in builder.close()]

    def _look_around(self, frame: Frame) -> SceneCheck | None:
        """Keep a picture now and then; compare with the reference when it is time. Returns the comparison if made."""
        if frame.t - self._picture_at >= PICTURE_EVERY_S:
            self._picture_at = frame.t
            self._pictures.append(frame.image)
        if frame.t - self._check_at < self._setup.roof.guard_s or len(self._pictures) < PICTURES:
            return None
        self._check_at = frame.t
        present = median_picture(tuple(self._pictures))
        reference = cv2.imread(str(self._reference), cv2.IMREAD_GRAYSCALE) if self._reference.exists() else None
        if reference is None:
            self._reference.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(self._reference, cv2.imencode(".png", present)[1].tobytes())
            return None
        self.scene = check_scene(np.asarray(reference, np.uint8), present)
        self._suspicions = self._suspicions + 1 if self.scene.verdict == "moved" else 0
        return self.scene

    @property
    def is_convicted(self) -> bool:
        """Several pictures in a row say that the camera was moved."""
        return self._suspicions >= CONFIRMED


class RoofWatch:
    """All roof cameras of one place.

    Parameters
    ----------
    path : Path
        Of roof.toml, for messages and relative paths.
    setup : RoofSetup
    calibrations : mapping of str to RoofCalibration
        By the cameras' names; every camera must have one.
    hardware : Hardware
        Gives the date.
    bus : Bus, optional
        Frames and events go there.

    Attributes
    ----------
    odometry : OdometryTrack
        Whoever has the robot's dead reckoning may add it. `robotd-solver roof watch` has none: there is no line to the
        robot, stops are joined by their dates, and moving beacons are followed by their own course as well.

    Raises
    ------
    ConfigError
        Lists every mistake: a section that is no camera, a camera without calibration.
    """

    def __init__(
        self,
        path: Path,
        setup: RoofSetup,
        calibrations: Mapping[str, RoofCalibration],
        hardware: Hardware,
        bus: Bus | None = None,
    ) -> None:
        plans = plan_cameras(path, setup.drivers)
        problems = [
            f"{path} [drivers.{name}]: {setup.roof.calibration} has no camera '{name}';"
            f" run robotd-solver calibrate roof ... --name {name}"
            for name in plans
            if name not in calibrations
        ]
        problems += [
            f"{path} [drivers.{name}]: is calibrated for beacons {calibrations[name].height:g} m high, but [roof]"
            f" beacons says {setup.roof.height:g}; calibrate it again"
            for name in plans
            if name in calibrations and abs(calibrations[name].height - setup.roof.height) > 0.01
        ]
        if problems:
            raise ConfigError(*problems)
        self.setup = setup
        self.hardware = hardware
        self.bus = bus or Bus()
        self.log = RoofLog(setup.roof.data)
        self.odometry = OdometryTrack()
        folder = setup.roof.data / "roof" / "cameras"
        self.cameras = [
            RoofCameraWatch(_driver(plan, hardware, self.bus), calibrations[name], setup, self.odometry, folder)
            for name, plan in plans.items()
        ]
        self._workers: ThreadPoolExecutor | None = None

    async def run(self) -> None:
        """Until cancelled; then every dwell under way is closed."""
        for camera in self.cameras:
            await in_thread(self.log.keep, camera.calibration)
        with ThreadPoolExecutor(max_workers=max(1, len(self.cameras)), thread_name_prefix="roof") as self._workers:
            try:
                async with asyncio.TaskGroup() as group:
                    for camera in self.cameras:
                        group.create_task(self._watch(camera))
                        group.create_task(camera.supervisor.run())
                    group.create_task(self._attend())
            finally:
                lines = [line for camera in self.cameras for line in camera.close()]
                self.log.add(lines)

    def pose(self) -> tuple[float, RoofPose] | None:
        """Where the robot is at present: the loop time of the newest fixes, and the pose; None if it is not seen."""
        fixes = [
            (camera, fix)
            for camera in self.cameras
            if not camera.moved
            for fix in camera.fixes.values()
            if now() - fix.until <= RECENT_S
        ]
        if not fixes:
            return None
        t = max(fix.t if fix.still_since is None else fix.until for _, fix in fixes)
        seen = []
        for camera, fix in fixes:
            # fixes of one moment: a beacon's last course is carried on to the newest one's time
            ahead = 0.0 if fix.still_since is not None else t - fix.t
            place = np.array([fix.u, fix.v]) + ahead * np.array(fix.velocity)
            flat = camera.lens.undistort(place, np.array(fix.covariance))
            if flat is not None:
                seen.append(Seen(camera.name, fix.beacon, *flat))
        pose = solve_pose(seen, {camera.name: camera.homography for camera in self.cameras}, self.setup.roof.beacons)
        return None if pose is None else (t, pose)

    def status(self) -> dict[str, Any]:
        """How every camera does, and where the robot is, for screens: plain data."""
        present = self.pose()
        return {
            "date": self.hardware.utc().isoformat(timespec="seconds"),
            "pose": None if present is None else asdict(present[1]) | {"age_s": round(now() - present[0], 3)},
            "cameras": [
                {
                    "name": camera.name,
                    "fault": camera.supervisor.fault,
                    "frames": camera.frames,
                    "silent_s": round(now() - camera.last_frame, 1) if camera.frames else None,
                    "moved": camera.moved,
                    "scene": None if camera.scene is None else asdict(camera.scene),
                    "beacons": {
                        name: {"u": fix.u, "v": fix.v, "sigma_px": fix.sigma_px, "age_s": round(now() - fix.until, 2)}
                        for name, fix in camera.fixes.items()
                        if now() - fix.until < RECENT_S
                    },
                }
                for camera in self.cameras
            ],
        }

    # ---- the work ----------------------------------------------------------------------------------------------------

    async def _watch(self, camera: RoofCameraWatch) -> None:
        """Every frame of one camera."""
        mode = CameraMode(size=camera.calibration.size)
        with self.bus.frames(camera.name).subscribe(size=4) as frames:
            await cast(Camera, camera.driver).start(mode)
            async for frame in frames:
                camera.frames += 1
                camera.last_frame = now()
                fixes, checked = await in_executor(self._workers, camera.update, frame)
                await self._keep(camera.dwells(fixes, self._date() - now()))
                if fixes:
                    self._anchor()
                if checked is not None:
                    self._judge(camera, checked)

    async def _attend(self) -> None:
        """What goes on without frames: dwells end, cameras fall silent, screens want news."""
        silent: set[str] = set()
        path = self.setup.roof.data / "roof" / "status.json"
        async for _ in ticks(STATUS_S):
            for camera in self.cameras:
                await self._keep(camera.idle(self._date()))
                quiet = now() - camera.last_frame
                if camera.frames and quiet > SILENT_S and camera.name not in silent:
                    silent.add(camera.name)
                    self._tell(camera, "warning", f"no frame for {quiet:.0f} s; the robot is not seen there meanwhile")
                elif quiet <= SILENT_S and camera.name in silent:
                    silent.discard(camera.name)
                    self._tell(camera, "info", "frames come again")
            await in_thread(_write, path, json.dumps(self.status()).encode())

    def _anchor(self) -> None:
        """Tell odometry where the robot stands."""
        present = self.pose()
        if present is not None:
            self.odometry.place(present[1].pose, present[0])

    def _judge(self, camera: RoofCameraWatch, checked: SceneCheck) -> None:
        if camera.is_convicted and not camera.moved:
            camera.moved = True
            self._tell(
                camera,
                "error",
                f"was moved since its calibration: {checked.corners} fixed points are {checked.shift_px:.1f} px from"
                " where they were; its sightings are not used until it is calibrated again",
            )
        elif camera.moved and checked.verdict == "still":
            camera.moved = False
            self._tell(camera, "info", "looks again where it was calibrated")

    async def _keep(self, lines: list[Any]) -> None:
        if not lines:
            return
        try:
            await in_thread(self.log.add, lines)
        except InputError as error:
            self.bus.events.publish(Event(now(), "roof", "error", str(error)))

    def _date(self) -> float:
        """Seconds since 1970."""
        return self.hardware.utc().timestamp()

    def _tell(self, camera: RoofCameraWatch, level: Any, text: str) -> None:
        self.bus.events.publish(Event(now(), camera.name, level, text))


def _driver(plan: Plan, hardware: Hardware, bus: Bus) -> Driver:
    return plan.cls(plan.name, plan.config, hardware, bus, Calibration())


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, data)
