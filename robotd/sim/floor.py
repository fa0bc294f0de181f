"""What the floor camera sees: the tape, the floor's texture, uneven light, and walls and shelves ahead.

Every pixel's ray is cut with the floor plane. The tape comes from a map of the signed distance to its edge: that
function is nearly linear across the edge, so a bilinear look-up is exact to a tenth of a millimetre, and divided by
its own slope in the image it gives the pixel's coverage. The texture comes from a pyramid whose level fits the size
of a pixel on the floor. Rows are exposed one after another, each from where the robot is at that time.
"""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..geometry.transforms import invert_rigid
from ..records import CameraModel, Floats
from .floor_tiles import PITCH, dirt_tile, floor_image, floor_tile
from .layout import StoreLayout
from .line import LineGeometry
from .settings import WorldSettings

Image = NDArray[np.uint8]
Single = NDArray[np.float32]

REACH = 4.0  # m from the robot to the farthest floor or wall in view
DARK_TAPE, BRIGHT_TAPE = 0.035, 0.80  # reflectance
WALL, SHELF, SKIRTING = 0.55, 0.40, 0.22  # reflectance; every wall has a dark skirting board
SKIRTING_HEIGHT = 0.06  # m
FLOOR_GREY = (110 / 255) ** 2.2  # of full scale: how bright the bare floor is at EXPOSURE
EXPOSURE = 0.010  # s, for which the camera's gain is set
OUTSIDE = 30_000  # steps of EDGE_STEP: nowhere near the tape
EDGE_STEP = 2e-5  # m per unit of the stored distance
LIGHT_CELL = 0.1  # m
LAMP_SHARE = 0.65  # of the light at the brightest place; the rest is ambient


class FloorRenderer:
    """Renders frames of one floor camera; safe to call from several threads.

    Parameters
    ----------
    layout : StoreLayout
    settings : WorldSettings
    camera : CameraModel
        As it truly is.
    seed : int
        Of the texture, the dirt and the light; frames get a noise seed of their own.
    """

    def __init__(self, layout: StoreLayout, settings: WorldSettings, camera: CameraModel, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._settings = settings.floor
        self._camera = Camera(camera)
        self._width, self._height = camera.size
        v, u = np.mgrid[0 : self._height, 0 : self._width]
        rays, valid = self._camera.rays(np.column_stack([u.ravel(), v.ravel()]))
        rays[~valid] = 0.0, 0.0, 1.0
        mount = self._camera.T_robot_camera
        self._rays = (rays @ mount[:3, :3].T).T.astype(np.float32).reshape(3, self._height, self._width)
        self._eye = mount[:3, 3]
        self._light = _light_map(layout, settings, rng)
        self._levels, self._pitch = _pyramid(layout, rng)
        self._bands = self._texture_bands()
        self._edge, self._edge_pitch = _edge_map(layout)
        self._tape = DARK_TAPE if layout.line.color == "dark" else BRIGHT_TAPE
        self._gain = FLOOR_GREY / float(self._levels[0][..., 0].mean())
        axis = np.clip(rays[:, 2] / np.linalg.norm(rays, axis=1), 0.0, 1.0).reshape(self._height, self._width)
        self._vignette = (1.0 - self._settings.vignetting * (1.0 - axis**4)).astype(np.float32)
        self._noise = rng.standard_normal((3 * self._height, 3 * self._width), dtype=np.float32)
        self._lamps = [(lamp.frequency, lamp.flicker) for lamp in layout.lamps]
        self._faces = _faces(layout)
        tangents = rays[:, :2] / rays[:, 2:]
        self._view = 1.2 * np.abs(tangents).max(axis=0)  # a little more than the image, in x/z and y/z
        self._still: tuple[bytes, Single] | None = None

    def render(self, T_start: Floats, T_end: Floats, t: float, exposure: float, noise_seed: int) -> Image:
        """One frame.

        Parameters
        ----------
        T_start, T_end : (4, 4) array
            T_store_robot in the middle of the exposure of the first and of the last row.
        t : float
            Start of the exposure of the first row in seconds: the phase of the lamps.
        exposure : float
            Seconds per row.
        noise_seed : int
            Of this frame's noise.

        Returns
        -------
        (H, W) uint8 array
        """
        key = T_start.tobytes() + T_end.tobytes()
        still = self._still
        if still is None or still[0] != key:
            still = key, self._radiance(T_start, T_end)
            self._still = still
        light = self._flicker(t, exposure) * np.float32(exposure / EXPOSURE)
        grey = cv2.pow(np.minimum(still[1] * light[:, None], np.float32(1.0)), 1.0 / self._settings.gamma)
        row, column = np.random.default_rng(noise_seed).integers(0, (2 * self._height, 2 * self._width))
        noise = self._noise[row : row + self._height, column : column + self._width]
        frame = cv2.addWeighted(grey, 255.0, noise, self._settings.noise, 0.0, dtype=cv2.CV_8U)
        return np.asarray(frame, dtype=np.uint8)

    def _radiance(self, T_start: Floats, T_end: Floats) -> Single:
        """(H, W) light on the sensor as a share of full scale, before exposure and flicker."""
        sweep = _Sweep(T_start, T_end, self._height)
        x, y, z = np.tensordot(T_start[:3, :3].astype(np.float32), self._rays, axes=1)
        eye = T_start[:3, :3] @ self._eye
        with np.errstate(divide="ignore"):
            range_ = np.where(z < -1e-3, np.float32(-eye[2]) / z, np.float32(1e3))
        dx, dy = x * range_ + np.float32(eye[0]), y * range_ + np.float32(eye[1])
        cos, sin = sweep.cos[:, None], sweep.sin[:, None]
        floor_x = cos * dx - sin * dy + sweep.x[:, None]
        floor_y = sin * dx + cos * dy + sweep.y[:, None]
        picture = self._floor(floor_x, floor_y)
        seen = cv2.remap(
            self._light,
            floor_x / LIGHT_CELL - 0.5,
            floor_y / LIGHT_CELL - 0.5,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        picture *= seen
        self._draw_faces(picture, sweep, T_start)
        picture *= self._vignette
        picture *= np.float32(self._gain)
        if self._settings.blur > 0:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), self._settings.blur), dtype=np.float32)
        return picture

    def _floor(self, x: Single, y: Single) -> Single:
        """Reflectance of floor and tape at points of the floor."""
        period_y, period_x = (size * self._pitch for size in self._levels[0].shape[:2])
        surface = np.empty((self._height, self._width, 2), np.float32)
        u = x / np.float32(period_x)
        v = y / np.float32(period_y)
        u -= np.floor(u)
        v -= np.floor(v)
        for level, rows in self._bands:
            height, width = self._levels[level].shape[:2]
            surface[rows] = cv2.remap(
                self._padded[level], u[rows] * width + 0.5, v[rows] * height + 0.5, cv2.INTER_LINEAR
            )
        floor, wear = surface[..., 0], surface[..., 1]
        pitch = np.float32(self._edge_pitch)
        edge = cv2.remap(
            self._edge,
            x / pitch - 0.5,
            y / pitch - 0.5,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=OUTSIDE,
        )
        slope = np.hypot(cv2.Sobel(edge, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(edge, cv2.CV_32F, 0, 1, scale=0.125))
        cover = np.clip(0.5 - edge / np.maximum(slope, 1.0), 0.0, 1.0)
        cover *= 1.0 - np.float32(self._settings.dirt) * wear
        return np.asarray(floor + cover * (np.float32(self._tape) - floor), dtype=np.float32)

    def _texture_bands(self) -> list[tuple[int, slice]]:
        """Which level of the pyramid suits which rows, from the size of a pixel on a level floor."""
        self._padded = [cv2.copyMakeBorder(level, 1, 1, 1, 1, cv2.BORDER_WRAP) for level in self._levels]
        down = -self._rays[2, :, self._width // 2]
        reach = self._eye[2] / np.maximum(down, 0.02)
        footprint = reach / self._camera.focal.mean() / np.sqrt(np.maximum(down, 0.02))
        levels = np.clip(np.rint(np.log2(np.maximum(footprint / self._pitch, 1.0))), 0, len(self._levels) - 1).astype(
            int
        )
        cuts = [0, *(np.flatnonzero(np.diff(levels)) + 1).tolist(), self._height]
        return [(int(levels[a]), slice(a, b)) for a, b in itertools.pairwise(cuts)]

    def _flicker(self, t: float, exposure: float) -> Single:
        """(H,) light of the lamps in each row: their swing, averaged over the row's exposure."""
        start = t + np.arange(self._height) * (self._settings.readout / self._height)
        light = np.ones(self._height)
        for frequency, flicker in self._lamps:
            swing = np.sinc(frequency * exposure) * np.cos(2 * np.pi * frequency * (start + exposure / 2))
            light += LAMP_SHARE * flicker / len(self._lamps) * swing
        return light.astype(np.float32)

    def _draw_faces(self, picture: Single, sweep: _Sweep, T_start: Floats) -> None:
        """Paint walls and shelves over the floor, the far ones first."""
        here = T_start[:2, 3]
        near = []
        for face in self._faces:
            a, b, _, _, _ = face
            step = b - a
            share = min(1.0, max(0.0, float((here - a) @ step / (step @ step))))
            distance = float(np.hypot(*(here - a - share * step)))
            if distance < REACH:
                near.append((distance, face))
        T_camera_store = invert_rigid(sweep.middle(T_start) @ self._camera.T_robot_camera)
        for _, (a, b, bottom, top, reflectance) in sorted(near, key=lambda item: -item[0]):
            corners = np.array([[*a, bottom], [*b, bottom], [*b, top], [*a, top]])
            outline = self._outline(corners, T_camera_store)
            if outline is None:
                continue
            mask = np.zeros((self._height, self._width), np.uint8)
            cv2.fillPoly(mask, [np.rint(outline * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
            cover = mask * np.float32(1 / 255)
            picture += cover * (np.float32(reflectance) - picture)

    def _outline(self, corners: Floats, T_camera_store: Floats) -> Floats | None:
        """Pixels (N, 2) around a flat face as far as it is in view, or None."""
        polygon = corners @ T_camera_store[:3, :3].T + T_camera_store[:3, 3]
        a, b = self._view
        planes = np.array([[0, 0, 1, -0.05], [-1, 0, a, 0], [1, 0, a, 0], [0, -1, b, 0], [0, 1, b, 0]])
        if ((polygon @ planes[:, :3].T + planes[:, 3]) < 0.0).all(axis=0).any():
            return None
        for plane in planes:
            polygon = _clipped(polygon, plane)
            if len(polygon) < 3:
                return None
        share = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None]  # because the lens bends straight edges
        following = np.concatenate([polygon[1:], polygon[:1]])
        edges = polygon[:, None] + share * (following - polygon)[:, None]
        pixels, valid = self._camera.project(edges.reshape(-1, 3))
        return pixels[valid] if valid.sum() >= 3 else None


class _Sweep:
    """Where the robot is while the rows are exposed one after another: planar motion from T_start to T_end."""

    def __init__(self, T_start: Floats, T_end: Floats, rows: int) -> None:
        share = np.linspace(0.0, 1.0, rows)
        heading = [math.atan2(T[1, 0], T[0, 0]) for T in (T_start, T_end)]
        self._turn = math.remainder(heading[1] - heading[0], 2 * math.pi)
        self._step = T_end[:2, 3] - T_start[:2, 3]
        self.cos = np.cos(share * self._turn).astype(np.float32)
        self.sin = np.sin(share * self._turn).astype(np.float32)
        self.x = (T_start[0, 3] + share * self._step[0]).astype(np.float32)
        self.y = (T_start[1, 3] + share * self._step[1]).astype(np.float32)

    def middle(self, T_start: Floats) -> Floats:
        """(4, 4) T_store_robot halfway."""
        c, s = math.cos(self._turn / 2), math.sin(self._turn / 2)
        T = T_start.copy()
        T[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ T_start[:3, :3]
        T[:2, 3] += self._step / 2
        return T


def _clipped(polygon: Floats, plane: Floats) -> Floats:
    """The part of a convex polygon (N, 3) where plane . (x, y, z, 1) >= 0 (Sutherland and Hodgman 1974)."""
    heights = (polygon @ plane[:3] + plane[3]).tolist()
    if min(heights) >= 0.0:
        return polygon
    points = []
    for k, (hp, hq) in enumerate(zip([heights[-1], *heights], heights, strict=False)):
        if (hp >= 0.0) != (hq >= 0.0):
            points.append(polygon[k - 1] + hp / (hp - hq) * (polygon[k] - polygon[k - 1]))
        if hq >= 0.0:
            points.append(polygon[k])
    return np.array(points).reshape(-1, 3)


def _faces(layout: StoreLayout) -> list[tuple[Floats, Floats, float, float, float]]:
    """Vertical rectangles: two points on the floor, lower and upper edge, reflectance."""
    faces: list[tuple[Floats, Floats, float, float, float]] = []
    for wall in layout.walls:
        a, b = np.array(wall.start), np.array(wall.end)
        board = min(SKIRTING_HEIGHT, wall.height)
        faces += [(a, b, board, wall.height, WALL), (a, b, 0.0, board, SKIRTING)]
    for shelf in layout.shelves:
        x0, y0, x1, y1 = shelf.box
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            faces.append((a, b, 0.0, shelf.height, SHELF))
    return faces


def _light_map(layout: StoreLayout, settings: WorldSettings, rng: np.random.Generator) -> Single:
    """Light on the floor in cells of 0.1 m, mean 1: ambient, lamps by the inverse-square law, and blotches."""
    columns, rows = (max(2, math.ceil(side / LIGHT_CELL)) for side in layout.size)
    y, x = np.mgrid[0:rows, 0:columns] * LIGHT_CELL + LIGHT_CELL / 2
    light = np.zeros((rows, columns))
    for lamp in layout.lamps:
        h = max(lamp.position[2], 0.1)
        square = (x - lamp.position[0]) ** 2 + (y - lamp.position[1]) ** 2 + h * h
        light += lamp.brightness * h * h * h / square**1.5  # cosine times inverse square, 1 below the lamp
    if layout.lamps:
        light = (1.0 - LAMP_SHARE) + LAMP_SHARE * light / max(float(light.max()), 1e-9)
    else:
        light += 1.0
    blotches: Floats = np.asarray(cv2.GaussianBlur(rng.standard_normal((rows, columns)), (0, 0), 3.0), dtype=np.float64)
    blotches /= max(float(blotches.std()), 1e-9)
    light *= np.exp(settings.floor.unevenness * 0.5 * blotches)
    return np.asarray(light / light.mean(), dtype=np.float32)


def _pyramid(layout: StoreLayout, rng: np.random.Generator) -> tuple[list[Single], float]:
    """Levels (H, W, 2) of reflectance and wear, each half as fine as the one before, and the first one's m per px."""
    if layout.floor.image is not None:
        reflectance, pitch = floor_image(layout.floor.image), layout.floor.metres_per_pixel
    else:
        reflectance, pitch = floor_tile(layout.floor.texture, rng), PITCH
    tile = np.dstack([reflectance, dirt_tile(rng, reflectance.shape)]).astype(np.float32)
    levels = [tile]
    while min(levels[-1].shape[:2]) >= 8 and len(levels) < 6:
        height, width = levels[-1].shape[:2]
        levels.append(np.asarray(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)))
    return levels, pitch


def _edge_map(layout: StoreLayout) -> tuple[NDArray[np.int16], float]:
    """Signed distance from the tape's edge, inside negative, in EDGE_STEPs on a grid, and the grid's pitch in m."""
    width, depth = layout.size
    pitch = min(0.02, max(0.004, math.sqrt(width * depth / 4e6)))
    columns, rows = math.ceil(width / pitch), math.ceil(depth / pitch)
    edge = np.full((rows, columns), OUTSIDE * EDGE_STEP, np.float32)
    line = layout.line
    half = line.width / 2
    margin = half + 4 * pitch + 0.1

    def area(low: Floats, high: Floats) -> tuple[Single, Floats, Floats]:
        """The part of the map around a box, and its cells' x and y."""
        (x0, y0), (x1, y1) = low - margin, high + margin
        c0, c1 = max(0, int(x0 / pitch)), min(columns, int(x1 / pitch) + 2)
        r0, r1 = max(0, int(y0 / pitch)), min(rows, int(y1 / pitch) + 2)
        y, x = (np.mgrid[r0:r1, c0:c1] + 0.5) * pitch
        return edge[r0:r1, c0:c1], x, y

    def lay(geometry: LineGeometry, half: float) -> None:
        for piece in geometry.tape():
            part, x, y = area(piece.low, piece.high)
            np.minimum(part, piece.edge_distance(x, y, half), out=part, casting="same_kind")

    lay(layout.geometry, half)
    for start, length in line.gaps:
        geometry = layout.geometry
        torn = geometry.point_at(start + np.linspace(0.0, length, 2 + math.ceil(length / 0.05)))
        part, x, y = area(torn.min(axis=0), torn.max(axis=0))
        offset, s = geometry.nearest(np.stack([x, y], axis=-1))
        inside = np.minimum(s - start, start + length - s)
        np.maximum(part, np.where(np.abs(offset) < margin, inside, -np.inf), out=part, casting="same_kind")
    for tape in layout.tapes:
        lay(LineGeometry(tape.points, closed=tape.closed, corner_radius=tape.corner_radius), tape.width / 2)
    for mark in layout.marks:
        centre, reach = np.array(mark.position), mark.size / 2
        part, x, y = area(centre - reach, centre + reach)
        dx, dy = x - centre[0], y - centre[1]
        if mark.shape == "dot":
            distance = np.hypot(dx, dy) - reach
        else:
            cos, sin = math.cos(mark.heading), math.sin(mark.heading)
            distance = np.maximum(np.abs(cos * dx + sin * dy), np.abs(cos * dy - sin * dx)) - reach
        np.minimum(part, distance, out=part, casting="same_kind")
    return np.rint(np.clip(edge / EDGE_STEP, -OUTSIDE, OUTSIDE)).astype(np.int16), pitch
