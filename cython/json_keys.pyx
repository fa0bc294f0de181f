"""Kernel of robotd.typed_json: does an object of a valid JSON text give a key twice?"""

from libc.stdlib cimport free, malloc
from libc.string cimport memcmp

cdef enum:
    DEEPEST = 64
    MOST_KEYS = 4096  # on the way from the root to one place


def repeats_keys(const unsigned char[::1] data) -> bool:
    """Whether valid JSON repeats a key within an object, or may: escapes in keys and great depth are not looked into."""
    cdef Py_ssize_t i = 0, n = data.shape[0], begin, at
    cdef Py_ssize_t* first = <Py_ssize_t*>malloc(2 * MOST_KEYS * sizeof(Py_ssize_t))
    cdef Py_ssize_t* length = first + MOST_KEYS
    cdef Py_ssize_t begins[DEEPEST]  # of each open bracket, the first of its keys
    cdef int depth = 0, keys = 0, k
    cdef bint escaped, repeated = False
    cdef unsigned char c
    if first == NULL:
        raise MemoryError
    with nogil:
        while i < n and not repeated:
            c = data[i]
            i += 1
            if c == 0x7B or c == 0x5B:  # { [
                if depth == DEEPEST:
                    repeated = True
                    break
                begins[depth] = keys
                depth += 1
            elif c == 0x7D or c == 0x5D:  # } ]
                depth -= 1
                keys = begins[depth]
            elif c == 0x22:  # "
                begin, escaped = i, False
                while data[i] != 0x22:
                    if data[i] == 0x5C:  # backslash
                        escaped = True
                        i += 1
                    i += 1
                at = i + 1
                while at < n and (data[at] == 0x20 or 0x09 <= data[at] <= 0x0D):
                    at += 1
                if at < n and data[at] == 0x3A:  # :
                    if escaped or keys == MOST_KEYS:
                        repeated = True
                        break
                    for k in range(begins[depth - 1], keys):
                        if length[k] == i - begin and memcmp(&data[first[k]], &data[begin], i - begin) == 0:
                            repeated = True
                            break
                    first[keys], length[keys] = begin, i - begin
                    keys += 1
                i += 1
    free(first)
    return repeated
