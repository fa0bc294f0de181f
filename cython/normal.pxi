"""Sightings linearised at a state, and the normal equations of everything."""

cdef double UNSEEN = 1e4  # as _UNSEEN in bundle.py
cdef double NEAREST_SQUARE = 0.1 * 0.1  # as _NEAREST_M in bundle.py


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


cdef class Normals(Factors):
    """Linearisation at a state, summed into the normal equations."""

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
