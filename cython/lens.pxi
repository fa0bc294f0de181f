"""Projection through a lens with derivatives: the same formulas as robotd.geometry.camera, one point at a time."""

cdef enum:
    LENS = 16  # numbers of a camera: fx fy cx cy, 8 coefficients, limit, square of the valid radius, fisheye, pinhole

cdef double PI = 3.14159265358979323846


cdef bint _image(const double* lens, const double* p, double* image, double* J) noexcept nogil:
    """Normalised image (2,) of a point in camera axes and its (2, 3) derivative; False where the lens cannot see."""
    if lens[14] != 0.0:
        return _fisheye(lens, p, image, J)
    return _pinhole(lens, p, image, J)


cdef bint _pinhole(const double* lens, const double* p, double* image, double* J) noexcept nogil:
    cdef const double* k = lens + 4
    cdef double x, y, s, numerator, denominator, radial, slope, cross, a, d, inverse
    if not p[2] > 1e-9:
        return False
    inverse = 1.0 / p[2]
    x, y = p[0] * inverse, p[1] * inverse
    s = x * x + y * y
    if not s <= lens[12] * lens[12]:
        return False
    if lens[15] != 0.0:
        image[0], image[1] = x, y
        J[0], J[1], J[2] = inverse, 0.0, -x * inverse
        J[3], J[4], J[5] = 0.0, inverse, -y * inverse
        return True
    # k1 k2 p1 p2 k3 k4 k5 k6
    numerator = 1.0 + s * (k[0] + s * (k[1] + s * k[4]))
    denominator = 1.0 + s * (k[5] + s * (k[6] + s * k[7]))
    radial = numerator / denominator
    image[0] = x * radial + 2.0 * k[2] * x * y + k[3] * (s + 2.0 * x * x)
    image[1] = y * radial + k[2] * (s + 2.0 * y * y) + 2.0 * k[3] * x * y
    slope = (
        k[0] + s * (2.0 * k[1] + s * 3.0 * k[4]) - radial * (k[5] + s * (2.0 * k[6] + s * 3.0 * k[7]))
    ) / denominator
    cross = 2.0 * slope * x * y + 2.0 * (k[2] * x + k[3] * y)
    a = radial + 2.0 * slope * x * x + 2.0 * k[2] * y + 6.0 * k[3] * x
    d = radial + 2.0 * slope * y * y + 6.0 * k[2] * y + 2.0 * k[3] * x
    J[0], J[1], J[3], J[4] = a * inverse, cross * inverse, cross * inverse, d * inverse
    J[2] = -(J[0] * x + J[1] * y)
    J[5] = -(J[3] * x + J[4] * y)
    return True


cdef bint _fisheye(const double* lens, const double* p, double* image, double* J) noexcept nogil:
    cdef const double* k = lens + 4
    cdef double x = p[0], y = p[1], z = p[2], rho = hypot(x, y), angle = atan2(rho, z), s = angle * angle
    cdef double radius, slope, ratio, along, ux, uy, square
    if not angle <= lens[12]:
        return False
    radius = angle * (1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    slope = 1.0 + s * (3.0 * k[0] + s * (5.0 * k[1] + s * (7.0 * k[2] + s * 9.0 * k[3])))
    square = max(rho * rho + z * z, 1e-300)
    if rho < 1e-12:
        ratio, along = 1.0 / (z if z > 0.0 else 1.0), 0.0
        ux = x / rho if rho > 0.0 else 0.0
        uy = y / rho if rho > 0.0 else 0.0
    else:
        ratio, ux, uy = radius / rho, x / rho, y / rho
        along = slope * z / square - ratio
    image[0], image[1] = x * ratio, y * ratio
    J[0], J[1] = ratio + along * ux * ux, along * ux * uy
    J[3], J[4] = J[1], ratio + along * uy * uy
    J[2], J[5] = -(slope * rho / square) * ux, -(slope * rho / square) * uy
    return True
