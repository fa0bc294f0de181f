"""Kernel of robotd.vision.cluster: DBSCAN with a grid over the first two features."""

from libc.math cimport sqrt


def dbscan(
    const double[:, ::1] features,
    double eps,
    int least,
    int[::1] cell_of,
    int[::1] start,
    int[::1] order,
    int[::1] stack,
    int[::1] counts,
    int[::1] labels,
    double origin_u,
    double origin_v,
    double cell,
    int columns,
    int rows,
):
    cdef Py_ssize_t n = features.shape[0], dims = features.shape[1], i, d
    cdef int c, col, row, neighbour, first, last, k, j, top, label = 0, current
    cdef double square, difference, limit = eps * eps
    with nogil:
        for c in range(columns * rows + 1):
            start[c] = 0
        for i in range(n):
            col = <int> ((features[i, 0] - origin_u) / cell)
            row = <int> ((features[i, 1] - origin_v) / cell)
            col = columns - 1 if col >= columns else col
            row = rows - 1 if row >= rows else row
            cell_of[i] = row * columns + col
            start[cell_of[i] + 1] += 1
            counts[i] = 0
            labels[i] = -1
        for c in range(columns * rows):
            start[c + 1] += start[c]
        for i in range(n - 1, -1, -1):
            start[cell_of[i] + 1] -= 1
            order[start[cell_of[i] + 1]] = <int> i
        # now start[c + 1] is where cell c begins, and it ends where cell c + 1 begins
        for i in range(n):
            col, row = cell_of[i] % columns, cell_of[i] // columns
            for neighbour in range(max(row - 1, 0), min(row + 2, rows)):
                first = start[neighbour * columns + max(col - 1, 0) + 1]
                last = _end(start, neighbour * columns + min(col + 1, columns - 1), columns * rows, <int> n)
                for k in range(first, last):
                    j = order[k]
                    if j < i:  # each pair once
                        continue
                    square = 0.0
                    for d in range(dims):
                        difference = features[i, d] - features[j, d]
                        square += difference * difference
                    if square <= limit:
                        counts[i] += 1
                        if j != i:
                            counts[j] += 1
        for i in range(n):
            if labels[i] != -1 or counts[i] < least:
                continue
            labels[i] = label
            stack[0] = <int> i
            top = 1
            while top > 0:
                top -= 1
                current = stack[top]
                col, row = cell_of[current] % columns, cell_of[current] // columns
                for neighbour in range(max(row - 1, 0), min(row + 2, rows)):
                    first = start[neighbour * columns + max(col - 1, 0) + 1]
                    last = _end(start, neighbour * columns + min(col + 1, columns - 1), columns * rows, <int> n)
                    for k in range(first, last):
                        j = order[k]
                        if labels[j] != -1:
                            continue
                        square = 0.0
                        for d in range(dims):
                            difference = features[current, d] - features[j, d]
                            square += difference * difference
                        if square <= limit:
                            labels[j] = label
                            if counts[j] >= least:
                                stack[top] = j
                                top += 1
            label += 1
    return label


cdef inline int _end(const int[::1] start, int c, int cells, int n) noexcept nogil:
    return start[c + 2] if c + 1 < cells else n
