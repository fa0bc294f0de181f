"""Kernel of robotd.solver.bundle: linearisation, Schur complement, sparse Cholesky and the descent, in one class.

The numpy code in bundle.py and covariance.py says what each step means; here is what makes it fast. Sightings are
visited label by label, so that a label's blocks stay in registers and cache, and derivatives are summed as they are
made. The Schur complement is summed stop by stop, so that a block row has one owner and a table of positions replaces
all searching. Only entries that are free have columns.
"""

import numpy as np
import scipy.linalg.cython_blas
import scipy.linalg.cython_lapack

from cpython.pycapsule cimport PyCapsule_GetName, PyCapsule_GetPointer
from libc.math cimport INFINITY, atan2, cos, fabs, fmod, hypot, isfinite, isinf, log, log1p, sin, sqrt
from libc.stdint cimport int64_t, uint8_t, uint64_t
from libc.stdlib cimport calloc, free, qsort
from libc.string cimport memcpy, memset

cdef extern from *:
    """
    #include <stdint.h>
    #include <string.h>
    #if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && defined(__linux__)
    #define CLONES __attribute__((target_clones("arch=x86-64-v3", "default")))
    #else
    #define CLONES
    #endif
    static inline int popcount(uint64_t bits) { return __builtin_popcountll(bits); }
    static inline int lowest_bit(uint64_t bits) { return __builtin_ctzll(bits); }

    /* or `pivot` into `row`; how many bits that added */
    CLONES static int merged_bits(uint64_t *restrict row, const uint64_t *restrict pivot, int low, int high) {
        int added = 0;
        for (int w = low; w < high; w++) {
            added += __builtin_popcountll(pivot[w] & ~row[w]);
            row[w] |= pivot[w];
        }
        return added;
    }

    /* C (m x n), lower part, = A (m x k) times the transpose of A's first n rows; A's columns `tall` apart, C's m */
    #define ROWS 8
    CLONES static void multiply(double *restrict C, const double *restrict A, int m, int n, int k, int tall) {
        for (int j = 0; j < n; j += 4) {
            const int columns = n - j < 4 ? n - j : 4;
            for (int i = j; i < m; i += ROWS) {
                double sum[4][ROWS] = {{0.0}};
                if (columns == 4 && m - i >= ROWS) {
                    for (int l = 0; l < k; l++) {
                        const double *a = A + (size_t)l * tall + i, *b = A + (size_t)l * tall + j;
                        for (int c = 0; c < 4; c++)
                            for (int r = 0; r < ROWS; r++) sum[c][r] += a[r] * b[c];
                    }
                    for (int c = 0; c < 4; c++)
                        for (int r = 0; r < ROWS; r++) C[(size_t)(j + c) * m + i + r] = sum[c][r];
                } else {
                    const int rows = m - i < ROWS ? m - i : ROWS;
                    for (int l = 0; l < k; l++) {
                        const double *a = A + (size_t)l * tall + i, *b = A + (size_t)l * tall + j;
                        for (int c = 0; c < columns; c++)
                            for (int r = 0; r < rows; r++) sum[c][r] += a[r] * b[c];
                    }
                    for (int c = 0; c < columns; c++)
                        for (int r = 0; r < rows; r++) C[(size_t)(j + c) * m + i + r] = sum[c][r];
                }
            }
        }
    }

    static void scatter(double *restrict column, const double *restrict product, const int *restrict rows, int from, int to) {
        for (int i = from; i < to; i++) column[rows[i]] -= product[i];
    }

    /* factorise the upper square of a tall panel and divide the rest by it; 0 if a pivot is not positive */
    CLONES static int narrow_cholesky(double *panel, int tall, int wide) {
        for (int j = 0; j < wide; j++) {
            double *restrict c = panel + (size_t)j * tall;
            const double pivot = c[j];
            if (!(pivot > 0.0)) return 0;
            const double root = __builtin_sqrt(pivot), inverse = 1.0 / root;
            c[j] = root;
            for (int i = j + 1; i < tall; i++) c[i] *= inverse;
            for (int k = j + 1; k < wide; k++) {
                double *restrict d = panel + (size_t)k * tall;
                const double b = c[k];
                for (int i = k; i < tall; i++) d[i] -= c[i] * b;
            }
        }
        return 1;
    }

    /* y (tall) -= each column times the entry of y it starts with, solved: forward substitution in a panel */
    CLONES static void forward(const double *panel, double *restrict y, int tall, int wide) {
        int j = 0;
        for (; j + 1 < wide; j += 2) {
            const double *restrict c = panel + (size_t)j * tall, *restrict d = c + tall;
            const double a = y[j] / c[j], b = (y[j + 1] - c[j + 1] * a) / d[j + 1];
            y[j] = a;
            y[j + 1] = b;
            for (int i = j + 2; i < tall; i++) y[i] -= c[i] * a + d[i] * b;
        }
        for (; j < wide; j++) {
            const double *restrict c = panel + (size_t)j * tall;
            const double a = y[j] / c[j];
            y[j] = a;
            for (int i = j + 1; i < tall; i++) y[i] -= c[i] * a;
        }
    }

    CLONES static void backward(const double *panel, double *y, int tall, int wide) {
        for (int j = wide - 1; j >= 0; j--) {
            const double *c = panel + (size_t)j * tall;
            double sum[8] = {0.0}, rest = y[j];
            int i = j + 1;
            for (; i + 7 < tall; i += 8)
                for (int r = 0; r < 8; r++) sum[r] += c[i + r] * y[i + r];
            for (; i < tall; i++) rest -= c[i] * y[i];
            for (int r = 0; r < 8; r++) rest -= sum[r];
            y[j] = rest / c[j];
        }
    }

    CLONES static double dot(const double *a, const double *b, int n) {
        double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
        int i = 0;
        for (; i + 3 < n; i += 4) {
            s0 += a[i] * b[i]; s1 += a[i + 1] * b[i + 1]; s2 += a[i + 2] * b[i + 2]; s3 += a[i + 3] * b[i + 3];
        }
        for (; i < n; i++) s0 += a[i] * b[i];
        return (s0 + s1) + (s2 + s3);
    }

    /* out (m x n, rows `pitch` apart) -= Y (m x 3) times W (3 x n) */
    static inline __attribute__((always_inline)) void subtract_product(double *out, int pitch, const double *Y, int m, const double *W, int n) {
        for (int i = 0; i < m; i++) {
            const double y0 = Y[3 * i], y1 = Y[3 * i + 1], y2 = Y[3 * i + 2];
            double *o = out + (size_t)i * pitch;
            for (int j = 0; j < n; j++) o[j] -= y0 * W[j] + y1 * W[n + j] + y2 * W[2 * n + j];
        }
    }

    /* the same for the label's entries low..high, all of one width, into the current row's blocks */
    #define ROW(NAME, WIDTH) \\
    CLONES static void NAME(double *restrict S, const Py_ssize_t *at, const double *Y, const double *restrict W, \\
                            const Py_ssize_t *entry_at, const int *node, int low, int high) { \\
        double y[WIDTH * 3]; \\
        memcpy(y, Y, sizeof y); \\
        for (int f = low; f <= high; f++) \\
            subtract_product(S + at[node[f]], WIDTH, y, WIDTH, W + entry_at[f], WIDTH); \\
    }
    ROW(subtract_row_3, 3)
    ROW(subtract_row_5, 5)
    """
    int popcount(uint64_t) noexcept nogil
    int lowest_bit(uint64_t) noexcept nogil
    int merged_bits(uint64_t*, const uint64_t*, int, int) noexcept nogil
    void multiply(double*, const double*, int, int, int, int) noexcept nogil
    void scatter(double*, const double*, const int*, int, int) noexcept nogil
    int narrow_cholesky(double*, int, int) noexcept nogil
    void forward(const double*, double*, int, int) noexcept nogil
    void backward(const double*, double*, int, int) noexcept nogil
    double dot(const double*, const double*, int) noexcept nogil
    void subtract_product(double*, int, const double*, int, const double*, int) noexcept nogil
    void subtract_row_3(
        double*, const Py_ssize_t*, const double*, const double*, const Py_ssize_t*, const int*, int, int
    ) noexcept nogil
    void subtract_row_5(
        double*, const Py_ssize_t*, const double*, const double*, const Py_ssize_t*, const int*, int, int
    ) noexcept nogil

include "pattern.pxi"
include "cholesky.pxi"
include "lens.pxi"
include "structure.pxi"
include "factors.pxi"
include "normal.pxi"
include "descent.pxi"
include "uncertainty.pxi"
