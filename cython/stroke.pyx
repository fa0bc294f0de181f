"""Kernels of robotd.vision.stroke: thin edges, strokes between opposite edges, and tracing along stroke centres.

Their plain versions are in robotd/vision/stroke_reference.py, which also says what each one computes.
"""

from libc.math cimport fabsf, floorf, sqrtf


def edges(
    const short[:, ::1] gx,
    const short[:, ::1] gy,
    const unsigned char[:, ::1] valid,
    float factor,
    float low,
    float high,
    float[:, ::1] magnitude,
    int[:, ::1] index,
    float[:, ::1] out,
):
    cdef Py_ssize_t height = gx.shape[0], width = gx.shape[1], row, col, capacity = out.shape[0]
    cdef double total = 0.0
    cdef float row_sum, level, here, before, after, bend
    cdef int inside = 0, found = 0, row_inside
    cdef bint across
    with nogil:
        for row in range(height):
            row_sum = 0.0
            row_inside = 0
            for col in range(width):
                magnitude[row, col] = sqrtf(
                    <float> (<int> gx[row, col] * gx[row, col] + <int> gy[row, col] * gy[row, col])
                ) * <float> valid[row, col]
                row_sum += magnitude[row, col]
                row_inside += valid[row, col]
                index[row, col] = -1
            total += row_sum
            inside += row_inside
        level = factor * <float> (total / (inside if inside > 0 else 1))
        level = low if level < low else (high if level > high else level)
        for row in range(1, height - 1):
            for col in range(1, width - 1):
                here = magnitude[row, col]
                if here < level or found >= capacity:
                    continue
                across = gx[row, col] * gx[row, col] >= gy[row, col] * gy[row, col]
                if across:
                    before, after = magnitude[row, col - 1], magnitude[row, col + 1]
                else:
                    before, after = magnitude[row - 1, col], magnitude[row + 1, col]
                if before == 0.0 or after == 0.0 or here < before or here <= after:
                    continue
                bend = before - 2.0 * here + after
                bend = 0.5 * (before - after) / bend
                out[found, 0] = <float> col + (bend if across else <float> 0.0)
                out[found, 1] = <float> row + (<float> 0.0 if across else bend)
                out[found, 2] = <float> gx[row, col] / here
                out[found, 3] = <float> gy[row, col] / here
                out[found, 4] = here
                index[row, col] = found
                found += 1
    return found, level


cdef inline int _opposite(
    const float[:, ::1] edge, const int[:, ::1] index, int i, Py_ssize_t row, Py_ssize_t col,
    float low, float high, float sign, float parallel,
) noexcept nogil:
    """The edge at a pixel if it is a partner of edge i, else -1."""
    cdef int j
    cdef float mu, mv, norm, across
    if row < 0 or col < 0 or row >= index.shape[0] or col >= index.shape[1]:
        return -1
    j = index[row, col]
    if j < 0 or edge[i, 2] * edge[j, 2] + edge[i, 3] * edge[j, 3] > -parallel:
        return -1
    mu = edge[i, 2] - edge[j, 2]
    mv = edge[i, 3] - edge[j, 3]
    norm = sqrtf(mu * mu + mv * mv)
    across = sign * ((edge[j, 0] - edge[i, 0]) * mu + (edge[j, 1] - edge[i, 1]) * mv) / norm
    return j if low <= across <= high else -1


def strokes(
    const float[:, ::1] edge,
    int count,
    const int[:, ::1] index,
    float low,
    float high,
    float sign,
    float parallel,
    float mutual,
    int[::1] partner,
    float[:, ::1] out,
):
    cdef Py_ssize_t height = index.shape[0], width = index.shape[1], row, col, capacity = out.shape[0]
    cdef int i, j, k, step, first, last, found = 0, hit
    cdef float du, dv, major, u, v, mu, mv, norm, across, gap
    cdef bint horizontal
    with nogil:
        for i in range(count):
            partner[i] = -1
            du = sign * edge[i, 2]
            dv = sign * edge[i, 3]
            horizontal = fabsf(du) >= fabsf(dv)
            major = fabsf(du) if horizontal else fabsf(dv)
            du /= major
            dv /= major
            first = <int> (low * major) - 1
            first = 1 if first < 1 else first
            last = <int> (high * major) + 2
            for step in range(first, last):
                u = edge[i, 0] + du * <float> step
                v = edge[i, 1] + dv * <float> step
                col = <Py_ssize_t> floorf(u + 0.5)
                row = <Py_ssize_t> floorf(v + 0.5)
                if col < 0 or row < 0 or col >= width or row >= height:
                    break
                hit = _opposite(edge, index, i, row, col, low, high, sign, parallel)
                if hit < 0:
                    hit = _opposite(
                        edge, index, i, row + (1 if horizontal else 0), col + (0 if horizontal else 1),
                        low, high, sign, parallel,
                    )
                if hit < 0:
                    hit = _opposite(
                        edge, index, i, row - (1 if horizontal else 0), col - (0 if horizontal else 1),
                        low, high, sign, parallel,
                    )
                if hit >= 0:
                    partner[i] = hit
                    break
        for i in range(count):
            j = partner[i]
            if j < 0 or found >= capacity:
                continue
            k = partner[j]
            if k < 0:
                continue
            mu = edge[i, 2] - edge[j, 2]
            mv = edge[i, 3] - edge[j, 3]
            norm = sqrtf(mu * mu + mv * mv)
            mu /= norm
            mv /= norm
            across = sign * ((edge[j, 0] - edge[i, 0]) * mu + (edge[j, 1] - edge[i, 1]) * mv)
            gap = (edge[k, 0] - edge[i, 0]) * (edge[k, 0] - edge[i, 0]) \
                + (edge[k, 1] - edge[i, 1]) * (edge[k, 1] - edge[i, 1])
            if gap > 4.0 and gap > mutual * mutual * across * across:
                continue
            out[found, 0] = 0.5 * (edge[i, 0] + edge[j, 0])
            out[found, 1] = 0.5 * (edge[i, 1] + edge[j, 1])
            out[found, 2] = -mv
            out[found, 3] = mu
            out[found, 4] = across
            out[found, 5] = edge[i, 4] if edge[i, 4] < edge[j, 4] else edge[j, 4]
            found += 1
    return found


cdef int _window(
    const float[:, ::1] stroke, const unsigned char[::1] state, float u, float v, float du, float dv,
    float half, float radius, float aligned, float* mean,
) noexcept nogil:
    """Sums over the strokes round (u, v): mean = along, across, tangent u, tangent v, claimed; returns how many."""
    cdef Py_ssize_t i
    cdef int count = 0
    cdef float ru, rv, along, across, turn
    for i in range(5):
        mean[i] = 0.0
    for i in range(stroke.shape[0]):
        if state[i] == 0:
            continue
        ru = stroke[i, 0] - u
        rv = stroke[i, 1] - v
        along = ru * du + rv * dv
        if fabsf(along) > half:
            continue
        across = rv * du - ru * dv
        if fabsf(across) > radius:
            continue
        turn = stroke[i, 2] * du + stroke[i, 3] * dv
        if fabsf(turn) < aligned:
            continue
        count += 1
        mean[0] += along
        mean[1] += across
        mean[2] += stroke[i, 2] if turn > 0.0 else -stroke[i, 2]
        mean[3] += stroke[i, 3] if turn > 0.0 else -stroke[i, 3]
        mean[4] += 1.0 if state[i] == 2 else 0.0
    if count > 0:
        mean[0] /= count
        mean[1] /= count
        mean[4] /= count
    return count


def trace(
    const float[:, ::1] stroke,
    const unsigned char[::1] state,
    float u,
    float v,
    float du,
    float dv,
    float step,
    float radius,
    float gap,
    int least,
    float aligned,
    float[:, ::1] out,
):
    cdef int found = 0, count, jump, jumps = <int> (gap / step), filled = 0, travelled = 0
    cdef float start_u = u, start_v = v, start_du = du, start_dv = dv, norm, qu, qv, furthest, along, across, tu, tv
    cdef float mean[5]
    cdef Py_ssize_t i, capacity = out.shape[0]
    cdef bint closed = False
    with nogil:
        while found < capacity - 1:
            for jump in range(1, jumps + 2):
                qu = u + du * step * jump
                qv = v + dv * step * jump
                count = _window(
                    stroke, state, qu, qv, du, dv, step, radius * (1.0 + 0.25 * (jump - 1)), aligned, mean
                )
                if count >= least and mean[0] > -0.75 * step and not (jump > 1 and mean[4] > 0.5):
                    break
            else:
                break
            if mean[4] > 0.6:
                break
            tu, tv = mean[2], mean[3]
            norm = sqrtf(tu * tu + tv * tv)
            u = qu + mean[0] * du - mean[1] * dv
            v = qv + mean[0] * dv + mean[1] * du
            du, dv = tu / norm, tv / norm
            out[found, 0] = u
            out[found, 1] = v
            found += 1
            filled += 1
            travelled += jump
            if (
                travelled > 6
                and (u - start_u) * (u - start_u) + (v - start_v) * (v - start_v) < step * step
                and du * start_du + dv * start_dv > aligned
            ):
                closed = True
                break
        if not closed:
            furthest = 0.0
            for i in range(stroke.shape[0]):
                if state[i] != 1:
                    continue
                along = (stroke[i, 0] - u) * du + (stroke[i, 1] - v) * dv
                across = (stroke[i, 1] - v) * du - (stroke[i, 0] - u) * dv
                if (
                    furthest < along <= 1.5 * step
                    and fabsf(across) <= radius
                    and fabsf(stroke[i, 2] * du + stroke[i, 3] * dv) >= aligned
                ):
                    furthest = along
            if furthest > 0.0:
                out[found, 0] = u + furthest * du
                out[found, 1] = v + furthest * dv
                found += 1
    return found, filled, travelled, closed


def claim(
    const float[:, ::1] stroke,
    unsigned char[::1] state,
    const float[:, ::1] points,
    float radius,
    float aligned,
):
    cdef Py_ssize_t i, k, last = points.shape[0] - 1
    cdef float du, dv, length, ru, rv, along, across
    cdef int count = 0
    with nogil:
        for k in range(last):
            du = points[k + 1, 0] - points[k, 0]
            dv = points[k + 1, 1] - points[k, 1]
            length = sqrtf(du * du + dv * dv)
            if length <= 0.0:
                continue
            du /= length
            dv /= length
            for i in range(stroke.shape[0]):
                if state[i] != 1:
                    continue
                ru = stroke[i, 0] - points[k, 0]
                rv = stroke[i, 1] - points[k, 1]
                along = ru * du + rv * dv
                across = rv * du - ru * dv
                if (
                    -radius <= along <= length + radius
                    and fabsf(across) <= radius
                    and fabsf(stroke[i, 2] * du + stroke[i, 3] * dv) >= aligned
                ):
                    state[i] = 2
                    count += 1
    return count
