"""Memory, and the pattern of a sparse Cholesky factor; see cholesky.pxi."""

cdef class Arena:
    """Memory that lives as long as its owner."""

    cdef list kept

    def __cinit__(self):
        self.kept = []

    cdef void* take(self, Py_ssize_t size) except NULL:
        """Zeroed memory of `size` bytes."""
        cdef void* memory = calloc(max(size, 1), 1)
        if memory == NULL:
            raise MemoryError(f"the solver needs {size} bytes")
        self.kept.append(<size_t>memory)
        return memory

    cdef int* ints(self, Py_ssize_t count) except NULL:
        return <int*>self.take(count * sizeof(int))

    cdef double* doubles(self, Py_ssize_t count) except NULL:
        return <double*>self.take(count * sizeof(double))

    cdef Py_ssize_t* offsets(self, Py_ssize_t count) except NULL:
        return <Py_ssize_t*>self.take(count * sizeof(Py_ssize_t))

    def __dealloc__(self):
        for memory in self.kept:
            free(<void*><size_t>memory)


cdef int _ascending(const void* a, const void* b) noexcept nogil:
    return (<int*>a)[0] - (<int*>b)[0]


cdef class Pattern:
    """Order of elimination and panels of a matrix given as block rows of its lower half.

    `begin` (nodes + 1) and `column` list, for every node, the nodes b <= a of its row's blocks; `block` holds where each
    block (row-major, width of a by width of b) starts in the matrix's values. The last node is eliminated last.
    """

    cdef Arena arena
    cdef int nodes, active, supers, size
    cdef int* width
    cdef int* first  # of each node, its first column
    cdef int* begin
    cdef int* column
    cdef Py_ssize_t* block
    cdef int* node_at  # of each place in the order of elimination
    cdef int* place  # of each node; -1 if it has no columns
    cdef int* start  # of each place, its first column in the order of elimination
    cdef int* super_of  # of each place
    cdef int* opens  # (supers + 1) first place
    cdef int* below  # (supers + 1) into `rows`
    cdef int* rows  # places below each supernode, ascending
    cdef int* offset  # of each of these, its first row in the panel
    cdef int* height  # rows of each panel
    cdef int* breadth  # columns of each panel
    cdef Py_ssize_t* panel
    cdef Py_ssize_t* target  # of each block, where it goes in the panels
    cdef Py_ssize_t entries  # of all panels
    cdef double work  # multiplications of one factorisation
    cdef double* L
    cdef double* product
    cdef double* vector
    cdef int* relative
    cdef int* where
    cdef int* next_super
    cdef int* pending
    cdef int* done

    cdef int analyse(self, Arena arena, int nodes, int* width, int* first, int* begin, int* column,
                     Py_ssize_t* block) except -1:
        cdef int n, k
        self.arena = arena
        self.nodes, self.width, self.first = nodes, width, first
        self.begin, self.column, self.block = begin, column, block
        self.node_at, self.place = arena.ints(nodes), arena.ints(nodes)
        self.size = 0
        for n in range(nodes):
            self.size += width[n]
        self._order()
        self._structure()
        self.L = arena.doubles(self.entries)
        self.vector = arena.doubles(self.size)
        return 0

    cdef int _order(self) except -1:
        """Eliminate the node with the fewest neighbours, again and again; the last node waits for all others."""
        cdef int nodes = self.nodes, last = nodes - 1, words = (nodes + 63) // 64, n, b, k, w, best, least, count
        cdef int low, high
        cdef uint64_t* rows = <uint64_t*>calloc(max(<Py_ssize_t>nodes * words, 1), sizeof(uint64_t))
        cdef int* degree = <int*>calloc(max(nodes, 1), sizeof(int))
        cdef uint64_t bits
        cdef uint64_t* row
        cdef uint64_t* pivot
        if rows == NULL or degree == NULL:
            free(rows)
            free(degree)
            raise MemoryError("ordering the solver's matrix needs more memory")
        with nogil:
            for n in range(nodes):
                self.place[n] = -1
            for n in range(last):
                for k in range(self.begin[n], self.begin[n + 1]):
                    b = self.column[k]
                    if b != n and self.width[n] and self.width[b]:
                        rows[<Py_ssize_t>n * words + b // 64] |= <uint64_t>1 << (b % 64)
                        rows[<Py_ssize_t>b * words + n // 64] |= <uint64_t>1 << (n % 64)
            for n in range(last):
                for w in range(words):
                    degree[n] += popcount(rows[<Py_ssize_t>n * words + w])
            count = 0
            low, high = 0, words
            while True:
                best, least = -1, nodes + 1
                for n in range(last):
                    if self.place[n] < 0 and self.width[n] and degree[n] < least:
                        best, least = n, degree[n]
                if best < 0:
                    break
                self.place[best] = count
                self.node_at[count] = best
                count += 1
                pivot = rows + <Py_ssize_t>best * words
                low, high = words, 0
                for w in range(words):
                    if pivot[w]:
                        low = min(low, w)
                        high = w + 1
                for w in range(low, high):
                    bits = pivot[w]
                    while bits:
                        n = 64 * w + lowest_bit(bits)
                        bits &= bits - 1
                        row = rows + <Py_ssize_t>n * words
                        degree[n] += merged_bits(row, pivot, low, high)
                        row[best // 64] &= ~(<uint64_t>1 << (best % 64))
                        row[n // 64] &= ~(<uint64_t>1 << (n % 64))
                        degree[n] -= 2  # itself, which the pivot's row has, and the pivot
            if self.width[last]:
                self.place[last] = count
                self.node_at[count] = last
                count += 1
            self.active = count
        free(rows)
        free(degree)
        return 0

    cdef int _structure(self) except -1:
        """Elimination tree, supernodes and panels."""
        cdef int m = self.active, j, k, n, b, i, child, parent_, s, top, count, free_row, p, q, wide, tall
        cdef Arena scratch = Arena()
        cdef int* degree = scratch.ints(m + 1)
        cdef int* fill = scratch.ints(m)
        cdef int* parent = scratch.ints(m)
        cdef int* mark = scratch.ints(m)
        cdef int* head = scratch.ints(m)
        cdef int* sibling = scratch.ints(m)
        cdef int* moved = scratch.ints(m)
        cdef int* stack = scratch.ints(m + 1)
        cdef int** lists = <int**>scratch.take(m * sizeof(int*))
        cdef int* length = scratch.ints(m)
        cdef int* neighbours
        cdef int* row
        cdef double* zeros = <double*>scratch.take((m + 1) * sizeof(double))
        cdef double extra, total
        cdef Py_ssize_t entry
        # symmetric adjacency by place
        for n in range(self.nodes):
            for k in range(self.begin[n], self.begin[n + 1]):
                b = self.column[k]
                if b != n and self.place[n] >= 0 and self.place[b] >= 0:
                    degree[self.place[n]] += 1
                    degree[self.place[b]] += 1
        total = 0
        for j in range(m):
            k = degree[j]
            degree[j] = <int>total
            fill[j] = <int>total
            total += k
        degree[m] = <int>total
        neighbours = scratch.ints(<Py_ssize_t>total)
        for n in range(self.nodes):
            for k in range(self.begin[n], self.begin[n + 1]):
                b = self.column[k]
                if b != n and self.place[n] >= 0 and self.place[b] >= 0:
                    i, j = self.place[n], self.place[b]
                    neighbours[fill[i]] = j
                    fill[i] += 1
                    neighbours[fill[j]] = i
                    fill[j] += 1
        # below every place: its later neighbours and those of its children (the column's pattern in the factor)
        for j in range(m):
            parent[j] = head[j] = -1
            mark[j] = -1
        row = scratch.ints(m)
        for j in range(m):
            count = 0
            mark[j] = j
            for k in range(degree[j], degree[j + 1]):
                i = neighbours[k]
                if i > j and mark[i] != j:
                    mark[i] = j
                    row[count] = i
                    count += 1
            child = head[j]
            while child >= 0:
                for k in range(length[child]):
                    i = lists[child][k]
                    if mark[i] != j:
                        mark[i] = j
                        row[count] = i
                        count += 1
                child = sibling[child]
            lists[j] = scratch.ints(count)
            length[j] = count
            memcpy(lists[j], row, count * sizeof(int))
            p = m
            for k in range(count):
                p = min(p, row[k])
            if p < m:
                parent[j] = p
                sibling[j] = head[p]
                head[p] = j
        # postorder, so that every subtree is a run of places
        count = 0
        for j in range(m - 1, -1, -1):
            if parent[j] >= 0:
                continue
            # numbered from the back: a parent before its children
            stack[0] = j
            top = 1
            while top:
                top -= 1
                k = stack[top]
                moved[k] = m - 1 - count
                count += 1
                child = head[k]
                while child >= 0:
                    stack[top] = child
                    top += 1
                    child = sibling[child]
        for j in range(m):
            row[moved[j]] = self.node_at[j]
        memcpy(self.node_at, row, m * sizeof(int))
        for j in range(m):
            self.place[self.node_at[j]] = j
            row[moved[j]] = j  # from new place to old
        self.start = self.arena.ints(m + 1)
        for j in range(m):
            self.start[j + 1] = self.start[j] + self.width[self.node_at[j]]
        # supernodes on a stack: `head` opens, `sibling` the last place; merged when few zeros are stored for it
        count = 0
        for j in range(m):
            head[count], sibling[count], zeros[count] = j, j, 0.0
            count += 1
            while count > 1:
                k = row[sibling[count - 2]]
                if parent[k] < 0 or moved[parent[k]] != head[count - 1]:
                    # the parent must be the first place of the one after, or within it
                    if parent[k] < 0 or moved[parent[k]] < head[count - 1] or moved[parent[k]] > sibling[count - 1]:
                        break
                p = self._scalars(lists[k], length[k], moved)
                q = self._scalars(lists[row[sibling[count - 1]]], length[row[sibling[count - 1]]], moved)
                wide = self.start[sibling[count - 2] + 1] - self.start[head[count - 2]]
                tall = self.start[sibling[count - 1] + 1] - self.start[head[count - 1]]
                extra = zeros[count - 2] + zeros[count - 1] + <double>wide * (tall + q - p)
                total = <double>(wide + tall) * (0.5 * (wide + tall) + q)
                if extra > 0.0 and extra > total * (
                    0.3 if wide + tall <= 16 else 0.15 if wide + tall <= 64 else 0.05
                ):
                    break
                sibling[count - 2] = sibling[count - 1]
                zeros[count - 2] = extra
                count -= 1
        self.supers = count
        self.opens, self.below = self.arena.ints(count + 1), self.arena.ints(count + 1)
        self.height, self.breadth = self.arena.ints(count), self.arena.ints(count)
        self.panel = self.arena.offsets(count)
        self.super_of = self.arena.ints(m)
        self.opens[count] = m
        for s in range(count):
            self.opens[s] = head[s]
            self.below[s + 1] = self.below[s] + length[row[sibling[s]]]
            for j in range(head[s], sibling[s] + 1):
                self.super_of[j] = s
        self.rows, self.offset = self.arena.ints(self.below[count]), self.arena.ints(self.below[count])
        self.entries = 0
        self.work = 0.0
        tall = wide = 0
        for s in range(count):
            k = row[sibling[s]]
            for i in range(length[k]):
                self.rows[self.below[s] + i] = moved[lists[k][i]]
            qsort(self.rows + self.below[s], length[k], sizeof(int), _ascending)
            self.breadth[s] = self.start[sibling[s] + 1] - self.start[head[s]]
            self.height[s] = self.breadth[s]
            for i in range(self.below[s], self.below[s + 1]):
                self.offset[i] = self.height[s]
                self.height[s] += self.width[self.node_at[self.rows[i]]]
            self.panel[s] = self.entries
            self.entries += <Py_ssize_t>self.height[s] * self.breadth[s]
            self.work += <double>self.breadth[s] * self.height[s] * self.height[s]
            tall, wide = max(tall, self.height[s]), max(wide, self.breadth[s])
        self.product = self.arena.doubles(<Py_ssize_t>tall * wide)
        self.relative = self.arena.ints(tall)
        self.where = self.arena.ints(m)
        self.next_super, self.pending = self.arena.ints(count), self.arena.ints(count)
        self.done = self.arena.ints(count)
        self.target = self.arena.offsets(self.begin[self.nodes])
        for n in range(self.nodes):
            for k in range(self.begin[n], self.begin[n + 1]):
                if self.place[n] >= 0 and self.place[self.column[k]] >= 0:
                    self.target[k] = self._position(self.place[n], self.place[self.column[k]])
        return 0

    cdef int _scalars(self, int* places, int count, int* moved) noexcept nogil:
        cdef int k, total = 0
        for k in range(count):
            total += self.width[self.node_at[moved[places[k]]]]
        return total

    cdef Py_ssize_t _position(self, int i, int j) noexcept nogil:
        """Where the block of two places starts in the panels; -1 if it is not in the pattern."""
        cdef int s, low, high, middle, r
        if i < j:
            i, j = j, i
        s = self.super_of[j]
        if i < self.opens[s + 1]:
            r = self.start[i] - self.start[self.opens[s]]
        else:
            low, high = self.below[s], self.below[s + 1]
            while low < high:
                middle = (low + high) // 2
                if self.rows[middle] < i:
                    low = middle + 1
                else:
                    high = middle
            if low == self.below[s + 1] or self.rows[low] != i:
                return -1
            r = self.offset[low]
        return self.panel[s] + r + <Py_ssize_t>self.height[s] * (self.start[j] - self.start[self.opens[s]])
