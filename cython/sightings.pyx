"""Kernels of robotd.sighting_columns: a hundred thousand records into columns, and columns into as many records."""

from cpython.object cimport PyObject_GenericSetAttr

import numpy as np


def read(list rows, dict cameras, double sigma_px):
    """The columns of `robotd.sighting_columns.read`."""
    cdef Py_ssize_t n = len(rows), i
    cdef list labels = [None] * n
    camera, numbers = np.empty(n, dtype=np.int64), np.empty((4, n))
    cdef long long[::1] c = camera
    cdef double[:, ::1] x = numbers
    cdef object row, value
    for i in range(n):
        row = rows[i]
        value = cameras.get(row.camera)
        c[i] = -1 if value is None else value
        labels[i] = row.label
        x[0, i], x[1, i] = row.u, row.v
        value = row.sigma_px
        x[2, i] = sigma_px if value is None else value
        value = row.probability
        x[3, i] = 1.0 if value is None else value
    return camera, labels, numbers


def made(type cls, tuple names, list columns):
    """Records of a frozen dataclass with slots, without a call of its constructor for each."""
    cdef Py_ssize_t n = len(columns[0]), width = len(names), i, k
    cdef list result = [None] * n
    cdef object new = cls.__new__, record, name
    cdef list column
    for i in range(n):
        result[i] = new(cls)
    for k in range(width):
        name, column = names[k], columns[k]
        for i in range(n):
            PyObject_GenericSetAttr(result[i], name, column[i])
    return tuple(result)
