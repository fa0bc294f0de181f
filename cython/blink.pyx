"""Kernels of robotd.vision.blink: the numpy functions beside them there say what each does.

Pixels are averaged in cells of 2x2 and cells summed in apertures of 2x2, because a light of about one pixel sigma
keeps most of its signal-to-noise ratio in a 4x4 sum, at a quarter of the work.
"""

from libc.math cimport fabs, sqrt
from libc.stdint cimport int8_t, int16_t, int32_t, uint8_t, uint16_t
from libc.string cimport memcpy


cdef enum:
    LIMIT = 16  # of a change: 4 grey levels over an aperture; a label as weak as that still counts in full
    SHIFT_ROUNDS = 5
    PARTS = 6  # of what is taken off light curves, at most

cdef double AGREE_PX = 0.1  # a tile that is further off has somebody in it
cdef double BETTER = 0.9  # a shift must explain the tiles so much better than none
cdef double QUIET_PX = 0.03  # what noise and passers-by make of a camera that stands still


cdef inline int16_t _clipped(int16_t value) noexcept nogil:
    value = LIMIT if value > LIMIT else value
    return -LIMIT if value < -LIMIT else value


cdef void _cell_row(const uint8_t* top, const uint8_t* bottom, uint8_t* out, Py_ssize_t columns) noexcept nogil:
    cdef Py_ssize_t j
    for j in range(columns):
        out[j] = <uint8_t>(
            (<uint16_t>(top[2 * j] + top[2 * j + 1]) + <uint16_t>(bottom[2 * j] + bottom[2 * j + 1]) + 2) >> 2
        )


cdef void _difference_row(
    const uint8_t* now0, const uint8_t* now1, const uint8_t* old0, const uint8_t* old1, int8_t* out, Py_ssize_t columns
) noexcept nogil:
    cdef Py_ssize_t j
    cdef int16_t new, old
    for j in range(columns - 1):
        new = <int16_t>(now0[j] + now0[j + 1] + now1[j] + now1[j + 1])
        old = <int16_t>(old0[j] + old0[j + 1] + old1[j] + old1[j + 1])
        out[j] = <int8_t>_clipped(<int16_t>(new - old))


cdef void _moved_row(
    const uint8_t* now0,
    const uint8_t* now1,
    const uint8_t* old0,
    const uint8_t* old1,
    const int16_t* down,
    const int16_t* right,
    int16_t move_down,
    int16_t move_right,
    int8_t* out,
    Py_ssize_t columns,
) noexcept nogil:
    cdef Py_ssize_t j
    cdef int16_t new, old, moved
    for j in range(columns - 1):
        new = <int16_t>(now0[j] + now0[j + 1] + now1[j] + now1[j + 1])
        old = <int16_t>(old0[j] + old0[j + 1] + old1[j] + old1[j + 1])
        moved = <int16_t>((<int32_t>down[j] * move_down) >> 16)
        moved += <int16_t>((<int32_t>right[j] * move_right) >> 16)
        moved += 1  # because both were rounded down
        out[j] = <int8_t>_clipped(<int16_t>(new - old + moved))


cdef void _alternation_row(const int8_t* now, const int8_t* old, int16_t* total, Py_ssize_t columns) noexcept nogil:
    cdef Py_ssize_t j
    for j in range(columns - 1):
        total[j] = <int16_t>(total[j] - <int16_t>(now[j] * old[j]))


def sum_cells(const uint8_t[:, ::1] image, uint8_t[:, ::1] cells, Py_ssize_t before, Py_ssize_t after):
    cdef Py_ssize_t rows = cells.shape[0] - before - after, columns = cells.shape[1] - before - after, i, j
    cdef Py_ssize_t whole = cells.shape[1]
    cdef uint8_t* row
    with nogil:
        for i in range(rows):
            row = &cells[before + i, 0]
            _cell_row(&image[2 * i, 0], &image[2 * i + 1, 0], row + before, columns)
            for j in range(before):
                row[j] = row[before]
            for j in range(before + columns, before + columns + after):
                row[j] = row[before + columns - 1]
        for i in range(before):
            memcpy(&cells[i, 0], &cells[before, 0], whole)
        for i in range(before + rows, before + rows + after):
            memcpy(&cells[i, 0], &cells[before + rows - 1, 0], whole)


def accumulate(
    const uint8_t[:, ::1] cells,
    const uint8_t[:, ::1] lagged,
    const int16_t[:, ::1] down,
    const int16_t[:, ::1] right,
    int move_down,
    int move_right,
    int8_t[:, ::1] difference,
    const int8_t[:, ::1] lagged_difference,
    int16_t[:, ::1] total,
    Py_ssize_t before,
):
    cdef Py_ssize_t rows = total.shape[0], columns = total.shape[1], i, k
    with nogil:
        for i in range(rows - 1):
            k = before + i
            if move_down == 0 and move_right == 0:
                _difference_row(
                    &cells[k, before],
                    &cells[k + 1, before],
                    &lagged[k, before],
                    &lagged[k + 1, before],
                    &difference[i, 0],
                    columns,
                )
            else:
                _moved_row(
                    &cells[k, before],
                    &cells[k + 1, before],
                    &lagged[k, before],
                    &lagged[k + 1, before],
                    &down[i, 0],
                    &right[i, 0],
                    <int16_t>move_down,
                    <int16_t>move_right,
                    &difference[i, 0],
                    columns,
                )
            _alternation_row(&difference[i, 0], &lagged_difference[i, 0], &total[i, 0], columns)


def rate_block(
    const int16_t[:, ::1] sums, const float[:, ::1] middle, const float[:, ::1] rate, int low, int high, int8_t[:, ::1] out
):
    cdef Py_ssize_t rows = sums.shape[0], columns = sums.shape[1], tiles = middle.shape[0], i, j, k
    cdef float value, least = low, most = high
    cdef const int16_t* values
    cdef const float* usual
    cdef const float* scale
    with nogil:
        for i in range(rows):
            k = i // (rows // tiles)
            k = tiles - 1 if k >= tiles else k
            values = &sums[i, 0]
            usual = &middle[k, 0]
            scale = &rate[k, 0]
            for j in range(columns):
                value = (values[j] - usual[j]) * scale[j]
                value = most if value > most else value
                value = least if value < least else value
                out[i, j] = <int8_t>value


def add_block(const int8_t[:, ::1] rated, const float[:, ::1] weight, float[:, ::1] total):
    cdef Py_ssize_t rows = rated.shape[0], columns = rated.shape[1], tiles = weight.shape[0], i, j, k
    cdef const int8_t* values
    cdef const float* counts
    cdef float* sums
    with nogil:
        for i in range(rows):
            k = i // (rows // tiles)
            k = tiles - 1 if k >= tiles else k
            values = &rated[i, 0]
            counts = &weight[k, 0]
            sums = &total[i, 0]
            for j in range(columns):
                sums[j] += counts[j] * values[j]


def shift_moments(
    const uint8_t[:, ::1] cells,
    const int16_t[:, ::1] reference,
    const int16_t[:, ::1] down,
    const int16_t[:, ::1] right,
    Py_ssize_t before,
    Py_ssize_t step,
    float[:, :, ::1] moments,
):
    cdef Py_ssize_t rows = moments.shape[0], columns = moments.shape[1], i, j, a, b
    cdef Py_ssize_t high = reference.shape[0] // rows, wide = reference.shape[1] // columns
    cdef const uint8_t* top
    cdef const uint8_t* bottom
    cdef const int16_t* old
    cdef const int16_t* gx
    cdef const int16_t* gy
    cdef int32_t change, x, y, d
    with nogil:
        moments[:, :, :] = 0
        for a in range(rows):
            i = a * high
            while i < (a + 1) * high:
                for b in range(columns):
                    top = &cells[before + i, before + b * wide]
                    bottom = &cells[before + i + 1, before + b * wide]
                    old = &reference[i, b * wide]
                    gx = &right[i, b * wide]
                    gy = &down[i, b * wide]
                    x = 0
                    y = 0
                    d = 0
                    for j in range(wide):
                        change = 4 * (<int32_t>top[j] + top[j + 1] + bottom[j] + bottom[j + 1]) - 2 - old[j]  # means are rounded up
                        x += gx[j] * change
                        y += gy[j] * change
                        d += change
                    moments[a, b, 0] += <float>x
                    moments[a, b, 1] += <float>y
                    moments[a, b, 2] += <float>d
                i += step


def agreed_shift(const float[:, ::1] moments, const double[:, ::1] tiles):
    cdef Py_ssize_t count = tiles.shape[0], turn, k
    cdef double a, b, c, p, q, determinant, u = 0.0, v = 0.0, x, y, miss, still, scale, weight
    cdef double missed = 0.0, unmoved = 0.0
    with nogil:
        for turn in range(SHIFT_ROUNDS + 1):
            a = b = c = p = q = missed = unmoved = 0.0
            for k in range(count):
                x = moments[k, 0] - tiles[k, 3] * moments[k, 2]
                y = moments[k, 1] - tiles[k, 4] * moments[k, 2]
                scale = 1.0 / (AGREE_PX * (tiles[k, 0] + tiles[k, 2]) + 1.0)
                still = scale * sqrt(x * x + y * y)
                unmoved += still if still < 1.0 else 1.0
                weight = 1.0
                if turn > 0:
                    miss = x - tiles[k, 0] * u - tiles[k, 1] * v
                    still = y - tiles[k, 1] * u - tiles[k, 2] * v
                    miss = scale * sqrt(miss * miss + still * still)
                    missed += miss if miss < 1.0 else 1.0
                    weight = 1.0 / (1.0 + miss * miss)
                a += weight * tiles[k, 0]
                b += weight * tiles[k, 1]
                c += weight * tiles[k, 2]
                p += weight * x
                q += weight * y
            if turn == SHIFT_ROUNDS:
                break
            determinant = a * c - b * b
            if determinant <= 1e-3 * a * c or a * c <= 0.0:
                u = v = 0.0
                break
            u = (c * p - b * q) / determinant
            v = (a * q - b * p) / determinant
            if fabs(u) < QUIET_PX and fabs(v) < QUIET_PX:
                u = v = 0.0
                break
        if missed > BETTER * unmoved:
            u = v = 0.0
    return u, v


cdef inline void _order(float* low, float* high) noexcept nogil:
    cdef float a = low[0], b = high[0]
    low[0] = a if a < b else b
    high[0] = b if a < b else a


cdef inline void _sort8(float* x) noexcept nogil:
    """Batcher's network, because branches that cannot be predicted cost more than comparisons."""
    _order(x, x + 1); _order(x + 2, x + 3); _order(x + 4, x + 5); _order(x + 6, x + 7)
    _order(x, x + 2); _order(x + 1, x + 3); _order(x + 4, x + 6); _order(x + 5, x + 7)
    _order(x + 1, x + 2); _order(x + 5, x + 6)
    _order(x, x + 4); _order(x + 1, x + 5); _order(x + 2, x + 6); _order(x + 3, x + 7)
    _order(x + 2, x + 4); _order(x + 3, x + 5)
    _order(x + 1, x + 2); _order(x + 3, x + 4); _order(x + 5, x + 6)


def aperture_series(
    const uint8_t[:, :, ::1] ring,
    const Py_ssize_t[::1] order,
    const Py_ssize_t[::1] rows,
    const Py_ssize_t[::1] columns,
    const float[::1] light,
    float[:, ::1] values,
    float[:, ::1] levels,
):
    cdef Py_ssize_t n = rows.shape[0], frames = order.shape[0], c, f, i, j, k, m
    cdef const uint8_t* cell
    cdef Py_ssize_t stride = ring.shape[2]
    cdef float side[8]
    cdef float level
    with nogil:
        for f in range(frames):
            for c in range(n):
                i = rows[c]
                j = columns[c]
                cell = &ring[order[f], i, j]
                for k in range(8):
                    side[k] = 0
                for k in range(4):  # the four sides of the 8x8 cells around the aperture, in two parts each
                    m = k - 3
                    side[0] += light[cell[-3 * stride + m]]
                    side[1] += light[cell[m * stride + 4]]
                    side[2] += light[cell[4 * stride + 1 - m]]
                    side[3] += light[cell[(1 - m) * stride - 3]]
                for k in range(3):
                    m = k + 1
                    side[4] += light[cell[-3 * stride + m]]
                    side[5] += light[cell[m * stride + 4]]
                    side[6] += light[cell[4 * stride + 1 - m]]
                    side[7] += light[cell[(1 - m) * stride - 3]]
                for k in range(4):
                    side[k] *= 0.25
                    side[k + 4] *= <float>(1.0 / 3.0)
                _sort8(side)
                level = <float>0.25 * (side[2] + side[3] + side[4] + side[5])
                levels[c, f] = level
                values[c, f] = (
                    light[cell[0]] + light[cell[1]] + light[cell[stride]] + light[cell[stride + 1]] - 4 * level
                )


def cut_patches(
    const uint8_t[:, ::1] image, const Py_ssize_t[::1] rows, const Py_ssize_t[::1] columns, uint8_t[:, :, ::1] patches
):
    cdef Py_ssize_t n = rows.shape[0], height = patches.shape[1], width = patches.shape[2], c, i
    with nogil:
        for c in range(n):
            for i in range(height):
                memcpy(&patches[c, i, 0], &image[rows[c] + i, columns[c]], width)


def project_runs(
    const float[:, ::1] values,
    const float[:, ::1] weights,
    const float[:, :, ::1] nuisance,
    const float[:, ::1] waves,
    const Py_ssize_t[::1] first,
    const Py_ssize_t[::1] last,
    float[:, ::1] projection,
    float[:, :, ::1] sums,
    float[:, ::1] squares,
):
    cdef Py_ssize_t n = values.shape[0], frames = values.shape[1], parts = nuisance.shape[1], c, f, k, b
    cdef float value
    with nogil:
        projection[:, :] = 0
        sums[:, :, :] = 0
        squares[:, :] = 0
        for c in range(n):
            for f in range(frames):
                if weights[c, f] > 0:
                    value = values[c, f]
                    for k in range(first[f], last[f]):
                        projection[c, k] += value * waves[f, k]
                        squares[c, k] += waves[f, k] * waves[f, k]
                    for b in range(parts):
                        value = nuisance[c, b, f]
                        for k in range(first[f], last[f]):
                            sums[c, b, k] += value * waves[f, k]


def best_runs(
    const float[:, ::1] projection,
    const float[:, :, ::1] sums,
    const float[:, ::1] squares,
    Py_ssize_t step,
    const float[::1] frames,
    float least,
    float[::1] gain,
    Py_ssize_t[::1] start,
    Py_ssize_t[::1] periods,
    float[::1] light,
):
    cdef Py_ssize_t n = projection.shape[0], starts = projection.shape[1], parts = sums.shape[1], c, g, k, h, b
    cdef float product, square, norm, value
    cdef float total[PARTS]
    with nogil:
        for c in range(n):
            gain[c] = 0
            start[c] = 0
            periods[c] = 2
            light[c] = 0
            for g in range(starts - step):
                product = projection[c, g]
                square = squares[c, g]
                for b in range(parts):
                    total[b] = sums[c, b, g]
                k = 1
                h = g + step
                while h < starts:
                    product += projection[c, h]
                    square += squares[c, h]
                    norm = square
                    for b in range(parts):
                        total[b] += sums[c, b, h]
                        norm -= total[b] * total[b]
                    k += 1
                    h += step
                    if product > 0:
                        norm = norm if norm > least * frames[c] else least * frames[c]
                        value = product * product / norm
                        if value > gain[c]:
                            gain[c] = value
                            start[c] = g
                            periods[c] = k
                            light[c] = product / norm
