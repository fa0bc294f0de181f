"""The normal equations at a state."""

cdef double UNSEEN = 1e4
cdef double NEAREST_SQUARE = 0.1 * 0.1


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


cdef void _rotate(const double* v, double* R, double* right) noexcept nogil:
    """Rotation matrix of a rotation vector, and how a change of the vector turns it, to third order."""
    cdef double angle = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), a = 1.0, b = 0.5, half
    cdef double k[9]
    cdef double kk[9]
    cdef int i, j, l
    if angle > 0.0:
        half = sin(0.5 * angle) / (0.5 * angle)
        a, b = sin(angle) / angle, 0.5 * half * half
    k[0] = k[4] = k[8] = 0.0
    k[1], k[2], k[5] = -v[2], v[1], -v[0]
    k[3], k[6], k[7] = v[2], -v[1], v[0]
    for i in range(3):
        for j in range(3):
            kk[3 * i + j] = 0.0
            for l in range(3):
                kk[3 * i + j] += k[3 * i + l] * k[3 * l + j]
    for i in range(9):
        R[i] = (1.0 if i % 4 == 0 else 0.0) + a * k[i] + b * kk[i]
        right[i] = (1.0 if i % 4 == 0 else 0.0) - 0.5 * k[i] + kk[i] / 6.0


cdef void _product(const double* A, const double* B, double* C) noexcept nogil:
    cdef int i, j
    for i in range(3):
        for j in range(3):
            C[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j]


cdef inline double _wrapped(double angle) noexcept nogil:
    angle = fmod(PI - angle, 2.0 * PI)
    return PI - (angle + 2.0 * PI if angle < 0.0 else angle)


cdef class Normals(Structure):
    """Linearisation at a state, summed into the normal equations."""

    cdef double* stop_axes  # of each stop: R_robot_world, x, y, sine and cosine of its roll
    cdef double* camera_axes  # of each camera: R_camera_robot, t, right Jacobian, focal, centre

    cdef int _prepare(self) except -1:
        self.stop_axes = self.arena.doubles(13 * self.stops)
        self.camera_axes = self.arena.doubles(25 * self.cameras)
        return 0

    cdef Normal _normal(self) except *:
        cdef Normal n
        cdef Arena arena = self.arena
        n.cost = 0.0
        n.H, n.M = arena.doubles(STOP * STOP * self.stops), arena.doubles(STOP * STOP * self.moves)
        n.G = arena.doubles(<Py_ssize_t>self.globals * self.size)
        n.V, n.W = arena.doubles(6 * self.labels), arena.doubles(self.couplings)
        n.g, n.p = arena.doubles(self.size), arena.doubles(3 * self.labels)
        return n

    cdef void _axes(self, const double* frame) noexcept nogil:
        cdef int f, c, i, j
        cdef double ch, sh, cp, sp, cr, sr
        cdef double turn[9]
        cdef double R[9]
        cdef double* a
        cdef const double* x
        for f in range(self.stops):
            x, a = frame + STOP * f, self.stop_axes + 13 * f
            ch, sh = cos(x[2]), sin(x[2])
            cp, sp, cr, sr = cos(x[4]), sin(x[4]), cos(x[3]), sin(x[3])
            a[0], a[3], a[6] = ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr
            a[1], a[4], a[7] = sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr
            a[2], a[5], a[8] = -sp, cp * sr, cp * cr
            a[9], a[10], a[11], a[12] = x[0], x[1], sr, cr
        for c in range(self.cameras):
            x, a = frame + STOP * self.stops + CAMERA * c, self.camera_axes + 25 * c
            _rotate(x, turn, a + 12)
            _product(self.R_robot_camera + 9 * c, turn, R)
            for i in range(3):
                for j in range(3):
                    a[3 * i + j] = R[3 * j + i]
                a[9 + i] = self.t_robot_camera[3 * c + i] + x[3 + i]
            for i in range(4):
                a[21 + i] = self.lens[LENS * c + i] + x[6 + i]

    cdef void _sightings(
        self, const double* points, const Shape* loss, Normal* n, double* residual, uint8_t* seen, double* by_frame,
        double* by_point,
    ) noexcept nogil:
        """Sum all sightings into `n`, or, if that is NULL, give each one's residual and whitened derivatives."""
        cdef int l, i, k, j, s, c, ws, wc, e, f
        cdef double ox, oy, oz, rx, ry, rz, dx, dy, dz, scale, eu, ev, square, weight, rho, root, cost = 0.0
        cdef double gain_u, gain_v, m0, m1, value
        cdef double q[3]
        cdef double image[2]
        cdef double J[6]
        cdef double A[6]
        cdef double Br[6]
        cdef double B[6]
        cdef double full[30]
        cdef double js[10]
        cdef double jc[20]
        cdef double V[6]
        cdef double p[3]
        cdef double moment[3]
        cdef const double* R
        cdef const double* C
        cdef const double* lens
        cdef const double* P
        cdef double* out
        cdef int* chosen
        cdef bint ok
        for l in range(self.labels):
            P = points + 3 * l
            memset(V, 0, sizeof(V))
            memset(p, 0, sizeof(p))
            for i in range(self.obs_begin[l], self.obs_begin[l + 1]):
                s, c = self.obs_stop[i], self.obs_camera[i]
                R, C, lens = self.stop_axes + 13 * s, self.camera_axes + 25 * c, self.lens + LENS * c
                ox, oy, oz = P[0] - R[9], P[1] - R[10], P[2]
                rx = R[0] * ox + R[1] * oy + R[2] * oz
                ry = R[3] * ox + R[4] * oy + R[5] * oz
                rz = R[6] * ox + R[7] * oy + R[8] * oz
                dx, dy, dz = rx - C[9], ry - C[10], rz - C[11]
                q[0] = C[0] * dx + C[1] * dy + C[2] * dz
                q[1] = C[3] * dx + C[4] * dy + C[5] * dz
                q[2] = C[6] * dx + C[7] * dy + C[8] * dz
                ok = dx * dx + dy * dy + dz * dz > NEAREST_SQUARE and _image(lens, q, image, J)
                if ok and not isinf(lens[13]):
                    eu, ev = lens[0] * image[0], lens[1] * image[1]
                    ok = eu * eu + ev * ev <= lens[13]
                scale = 1.0 / max(self.obs[4 * i + 2], loss.sigma)
                if ok:
                    eu = (C[21] * image[0] + C[23] - self.obs[4 * i]) * scale
                    ev = (C[22] * image[1] + C[24] - self.obs[4 * i + 1]) * scale
                else:
                    eu = ev = UNSEEN
                square = eu * eu + ev * ev
                rho = _loss(loss.shape, loss.width, square, &weight)
                cost += self.obs[4 * i + 3] * rho
                if residual != NULL:
                    k = self.source[i]
                    residual[2 * k], residual[2 * k + 1], seen[k] = eu, ev, ok
                if not ok or (n == NULL and by_frame == NULL):
                    continue
                root = 1.0 if n == NULL else sqrt(weight * self.obs[4 * i + 3])
                gain_u, gain_v = C[21] * scale * root, C[22] * scale * root
                for k in range(3):
                    A[k], A[3 + k] = J[k] * gain_u, J[3 + k] * gain_v
                for k in range(2):
                    for j in range(3):
                        Br[3 * k + j] = A[3 * k] * C[j] + A[3 * k + 1] * C[3 + j] + A[3 * k + 2] * C[6 + j]
                for k in range(2):
                    for j in range(3):
                        B[3 * k + j] = Br[3 * k] * R[j] + Br[3 * k + 1] * R[3 + j] + Br[3 * k + 2] * R[6 + j]
                for k in range(2):
                    full[15 * k], full[15 * k + 1] = -B[3 * k], -B[3 * k + 1]
                    full[15 * k + 2] = B[3 * k] * oy - B[3 * k + 1] * ox
                wc = self.camera_width[c]
                if self.tilts or by_frame != NULL:
                    for k in range(2):
                        moment[1] = Br[3 * k + 2] * rx - Br[3 * k] * rz
                        moment[2] = Br[3 * k] * ry - Br[3 * k + 1] * rx
                        full[15 * k + 3] = Br[3 * k + 1] * rz - Br[3 * k + 2] * ry
                        full[15 * k + 4] = moment[1] * R[12] - moment[2] * R[11]
                if wc or by_frame != NULL:
                    for k in range(2):
                        moment[0] = A[3 * k + 1] * q[2] - A[3 * k + 2] * q[1]
                        moment[1] = A[3 * k + 2] * q[0] - A[3 * k] * q[2]
                        moment[2] = A[3 * k] * q[1] - A[3 * k + 1] * q[0]
                        for j in range(3):
                            full[15 * k + 5 + j] = (
                                moment[0] * C[12 + j] + moment[1] * C[15 + j] + moment[2] * C[18 + j]
                            )
                            full[15 * k + 8 + j] = -Br[3 * k + j]
                    full[11], full[12], full[13], full[14] = image[0] * scale * root, 0.0, scale * root, 0.0
                    full[26], full[27], full[28], full[29] = 0.0, image[1] * scale * root, 0.0, scale * root
                if n == NULL:
                    k = self.source[i]
                    memcpy(by_frame + 30 * k, full, 30 * sizeof(double))
                    memcpy(by_point + 6 * k, B, 6 * sizeof(double))
                    continue
                eu *= root
                ev *= root
                V[0] += B[0] * B[0] + B[3] * B[3]
                V[1] += B[0] * B[1] + B[3] * B[4]
                V[2] += B[0] * B[2] + B[3] * B[5]
                V[3] += B[1] * B[1] + B[4] * B[4]
                V[4] += B[1] * B[2] + B[4] * B[5]
                V[5] += B[2] * B[2] + B[5] * B[5]
                for k in range(3):
                    p[k] += B[k] * eu + B[3 + k] * ev
                e, f = self.obs_entry[2 * i], self.obs_entry[2 * i + 1]
                ws = 0
                if e >= 0:
                    ws, chosen = self.width[s], self.active + STOP * s
                    for k in range(ws):
                        js[k], js[STOP + k] = full[chosen[k]], full[15 + chosen[k]]
                    out = n.W + self.entry_at[e]
                    if ws == 3:
                        _add(n.H + STOP * STOP * s, out, n.g + self.first[s], js, js + STOP, B, eu, ev, 3)
                    else:
                        _add(n.H + STOP * STOP * s, out, n.g + self.first[s], js, js + STOP, B, eu, ev, ws)
                if f >= 0:
                    chosen = self.active + STOP * self.stops + CAMERA * c
                    for k in range(wc):
                        jc[k], jc[CAMERA + k] = full[5 + chosen[k]], full[20 + chosen[k]]
                    out = n.W + self.entry_at[f]
                    for j in range(3):
                        for k in range(wc):
                            out[j * wc + k] += B[j] * jc[k] + B[3 + j] * jc[CAMERA + k]
                    out = n.g + self.first[self.stops] + self.camera_first[c]
                    for k in range(wc):
                        out[k] += jc[k] * eu + jc[CAMERA + k] * ev
                    out = (
                        n.G + <Py_ssize_t>self.globals * (self.first[self.stops] + self.camera_first[c])
                        + self.camera_first[c]
                    )
                    for k in range(wc):
                        for j in range(wc):
                            out[k * self.globals + j] += jc[k] * jc[j] + jc[CAMERA + k] * jc[CAMERA + j]
                    out = n.G + <Py_ssize_t>self.globals * self.first[s] + self.camera_first[c] * ws
                    for k in range(wc):
                        for j in range(ws):
                            out[k * ws + j] += jc[k] * js[j] + jc[CAMERA + k] * js[STOP + j]
            if n != NULL:
                for k in range(6):
                    n.V[6 * l + k] = V[k]
                for k in range(3):
                    n.p[3 * l + k] = p[k]
        if n != NULL:
            n.cost = cost

    cdef void evaluate(self, const double* frame, const double* points, const Shape* loss, Normal* n) noexcept nogil:
        """Normal equations, gradient and cost of everything at a state."""
        cdef int i, k, j, l
        cdef double square, weight, rho, info
        cdef double d[3]
        self._axes(frame)
        memset(n.H, 0, STOP * STOP * self.stops * sizeof(double))
        memset(n.M, 0, STOP * STOP * self.moves * sizeof(double))
        memset(n.G, 0, <Py_ssize_t>self.globals * self.size * sizeof(double))
        memset(n.W, 0, self.couplings * sizeof(double))
        memset(n.g, 0, self.size * sizeof(double))
        self._sightings(points, loss, n, NULL, NULL, NULL, NULL)
        for i in range(self.knowns):
            l = self.known_point[i]
            square = 0.0
            for k in range(3):
                d[k] = (points[3 * l + k] - self.known[4 * i + k]) / self.known[4 * i + 3]
                square += d[k] * d[k]
            n.cost += _loss(1, loss.move_width, square, &weight)
            info = weight / (self.known[4 * i + 3] * self.known[4 * i + 3])
            n.V[6 * l] += info
            n.V[6 * l + 3] += info
            n.V[6 * l + 5] += info
            for k in range(3):
                n.p[3 * l + k] += d[k] * weight / self.known[4 * i + 3]
        self._moves(frame, loss, n)
        self._roofs(frame, loss, n)
        for i in range(self.stops):
            for k in range(self.width[i]):
                j = STOP * i + self.active[STOP * i + k]
                n.H[STOP * STOP * i + k * (self.width[i] + 1)] += self.prior[j]
        for k in range(self.globals):
            j = self.entry_of[self.first[self.stops] + k]
            n.G[<Py_ssize_t>self.globals * (self.first[self.stops] + k) + k] += self.prior[j]
        for k in range(self.size):
            j = self.entry_of[k]
            n.g[k] += self.prior[j] * frame[j]
        for k in range(self.entries):
            n.cost += self.prior[k] * frame[k] * frame[k]
        n.cost *= 0.5

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


cdef inline void _add(
    double* H, double* W, double* g, const double* j0, const double* j1, const double* B, double eu, double ev, int w
) noexcept nogil:
    cdef int a, b
    for a in range(w):
        g[a] += j0[a] * eu + j1[a] * ev
        for b in range(w):
            H[a * w + b] += j0[a] * j0[b] + j1[a] * j1[b]
    for a in range(3):
        for b in range(w):
            W[a * w + b] += B[a] * j0[b] + B[3 + a] * j1[b]
