"""Kernels of robotd.vision.cluster: DBSCAN with a grid over the first two features, and strokes sorted by cluster."""

from libc.math cimport log


cdef inline bint _near(const double *one, const double *two, Py_ssize_t dims, double limit) noexcept nogil:
    cdef double difference = one[0] - two[0], square = difference * difference
    cdef Py_ssize_t d
    difference = one[1] - two[1]
    square += difference * difference
    if square > limit:
        return False
    for d in range(2, dims):
        difference = one[d] - two[d]
        square += difference * difference
    return square <= limit


def dbscan(
    const double[:, ::1] features,
    double eps,
    int least,
    double[:, ::1] packed,
    int[:, ::1] work,
    int[::1] start,
    int[::1] counts,
    int[::1] labels,
    double origin_u,
    double origin_v,
    double cell,
    int columns,
    int rows,
):
    cdef Py_ssize_t n = features.shape[0], dims = features.shape[1], i, d
    cdef int cells = columns * rows, c, col, row, low, high, k, j, top, label = 0, current, next_row
    cdef double limit = eps * eps
    cdef int *cell_of = &work[0, 0]  # of each point, in the order given
    cdef int *place = &work[1, 0]  # of each point among the packed ones, which are sorted by cell
    cdef int *count = &work[2, 0]  # neighbours of each packed point
    cdef int *cluster = &work[3, 0]  # of each packed point
    cdef int *stack = &work[4, 0]
    cdef int *home = &work[5, 0]  # cell of each packed point
    cdef double *point = &packed[0, 0]
    with nogil:
        for c in range(cells + 2):
            start[c] = 0
        for i in range(n):
            col = <int> ((features[i, 0] - origin_u) / cell)
            row = <int> ((features[i, 1] - origin_v) / cell)
            col = columns - 1 if col >= columns else col
            row = rows - 1 if row >= rows else row
            cell_of[i] = row * columns + col
            start[cell_of[i] + 2] += 1
        for c in range(cells):
            start[c + 2] += start[c + 1]
        for i in range(n):  # afterwards cell c is start[c] to start[c + 1]
            k = start[cell_of[i] + 1]
            start[cell_of[i] + 1] += 1
            place[i] = k
            home[k] = cell_of[i]
            count[k] = 1  # itself
            cluster[k] = -1
            for d in range(dims):
                point[k * dims + d] = features[i, d]
        for k in range(n):  # each pair once: later points of the cell, the next cell, and three of the next row
            c = home[k]
            col, row = c % columns, c // columns
            high = start[c + 2] if col + 1 < columns else start[c + 1]
            for j in range(k + 1, high):
                if _near(point + k * dims, point + j * dims, dims, limit):
                    count[k] += 1
                    count[j] += 1
            if row + 1 == rows:
                continue
            next_row = c + columns
            low = start[next_row - 1 if col > 0 else next_row]
            high = start[next_row + 2 if col + 1 < columns else next_row + 1]
            for j in range(low, high):
                if _near(point + k * dims, point + j * dims, dims, limit):
                    count[k] += 1
                    count[j] += 1
        for i in range(n):  # in the order given, because clusters are numbered by their first core
            k = place[i]
            if cluster[k] != -1 or count[k] < least:
                continue
            cluster[k] = label
            stack[0] = k
            top = 1
            while top > 0:
                top -= 1
                current = stack[top]
                c = home[current]
                col, row = c % columns, c // columns
                for next_row in range(row - 1 if row > 0 else 0, row + 2 if row + 1 < rows else rows):
                    c = next_row * columns + col
                    low = start[c - 1 if col > 0 else c]
                    high = start[c + 2 if col + 1 < columns else c + 1]
                    for j in range(low, high):
                        if cluster[j] == -1 and _near(point + current * dims, point + j * dims, dims, limit):
                            cluster[j] = label
                            if count[j] >= least:
                                stack[top] = j
                                top += 1
            label += 1
        for i in range(n):
            labels[i] = cluster[place[i]]
            counts[i] = count[place[i]]
    return label


def features(const float[:, ::1] stroke, double reach, double width_weight, double turn_weight, double[:, ::1] out):
    cdef Py_ssize_t i
    cdef double tu, tv
    with nogil:
        for i in range(out.shape[0]):
            out[i, 0] = stroke[i, 0] / reach
            out[i, 1] = stroke[i, 1] / reach
            out[i, 2] = width_weight * log(stroke[i, 4])
            tu, tv = stroke[i, 2], stroke[i, 3]
            out[i, 3] = turn_weight * (tu * tu - tv * tv)
            out[i, 4] = turn_weight * 2.0 * tu * tv


def sort(
    const float[:, ::1] stroke,
    const int[::1] labels,
    const int[::1] counts,
    int clusters,
    int least,
    int[:, ::1] work,
    float[:, ::1] out,
    int[::1] out_counts,
    int[::1] first,
    int[::1] axis,
):
    cdef int n = <int> labels.shape[0], i, k, c, at = 0, kept = 0, best, size, d
    cdef int begin, end
    cdef int *sizes = &work[0, 0]
    cdef int *place = &work[1, 0]
    cdef int *member = &work[2, 0]
    cdef int *bins = &work[3, 0]  # at least as many as the image has rows or columns
    cdef float low_u, high_u, low_v, high_v
    cdef int room = <int> first.shape[0] - 1
    with nogil:
        for c in range(clusters):
            sizes[c] = 0
            place[c] = -1
        for i in range(n):
            if labels[i] >= 0:
                sizes[labels[i]] += 1
        first[0] = 0
        while kept < room:
            best = -1
            for c in range(clusters):
                if place[c] < 0 and sizes[c] >= least and (best < 0 or sizes[c] > sizes[best]):
                    best = c
            if best < 0:
                break
            place[best] = at
            at += sizes[best]
            kept += 1
            first[kept] = at
        # members in the order of their pixel along the cluster's longer side: first listed, then counted into place
        for i in range(n):
            c = labels[i]
            if c >= 0 and place[c] >= 0:
                member[place[c]] = i
                place[c] += 1
        for c in range(kept):
            low_u = low_v = 1e30
            high_u = high_v = -1e30
            for k in range(first[c], first[c + 1]):
                i = member[k]
                low_u = stroke[i, 0] if stroke[i, 0] < low_u else low_u
                high_u = stroke[i, 0] if stroke[i, 0] > high_u else high_u
                low_v = stroke[i, 1] if stroke[i, 1] < low_v else low_v
                high_v = stroke[i, 1] if stroke[i, 1] > high_v else high_v
            d = 0 if high_u - low_u >= high_v - low_v else 1
            axis[c] = d
            begin = <int> (low_u if d == 0 else low_v)
            end = <int> (high_u if d == 0 else high_v)
            for k in range(end - begin + 2):
                bins[k] = 0
            for k in range(first[c], first[c + 1]):
                bins[<int> stroke[member[k], d] - begin + 1] += 1
            for k in range(end - begin + 1):
                bins[k + 1] += bins[k]
            for k in range(first[c], first[c + 1]):
                i = member[k]
                at = first[c] + bins[<int> stroke[i, d] - begin]
                bins[<int> stroke[i, d] - begin] += 1
                for best in range(6):
                    out[at, best] = stroke[i, best]
                out_counts[at] = counts[i]
    return kept
