# Elementary functions, rotations and the Earth: fusiond.elementary, fusiond.rotation, fusiond.earth.

# ---------------------------------------------------------------- elementary functions (fusiond.elementary)

cdef void sin_cos(double x, double* sine_out, double* cosine_out) noexcept nogil:
    cdef double turns = floor(x / (1.57079632673412561417 + 6.07710050650619224932e-11) + 0.5)
    cdef double high = x - turns * 1.57079632673412561417
    cdef double low = turns * 6.07710050650619224932e-11
    cdef double r = high - low
    cdef double tail = (high - r) - low
    cdef double z = r * r
    cdef double s = 8.33333333332248946124e-03 + z * (
        -1.98412698298579493134e-04
        + z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))
    cdef double v = z * r
    cdef double sine = r - ((z * (0.5 * tail - v * s) - tail) - v * -1.66666666666666324348e-01)
    cdef double c = z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (
        2.48015872894767294178e-05
        + z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)))))
    cdef double half = 0.5 * z
    cdef double w = 1.0 - half
    cdef double cosine = w + (((1.0 - w) - half) + (z * c - r * tail))
    cdef int quadrant = (<int>turns) & 3
    if quadrant == 0:
        sine_out[0] = sine
        cosine_out[0] = cosine
    elif quadrant == 1:
        sine_out[0] = cosine
        cosine_out[0] = -sine
    elif quadrant == 2:
        sine_out[0] = -sine
        cosine_out[0] = -cosine
    else:
        sine_out[0] = -cosine
        cosine_out[0] = sine


cdef double exponential(double x) noexcept nogil:
    if x < -700.0:
        return 0.0
    if x > 700.0:
        return INFINITY
    cdef double k = floor(x / (6.93147180369123816490e-01 + 1.90821492927058770002e-10) + 0.5)
    cdef double high = x - k * 6.93147180369123816490e-01
    cdef double low = k * 1.90821492927058770002e-10
    cdef double r = high - low
    cdef double t = r * r
    cdef double c = r - t * (1.66666666666666019037e-01 + t * (-2.77777777770155933842e-03 + t * (
        6.61375632143793436117e-05 + t * (-1.65339022054652515390e-06 + t * 4.13813679705723846039e-08))))
    cdef double y = 1.0 - ((low - (r * c) / (2.0 - c)) - high)
    return ldexp(y, <int>k)


cdef double arc_tangent(double x) noexcept nogil:
    """Of x >= 0."""
    cdef double high, low, u, z, w, odd, even
    if x < 0.4375:
        high, low, u = 0.0, 0.0, x
    elif x < 0.6875:
        high, low, u = 4.63647609000806093515e-01, 2.26987774529616870924e-17, (2.0 * x - 1.0) / (2.0 + x)
    elif x < 1.1875:
        high, low, u = 7.85398163397448278999e-01, 3.06161699786838301793e-17, (x - 1.0) / (x + 1.0)
    elif x < 2.4375:
        high, low, u = 9.82793723247329054082e-01, 1.39033110312309984516e-17, (x - 1.5) / (1.0 + 1.5 * x)
    else:
        high, low, u = 1.57079632679489655800, 6.12323399573676603587e-17, -1.0 / x
    z = u * u
    w = z * z
    odd = z * (ATAN[0] + w * (ATAN[2] + w * (ATAN[4] + w * (ATAN[6] + w * (ATAN[8] + w * ATAN[10])))))
    even = w * (ATAN[1] + w * (ATAN[3] + w * (ATAN[5] + w * (ATAN[7] + w * ATAN[9]))))
    return high - ((u * (odd + even) - low) - u)


cdef double atan2(double y, double x) noexcept nogil:
    cdef double angle
    if x == 0.0 and y == 0.0:
        return 0.0
    if x == 0.0:
        angle = HALF_PI_HIGH + HALF_PI_LOW
    else:
        angle = arc_tangent(fabs(y) / fabs(x))
    if x < 0.0:
        angle = PI - (angle - PI_LOW)
    return -angle if y < 0.0 else angle


# ---------------------------------------------------------------- rotations and earth (fusiond.rotation, fusiond.earth)

cdef void quaternion_exp(double* v, double* q) noexcept nogil:
    cdef double angle2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    cdef double scale, w, angle, sine
    if angle2 < 1e-8:
        scale = 0.5 - angle2 / 48
        w = 1 - angle2 / 8 + angle2 * angle2 / 384
    else:
        angle = sqrt(angle2)
        sin_cos(angle / 2, &sine, &w)
        scale = sine / angle
    q[0] = w
    q[1] = scale * v[0]
    q[2] = scale * v[1]
    q[3] = scale * v[2]


cdef void quaternion_multiply(double* a, double* b, double* out) noexcept nogil:
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]


cdef void normalise(double* q) noexcept nogil:
    cdef double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    cdef int i
    for i in range(4):
        q[i] = q[i] / norm


cdef void matrix(double* q, double* m) noexcept nogil:
    cdef double w = q[0], x = q[1], y = q[2], z = q[3]
    m[0] = 1 - 2 * (y * y + z * z)
    m[1] = 2 * (x * y - w * z)
    m[2] = 2 * (x * z + w * y)
    m[3] = 2 * (x * y + w * z)
    m[4] = 1 - 2 * (x * x + z * z)
    m[5] = 2 * (y * z - w * x)
    m[6] = 2 * (x * z - w * y)
    m[7] = 2 * (y * z + w * x)
    m[8] = 1 - 2 * (x * x + y * y)


cdef void times(double* m, double* v, double* out) noexcept nogil:
    cdef int i
    for i in range(3):
        out[i] = m[3 * i] * v[0] + m[3 * i + 1] * v[1] + m[3 * i + 2] * v[2]


cdef void transposed_times(double* m, double* v, double* out) noexcept nogil:
    cdef int i
    for i in range(3):
        out[i] = m[i] * v[0] + m[3 + i] * v[1] + m[6 + i] * v[2]


cdef void cross(double* a, double* b, double* out) noexcept nogil:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


cdef void geodetic_trig(double* r, double* sin_lat, double* cos_lat, double* sin_lon, double* cos_lon) noexcept nogil:
    cdef double p = sqrt(r[0] * r[0] + r[1] * r[1])
    cdef double tn = r[2] * SEMI_MAJOR, td = p * SEMI_MINOR
    cdef double norm, sb, cb, up, out
    cdef int i
    if p > 0:
        sin_lon[0] = r[1] / p
        cos_lon[0] = r[0] / p
    else:
        sin_lon[0] = 0.0
        cos_lon[0] = 1.0
    for i in range(2):
        norm = sqrt(tn * tn + td * td)
        sb = tn / norm
        cb = td / norm
        up = r[2] + SECOND_ECCENTRICITY2 * SEMI_MINOR * sb * sb * sb
        out = p - ECCENTRICITY2 * SEMI_MAJOR * cb * cb * cb
        norm = sqrt(up * up + out * out)
        sin_lat[0] = up / norm
        cos_lat[0] = out / norm
        tn = sin_lat[0] * SEMI_MINOR
        td = cos_lat[0] * SEMI_MAJOR


cdef double height_of(double* r, double sin_lat, double cos_lat) noexcept nogil:
    cdef double root = sqrt(1 - ECCENTRICITY2 * sin_lat * sin_lat)
    return sqrt(r[0] * r[0] + r[1] * r[1]) * cos_lat + r[2] * sin_lat - SEMI_MAJOR * root


cdef void gravity_e(double* r, double* g) noexcept nogil:
    cdef double sa, ca, so, co, s2, surface, ratio, strength
    geodetic_trig(r, &sa, &ca, &so, &co)
    s2 = sa * sa
    surface = EQUATOR_GRAVITY * (1 + SOMIGLIANA * s2) / sqrt(1 - ECCENTRICITY2 * s2)
    ratio = height_of(r, sa, ca) / SEMI_MAJOR
    strength = surface * (
        1 - 2 * ratio * (1 + FLATTENING + GRAVITY_RATIO - 2 * FLATTENING * s2) + 3 * ratio * ratio)
    g[0] = -strength * ca * co
    g[1] = -strength * ca * so
    g[2] = -strength * sa


cdef void mat_ne(double* r, double* m) noexcept nogil:
    cdef double sa, ca, so, co
    geodetic_trig(r, &sa, &ca, &so, &co)
    m[0] = -sa * co
    m[1] = -sa * so
    m[2] = ca
    m[3] = -so
    m[4] = co
    m[5] = 0.0
    m[6] = -ca * co
    m[7] = -ca * so
    m[8] = -sa
