"""Kernel of robotd.identify.throughput: the numpy function there says what it does."""

from libc.math cimport log
from libc.stdint cimport int64_t


def log_likelihoods(
    const double[::1] intervals, const double[::1] odds, const int64_t[::1] lights, const int64_t[::1] answers,
    const int64_t[::1] slot, const int64_t[::1] portion, const int64_t[::1] turn, const float[::1] start,
    const float[::1] right, const float[::1] instead, const int64_t[::1] portions, const double[::1] gates,
    const int64_t[::1] heads, const float[:, ::1] table, double first, double step, double[::1] waits,
    double[::1] scores,
):
    """Log-likelihood of the lights' answers under every interval, into `scores`; `waits` is scratch."""
    cdef Py_ssize_t k, s, h, light, pair, answer, index, last = table.shape[1] - 1
    cdef double interval, wait, total, product, score
    cdef float late, begin = <float> (0.5 * step - first), per = <float> (1.0 / step)
    with nogil:
        for k in range(intervals.shape[0]):
            interval = intervals[k]
            for s in range(portions.shape[0] - 1):
                wait = -1e300
                for h in range(portions[s], portions[s + 1]):
                    wait = max(wait, gates[h] - heads[h] * interval)
                    waits[h] = wait
            score = 0.0
            for light in range(lights.shape[0] - 1):
                total = 0.0
                for pair in range(lights[light], lights[light + 1]):
                    product = odds[pair]
                    for answer in range(answers[pair], answers[pair + 1]):
                        late = start[answer] - <float> (waits[portion[answer]] + turn[answer] * interval)
                        index = <Py_ssize_t> ((late + begin) * per)
                        index = 0 if index < 0 else last if index > last else index
                        product = product * (right[answer] * table[slot[answer], index] + instead[answer])
                    total = total + product
                score = score + log(max(total, 1e-300))
            scores[k] = score
