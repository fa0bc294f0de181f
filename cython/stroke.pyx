"""Kernels of robotd.vision.stroke: thin edges, and strokes between opposite edges.

Their plain versions are in robotd/vision/stroke_reference.py, which also says what each one computes.
"""

from libc.math cimport fabsf, sqrtf
from libc.stdlib cimport free, malloc
from libc.string cimport memcpy, memset

cdef enum:
    BLOCK = 32  # px, side of the squares that have each a threshold of their own


cdef inline int _sector(float x, float y) noexcept nogil:
    """Which of 16 equal sectors a direction lies in, counted from the one after +u towards +v."""
    cdef float wide = fabsf(x), high = fabsf(y)
    cdef int part
    if high <= wide:
        part = 0 if high < 0.41421356 * wide else 1
    else:
        part = 2 if wide > 0.41421356 * high else 3
    if x >= 0.0:
        return part if y >= 0.0 else 15 - part
    return 7 - part if y >= 0.0 else 8 + part


def edges(
    const short[:, ::1] gx,
    const short[:, ::1] gy,
    const unsigned char[:, ::1] valid,
    float factor,
    float low,
    float high,
    float[:, ::1] level,
    int[:, ::1] index,
    unsigned char[:, ::1] sector,
    float[:, ::1] out,
):
    cdef Py_ssize_t height = gx.shape[0], width = gx.shape[1], row, col, at, side, capacity = out.shape[0], stop, i, j
    cdef Py_ssize_t rows = level.shape[0], columns = level.shape[1] // 3
    cdef unsigned long long eight
    cdef short larger
    cdef short *bound = <short *> malloc(width * sizeof(short))
    cdef const short *x
    cdef const short *y
    cdef const unsigned char *inside
    cdef int *place
    cdef unsigned char *code
    cdef int found = 0, row_sum, row_inside, square, here, least = 0
    cdef float total, pixels, middle, before, after, bend, whole, mean = 0.0
    cdef bint across, masked = valid.shape[0] > 0
    if bound == NULL:
        raise MemoryError
    with nogil:
        for i in range(rows):
            for j in range(columns):
                level[i, columns + j] = level[i, 2 * columns + j] = 0.0
        for row in range(0, height, 4):  # because every fourth row says enough
            x, y = &gx[row, 0], &gy[row, 0]
            for j in range(columns):
                stop = (j + 1) * BLOCK if j + 1 < columns else width
                row_sum = 0
                if masked:
                    inside = &valid[row, 0]
                    row_inside = 0
                    for col in range(j * BLOCK, stop):
                        row_sum += inside[col] * ((x[col] if x[col] > 0 else -x[col]) + (y[col] if y[col] > 0 else -y[col]))
                        row_inside += inside[col]
                else:
                    for col in range(j * BLOCK, stop):
                        row_sum += (x[col] if x[col] > 0 else -x[col]) + (y[col] if y[col] > 0 else -y[col])
                    row_inside = <int> (stop - j * BLOCK)
                i = row // BLOCK if row // BLOCK < rows else rows - 1
                level[i, columns + j] += <float> row_sum
                level[i, 2 * columns + j] += <float> row_inside
        total = pixels = 0.0
        for i in range(rows):
            for j in range(columns):
                total += level[i, columns + j]
                pixels += level[i, 2 * columns + j]
        # the mean over all directions of |cos| + |sin| is 4 / pi
        factor *= 0.7853982
        whole = factor * (total / (pixels if pixels > 1.0 else <float> 1.0))
        for i in range(rows):
            for j in range(columns):
                total = pixels = 0.0
                for row in range(i - 1 if i > 0 else 0, i + 2 if i + 2 <= rows else rows):
                    for col in range(j - 1 if j > 0 else 0, j + 2 if j + 2 <= columns else columns):
                        total += level[row, columns + col]
                        pixels += level[row, 2 * columns + col]
                total = factor * (total / (pixels if pixels > 1.0 else <float> 1.0))
                total = total if total < whole else whole
                level[i, j] = low if total < low else (high if total > high else total)
                mean += level[i, j]
        for row in range(height):
            x, y, code = &gx[row, 0], &gy[row, 0], &sector[row, 0]
            if row == 0 or row == height - 1:
                memset(code, 0, width)
                continue
            if row == 1 or (row % BLOCK == 0 and row // BLOCK < rows):
                for col in range(width):  # what the larger component of so long a gradient exceeds
                    j = col // BLOCK if col // BLOCK < columns else columns - 1
                    bound[col] = <short> (0.7071 * level[row // BLOCK if row // BLOCK < rows else rows - 1, j])
            for col in range(width):  # apart from what follows, because so the compiler makes it wide
                larger = x[col] if x[col] > <short> -x[col] else <short> -x[col]
                larger = y[col] if y[col] > larger else larger
                larger = <short> -y[col] if <short> -y[col] > larger else larger
                code[col] = larger > bound[col]
            code[0] = code[width - 1] = 0
        for row in range(1, height - 1):
            x, y, place, code = &gx[row, 0], &gy[row, 0], &index[row, 0], &sector[row, 0]
            i = row // BLOCK if row // BLOCK < rows else rows - 1
            col = 0
            while col < width:
                if col + 8 <= width:
                    memcpy(&eight, code + col, 8)
                    if eight == 0:
                        col += 8
                        continue
                if code[col] == 0:
                    col += 1
                    continue
                code[col] = 0
                col += 1
                at = col - 1
                here = x[at] * x[at] + y[at] * y[at]
                j = at // BLOCK if at // BLOCK < columns else columns - 1
                least = <int> (level[i, j] * level[i, j])
                if here <= least:
                    continue
                across = x[at] * x[at] >= y[at] * y[at]
                side = 1 if across else width
                square = x[at - side] * x[at - side] + y[at - side] * y[at - side]
                if square > here:
                    continue
                before = <float> square
                square = x[at + side] * x[at + side] + y[at + side] * y[at + side]
                if square >= here:
                    continue
                after = <float> square
                if masked:
                    inside = &valid[row, 0]
                    if inside[at] == 0 or inside[at - side] == 0 or inside[at + side] == 0:
                        continue
                if found >= capacity:
                    continue
                middle, before, after = sqrtf(<float> here), sqrtf(before), sqrtf(after)
                bend = 0.5 * (before - after) / (before - 2.0 * middle + after)
                out[found, 0] = <float> at + (bend if across else <float> 0.0)
                out[found, 1] = <float> row + (<float> 0.0 if across else bend)
                out[found, 2] = <float> x[at] / middle
                out[found, 3] = <float> y[at] / middle
                out[found, 4] = middle
                place[at] = found
                code[at] = <unsigned char> (1 + _sector(<float> x[at], <float> y[at]))
                found += 1
        free(bound)
    return found, mean / (rows * columns)


cdef inline int _opposite(
    const float *edge, const int *index, int i, Py_ssize_t at, float low, float high, float sign, float parallel,
) noexcept nogil:
    """The edge at a pixel if it is a partner of edge i, else -1."""
    cdef int j = index[at]
    cdef const float *one = edge + 5 * i
    cdef const float *two
    cdef float mu, mv, across
    if j < 0:
        return -1
    two = edge + 5 * j
    if one[2] * two[2] + one[3] * two[3] > -parallel:
        return -1
    mu, mv = one[2] - two[2], one[3] - two[3]
    across = sign * ((two[0] - one[0]) * mu + (two[1] - one[1]) * mv) / sqrtf(mu * mu + mv * mv)
    return j if low <= across <= high else -1


def strokes(
    const float[:, ::1] edge,
    int count,
    const int[:, ::1] index,
    const unsigned char[:, ::1] sector,
    float low,
    float high,
    float sign,
    float parallel,
    float mutual,
    int[::1] partner,
    float[:, ::1] out,
):
    cdef Py_ssize_t height = index.shape[0], width = index.shape[1], row, col, at, side, capacity = out.shape[0]
    cdef int i, j, k, step, first, last, found = 0, hit, fixed_u, fixed_v, step_u, step_v
    cdef float du, dv, major, mu, mv, norm, across, gap
    cdef bint horizontal
    cdef const float *all = &edge[0, 0]
    cdef const float *one
    cdef const float *two
    cdef const float *three
    cdef const int *pixel = &index[0, 0]
    cdef const unsigned char *code = &sector[0, 0]
    cdef unsigned int wanted  # bit 1 + s is set if an edge in sector s can be opposite
    cdef int[16] near
    cdef int sides = 2  # sectors that an opposite direction can be off: 22.5 degrees each, and one for their width
    for i in range(16):
        near[i] = 0
        for j in range(-sides, sides + 1):
            near[i] |= 1 << (1 + (i + 8 + j + 16) % 16)
    with nogil:
        for i in range(count):
            partner[i] = -1
            one = all + 5 * i
            du, dv = sign * one[2], sign * one[3]
            horizontal = fabsf(du) >= fabsf(dv)
            major = fabsf(du) if horizontal else fabsf(dv)
            du /= major
            dv /= major
            side = width if horizontal else 1
            wanted = near[_sector(one[2], one[3])]
            first = <int> (low * major) - 1
            first = 1 if first < 1 else first
            last = <int> (high * major) + 2
            # 16 bits of fraction, because rounding floats is slower than shifting
            step_u, step_v = <int> (du * 65536.0), <int> (dv * 65536.0)
            fixed_u = <int> ((one[0] + 0.5) * 65536.0) + first * step_u
            fixed_v = <int> ((one[1] + 0.5) * 65536.0) + first * step_v
            for step in range(first, last):
                col, row = fixed_u >> 16, fixed_v >> 16
                fixed_u += step_u
                fixed_v += step_v
                # edges never lie in the outermost pixels, so these need no look-up, nor do their outer neighbours
                if col < 1 or row < 1 or col >= width - 1 or row >= height - 1:
                    break
                at = row * width + col
                hit = -1
                if wanted >> code[at] & 1:
                    hit = _opposite(all, pixel, i, at, low, high, sign, parallel)
                if hit < 0 and wanted >> code[at + side] & 1:
                    hit = _opposite(all, pixel, i, at + side, low, high, sign, parallel)
                if hit < 0 and wanted >> code[at - side] & 1:
                    hit = _opposite(all, pixel, i, at - side, low, high, sign, parallel)
                if hit >= 0:
                    partner[i] = hit
                    break
        for i in range(count):
            j = partner[i]
            if j < 0 or found >= capacity:
                continue
            k = partner[j]
            if k < 0 or (k == i and j < i):
                continue
            one, two, three = all + 5 * i, all + 5 * j, all + 5 * k
            mu, mv = one[2] - two[2], one[3] - two[3]
            norm = sqrtf(mu * mu + mv * mv)
            mu /= norm
            mv /= norm
            across = sign * ((two[0] - one[0]) * mu + (two[1] - one[1]) * mv)
            gap = (three[0] - one[0]) * (three[0] - one[0]) + (three[1] - one[1]) * (three[1] - one[1])
            if gap > 4.0 and gap > mutual * mutual * across * across:
                continue
            out[found, 0] = 0.5 * (one[0] + two[0])
            out[found, 1] = 0.5 * (one[1] + two[1])
            out[found, 2] = -mv
            out[found, 3] = mu
            out[found, 4] = across
            out[found, 5] = one[4] if one[4] < two[4] else two[4]
            found += 1
    return found
