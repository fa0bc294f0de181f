"""Sparse Cholesky factor of a symmetric matrix of small dense blocks.

Nodes (a stop; all cameras and odometry factors together) have a width, the number of their columns. The order is of
minimum degree (Tinney and Walker 1967, scheme 2, exact degrees on bit sets), the factorisation left-looking by
supernodes (Ng and Peyton 1993), and the inverse on the factor's pattern follows Takahashi (1973).
Panels are column-major: a supernode's own rows first, then those below.
"""

ctypedef void (*Gemm)(char*, char*, int*, int*, int*, double*, double*, int*, double*, int*, double*, double*, int*) noexcept nogil
ctypedef void (*Syrk)(char*, char*, int*, int*, double*, double*, int*, double*, double*, int*) noexcept nogil
ctypedef void (*Trsm)(char*, char*, char*, char*, int*, int*, double*, double*, int*, double*, int*) noexcept nogil
ctypedef void (*Potrf)(char*, int*, double*, int*, int*) noexcept nogil


cdef void* _routine(module, name) except NULL:
    # scipy publishes its BLAS for other extensions in this table; reading it needs no scipy when we are built
    capsule = module.__pyx_capi__[name]
    return PyCapsule_GetPointer(capsule, PyCapsule_GetName(capsule))


cdef Gemm gemm = <Gemm>_routine(scipy.linalg.cython_blas, "dgemm")
cdef Syrk syrk = <Syrk>_routine(scipy.linalg.cython_blas, "dsyrk")
cdef Trsm trsm = <Trsm>_routine(scipy.linalg.cython_blas, "dtrsm")
cdef Potrf potrf = <Potrf>_routine(scipy.linalg.cython_lapack, "dpotrf")

cdef enum:
    # up to so many columns of a panel and multiplications of an update BLAS is not called, because it would start
    # threads that wait for each other longer than they work
    NARROW = 48
    SMALL = 2000000


cdef class Factor(Pattern):
    """The factor itself, what it solves, and the inverse."""

    cdef int factorise(self, const double* values) noexcept nogil:
        """Factorise; 0, or 1 if the matrix is not positive definite."""
        cdef int n, k, b, r, c, wa, wb, s
        cdef const double* source
        cdef double* into
        cdef Py_ssize_t high
        memset(self.L, 0, self.entries * sizeof(double))
        for n in range(self.nodes):
            wa = self.width[n]
            if wa == 0:
                continue
            for k in range(self.begin[n], self.begin[n + 1]):
                b = self.column[k]
                wb = self.width[b]
                if wb == 0:
                    continue
                source, into = values + self.block[k], self.L + self.target[k]
                if self.place[n] >= self.place[b]:
                    high = self.height[self.super_of[self.place[b]]]
                    for r in range(wa):
                        for c in range(wb):
                            into[r + c * high] = source[r * wb + c]
                else:
                    high = self.height[self.super_of[self.place[n]]]
                    for r in range(wa):
                        for c in range(wb):
                            into[c + r * high] = source[r * wb + c]
        for s in range(self.supers):
            self.next_super[s] = self.pending[s] = -1
        for s in range(self.supers):
            if self._panel(s):
                return 1
        return 0

    cdef int _panel(self, int s) noexcept nogil:
        cdef int p, k, d, after, tall = self.height[s], wide = self.breadth[s]
        for p in range(self.opens[s], self.opens[s + 1]):
            self.where[p] = self.start[p] - self.start[self.opens[s]]
        for k in range(self.below[s], self.below[s + 1]):
            self.where[self.rows[k]] = self.offset[k]
        d = self.pending[s]
        while d >= 0:
            after = self.next_super[d]
            self._update(s, d)
            d = after
        if not self._dense(self.L + self.panel[s], tall, wide):
            return 1
        self.done[s] = self.below[s]
        if self.below[s] < self.below[s + 1]:
            self._enlist(s)
        return 0

    cdef void _enlist(self, int d) noexcept nogil:
        cdef int s = self.super_of[self.rows[self.done[d]]]
        self.next_super[d] = self.pending[s]
        self.pending[s] = d

    cdef void _update(self, int s, int d) noexcept nogil:
        """Subtract what the earlier supernode d contributes to the panel of s."""
        cdef int low = self.done[d], high = low, k, i, j, c, r, n, m = 0, square, tall = self.height[d]
        cdef int wide = self.breadth[d], into = self.height[s]
        cdef Py_ssize_t column
        cdef double* source
        cdef double* panel = self.L + self.panel[s]
        cdef double* product = self.product
        cdef double one = 1.0, zero = 0.0
        while high < self.below[d + 1] and self.rows[high] < self.opens[s + 1]:
            high += 1
        square = 0
        for k in range(low, self.below[d + 1]):
            n = self.width[self.node_at[self.rows[k]]]
            r = self.where[self.rows[k]]
            for i in range(n):
                self.relative[m + i] = r + i
            m += n
            if k < high:
                square += n
        source = self.L + self.panel[d] + (tall - m)
        if <double>m * square * wide <= SMALL:
            multiply(product, source, m, square, wide, tall)
        else:
            r = m - square
            syrk("L", "N", &square, &wide, &one, source, &tall, &zero, product, &m)
            if r > 0:
                gemm("N", "T", &r, &square, &wide, &one, source + square, &tall, source, &tall, &zero,
                     product + square, &m)
        for j in range(square):
            column = <Py_ssize_t>self.relative[j] * into
            scatter(panel + column, product + <Py_ssize_t>j * m, self.relative, j, m)
        self.done[d] = high
        if high < self.below[d + 1]:
            self._enlist(d)

    cdef int _dense(self, double* panel, int tall, int wide) noexcept nogil:
        """Factorise the square on top and divide what is below it; 0 on failure."""
        cdef int j, k, i, info = 0, rest = tall - wide
        cdef double pivot, one = 1.0
        if wide <= NARROW:
            return narrow_cholesky(panel, tall, wide)
        potrf("L", &wide, panel, &tall, &info)
        if info != 0:
            return 0
        if rest > 0:
            trsm("R", "L", "T", "N", &rest, &wide, &one, panel, &tall, panel + wide, &tall)
        return 1

    cdef void solve(self, double* x) noexcept nogil:
        """Replace a right-hand side (columns as in the matrix) by the solution."""
        cdef double* y = self.vector
        cdef double* panel = self.product
        cdef double* top
        cdef int p, k, s, i, n, tall, wide
        for p in range(self.active):
            n = self.node_at[p]
            for i in range(self.width[n]):
                y[self.start[p] + i] = x[self.first[n] + i]
        for s in range(self.supers):
            tall, wide, top = self.height[s], self.breadth[s], y + self.start[self.opens[s]]
            memcpy(panel, top, wide * sizeof(double))
            memset(panel + wide, 0, (tall - wide) * sizeof(double))
            forward(self.L + self.panel[s], panel, tall, wide)
            memcpy(top, panel, wide * sizeof(double))
            for k in range(self.below[s], self.below[s + 1]):
                p = self.rows[k]
                for i in range(self.width[self.node_at[p]]):
                    y[self.start[p] + i] += panel[self.offset[k] + i]
        for s in range(self.supers - 1, -1, -1):
            tall, wide, top = self.height[s], self.breadth[s], y + self.start[self.opens[s]]
            memcpy(panel, top, wide * sizeof(double))
            for k in range(self.below[s], self.below[s + 1]):
                p = self.rows[k]
                for i in range(self.width[self.node_at[p]]):
                    panel[self.offset[k] + i] = y[self.start[p] + i]
            backward(self.L + self.panel[s], panel, tall, wide)
            memcpy(top, panel, wide * sizeof(double))
        for p in range(self.active):
            n = self.node_at[p]
            for i in range(self.width[n]):
                x[self.first[n] + i] = y[self.start[p] + i]

    cdef int invert(self, double* Z) except -1:
        """The inverse on the factor's pattern, in panels like the factor's, from the last supernode to the first."""
        cdef int s, k, l, i, j, p, q, tall, wide, rest, a, b, wp, wq
        cdef Py_ssize_t at
        cdef int biggest = 0, broad = 0
        cdef double* panel
        cdef double* into
        cdef double one = 1.0, minus = -1.0, zero = 0.0
        for s in range(self.supers):
            biggest = max(biggest, self.height[s] - self.breadth[s])
            broad = max(broad, self.breadth[s])
        scratch = Arena()
        cdef double* gathered = scratch.doubles(<Py_ssize_t>biggest * biggest)
        cdef double* X = scratch.doubles(<Py_ssize_t>biggest * broad)
        cdef double* T = scratch.doubles(<Py_ssize_t>broad * broad)
        with nogil:
            for s in range(self.supers - 1, -1, -1):
                tall, wide = self.height[s], self.breadth[s]
                rest = tall - wide
                panel, into = self.L + self.panel[s], Z + self.panel[s]
                # T = L11^-1, lower
                memset(T, 0, <Py_ssize_t>wide * wide * sizeof(double))
                for j in range(wide):
                    T[j + <Py_ssize_t>j * wide] = 1.0
                trsm("L", "L", "N", "N", &wide, &wide, &one, panel, &tall, T, &wide)
                # Z11 = L11^-T L11^-1
                gemm("T", "N", &wide, &wide, &wide, &one, T, &wide, T, &wide, &zero, into, &tall)
                if rest == 0:
                    continue
                a = 0
                for k in range(self.below[s], self.below[s + 1]):
                    p = self.rows[k]
                    wp = self.width[self.node_at[p]]
                    b = a
                    for l in range(k, self.below[s + 1]):
                        q = self.rows[l]
                        wq = self.width[self.node_at[q]]
                        at = self._position(q, p)
                        for j in range(wp):
                            for i in range(wq):
                                gathered[b + i + <Py_ssize_t>(a + j) * rest] = Z[
                                    at + i + <Py_ssize_t>j * self.height[self.super_of[p]]
                                ]
                                gathered[a + j + <Py_ssize_t>(b + i) * rest] = gathered[
                                    b + i + <Py_ssize_t>(a + j) * rest
                                ]
                        b += wq
                    a += wp
                gemm("N", "N", &rest, &wide, &wide, &one, panel + wide, &tall, T, &wide, &zero, X, &rest)
                gemm("N", "N", &rest, &wide, &rest, &minus, gathered, &rest, X, &rest, &zero, into + wide, &tall)
                gemm("T", "N", &wide, &wide, &rest, &minus, X, &rest, into + wide, &tall, &one, into, &tall)
        return 0

    cdef void block_of(
        self, const double* Z, int a, int row, int rows, int b, int column, int columns, double* out
    ) noexcept nogil:
        """Copy a part of the inverse's block of nodes a and b, row-major; the pattern must hold it."""
        cdef int i, j, p = self.place[a], q = self.place[b]
        cdef Py_ssize_t at = self._position(p, q), high = self.height[self.super_of[min(p, q)]]
        for i in range(rows):
            for j in range(columns):
                if p >= q:
                    out[i * columns + j] = Z[at + row + i + (column + j) * high]
                else:
                    out[i * columns + j] = Z[at + column + j + (row + i) * high]
