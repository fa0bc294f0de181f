"""Walkers before a camera: upright pictures of people that face it, painted over the traced scene."""

cdef struct Board:  # a walker as seen from one point: an upright picture that faces that point
    double nx, ny, ex, ey, distance, drift, height, half, light
    int64_t picture
    bint mirrored


cdef bint face(const double* w, double ox, double oy, Board* board) noexcept nogil:
    cdef double dx = w[0] - ox, dy = w[1] - oy, speed = sqrt(w[2] * w[2] + w[3] * w[3]), side
    board.distance = sqrt(dx * dx + dy * dy)
    if board.distance < 0.15:
        return False
    board.nx = dx / board.distance
    board.ny = dy / board.distance
    board.ex = board.ny  # to the right, seen from the viewer
    board.ey = -board.nx
    board.drift = w[2] * board.ex + w[3] * board.ey
    side = fabs(board.drift) / speed if speed > 1e-9 else 0.0
    board.picture = <int64_t> w[6] * 3 + (0 if side < 0.35 else (1 if side < 0.8 else 2))
    board.mirrored = board.drift < 0.0
    board.height = w[4]
    board.half = w[8]
    board.light = w[5]
    return True


cdef inline float texel_at(
    const uint8_t* picture, int64_t w, int64_t h, float fx, float fy, float* light
) noexcept nogil:
    """Coverage at a place of a picture, 0..255, and there its reflectance."""
    cdef int64_t x, y
    cdef const uint8_t* p
    cdef const uint8_t* q
    cdef float top, bottom
    if not (fx >= 0.0 and fy >= 0.0 and fx < w - 1 and fy < h - 1):
        return 0.0
    x = <int64_t> fx
    y = <int64_t> fy
    p = picture + 2 * (y * w + x)
    q = p + 2 * w
    if not (p[0] | p[2] | q[0] | q[2]):
        return 0.0
    fx -= x
    fy -= y
    top = p[1] + fx * (p[3] - p[1])
    bottom = q[1] + fx * (q[3] - q[1])
    light[0] = top + fy * (bottom - top)
    top = p[0] + fx * (p[2] - p[0])
    bottom = q[0] + fx * (q[2] - q[0])
    return top + fy * (bottom - top)


cdef inline uint64_t texel(const uint8_t* p) noexcept nogil:
    """Coverage in the lower and reflectance in the upper half, so that both are blended at once."""
    return p[0] | (<uint64_t> p[1] << 32)


cdef bint paint_tile(
    float[:, ::1] linear, const float[:, ::1] depth, const uint8_t* picture, int64_t w, int64_t h, const double* fx,
    const double* fy, const double* t, bint hidden, double light, int64_t r0, int64_t r1, int64_t c0, int64_t c1,
    int32_t* box
) noexcept nogil:
    """Paint a walker into one tile, given places in the picture and depths at the tile's corners.

    `hidden` says whether parts of it may be behind something.
    """
    cdef int64_t r, c, x, y, dx, dy, top = r1, bottom = r0, left = c1, right = c0
    cdef double a, x0, y0, z0, rows = 1.0 / (r1 - r0), columns = 1.0 / (c1 - c0)
    cdef uint64_t across = <uint64_t> (w - 1) << 32, down = <uint64_t> (h - 1) << 32
    cdef uint64_t p, q, part
    cdef float z, dz, alpha
    cdef float full = <float> (1.0 / (255.0 * 16777216.0)), tone = <float> (light / (255.0 * 16777216.0))
    cdef const uint8_t* at
    for r in range(r0, r1):  # of rows so far apart none is at hand unless they are called for at once
        fetch(&linear[r, c0])
        fetch(&linear[r, c1 - 1])
        if hidden:
            fetch(&depth[r, c0])
            fetch(&depth[r, c1 - 1])
    for r in range(r0, r1):
        a = (r - r0 + 0.5) * rows
        x0 = fx[0] + a * (fx[2] - fx[0])
        y0 = fy[0] + a * (fy[2] - fy[0])
        z0 = t[0] + a * (t[2] - t[0])
        dx = <int64_t> ((fx[1] + a * (fx[3] - fx[1]) - x0) * columns * 4294967296.0)  # 32 binary digits
        dy = <int64_t> ((fy[1] + a * (fy[3] - fy[1]) - y0) * columns * 4294967296.0)
        dz = <float> ((t[1] + a * (t[3] - t[1]) - z0) * columns)
        x = <int64_t> (x0 * 4294967296.0) - (dx >> 1)
        y = <int64_t> (y0 * 4294967296.0) - (dy >> 1)
        z = <float> z0 - <float> 0.5 * dz
        for c in range(c0, c1):
            x += dx
            y += dy
            z += dz
            if <uint64_t> x >= across or <uint64_t> y >= down:
                continue
            at = picture + 2 * ((y >> 32) * w + (x >> 32))
            if not (at[0] | at[2] | at[2 * w] | at[2 * w + 2]) or (hidden and z >= depth[r, c]):
                continue
            part = (x >> 20) & 4095
            p = texel(at)
            p = (p << 12) + (texel(at + 2) - p) * part
            q = texel(at + 2 * w)
            q = (q << 12) + (texel(at + 2 * w + 2) - q) * part
            p = (p << 12) + (q - p) * <uint64_t> ((y >> 20) & 4095)
            alpha = <float> <uint32_t> p * full
            linear[r, c] += alpha * (<float> <uint32_t> (p >> 32) * tone - linear[r, c])
            top = min(top, r)
            bottom = r + 1
            left = min(left, c)
            right = max(right, c + 1)
    box[0] = <int32_t> top
    box[1] = <int32_t> bottom
    box[2] = <int32_t> left
    box[3] = <int32_t> right
    return bottom > top


cdef inline bint covered(
    const uint8_t* cover, int64_t w, int64_t h, const double* fx, const double* fy
) noexcept nogil:
    """Whether anything of a picture is between these corners; `cover` is its greatest coverage per block."""
    cdef int64_t x, y
    cdef int64_t x0 = <int64_t> max(min(min(fx[0], fx[1]), min(fx[2], fx[3])), 0.0)
    cdef int64_t y0 = <int64_t> max(min(min(fy[0], fy[1]), min(fy[2], fy[3])), 0.0)
    cdef int64_t x1 = <int64_t> max(min(max(max(fx[0], fx[1]), max(fx[2], fx[3])), w - 1.0), -1.0)
    cdef int64_t y1 = <int64_t> max(min(max(max(fy[0], fy[1]), max(fy[2], fy[3])), h - 1.0), -1.0)
    for y in range(y0 // BLOCK, (y1 + BLOCK) // BLOCK):
        for x in range(x0 // BLOCK, (x1 + BLOCK) // BLOCK):
            if cover[y * (w // BLOCK) + x]:
                return True
    return False


def paint_walkers(
    float[:, ::1] linear, const float[:, ::1] depth, const float[:, :, ::1] reach, const float[:, :, ::1] rays,
    const double[:, ::1] T_store_camera, const double[:, ::1] walkers, const uint8_t[::1] sprites,
    const int64_t[:, ::1] levels, const uint8_t[::1] cover, double row_time, int32_t[:, ::1] boxes
):
    cdef int64_t height = linear.shape[0], width = linear.shape[1], used = 0
    cdef int64_t tiles = (width + 15) // 16, k, i, j, r, c, side, level, picture, h, w
    cdef double d[3]
    cdef double fx[4]
    cdef double fy[4]
    cdef double t[4]
    cdef double ox = T_store_camera[0, 3], oy = T_store_camera[1, 3], oz = T_store_camera[2, 3]
    cdef double ahead, near, pixel, s
    cdef Board board
    # column, row and depth of the corners above and below a row of tiles
    cdef double* corners = <double*> malloc(6 * (tiles + 1) * sizeof(double))
    cdef double* corner
    if corners == NULL:
        raise MemoryError
    with nogil:
        for k in range(walkers.shape[0]):
            if not face(&walkers[k, 0], ox, oy, &board):
                continue
            pixel = fabs(rays[height // 2, width // 2 + 1, 0] - rays[height // 2, width // 2, 0]) * board.distance
            level = 0
            while level + 1 < levels.shape[0] and pixel * levels[level, 1] > 1.5 * board.height:
                level += 1
            h = levels[level, 1]
            w = levels[level, 2]
            picture = levels[level, 0] + (<int64_t> walkers[k, 7] * levels[level, 3] + board.picture) * h * w
            side = 0
            for i in range((height + 15) // 16 + 1):
                r = min(16 * i, height)
                side = 1 - side
                corner = corners + 3 * (tiles + 1) * side
                for j in range(tiles + 1):
                    c = min(16 * j, width)
                    direction(T_store_camera, rays[r, c, 0], rays[r, c, 1], d)
                    ahead = d[0] * board.nx + d[1] * board.ny
                    corner[2] = board.distance / ahead if ahead > 0.02 else -1.0
                    s = (corner[2] * (d[0] * board.ex + d[1] * board.ey) - board.drift * row_time * r) / board.half
                    corner[0] = (0.5 - 0.5 * s if board.mirrored else 0.5 + 0.5 * s) * w - 0.5
                    corner[1] = (1.0 - (oz + corner[2] * d[2]) / board.height) * h - 0.5
                    corner += 3
                if i == 0:
                    continue
                for j in range(tiles):
                    for c in range(4):
                        corner = corners + 3 * ((tiles + 1) * (1 - side if c < 2 else side) + j + c % 2)
                        fx[c] = corner[0]
                        fy[c] = corner[1]
                        t[c] = corner[2]
                    near = min(min(t[0], t[1]), min(t[2], t[3]))
                    if near < 0.0 or near >= reach[i - 1, j, 1] or used >= boxes.shape[0]:
                        continue
                    if covered(&cover[picture // (BLOCK * BLOCK)], w, h, fx, fy):
                        used += paint_tile(linear, depth, &sprites[2 * picture], w, h, fx, fy, t,
                                           max(max(t[0], t[1]), max(t[2], t[3])) >= reach[i - 1, j, 0], board.light,
                                           16 * i - 16, r, 16 * j, min(16 * j + 16, width), &boxes[used, 0])
    free(corners)
    return used


def transmission(
    const double[:, ::1] origins, const double[:, ::1] targets, const double[::1] delays, const int64_t[::1] spots,
    const double[:, ::1] walkers, const uint8_t[::1] sprites, const int64_t[:, ::1] levels, double[:, ::1] strength
):
    cdef int64_t i, k, picture
    cdef double dx, dy, reach, t, s, z, passed
    cdef float light = 0.0
    cdef Board board
    with nogil:
        for i in range(origins.shape[0]):
            if strength[0, spots[i]] <= 0.0 and strength[1, spots[i]] <= 0.0:
                continue
            for k in range(walkers.shape[0]):
                if not face(&walkers[k, 0], origins[i, 0], origins[i, 1], &board):
                    continue
                dx = targets[i, 0] - origins[i, 0]
                dy = targets[i, 1] - origins[i, 1]
                reach = dx * board.nx + dy * board.ny
                if reach <= board.distance:
                    continue
                t = board.distance / reach
                s = (t * (dx * board.ex + dy * board.ey) - board.drift * delays[i]) / board.half
                z = (origins[i, 2] + t * (targets[i, 2] - origins[i, 2])) / board.height
                if board.mirrored:
                    s = -s
                picture = levels[0, 0] + (<int64_t> walkers[k, 7] * levels[0, 3] + board.picture) \
                    * levels[0, 1] * levels[0, 2]
                passed = 1.0 - texel_at(&sprites[2 * picture], levels[0, 2], levels[0, 1],
                                        <float> ((0.5 + 0.5 * s) * levels[0, 2] - 0.5),
                                        <float> ((1.0 - z) * levels[0, 1] - 0.5), &light) / 255.0
                strength[0, spots[i]] *= passed
                strength[1, spots[i]] *= passed
