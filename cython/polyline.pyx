"""Kernels of robotd.vision.stroke: tracing strokes into polylines, and joining these over gaps and round corners.

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



cdef struct End:
    float u
    float v
    float du  # out of the piece
    float dv
    float width
    int mate  # the end that it is joined to, or -1
    bint corner
    float corner_u
    float corner_v


cdef void _end(const float *path, int count, bint last, float reach, End *end) noexcept nogil:
    """Where a piece ends, and its direction there, over the last `reach` of its length."""
    cdef int k = count - 1 if last else 0, move = -1 if last else 1, other
    cdef float size, gone = 0.0, du, dv
    end.u, end.v = path[2 * k], path[2 * k + 1]
    other = k
    while 0 <= other + move < count and gone < reach:
        du = path[2 * (other + move)] - path[2 * other]
        dv = path[2 * (other + move) + 1] - path[2 * other + 1]
        gone += sqrtf(du * du + dv * dv)
        other += move
    du, dv = end.u - path[2 * other], end.v - path[2 * other + 1]
    size = sqrtf(du * du + dv * dv)
    size = size if size > 1e-6 else <float> 1e-6
    end.du, end.dv = du / size, dv / size
    end.mate = -1
    end.corner = False


cdef bint _belong(const End *one, const End *two, float *corner) noexcept nogil:
    """Whether two ends face each other over a gap (corner[0] = 0) or meet in a corner (1, and its place)."""
    cdef float gu = two.u - one.u, gv = two.v - one.v, width = 0.5 * (one.width + two.width)
    cdef float distance = sqrtf(gu * gu + gv * gv)
    cdef float facing = -(one.du * two.du + one.dv * two.dv), forward, backward, det, ahead, behind
    corner[0] = 0.0
    if distance > 3.0 * width or one.width > 1.3 * two.width or two.width > 1.3 * one.width:
        return False
    forward = one.du * gu + one.dv * gv
    backward = -(two.du * gu + two.dv * gv)
    forward = forward if forward < backward else backward
    if distance < 0.25 * width and facing > 0.5:
        return True
    if facing > 0.9 and forward > 0.92 * distance and distance <= 2.5 * width:
        return True
    if facing > 0.87 or facing < -0.87:  # nearly parallel: their crossing is no corner
        return False
    # one + ahead * d1 = two + behind * d2
    det = one.du * -two.dv + one.dv * two.du
    ahead = (gu * -two.dv + gv * two.du) / det
    behind = (one.du * gv - one.dv * gu) / det
    if not (-0.75 * width <= ahead <= 2.0 * width and -0.75 * width <= behind <= 2.0 * width):
        return False
    corner[0] = 1.0
    corner[1] = one.u + ahead * one.du
    corner[2] = one.v + ahead * one.dv
    return True


cdef int _copy(
    const float *path, int count, bint reverse, float *out, int used, int capacity,
    const End *first, const End *last,
) noexcept nogil:
    """Append a piece, without what lies beyond the corners at its ends; returns how many points there are then."""
    cdef int k, j, begin = used
    cdef float u, v
    for k in range(count):
        j = count - 1 - k if reverse else k
        u, v = path[2 * j], path[2 * j + 1]
        if first.corner and (u - first.corner_u) * first.du + (v - first.corner_v) * first.dv > 0.0:
            continue
        if last.corner and (u - last.corner_u) * last.du + (v - last.corner_v) * last.dv > 0.0:
            continue
        if used < capacity:
            out[2 * used], out[2 * used + 1] = u, v
            used += 1
    return used


def join(
    const float[:, ::1] points,
    const float[:, ::1] pieces,
    int count,
    float[:, ::1] out_points,
    float[:, ::1] out_pieces,
):
    cdef int i, j, k, e, start, n = 0, used = 0, begin, current, capacity = <int> out_points.shape[0], best_i, best_j, m
    cdef float square, nearest, weight, arc, gap, du, dv, total
    cdef double sw, ss, sy, sss, ssy, det, slope, w, length, middle
    cdef End[128] ends
    cdef unsigned char[64] used_piece
    cdef int[64] group
    cdef float[3] corner
    cdef float[3] best_corner
    cdef float[128] node_arc
    cdef float[128] node_width
    cdef float[128] node_weight
    count = 64 if count > 64 else count
    corner[1] = corner[2] = best_corner[0] = best_corner[1] = best_corner[2] = 0.0
    with nogil:
        for i in range(count):
            used_piece[i] = 0
            group[i] = i
            for j in range(2):
                _end(&points[<int> pieces[i, 0], 0], <int> pieces[i, 1], j == 1, pieces[i, 2], &ends[2 * i + j])
                ends[2 * i + j].width = pieces[i, 2] + pieces[i, 3] * (0.5 if j == 1 else -0.5) * pieces[i, 10]
                if ends[2 * i + j].width < 0.5 * pieces[i, 2]:
                    ends[2 * i + j].width = 0.5 * pieces[i, 2]
        while True:
            nearest = 1e30
            best_i = best_j = -1
            for i in range(2 * count):
                if ends[i].mate >= 0 or pieces[i // 2, 8] > 0.0:
                    continue
                for j in range(i + 1, 2 * count):
                    if ends[j].mate >= 0 or pieces[j // 2, 8] > 0.0 or group[i // 2] == group[j // 2]:
                        continue
                    square = (ends[i].u - ends[j].u) * (ends[i].u - ends[j].u) \
                        + (ends[i].v - ends[j].v) * (ends[i].v - ends[j].v)
                    if square >= nearest or square > 9.0 * ends[i].width * ends[j].width * 1.3:
                        continue
                    if _belong(&ends[i], &ends[j], corner):
                        square += 1e8 * corner[0]  # straight on, at crossings, comes before round a corner
                        if square >= nearest:
                            continue
                        nearest = square
                        best_i, best_j = i, j
                        best_corner[0], best_corner[1], best_corner[2] = corner[0], corner[1], corner[2]
            if best_i < 0:
                break
            ends[best_i].mate, ends[best_j].mate = best_j, best_i
            if best_corner[0] > 0.0:
                for k in range(2):
                    e = best_i if k == 0 else best_j
                    ends[e].corner = True
                    ends[e].corner_u, ends[e].corner_v = best_corner[1], best_corner[2]
            i, j = group[best_i // 2], group[best_j // 2]
            for k in range(count):
                if group[k] == j:
                    group[k] = i
        for i in range(count):
            if used_piece[i]:
                continue
            # to the first end of the chain
            current = 2 * i
            m = 0
            while ends[current].mate >= 0 and m < count:
                current = ends[current].mate ^ 1
                m += 1
            begin = used
            for k in range(3, 11):
                out_pieces[n, k] = 0.0
            total = 0.0
            arc = 0.0
            m = 0
            while True:
                j = current // 2
                used_piece[j] = 1
                start = <int> pieces[j, 0]
                if used > begin:
                    k = used - 1
                else:
                    k = -1
                used = _copy(
                    &points[start, 0], <int> pieces[j, 1], current % 2 == 1, &out_points[0, 0], used, capacity,
                    &ends[current], &ends[current ^ 1],
                )
                if k >= 0 and k + 1 < used:
                    du = out_points[k + 1, 0] - out_points[k, 0]
                    dv = out_points[k + 1, 1] - out_points[k, 1]
                    gap = sqrtf(du * du + dv * dv)
                    arc += gap
                    out_pieces[n, 6] += <float> (<int> (gap / (0.4 * pieces[j, 2] if pieces[j, 2] > 5.0 else 2.0)))
                weight = pieces[j, 7]
                if m + 2 <= 128:
                    node_arc[m], node_width[m], node_weight[m] = arc, ends[current].width, weight
                    node_arc[m + 1], node_width[m + 1], node_weight[m + 1] = \
                        arc + pieces[j, 10], ends[current ^ 1].width, weight
                    m += 2
                arc += pieces[j, 10]
                out_pieces[n, 4] += weight * pieces[j, 4]
                out_pieces[n, 5] += pieces[j, 5]
                out_pieces[n, 6] += pieces[j, 6]
                out_pieces[n, 7] += weight
                out_pieces[n, 8] = pieces[j, 8]
                out_pieces[n, 9] += weight * pieces[j, 9]
                total += weight
                e = current ^ 1
                if ends[e].mate < 0:
                    break
                if ends[e].corner and used < capacity:
                    out_points[used, 0], out_points[used, 1] = ends[e].corner_u, ends[e].corner_v
                    used += 1
                current = ends[e].mate
            length = 0.0
            for k in range(begin, used - 1):
                du = out_points[k + 1, 0] - out_points[k, 0]
                dv = out_points[k + 1, 1] - out_points[k, 1]
                length += sqrtf(du * du + dv * dv)
            sw = ss = sy = sss = ssy = 0.0
            for k in range(m):
                w = node_weight[k]
                sw += w
                ss += w * (node_arc[k] - 0.5 * arc)
                sy += w * node_width[k]
                sss += w * (node_arc[k] - 0.5 * arc) * (node_arc[k] - 0.5 * arc)
                ssy += w * (node_arc[k] - 0.5 * arc) * node_width[k]
            det = sw * sss - ss * ss
            slope = (sw * ssy - ss * sy) / det if det > 1e-6 * sw * sw else 0.0
            out_pieces[n, 0] = <float> begin
            out_pieces[n, 1] = <float> (used - begin)
            out_pieces[n, 2] = <float> ((sy - slope * ss) / sw)
            out_pieces[n, 3] = <float> slope
            out_pieces[n, 4] /= total
            out_pieces[n, 9] /= total
            out_pieces[n, 10] = <float> length
            if used - begin >= 2:
                n += 1
            else:
                used = begin
    return n
