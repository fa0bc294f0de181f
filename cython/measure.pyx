"""Kernels of robotd.vision.stroke and robotd.vision.evidence: what speaks for a line, and where exactly it lies.

Their plain versions are in robotd/vision/measure_reference.py, which also says what each one computes.
"""

from libc.math cimport M_PI, atan2, atan2f, fabsf, floor, floorf, logf, sqrt, sqrtf

cdef float MOST_SLOPE = 0.08  # of the width along the line, that bends and tilted views explain
cdef float OUT_OF_VIEW = 1.5  # widths that an end beyond the view counts for


cdef int _resampled(const float *path, int count, float spacing, int least, float *out, int capacity) noexcept nogil:
    """Points at equal distances of about `spacing` along a polyline, both ends included; returns how many."""
    cdef int n, i, k = 0
    cdef float length = 0.0, du, dv, wanted, passed = 0.0, size, share
    for i in range(count - 1):
        du, dv = path[2 * i + 2] - path[2 * i], path[2 * i + 3] - path[2 * i + 1]
        length += sqrtf(du * du + dv * dv)
    n = <int> (length / spacing + 0.5) + 1
    n = least if n < least else (capacity if n > capacity else n)
    du, dv = path[2] - path[0], path[3] - path[1]
    size = sqrtf(du * du + dv * dv)
    for i in range(n):
        wanted = length * <float> i / <float> (n - 1)
        while k < count - 2 and passed + size < wanted:
            passed += size
            k += 1
            du, dv = path[2 * k + 2] - path[2 * k], path[2 * k + 3] - path[2 * k + 1]
            size = sqrtf(du * du + dv * dv)
        share = (wanted - passed) / size if size > 1e-9 else <float> 0.0
        share = 1.0 if share > 1.0 else share
        out[2 * i], out[2 * i + 1] = path[2 * k] + share * du, path[2 * k + 1] + share * dv
    return n


cdef inline void _tangent(const float *path, int count, int i, int reach, float *out) noexcept nogil:
    """Unit direction at a point over `reach` points to either side, fewer near the ends."""
    cdef int a = i - reach if i > reach else 0, b = i + reach if i + reach < count else count - 1
    cdef float du = path[2 * b] - path[2 * a], dv = path[2 * b + 1] - path[2 * a + 1], size = sqrtf(du * du + dv * dv)
    size = size if size > 1e-9 else <float> 1e-9
    out[0], out[1] = du / size, dv / size


cdef inline float _at(
    const unsigned char *image, const unsigned char *valid, bint masked, int height, int width, float u, float v
) noexcept nogil:
    """Grey level of the nearest pixel, or -1 outside."""
    cdef int col = <int> floorf(u + 0.5), row = <int> floorf(v + 0.5)
    if col < 0 or row < 0 or col >= width or row >= height:
        return -1.0
    if masked and valid[row * width + col] == 0:
        return -1.0
    return image[row * width + col]


cdef inline float _beside(
    const unsigned char *image, const unsigned char *valid, bint masked, int height, int width,
    const float *at, const float *t, float half, float from_, float step, int side,
) noexcept nogil:
    """Mean grey level of three places beside a line, in half widths of at least 4 px from its border; -1 outside."""
    cdef float unit = half if half > 4.0 else <float> 4.0, reach, value, total = 0.0
    cdef int k, shown = 0
    for k in range(3):
        reach = half + (from_ + step * k) * unit
        reach = reach if side == 1 else -reach
        value = _at(image, valid, masked, height, width, at[0] - reach * t[1], at[1] + reach * t[0])
        if value >= 0.0:
            total += value
            shown += 1
    return total / shown if shown > 0 else <float> -1.0


cdef inline float _log(float value, float low, float high) noexcept nogil:
    return logf(low if value < low else (high if value > high else value))


def judge(
    const unsigned char[:, ::1] image,
    const unsigned char[:, ::1] valid,
    const float[:, ::1] points,
    const float[:, ::1] pieces,
    int count,
    float sign,
    int strokes,
    float[:, ::1] scratch,
    float[:, ::1] out,
):
    cdef int height = <int> image.shape[0], width = <int> image.shape[1], p, n, i, k, side, shown, good, steps
    cdef bint masked = valid.shape[0] > 0
    cdef const unsigned char *grey = &image[0, 0]
    cdef const unsigned char *mask = &valid[0, 0] if valid.shape[0] > 0 else NULL
    cdef float *path = &scratch[0, 0]
    cdef int capacity = <int> scratch.shape[0] // 3
    cdef float *left = path + 2 * capacity  # step from the floor to the line, point by point
    cdef float *right = path + 3 * capacity
    cdef float *tone = path + 4 * capacity
    cdef float w, spacing, half, level, reach, value, inner, along, mean_left, mean_right, scatter, contrast, turn, total
    cdef float low, weaker, near
    cdef int nears
    cdef float[2] beyond  # contrast with the floor farther off, by side
    cdef int[2] beyonds
    cdef float[2] t
    cdef float[2] before
    cdef float[3] inside
    cdef float[2] beside
    total = 0.0
    with nogil:
        for p in range(count):
            total += pieces[p, 10]
        for p in range(count):
            w = pieces[p, 2]
            spacing = 0.25 * w if w > 4.0 else 1.0
            n = _resampled(&points[<int> pieces[p, 0], 0], <int> pieces[p, 1], spacing, 5, path, capacity)
            shown = 0
            inner = mean_left = mean_right = near = 0.0
            nears = 0
            for side in range(2):
                beyond[side] = 0.0
                beyonds[side] = 0
            for i in range(n):
                _tangent(path, n, i, 1, t)
                half = 0.5 * (w + pieces[p, 3] * pieces[p, 10] * (<float> i / <float> (n - 1) - 0.5))
                half = 0.25 * w if half < 0.25 * w else half
                level = 0.0
                for k in range(3):
                    inside[k] = _at(
                        grey, mask, masked, height, width,
                        path[2 * i] - (k - 1) * 0.45 * half * t[1], path[2 * i + 1] + (k - 1) * 0.45 * half * t[0],
                    )
                    level += inside[k]
                if inside[0] < 0.0 or inside[1] < 0.0 or inside[2] < 0.0:
                    continue
                level /= 3.0
                for side in range(2):
                    beside[side] = _beside(grey, mask, masked, height, width, path + 2 * i, t, half, 0.5, 0.25, side)
                if beside[0] < 0.0 or beside[1] < 0.0:
                    continue
                for k in range(3):
                    inner += fabsf(inside[k] - level)
                for side in range(2):
                    value = _beside(grey, mask, masked, height, width, path + 2 * i, t, half, 1.5, 0.5, side)
                    if value >= 0.0:
                        beyond[side] += sign * (level - value)
                        beyonds[side] += 1
                # how much of the step lies right at the borders
                reach = 0.3 * half if half > 5.0 else <float> 1.5
                for side in range(2):
                    turn = half if side == 1 else -half
                    weaker = turn - reach if side == 1 else turn + reach
                    value = turn + reach if side == 1 else turn - reach
                    inside[0] = _at(
                        grey, mask, masked, height, width, path[2 * i] - weaker * t[1], path[2 * i + 1] + weaker * t[0]
                    )
                    inside[2] = _at(
                        grey, mask, masked, height, width, path[2 * i] - value * t[1], path[2 * i + 1] + value * t[0]
                    )
                    if inside[0] >= 0.0 and inside[2] >= 0.0:
                        near += sign * (inside[0] - inside[2])
                        nears += 1
                tone[shown] = level
                left[shown], right[shown] = sign * (level - beside[0]), sign * (level - beside[1])
                mean_left += left[shown]
                mean_right += right[shown]
                shown += 1
            for k in range(17):
                out[p, k] = 0.0
            if shown < 3:
                continue
            inner /= 3 * shown
            mean_left /= shown
            mean_right /= shown
            contrast = 0.5 * (mean_left + mean_right)
            if contrast <= 1.0 or mean_left <= 0.0 or mean_right <= 0.0:
                continue
            scatter = along = 0.0
            good = 0
            for i in range(shown):
                scatter += fabsf(left[i] - mean_left) + fabsf(right[i] - mean_right)
                weaker = left[i] if left[i] < right[i] else right[i]
                good += weaker > 0.4 * contrast
                if i > 0:
                    along += fabsf(tone[i] - tone[i - 1])
            scatter /= 2 * shown
            along /= shown - 1
            # turn from width to width
            turn = 0.0
            steps = 0
            for i in range(2, n - 2, 4):
                _tangent(path, n, i, 2, t)
                if steps > 0:
                    turn += fabsf(before[0] * t[1] - before[1] * t[0])
                before[0], before[1] = t[0], t[1]
                steps += 1
            turn = turn / (steps - 1) if steps > 1 else <float> 0.3
            low = mean_left if mean_left < mean_right else mean_right
            out[p, 0] = 1.0
            # an end that is only out of view says that the line is longer than what is seen of it
            value = pieces[p, 10] / w
            if pieces[p, 8] > 0.0:
                value += 2.0 * OUT_OF_VIEW
            else:
                _tangent(path, n, 0, 2, t)
                if _at(grey, mask, masked, height, width, path[0] - w * t[0], path[1] - w * t[1]) < 0.0:
                    value += OUT_OF_VIEW
                _tangent(path, n, n - 1, 2, t)
                if _at(grey, mask, masked, height, width, path[2 * n - 2] + w * t[0], path[2 * n - 1] + w * t[1]) < 0.0:
                    value += OUT_OF_VIEW
            out[p, 1] = _log(value, 0.5, 15.0)
            value = 10.0 * (fabsf(pieces[p, 3]) - MOST_SLOPE)
            out[p, 2] = 0.0 if value < 0.0 else (2.0 if value > 2.0 else value)
            out[p, 3] = _log(near / (nears if nears > 0 else 1) / (0.7 * contrast), 0.3, 1.0)
            value = 10.0 * pieces[p, 4] / w
            out[p, 4] = 0.1 if value < 0.1 else (2.0 if value > 2.0 else value)
            value = 10.0 * pieces[p, 9] / w
            out[p, 5] = 0.1 if value < 0.1 else (2.0 if value > 2.0 else value)
            out[p, 6] = _log(contrast / (scatter + 1.0), 0.2, 12.0)
            out[p, 7] = _log(contrast, 1.0, 60.0)
            out[p, 8] = _log(low / (0.65 * contrast), 0.1, 1.0)
            out[p, 9] = <float> good / <float> shown
            out[p, 10] = _log(contrast / (inner + 1.0), 0.5, 30.0)
            out[p, 11] = _log(contrast / (along + 1.0), 0.5, 30.0)
            out[p, 12] = _log(turn, 0.02, 1.0)
            out[p, 13] = _log(pieces[p, 7] / <float> strokes, 0.01, 1.0)
            out[p, 14] = _log(pieces[p, 10] / total, 0.01, 1.0)
            out[p, 15] = _log(w / 3.0, 1.0, 4.0)
            value = contrast
            for side in range(2):
                if beyonds[side] > 0 and beyond[side] < value * beyonds[side]:
                    value = beyond[side] / beyonds[side]
            out[p, 16] = _log(value / (0.5 * contrast), 0.1, 1.0)


cdef inline float _between(const unsigned char *image, Py_ssize_t width, float u, float v) noexcept nogil:
    """Bilinear; the caller keeps (u, v) inside."""
    cdef Py_ssize_t col = <Py_ssize_t> u, row = <Py_ssize_t> v
    cdef float a = u - <float> col, b = v - <float> row
    cdef const unsigned char *at = image + row * width + col
    return (1.0 - b) * ((1.0 - a) * at[0] + a * at[1]) + b * ((1.0 - a) * at[width] + a * at[width + 1])


cdef void _border(
    const unsigned char *image, const unsigned char *valid, bint masked, int height, int width,
    float u, float v, float tu, float tv, float half, float side, float sign, int samples, float along, float *out,
) noexcept nogil:
    """Distance of the line's border from (u, v) along its normal, out[0], and its slope, out[1], 0 if there is none."""
    cdef float[64] profile
    cdef float[64] slope
    cdef float start = half - 0.5 * (samples - 1), reach, total, value, peak = 0.0, before, after, bend, x, y
    cdef int k, m, best = -1
    out[0] = out[1] = 0.0
    for k in range(samples):
        reach = side * (start + k)
        total = 0.0
        for m in range(-1, 2):
            x = u - reach * tv + along * m * tu
            y = v + reach * tu + along * m * tv
            if not (0.0 <= x < width - 1 and 0.0 <= y < height - 1):
                return
            if masked and valid[<int> y * width + <int> x] == 0:
                return
            total += _between(image, width, x, y)
        profile[k] = total
    for k in range(1, samples - 1):
        slope[k] = -sign * (profile[k + 1] - profile[k - 1])  # positive: the floor lies further out
    for k in range(2, samples - 2):
        value = slope[k - 1] + 2.0 * slope[k] + slope[k + 1]
        if value > peak:
            peak = value
            best = k
    if best < 3 or best > samples - 4:
        return
    before = slope[best - 2] + 2.0 * slope[best - 1] + slope[best]
    after = slope[best] + 2.0 * slope[best + 1] + slope[best + 2]
    bend = before - 2.0 * peak + after
    if bend >= 0.0:
        return
    out[0] = start + best + 0.5 * (before - after) / bend
    out[1] = peak / 24.0


cdef float _median(float *values, int n) noexcept nogil:
    """Upper median; the values are left in another order."""
    cdef int low = 0, high = n - 1, middle = n // 2, i, j
    cdef float pivot, swap
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                swap = values[i]
                values[i] = values[j]
                values[j] = swap
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            break
    return values[middle]


cdef int _prolonged(
    const unsigned char *valid, bint masked, int height, int width, const float *path, int count, bint last, float reach,
    float *out,
) noexcept nogil:
    """The point where a line, prolonged straight by at most `reach`, leaves the view: 1 and out, or 0."""
    cdef int k = count - 1 if last else 0, move = -1 if last else 1, other = k, col, row
    cdef float du, dv, size, gone = 0.0, u, v
    cdef bint inside = True
    while 0 <= other + move < count and gone < reach:
        du, dv = path[2 * (other + move)] - path[2 * other], path[2 * (other + move) + 1] - path[2 * other + 1]
        gone += sqrtf(du * du + dv * dv)
        other += move
    du, dv = path[2 * k] - path[2 * other], path[2 * k + 1] - path[2 * other + 1]
    size = sqrtf(du * du + dv * dv)
    if size <= 0.0:
        return 0
    du /= size
    dv /= size
    size = 0.0
    while size <= reach:
        u, v = path[2 * k] + (size + 1.0) * du, path[2 * k + 1] + (size + 1.0) * dv
        col, row = <int> floorf(u + 0.5), <int> floorf(v + 0.5)
        if col < 0 or row < 0 or col >= width or row >= height or (masked and valid[row * width + col] == 0):
            if size <= 0.0:
                return 0
            out[0], out[1] = path[2 * k] + size * du, path[2 * k + 1] + size * dv
            return 1
        size += 1.0
    return 0


def refine(
    const unsigned char[:, ::1] image,
    const unsigned char[:, ::1] valid,
    const float[:, ::1] path,
    float width,
    float slope,
    bint closed,
    float grain,
    float sign,
    float[:, ::1] scratch,
    double[:, ::1] out,
):
    cdef int rows = <int> image.shape[0], columns = <int> image.shape[1], count = <int> path.shape[0]
    cdef bint masked = valid.shape[0] > 0
    cdef const unsigned char *grey = &image[0, 0]
    cdef const unsigned char *mask = &valid[0, 0] if valid.shape[0] > 0 else NULL
    cdef int capacity = <int> scratch.shape[0] // 8, n, i, j, k, samples, window, seen, first = 0
    cdef float *rough = &scratch[0, 0]
    cdef float *line = rough + 2 * capacity
    cdef float *shift = rough + 4 * capacity
    cdef float *strength = rough + 5 * capacity
    cdef float *measured = rough + 6 * capacity
    cdef float *sorted_ = rough + 7 * capacity
    cdef float *normal = rough + 8 * capacity
    cdef float half, spacing, search, along, weight, total, taper, level, w, reach, length = 0.0, du, dv
    cdef float turn = 0.0, dot, cross, x, y
    cdef float[2] t
    cdef float[2] one
    cdef float[2] two
    cdef int near, far, least
    with nogil:
        count = capacity - 2 if count > capacity - 2 else count
        w = width * grain
        for i in range(count):
            rough[2 * i + 2] = (path[i, 0] + 0.5) * grain - 0.5
            rough[2 * i + 3] = (path[i, 1] + 0.5) * grain - 0.5
        first = 1
        if not closed:
            if _prolonged(mask, masked, rows, columns, rough + 2, count, False, 1.2 * w, one):
                rough[0], rough[1] = one[0], one[1]
                first = 0
            if _prolonged(mask, masked, rows, columns, rough + 2, count, True, 1.2 * w, two):
                rough[2 * count + 2], rough[2 * count + 3] = two[0], two[1]
                count += 1
            count += 1 - first
        spacing = 0.15 * w if w > 13.3333 else 2.0
        n = _resampled(rough + 2 * first, count, spacing, 4, line, capacity)
        for i in range(n - 1):
            du, dv = line[2 * i + 2] - line[2 * i], line[2 * i + 3] - line[2 * i + 1]
            length += sqrtf(du * du + dv * dv)
        spacing = length / (n - 1)
        window = <int> (w / spacing + 0.5)
        window = 2 if window < 2 else window
        window = (n - 1) // 2 if window > (n - 1) // 2 else window
        search = 0.12 * w + grain
        search = 2.5 if search < 2.5 else (24.0 if search > 24.0 else search)
        samples = 2 * <int> (search + 1.0) + 7
        samples = 63 if samples > 63 else samples
        along = 0.12 * w if w < 16.0 else 2.0
        seen = 0
        for i in range(n):
            _tangent(line, n, i, window // 2 if window > 3 else 1, t)
            normal[2 * i], normal[2 * i + 1] = -t[1], t[0]
            taper = width + slope * (<float> i / <float> (n - 1) - 0.5) * length / grain
            half = 0.5 * grain * (taper if taper > 0.5 * width else 0.5 * width)
            _border(grey, mask, masked, rows, columns, line[2 * i], line[2 * i + 1], t[0], t[1], half, -1.0, sign, samples, along, one)
            _border(grey, mask, masked, rows, columns, line[2 * i], line[2 * i + 1], t[0], t[1], half, 1.0, sign, samples, along, two)
            shift[i] = 0.5 * (two[0] - one[0])
            measured[i] = one[0] + two[0]
            strength[i] = one[1] if one[1] < two[1] else two[1]
            if strength[i] > 0.0 and fabsf(measured[i] - 2.0 * half) > 0.2 * w + 1.0:
                strength[i] = 0.0
            if strength[i] > 0.0:
                sorted_[seen] = strength[i]
                seen += 1
        if seen > 0:
            level = 0.4 * _median(sorted_, seen)
            seen = 0
            for i in range(n):
                if strength[i] <= level:
                    strength[i] = 0.0
                else:
                    sorted_[seen] = measured[i]
                    seen += 1
            if seen > 0:
                width = _median(sorted_, seen) / grain
        for i in range(n):
            weight = total = 0.0
            for k in range(-window, window + 1):
                j = i + k
                if closed:
                    j = (j + n - 1) % (n - 1)
                elif j < 0 or j >= n:
                    continue
                if strength[j] > 0.0:
                    # a parabola as the window, because it needs no cosine
                    level = 1.0 - <float> (k * k) / <float> ((window + 1) * (window + 1))
                    weight += level
                    total += level * shift[j]
            total = total / (weight if weight > 0.5 else <float> 0.5)
            out[i, 0] = line[2 * i] + total * normal[2 * i]
            out[i, 1] = line[2 * i + 1] + total * normal[2 * i + 1]
        # the sharpest turn from arm to arm
        near, far, least = <int> (0.8 * w / spacing + 0.5), <int> (2.0 * w / spacing + 0.5), <int> (0.6 * w / spacing + 0.5)
        for i in range(near + least, n - near - least):
            j = i - far if i > far else 0
            k = i + far if i + far < n else n - 1
            one[0], one[1] = <float> (out[i - near, 0] - out[j, 0]), <float> (out[i - near, 1] - out[j, 1])
            two[0], two[1] = <float> (out[k, 0] - out[i + near, 0]), <float> (out[k, 1] - out[i + near, 1])
            dot = one[0] * two[0] + one[1] * two[1]
            cross = fabsf(one[0] * two[1] - one[1] * two[0])
            x = atan2f(cross, dot)
            turn = x if x > turn else turn
    return n, width * grain, turn


def shape(
    const double[:, ::1] points,
    double reach,
    bint closed,
    double[:, ::1] normals,
    double[::1] heading,
    double[::1] curvature,
):
    cdef int n = <int> points.shape[0], i, a, b, j, half
    cdef double du, dv, size, angle, count, s, t, st, ss, offset, total = 0.0
    with nogil:
        for i in range(n - 1):
            du, dv = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
            total += sqrt(du * du + dv * dv)
        for i in range(n):
            a, b = (i - 1 if i > 0 else 0), (i + 1 if i + 1 < n else n - 1)
            if closed and (i == 0 or i == n - 1):
                a, b = n - 2, 1
            du, dv = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            size = sqrt(du * du + dv * dv)
            size = size if size > 1e-12 else 1e-12
            normals[i, 0], normals[i, 1] = -dv / size, du / size
            angle = atan2(dv, du)
            if i > 0:
                angle += 2.0 * M_PI * floor((heading[i - 1] - angle) / (2.0 * M_PI) + 0.5)
            heading[i] = angle
        half = <int> (0.5 * reach * (n - 1) / (total if total > 1e-12 else 1e-12) + 0.5)
        half = 1 if half < 1 else half
        for i in range(n):
            count = s = t = st = ss = 0.0
            for j in range(i - half, i + half + 1):
                if closed:
                    a = (j + n - 1) % (n - 1)
                    offset = heading[n - 1] - heading[0]
                    angle = heading[a] + (offset if j >= n - 1 else (-offset if j < 0 else 0.0))
                elif 0 <= j < n:
                    angle = heading[j]
                else:
                    continue
                count += 1.0
                s += j - i
                t += angle
                st += (j - i) * angle
                ss += (j - i) * (j - i)
            size = count * ss - s * s
            curvature[i] = (count * st - s * t) / size * (n - 1) / total if size > 0.0 and total > 0.0 else 0.0
