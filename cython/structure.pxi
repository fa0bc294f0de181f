"""The structure of a problem: everything that does not depend on the state."""

cdef enum:
    STOP = 5
    CAMERA = 10
    ROOF = 8
    BEACON = 2
    ODOMETRY = 3
    MOVE = 9  # columns of a move: 3 of either stop and the odometry factors


cdef class Structure:
    """Who sees what, sorted by label; which entries are free; which blocks there are."""

    cdef Arena arena
    cdef int size
    cdef int stops, cameras, planes, labels, count, moves, roofs, knowns, globals, nodes, entries
    cdef bint tilts
    cdef int alike  # the width of all stops but the first that have one, or 0
    cdef double* points
    cdef int* width  # of each stop; the last node holds cameras, roofs and odometry factors
    cdef int* first
    cdef int* active  # (stops, 5) and then (cameras, 10) and so on: which entries are free
    cdef int* camera_width
    cdef int* camera_first  # among the columns of the last node
    cdef int* plane_width  # of each roof camera, then of each beacon
    cdef int* plane_first
    cdef int* plane_entry
    cdef int odometry_width, odometry_first, odometry_entry
    cdef int64_t* entry_of  # of each column, its index in the frame vector
    cdef double* prior
    cdef int* label_at  # labels by the stop that first saw them, because neighbours in memory are then used together
    cdef int* rank  # of each label, its number in that order, which is what all arrays below use
    # sightings by label
    cdef int* source
    cdef int* obs_begin
    cdef int* obs_stop
    cdef int* obs_camera
    cdef int* obs_entry  # entry of its stop, then of its camera; -1 if none
    cdef double* obs  # u, v, sigma, probability
    # entries: a label and a node, by label: stops ascending, then cameras
    cdef int* entry_begin
    cdef int* camera_begin  # of each label, its first entry that is a camera's
    cdef int* entry_node
    cdef int* entry_label
    cdef Py_ssize_t* entry_at
    cdef Py_ssize_t couplings
    cdef int* row_begin  # entries of each stop
    cdef int* row_entries
    # the matrix: block rows of its lower half
    cdef int* begin
    cdef int* column
    cdef Py_ssize_t* block
    cdef Py_ssize_t values, last_row
    cdef Py_ssize_t* move_block
    cdef double* lens
    cdef double* R_robot_camera
    cdef double* t_robot_camera
    cdef int* before
    cdef int* after
    cdef double* moved  # 3 measured, 9 root of information, 9 derivatives by the odometry factors
    cdef int* roof_stop
    cdef int* roof_plane  # of each sighting, its roof camera, then, from `planes` on, its beacon
    cdef double* plane_axes  # of each roof camera, (8, 3, 3)
    cdef double* roof  # 3 beacon, 2 pixels, sigma, 9 homography
    cdef int* known_point
    cdef double* known  # 3 position, sigma

    def __init__(
        self, int stops, int labels, const int64_t[::1] columns, const double[::1] prior, const double[:, ::1] lens,
        const double[:, :, ::1] R_robot_camera, const double[:, ::1] t_robot_camera, const int64_t[::1] stop,
        const int64_t[::1] camera, const int64_t[::1] point, const double[:, ::1] uv, const double[::1] sigma,
        const double[::1] probability, const int64_t[::1] before, const int64_t[::1] after,
        const double[:, ::1] measured, const double[:, :, ::1] roots, const double[:, :, ::1] by_errors,
        const int64_t[::1] roof_stop, const int64_t[::1] roof_camera,
        const int64_t[::1] roof_beacon, const double[:, :, :, ::1] roof_axes, int beacons,
        const double[:, ::1] beacon, const double[:, ::1] roof_uv, const double[::1] roof_sigma,
        const double[:, :, ::1] H_image_world, const int64_t[::1] known_point, const double[:, ::1] known_position,
        const double[::1] known_sigma,
    ):
        cdef int c, f, k, i, j, entry
        cdef Arena arena = Arena()
        self.arena = arena
        self.stops, self.cameras, self.labels, self.count = stops, lens.shape[0], labels, stop.shape[0]
        self.nodes, self.entries = stops + 1, columns.shape[0]
        self.width, self.first = arena.ints(self.nodes), arena.ints(self.nodes)
        self.active = arena.ints(columns.shape[0])
        self.entry_of = <int64_t*>arena.take(columns.shape[0] * sizeof(int64_t))
        self.prior = arena.doubles(columns.shape[0])
        self.camera_width, self.camera_first = arena.ints(self.cameras), arena.ints(self.cameras)
        self.size = 0
        self.tilts = False
        self.alike = -1
        self.points = arena.doubles(3 * labels)
        for i in range(columns.shape[0]):
            self.prior[i] = prior[i]
            if columns[i] >= 0:
                self.entry_of[columns[i]] = i
        for f in range(stops):
            self.first[f] = self.size
            self.width[f] = self._free(columns, STOP * f, STOP)
            if self.width[f] and f > 0:
                self.alike = self.width[f] if self.alike < 0 or self.alike == self.width[f] else 0
            for k in range(self.width[f]):
                self.tilts = self.tilts or self.active[STOP * f + k] > 2
        self.first[stops] = self.size
        for c in range(self.cameras):
            self.camera_first[c] = self.size - self.first[stops]
            self.camera_width[c] = self._free(columns, STOP * stops + CAMERA * c, CAMERA)
        self.planes = roof_axes.shape[0]
        entry, k = STOP * stops + CAMERA * self.cameras, self.planes + beacons
        self.plane_width, self.plane_first, self.plane_entry = arena.ints(k), arena.ints(k), arena.ints(k)
        for i in range(k):
            self.plane_first[i], self.plane_entry[i] = self.size - self.first[stops], entry
            self.plane_width[i] = self._free(columns, entry, ROOF if i < self.planes else BEACON)
            entry += ROOF if i < self.planes else BEACON
        if entry + ODOMETRY != self.entries:
            raise ValueError(f"expected {entry + ODOMETRY} columns, got {self.entries}")
        self.odometry_first, self.odometry_entry = self.size - self.first[stops], entry
        self.odometry_width = self._free(columns, entry, ODOMETRY)
        self.globals = self.width[stops] = self.size - self.first[stops]
        self.lens = arena.doubles(LENS * self.cameras)
        self.R_robot_camera, self.t_robot_camera = arena.doubles(9 * self.cameras), arena.doubles(3 * self.cameras)
        for c in range(self.cameras):
            for k in range(LENS):
                self.lens[LENS * c + k] = lens[c, k]
            for k in range(9):
                self.R_robot_camera[9 * c + k] = R_robot_camera[c, k // 3, k % 3]
            for k in range(3):
                self.t_robot_camera[3 * c + k] = t_robot_camera[c, k]
        self.moves, self.roofs, self.knowns = before.shape[0], roof_stop.shape[0], known_point.shape[0]
        self.before, self.after = arena.ints(self.moves), arena.ints(self.moves)
        self.moved = arena.doubles(21 * self.moves)
        for i in range(self.moves):
            if not 0 <= before[i] < after[i] < stops:
                raise ValueError(f"a move must lead from an earlier to a later stop, got {before[i]} to {after[i]}")
            self.before[i], self.after[i] = before[i], after[i]
            for k in range(3):
                self.moved[21 * i + k] = measured[i, k]
            for k in range(9):
                self.moved[21 * i + 3 + k] = roots[i, k // 3, k % 3]
                self.moved[21 * i + 12 + k] = by_errors[i, k // 3, k % 3]
        self.roof_stop, self.roof = arena.ints(self.roofs), arena.doubles(15 * self.roofs)
        self.roof_plane, self.plane_axes = arena.ints(2 * self.roofs), arena.doubles(9 * ROOF * self.planes)
        for i in range(self.planes):
            for k in range(9 * ROOF):
                self.plane_axes[9 * ROOF * i + k] = roof_axes[i, k // 9, k // 3 % 3, k % 3]
        for i in range(self.roofs):
            if not (0 <= roof_stop[i] < stops and 0 <= roof_camera[i] < self.planes and 0 <= roof_beacon[i] < beacons):
                raise ValueError(f"roof sighting {i}: stop, camera or beacon out of range")
            self.roof_stop[i] = roof_stop[i]
            self.roof_plane[2 * i], self.roof_plane[2 * i + 1] = roof_camera[i], self.planes + roof_beacon[i]
            for k in range(3):
                self.roof[15 * i + k] = beacon[i, k]
            self.roof[15 * i + 3], self.roof[15 * i + 4] = roof_uv[i, 0], roof_uv[i, 1]
            self.roof[15 * i + 5] = roof_sigma[i]
            for k in range(9):
                self.roof[15 * i + 6 + k] = H_image_world[i, k // 3, k % 3]
        self._rank(stop, camera, point)
        self._sort(stop, camera, point, uv, sigma, probability)
        self.known_point, self.known = arena.ints(self.knowns), arena.doubles(4 * self.knowns)
        for i in range(self.knowns):
            self.known_point[i] = self.rank[known_point[i]]
            for k in range(3):
                self.known[4 * i + k] = known_position[i, k]
            self.known[4 * i + 3] = known_sigma[i]

    cdef int _rank(self, const int64_t[::1] stop, const int64_t[::1] camera, const int64_t[::1] point) except -1:
        cdef int i, l, s
        cdef Arena scratch = Arena()
        cdef int* first = scratch.ints(self.labels)
        cdef int* start = scratch.ints(self.stops + 2)
        self.label_at, self.rank = self.arena.ints(self.labels), self.arena.ints(self.labels)
        for l in range(self.labels):
            first[l] = self.stops
        for i in range(self.count):
            if not (0 <= stop[i] < self.stops and 0 <= camera[i] < self.cameras and 0 <= point[i] < self.labels):
                raise ValueError(f"sighting {i}: stop, camera or label out of range")
            first[point[i]] = min(first[point[i]], <int>stop[i])
        for l in range(self.labels):
            start[first[l] + 1] += 1
        for s in range(self.stops):
            start[s + 1] += start[s]
        for l in range(self.labels):
            self.rank[l] = start[first[l]]
            self.label_at[self.rank[l]] = l
            start[first[l]] += 1
        return 0

    cdef int _free(self, const int64_t[::1] columns, int base, int entries):
        cdef int k, width = 0
        for k in range(entries):
            if columns[base + k] >= 0:
                self.active[base + width] = k
                width += 1
        self.size += width
        return width

    cdef int _sort(
        self, const int64_t[::1] stop, const int64_t[::1] camera, const int64_t[::1] point, const double[:, ::1] uv,
        const double[::1] sigma, const double[::1] probability,
    ) except -1:
        """Sightings by label and, within a label, by stop; entries of labels and nodes."""
        cdef int n = self.count, i, k, l, s, c, j, entries = 0, from_
        cdef Arena arena = self.arena, scratch = Arena()
        cdef int* start = scratch.ints(max(self.stops, self.labels) + 1)
        cdef int* by_stop = scratch.ints(n)
        cdef int* camera_entry = scratch.ints(self.cameras)
        for i in range(n):
            start[stop[i] + 1] += 1
        for s in range(self.stops):
            start[s + 1] += start[s]
        for i in range(n):
            by_stop[start[stop[i]]] = i
            start[stop[i]] += 1
        memset(start, 0, (max(self.stops, self.labels) + 1) * sizeof(int))
        self.obs_begin = arena.ints(self.labels + 1)
        for i in range(n):
            self.obs_begin[self.rank[point[i]] + 1] += 1
        for l in range(self.labels):
            self.obs_begin[l + 1] += self.obs_begin[l]
            start[l] = self.obs_begin[l]
        self.source = arena.ints(n)
        for k in range(n):
            i = by_stop[k]
            l = self.rank[point[i]]
            self.source[start[l]] = i
            start[l] += 1
        self.obs_stop, self.obs_camera, self.obs_entry = arena.ints(n), arena.ints(n), arena.ints(2 * n)
        self.obs = arena.doubles(4 * n)
        self.entry_begin, self.camera_begin = arena.ints(self.labels + 1), arena.ints(self.labels + 1)
        self.entry_node, self.entry_label = arena.ints(2 * n), arena.ints(2 * n)
        self.entry_at = arena.offsets(2 * n)
        self.couplings = 0
        for l in range(self.labels):
            s = -1
            for c in range(self.cameras):
                camera_entry[c] = -1
            for k in range(self.obs_begin[l], self.obs_begin[l + 1]):
                i = self.source[k]
                self.obs_stop[k], self.obs_camera[k] = stop[i], camera[i]
                self.obs[4 * k], self.obs[4 * k + 1] = uv[i, 0], uv[i, 1]
                self.obs[4 * k + 2], self.obs[4 * k + 3] = sigma[i], probability[i]
                camera_entry[camera[i]] = 0
                self.obs_entry[2 * k] = -1
                if self.width[stop[i]]:
                    if stop[i] != s:
                        s = stop[i]
                        self._entry(entries, l, s, self.width[s])
                        entries += 1
                    self.obs_entry[2 * k] = entries - 1
            self.camera_begin[l] = entries
            for c in range(self.cameras):
                if camera_entry[c] == 0 and self.camera_width[c]:
                    camera_entry[c] = entries
                    self._entry(entries, l, c, self.camera_width[c])
                    entries += 1
                else:
                    camera_entry[c] = -1
            for k in range(self.obs_begin[l], self.obs_begin[l + 1]):
                self.obs_entry[2 * k + 1] = camera_entry[self.obs_camera[k]]
            self.entry_begin[l + 1] = entries
        self.row_begin = arena.ints(self.stops + 1)
        for l in range(self.labels):
            for k in range(self.entry_begin[l], self.camera_begin[l]):
                self.row_begin[self.entry_node[k] + 1] += 1
        for s in range(self.stops):
            self.row_begin[s + 1] += self.row_begin[s]
        self.row_entries = arena.ints(self.row_begin[self.stops])
        from_ = max(self.stops, self.labels) + 1
        memset(start, 0, from_ * sizeof(int))
        for l in range(self.labels):
            for k in range(self.entry_begin[l], self.camera_begin[l]):
                s = self.entry_node[k]
                self.row_entries[self.row_begin[s] + start[s]] = k
                start[s] += 1
        return 0

    cdef void _ordered(self, const double* given, double* points) noexcept nogil:
        cdef int l
        for l in range(self.labels):
            memcpy(points + 3 * l, given + 3 * self.label_at[l], 3 * sizeof(double))

    cdef void _entry(self, int entry, int label, int node, int width) noexcept:
        self.entry_node[entry], self.entry_label[entry] = node, label
        self.entry_at[entry] = self.couplings
        self.couplings += 3 * width

    cdef int _pattern(self) except -1:
        """Blocks of the reduced matrix: stops that see a common label or are joined by a move; the last row is full."""
        cdef int a, b, e, f, k, l, m, room, count
        cdef Arena arena = self.arena, scratch = Arena()
        cdef int* mark = scratch.ints(self.stops)
        cdef int* move_begin = scratch.ints(self.stops + 1)
        cdef int* move_at = scratch.ints(self.moves)
        cdef int* found = scratch.ints(self.stops + 1)
        cdef int** rows = <int**>scratch.take(self.stops * sizeof(int*))
        self.begin = arena.ints(self.nodes + 1)
        self.move_block = arena.offsets(self.moves)
        for m in range(self.moves):
            move_begin[self.after[m] + 1] += 1
        for a in range(self.stops):
            move_begin[a + 1] += move_begin[a]
            mark[a] = -1
        memset(found, 0, (self.stops + 1) * sizeof(int))
        for m in range(self.moves):
            a = self.after[m]
            move_at[move_begin[a] + found[a]] = m
            found[a] += 1
        for a in range(self.stops):
            count = 0
            if self.width[a]:
                mark[a] = a
                found[0] = a
                count = 1
                for k in range(move_begin[a], move_begin[a + 1]):
                    b = self.before[move_at[k]]
                    if self.width[b] and mark[b] != a:
                        mark[b] = a
                        found[count] = b
                        count += 1
                for k in range(self.row_begin[a], self.row_begin[a + 1]):
                    e = self.row_entries[k]
                    for f in range(self.entry_begin[self.entry_label[e]], e):
                        b = self.entry_node[f]
                        if mark[b] != a:
                            mark[b] = a
                            found[count] = b
                            count += 1
            rows[a] = scratch.ints(count)
            memcpy(rows[a], found, count * sizeof(int))
            self.begin[a + 1] = self.begin[a] + count
        self.begin[self.nodes] = self.begin[self.stops] + (self.nodes if self.globals else 0)
        self.column = arena.ints(self.begin[self.nodes])
        self.block = arena.offsets(self.begin[self.nodes])
        self.values = 0
        for a in range(self.stops):
            memcpy(self.column + self.begin[a], rows[a], (self.begin[a + 1] - self.begin[a]) * sizeof(int))
            for k in range(self.begin[a], self.begin[a + 1]):
                self.block[k] = self.values
                self.values += self.width[a] * self.width[self.column[k]]
        self.last_row = self.values
        if self.globals:
            for b in range(self.nodes):
                k = self.begin[self.stops] + b
                self.column[k], self.block[k] = b, self.values
                self.values += <Py_ssize_t>self.globals * self.width[b]
        for m in range(self.moves):
            self.move_block[m] = -1
            for k in range(self.begin[self.after[m]], self.begin[self.after[m] + 1]):
                if self.column[k] == self.before[m] and self.width[self.before[m]]:
                    self.move_block[m] = self.block[k]
        return 0
