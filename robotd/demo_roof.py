"""Roof cameras in the demo: served over HTTP on loopback, calibrated and watched as an owner would."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from .bus import Bus
from .clock import now
from .errors import DriverFault
from .hardware import Hardware
from .records import CameraModel
from .roof.setup import NO_POSE, load_calibrations, load_setup, save_calibration
from .roof_tool import record
from .roof_watch import RoofWatch
from .sim.mjpeg_server import MjpegServer, NetworkCameraSettings
from .sim.roof import RoofEye
from .sim.world import World
from .solver.calibrate_roof import RoofPoint, calibrate_roof

SETUP = """\
[roof]
data = {data}
beacons = {{ front = {front}, rear = {rear} }}

[detector]
exposure_s = {exposure}
row_time_s = {row_time}
jitter_s = 0.006
"""
DRIVER = """
[drivers.{name}]
driver = "mjpeg"
url = {url}
fps = {fps}
delay_s = {delay}
"""


class DemoRoof:
    """The roof cameras of a simulated store.

    Parameters
    ----------
    world : World
        With roof cameras in its layout.
    folder : Path
        For roof.toml and the calibration.
    data : Path
        The server's folder.
    """

    def __init__(self, world: World, folder: Path, data: Path) -> None:
        self.world = world
        self.folder = folder
        self.data = data
        self.poses: list[tuple[float, float, float, float]] = []  # time, x, y, heading: for the report
        self._eyes = {camera.name: world.roof_eye(camera.name) for camera in world.layout.roof_cameras}
        folder.mkdir(parents=True, exist_ok=True)
        beacons = world.believed_calibration().beacons
        self._height = beacons["front"][2]
        for name, eye in self._eyes.items():
            self._calibrate(name, eye)

    def _calibrate(self, name: str, eye: RoofEye) -> None:
        """From floor points that the operator measured, and the lens as a calibration left it."""
        settings = self.world.settings
        points = self.world.roof_points(name, eye)
        rng = self.world.rng(f"lens/{name}")
        fx, fy, cx, cy = eye.camera.matrix
        focal, centre = settings.focal_error * rng.standard_normal(), settings.centre_error * rng.standard_normal(2)
        matrix = (fx + focal, fy + focal, cx + float(centre[0]), cy + float(centre[1]))
        lens = CameraModel(name, eye.camera.size, matrix, NO_POSE, eye.camera.model, eye.camera.distortion)
        fit = calibrate_roof(
            [RoofPoint(*point, settings.roof.point_error) for point in points],
            lens,
            self._height,
            lens_known=True,
            sigma_px=settings.roof.pick_error,
        )
        save_calibration(record(fit, self._height, "the demo's"), self.folder / "roof-calibration.toml")

    @asynccontextmanager
    async def running(self, hardware: Hardware, robot: Bus, bus: Bus) -> AsyncIterator[RoofWatch]:
        """Serve and watch while the block runs; `robot` is the bus whose odometry is known here, as by telemetry."""
        servers: list[MjpegServer] = []
        tasks: list[asyncio.Task[None]] = []
        try:
            text = self._setup()
            for k, (name, eye) in enumerate(self._eyes.items()):
                server, address = await self._serve(k, eye)
                servers.append(server)
                text += self._driver(name, address)
            path = self.folder / "roof.toml"
            path.write_text(text)
            setup = load_setup(path)
            watch = RoofWatch(path, setup, load_calibrations(setup.roof.calibration), hardware, bus)
            tasks = [
                asyncio.create_task(watch.run()),
                asyncio.create_task(_feed(watch, robot)),
                asyncio.create_task(self._note(watch)),
            ]
            yield watch
        finally:
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
            for server in servers:
                await server.close()
        for result in results:
            if isinstance(result, Exception) and not isinstance(result, DriverFault):
                raise result

    async def _serve(self, number: int, eye: RoofEye) -> tuple[MjpegServer, str]:
        settings = self.world.settings.roof
        served = NetworkCameraSettings(
            fps=settings.fps,
            quality=settings.quality,
            stamps="X-Timestamp" if settings.stamps else None,
            delay_min=settings.delay_min,
            delay_max=settings.delay_max,
            exposed=eye.span,
            drop=settings.drop,
        )
        seed = int(self.world.rng(f"network/{number}").integers(2**31))
        server = MjpegServer(eye.prepare, served, seed=seed)
        return server, await server.start()

    def _setup(self) -> str:
        beacons = self.world.believed_calibration().beacons
        settings = self.world.settings.roof
        rows = next(iter(self._eyes.values())).camera.size[1]
        return SETUP.format(
            data=json.dumps(str(self.data)),
            front=list(beacons["front"]),
            rear=list(beacons["rear"]),
            exposure=settings.exposure,
            row_time=settings.readout / rows,
        )

    def _driver(self, name: str, address: str) -> str:
        settings = self.world.settings.roof
        # from the first light to the arrival, as the owner read off the camera's data sheet
        mean = 0.5 * (settings.delay_min + settings.delay_max)
        delay = settings.delay_min if settings.stamps else mean
        return DRIVER.format(name=name, url=json.dumps(address), fps=settings.fps, delay=delay)

    async def _note(self, watch: RoofWatch) -> None:
        """Keep where the cameras see the robot, for the report."""
        last = -1.0
        while True:
            await asyncio.sleep(0.2)
            present = watch.pose()
            if present is not None and present[0] > last:
                last, pose = present
                self.poses.append((last, pose.pose.x, pose.pose.y, pose.pose.heading))


async def _feed(watch: RoofWatch, robot: Bus) -> None:
    """The robot's dead reckoning, as telemetry brings it."""
    with robot.odometry.subscribe(size=256) as states:
        async for state in states:
            if now() - state.t < 1.0:
                watch.odometry.add(state)
