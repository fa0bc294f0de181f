"""Kernels of robotd.vision.stroke: pieces of lines made longer where both borders go on, and joined into whole lines.

Their plain versions are in robotd/vision/join_reference.py, which also says what each one computes.
"""

from libc.math cimport cosf, fabsf, sinf, sqrtf


cdef float LEAST_STEP = 0.06  # from line to floor of a piece that is followed, as a share of the grey level
cdef float GOES_ON = 0.5  # of its usual step that both borders keep where a line goes on
cdef float ALIKE = 0.5  # ratio of the steps of pieces of one line
cdef float DARK = 8.0  # grey levels of a camera's black, with a margin
cdef float MOST_MISSED = 1.0  # widths that glare or dirt may hide


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
    float step  # usual height of its borders, or -1 if not yet measured


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
    end.step = -1.0


cdef struct View:
    const unsigned char *grey
    const unsigned char *usable
    bint masked
    int height
    int width
    float sign


cdef View _view(const unsigned char[:, ::1] image, const unsigned char[:, ::1] valid, float sign) noexcept nogil:
    cdef View view
    view.grey = &image[0, 0]
    view.masked = valid.shape[0] > 0
    view.usable = &valid[0, 0] if valid.shape[0] > 0 else NULL
    view.height, view.width = <int> image.shape[0], <int> image.shape[1]
    view.sign = sign
    return view


cdef inline float _at(const View *view, float u, float v) noexcept nogil:
    """Grey level between pixels, or -1 outside."""
    cdef int col, row
    cdef float a, b
    cdef const unsigned char *at
    if not (0.0 <= u < view.width - 1 and 0.0 <= v < view.height - 1):
        return -1.0
    col, row = <int> u, <int> v
    if view.masked and view.usable[row * view.width + col] == 0:
        return -1.0
    a, b = u - <float> col, v - <float> row
    at = view.grey + row * view.width + col
    return (1.0 - b) * ((1.0 - a) * at[0] + a * at[1]) + b * ((1.0 - a) * at[view.width] + a * at[view.width + 1])


cdef float _border(
    const View *view, float u, float v, float du, float dv, float back, float half, float side, float *off,
) noexcept nogil:
    """The step from line to floor near a border: its height, or -1 out of view, and how far off it lies.

    Heights are shares of the grey level there, because a shadow takes from line and floor alike.
    """
    cdef float[9] profile
    cdef float reach, one, two, step, best = 0.0
    cdef int k
    off[0] = 0.0
    for k in range(9):
        reach = side * half * (<float> 0.4 + <float> 0.15 * k)
        one = _at(view, u - reach * dv, v + reach * du)
        two = _at(view, u - back * du - reach * dv, v - back * dv + reach * du)
        if one < 0.0 or two < 0.0:
            return -1.0
        profile[k] = 0.5 * (one + two)
    for k in range(2, 7):
        one = profile[k - 2] + profile[k - 1]
        two = profile[k + 1] + profile[k + 2]
        step = 2.0 * view.sign * (one - two) / (one + two + 4.0 * DARK)
        if step > best:
            best = step
            off[0] = <float> 0.15 * (k - 4) * half
    return best


cdef float _usual(
    const View *view, const float *path, int count, bint last, float half, float reach, float back,
) noexcept nogil:
    """Mean height of the weaker border over the last `reach` of a piece, 0 if it is out of view."""
    cdef int k = count - 1 if last else 0, move = -1 if last else 1, n = 0
    cdef float du, dv, size, gone = 0.0, one, two, off, total = 0.0
    while 0 <= k + move < count and gone < reach:
        du, dv = path[2 * k] - path[2 * (k + move)], path[2 * k + 1] - path[2 * (k + move) + 1]
        size = sqrtf(du * du + dv * dv)
        gone += size
        k += move
        if size <= 0.0:
            continue
        one = _border(view, path[2 * k], path[2 * k + 1], du / size, dv / size, back, half, -1.0, &off)
        two = _border(view, path[2 * k], path[2 * k + 1], du / size, dv / size, back, half, 1.0, &off)
        if one >= 0.0 and two >= 0.0:
            total += one if one < two else two
            n += 1
    return total / n if n > 0 else <float> 0.0


cdef bint _taken(
    const float *points, const float *pieces, int columns, int count, int own, float u, float v, float near
) noexcept nogil:
    """Whether another piece runs within `near` of a place."""
    cdef int p, k, start
    cdef float du, dv
    for p in range(count):
        if p == own:
            continue
        start = <int> pieces[p * columns]
        for k in range(start, start + <int> pieces[p * columns + 1]):
            du, dv = points[2 * k] - u, points[2 * k + 1] - v
            if du * du + dv * dv < near * near:
                return True
    return False


cdef int _onwards(
    const View *view, const float *points, const float *pieces, int columns, int count, int own, bint last,
    float *out, int capacity, float *length,
) noexcept nogil:
    """Follow both borders beyond an end of a piece; returns how many points that gave."""
    cdef const float *piece = pieces + own * columns
    cdef const float *path = points + 2 * <int> piece[0]
    cdef int size = <int> piece[1], found = 0, fan, best, k, missed = 0
    cdef float width = piece[2] + piece[3] * piece[10] * (<float> 0.5 if last else <float> -0.5)
    cdef float grow = piece[3] if last else -piece[3]
    cdef float step, half, usual, du, dv, u, v, one, two, off_one, off_two, q, most, shift, cu, cv, turn, gone = 0.0
    cdef float best_u, best_v, best_shift, far
    cdef End end
    length[0] = 0.0
    width = width if width > 0.5 * piece[2] else 0.5 * piece[2]
    step = 0.4 * width if width > 5.0 else <float> 2.0
    half = 0.5 * width
    usual = _usual(view, path, size, last, half, 4.0 * width, 0.5 * step)
    if usual < LEAST_STEP:
        return 0
    _end(path, size, last, piece[2], &end)
    u, v, du, dv = end.u, end.v, end.du, end.dv
    far = 0.0
    while found < capacity:
        half = 0.5 * (width + grow * gone)
        half = half if half > 0.25 * width else 0.25 * width
        most = -1.0
        best = 0
        best_u, best_v, best_shift = du, dv, 0.0
        for k in range(5 if missed == 0 else 1):
            fan = (k + 1) // 2 * (1 if k % 2 else -1)
            turn = <float> 0.18 * fan
            cu, cv = du * cosf(turn) - dv * sinf(turn), du * sinf(turn) + dv * cosf(turn)
            one = _border(view, u + step * cu, v + step * cv, cu, cv, 0.5 * step, half, -1.0, &off_one)
            two = _border(view, u + step * cu, v + step * cv, cu, cv, 0.5 * step, half, 1.0, &off_two)
            if one < 0.0 and two < 0.0:
                if k == 0:
                    break  # out of view: a turn that stays in it is no better
                continue
            if one < 0.0 or two < 0.0:  # at the edge of the view: one border, not well enough known to move by
                q, shift = 0.7 * (two if one < 0.0 else one), 0.0
                if fabsf(off_one + off_two) > 0.2 * half:
                    q = 0.0
            else:
                q, shift = (one if one < two else two), 0.5 * (off_two - off_one)
                if fabsf(off_one + off_two) > 0.5 * half:
                    q = 0.0
            q *= 1.0 - <float> 0.04 * (fan if fan > 0 else -fan)
            if q > most:
                most = q
                best_u, best_v, best_shift = cu, cv, shift
        if most < 0.0:
            break
        u += step * best_u
        v += step * best_v
        far += step
        gone += step
        if most < GOES_ON * usual:
            missed += 1
            if far > MOST_MISSED * width:
                break
            continue
        cu, cv = u - best_shift * best_v, v + best_shift * best_u
        if _at(view, cu, cv) < 0.0 or _taken(points, pieces, columns, count, own, cu, cv, 0.4 * width):
            break
        u, v = cu, cv
        out[2 * found], out[2 * found + 1] = u, v
        found += 1
        length[0] += far
        # half the correction, because a border is known to a few tenths of a pixel only
        du, dv = best_u - 0.5 * best_shift / far * best_v, best_v + 0.5 * best_shift / far * best_u
        q = sqrtf(du * du + dv * dv)
        du /= q
        dv /= q
        far = 0.0
        missed = 0
    return found


def extend(
    const unsigned char[:, ::1] image,
    const unsigned char[:, ::1] valid,
    float sign,
    const float[:, ::1] points,
    const float[:, ::1] pieces,
    int count,
    float[:, ::1] way,
    float[:, ::1] out_points,
    float[:, ::1] out_pieces,
):
    cdef View view = _view(image, valid, sign)
    cdef int i, k, n, before, after, start, used = 0, added = 0, columns = <int> pieces.shape[1]
    cdef int capacity = <int> out_points.shape[0]
    cdef float one, two, width
    with nogil:
        for i in range(count):
            start, n = <int> pieces[i, 0], <int> pieces[i, 1]
            before = after = 0
            one = two = 0.0
            if pieces[i, 8] == 0.0 and capacity - used > n:
                before = _onwards(
                    &view, &points[0, 0], &pieces[0, 0], columns, count, i, False, &way[0, 0],
                    min(<int> way.shape[0], capacity - used - n), &one,
                )
                for k in range(before):
                    out_points[used + before - 1 - k, 0], out_points[used + before - 1 - k, 1] = way[k, 0], way[k, 1]
                after = _onwards(
                    &view, &points[0, 0], &pieces[0, 0], columns, count, i, True, &way[0, 0],
                    min(<int> way.shape[0], capacity - used - n - before), &two,
                )
                for k in range(after):
                    out_points[used + before + n + k, 0], out_points[used + before + n + k, 1] = way[k, 0], way[k, 1]
            n = min(n, capacity - used - before - after)
            for k in range(n):
                out_points[used + before + k, 0], out_points[used + before + k, 1] = points[start + k, 0], points[start + k, 1]
            for k in range(columns):
                out_pieces[i, k] = pieces[i, k]
            width = pieces[i, 2] + 0.5 * pieces[i, 3] * (two - one)
            out_pieces[i, 0], out_pieces[i, 1] = <float> used, <float> (before + n + after)
            out_pieces[i, 2] = width if width > 0.5 * pieces[i, 2] else 0.5 * pieces[i, 2]
            out_pieces[i, 10] = pieces[i, 10] + one + two
            used += before + n + after
            added += before + after
    return added


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


cdef bint _alike(
    const View *view, const float[:, ::1] points, const float[:, ::1] pieces, End *ends, int i, int j
) noexcept nogil:
    """Whether the borders at two ends are about equally high: pieces of one tape on one floor."""
    cdef int k, e, piece
    cdef float low, high
    for k in range(2):
        e = i if k == 0 else j
        if ends[e].step < 0.0:
            piece = e // 2
            ends[e].step = _usual(
                view, &points[<int> pieces[piece, 0], 0], <int> pieces[piece, 1], e % 2 == 1, 0.5 * ends[e].width,
                3.0 * ends[e].width, 0.2 * ends[e].width,
            )
    low, high = ends[i].step, ends[j].step
    if low > high:
        low, high = high, low
    return low >= ALIKE * high


def join(
    const unsigned char[:, ::1] image,
    const unsigned char[:, ::1] valid,
    float sign,
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
    cdef View view = _view(image, valid, sign)
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
                    if _belong(&ends[i], &ends[j], corner) and _alike(&view, points, pieces, ends, i, j):
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
