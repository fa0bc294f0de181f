"""Covariances from the inverse on the factor's pattern."""


cdef class Bundle(Descent):
    """A least-squares problem; arrays are those of robotd.solver.bundle.Adjustment."""

    def covariance(self, const double[::1] frame, const double[:, ::1] points):
        """Covariances at a least-squares optimum: points (l, 3, 3), stops (S, 3, 3), predictions (N, 3).

        None if the matrix is too nearly singular for its factor to be trusted.
        """
        cdef Shape loss
        cdef double[:, :, ::1] of_points = np.empty((self.labels, 3, 3))
        cdef double[:, :, ::1] of_stops = np.zeros((self.stops, 3, 3))
        cdef double[:, ::1] predicted = np.zeros((self.count, 3))
        cdef double[:, :, ::1] by_frame = np.zeros((self.count, 2, 15))
        cdef double[:, :, ::1] by_point = np.zeros((self.count, 2, 3))
        cdef uint8_t[::1] seen = np.empty(self.count, dtype=np.uint8)
        cdef double[:, ::1] residual = np.empty((self.count, 2))
        cdef double[::1] Z
        cdef double block[25]
        cdef int f, i, j, w
        loss.shape, loss.sigma, loss.width, loss.move_width = 0, 0.0, INFINITY, INFINITY
        self._check(frame, points)
        self._analyse()
        with nogil:
            self._ordered(&points[0, 0], self.points)
            self.evaluate(&frame[0], self.points, &loss, &self.now)
            self._eliminate(0.0)
            i = self.factor.factorise(self.S)
        if i or self._doubtful():
            return None
        Z = np.empty(self.factor.entries)
        self.factor.invert(&Z[0])
        for f in range(self.stops):
            w = self.width[f]
            if w == 0:
                continue
            self.factor.block_of(&Z[0], f, 0, w, f, 0, w, block)
            for i in range(w):
                for j in range(w):
                    if self.active[STOP * f + i] < 3 and self.active[STOP * f + j] < 3:
                        of_stops[f, self.active[STOP * f + i], self.active[STOP * f + j]] = block[i * w + j]
        if self.count:
            with nogil:
                self._sightings(
                    self.points, &loss, NULL, &residual[0, 0], &seen[0], &by_frame[0, 0, 0], &by_point[0, 0, 0]
                )
        self._of_points(&Z[0], &of_points[0, 0, 0], &predicted[0, 0], &by_frame[0, 0, 0], &by_point[0, 0, 0])
        return np.asarray(of_points), np.asarray(of_stops), np.asarray(predicted)

    cdef bint _doubtful(self) noexcept nogil:
        """Whether some pivot lost nearly all digits of its diagonal entry."""
        cdef int f, k, w, p, s
        cdef double pivot, diagonal
        for f in range(self.nodes):
            w, p = self.width[f], self.factor.place[f]
            if w == 0:
                continue
            s = self.factor.super_of[p]
            for k in range(w):
                pivot = self.factor.L[
                    self.factor.panel[s]
                    + (self.factor.start[p] + k - self.factor.start[self.factor.opens[s]])
                    * <Py_ssize_t>(self.factor.height[s] + 1)
                ]
                if f < self.stops:
                    diagonal = self.S[self.block[self.begin[f]] + k * (w + 1)]
                else:
                    diagonal = self.S[self.last_row + <Py_ssize_t>w * self.first[f] + k * (w + 1)]
                if not pivot * pivot > 1e-11 * diagonal:
                    return True
        return False

    cdef int _of_points(
        self, const double* Z, double* of_points, double* predicted, const double* by_frame, const double* by_point
    ) except -1:
        """Covariances of the points, and what every sighting's own prediction is uncertain by."""
        cdef int l, e, f, i, j, k, r, c, s, most = 0, we, wf, entries, base, width, offset
        cdef Arena scratch = Arena()
        for l in range(self.labels):
            most = max(most, self.entry_begin[l + 1] - self.entry_begin[l])
        # of a label's entries: T = Z W' V^-1, the coupling of each with the point but for its sign
        cdef double* T = scratch.doubles(most * CAMERA * 3)
        cdef double U[30]
        cdef double block[100]
        cdef double full[225]
        cdef double P[9]
        cdef double M[9]
        cdef double J[30]
        cdef double coupled[45]
        cdef const double* V
        cdef const double* W
        cdef const double* p
        cdef double total
        for l in range(self.labels):
            base, entries = self.entry_begin[l], self.entry_begin[l + 1] - self.entry_begin[l]
            V = self.V_inverse + 6 * l
            memset(T, 0, entries * CAMERA * 3 * sizeof(double))
            memset(M, 0, sizeof(M))
            for f in range(entries):
                W, wf = self.now.W + self.entry_at[base + f], self._entry_width(l, base + f)
                _times_inverse(W, V, wf, U)
                for e in range(entries):
                    we = self._entry_width(l, base + e)
                    self._inverse_block(Z, l, base + e, base + f, block)
                    for i in range(we):
                        for k in range(3):
                            total = 0.0
                            for j in range(wf):
                                total += block[i * wf + j] * U[3 * j + k]
                            T[(e * CAMERA + i) * 3 + k] += total
            for e in range(entries):
                W, we = self.now.W + self.entry_at[base + e], self._entry_width(l, base + e)
                for i in range(3):
                    for j in range(3):
                        for k in range(we):
                            M[3 * i + j] += W[i * we + k] * T[(e * CAMERA + k) * 3 + j]
            for i in range(3):
                for j in range(3):
                    P[3 * i + j] = V[_packed(i, j)]
                    for k in range(3):
                        P[3 * i + j] += V[_packed(i, k)] * M[3 * k + j]
            for i in range(3):
                for j in range(3):
                    of_points[9 * self.label_at[l] + 3 * i + j] = 0.5 * (P[3 * i + j] + P[3 * j + i])
            for k in range(self.obs_begin[l], self.obs_begin[l + 1]):
                # prediction by the free entries of stop and camera, and by the point
                width = 0
                memset(full, 0, sizeof(full))
                memset(coupled, 0, sizeof(coupled))
                for r in range(2):
                    e = self.obs_entry[2 * k + r]
                    if e < 0:
                        continue
                    we = self._entry_width(l, e)
                    for i in range(we):
                        for j in range(3):
                            coupled[3 * (width + i) + j] = -T[((e - base) * CAMERA + i) * 3 + j]
                    offset = 0
                    for c in range(2):
                        f = self.obs_entry[2 * k + c]
                        if f < 0:
                            continue
                        wf = self._entry_width(l, f)
                        self._inverse_block(Z, l, e, f, block)
                        for i in range(we):
                            for j in range(wf):
                                full[15 * (width + i) + offset + j] = block[i * wf + j]
                        offset += wf
                    width += we
                for r in range(2):
                    offset = 0
                    for c in range(2):
                        e = self.obs_entry[2 * k + c]
                        if e < 0:
                            continue
                        for i in range(self._entry_width(l, e)):
                            if c == 0:
                                j = self.active[STOP * self.obs_stop[k] + i]
                            else:
                                j = 5 + self.active[STOP * self.stops + CAMERA * self.obs_camera[k] + i]
                            J[15 * r + offset] = by_frame[30 * self.source[k] + 15 * r + j]
                            offset += 1
                p = by_point + 6 * self.source[k]
                for s in range(3):  # u with u, v with v, u with v
                    r, c = s % 2, min(s, 1)
                    total = 0.0
                    for i in range(width):
                        for j in range(width):
                            total += J[15 * r + i] * full[15 * i + j] * J[15 * c + j]
                        for j in range(3):
                            total += coupled[3 * i + j] * (J[15 * r + i] * p[3 * c + j] + J[15 * c + i] * p[3 * r + j])
                    for i in range(3):
                        for j in range(3):
                            total += p[3 * r + i] * P[3 * i + j] * p[3 * c + j]
                    predicted[3 * self.source[k] + s] = total
        return 0

    cdef inline int _entry_width(self, int label, int entry) noexcept nogil:
        if entry < self.camera_begin[label]:
            return self.width[self.entry_node[entry]]
        return self.camera_width[self.entry_node[entry]]

    cdef void _inverse_block(self, const double* Z, int label, int e, int f, double* out) noexcept nogil:
        """The inverse's block of two entries of a label, row-major; a camera's is a part of the last node's."""
        cdef int a = self.entry_node[e], b = self.entry_node[f], i, j, we = self._entry_width(label, e)
        cdef int wf = self._entry_width(label, f), row = 0, column = 0
        if e >= self.camera_begin[label]:
            row = self.camera_first[a]
            a = self.stops
        if f >= self.camera_begin[label]:
            column = self.camera_first[b]
            b = self.stops
        self.factor.block_of(Z, a, row, we, b, column, wf, out)
