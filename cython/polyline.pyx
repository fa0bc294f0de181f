"""Kernels of robotd.vision.stroke: tracing strokes into polylines.

Their plain versions are in robotd/vision/polyline_reference.py, which also says what each one computes.
"""

from libc.math cimport fabsf, floorf, sqrtf


cdef struct Window:
    int count
    float along
    float across
    float tu
    float tv
    float claimed


cdef inline int _from(const float *stroke, int first, int last, int axis, float least) noexcept nogil:
    """The first stroke whose pixel along the axis is not before that of `least`."""
    cdef int wanted = <int> least if least > 0.0 else 0, middle
    while first < last:
        middle = (first + last) // 2
        if <int> stroke[6 * middle + axis] < wanted:
            first = middle + 1
        else:
            last = middle
    return first


cdef inline void _window(
    const float *stroke, const unsigned char *state, int first, int last, int axis, float u, float v, float du, float dv,
    float half, float radius, float aligned, Window *seen,
) noexcept nogil:
    """Means over the strokes round (u, v)."""
    cdef int i
    cdef float ru, rv, along, across, turn, beyond
    cdef const float *one
    seen.count = 0
    seen.along = seen.across = seen.tu = seen.tv = seen.claimed = 0.0
    i = _from(stroke, first, last, axis, (v if axis else u) - half - radius)
    beyond = (v if axis else u) + half + radius + 1.0
    for i in range(i, last):
        one = stroke + 6 * i
        if one[axis] > beyond:
            break
        ru = one[0] - u
        rv = one[1] - v
        along = ru * du + rv * dv
        if fabsf(along) > half:
            continue
        across = rv * du - ru * dv
        if fabsf(across) > radius:
            continue
        turn = one[2] * du + one[3] * dv
        if fabsf(turn) < aligned:
            continue
        seen.count += 1
        seen.along += along
        seen.across += across
        seen.tu += one[2] if turn > 0.0 else -one[2]
        seen.tv += one[3] if turn > 0.0 else -one[3]
        seen.claimed += 1.0 if state[i] == 2 else 0.0
    if seen.count > 0:
        seen.along /= seen.count
        seen.across /= seen.count
        seen.claimed /= seen.count


cdef struct Way:
    int found
    int filled
    int travelled
    bint closed


cdef Way _follow(
    const float *stroke, const unsigned char *state, int first, int last, int axis, float u, float v, float du, float dv,
    float step, float radius, float gap, int least, float aligned, float *out, int capacity,
) noexcept nogil:
    cdef Way way
    cdef Window seen
    cdef int jump, jumps = <int> (gap / step), i
    cdef float start_u = u, start_v = v, start_du = du, start_dv = dv, norm, qu, qv, furthest, along, across
    cdef const float *one
    way.found = way.filled = way.travelled = 0
    way.closed = False
    while way.found < capacity - 1:
        for jump in range(1, jumps + 2):
            qu = u + du * step * jump
            qv = v + dv * step * jump
            _window(
                stroke, state, first, last, axis, qu, qv, du, dv, <float> 0.99 * step, radius * <float> (1.0 + 0.25 * (jump - 1)), aligned, &seen
            )
            if seen.count >= least and seen.along > -0.75 * step and not (jump > 1 and seen.claimed > 0.5):
                break
        else:
            break
        if seen.claimed > 0.6:
            break
        norm = sqrtf(seen.tu * seen.tu + seen.tv * seen.tv)
        u = qu + seen.along * du - seen.across * dv
        v = qv + seen.along * dv + seen.across * du
        du, dv = seen.tu / norm, seen.tv / norm
        out[2 * way.found] = u
        out[2 * way.found + 1] = v
        way.found += 1
        way.filled += 1
        way.travelled += jump
        if (
            way.travelled > 6
            and (u - start_u) * (u - start_u) + (v - start_v) * (v - start_v) < step * step
            and du * start_du + dv * start_dv > aligned
        ):
            way.closed = True
            return way
    furthest = 0.0
    for i in range(first, last):
        if state[i] != 1:
            continue
        one = stroke + 6 * i
        along = (one[0] - u) * du + (one[1] - v) * dv
        across = (one[1] - v) * du - (one[0] - u) * dv
        if (
            furthest < along <= 1.5 * step
            and fabsf(across) <= radius
            and fabsf(one[2] * du + one[3] * dv) >= aligned
        ):
            furthest = along
    if furthest > 0.0:
        out[2 * way.found] = u + furthest * du
        out[2 * way.found + 1] = v + furthest * dv
        way.found += 1
    return way


cdef int _claim(
    const float *stroke, unsigned char *state, float *place, int first, int last, int axis, const float *points, int count,
    float radius, float aligned, float *ragged,
) noexcept nogil:
    """Mark the free strokes on a polyline as claimed and note their arc lengths in place; returns how many."""
    cdef int i, k, claimed = 0
    cdef float du, dv, length, ru, rv, along, across, arc, beyond
    cdef const float *one
    ragged[0] = 0.0
    for i in range(first, last):
        if state[i] == 1:
            place[2 * i] = -1.0  # across
    arc = 0.0
    for k in range(count - 1):
        du = points[2 * k + 2] - points[2 * k]
        dv = points[2 * k + 3] - points[2 * k + 1]
        length = sqrtf(du * du + dv * dv)
        if length <= 0.0:
            continue
        du /= length
        dv /= length
        beyond = points[2 * k + axis] if points[2 * k + axis] > points[2 * k + 2 + axis] else points[2 * k + 2 + axis]
        i = _from(stroke, first, last, axis, points[2 * k + axis] + points[2 * k + 2 + axis] - beyond - 2.0 * radius)
        beyond += 2.0 * radius + 1.0
        for i in range(i, last):
            one = stroke + 6 * i
            if one[axis] > beyond:
                break
            if state[i] != 1:
                continue
            ru = one[0] - points[2 * k]
            rv = one[1] - points[2 * k + 1]
            along = ru * du + rv * dv
            if along < -radius or along > length + radius:
                continue
            across = fabsf(rv * du - ru * dv)
            if across > radius or fabsf(one[2] * du + one[3] * dv) < aligned:
                continue
            if place[2 * i] < 0.0 or across < place[2 * i]:
                place[2 * i] = across
                place[2 * i + 1] = arc + along
        arc += length
    for i in range(first, last):
        if state[i] == 1 and place[2 * i] >= 0.0:
            state[i] = 2
            claimed += 1
            ragged[0] += place[2 * i]
            place[2 * i] = -2.0 - place[2 * i]  # marks the strokes of this claim
    if claimed > 0:
        ragged[0] /= claimed
    return claimed


cdef void _widths(
    const float *stroke, float *place, int first, int last, float length, float *out,
) noexcept nogil:
    """Robust straight fit of the claimed strokes' widths over the arc length: out = middle, slope, spread."""
    cdef int i, turn, n
    cdef double s, w, sums, sumw, sumss, sumsw, middle = 0.0, slope = 0.0, spread = 0.0, limit = 1e30, off, det
    for turn in range(3):
        n = 0
        sums = sumw = sumss = sumsw = 0.0
        for i in range(first, last):
            if place[2 * i] > -2.0:
                continue
            s = place[2 * i + 1] - 0.5 * length
            w = stroke[6 * i + 4]
            if turn > 0 and (w - middle - slope * s) * (w - middle - slope * s) > limit * limit:
                continue
            n += 1
            sums += s
            sumw += w
            sumss += s * s
            sumsw += s * w
        if n < 3:
            break
        det = n * sumss - sums * sums
        slope = (n * sumsw - sums * sumw) / det if det > 1e-3 * n * n else 0.0
        slope = 0.4 if slope > 0.4 else (-0.4 if slope < -0.4 else slope)
        middle = (sumw - slope * sums) / n
        n = 0
        spread = 0.0
        for i in range(first, last):
            if place[2 * i] > -2.0:
                continue
            off = stroke[6 * i + 4] - middle - slope * (place[2 * i + 1] - 0.5 * length)
            spread += off if off > 0.0 else -off
            n += 1
        spread /= n if n > 0 else 1
        limit = 1.5 * spread
    for i in range(first, last):
        if place[2 * i] <= -2.0:
            place[2 * i] = -1.0
    out[0], out[1], out[2] = <float> middle, <float> slope, <float> spread


def trace(
    const float[:, ::1] stroke,
    const int[::1] counts,
    const int[::1] first,
    const int[::1] axis,
    float aligned,
    float least_length,
    float most_spread,
    unsigned char[::1] state,
    float[:, ::1] place,
    float[:, ::1] forward,
    float[:, ::1] backward,
    float[:, ::1] points,
    float[:, ::1] pieces,
):
    cdef int clusters = <int> first.shape[0] - 1, c, a, b, i, j, k, seed, turn, n = 0, used = 0, least, claimed, free, total
    cdef int capacity = <int> points.shape[0], room = <int> pieces.shape[0], scratch = <int> forward.shape[0]
    cdef float width, step, radius, length, ragged, strength
    cdef Way one, two
    cdef float[3] fit
    cdef const float *all = &stroke[0, 0]
    cdef float *path
    with nogil:
        for i in range(<int> stroke.shape[0]):
            state[i] = 1
        for c in range(clusters):
            a, b = first[c], first[c + 1]
            for turn in range(6):  # the longest way through a cluster, then its branches
                seed = -1
                free = 0
                for i in range(a, b):
                    if state[i] == 1:
                        free += 1
                        if seed < 0 or counts[i] > counts[seed]:
                            seed = i
                if n >= room or seed < 0 or free < 4:
                    break
                width = all[6 * seed + 4]
                if free < 0.5 * width * least_length:
                    break
                step = 0.4 * width if width > 5.0 else 2.0
                radius = 0.3 * width if width > 5.0 else 1.5
                least = <int> (0.35 * step + 0.5)
                least = 2 if least < 2 else least
                one = _follow(
                    all, &state[0], a, b, axis[c], all[6 * seed], all[6 * seed + 1], all[6 * seed + 2], all[6 * seed + 3],
                    step, radius, 2.0 * width, least, aligned, &forward[0, 0], scratch,
                )
                two.found = two.filled = two.travelled = 0
                if not one.closed:
                    two = _follow(
                        all, &state[0], a, b, axis[c], all[6 * seed], all[6 * seed + 1], -all[6 * seed + 2], -all[6 * seed + 3],
                        step, radius, 2.0 * width, least, aligned, &backward[0, 0], scratch,
                    )
                total = one.found + two.found + 1
                if used + total + 1 > capacity:
                    break
                path = &points[used, 0]
                j = 0
                for k in range(two.found - 1, -1, -1):
                    path[2 * j], path[2 * j + 1] = backward[k, 0], backward[k, 1]
                    j += 1
                # the seed itself is one noisy stroke: it counts only as an end
                if (one.found == 0 or two.found == 0) and not one.closed:
                    path[2 * j], path[2 * j + 1] = all[6 * seed], all[6 * seed + 1]
                    j += 1
                for k in range(one.found):
                    path[2 * j], path[2 * j + 1] = forward[k, 0], forward[k, 1]
                    j += 1
                if one.closed:
                    path[2 * j], path[2 * j + 1] = path[0], path[1]
                    j += 1
                length = 0.0
                for k in range(j - 1):
                    length += sqrtf(
                        (path[2 * k + 2] - path[2 * k]) * (path[2 * k + 2] - path[2 * k])
                        + (path[2 * k + 3] - path[2 * k + 1]) * (path[2 * k + 3] - path[2 * k + 1])
                    )
                ragged = 0.0
                claimed = _claim(all, &state[0], &place[0, 0], a, b, axis[c], path, j, 0.5 * width, aligned, &ragged)
                state[seed] = 2
                if j < 2 or claimed < 4 or length < least_length * width:
                    for i in range(a, b):
                        place[i, 0] = -1.0
                    continue
                _widths(all, &place[0, 0], a, b, length, fit)
                if fit[0] <= 0.0 or fit[2] > most_spread * fit[0] or length < least_length * fit[0]:
                    continue
                pieces[n, 0] = <float> used
                pieces[n, 1] = <float> j
                pieces[n, 2] = fit[0]
                pieces[n, 3] = fit[1]
                pieces[n, 4] = fit[2]
                pieces[n, 5] = <float> (one.filled + two.filled)
                pieces[n, 6] = <float> (one.travelled + two.travelled)
                pieces[n, 7] = <float> claimed
                pieces[n, 8] = 1.0 if one.closed else 0.0
                pieces[n, 9] = ragged
                pieces[n, 10] = length
                used += j
                n += 1
    return n
