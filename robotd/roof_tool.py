"""`robotd-solver calibrate roof` and `robotd-solver roof`: calibrate, check and watch roof cameras."""

from __future__ import annotations

import argparse
import asyncio
import csv
import json
import logging
import math
import signal
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .bus import Bus
from .clock import now
from .config import load_calibration as load_robot_calibration
from .daemon import LEVELS
from .errors import InputError
from .files import read_bytes
from .geometry.homography import apply
from .real import RealHardware
from .records import CameraModel
from .roof.pose import Lens
from .roof.setup import NO_POSE, RoofCalibration, load_calibrations, load_setup, matrix3, save_calibration
from .roof_watch import RoofWatch
from .solver.calibrate_roof import RoofFit, RoofPoint, calibrate_roof
from .vision.figures import ORANGE, SKY, WHITE, Canvas, Picture

log = logging.getLogger("robotd.roof")

Bytes = NDArray[np.uint8]
COLUMNS = ("u", "v", "x", "y")
MAGNIFIED = 20.0  # times, the residuals in the picture
GRID_M = 0.5


# ---- calibrate -------------------------------------------------------------------------------------------------------


def calibrate(arguments: argparse.Namespace) -> int:
    """Run `robotd-solver calibrate roof`; returns the exit code.

    Raises
    ------
    InputError
        If a file is wrong; every mistake of the points is named.
    SolverError
        If the points do not give the plane of the beacons: the message says what is missing.
    """
    points = load_points(arguments.points)
    image = _image(arguments.picture) if arguments.picture is not None else None
    size = arguments.size if image is None else (image.shape[1], image.shape[0])
    lens, known = _lens(arguments.lens, arguments.name, size)
    result = calibrate_roof(
        points,
        lens,
        arguments.height,
        lens_known=known,
        camera=arguments.camera,
        camera_sigma=arguments.camera_sigma,
        sigma_px=arguments.pick_sigma,
    )
    note = (
        f"{len(points)} points, {result.rms_px:.2f} px rms; the beacons' plane"
        f" +- {1e3 * np.median(result.sigma_m):.0f} mm at the points, {1e3 * result.sigma_m.max():.0f} mm at the worst"
    )
    calibration = record(result, arguments.height, note)
    save_calibration(calibration, arguments.calibration)
    if arguments.residuals is not None:
        base = np.full(size[::-1], 90, np.uint8) if image is None else image
        if not cv2.imwrite(str(arguments.residuals), residual_picture(base, points, result, calibration)):
            raise InputError(f"{arguments.residuals}: cannot be written; name another file ending in .png")
    if arguments.json:
        print(json.dumps(_summary(result, calibration)))
    at = "" if result.position is None else " camera at ({:.2f}, {:.2f}, {:.2f}) m;".format(*result.position)
    print(f"{arguments.name}: {note};{at} written to {arguments.calibration}", file=sys.stderr)
    return 0


def record(result: RoofFit, height: float, note: str) -> RoofCalibration:
    """A fit as roof-calibration.toml keeps it."""
    model = result.model
    return RoofCalibration(
        name=model.name,
        size=model.size,
        matrix=model.matrix,
        H_world_image=matrix3(result.homography.inverse / np.abs(result.homography.inverse).max()),
        covariance=tuple(tuple(float(value) for value in row) for row in result.homography.covariance),
        height=height,
        model=model.model,
        distortion=model.distortion,
        position=result.position,
        note=note,
    )


def load_points(path: Path) -> list[RoofPoint]:
    """Read a table of points; raises InputError that names every wrong line."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 at byte {error.start}; save the file as UTF-8") from error
    rows = list(csv.reader(line for line in text.splitlines() if line.strip() and not line.startswith("#")))
    head = [name.strip() for name in rows[0]] if rows else []
    optional = {"z", "sigma"}
    if tuple(head[:4]) != COLUMNS or not set(head[4:]) <= optional or len(set(head)) != len(head):
        raise InputError(f"{path}: found the header '{','.join(head)[:60]}'; expected u,v,x,y and if you like z, sigma")
    problems: list[str] = []
    points: list[RoofPoint] = []
    for number, row in enumerate(rows[1:], start=1):
        try:
            values = dict(zip(head, (float(cell) for cell in row), strict=True))
        except ValueError:
            problems.append(f"{path} point {number}: found '{','.join(row)[:60]}'; expected {len(head)} numbers")
            continue
        if not all(math.isfinite(value) for value in values.values()):
            problems.append(f"{path} point {number}: expected finite numbers")
            continue
        sigma = values.get("sigma", 0.005)
        if sigma <= 0.0:
            problems.append(f"{path} point {number} sigma: found {sigma:g}; expected above 0")
            continue
        points.append(RoofPoint(values["u"], values["v"], values["x"], values["y"], values.get("z", 0.0), sigma))
    if problems:
        raise InputError(*problems)
    return points


def _image(path: Path) -> Bytes:
    data = np.frombuffer(read_bytes(path), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if image is None:
        raise InputError(f"{path}: cannot be read as an image")
    return np.asarray(image, np.uint8)


def _lens(path: Path | None, name: str, size: tuple[int, int]) -> tuple[CameraModel, bool]:
    if path is None:
        middle = 0.5 * size[0] - 0.5, 0.5 * size[1] - 0.5
        return CameraModel(name, size, (0.8 * size[0], 0.8 * size[0], *middle), NO_POSE), False
    cameras = {camera.name: camera for camera in load_robot_calibration(path).cameras}
    if name not in cameras:
        found = ", ".join(sorted(cameras)) or "none"
        raise InputError(f'{path} cameras: found {found}; expected one with name = "{name}"')
    lens = cameras[name]
    if lens.size != size:
        wide, high = lens.size
        raise InputError(f"{path} cameras {name}: is for {wide}x{high} px, the picture has {size[0]}x{size[1]}")
    return lens, True


def _summary(result: RoofFit, calibration: RoofCalibration) -> dict[str, Any]:
    return {
        "name": calibration.name,
        "rms_px": round(result.rms_px, 4),
        "chi2": round(result.chi2, 4),
        "sigma_m": [round(float(sigma), 6) for sigma in result.sigma_m],
        "H_world_image": calibration.H_world_image,
        "position": result.position,
        "matrix": calibration.matrix,
    }


def residual_picture(image: Bytes, points: list[RoofPoint], result: RoofFit, calibration: RoofCalibration) -> Picture:
    """The points as picked (blue), where the fit has them (orange, magnified), and a grid in the beacons' plane."""
    canvas = Canvas(image, dim=0.6)
    lens = Lens(calibration.lens)
    world = np.array([[point.x, point.y] for point in points])
    low, high = np.floor(world.min(axis=0) / GRID_M) * GRID_M, np.ceil(world.max(axis=0) / GRID_M) * GRID_M
    for axis in (0, 1):
        for value in np.arange(low[axis], high[axis] + 0.5 * GRID_M, GRID_M):
            along = np.linspace(low[1 - axis], high[1 - axis], 60)
            line = np.column_stack([np.full(60, value), along] if axis == 0 else [along, np.full(60, value)])
            pixels = lens.distort(apply(calibration.homography.matrix, line))
            for piece in np.split(pixels, np.flatnonzero(~np.isfinite(pixels).all(axis=1))):
                inside = piece[np.isfinite(piece).all(axis=1)]
                if len(inside) > 1:
                    canvas.line(inside, WHITE)
    seen = np.array([[point.u, point.v] for point in points])
    canvas.dots(seen, np.tile(np.array(SKY, np.uint8), (len(seen), 1)), 3)
    miss = result.fitted - result.seen
    canvas.segments(np.hstack([seen, seen + MAGNIFIED * miss]), ORANGE)
    title = f"{calibration.name}: {result.rms_px:.2f} px rms, residuals x {MAGNIFIED:.0f}; grid {GRID_M:g} m"
    return canvas.titled(f"{title} at {calibration.height:g} m")


# ---- watch and check -------------------------------------------------------------------------------------------------


def run_watch(arguments: argparse.Namespace) -> int:
    """Watch until told to stop."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    cv2.setNumThreads(1)
    watch = _watch_of(arguments.config)

    async def until_told() -> None:
        work = asyncio.ensure_future(watch.run())
        events = asyncio.ensure_future(_log_events(watch.bus))
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, work.cancel)
        await asyncio.gather(work, return_exceptions=True)
        events.cancel()
        if not work.cancelled():
            work.result()

    asyncio.run(until_told())
    return 0


def _watch_of(path: Path) -> RoofWatch:
    setup = load_setup(path)
    return RoofWatch(path, setup, load_calibrations(setup.roof.calibration), RealHardware())


async def _log_events(bus: Bus) -> None:
    with bus.events.subscribe(size=256) as events:
        async for event in events:
            log.log(LEVELS[event.level], "%s: %s", event.source, event.text)


def run_check(arguments: argparse.Namespace) -> int:
    """Look through every camera for some seconds; returns 1 if one gives no pictures."""
    cv2.setNumThreads(1)
    watch = _watch_of(arguments.config)
    if arguments.no_cameras:
        print(f"{arguments.config}: no mistakes; {len(watch.cameras)} roof cameras")
        return 0

    async def look() -> dict[str, Any]:
        work = asyncio.ensure_future(watch.run())
        begun = now()
        await asyncio.wait({work}, timeout=arguments.seconds)
        status = watch.status() | {"seconds": now() - begun}
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)
        if not work.cancelled():
            work.result()
        return status

    status = asyncio.run(look())
    if arguments.json:
        print(json.dumps(status))
    else:
        for camera in status["cameras"]:
            print(_line(camera, status["seconds"]))
        pose = status["pose"]
        if pose is not None:
            at = pose["pose"]
            print(
                f"the robot is at ({at['x']:.3f}, {at['y']:.3f}) m, heading {math.degrees(at['heading']):.1f} degrees"
            )
    return 0 if all(camera["frames"] for camera in status["cameras"]) else 1


def _line(camera: dict[str, Any], seconds: float) -> str:
    if not camera["frames"]:
        return f"{camera['name']}: no frame; {camera['fault'] or 'the camera is silent'}"
    beacons = ", ".join(
        f"{name} at ({fix['u']:.1f}, {fix['v']:.1f}) +- {fix['sigma_px']:.2f} px"
        for name, fix in camera["beacons"].items()
    )
    rate = camera["frames"] / max(seconds, 1e-3)
    seen = beacons or "no beacon seen (does the robot stand still, lit?)"
    return f"{camera['name']}: {rate:.1f} frames a second; {seen}"
