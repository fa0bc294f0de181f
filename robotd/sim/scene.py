"""A store as light sees it: textured surfaces under lamps, labels, reflections and passers-by, in store axes.

Surfaces are rectangles (quads) seen from one side; each carries a picture of the light that leaves it, with the lamps'
light and shadows already in it, as a pyramid of texels. Radiance 1 clips a sensor that is exposed for 10 ms.
A quad may be glossy: it then mirrors what lies before it. Lights (labels, blinkers) are points, seen directly and
mirrored in every glossy quad.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..records import Floats, Vector3
from . import surfaces
from .sensor import SIGMA_STEPS
from .stores import StoreLayout
from .walker import Crowd, make_crowd

try:
    from ._sensor import visible as _visible
except ImportError:
    from .sensor import visible as _visible

FULL_SCALE = 4.0  # radiance of texel value 65535
EMPTY = 0.03  # radiance where a ray leaves the store
MEAN_RADIANCE = 0.36  # of a white surface in average light: an average wall is then at 100 to 130 grey levels
AMBIENT = 0.35  # share of the average light that comes from everywhere
MOST_TEXELS = 9e6  # of a whole scene; large stores get coarser pictures
LIGHT_POINTS = 15_000  # of a whole scene, at which the lamps' light is computed, 0.15 m apart or more
FINEST_TEXEL = 0.004  # m: a pixel of the rig at one metre
NOISE_BANK = 1 << 22

LABEL_RADIANCE = 1.0  # peak in a picture of sigma 1 px at 1 m, straight ahead, exposed for 10 ms: clips just there
LED_SIGMA = 0.00075  # m, a disc of 3 mm
FADE_BEGINS, FADE_ENDS = math.radians(68.0), math.radians(78.0)  # a label is seen up to about 75 degrees
LABELS_PER_REFLECTION = 10
GLOSS = 0.6  # reflectivity of the default panels
GLOSS_SIZE = (0.55, 0.45)  # m
CAMERA_HEIGHT = 0.5  # m, of the viewers for whom panels are placed


@dataclass(frozen=True, slots=True, eq=False)
class Lights:
    """N point lights.

    `position` and `normal` (N, 3), the normal zero for a light that shines to all sides; `strength` (N,) peak radiance
    at 1 m; `label` (N,) index of the label, or -1 for a blinker, whose frequency and duty are `blink` (N, 2).
    """

    position: Floats
    normal: Floats
    strength: Floats
    label: NDArray[np.int64]
    blink: Floats


@functools.cache
def noise_bank() -> NDArray[np.int8]:
    """(NOISE_BANK + 4096,) standard normal samples in steps of 1/32, one for all: seeds decide where frames read it."""
    samples = np.random.default_rng(0).standard_normal(NOISE_BANK, dtype=np.float32) * SIGMA_STEPS
    bank = np.clip(np.rint(samples), -127, 127).astype(np.int8)
    bank = np.concatenate([bank, bank[:4096]])
    bank.flags.writeable = False
    return bank


class Scene:
    """Static surfaces and lights of one store.

    Parameters
    ----------
    layout : StoreLayout
        With its disturbances already added.
    seed : int
        Decides what the surfaces look like and where glossy panels hang; positions come from the layout alone.
    finest : float
        Size of a texel in metres; larger in a store of more than about 150 square metres of surface.

    Attributes
    ----------
    quads : (S, 15) array
        Upper left corner, unit vectors to the right and down as seen from the front, normal towards the viewer, width,
        height (metres), reflectivity.
    textures : (S, 4) int64 array
        First texel, columns, rows and number of levels of each quad's picture.
    texels : (N,) uint16 array
        Radiance in steps of `unit`.
    lights : Lights
    crowd : Crowd
    noise : (NOISE_BANK + 4096,) int8 array
        See `noise_bank`.
    """

    unit = FULL_SCALE / 65535.0
    empty = EMPTY

    def __init__(self, layout: StoreLayout, seed: int, *, finest: float = FINEST_TEXEL) -> None:
        self.layout = layout
        self._rng = np.random.default_rng([seed, 0xA1])
        self._quads: list[Floats] = []
        self._pictures: list[surfaces.Picture] = []
        self._glowing: list[bool] = []
        # coordinates (3, N, 1) and brightness (N, 1) of the lamps
        self._lamps = (
            np.ascontiguousarray(_rows([lamp.position for lamp in layout.lamps]).T)[..., None],
            np.array([[lamp.brightness] for lamp in layout.lamps]).reshape(-1, 1),
        )
        self._texel = self._texel_size(finest)
        self._build_room()
        self._build_fittings()
        self.quads = np.array(self._quads)
        self.lights = self._make_lights()
        self._hang_panels()
        self._add_mirrors()
        self.quads = np.ascontiguousarray(self._quads, dtype=np.float64)
        self._light_up()
        self.crowd: Crowd = make_crowd(layout.walkers, self._rng)
        self.noise = noise_bank()
        del self._pictures, self._quads, self._glowing

    # ---- surfaces ----------------------------------------------------------------------------------------------------

    def _texel_size(self, finest: float) -> float:
        width, depth = self.layout.size
        area = 1.5 * width * depth
        area += sum(2.0 * math.dist(wall.start, wall.end) * wall.height for wall in self.layout.walls)
        for shelf in self.layout.shelves:
            x0, y0, x1, y1 = shelf.box
            area += 2.0 * (x1 - x0 + y1 - y0) * shelf.height + (x1 - x0) * (y1 - y0)
        return max(finest, math.sqrt(area / MOST_TEXELS))

    def _add(
        self,
        corner: ArrayLike,
        right: ArrayLike,
        down: ArrayLike,
        picture: surfaces.Picture,
        *,
        reflectivity: float = 0.0,
        glows: bool = False,
    ) -> None:
        """A quad from its upper left corner and its two edges, as seen from the front."""
        u, v = np.asarray(right, dtype=np.float64), np.asarray(down, dtype=np.float64)
        width, height = float(np.linalg.norm(u)), float(np.linalg.norm(v))
        u, v = u / width, v / height
        self._quads.append(np.array([*np.asarray(corner), *u, *v, *-np.cross(u, v), width, height, reflectivity]))
        self._pictures.append(picture)
        self._glowing.append(glows)

    def _inside(self, point: Floats) -> bool:
        width, depth = self.layout.size
        return bool(0.0 < point[0] < width and 0.0 < point[1] < depth)

    def _upright(self, start: Floats, end: Floats) -> list[tuple[Floats, Floats]]:
        """Upper left foot and edge to the right of the faces of a vertical sheet that can be seen from the floor."""
        faces = []
        for a, b in ((start, end), (end, start)):
            edge = b - a
            normal = np.array([edge[1], -edge[0]]) / np.hypot(*edge)  # the viewer's side, a on the left
            if self._inside(0.5 * (a + b) + 0.01 * normal):
                faces.append((a, edge))
        return faces

    def _build_room(self) -> None:
        layout, rng, texel = self.layout, self._rng, self._texel
        width, depth = layout.size
        top = max([2.4, *(wall.height for wall in layout.walls)])
        ground = surfaces.floor(rng, layout.floor, width, depth, texel)
        self._lay_tape(ground)
        self._add((0.0, depth, 0.0), (width, 0.0, 0.0), (0.0, -depth, 0.0), ground)
        above = surfaces.ceiling(rng, width, depth, 2.0 * texel)
        self._add((0.0, 0.0, top), (width, 0.0, 0.0), (0.0, depth, 0.0), above)
        for wall in layout.walls:
            for a, edge in self._upright(np.array(wall.start), np.array(wall.end)):
                length = float(np.hypot(*edge))
                picture = surfaces.wall(rng, wall.texture, length, wall.height, texel)
                self._add((*a, wall.height), (*edge, 0.0), (0.0, 0.0, -wall.height), picture)

    def _lay_tape(self, ground: surfaces.Picture) -> None:
        line = self.layout.line
        points = self.layout.geometry.points / self._texel - 0.5
        points[:, 1] = ground.shape[0] - 1.0 - points[:, 1]
        tape = np.zeros(ground.shape, np.uint8)
        fixed = np.rint(points * 16.0).astype(np.int32).reshape(-1, 1, 2)  # sub-texel positions, four binary digits
        cv2.polylines(tape, [fixed], False, 255, max(1, round(line.width / self._texel)), cv2.LINE_AA, 4)
        share = tape.astype(np.float32) / 255.0
        ground *= 1.0 - share
        ground += share * (0.04 if line.color == "dark" else 0.8)

    def _build_fittings(self) -> None:
        layout, rng, texel = self.layout, self._rng, self._texel
        for shelf in layout.shelves:
            x0, y0, x1, y1 = shelf.box
            corners = [np.array(p) for p in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
            for a, b in itertools.pairwise([*corners, corners[0]]):
                edge = b - a
                if not self._inside(0.5 * (a + b) + 0.01 * np.array([edge[1], -edge[0]]) / np.hypot(*edge)):
                    continue
                picture = surfaces.shelf(rng, float(np.hypot(*edge)), shelf.height, texel)
                self._add((*a, shelf.height), (*edge, 0.0), (0.0, 0.0, -shelf.height), picture)
            cover = surfaces.shelf_top(rng, x1 - x0, y1 - y0, 4.0 * texel)
            self._add((x0, y1, shelf.height), (x1 - x0, 0.0, 0.0), (0.0, y0 - y1, 0.0), cover)
        for label in layout.labels:
            u, v = _axes(np.array(label.normal))
            corner = np.array(label.position) - 0.002 * np.array(label.normal) - 0.03 * u - 0.005 * v
            self._add(corner, 0.06 * u, 0.04 * v, surfaces.label(rng))
        for lamp in layout.lamps:
            centre = np.array(lamp.position) - (0.0, 0.0, 0.01)
            shine = np.full((4, 8), min(FULL_SCALE, 2.5 * lamp.brightness), np.float32)
            self._add(centre - (0.4, 0.08, 0.0), (0.8, 0.0, 0.0), (0.0, 0.16, 0.0), shine, glows=True)

    # ---- lights and reflections --------------------------------------------------------------------------------------

    def _make_lights(self) -> Lights:
        labels, blinkers = self.layout.labels, self.layout.blinkers
        everywhere = (0.0, 0.0, 0.0)
        return Lights(
            position=_rows([*(item.position for item in labels), *(item.position for item in blinkers)]),
            normal=_rows([*(item.normal for item in labels), *(item.normal or everywhere for item in blinkers)]),
            strength=LABEL_RADIANCE
            * np.array([*(item.brightness for item in labels), *(item.brightness for item in blinkers)]),
            label=np.concatenate([np.arange(len(labels)), np.full(len(blinkers), -1)]).astype(np.int64),
            blink=np.array([(0.0, 0.0)] * len(labels) + [(item.frequency, item.duty) for item in blinkers]).reshape(
                -1, 2
            ),
        )

    def _hang_panels(self) -> None:
        """One glossy panel per ten labels, where it shows a label to a robot at one of the line's stops.

        A store with mirrors of its own, or without disturbances, gets none.
        """
        layout, rng = self.layout, self._rng
        if not layout.disturbances or layout.mirrors or not layout.labels:
            return
        stops = layout.geometry.point_at(np.array(layout.line.stops))
        viewers = np.column_stack([stops, np.full(len(stops), CAMERA_HEIGHT)])
        solid = [k for k in range(len(self.quads)) if self.quads[k, 12] > GLOSS_SIZE[0] and self.quads[k, 8] < -0.5]
        shown: list[list[tuple[int, Floats]]] = [[] for _ in layout.labels]  # quad and point of every possible place
        every = np.arange(len(layout.labels))
        for k in solid:
            points, seen = self.mirrored(viewers, every, self.quads[k])
            place = (points - self.quads[k, :3]) @ self.quads[k, 3:9].reshape(2, 3).T
            seen &= (place > 0.1).all(axis=-1) & (place < self.quads[k, 12:14] - 0.1).all(axis=-1)
            for v, n in np.argwhere(seen):
                shown[n].append((k, points[v, n]))
        wanted = max(1, round(len(layout.labels) / LABELS_PER_REFLECTION))
        taken: list[Floats] = []
        for n in rng.permutation(len(layout.labels)):
            places = [
                (k, point) for k, point in shown[n] if all(np.linalg.norm(point - other) > 0.8 for other in taken)
            ]
            if places and len(taken) < wanted:
                k, point = places[int(rng.integers(len(places)))]
                self._add_panel(self.quads[k], point)
                taken.append(point)

    def _add_panel(self, quad: Floats, centre: Floats) -> None:
        u, v, n = quad[3:6], quad[6:9], quad[9:12]
        # not beyond the edges of the surface that carries it
        a = np.clip((centre - quad[:3]) @ u, 0.5 * GLOSS_SIZE[0], max(quad[12] - 0.5 * GLOSS_SIZE[0], 0.5 * quad[12]))
        height = min(GLOSS_SIZE[1], quad[13])
        b = np.clip((centre - quad[:3]) @ v, 0.5 * height, quad[13] - 0.5 * height)
        corner = quad[:3] + (a - 0.5 * GLOSS_SIZE[0]) * u + (b - 0.5 * height) * v + 0.003 * n
        shape = surfaces.picture_size(GLOSS_SIZE[0], height, 4.0 * self._texel)
        tint = np.full(shape, self._rng.uniform(0.1, 0.4), np.float32)
        self._add(corner, GLOSS_SIZE[0] * u, height * v, tint, reflectivity=GLOSS)

    def _add_mirrors(self) -> None:
        for mirror in self.layout.mirrors:
            height = mirror.top - mirror.bottom
            for a, edge in self._upright(np.array(mirror.start), np.array(mirror.end)):
                out = np.array([edge[1], -edge[0]]) / np.hypot(*edge)  # in front of a wall that it may hang on
                tint = np.full((4, 4), 0.2, np.float32)
                corner = (*(a + 0.003 * out), mirror.top)
                self._add(corner, (*edge, 0.0), (0.0, 0.0, -height), tint, reflectivity=mirror.reflectivity)

    def mirrored(self, viewers: Floats, which: NDArray[np.int64], quad: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Where viewers see lights mirrored in one quad.

        Parameters
        ----------
        viewers : (V, 3) array
        which : (N,) int array
            Indices of lights.
        quad : (15,) array
            A row of `quads`.

        Returns
        -------
        points : (V, N, 3) array
            Points of the quad's plane in which the lights appear.
        seen : (V, N) bool array
            The point lies in the quad, and nothing that stands still is in the way before or behind it.
        """
        n = quad[9:12]
        light = self.lights.position[which]
        front_viewer = (viewers - quad[:3]) @ n
        front_light = (light - quad[:3]) @ n
        seen = (front_viewer[:, None] > 1e-3) & (front_light[None] > 1e-3)
        total = np.where(seen, front_viewer[:, None] + front_light[None], 1.0)
        image = light - 2.0 * front_light[:, None] * n
        points = viewers[:, None] + (front_viewer[:, None] / total)[..., None] * (image[None] - viewers[:, None])
        a, b = (points - quad[:3]) @ quad[3:6], (points - quad[:3]) @ quad[6:9]
        seen &= (a >= 0.0) & (a <= quad[12]) & (b >= 0.0) & (b <= quad[13])
        v, k = np.nonzero(seen)
        if not len(v):
            return points, seen
        ends = points[v, k]
        clear = self.visible(viewers[v], ends) & self.visible(ends, light[k])
        clear &= self.emission(which[k], ends) > 0.0
        seen[v, k] = clear
        return points, seen

    def visible(self, origins: Floats, targets: Floats) -> NDArray[np.bool_]:
        """Whether nothing that stands still is between origins and targets (N, 3)."""
        out = np.empty(len(origins), np.uint8)
        _visible(self.quads, np.ascontiguousarray(origins), np.ascontiguousarray(targets), out)
        return out.astype(np.bool_)

    def emission(self, which: NDArray[np.int64], towards: Floats) -> Floats:
        """Strength (N,) of lights in the directions of the points (N, 3): falls with the cosine, gone at 78 degrees."""
        lights = self.lights
        step = towards - lights.position[which]
        cosine = np.einsum("ij,ij->i", step, lights.normal[which]) / np.maximum(np.linalg.norm(step, axis=1), 1e-9)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        share = np.clip((FADE_ENDS - angle) / (FADE_ENDS - FADE_BEGINS), 0.0, 1.0)
        everywhere = ~lights.normal[which].any(axis=1)
        shape = np.where(everywhere, 1.0, np.maximum(cosine, 0.0) * share * share * (3.0 - 2.0 * share))
        return np.asarray(lights.strength[which] * shape)

    # ---- the lamps' light --------------------------------------------------------------------------------------------

    def irradiance(self, points: Floats, normals: Floats) -> Floats:
        """Light (N,) of the lamps that reaches points (N, 3) on surfaces with these normals, shadows included."""
        total = np.zeros(len(points))
        for lamp in self.layout.lamps:
            for shift in (-0.25, 0.25):  # two points of the tube soften the shadows
                at = np.array(lamp.position) + np.array([shift, 0.0, -0.02])
                step = at - points
                square = np.maximum(np.einsum("ij,ij->i", step, step), 0.09)
                cosine = np.einsum("ij,ij->i", step, normals) / np.sqrt(square)
                facing = np.flatnonzero(cosine > 0.0)
                clear = self.visible(points[facing], np.tile(at, (len(facing), 1)))
                down = np.maximum(step[facing, 2], 0.0) / np.sqrt(square[facing])
                total[facing] += clear * 0.5 * lamp.brightness * cosine[facing] * (0.25 + 0.75 * down) / square[facing]
        return total

    def _light_up(self) -> None:
        """Turn reflectance into radiance and store all pictures with their pyramids."""
        grids, points, normals = [], [], []
        cell = max(0.15, math.sqrt(float((self.quads[:, 12] * self.quads[:, 13]).sum()) / LIGHT_POINTS))
        for quad in self.quads:
            rows, columns = (max(2, round(size / cell)) for size in (quad[13], quad[12]))
            a = (np.arange(columns) + 0.5) * quad[12] / columns
            b = (np.arange(rows) + 0.5) * quad[13] / rows
            grid = quad[:3] + b[:, None, None] * quad[6:9] + a[None, :, None] * quad[3:6] + 0.002 * quad[9:12]
            grids.append((rows, columns))
            points.append(grid.reshape(-1, 3))
            normals.append(np.tile(quad[9:12], (rows * columns, 1)))
        light = self.irradiance(np.concatenate(points), np.concatenate(normals))
        lit = light[light > 0.0]
        average = float(lit.mean()) if len(lit) else 1.0
        share = (1.0 - AMBIENT) if len(lit) else 0.0
        self._light_scale = MEAN_RADIANCE * share / average
        self._light_floor = MEAN_RADIANCE * (1.0 - share)
        level = (self._light_floor + self._light_scale * light).astype(np.float32)
        table, buffers, first, used = [], [], 0, 0
        for (rows, columns), picture, glows in zip(grids, self._pictures, self._glowing, strict=True):
            map_ = level[used : used + rows * columns].reshape(rows, columns)
            used += rows * columns
            radiance = picture if glows else picture * cv2.resize(map_, picture.shape[::-1])
            count, start = 0, first
            while True:
                stored = np.clip(np.rint(radiance / self.unit), 0, 65535).astype(np.uint16)
                buffers.append(stored.ravel())
                first += stored.size
                count += 1
                if max(radiance.shape) <= 2 or count == 9:
                    break
                half = max(1, radiance.shape[1] // 2), max(1, radiance.shape[0] // 2)
                radiance = cv2.resize(radiance, half, interpolation=cv2.INTER_AREA).reshape(half[::-1])
            table.append((start, picture.shape[1], picture.shape[0], count))
        self.textures = np.array(table, np.int64)
        self.texels: NDArray[np.uint16] = np.concatenate(buffers)

    def people(self, t: float) -> Floats:
        """(K, 9) state of the passers-by at time `t`; see `Crowd.at`."""
        crowd = self.crowd
        if not crowd.walkers:
            return np.empty((0, 9))
        rows = crowd.at(t)
        rows[:, 5] = self._light_on(rows)
        return rows

    def _light_on(self, rows: Floats) -> Floats:
        """Radiance of a white, upright surface at the passers-by's chests, averaged over all directions."""
        x, y, z = rows[:, 0], rows[:, 1], 0.7 * rows[:, 4]
        at, brightness = self._lamps
        up = at[2] - z
        square = np.maximum((at[0] - x) ** 2 + (at[1] - y) ** 2 + up**2, 0.25)
        light = brightness * 0.5 * (0.25 + 0.75 * np.maximum(up, 0.0) / np.sqrt(square)) / square
        return np.asarray(self._light_floor + self._light_scale * light.sum(axis=0))


def _rows(vectors: list[Vector3]) -> Floats:
    return np.array(vectors, dtype=np.float64).reshape(-1, 3)


def _axes(normal: Floats) -> tuple[Floats, Floats]:
    """Unit vectors to the right and down on a surface, as seen from the front."""
    forward = -normal
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    return right, np.cross(forward, right)
