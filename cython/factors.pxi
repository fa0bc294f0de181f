"""Moves and beacons seen from the roof, summed into the normal equations; what `Normal` holds, and how losses count."""


cdef struct Shape:
    int shape  # 0 square, 1 cauchy, 2 geman-mcclure
    double sigma
    double width
    double move_width


cdef struct Normal:
    # blocks are row-major; those of stops start at STOP * STOP times the stop, those of moves likewise
    double cost
    double* H
    double* M
    double* G  # rows of cameras and odometry factors: a block for every stop, then their own
    double* V  # xx xy xz yy yz zz of each label
    double* W  # of each entry, (3, width)
    double* g
    double* p


cdef inline double _loss(int shape, double width, double square, double* weight) noexcept nogil:
    cdef double c
    if shape == 0 or isinf(width):
        weight[0] = 1.0
        return square
    c = width * width
    weight[0] = c / (c + square)
    if shape == 1:
        return c * log1p(square / c)
    square *= weight[0]
    weight[0] *= weight[0]
    return square


cdef inline double _wrapped(double angle) noexcept nogil:
    angle = fmod(PI - angle, 2.0 * PI)
    return PI - (angle + 2.0 * PI if angle < 0.0 else angle)


cdef class Factors(Structure):
    """Measurements without labels: each has to do with one or two stops, and with columns of the last node."""

    cdef double* stop_axes  # of each stop: R_robot_world, x, y, sine and cosine of its roll

    cdef void _moves(self, const double* frame, const Shape* loss, Normal* n) noexcept nogil:
        cdef int m, i, j, k, a, b, wa, wb, r
        cdef double c, s, dx, dy, weight, square, scale, turn, drift
        cdef const double* z
        cdef const double* L
        cdef const double* x
        cdef const double* y
        cdef double e[3]
        cdef double whitened[3]
        cdef double D[3 * MOVE]  # before, after, odometry factors
        cdef double LD[3 * MOVE]
        cdef double shared[3 * ODOMETRY]
        cdef double* block
        cdef int column[ODOMETRY]
        cdef int* active
        scale, turn, drift = frame[self.odometry_entry], frame[self.odometry_entry + 1], frame[self.odometry_entry + 2]
        for m in range(self.moves):
            a, b = self.before[m], self.after[m]
            z, L = self.moved + 21 * m, self.moved + 21 * m + 3
            x, y = frame + STOP * a, frame + STOP * b
            c, s = cos(x[2]), sin(x[2])
            dx, dy = y[0] - x[0], y[1] - x[1]
            memset(D, 0, sizeof(D))
            e[0] = c * dx + s * dy
            e[1] = -s * dx + c * dy
            D[3], D[4], D[MOVE + 3], D[MOVE + 4], D[2 * MOVE + 5] = c, s, -s, c, 1.0
            for i in range(3):
                for j in range(3):
                    D[MOVE * i + j] = -D[MOVE * i + 3 + j]
            D[2], D[MOVE + 2] = e[1], -e[0]
            for i in range(3):
                for j in range(ODOMETRY):
                    D[MOVE * i + 6 + j] = -L[9 + ODOMETRY * i + j]
            e[0] -= z[0]
            e[1] -= z[1]
            e[2] = _wrapped(y[2] - x[2] - z[2])
            for i in range(3):
                e[i] += D[MOVE * i + 6] * scale + D[MOVE * i + 7] * turn + D[MOVE * i + 8] * drift
            square = 0.0
            for i in range(3):
                whitened[i] = L[3 * i] * e[0] + L[3 * i + 1] * e[1] + L[3 * i + 2] * e[2]
                square += whitened[i] * whitened[i]
                for j in range(MOVE):
                    LD[MOVE * i + j] = L[3 * i] * D[j] + L[3 * i + 1] * D[MOVE + j] + L[3 * i + 2] * D[2 * MOVE + j]
            n.cost += _loss(1, loss.move_width, square, &weight)
            wa, wb = self.width[a], self.width[b]
            # a stop's free entries start with its planar ones, unless these are held fixed
            self._factor(n, a, LD, MOVE, 3, 3, whitened, weight)
            self._factor(n, b, LD + 3, MOVE, 3, 3, whitened, weight)
            block = n.M + STOP * STOP * m
            for i in range(wb):
                if self.active[STOP * b + i] > 2:
                    continue
                for j in range(wa):
                    if self.active[STOP * a + j] > 2:
                        continue
                    for r in range(3):
                        block[i * wa + j] += (
                            weight * LD[MOVE * r + 3 + self.active[STOP * b + i]]
                            * LD[MOVE * r + self.active[STOP * a + j]]
                        )
            active = self.active + self.odometry_entry
            for i in range(self.odometry_width):
                column[i] = self.odometry_first + i
                for r in range(3):
                    shared[ODOMETRY * r + i] = LD[MOVE * r + 6 + active[i]]
            self._shared(n, column, shared, ODOMETRY, self.odometry_width, 3, whitened, weight)
            self._coupled(n, a, LD, MOVE, 3, column, shared, ODOMETRY, self.odometry_width, 3, weight)
            self._coupled(n, b, LD + 3, MOVE, 3, column, shared, ODOMETRY, self.odometry_width, 3, weight)

    cdef void _shared(
        self, Normal* n, const int* column, const double* J, int pitch, int count, int rows, const double* e, double weight
    ) noexcept nogil:
        """Add J' J and J' e of a factor to columns of the last node."""
        cdef int i, j, r, from_ = self.first[self.stops]
        cdef double* out
        for i in range(count):
            out = n.G + <Py_ssize_t>self.globals * (from_ + column[i])
            for r in range(rows):
                n.g[from_ + column[i]] += weight * J[r * pitch + i] * e[r]
                for j in range(count):
                    out[column[j]] += weight * J[r * pitch + i] * J[r * pitch + j]

    cdef void _coupled(
        self, Normal* n, int stop, const double* J, int pitch, int entries, const int* column, const double* shared,
        int shared_pitch, int count, int rows, double weight
    ) noexcept nogil:
        """Add what a factor makes columns of the last node and a stop have to do with each other."""
        cdef int i, j, r, w = self.width[stop]
        cdef int* active = self.active + STOP * stop
        cdef double* out
        for i in range(count):
            out = n.G + <Py_ssize_t>self.globals * self.first[stop] + column[i] * w
            for j in range(w):
                if active[j] < entries:
                    for r in range(rows):
                        out[j] += weight * shared[r * shared_pitch + i] * J[r * pitch + active[j]]

    cdef void _factor(
        self, Normal* n, int stop, const double* J, int pitch, int entries, int rows, const double* e, double weight
    ) noexcept nogil:
        """Add J' J and J' e of a factor to a stop; J has columns for its first `entries` entries."""
        cdef int i, j, r, w = self.width[stop]
        cdef int* active = self.active + STOP * stop
        for i in range(w):
            if active[i] >= entries:
                continue
            for r in range(rows):
                n.g[self.first[stop] + i] += weight * J[r * pitch + active[i]] * e[r]
                for j in range(w):
                    if active[j] < entries:
                        n.H[STOP * STOP * stop + i * w + j] += (
                            weight * J[r * pitch + active[i]] * J[r * pitch + active[j]]
                        )

    cdef void _roofs(self, const double* frame, const Shape* loss, Normal* n) noexcept nogil:
        cdef int i, k, j, f, plane, count
        cdef double weight, square, x, y, w, u, v, step
        cdef const double* R
        cdef const double* given
        cdef const double* axes
        cdef const double* own
        cdef int* active
        cdef int column[ROOF + BEACON]
        cdef double shared[2 * (ROOF + BEACON)]
        cdef double b[3]
        cdef double H[9]
        cdef double h[3]
        cdef double arm[3]
        cdef double skewed[9]
        cdef double moved[9]
        cdef double by_world[4]
        cdef double J[10]
        cdef double e[2]
        for i in range(self.roofs):
            f = self.roof_stop[i]
            R, given = self.stop_axes + 13 * f, self.roof + 15 * i
            plane = self.roof_plane[2 * i]
            axes, own = self.plane_axes + 9 * ROOF * plane, frame + self.plane_entry[plane]
            for k in range(9):
                H[k] = given[6 + k]
                for j in range(ROOF):
                    H[k] += own[j] * axes[9 * j + k]
            own = frame + self.plane_entry[self.roof_plane[2 * i + 1]]
            b[0], b[1], b[2] = given[0] + own[0], given[1] + own[1], given[2]
            for k in range(3):
                arm[k] = R[k] * b[0] + R[3 + k] * b[1] + R[6 + k] * b[2]
            x, y = R[9] + arm[0], R[10] + arm[1]
            w = H[6] * x + H[7] * y + H[8]
            u, v = (H[0] * x + H[1] * y + H[2]) / w, (H[3] * x + H[4] * y + H[5]) / w
            by_world[0], by_world[1] = (H[0] - u * H[6]) / w, (H[1] - u * H[7]) / w
            by_world[2], by_world[3] = (H[3] - v * H[6]) / w, (H[4] - v * H[7]) / w
            skewed[0] = skewed[4] = skewed[8] = 0.0
            skewed[1], skewed[2], skewed[5] = -b[2], b[1], -b[0]
            skewed[3], skewed[6], skewed[7] = b[2], -b[1], b[0]
            # minus the first two rows of R_world_robot times skew
            for k in range(2):
                for j in range(3):
                    moved[3 * k + j] = -(R[k] * skewed[j] + R[3 + k] * skewed[3 + j] + R[6 + k] * skewed[6 + j])
            square = 0.0
            for k in range(2):
                J[5 * k], J[5 * k + 1] = by_world[2 * k], by_world[2 * k + 1]
                J[5 * k + 2] = -by_world[2 * k] * arm[1] + by_world[2 * k + 1] * arm[0]
                for j in range(3):
                    skewed[j] = by_world[2 * k] * moved[j] + by_world[2 * k + 1] * moved[3 + j]
                J[5 * k + 3] = skewed[0]
                J[5 * k + 4] = skewed[1] * R[12] - skewed[2] * R[11]
                e[k] = ((u if k == 0 else v) - given[3 + k]) / given[5]
                square += e[k] * e[k]
                for j in range(5):
                    J[5 * k + j] /= given[5]
            n.cost += _loss(1, loss.move_width, square, &weight)
            self._factor(n, f, J, 5, 5, 2, e, weight)
            count = self.plane_width[plane]
            active = self.active + self.plane_entry[plane]
            for j in range(count):
                column[j] = self.plane_first[plane] + j
                own = axes + 9 * active[j]
                for k in range(3):
                    h[k] = own[3 * k] * x + own[3 * k + 1] * y + own[3 * k + 2]
                shared[j] = (h[0] - u * h[2]) / (w * given[5])
                shared[ROOF + BEACON + j] = (h[1] - v * h[2]) / (w * given[5])
            plane = self.roof_plane[2 * i + 1]
            active = self.active + self.plane_entry[plane]
            for j in range(self.plane_width[plane]):
                column[count] = self.plane_first[plane] + j
                for k in range(2):
                    step = by_world[2 * k] * R[3 * active[j]] + by_world[2 * k + 1] * R[3 * active[j] + 1]
                    shared[(ROOF + BEACON) * k + count] = step / given[5]
                count += 1
            self._shared(n, column, shared, ROOF + BEACON, count, 2, e, weight)
            self._coupled(n, f, J, 5, 5, column, shared, ROOF + BEACON, count, 2, weight)
