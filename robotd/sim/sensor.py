"""Ray casting, walkers, lights and noise of the simulated rig: the numpy reference of `robotd.sim._sensor`.

The kernel does the same many times faster; these functions define what it does, test it, and stand in for it where it
was not built. Arrays that a function fills or changes are named in its description.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..records import Floats

Image = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Boxes = NDArray[np.int32]

TILE = 16  # rows and columns of the boxes in which walkers are painted
BLOCK = 4  # rows and columns of texels whose greatest coverage is known
UNITY = 16384  # row gain of 1
DN_STEPS = 64  # steps of a level per grey level
SIGMA_STEPS = 32  # steps of a deviation per grey level


def _nearest(quads: Floats, origins: Floats, rays: Floats, limit: Floats) -> tuple[Ints, Floats, Floats, Floats]:
    """First quad hit from its front by each ray: index or -1, distance in ray lengths, and where in the quad (m)."""
    index = np.full(len(rays), -1)
    t_best, a_best, b_best = limit.copy(), np.zeros(len(rays)), np.zeros(len(rays))
    for k, quad in enumerate(quads):
        slope = rays @ quad[9:12]
        front = slope < -1e-12
        away = origins - quad[:3]
        t = np.divide(-(away @ quad[9:12]), slope, out=np.full(len(rays), np.inf), where=front)
        hit = np.flatnonzero((t > 1e-9) & (t < t_best))
        at = away[hit] + t[hit, None] * rays[hit]
        a, b = at @ quad[3:6], at @ quad[6:9]
        inside = (a >= 0.0) & (a <= quad[12]) & (b >= 0.0) & (b <= quad[13])
        hit = hit[inside]
        index[hit], t_best[hit], a_best[hit], b_best[hit] = k, t[hit], a[inside], b[inside]
    return index, t_best, a_best, b_best


def _sample(textures: Ints, texels: NDArray[np.uint16], index: Ints, a: Floats, b: Floats, footprint: Floats) -> Floats:
    """Bilinear texels of pictures `index` at a, b in 0..1, from the level that fits `footprint` (texels of level 0)."""
    offset, w, h, levels = textures[index].T.copy()
    level, size = np.ones(len(index), np.int64), footprint.copy()
    while True:
        coarser = (size > 1.5) & (level < levels)
        if not coarser.any():
            break
        offset = np.where(coarser, offset + w * h, offset)
        w, h = (np.where(coarser, np.maximum(n // 2, 1), n) for n in (w, h))
        size, level = np.where(coarser, 0.5 * size, size), level + coarser
    fx, fy = np.clip(a * w - 0.5, 0.0, w - 1.0), np.clip(b * h - 0.5, 0.0, h - 1.0)
    x, y = fx.astype(np.int64), fy.astype(np.int64)
    x1, y1 = np.minimum(x + 1, w - 1), np.minimum(y + 1, h - 1)
    fx, fy = fx - x, fy - y
    top = texels[offset + y * w + x] * (1.0 - fx) + texels[offset + y * w + x1] * fx
    bottom = texels[offset + y1 * w + x] * (1.0 - fx) + texels[offset + y1 * w + x1] * fx
    return np.asarray(top * (1.0 - fy) + bottom * fy)


def trace(
    quads: Floats,
    textures: Ints,
    texels: NDArray[np.uint16],
    unit: float,
    empty: float,
    T_store_camera: Floats,
    rays: Image,
    radiance: Image,
    depth: Image,
) -> None:
    """Render what stands still: four rays a pixel, one bounce in glossy quads.

    Parameters
    ----------
    quads, textures, texels, unit
        See `robotd.sim.scene.Scene`.
    empty : float
        Radiance of rays that hit nothing.
    T_store_camera : (4, 4) array
    rays : (H + 1, W + 1, 2) float32 array
        x/z and y/z in camera axes of the pixels' corners.
    radiance, depth : (H, W) float32 arrays
        Filled: mean of the four rays, and the nearest z of them in metres.
    """
    height, width = radiance.shape
    rotation, origin = T_store_camera[:3, :3], T_store_camera[:3, 3]
    spread = 0.5 * abs(float(rays[height // 2, width // 2 + 1, 0]) - float(rays[height // 2, width // 2, 0]))
    for row in range(height):
        total, first = np.zeros(width), np.full(width, 1e9)
        for b in (0.25, 0.75):
            for a in (0.25, 0.75):
                edge = (1.0 - b) * rays[row].astype(np.float64) + b * rays[row + 1]
                xy = (1.0 - a) * edge[:-1] + a * edge[1:]
                d = np.column_stack([xy, np.ones(width)]) @ rotation.T
                value, t = _along(quads, textures, texels, np.tile(origin, (width, 1)), d, spread, empty / unit)
                total += value
                first = np.minimum(first, t)
        radiance[row] = 0.25 * total * unit
        depth[row] = first


def _along(
    quads: Floats, textures: Ints, texels: NDArray[np.uint16], o: Floats, d: Floats, spread: float, empty: float
) -> tuple[Floats, Floats]:
    index, t, a, b = _nearest(quads, o, d, np.full(len(d), 1e9))
    values = np.full(len(d), empty)
    hit = np.flatnonzero(index >= 0)
    quad = quads[index[hit]]
    slope = np.einsum("ij,ij->i", quad[:, 9:12], d[hit])
    slant = np.maximum(-slope / np.linalg.norm(d[hit], axis=1), 0.05)
    per_metre = textures[index[hit], 1] / quad[:, 12]
    values[hit] = _sample(
        textures,
        texels,
        index[hit],
        a[hit] / quad[:, 12],
        b[hit] / quad[:, 13],
        t[hit] * spread / np.sqrt(slant) * per_metre,
    )
    glossy = quad[:, 14] > 0.0
    if glossy.any():
        rays, panel = hit[glossy], quad[glossy]
        start = o[rays] + t[rays, None] * d[rays]
        back = d[rays] - 2.0 * slope[glossy, None] * panel[:, 9:12]
        other, t2, a2, b2 = _nearest(quads, start, back, np.full(len(rays), 1e9))
        reflected = np.full(len(rays), empty)
        k = np.flatnonzero(other >= 0)
        seen = quads[other[k]]
        reflected[k] = _sample(
            textures,
            texels,
            other[k],
            a2[k] / seen[:, 12],
            b2[k] / seen[:, 13],
            (t[rays][k] + t2[k]) * spread * textures[other[k], 1] / seen[:, 12],
        )
        values[rays] = (1.0 - panel[:, 14]) * values[rays] + panel[:, 14] * reflected
    return values, t


def visible(quads: Floats, origins: Floats, targets: Floats, out: Bytes) -> None:
    """Fill `out` (N,) with 1 where no quad stands between origins and targets (N, 3), both 1 mm into free air."""
    step = targets - origins
    length = np.linalg.norm(step, axis=1)
    far = length > 0.002
    d = step / np.maximum(length, 1e-12)[:, None]
    index, *_ = _nearest(quads, origins + 0.001 * d, d, length - 0.002)
    out[:] = ~far | (index < 0)


class _Board:
    """A walker as seen from one point: an upright picture that faces that point."""

    def __init__(self, walker: Floats, x: float, y: float) -> None:
        step = walker[:2] - (x, y)
        self.distance = float(np.hypot(*step))
        self.ahead = step / max(self.distance, 1e-9)
        self.right = np.array([self.ahead[1], -self.ahead[0]])
        self.drift = float(walker[2:4] @ self.right)
        speed = float(np.hypot(*walker[2:4]))
        side = abs(self.drift) / speed if speed > 1e-9 else 0.0
        self.picture = int(walker[6]) * 3 + (0 if side < 0.35 else 1 if side < 0.8 else 2)
        self.height, self.light, self.half = walker[4], walker[5], walker[8]
        self.person = int(walker[7])

    def places(self, level: Ints, s: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Columns and rows of a picture at `s` to the right of the middle and `z` above the floor, metres."""
        across = s / (2.0 * self.half)
        across = 0.5 - across if self.drift < 0.0 else 0.5 + across
        return across * level[2] - 0.5, (1.0 - z / self.height) * level[1] - 0.5

    def blocks(self, cover: Bytes, level: Ints) -> Bytes:
        """Greatest coverage in the blocks of its picture."""
        h, w = int(level[1]) // BLOCK, int(level[2]) // BLOCK
        first = int(level[0]) // BLOCK**2 + (self.person * int(level[3]) + self.picture) * h * w
        return cover[first : first + h * w].reshape(h, w)

    def look(self, sprites: Bytes, level: Ints, fx: Floats, fy: Floats) -> tuple[Floats, Floats]:
        """Coverage and radiance at places of its picture."""
        h, w = int(level[1]), int(level[2])
        inside = (fx >= 0.0) & (fy >= 0.0) & (fx < w - 1.0) & (fy < h - 1.0)
        fx, fy = np.where(inside, fx, 0.0), np.where(inside, fy, 0.0)
        first = int(level[0]) + (self.person * int(level[3]) + self.picture) * h * w
        picture = sprites[2 * first : 2 * (first + h * w)].reshape(h, w, 2).astype(np.float64)
        x, y = fx.astype(np.int64), fy.astype(np.int64)
        fx, fy = (fx - x)[..., None], (fy - y)[..., None]
        value = (1.0 - fy) * ((1.0 - fx) * picture[y, x] + fx * picture[y, x + 1])
        value += fy * ((1.0 - fx) * picture[y + 1, x] + fx * picture[y + 1, x + 1])
        return np.where(inside, value[..., 0] / 255.0, 0.0), value[..., 1] / 255.0 * self.light


def reach(depth: Image) -> Image:
    """Nearest and farthest depth in every tile, (rows, columns, 2)."""
    rows, columns = (np.arange(0, size, TILE) for size in depth.shape)
    return np.stack(
        [ends.reduceat(ends.reduceat(depth, rows), columns, axis=1) for ends in (np.minimum, np.maximum)], axis=-1
    )


def paint_walkers(
    linear: Image,
    depth: Image,
    reach: Image,
    rays: Image,
    T_store_camera: Floats,
    walkers: Floats,
    sprites: Bytes,
    levels: Ints,
    cover: Bytes,
    row_time: float,
    boxes: Boxes,
) -> int:
    """Paint the passers-by into `linear` where they are nearer than `depth`, moving on by `row_time` with every row.

    Parameters
    ----------
    linear : (H, W) float32 array
        Radiance, changed.
    depth, rays, T_store_camera
        As in `trace`.
    reach : (rows, columns, 2) float32 array
        See the function of that name.
    walkers, sprites, levels, cover
        As in `robotd.sim.walker.Crowd`.
    row_time : float
        Seconds between two rows.
    boxes : (N, 4) int32 array
        Filled: first row, end row, first column, end column of the areas that were painted.

    Returns
    -------
    int
        How many boxes there are.
    """
    height, width = linear.shape
    rows, columns = (np.array([*range(0, size, TILE), size]) for size in (height, width))
    corners = rays[rows][:, columns].astype(np.float64)
    d = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=-1) @ T_store_camera[:3, :3].T
    origin = T_store_camera[:3, 3]
    pixel = abs(float(rays[height // 2, width // 2 + 1, 0]) - float(rays[height // 2, width // 2, 0]))
    used = 0
    for walker in walkers:
        board = _Board(walker, origin[0], origin[1])
        if board.distance < 0.15:
            continue
        k = 0
        while k + 1 < len(levels) and pixel * board.distance * levels[k, 1] > 1.5 * board.height:
            k += 1
        along = d[..., :2] @ board.ahead
        ahead = along > 0.02
        t = board.distance / np.where(ahead, along, 1.0)
        s = t * (d[..., :2] @ board.right) - board.drift * row_time * rows[:, None]
        z = origin[2] + t * d[..., 2]
        fx, fy = board.places(levels[k], s, z)
        blocks = board.blocks(cover, levels[k])
        for i, j in np.ndindex(len(rows) - 1, len(columns) - 1):
            part = slice(i, i + 2), slice(j, j + 2)
            if not ahead[part].all() or used >= len(boxes) or t[part].min() >= reach[i, j, 1]:
                continue
            span = [
                slice(max(int(place[part].min()), 0) // BLOCK, int(max(place[part].max(), -1.0)) // BLOCK + 1)
                for place in (fy, fx)
            ]
            if not blocks[span[0], span[1]].any():
                continue
            area = slice(rows[i], rows[i + 1]), slice(columns[j], columns[j + 1])
            inner = [_between(values[part], depth[area].shape) for values in (fx, fy, t)]
            alpha, light = board.look(sprites, levels[k], inner[0], inner[1])
            alpha = np.where(inner[2] < depth[area], alpha, 0.0)
            linear[area] += alpha * (light - linear[area])
            r, c = np.nonzero(alpha)
            if len(r):
                boxes[used] = np.array([r.min(), r.max() + 1, c.min(), c.max() + 1]) + np.repeat(
                    [rows[i], columns[j]], 2
                )
                used += 1
    return used


def _between(corners: Floats, shape: tuple[int, ...]) -> Floats:
    """Bilinear values at the pixels of a tile: bent by less than a millimetre at the distance of a person."""
    down, across = ((np.arange(size) + 0.5) / size for size in shape)
    edge = corners[0] + down[:, None] * (corners[1] - corners[0])
    return np.asarray(edge[:, :1] + across * (edge[:, 1:] - edge[:, :1]))


def on_share(t0: Floats, t1: Floats, frequency: Floats, duty: Floats) -> Floats:
    """Share of [t0, t1] in which a light that blinks at `frequency` with this `duty` is on."""
    turns0, turns1 = t0 * frequency, t1 * frequency
    on = (np.floor(turns1) - np.floor(turns0)) * duty + np.minimum(turns1 % 1.0, duty) - np.minimum(turns0 % 1.0, duty)
    return np.asarray(np.where(frequency > 0.0, on / np.maximum(turns1 - turns0, 1e-12), 1.0))


def shine(
    light: Floats,
    pick: Ints,
    blink: Floats,
    ends: Floats,
    peak: Floats,
    t: float,
    exposure: float,
    row_time: float,
    strength: Floats,
) -> None:
    """Fill `strength` (2, N) with `peak` (N,) times the share of the exposure in which each light is on.

    Parameters
    ----------
    light, pick : (M,) and (2, N) arrays
        Shares, and which of them hold in the first and last row of each light's box; -1 for one that blinks by itself.
    blink, ends : (N, 2) arrays
        Frequency and duty of those; first and last row of the boxes.
    t, exposure, row_time : float
        Begin of row 0's exposure, its length, and seconds between two rows.
    """
    begin = t + row_time * ends.T
    own = on_share(begin, begin + exposure, *blink.T)
    picked = light[np.maximum(pick, 0)] if len(light) else own
    strength[:] = np.where(pick >= 0, picked, own) * peak


def transmission(
    origins: Floats,
    targets: Floats,
    delays: Floats,
    spots: Ints,
    walkers: Floats,
    sprites: Bytes,
    levels: Ints,
    strength: Floats,
) -> None:
    """Weaken `strength` (2, M) of lights by what walkers let through on the legs of their way to the camera.

    Leg k leads from `targets` to `origins` (N, 3), `delays` s after row 0, and belongs to light `spots[k]`.
    """
    for k in range(len(origins)):
        step = targets[k] - origins[k]
        for walker in walkers:
            board = _Board(walker, origins[k, 0], origins[k, 1])
            reach = float(step[:2] @ board.ahead)
            if board.distance < 0.15 or reach <= board.distance:
                continue
            t = board.distance / reach
            s = t * float(step[:2] @ board.right) - board.drift * delays[k]
            place = board.places(levels[0], np.array([s]), np.array([origins[k, 2] + t * step[2]]))
            strength[:, spots[k]] *= 1.0 - board.look(sprites, levels[0], *place)[0][0]


def add_lights(
    linear: Image, boxes: Boxes, across: Image, down: Image, strength: Floats, gain: NDArray[np.float32], changed: Boxes
) -> int:
    """Add point lights to `linear`: strength times down times across, divided by the rows' lamp gain.

    `strength` (2, N) is that of the first and last row of each box, straight in between, because the rows are exposed
    one after the other; `across`, `down` (N, M) are the spread function's two factors. Returns how many of the boxes
    are not dark; they are written to `changed`.
    """
    bright = np.flatnonzero(strength.max(axis=0, initial=0.0) > 1e-5)
    for k in bright:
        r0, r1, c0, c1 = boxes[k]
        along = strength[0, k] + (strength[1, k] - strength[0, k]) * np.arange(r1 - r0) / max(r1 - r0 - 1, 1)
        row = along * down[k, : r1 - r0] / gain[r0:r1]
        linear[r0:r1, c0:c1] += (row[:, None] * across[k, : c1 - c0]).astype(np.float32)
    changed[: len(bright)] = boxes[bright]
    return len(bright)


def _noise(bank: NDArray[np.int8], mask: int, seed: int, rows: Ints, columns: slice) -> NDArray[np.int32]:
    """Noise of some rows: each begins at a place of its own in the bank (splitmix64, Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + (rows.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        start = ((z ^ (z >> np.uint64(31))) & np.uint64(mask)).astype(np.int64)
    return bank[start[:, None] + np.arange(columns.start, columns.stop)].astype(np.int32)


def expose(
    level: NDArray[np.int16],
    sigma: Bytes,
    gain: NDArray[np.int32],
    bank: NDArray[np.int8],
    mask: int,
    seed: int,
    out: Bytes,
) -> None:
    """Turn an encoded picture into one noisy exposure of it.

    Parameters
    ----------
    level : (H, W) int16 array
        Grey levels times 64.
    sigma : (H, W) uint8 array
        Noise in grey levels times 32.
    gain : (H,) int32 array
        Of each row, in encoded levels, times 16384.
    bank, mask, seed
        Normal samples times 32; their number less one (a power of two); decides where the rows begin.
    out : (H, W) uint8 array
        Filled.
    """
    height, width = level.shape
    noise = _noise(bank, mask, seed, np.arange(height), slice(0, width))
    scaled = np.where(gain[:, None] == UNITY, level, np.minimum((level.astype(np.int32) * gain[:, None]) >> 14, 24000))
    out[:] = np.clip((scaled + ((sigma.astype(np.int32) * noise) >> 4) + 32) >> 6, 0, 255)


def retouch(
    linear: Image,
    still: Image,
    boxes: Boxes,
    code_of: NDArray[np.int32],
    scale: float,
    gain: NDArray[np.float32],
    bank: NDArray[np.int8],
    mask: int,
    seed: int,
    out: Bytes,
) -> None:
    """Expose the boxes of `linear` again, which walkers and lights changed, and set them back to `still`.

    `code_of` is a table by radiance times `scale`, of levels times 256 plus deviations; `gain` (H,) is linear here.
    """
    for r0, r1, c0, c1 in boxes:
        value = linear[r0:r1, c0:c1] * (np.float32(scale) * gain[r0:r1, None]).astype(np.float32)
        code = code_of[np.minimum(value, len(code_of) - 1).astype(np.int32)]
        noise = _noise(bank, mask, seed, np.arange(r0, r1), slice(int(c0), int(c1)))
        levels = (code >> 8) + (((code & 255) * noise) >> 4)
        out[r0:r1, c0:c1] = np.clip((levels + 32) >> 6, 0, 255)
    for r0, r1, c0, c1 in boxes:
        linear[r0:r1, c0:c1] = still[r0:r1, c0:c1]
