"""Elimination of the points, the step, and the descent."""

cdef double STALE_FROM = 3e8  # multiplications of a factorisation from which its reuse pays
cdef double TIGHT = 3e-3  # relative error of a step by conjugate gradients: 1e-5 of its gain is left to the next one
cdef double STEP_COST = 120.0  # of one of them per number in matrix and factor, in multiplications of a factorisation


cdef class Descent(Normals):
    """A least-squares problem ready to be solved."""

    cdef Factor factor
    cdef bint analysed
    cdef bint factored
    cdef Normal now
    cdef Normal then
    cdef double* S
    cdef double* V_inverse
    cdef double* right
    cdef double* step
    cdef double* point_step
    cdef double* trial_frame
    cdef double* trial_points
    cdef double* cg
    cdef Py_ssize_t* at  # of each stop, where the block of the current row and that stop starts

    cdef int _analyse(self) except -1:
        """Everything that depends on the structure only, when it is first needed."""
        cdef Arena arena = self.arena
        if self.analysed:
            return 0
        self._prepare()
        self._pattern()
        self.factor = Factor()
        self.factor.analyse(arena, self.nodes, self.width, self.first, self.begin, self.column, self.block)
        self.now, self.then = self._normal(), self._normal()
        self.S, self.V_inverse = arena.doubles(self.values), arena.doubles(6 * self.labels)
        self.right, self.step = arena.doubles(self.size), arena.doubles(self.size)
        self.point_step = arena.doubles(3 * self.labels)
        self.trial_frame = arena.doubles(self.entries)
        self.trial_points = arena.doubles(3 * self.labels)
        self.cg = arena.doubles(4 * self.size)
        self.at = arena.offsets(self.stops)
        self.analysed = True
        return 0

    def residuals(self, const double[::1] frame, const double[:, ::1] points, double sigma):
        """Whitened residuals (N, 2) and validity (N,) in the order of the sightings given; `sigma` is a floor in px."""
        cdef double[:, ::1] residual = np.empty((self.count, 2))
        cdef uint8_t[::1] seen = np.empty(self.count, dtype=np.uint8)
        cdef Shape loss
        loss.shape, loss.sigma, loss.width, loss.move_width = 0, sigma, INFINITY, INFINITY
        self._check(frame, points)
        if self.stop_axes == NULL:
            self._prepare()
        if self.count:
            with nogil:
                self._ordered(&points[0, 0], self.points)
                self._axes(&frame[0])
                self._sightings(self.points, &loss, NULL, &residual[0, 0], &seen[0], NULL, NULL)
        return np.asarray(residual), np.asarray(seen).view(np.bool_)

    def solve(
        self, const double[::1] frame, const double[:, ::1] points, int shape, double sigma, double width,
        double move_width, int iterations, double tolerance, double damping=1e-4,
    ):
        """Descend: frame (F,), points (l, 3), cost, iterations, converged. See Adjustment.solve."""
        cdef Shape loss
        cdef double[::1] end = np.array(frame)
        cdef double[:, ::1] end_points = np.empty((self.labels, 3))
        cdef int l, k
        cdef bint converged = False
        cdef int spent
        loss.shape, loss.sigma, loss.width, loss.move_width = shape, sigma, width, move_width
        self._check(frame, points)
        self._analyse()
        with nogil:
            self._ordered(&points[0, 0], self.points)
            spent = self._descend(&end[0], self.points, &loss, iterations, tolerance, damping, &converged)
            for l in range(self.labels):
                for k in range(3):
                    end_points[self.label_at[l], k] = self.points[3 * l + k]
        return np.asarray(end), np.asarray(end_points), self.now.cost, spent, converged

    cdef int _check(self, const double[::1] frame, const double[:, ::1] points) except -1:
        if frame.shape[0] != self.entries:
            raise ValueError(f"the frame vector has {frame.shape[0]} entries, not those of this problem")
        if points.shape[0] != self.labels or points.shape[1] != 3:
            raise ValueError(f"need points of shape ({self.labels}, 3), got ({points.shape[0]}, {points.shape[1]})")
        return 0

    cdef int _descend(
        self, double* frame, double* points, const Shape* loss, int iterations, double tolerance, double damping,
        bint* converged,
    ) noexcept nogil:
        cdef int iteration, k, entries = self.entries
        cdef double predicted, cost, trial, ratio
        cdef Normal swapped
        self.factored = False
        self.evaluate(frame, points, loss, &self.now)
        for iteration in range(1, iterations + 1):
            if not self._step(damping):
                damping *= 10.0
                continue
            predicted = self._predicted(damping)
            memcpy(self.trial_frame, frame, entries * sizeof(double))
            for k in range(self.size):
                self.trial_frame[self.entry_of[k]] += self.step[k]
            for k in range(3 * self.labels):
                self.trial_points[k] = points[k] + self.point_step[k]
            self.evaluate(self.trial_frame, self.trial_points, loss, &self.then)
            cost, trial = self.now.cost, self.then.cost
            if trial <= cost + 1e-12 * fabs(cost):
                ratio = (cost - trial) / max(predicted, 1e-300)
                damping = max(damping * (0.1 if ratio > 0.5 else 0.5 if ratio > 0.1 else 2.0), 1e-9)
                memcpy(frame, self.trial_frame, entries * sizeof(double))
                memcpy(points, self.trial_points, 3 * self.labels * sizeof(double))
                swapped = self.now
                self.now = self.then
                self.then = swapped
                if predicted < tolerance:
                    converged[0] = True
                    return iteration
            else:
                if predicted < tolerance:
                    converged[0] = True
                    return iteration
                damping = max(damping, 1e-6) * 10.0
                if damping > 1e8:
                    break
        return iterations

    cdef double _predicted(self, double damping) noexcept nogil:
        cdef int f, k, l, w
        cdef double total = 0.0, x
        cdef const double* V
        for f in range(self.stops):
            w = self.width[f]
            for k in range(w):
                x = self.step[self.first[f] + k]
                total += x * (damping * x * self.now.H[STOP * STOP * f + k * (w + 1)] - self.now.g[self.first[f] + k])
        for k in range(self.globals):
            l = self.first[self.stops] + k
            x = self.step[l]
            total += x * (damping * x * self.now.G[<Py_ssize_t>self.globals * l + k] - self.now.g[l])
        for l in range(self.labels):
            V = self.now.V + 6 * l
            for k in range(3):
                x = self.point_step[3 * l + k]
                total += x * (damping * x * V[3 * k - k * (k - 1) // 2] - self.now.p[3 * l + k])
        return 0.5 * total

    cdef bint _step(self, double damping) noexcept nogil:
        """The damped step; False if the matrix is not positive definite or the step not finite."""
        cdef int k
        self._eliminate(damping)
        memcpy(self.step, self.right, self.size * sizeof(double))
        if self.size and not self._reduced():
            return False
        self._points()
        for k in range(self.size):
            if not isfinite(self.step[k]):
                return False
        for k in range(3 * self.labels):
            if not isfinite(self.point_step[k]):
                return False
        return True

    cdef bint _reduced(self) noexcept nogil:
        """Solve the reduced system into `step`; a factor of an earlier matrix serves as preconditioner."""
        cdef double by_factor = self.factor.work, by_gradient = STEP_COST * (self.values + self.factor.entries)
        cdef int most = <int>(by_factor / by_gradient)
        if self.factored and by_factor > STALE_FROM and most > 2 and self._gradients(most):
            return True
        self.factored = self.factor.factorise(self.S) == 0
        if not self.factored:
            return False
        memcpy(self.step, self.right, self.size * sizeof(double))
        self.factor.solve(self.step)
        return True

    cdef bint _gradients(self, int most) noexcept nogil:
        """Preconditioned conjugate gradients (Hestenes and Stiefel 1952); False if `most` steps do not do."""
        cdef int n = self.size, k, i
        cdef double* x = self.step
        cdef double* r = self.cg
        cdef double* z = self.cg + n
        cdef double* p = self.cg + 2 * n
        cdef double* q = self.cg + 3 * n
        cdef double rz, before, begun, alpha, beta, wanted
        memcpy(r, self.right, n * sizeof(double))
        memcpy(z, r, n * sizeof(double))
        self.factor.solve(z)
        memset(x, 0, n * sizeof(double))
        memcpy(p, z, n * sizeof(double))
        rz = dot(r, z, n)
        begun, wanted = rz, TIGHT * TIGHT * rz
        for k in range(most):
            self._times(p, q)
            alpha = rz / dot(p, q, n)
            if not alpha > 0.0:
                return False
            for i in range(n):
                x[i] += alpha * p[i]
                r[i] -= alpha * q[i]
            memcpy(z, r, n * sizeof(double))
            self.factor.solve(z)
            before = rz
            rz = dot(r, z, n)
            if rz <= wanted:
                return True
            if k > 2 and (k + 1) * log(wanted / begun) < most * log(rz / begun):
                return False  # at this rate it would take longer than a new factor
            beta = rz / before
            for i in range(n):
                p[i] = z[i] + beta * p[i]
        return False

    cdef void _times(self, const double* x, double* y) noexcept nogil:
        cdef int a, b, k, i, j, wa, wb
        cdef const double* S
        cdef const double* xa
        cdef const double* xb
        cdef double* ya
        cdef double* yb
        cdef double total
        memset(y, 0, self.size * sizeof(double))
        for a in range(self.nodes):
            wa, xa, ya = self.width[a], x + self.first[a], y + self.first[a]
            for k in range(self.begin[a], self.begin[a + 1]):
                b = self.column[k]
                wb, xb, yb, S = self.width[b], x + self.first[b], y + self.first[b], self.S + self.block[k]
                if wa == 3 and wb == 3 and a != b:
                    for i in range(3):
                        ya[i] += S[3 * i] * xb[0] + S[3 * i + 1] * xb[1] + S[3 * i + 2] * xb[2]
                        yb[i] += S[i] * xa[0] + S[3 + i] * xa[1] + S[6 + i] * xa[2]
                    continue
                for i in range(wa):
                    total = 0.0
                    for j in range(wb):
                        total += S[i * wb + j] * xb[j]
                        if a != b:
                            yb[j] += S[i * wb + j] * xa[i]
                    ya[i] += total

    cdef void _eliminate(self, double damping) noexcept nogil:
        """Schur complement over the points: the matrix S and the right-hand side."""
        cdef int a, b, e, f, k, l, m, i, j, w, wb, wc, g = self.globals
        cdef double largest
        cdef double V[6]
        cdef double Y[30]
        cdef double* S
        cdef double* right
        cdef const double* W
        cdef const double* H
        cdef const double* p
        memset(self.S, 0, self.values * sizeof(double))
        for l in range(self.labels):
            memcpy(V, self.now.V + 6 * l, sizeof(V))
            largest = max(max(V[0], V[3]), V[5])
            V[0] += damping * V[0] + 1e-9 * largest + 1e-9
            V[3] += damping * V[3] + 1e-9 * largest + 1e-9
            V[5] += damping * V[5] + 1e-9 * largest + 1e-9
            _inverse(V, self.V_inverse + 6 * l)
        for k in range(self.size):
            self.right[k] = -self.now.g[k]
        for m in range(self.moves):
            if self.move_block[m] >= 0:
                w = self.width[self.before[m]] * self.width[self.after[m]]
                for k in range(w):
                    self.S[self.move_block[m] + k] += self.now.M[STOP * STOP * m + k]
        for a in range(self.stops):
            w = self.width[a]
            if w == 0:
                continue
            for k in range(self.begin[a], self.begin[a + 1]):
                self.at[self.column[k]] = self.block[k]
            S, H = self.S + self.at[a], self.now.H + STOP * STOP * a
            for k in range(w * w):
                S[k] += H[k]
            for k in range(w):
                S[k * (w + 1)] += damping * H[k * (w + 1)] + 1e-9
            right = self.right + self.first[a]
            for k in range(self.row_begin[a], self.row_begin[a + 1]):
                e = self.row_entries[k]
                l = self.entry_label[e]
                _times_inverse(self.now.W + self.entry_at[e], self.V_inverse + 6 * l, w, Y)
                p = self.now.p + 3 * l
                for i in range(w):
                    right[i] += Y[3 * i] * p[0] + Y[3 * i + 1] * p[1] + Y[3 * i + 2] * p[2]
                f = self.entry_begin[l]
                while f <= e and (a == 0 or self.entry_node[f] == 0 or (self.alike != 3 and self.alike != 5)):
                    b = self.entry_node[f]
                    wb = self.width[b]
                    subtract_product(self.S + self.at[b], wb, Y, w, self.now.W + self.entry_at[f], wb)
                    f += 1
                if f > e:
                    continue
                if w == 3:
                    subtract_row_3(self.S, self.at, Y, self.now.W, self.entry_at, self.entry_node, f, e)
                else:
                    subtract_row_5(self.S, self.at, Y, self.now.W, self.entry_at, self.entry_node, f, e)
        if g == 0:
            return
        S = self.S + self.last_row
        for k in range(g * self.size):
            S[k] = self.now.G[k]
        H = self.now.G + <Py_ssize_t>g * self.first[self.stops]
        S = self.S + self.last_row + <Py_ssize_t>g * self.first[self.stops]
        for k in range(g):
            S[k * (g + 1)] += damping * H[k * (g + 1)] + 1e-9
        for l in range(self.labels):
            p = self.now.p + 3 * l
            for e in range(self.camera_begin[l], self.entry_begin[l + 1]):
                i = self.camera_first[self.entry_node[e]]
                wc = self.camera_width[self.entry_node[e]]
                _times_inverse(self.now.W + self.entry_at[e], self.V_inverse + 6 * l, wc, Y)
                right = self.right + self.first[self.stops] + i
                for j in range(wc):
                    right[j] += Y[3 * j] * p[0] + Y[3 * j + 1] * p[1] + Y[3 * j + 2] * p[2]
                for f in range(self.entry_begin[l], self.camera_begin[l]):
                    b = self.entry_node[f]
                    wb = self.width[b]
                    subtract_product(
                        self.S + self.last_row + <Py_ssize_t>g * self.first[b] + i * wb, wb, Y, wc,
                        self.now.W + self.entry_at[f], wb,
                    )
                for f in range(self.camera_begin[l], self.entry_begin[l + 1]):
                    b = self.entry_node[f]
                    subtract_product(
                        S + i * g + self.camera_first[b], g, Y, wc, self.now.W + self.entry_at[f], self.camera_width[b]
                    )

    cdef void _points(self) noexcept nogil:
        """The points' part of the step, given the frame's."""
        cdef int l, e, k, w
        cdef double r[3]
        cdef const double* W
        cdef const double* V
        cdef const double* x
        for l in range(self.labels):
            for k in range(3):
                r[k] = -self.now.p[3 * l + k]
            for e in range(self.entry_begin[l], self.entry_begin[l + 1]):
                W = self.now.W + self.entry_at[e]
                if e < self.camera_begin[l]:
                    w, x = self.width[self.entry_node[e]], self.step + self.first[self.entry_node[e]]
                else:
                    w = self.camera_width[self.entry_node[e]]
                    x = self.step + self.first[self.stops] + self.camera_first[self.entry_node[e]]
                for k in range(w):
                    r[0] -= W[k] * x[k]
                    r[1] -= W[w + k] * x[k]
                    r[2] -= W[2 * w + k] * x[k]
            V = self.V_inverse + 6 * l
            self.point_step[3 * l] = V[0] * r[0] + V[1] * r[1] + V[2] * r[2]
            self.point_step[3 * l + 1] = V[1] * r[0] + V[3] * r[1] + V[4] * r[2]
            self.point_step[3 * l + 2] = V[2] * r[0] + V[4] * r[1] + V[5] * r[2]


cdef inline int _packed(int i, int j) noexcept nogil:
    """Where entry (i, j) of a symmetric 3x3 matrix is among its six."""
    return 3 * i - i * (i - 1) // 2 + (j - i) if i <= j else 3 * j - j * (j - 1) // 2 + (i - j)


cdef inline void _inverse(const double* V, double* out) noexcept nogil:
    """Inverse of a symmetric positive definite 3x3 matrix by its LDL' factors."""
    cdef double d0 = 1.0 / V[0], l1 = V[1] * d0, l2 = V[2] * d0
    cdef double d1 = 1.0 / (V[3] - l1 * V[1]), l3 = (V[4] - l2 * V[1]) * d1
    cdef double d2 = 1.0 / (V[5] - l2 * V[2] - l3 * (V[4] - l2 * V[1]))
    # rows of L^-1: (1), (-l1, 1), (l1 l3 - l2, -l3, 1)
    cdef double m = l1 * l3 - l2
    out[0] = d0 + l1 * l1 * d1 + m * m * d2
    out[1] = -l1 * d1 - m * l3 * d2
    out[2] = m * d2
    out[3] = d1 + l3 * l3 * d2
    out[4] = -l3 * d2
    out[5] = d2


cdef inline void _times_inverse(const double* W, const double* V, int w, double* Y) noexcept nogil:
    """Y (w, 3) = transpose of W (3, w) times the packed symmetric V."""
    cdef int i
    for i in range(w):
        Y[3 * i] = W[i] * V[0] + W[w + i] * V[1] + W[2 * w + i] * V[2]
        Y[3 * i + 1] = W[i] * V[1] + W[w + i] * V[3] + W[2 * w + i] * V[4]
        Y[3 * i + 2] = W[i] * V[2] + W[w + i] * V[4] + W[2 * w + i] * V[5]
