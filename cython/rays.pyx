"""Kernels of robotd.solver.initial: the numpy functions there say what each does."""

from libc.math cimport INFINITY, cos, fabs, log, sin, sqrt
from libc.stdint cimport int64_t, uint8_t


cdef inline double _dot(const double* a, const double* b) noexcept nogil:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


cdef inline void _cross(const double* a, const double* b, double* out) noexcept nogil:
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def vote(
    const double[:, ::1] origin, const double[:, ::1] direction, const double[::1] weight, const int64_t[::1] stop,
    const int64_t[::1] order, const int64_t[::1] begins, const int64_t[::1] pair_begins, const int64_t[::1] first,
    const int64_t[::1] second, double tolerance, double least_sine, double farthest, double floor,
    double[:, ::1] points, uint8_t[::1] found,
):
    """For each label the point of a ray pair that most of its rays agree on, into `points` and `found`.

    The rays of label l are order[begins[l]:begins[l + 1]]; with n of them the pairs to try are those of
    first, second[pair_begins[n]:pair_begins[n + 1]].
    """
    cdef Py_ssize_t l, k, p, n, i, j, base
    cdef double cosine, determinant, s, t, score, best, square, length, along_a, along_b
    cdef const double* a
    cdef const double* b
    cdef double gap[3]
    cdef double X[3]
    cdef double toward[3]
    cdef double inverse = 1.0 / (tolerance * tolerance)
    with nogil:
        for l in range(begins.shape[0] - 1):
            base, n = begins[l], begins[l + 1] - begins[l]
            best = INFINITY
            for p in range(pair_begins[n], pair_begins[n + 1]):
                i, j = order[base + first[p]], order[base + second[p]]
                if stop[i] == stop[j]:
                    continue
                a, b = &direction[i, 0], &direction[j, 0]
                cosine = _dot(a, b)
                determinant = max(1.0 - cosine * cosine, 1e-12)
                if not determinant > least_sine * least_sine:
                    continue
                for k in range(3):
                    gap[k] = origin[i, k] - origin[j, k]
                along_a, along_b = _dot(a, gap), _dot(b, gap)
                s = (cosine * along_b - along_a) / determinant
                t = (along_b - cosine * along_a) / determinant
                if not (0.1 < s < farthest and 0.1 < t < farthest):
                    continue
                for k in range(3):
                    X[k] = 0.5 * (origin[i, k] + s * a[k] + origin[j, k] + t * b[k])
                if not X[2] > floor:
                    continue
                score = 0.0
                for k in range(n):
                    i = order[base + k]
                    toward[0], toward[1], toward[2] = X[0] - origin[i, 0], X[1] - origin[i, 1], X[2] - origin[i, 2]
                    length = 1.0 / (sqrt(_dot(toward, toward)) + 1e-12)
                    toward[0] = toward[0] * length - direction[i, 0]
                    toward[1] = toward[1] * length - direction[i, 1]
                    toward[2] = toward[2] * length - direction[i, 2]
                    square = _dot(toward, toward) * inverse
                    score += weight[i] * (square if square < 1.0 else 1.0)
                    if score >= best:
                        break
                if score < best:
                    best = score
                    points[l, 0], points[l, 1], points[l, 2] = X[0], X[1], X[2]
                    found[l] = True


cdef inline double _miss(
    const double* origin_a, const double* a, const double* origin_b, const double* b, const double* move, double c,
    double s, double* slope,
) noexcept nogil:
    """Sampson distance from coplanarity, and, into `slope` if not NULL, its derivatives by the move."""
    cdef double base[3]
    cdef double turned[3]
    cdef double normal[3]
    cdef double u[3]
    cdef double v[3]
    cdef double dbase[3]
    cdef double dturned[3]
    cdef double w[3]
    cdef double volume, square, root, dvolume, dsquare
    cdef int k
    base[0] = c * origin_b[0] - s * origin_b[1] + move[0] - origin_a[0]
    base[1] = s * origin_b[0] + c * origin_b[1] + move[1] - origin_a[1]
    base[2] = origin_b[2] - origin_a[2]
    turned[0], turned[1], turned[2] = c * b[0] - s * b[1], s * b[0] + c * b[1], b[2]
    _cross(a, turned, normal)
    volume = _dot(base, normal)
    _cross(base, a, u)
    _cross(base, turned, v)
    square = _dot(u, u) + _dot(v, v) + 1e-6
    root = 1.0 / sqrt(square)
    if slope != NULL:
        for k in range(3):
            dbase[0] = dbase[1] = dbase[2] = 0.0
            dturned[0] = dturned[1] = dturned[2] = 0.0
            if k < 2:
                dbase[k] = 1.0
            else:
                dbase[0] = -s * origin_b[0] - c * origin_b[1]
                dbase[1] = c * origin_b[0] - s * origin_b[1]
                dturned[0], dturned[1] = -turned[1], turned[0]
            _cross(a, dturned, w)
            dvolume = _dot(dbase, normal) + _dot(base, w)
            _cross(dbase, a, w)
            dsquare = 2.0 * _dot(u, w)
            _cross(dbase, turned, w)
            dsquare += 2.0 * _dot(v, w)
            _cross(base, dturned, w)
            dsquare += 2.0 * _dot(v, w)
            slope[k] = dvolume * root - 0.5 * volume * dsquare * root / square
    return volume * root


def losses(
    const double[:, ::1] origin, const double[:, ::1] direction, const int64_t[::1] first, const int64_t[::1] second,
    const int64_t[::1] begins, const double[:, ::1] move, double sigma, double[::1] loss,
):
    """Sum of log(1 + miss^2) of the ray pairs begins[m]:begins[m + 1] of every move."""
    cdef Py_ssize_t m, p, i, j
    cdef double c, s, miss, total, product
    with nogil:
        for m in range(begins.shape[0] - 1):
            c, s, total, product = cos(move[m, 2]), sin(move[m, 2]), 0.0, 1.0
            for p in range(begins[m], begins[m + 1]):
                i, j = first[p], second[p]
                miss = _miss(
                    &origin[i, 0], &direction[i, 0], &origin[j, 0], &direction[j, 0], &move[m, 0], c, s, NULL
                ) / sigma
                product *= 1.0 + miss * miss  # because a multiplication costs a tenth of a logarithm
                if product > 1e200:
                    total += log(product)
                    product = 1.0
            loss[m] = total + log(product)


def slopes(
    const double[:, ::1] origin, const double[:, ::1] direction, const int64_t[::1] first, const int64_t[::1] second,
    const int64_t[::1] begins, const double[:, ::1] move, double sigma, double[:, :, ::1] H, double[:, ::1] g,
):
    """Reweighted normal equations of the same, into H (M, 3, 3) and g (M, 3)."""
    cdef Py_ssize_t m, p, i, j, r, q
    cdef double c, s, miss, weight
    cdef double J[3]
    with nogil:
        for m in range(begins.shape[0] - 1):
            c, s = cos(move[m, 2]), sin(move[m, 2])
            for p in range(begins[m], begins[m + 1]):
                i, j = first[p], second[p]
                miss = _miss(
                    &origin[i, 0], &direction[i, 0], &origin[j, 0], &direction[j, 0], &move[m, 0], c, s, J
                ) / sigma
                weight = 1.0 / (1.0 + miss * miss)
                for r in range(3):
                    g[m, r] += weight * miss * J[r] / sigma
                    for q in range(3):
                        H[m, r, q] += weight * J[r] * J[q] / (sigma * sigma)
