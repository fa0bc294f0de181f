"""The image sensor of the simulated rig: ray casting, walkers, lights and noise.

`robotd.sim.sensor` holds the numpy reference of every function here, with the meaning of the arguments.
"""

from libc.math cimport acos, asin, fabs, floor, sqrt
from libc.stdint cimport int8_t, int16_t, int32_t, int64_t, uint8_t, uint16_t, uint32_t, uint64_t
from libc.stdlib cimport free, malloc

cdef extern from *:
    void fetch "__builtin_prefetch"(const void* at) nogil

cdef enum:
    QUAD = 15  # numbers in a row of `quads`
    BLOCK = 4  # rows and columns of a block of `cover`


cdef inline double dot(const double* a, const double* b) noexcept nogil:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


cdef double sample(const uint16_t* texels, const int64_t* texture, double a, double b, double footprint) noexcept nogil:
    """Bilinear value of the pyramid level that fits `footprint` (texels of level 0); a, b in 0..1."""
    cdef int64_t offset = texture[0], w = texture[1], h = texture[2], level = 1
    cdef int64_t x, y, x1, y1
    cdef double fx, fy, top, bottom
    while footprint > 1.5 and level < texture[3]:
        offset += w * h
        w = w // 2 if w > 1 else 1
        h = h // 2 if h > 1 else 1
        footprint *= 0.5
        level += 1
    fx = a * w - 0.5
    fy = b * h - 0.5
    fx = 0.0 if fx < 0.0 else (w - 1.0 if fx > w - 1.0 else fx)
    fy = 0.0 if fy < 0.0 else (h - 1.0 if fy > h - 1.0 else fy)
    x = <int64_t> fx
    y = <int64_t> fy
    x1 = x + 1 if x + 1 < w else x
    y1 = y + 1 if y + 1 < h else y
    fx -= x
    fy -= y
    top = texels[offset + y * w + x] * (1.0 - fx) + texels[offset + y * w + x1] * fx
    bottom = texels[offset + y1 * w + x] * (1.0 - fx) + texels[offset + y1 * w + x1] * fx
    return top * (1.0 - fy) + bottom * fy


cdef int64_t nearest(
    const double* quads, const int32_t* chosen, int64_t count, const double* o, const double* d, double* found
) noexcept nogil:
    """Index of the first quad hit from its front with found[0] > t > 0, or -1; found becomes t, a, b."""
    cdef int64_t i, index, best = -1
    cdef const double* q
    cdef double slope, t, a, b, r0, r1, r2
    for i in range(count):
        index = chosen[i] if chosen != NULL else i
        q = quads + index * QUAD
        slope = q[9] * d[0] + q[10] * d[1] + q[11] * d[2]
        if slope >= -1e-12:
            continue
        r0 = o[0] - q[0]
        r1 = o[1] - q[1]
        r2 = o[2] - q[2]
        t = -(q[9] * r0 + q[10] * r1 + q[11] * r2) / slope
        if t <= 1e-9 or t >= found[0]:
            continue
        r0 += t * d[0]
        r1 += t * d[1]
        r2 += t * d[2]
        a = q[3] * r0 + q[4] * r1 + q[5] * r2
        if a < 0.0 or a > q[12]:
            continue
        b = q[6] * r0 + q[7] * r1 + q[8] * r2
        if b < 0.0 or b > q[13]:
            continue
        best = index
        found[0] = t
        found[1] = a
        found[2] = b
    return best


cdef double radiance_along(
    const double* quads, const int64_t* textures, const uint16_t* texels, const int32_t* chosen, int64_t count,
    int64_t total, const double* o, const double* d, double spread, double empty, double* depth
) noexcept nogil:
    """Texel value seen along a ray, with one bounce in glass; `spread` is the ray's width per unit of t."""
    cdef double found[3]
    cdef double bounce[3]
    cdef double start[3]
    cdef double direction[3]
    cdef double slope, length, value, footprint, reflected, travelled
    cdef const double* q
    cdef int64_t index, other
    found[0] = 1e9
    index = nearest(quads, chosen, count, o, d, found)
    depth[0] = found[0]
    if index < 0:
        return empty
    q = quads + index * QUAD
    slope = -dot(q + 9, d)
    length = sqrt(dot(d, d))
    slope = slope / length
    footprint = found[0] * spread / sqrt(slope if slope > 0.05 else 0.05)
    value = sample(texels, textures + 4 * index, found[1] / q[12], found[2] / q[13],
                   footprint * textures[4 * index + 1] / q[12])
    if q[14] <= 0.0:
        return value
    slope = dot(q + 9, d)
    for other in range(3):
        start[other] = o[other] + found[0] * d[other]
        direction[other] = d[other] - 2.0 * slope * q[9 + other]
    travelled = found[0]
    bounce[0] = 1e9
    other = nearest(quads, NULL, total, start, direction, bounce)
    if other < 0:
        reflected = empty
    else:
        reflected = sample(texels, textures + 4 * other, bounce[1] / quads[other * QUAD + 12],
                           bounce[2] / quads[other * QUAD + 13],
                           (travelled + bounce[0]) * spread * textures[4 * other + 1] / quads[other * QUAD + 12])
    return (1.0 - q[14]) * value + q[14] * reflected


def trace(
    const double[:, ::1] quads, const int64_t[:, ::1] textures, const uint16_t[::1] texels, double unit, double empty,
    const double[:, ::1] T_store_camera, const float[:, :, ::1] rays, float[:, ::1] radiance, float[:, ::1] depth
):
    cdef int64_t height = radiance.shape[0], width = radiance.shape[1], total = quads.shape[0]
    cdef int64_t r0, c0, r1, c1, r, c, i, count, k
    cdef double o[3]
    cdef double d[3]
    cdef double axis[3]
    cdef double corner[3]
    cdef double x, y, a, b, value, z, first, cosine, half, angle, distance, radius, spread
    cdef const double* q = &quads[0, 0]
    cdef int32_t* chosen = <int32_t*> malloc(total * sizeof(int32_t))
    cdef int32_t* facing = <int32_t*> malloc(total * sizeof(int32_t))
    cdef int64_t n_facing = 0
    if chosen == NULL or facing == NULL:
        free(chosen)
        free(facing)
        raise MemoryError
    with nogil:
        for k in range(3):
            o[k] = T_store_camera[k, 3]
        for i in range(total):  # quads are seen from the front only
            if (o[0] - q[QUAD * i]) * q[QUAD * i + 9] + (o[1] - q[QUAD * i + 1]) * q[QUAD * i + 10] \
                    + (o[2] - q[QUAD * i + 2]) * q[QUAD * i + 11] > 0.0:
                facing[n_facing] = <int32_t> i
                n_facing += 1
        # width of a sub-pixel's ray at unit depth
        spread = 0.5 * fabs(rays[height // 2, width // 2 + 1, 0] - rays[height // 2, width // 2, 0])
        for r0 in range(0, height, 32):
            r1 = min(r0 + 32, height)
            for c0 in range(0, width, 32):
                c1 = min(c0 + 32, width)
                direction(T_store_camera, rays[(r0 + r1) // 2, (c0 + c1) // 2, 0],
                          rays[(r0 + r1) // 2, (c0 + c1) // 2, 1], axis)
                unit_length(axis)
                cosine = 1.0
                for i in range(4):
                    r = r0 if i < 2 else r1
                    c = c0 if i % 2 == 0 else c1
                    direction(T_store_camera, rays[r, c, 0], rays[r, c, 1], corner)
                    unit_length(corner)
                    cosine = min(cosine, dot(axis, corner))
                half = acos(max(cosine, -1.0)) * 1.05 + 0.002
                count = 0
                for k in range(n_facing):  # keep the quads whose bounding sphere meets the tile's cone
                    i = facing[k]
                    for r in range(3):
                        corner[r] = q[QUAD * i + r] - o[r] + 0.5 * (
                            q[QUAD * i + 12] * q[QUAD * i + 3 + r] + q[QUAD * i + 13] * q[QUAD * i + 6 + r])
                    radius = 0.5 * sqrt(q[QUAD * i + 12] * q[QUAD * i + 12] + q[QUAD * i + 13] * q[QUAD * i + 13])
                    distance = sqrt(dot(corner, corner))
                    if distance > radius:
                        angle = acos(max(-1.0, min(1.0, dot(axis, corner) / distance)))
                        if angle > half + asin(radius / distance):
                            continue
                    chosen[count] = <int32_t> i
                    count += 1
                for r in range(r0, r1):
                    for c in range(c0, c1):
                        value = 0.0
                        first = 1e9
                        for i in range(4):
                            a = 0.25 if i % 2 == 0 else 0.75
                            b = 0.25 if i < 2 else 0.75
                            x = (1 - b) * ((1 - a) * rays[r, c, 0] + a * rays[r, c + 1, 0]) \
                                + b * ((1 - a) * rays[r + 1, c, 0] + a * rays[r + 1, c + 1, 0])
                            y = (1 - b) * ((1 - a) * rays[r, c, 1] + a * rays[r, c + 1, 1]) \
                                + b * ((1 - a) * rays[r + 1, c, 1] + a * rays[r + 1, c + 1, 1])
                            direction(T_store_camera, x, y, d)
                            value += radiance_along(q, &textures[0, 0], &texels[0], chosen, count, total, o, d,
                                                    spread, empty / unit, &z)
                            first = min(first, z)
                        radiance[r, c] = <float> (0.25 * value * unit)
                        depth[r, c] = <float> first
    free(chosen)
    free(facing)


cdef inline void direction(const double[:, ::1] T, double x, double y, double* d) noexcept nogil:
    d[0] = T[0, 0] * x + T[0, 1] * y + T[0, 2]
    d[1] = T[1, 0] * x + T[1, 1] * y + T[1, 2]
    d[2] = T[2, 0] * x + T[2, 1] * y + T[2, 2]


cdef inline void unit_length(double* d) noexcept nogil:
    cdef double length = sqrt(dot(d, d))
    d[0] /= length
    d[1] /= length
    d[2] /= length


def visible(const double[:, ::1] quads, const double[:, ::1] origins, const double[:, ::1] targets, uint8_t[::1] out):
    cdef int64_t i, k
    cdef double d[3]
    cdef double o[3]
    cdef double found[3]
    cdef double length
    with nogil:
        for i in range(origins.shape[0]):
            for k in range(3):
                d[k] = targets[i, k] - origins[i, k]
            length = sqrt(dot(d, d))
            out[i] = 1
            if length <= 0.002:
                continue
            for k in range(3):  # both ends may lie on a surface
                d[k] /= length
                o[k] = origins[i, k] + 0.001 * d[k]
            found[0] = length - 0.002
            out[i] = nearest(&quads[0, 0], NULL, quads.shape[0], o, d, found) < 0


include "walkers.pxi"


cdef inline double whole_turns(double turns, double duty) noexcept nogil:
    """How long a light with this duty has been on after so many turns, in turns."""
    cdef double whole = floor(turns)
    return whole * duty + min(turns - whole, duty)


def shine(
    const double[::1] light, const int64_t[:, ::1] pick, const double[:, ::1] blink, const double[:, ::1] ends,
    const double[::1] peak, double t, double exposure, double row_time, double[:, ::1] strength
):
    cdef int64_t i, k
    cdef double begin, share, frequency
    with nogil:
        for k in range(2):
            for i in range(peak.shape[0]):
                frequency = blink[i, 0]
                if pick[k, i] >= 0:
                    share = light[pick[k, i]]
                elif frequency > 0.0:
                    begin = (t + row_time * ends[i, k]) * frequency
                    share = whole_turns(begin + exposure * frequency, blink[i, 1]) - whole_turns(begin, blink[i, 1])
                    share = share / max(exposure * frequency, 1e-12)
                else:
                    share = 1.0
                strength[k, i] = share * peak[i]


def add_lights(
    float[:, ::1] linear, const int32_t[:, ::1] boxes, const float[:, ::1] across, const float[:, ::1] down,
    const double[:, ::1] strength, const float[::1] gain, int32_t[:, ::1] changed
):
    cdef int64_t i, r, c, rows, k, used = 0
    cdef double here
    cdef float row
    with nogil:
        for i in range(boxes.shape[0]):
            if strength[0, i] <= 1e-5 and strength[1, i] <= 1e-5:
                continue
            rows = boxes[i, 1] - boxes[i, 0]
            for r in range(boxes[i, 0], boxes[i, 1]):
                here = strength[0, i] + (strength[1, i] - strength[0, i]) * (r - boxes[i, 0]) / (
                    rows - 1 if rows > 1 else 1)
                row = <float> (here * down[i, r - boxes[i, 0]] / gain[r])
                for c in range(boxes[i, 2], boxes[i, 3]):
                    linear[r, c] += row * across[i, c - boxes[i, 2]]
            for k in range(4):
                changed[used, k] = boxes[i, k]
            used += 1
    return used


cdef inline uint64_t start_of_row(uint64_t seed, uint64_t row, uint64_t mask) noexcept nogil:
    """Where in the noise bank a row begins: splitmix64, Steele et al. 2014."""
    cdef uint64_t z = seed + (row + 1) * <uint64_t> 0x9E3779B97F4A7C15
    z = (z ^ (z >> 30)) * <uint64_t> 0xBF58476D1CE4E5B9
    z = (z ^ (z >> 27)) * <uint64_t> 0x94D049BB133111EB
    return (z ^ (z >> 31)) & mask


cdef void expose_row(
    const int16_t* level, const uint8_t* sigma, const int8_t* noise, uint8_t* out, int64_t width
) noexcept nogil:
    cdef int64_t c
    cdef int16_t v
    for c in range(width):
        v = <int16_t> ((<int16_t> (<int16_t> sigma[c] * <int16_t> noise[c])) >> 4)
        v = <int16_t> (v + level[c])
        v = <int16_t> (<int16_t> (v + 32) >> 6)
        v = v if v > 0 else 0
        out[c] = <uint8_t> (v if v < 255 else 255)


cdef void scale_row(const int16_t* level, int32_t gain, int16_t* out, int64_t width) noexcept nogil:
    cdef int64_t c
    cdef int32_t v
    for c in range(width):
        v = (<int32_t> level[c] * gain) >> 14
        out[c] = <int16_t> (v if v < 24000 else 24000)


def expose(
    const int16_t[:, ::1] level, const uint8_t[:, ::1] sigma, const int32_t[::1] gain, const int8_t[::1] bank,
    uint64_t mask, uint64_t seed, uint8_t[:, ::1] out
):
    cdef int64_t height = level.shape[0], width = level.shape[1], r, c
    cdef uint64_t start = start_of_row(seed, 0, mask), following
    cdef const int16_t* row
    cdef int16_t* scaled = <int16_t*> malloc(width * sizeof(int16_t))
    if scaled == NULL:
        raise MemoryError
    with nogil:
        for r in range(height):
            row = &level[r, 0]
            following = start_of_row(seed, r + 1, mask)
            for c in range(0, width, 64):  # rows begin anywhere in the bank
                fetch(&bank[following + c])
            if gain[r] != 16384:
                scale_row(row, gain[r], scaled, width)
                row = scaled
            expose_row(row, &sigma[r, 0], &bank[start], &out[r, 0], width)
            start = following
    free(scaled)


def retouch(
    float[:, ::1] linear, const float[:, ::1] still, const int32_t[:, ::1] boxes, const int32_t[::1] code_of,
    double scale, const float[::1] gain, const int8_t[::1] bank, uint64_t mask, uint64_t seed, uint8_t[:, ::1] out
):
    cdef int64_t last = code_of.shape[0] - 1, i, r, c
    cdef const int8_t* noise
    cdef float factor, value
    cdef int32_t v
    cdef uint64_t* starts = <uint64_t*> malloc(out.shape[0] * sizeof(uint64_t))
    if starts == NULL:
        raise MemoryError
    with nogil:
        for r in range(out.shape[0]):
            starts[r] = start_of_row(seed, r, mask)
        for i in range(boxes.shape[0]):
            if i + 1 < boxes.shape[0]:
                c = boxes[i + 1, 2]
                for r in range(boxes[i + 1, 0], boxes[i + 1, 1]):
                    fetch(&bank[starts[r] + c])
                    fetch(&out[r, c])
                    fetch(&still[r, c])
                    fetch(&linear[r, c])
            for r in range(boxes[i, 0], boxes[i, 1]):
                noise = &bank[starts[r]]
                factor = <float> (scale * gain[r])
                for c in range(boxes[i, 2], boxes[i, 3]):
                    value = linear[r, c] * factor
                    v = code_of[<int32_t> (value if value < last else last)]
                    v = (v >> 8) + (((v & 255) * noise[c]) >> 4)
                    v = (v + 32) >> 6
                    out[r, c] = <uint8_t> (0 if v < 0 else (255 if v > 255 else v))
        for i in range(boxes.shape[0]):
            for r in range(boxes[i, 0], boxes[i, 1]):
                for c in range(boxes[i, 2], boxes[i, 3]):
                    linear[r, c] = still[r, c]
    free(starts)
