# Made by tools/translate_kernel from fusiond/filter and fusiond/maths: not to be edited. `n`: number of error states.


cdef double[4] PRIOR = [0.997, 0.001, 0.001, 0.001]
cdef double[4] PRIOR_OF_LIAR = [0.499, 0.001, 0.499, 0.001]

# ---------------- fusiond.maths.linear

cdef double linear_dot(double* a, double* b) noexcept nogil:
    cdef double total
    cdef int64_t k
    total = 0.0
    for k in range(n):
        total += (a[k] * b[k])
    return total

# ---------------- fusiond.maths.portable

cdef double portable_square(double x) noexcept nogil:
    return (x * x)

cdef (double, double) portable_sin_cos(double x) noexcept nogil:
    cdef double turns
    cdef double high
    cdef double low
    cdef double r
    cdef double tail
    cdef double z
    cdef double s
    cdef double v
    cdef double sine
    cdef double c
    cdef double half
    cdef double w
    cdef double cosine
    cdef int64_t quadrant
    if (not isfinite(x)):
        return (NAN, NAN)
    turns = floor(((x / (1.5707963267341256 + 6.077100506506192e-11)) + 0.5))
    high, low = (x - (turns * 1.5707963267341256)), (turns * 6.077100506506192e-11)
    r = (high - low)
    tail = ((high - r) - low)
    z = (r * r)
    s = (0.00833333333332249 + (z * ((-0.0001984126982985795) + (z * (2.7557313707070068e-06 + (z * ((-2.5050760253406863e-08) + (z * 1.58969099521155e-10))))))))
    v = (z * r)
    sine = (r - (((z * ((0.5 * tail) - (v * s))) - tail) - (v * (-0.16666666666666632))))
    c = (z * (0.0416666666666666 + (z * ((-0.001388888888887411) + (z * (2.480158728947673e-05 + (z * ((-2.7557314351390663e-07) + (z * (2.087572321298175e-09 + (z * (-1.1359647557788195e-11))))))))))))
    half = (0.5 * z)
    w = (1.0 - half)
    cosine = (w + (((1.0 - w) - half) + ((z * c) - (r * tail))))
    quadrant = ((<int64_t>turns) & 3)
    if (quadrant == 0):
        return (sine, cosine)
    if (quadrant == 1):
        return (cosine, (-sine))
    if (quadrant == 2):
        return ((-sine), (-cosine))
    return ((-cosine), sine)

cdef double portable__atan(double x) noexcept nogil:
    cdef double high
    cdef double low
    cdef double u
    cdef double z
    cdef double w
    cdef double odd
    cdef double even
    if (x < 0.4375):
        high, low, u = 0.0, 0.0, x
    elif (x < 0.6875):
        high, low, u = 0.4636476090008061, 2.2698777452961687e-17, (((2.0 * x) - 1.0) / (2.0 + x))
    elif (x < 1.1875):
        high, low, u = 0.7853981633974483, 3.061616997868383e-17, ((x - 1.0) / (x + 1.0))
    elif (x < 2.4375):
        high, low, u = 0.982793723247329, 1.3903311031230998e-17, ((x - 1.5) / (1.0 + (1.5 * x)))
    else:
        high, low, u = 1.5707963267948966, 6.123233995736766e-17, ((-1.0) / x)
    z = (u * u)
    w = (z * z)
    odd = (z * (0.3333333333333293 + (w * (0.14285714272503466 + (w * (0.09090887133436507 + (w * (0.06661073137387531 + (w * (0.049768779946159324 + (w * 0.016285820115365782)))))))))))
    even = (w * (-0.19999999999876483 + (w * (-0.11111110405462356 + (w * (-0.0769187620504483 + (w * (-0.058335701337905735 + (w * -0.036531572744216916)))))))))
    return (high - (((u * (odd + even)) - low) - u))

cdef double portable_atan2(double y, double x) noexcept nogil:
    cdef double far
    cdef double near
    cdef double angle
    if ((x == 0.0) and (y == 0.0)):
        return 0.0
    far, near = fabs(y), fabs(x)
    angle = ((1.5707963267341256 + 6.077100506506192e-11) if (near == 0.0) else portable__atan((far / near)))
    if (x < 0.0):
        angle = (3.141592653589793 - (angle - 1.2246467991473532e-16))
    return ((-angle) if (y < 0.0) else angle)

cdef double portable_exp(double x) noexcept nogil:
    cdef double k
    cdef double high
    cdef double low
    cdef double r
    cdef double t
    cdef double c
    cdef double y
    if isnan(x):
        return x
    if (x < (-700.0)):
        return 0.0
    if (x > 700.0):
        return INFINITY
    k = floor(((x / (0.6931471803691238 + 1.9082149292705877e-10)) + 0.5))
    high, low = (x - (k * 0.6931471803691238)), (k * 1.9082149292705877e-10)
    r = (high - low)
    t = (r * r)
    c = (r - (t * (0.16666666666666602 + (t * ((-0.0027777777777015593) + (t * (6.613756321437934e-05 + (t * ((-1.6533902205465252e-06) + (t * 4.1381367970572385e-08))))))))))
    y = (1.0 - ((low - ((r * c) / (2.0 - c))) - high))
    return ldexp(y, (<int64_t>k))

# ---------------- fusiond.maths.rotation

cdef void rotation_times(double* mat, double* v, double* out) noexcept nogil:
    out[0] = (((mat[(0) * 3 + 0] * v[0]) + (mat[(0) * 3 + 1] * v[1])) + (mat[(0) * 3 + 2] * v[2]))
    out[1] = (((mat[(1) * 3 + 0] * v[0]) + (mat[(1) * 3 + 1] * v[1])) + (mat[(1) * 3 + 2] * v[2]))
    out[2] = (((mat[(2) * 3 + 0] * v[0]) + (mat[(2) * 3 + 1] * v[1])) + (mat[(2) * 3 + 2] * v[2]))
    return

cdef double rotation_inner(double* a, double* b) noexcept nogil:
    cdef double total
    cdef int64_t i
    total = 0.0
    for i in range(3):
        total += (a[i] * b[i])
    return total

cdef void rotation_transposed_times(double* mat, double* v, double* out) noexcept nogil:
    out[0] = (((mat[(0) * 3 + 0] * v[0]) + (mat[(1) * 3 + 0] * v[1])) + (mat[(2) * 3 + 0] * v[2]))
    out[1] = (((mat[(0) * 3 + 1] * v[0]) + (mat[(1) * 3 + 1] * v[1])) + (mat[(2) * 3 + 1] * v[2]))
    out[2] = (((mat[(0) * 3 + 2] * v[0]) + (mat[(1) * 3 + 2] * v[1])) + (mat[(2) * 3 + 2] * v[2]))
    return

cdef void rotation_matrix_product(double* a, double* b, double* out) noexcept nogil:
    cdef double found[3 * 3]
    cdef int64_t i
    cdef double _t1
    cdef double _t2
    cdef double _t3
    cdef int _i
    for i in range(3):
        _t1 = a[(i) * 3 + 0]
        _t2 = a[(i) * 3 + 1]
        _t3 = a[(i) * 3 + 2]
        for _i in range(3):
            (found + (i) * 3)[_i] = (((_t1 * (b + (0) * 3)[_i]) + (_t2 * (b + (1) * 3)[_i])) + (_t3 * (b + (2) * 3)[_i]))
    memcpy(out, found, 3 * 3 * sizeof(double))
    return

cdef void rotation_cross(double* a, double* b, double* out) noexcept nogil:
    out[0] = ((a[1] * b[2]) - (a[2] * b[1]))
    out[1] = ((a[2] * b[0]) - (a[0] * b[2]))
    out[2] = ((a[0] * b[1]) - (a[1] * b[0]))
    return

cdef void rotation_quaternion_exp(double* rotation, double* out) noexcept nogil:
    cdef double x
    cdef double y
    cdef double z
    cdef double angle2
    cdef double scale
    cdef double w
    cdef double angle
    cdef (double, double) _t1
    cdef double sine
    x = rotation[0]
    y = rotation[1]
    z = rotation[2]
    angle2 = (((x * x) + (y * y)) + (z * z))
    if (angle2 < 1e-08):
        scale, w = (0.5 - (angle2 / 48)), ((1 - (angle2 / 8)) + ((angle2 * angle2) / 384))
    else:
        angle = sqrt(angle2)
        _t1 = portable_sin_cos((angle / 2))
        sine = _t1[0]
        w = _t1[1]
        scale = (sine / angle)
    out[0] = w
    out[1] = (scale * x)
    out[2] = (scale * y)
    out[3] = (scale * z)
    return

cdef void rotation_quaternion_multiply(double* a, double* b, double* out) noexcept nogil:
    cdef double aw
    cdef double ax
    cdef double ay
    cdef double az
    cdef double bw
    cdef double bx
    cdef double by
    cdef double bz
    aw = a[0]
    ax = a[1]
    ay = a[2]
    az = a[3]
    bw = b[0]
    bx = b[1]
    by = b[2]
    bz = b[3]
    out[0] = ((((aw * bw) - (ax * bx)) - (ay * by)) - (az * bz))
    out[1] = ((((aw * bx) + (ax * bw)) + (ay * bz)) - (az * by))
    out[2] = ((((aw * by) - (ax * bz)) + (ay * bw)) + (az * bx))
    out[3] = ((((aw * bz) + (ax * by)) - (ay * bx)) + (az * bw))
    return

cdef void rotation_normalised(double* quaternion, double* out) noexcept nogil:
    cdef double w
    cdef double x
    cdef double y
    cdef double z
    cdef double _t1
    cdef int _i
    w = quaternion[0]
    x = quaternion[1]
    y = quaternion[2]
    z = quaternion[3]
    _t1 = sqrt(((((w * w) + (x * x)) + (y * y)) + (z * z)))
    for _i in range(4):
        out[_i] = (quaternion[_i] / _t1)
    return

cdef void rotation_matrix(double* quaternion_ab, double* out) noexcept nogil:
    cdef double w
    cdef double x
    cdef double y
    cdef double z
    w = quaternion_ab[0]
    x = quaternion_ab[1]
    y = quaternion_ab[2]
    z = quaternion_ab[3]
    out[0] = (1 - (2 * ((y * y) + (z * z))))
    out[1] = (2 * ((x * y) - (w * z)))
    out[2] = (2 * ((x * z) + (w * y)))
    out[3] = (2 * ((x * y) + (w * z)))
    out[4] = (1 - (2 * ((x * x) + (z * z))))
    out[5] = (2 * ((y * z) - (w * x)))
    out[6] = (2 * ((x * z) - (w * y)))
    out[7] = (2 * ((y * z) + (w * x)))
    out[8] = (1 - (2 * ((x * x) + (y * y))))
    return

cdef void rotation_quaternion(double* mat_ab, double* out) noexcept nogil:
    cdef double* m
    cdef double q[4]
    cdef double trace
    cdef double largest
    cdef int64_t pick
    cdef int64_t i
    m = mat_ab
    trace = ((m[(0) * 3 + 0] + m[(1) * 3 + 1]) + m[(2) * 3 + 2])
    largest, pick = trace, 0
    for i in range(3):
        if (m[(i) * 3 + i] > largest):
            largest, pick = m[(i) * 3 + i], (i + 1)
    if (pick == 0):
        q[0], q[1], q[2], q[3] = (1 + trace), (m[(2) * 3 + 1] - m[(1) * 3 + 2]), (m[(0) * 3 + 2] - m[(2) * 3 + 0]), (m[(1) * 3 + 0] - m[(0) * 3 + 1])
    elif (pick == 1):
        q[0], q[1], q[2], q[3] = (m[(2) * 3 + 1] - m[(1) * 3 + 2]), ((1 + (2 * m[(0) * 3 + 0])) - trace), (m[(0) * 3 + 1] + m[(1) * 3 + 0]), (m[(0) * 3 + 2] + m[(2) * 3 + 0])
    elif (pick == 2):
        q[0], q[1], q[2], q[3] = (m[(0) * 3 + 2] - m[(2) * 3 + 0]), (m[(0) * 3 + 1] + m[(1) * 3 + 0]), ((1 + (2 * m[(1) * 3 + 1])) - trace), (m[(1) * 3 + 2] + m[(2) * 3 + 1])
    else:
        q[0], q[1], q[2], q[3] = (m[(1) * 3 + 0] - m[(0) * 3 + 1]), (m[(0) * 3 + 2] + m[(2) * 3 + 0]), (m[(1) * 3 + 2] + m[(2) * 3 + 1]), ((1 + (2 * m[(2) * 3 + 2])) - trace)
    if (not (q[0] >= 0)):
        for i in range(4):
            q[i] = (-q[i])
    rotation_normalised(q, out)
    return

# ---------------- fusiond.maths.wgs84

cdef (double, double, double, double) wgs84_geodetic_trig(double x, double y, double z) noexcept nogil:
    cdef double p
    cdef double sin_lon
    cdef double cos_lon
    cdef double tangent_n
    cdef double tangent_d
    cdef double sin_lat
    cdef double cos_lat
    cdef int64_t _
    cdef double norm
    cdef double sin_b
    cdef double cos_b
    cdef double up
    cdef double out
    p = sqrt(((x * x) + (y * y)))
    if (p > 0):
        sin_lon, cos_lon = (y / p), (x / p)
    else:
        sin_lon, cos_lon = 0.0, 1.0
    tangent_n, tangent_d = (z * 6378137.0), (p * 6356752.314245179)
    sin_lat, cos_lat = 0.0, 1.0
    for _ in range(2):
        norm = sqrt(((tangent_n * tangent_n) + (tangent_d * tangent_d)))
        sin_b, cos_b = (tangent_n / norm), (tangent_d / norm)
        up = (z + ((((0.006739496742276434 * 6356752.314245179) * sin_b) * sin_b) * sin_b))
        out = (p - ((((0.0066943799901413165 * 6378137.0) * cos_b) * cos_b) * cos_b))
        norm = sqrt(((up * up) + (out * out)))
        sin_lat, cos_lat = (up / norm), (out / norm)
        tangent_n, tangent_d = (sin_lat * 6356752.314245179), (cos_lat * 6378137.0)
    return (sin_lat, cos_lat, sin_lon, cos_lon)

cdef double wgs84_height_of(double x, double y, double z, double sin_lat, double cos_lat) noexcept nogil:
    cdef double root
    root = sqrt((1 - ((0.0066943799901413165 * sin_lat) * sin_lat)))
    return (((sqrt(((x * x) + (y * y))) * cos_lat) + (z * sin_lat)) - (6378137.0 * root))

cdef (double, double, double) wgs84_geodetic(double* position_e) noexcept nogil:
    cdef double x
    cdef double y
    cdef double z
    cdef (double, double, double, double) _t1
    cdef double sin_lat
    cdef double cos_lat
    cdef double sin_lon
    cdef double cos_lon
    x, y, z = (<double>(position_e[0])), (<double>(position_e[1])), (<double>(position_e[2]))
    _t1 = wgs84_geodetic_trig(x, y, z)
    sin_lat = _t1[0]
    cos_lat = _t1[1]
    sin_lon = _t1[2]
    cos_lon = _t1[3]
    return (portable_atan2(sin_lat, cos_lat), portable_atan2(sin_lon, cos_lon), wgs84_height_of(x, y, z, sin_lat, cos_lat))

cdef void wgs84_mat_ne_from_trig(double sin_lat, double cos_lat, double sin_lon, double cos_lon, double* out) noexcept nogil:
    out[0] = ((-sin_lat) * cos_lon)
    out[1] = ((-sin_lat) * sin_lon)
    out[2] = cos_lat
    out[3] = (-sin_lon)
    out[4] = cos_lon
    out[5] = 0.0
    out[6] = ((-cos_lat) * cos_lon)
    out[7] = ((-cos_lat) * sin_lon)
    out[8] = (-sin_lat)
    return

cdef void wgs84_mat_ne(double* position_e, double* out) noexcept nogil:
    cdef (double, double, double, double) _t1
    cdef double sin_lat
    cdef double cos_lat
    cdef double sin_lon
    cdef double cos_lon
    _t1 = wgs84_geodetic_trig(position_e[0], position_e[1], position_e[2])
    sin_lat = _t1[0]
    cos_lat = _t1[1]
    sin_lon = _t1[2]
    cos_lon = _t1[3]
    wgs84_mat_ne_from_trig(sin_lat, cos_lat, sin_lon, cos_lon, out)
    return

cdef double wgs84_normal_gravity(double sin_lat, double height) noexcept nogil:
    cdef double s2
    cdef double surface
    cdef double ratio
    s2 = (sin_lat * sin_lat)
    surface = ((9.7803253359 * (1 + (0.00193185265241 * s2))) / sqrt((1 - (0.0066943799901413165 * s2))))
    ratio = (height / 6378137.0)
    return (surface * ((1 - ((2 * ratio) * (((1 + 0.0033528106647474805) + 0.0034497865068408447) - ((2 * 0.0033528106647474805) * s2)))) + ((3 * ratio) * ratio)))

cdef void wgs84_gravity_e(double* position_e, double* out) noexcept nogil:
    cdef double x
    cdef double y
    cdef double z
    cdef (double, double, double, double) _t1
    cdef double sin_lat
    cdef double cos_lat
    cdef double sin_lon
    cdef double cos_lon
    cdef double g
    x, y, z = (<double>(position_e[0])), (<double>(position_e[1])), (<double>(position_e[2]))
    _t1 = wgs84_geodetic_trig(x, y, z)
    sin_lat = _t1[0]
    cos_lat = _t1[1]
    sin_lon = _t1[2]
    cos_lon = _t1[3]
    g = wgs84_normal_gravity(sin_lat, wgs84_height_of(x, y, z, sin_lat, cos_lat))
    out[0] = (((-g) * cos_lat) * cos_lon)
    out[1] = (((-g) * cos_lat) * sin_lon)
    out[2] = ((-g) * sin_lat)
    return

# ---------------- fusiond.filter.gnss_error

cdef void gnss_error_carry(State* state, int64_t source, double* values, Parameters* params) noexcept nogil:
    cdef double* parameter
    cdef double* x
    cdef double* p
    cdef double kept
    cdef double last
    cdef int64_t i
    cdef int _i
    cdef double factor
    cdef double new
    cdef double to_n[3 * 3]
    cdef double horizontal
    cdef double vertical
    cdef double late
    cdef int64_t j
    cdef double along
    parameter = params.model_parameters + (source) * PARAMETERS
    x = state.nominal
    p = state.covariance
    if (not (parameter[5] > 0)):
        return
    kept, last = 0.0, state.memory[(source) * MEMORY_SIZE + 21]
    if ((state.stamps[5] != (<int64_t>-4611686018427387904)) and ((last == 0) or (last == values[5]))):
        kept = portable_exp(((-((state.stamps[0] - state.stamps[5]) * 1e-09)) / parameter[5]))
    for i in range(3):
        x[(19 + i)] *= kept
        for _i in range(n):
            (p + ((18 + i)) * n)[_i] *= kept
    for i in range(3):
        for _i in range(n):
            (p + (18 + i))[_i * n] *= kept
    if state.tracked:
        for i in range(3):
            for _i in range(n):
                (state.transition + ((18 + i)) * n)[_i] *= kept
    factor = source_health_noise_factor(state.memory + (source) * MEMORY_SIZE, parameter[8], parameter[9])
    new = ((factor * parameter[7]) * (1 - (kept * kept)))
    wgs84_mat_ne(x, to_n)
    horizontal, vertical = (new * values[3]), (new * values[4])
    gnss_error__add(p, 18, to_n, horizontal, horizontal, vertical)
    late = ((new * parameter[6]) * parameter[6])
    for i in range(3):
        for j in range(3):
            along = (x[(3 + i)] * x[(3 + j)])
            p[((18 + i)) * n + (18 + j)] += (late * along)

cdef void gnss_error_note(State* state, int64_t source, double* values, Parameters* params) noexcept nogil:
    state.memory[(source) * MEMORY_SIZE + 21] = values[5]
    if (params.model_parameters[(source) * PARAMETERS + 5] > 0):
        state.stamps[5] = state.stamps[0]

cdef void gnss_error_with_whole_error(State* state, int64_t source, double* values, Parameters* params, double* innovation, double* spread) noexcept nogil:
    cdef double* parameter
    cdef double* p
    cdef double to_n[3 * 3]
    cdef double share
    cdef double error_n[3]
    cdef double late_n[3]
    cdef int64_t i
    cdef double own
    cdef int64_t j
    cdef int64_t k
    cdef double variance
    cdef double _t1
    parameter = params.model_parameters + (source) * PARAMETERS
    p = state.covariance
    if (not (parameter[5] > 0)):
        return
    wgs84_mat_ne(state.nominal, to_n)
    share = (source_health_noise_factor(state.memory + (source) * MEMORY_SIZE, parameter[8], parameter[9]) * parameter[7])
    rotation_times(to_n, state.nominal + 19, error_n)
    rotation_times(to_n, state.nominal + 3, late_n)
    for i in range(3):
        innovation[i] += error_n[i]
        own = 0.0
        for j in range(3):
            for k in range(3):
                own += ((to_n[(i) * 3 + j] * p[((18 + j)) * n + (18 + k)]) * to_n[(i) * 3 + k])
        variance = (values[4] if (i == 2) else values[3])
        variance += portable_square((parameter[6] * late_n[i]))
        _t1 = ((share * variance) - own)
        spread[(i) * 3 + i] += (0.0 if 0.0 > _t1 else _t1)

cdef void gnss_error_forget_prior(State* state, int64_t source, double* values, Parameters* params) noexcept nogil:
    cdef double* parameter
    cdef double* p
    cdef double to_n[3 * 3]
    cdef double rest[3 * 3]
    cdef double share
    cdef double late
    cdef int64_t i
    cdef int64_t j
    cdef double along
    cdef double sigma
    cdef double lower[3 * 3]
    cdef double none[3]
    cdef double columns[3 * n]
    cdef double whole[3]
    cdef int64_t a
    cdef int _i
    cdef int64_t b
    cdef double _t1
    cdef double error[n]
    parameter = params.model_parameters + (source) * PARAMETERS
    p = state.covariance
    if (not (parameter[5] > 0)):
        return
    wgs84_mat_ne(state.nominal, to_n)
    memset(rest, 0, 3 * 3 * sizeof(double))
    share = (source_health_noise_factor(state.memory + (source) * MEMORY_SIZE, parameter[8], parameter[9]) * parameter[7])
    late = portable_square(parameter[6])
    for i in range(3):
        for j in range(3):
            along = (state.nominal[(3 + i)] * state.nominal[(3 + j)])
            sigma = (values[3] * ((to_n[(0) * 3 + i] * to_n[(0) * 3 + j]) + (to_n[(1) * 3 + i] * to_n[(1) * 3 + j])))
            sigma += ((values[4] * (to_n[(2) * 3 + i] * to_n[(2) * 3 + j])) + (late * along))
            rest[(i) * 3 + j] = (((1.1 * share) * sigma) - p[((18 + i)) * n + (18 + j)])
    memset(none, 0, 3 * sizeof(double))
    if (not measurement_update_cholesky(rest, none, 1.0, 3, lower)):
        return
    for a in range(3):
        for _i in range(n):
            (columns + (a) * n)[_i] = (p + ((18 + a)) * n)[_i]
        whole[a] = state.nominal[(19 + a)]
        for b in range(a):
            axpy(columns + (a) * n, (-lower[(a) * 3 + b]), columns + (b) * n)
            whole[a] -= (lower[(a) * 3 + b] * whole[b])
        _t1 = lower[(a) * 3 + a]
        for _i in range(n):
            (columns + (a) * n)[_i] /= _t1
        whole[a] /= lower[(a) * 3 + a]
    memset(error, 0, n * sizeof(double))
    for a in range(3):
        axpy(error, whole[a], columns + (a) * n)
        for i in range(n):
            axpy(p + (i) * n, columns[(a) * n + i], columns + (a) * n)
    linear_mirror(p)
    measurement_update_inject(state, error)

cdef void gnss_error_place(State* state, int64_t source, double* values, Observation* seen, Parameters* params) noexcept nogil:
    cdef double* x
    cdef double* p
    cdef double to_n[3 * 3]
    cdef bint slow
    cdef double off[3]
    cdef double variance[3]
    cdef double common[3]
    cdef double _t1[3]
    cdef int _i
    cdef int64_t a
    cdef int64_t i
    cdef int64_t j
    cdef double _t2[3]
    cdef double along[3]
    x = state.nominal
    p = state.covariance
    wgs84_mat_ne(x, to_n)
    slow = (params.model_parameters[(source) * PARAMETERS + 5] > 0)
    memset(off, 0, 3 * sizeof(double))
    memset(variance, 0, 3 * sizeof(double))
    memset(common, 0, 3 * sizeof(double))
    if slow:
        rotation_times(to_n, x + 19, _t1)
        for _i in range(3):
            off[_i] = _t1[_i]
        state.stamps[5] = (<int64_t>-4611686018427387904)
        gnss_error_carry(state, source, values, params)
        gnss_error_note(state, source, values, params)
    for a in range(seen.m):
        off[a] += seen.innovation[a]
        variance[a], common[a] = seen.variance[a], seen.common[a]
    for a in range(seen.m, 3):
        off[a] = 0.0
        for i in range(3):
            for j in range(3):
                variance[a] += ((to_n[(a) * 3 + i] * p[((0 + i)) * n + (0 + j)]) * to_n[(a) * 3 + j])
    rotation_transposed_times(to_n, off, _t2)
    for _i in range(3):
        x[_i] += _t2[_i]
    for i in range(3):
        for _i in range(n):
            (p + ((0 + i)) * n)[_i] = 0.0
        for _i in range(n):
            (p + (0 + i))[_i * n] = 0.0
    gnss_error__add(p, 0, to_n, variance[0], variance[1], variance[2])
    rotation_transposed_times(to_n, common, along)
    for i in range(3):
        for j in range(3):
            p[((0 + i)) * n + (0 + j)] += (along[i] * along[j])
    if slow:
        gnss_error__tie(p, to_n, seen.m)

cdef void gnss_error__tie(double* p, double* to_n, int64_t axes) noexcept nogil:
    cdef double along[3 * 3]
    cdef double across[3 * 3]
    cdef int64_t a
    cdef int64_t i
    cdef int64_t j
    cdef int64_t k
    memset(along, 0, 3 * 3 * sizeof(double))
    memset(across, 0, 3 * 3 * sizeof(double))
    for a in range(axes):
        for i in range(3):
            for j in range(3):
                along[(i) * 3 + j] += (to_n[(a) * 3 + i] * to_n[(a) * 3 + j])
    for i in range(3):
        for k in range(3):
            for j in range(3):
                across[(i) * 3 + j] += (along[(i) * 3 + k] * p[((18 + k)) * n + (18 + j)])
    for i in range(3):
        for j in range(3):
            p[((0 + i)) * n + (18 + j)] = (-across[(i) * 3 + j])
            p[((18 + j)) * n + (0 + i)] = (-across[(i) * 3 + j])
    for i in range(3):
        for j in range(i, 3):
            for k in range(3):
                p[((0 + i)) * n + (0 + j)] += (across[(i) * 3 + k] * along[(k) * 3 + j])
            p[((0 + j)) * n + (0 + i)] = p[((0 + i)) * n + (0 + j)]

cdef void gnss_error__add(double* p, int64_t block, double* to_n, double north, double east, double down) noexcept nogil:
    cdef int64_t i
    cdef int64_t j
    for i in range(3):
        for j in range(3):
            p[((block + i)) * n + (block + j)] += (((north * (to_n[(0) * 3 + i] * to_n[(0) * 3 + j])) + (east * (to_n[(1) * 3 + i] * to_n[(1) * 3 + j]))) + (down * (to_n[(2) * 3 + i] * to_n[(2) * 3 + j])))

# ---------------- fusiond.filter.heading_bank

cdef void heading_bank_weigh(State* state, int64_t i, Observation* seen, double factor, double* spread) noexcept nogil:
    cdef double likely
    likely = rivals_likelihood(seen.innovation, seen.variance, factor, seen.m, spread)
    if (likely > 0):
        state.bank[(i) * BLOCK + 0] *= likely

cdef void heading_bank_fuse(State* state, int64_t i, State* hypothesis, Observation* seen, double factor, Parameters* params, bint weighed) noexcept nogil:
    cdef double across[3 * n]
    cdef double spread[3 * 3]
    measurement_update_project(hypothesis, seen, across, spread)
    if weighed:
        heading_bank_weigh(state, i, seen, factor, spread)
    measurement_update_update_projected(hypothesis, seen, params.gates[seen.m], factor, True, 0.01, across, spread, False)

cdef void heading_bank_fuse_measurement(State* state, int64_t i, int64_t model, double* values, double* parameter, double factor, Parameters* params) noexcept nogil:
    cdef State hypothesis
    cdef Observation seen
    cdef double across[3 * n]
    cdef double spread[3 * 3]
    hypothesis = hypothesis_of(state, i)
    if (model == 2):
        if (not heading_bank__velocity_is_known(state, params)):
            return
        wheel_speed_observe_certain(&hypothesis, values, parameter, &seen)
        measurement_share_noise(&hypothesis, &seen, parameter)
        measurement_update_project(&hypothesis, &seen, across, spread)
        heading_bank_weigh(state, i, &seen, factor, spread)
    if observations_observe(&hypothesis, model, values, parameter, &seen):
        measurement_share_noise(&hypothesis, &seen, parameter)
        heading_bank_fuse(state, i, &hypothesis, &seen, factor, params, (model != 2))

cdef void heading_bank_constrain(State* state, Parameters* params) noexcept nogil:
    cdef (bint, bint) _t1
    cdef bint still
    cdef bint rolling
    cdef Observation seen
    cdef int64_t i
    cdef State hypothesis
    _t1 = motion_constraints_constraints_due(state, params)
    still = _t1[0]
    rolling = _t1[1]
    still = (still and heading_bank__stillness_is_known(state, params))
    if (not (still or rolling)):
        return
    for i in range(13):
        if (still and (state.bank[(i) * BLOCK + 0] > 0)):
            hypothesis = hypothesis_of(state, i)
            motion_constraints_observe_constraint(&hypothesis, 1, params, &seen)
            model_with_rate_noise(&hypothesis, &seen)
            heading_bank_fuse(state, i, &hypothesis, &seen, params.zero_velocity_factor, params, True)
            motion_constraints_observe_constraint(&hypothesis, 2, params, &seen)
            model_with_rate_noise(&hypothesis, &seen)
            heading_bank_fuse(state, i, &hypothesis, &seen, 1.0, params, True)
    if (rolling and (not still)):
        heading_bank__roll(state, params)
    heading_bank_normalise(state)

cdef bint heading_bank__stillness_is_known(State* state, Parameters* params) noexcept nogil:
    cdef int64_t i
    cdef int64_t _k1
    cdef int64_t silent_ns
    if (params.wheels_count > 0):
        return True
    for _k1 in range(params.velocities_count):
        i = params.velocities[_k1]
        silent_ns = (state.stamps[0] - state.source_stamps[(i) * SOURCE_STAMPS_SIZE + 0])
        if (silent_ns <= 2000000000):
            return True
    return False

cdef void heading_bank__roll(State* state, Parameters* params) noexcept nogil:
    cdef double* parameter
    cdef Observation seen
    cdef double fastest
    cdef int64_t i
    cdef State hypothesis
    cdef double _t1
    parameter = params.constraints + (0) * PARAMETERS
    fastest = 0.0
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            hypothesis = hypothesis_of(state, i)
            _t1 = non_holonomic_observe_at_any_speed(&hypothesis, parameter, &seen)
            fastest = (_t1 if _t1 > fastest else fastest)
    if ((fastest < parameter[5]) or (not heading_bank__velocity_is_known(state, params))):
        return
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            hypothesis = hypothesis_of(state, i)
            non_holonomic_observe_at_any_speed(&hypothesis, parameter, &seen)
            model_with_rate_noise(&hypothesis, &seen)
            heading_bank_fuse(state, i, &hypothesis, &seen, 1.0, params, True)

cdef bint heading_bank__velocity_is_known(State* state, Parameters* params) noexcept nogil:
    cdef double unsure
    cdef int64_t i
    cdef State hypothesis
    cdef double variance
    cdef int64_t a
    unsure = 0.0
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            hypothesis = hypothesis_of(state, i)
            variance = 0.0
            for a in range(3, 6):
                variance += (hypothesis.covariance[(a) * n + a] / 3)
            unsure = (variance if variance > unsure else unsure)
    return (((unsure * 0.20943951023931956) * 0.20943951023931956) <= params.constraints[(0) * PARAMETERS + 3])

cdef void heading_bank_normalise(State* state) noexcept nogil:
    cdef double total
    cdef int64_t i
    cdef State hypothesis
    total = 0.0
    for i in range(13):
        hypothesis = hypothesis_of(state, i)
        if (not ((state.bank[(i) * BLOCK + 0] > 0) and isfinite(state.bank[(i) * BLOCK + 0]) and state_is_sound(&hypothesis))):
            state.bank[(i) * BLOCK + 0] = 0.0
        total += state.bank[(i) * BLOCK + 0]
    for i in range(13):
        state.bank[(i) * BLOCK + 0] = ((state.bank[(i) * BLOCK + 0] / total) if (total > 0) else 0.0)
        if (state.bank[(i) * BLOCK + 0] < 1e-09):
            state.bank[(i) * BLOCK + 0] = 0.0

cdef void heading_bank_collapse_if_close(State* state, Parameters* params) noexcept nogil:
    cdef int64_t best
    cdef int64_t i
    cdef State likeliest
    cdef double to_n[3 * 3]
    cdef double* down
    cdef double errors[13 * n]
    cdef double turns[13]
    cdef double _t1
    cdef double mean
    cdef double spread
    cdef double doubt
    cdef State hypothesis
    cdef double _t2[n]
    cdef int _i
    cdef double* turn
    cdef double own
    heading_bank_normalise(state)
    best = (-1)
    for i in range(13):
        if ((state.bank[(i) * BLOCK + 0] > 0) and ((best < 0) or (state.bank[(i) * BLOCK + 0] > state.bank[(best) * BLOCK + 0]))):
            best = i
    if (best < 0):
        return
    likeliest = hypothesis_of(state, best)
    wgs84_mat_ne(likeliest.nominal, to_n)
    down = to_n + (2) * 3
    memset(errors, 0, 13 * n * sizeof(double))
    memset(turns, 0, 13 * sizeof(double))
    _t1 = 0.0
    mean = _t1
    spread = _t1
    doubt = _t1
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            hypothesis = hypothesis_of(state, i)
            measurement_update_difference(&hypothesis, &likeliest, _t2)
            for _i in range(n):
                (errors + (i) * n)[_i] = _t2[_i]
            turn = errors + (i) * n + 6
            turns[i] = (((down[0] * turn[0]) + (down[1] * turn[1])) + (down[2] * turn[2]))
            mean += (state.bank[(i) * BLOCK + 0] * turns[i])
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            hypothesis = hypothesis_of(state, i)
            own = state_variance_about(&hypothesis, down[0], down[1], down[2])
            spread += (state.bank[(i) * BLOCK + 0] * (own + ((turns[i] - mean) * (turns[i] - mean))))
            if (fabs(turns[i]) > 0.5235987755982988):
                doubt += state.bank[(i) * BLOCK + 0]
    if ((spread <= params.heading_variance) and (doubt <= 0.0001)):
        heading_bank__collapse(state, best, errors)

cdef void heading_bank__collapse(State* state, int64_t best, double* errors) noexcept nogil:
    cdef double* p
    cdef double mean[n]
    cdef int64_t i
    cdef int _i
    cdef double weight
    cdef State hypothesis
    cdef int64_t j
    cdef double _t1
    cdef double _t2
    cdef State likeliest
    cdef int64_t source
    p = state.covariance
    memset(mean, 0, n * sizeof(double))
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            axpy(mean, state.bank[(i) * BLOCK + 0], errors + (i) * n)
    for _i in range(n * n):
        p[_i] = 0.0
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            weight = state.bank[(i) * BLOCK + 0]
            hypothesis = hypothesis_of(state, i)
            for j in range(n):
                _t1 = (errors[(i) * n + j] - mean[j])
                _t2 = (errors[(i) * n + j] - mean[j])
                for _i in range(n):
                    (p + (j) * n)[_i] += (weight * ((hypothesis.covariance + (j) * n)[_i] + (_t2 * ((errors + (i) * n)[_i] - mean[_i]))))
    linear_mirror(p)
    likeliest = hypothesis_of(state, best)
    for _i in range(NOMINAL_SIZE):
        state.nominal[_i] = likeliest.nominal[_i]
    measurement_update_inject(state, mean)
    for _i in range(HYPOTHESES * BLOCK):
        state.bank[_i] = 0.0
    state.stamps[10] = 2
    if (state.stamps[21] == 1):
        state_count_reset(state, 5)
    for source in range(state.sources):
        state.source_stamps[(source) * SOURCE_STAMPS_SIZE + 4] = (<int64_t>-4611686018427387904)

# ---------------- fusiond.filter.hot_start

cdef bint hot_start_leads(State* state, Parameters* params) noexcept nogil:
    if ((state.stamps[10] != 3) or (state.stamps[21] != 1)):
        return False
    return (state.bank[(12) * BLOCK + 0] >= 0.5)

cdef bint hot_start_has_state(State* state, Parameters* params) noexcept nogil:
    return ((state.stamps[10] == 2) or hot_start_leads(state, params))

# ---------------- fusiond.filter.inertial_delay

cdef void inertial_delay_catch_up(State* state, double* force_change, double* rate_change) noexcept nogil:
    cdef double* x
    cdef double* p
    cdef int64_t gyro
    cdef int64_t accel
    cdef double c[3 * 3]
    cdef double turned_e[3]
    cdef double pushed_e[3]
    cdef double turn[4]
    cdef double _t1
    cdef double _t2[3]
    cdef int _i
    cdef double _t3[4]
    cdef double _t4[4]
    cdef double _t5
    cdef int64_t i
    cdef double _t6
    cdef double _t7
    x = state.nominal
    p = state.covariance
    gyro, accel = 30, (30 + 1)
    if ((n == 21) or (not ((p[(gyro) * n + gyro] + p[(accel) * n + accel]) > 0))):
        return
    rotation_matrix(x + 6, c)
    rotation_times(c, rate_change, turned_e)
    rotation_times(c, force_change, pushed_e)
    _t1 = x[31]
    for _i in range(3):
        _t2[_i] = (rate_change[_i] * _t1)
    rotation_quaternion_exp(_t2, turn)
    rotation_quaternion_multiply(x + 6, turn, _t4)
    rotation_normalised(_t4, _t3)
    for _i in range(4):
        (x + 6)[_i] = _t3[_i]
    _t5 = x[(31 + 1)]
    for _i in range(3):
        (x + 3)[_i] += (pushed_e[_i] * _t5)
    for i in range(3):
        axpy(p + ((3 + i)) * n, pushed_e[i], p + (accel) * n)
        axpy(p + ((6 + i)) * n, turned_e[i], p + (gyro) * n)
    for i in range(3):
        _t6 = pushed_e[i]
        for _i in range(n):
            (p + (3 + i))[_i * n] += (_t6 * (p + accel)[_i * n])
        _t7 = turned_e[i]
        for _i in range(n):
            (p + (6 + i))[_i * n] += (_t7 * (p + gyro)[_i * n])
    if state.tracked:
        for i in range(3):
            axpy(state.transition + ((3 + i)) * n, pushed_e[i], state.transition + (accel) * n)
            axpy(state.transition + ((6 + i)) * n, turned_e[i], state.transition + (gyro) * n)

# ---------------- fusiond.filter.inertial_sample

cdef (double, double, double, double) inertial_sample_compare(State* state, double* values, double elapsed, Parameters* params) noexcept nogil:
    cdef double* a
    cdef double _t1
    cdef double force
    cdef double rate
    cdef int64_t i
    cdef double white
    cdef double _t2
    cdef double _t3
    cdef double _t4
    cdef double _t5
    a = state.auxiliary
    _t1 = 0.0
    force = _t1
    rate = _t1
    for i in range(3):
        force += portable_square((values[i] - a[(0 + i)]))
        rate += portable_square((values[(3 + i)] - a[(3 + i)]))
    white = (6.0 / (0.0001 if 0.0001 > elapsed else elapsed))
    _t2 = a[48]
    _t3 = (white * params.noise.accel)
    _t4 = a[49]
    _t5 = (white * params.noise.gyro)
    return (force, rate, (_t3 if _t3 > _t2 else _t2), (_t5 if _t5 > _t4 else _t4))

cdef (double, double) inertial_sample_ratios(double force, double rate, double own_force, double own_rate, double since, double blows) noexcept nogil:
    cdef double by_force
    by_force = (force / ((36.0 * own_force) + portable_square(((blows * 40.0) + (400.0 * since)))))
    return (by_force, (rate / ((36.0 * own_rate) + portable_square(((blows * 1.0) + (20.0 * since))))))

cdef double inertial_sample_since_last(State* state, int64_t t_ns, Parameters* params) noexcept nogil:
    cdef int64_t last
    last = state.source_stamps[(params.imu_source) * SOURCE_STAMPS_SIZE + 0]
    if ((state.stamps[1] == (<int64_t>-4611686018427387904)) or (last == (<int64_t>-4611686018427387904)) or ((t_ns - last) > params.imu_gap_ns)):
        return INFINITY
    return ((t_ns - last) * 1e-09)

cdef bint inertial_sample_is_believed(State* state, double* values, int64_t t_ns, Parameters* params) noexcept nogil:
    cdef double since
    cdef double elapsed
    cdef (double, double, double, double) _t1
    cdef double force
    cdef double rate
    cdef double own_force
    cdef double own_rate
    cdef (double, double) _t2
    cdef double by_force
    cdef double by_rate
    if (not source_health_is_trusted(state.memory + (params.imu_source) * MEMORY_SIZE)):
        return False
    since = inertial_sample_since_last(state, t_ns, params)
    if (not (state.auxiliary[50] > since)):
        return True
    elapsed = ((t_ns - state.stamps[1]) * 1e-09)
    _t1 = inertial_sample_compare(state, values, elapsed, params)
    force = _t1[0]
    rate = _t1[1]
    own_force = _t1[2]
    own_rate = _t1[3]
    _t2 = inertial_sample_ratios(force, rate, own_force, own_rate, since, 1.0)
    by_force = _t2[0]
    by_rate = _t2[1]
    return (not ((by_force > 1) or (by_rate > 1)))

cdef bint inertial_sample_judge(State* state, Row* row, Parameters* params) noexcept nogil:
    cdef double* a
    cdef double* values
    cdef int64_t t_ns
    cdef double since
    cdef double elapsed
    cdef (double, double, double, double) _t1
    cdef double force
    cdef double rate
    cdef double own_force
    cdef double own_rate
    cdef (double, double) _t2
    cdef double by_force
    cdef double by_rate
    cdef int64_t i
    cdef double _t3
    cdef double share
    cdef double _t4
    cdef double _t5
    a = state.auxiliary
    values = row.values
    t_ns = (<int64_t>row.t_ns)
    since = inertial_sample_since_last(state, t_ns, params)
    if (since == INFINITY):
        a[50] = 0.0
        return True
    elapsed = ((t_ns - state.stamps[1]) * 1e-09)
    _t1 = inertial_sample_compare(state, values, elapsed, params)
    force = _t1[0]
    rate = _t1[1]
    own_force = _t1[2]
    own_rate = _t1[3]
    _t2 = inertial_sample_ratios(force, rate, own_force, own_rate, since, 1.0)
    by_force = _t2[0]
    by_rate = _t2[1]
    if ((by_force > 1) or (by_rate > 1)):
        row.ratio = (by_rate if by_rate > by_force else by_force)
        for i in range(3):
            if (by_force > by_rate):
                row.innovation[i] = (values[i] - a[(0 + i)])
                row.variance[i] = (own_force / 3)
            else:
                row.innovation[i] = (values[(3 + i)] - a[(3 + i)])
                row.variance[i] = (own_rate / 3)
        if (a[50] > since):
            a[50] -= since
            return False
        a[50] = 0.0
    else:
        _t3 = (a[50] + since)
        a[50] = (2.0 if 2.0 < _t3 else _t3)
    share = (since / (1.0 + since))
    _t4 = (16.0 * own_force)
    a[48] += (share * ((_t4 if _t4 < force else force) - a[48]))
    _t5 = (16.0 * own_rate)
    a[49] += (share * ((_t5 if _t5 < rate else rate) - a[49]))
    return True

cdef (double, double) inertial_sample_doubt(State* state, double* values, int64_t t_ns, int64_t until_ns, bint believed, Parameters* params) noexcept nogil:
    cdef int64_t held
    cdef double elapsed
    cdef (double, double, double, double) _t1
    cdef double force
    cdef double rate
    cdef double own_force
    cdef double own_rate
    cdef (double, double) _t2
    cdef double by_force
    cdef double by_rate
    cdef bint bridged
    cdef double _t3
    cdef double _t4
    cdef double steps
    held = state.stamps[1]
    elapsed = ((until_ns - held) * 1e-09)
    _t1 = inertial_sample_compare(state, values, elapsed, params)
    force = _t1[0]
    rate = _t1[1]
    own_force = _t1[2]
    own_rate = _t1[3]
    _t2 = inertial_sample_ratios(force, rate, own_force, own_rate, elapsed, 0.0)
    by_force = _t2[0]
    by_rate = _t2[1]
    bridged = ((not believed) or (state.source_stamps[(params.imu_source) * SOURCE_STAMPS_SIZE + 0] > held))
    if (not (bridged or (by_force > 1) or (by_rate > 1))):
        return (0.0, 0.0)
    if (not believed):
        elapsed, force, rate = ((t_ns - held) * 1e-09), 0.0, 0.0
    _t3 = state.memory[(params.imu_source) * MEMORY_SIZE + 13]
    _t4 = (elapsed / (0.0001 if 0.0001 > _t3 else _t3))
    steps = (1.0 if 1.0 > _t4 else _t4)
    return ((((own_force * steps) + (0.08333333333333333 * force)) * elapsed), (((own_rate * steps) + (0.08333333333333333 * rate)) * elapsed))

cdef void inertial_sample_judge_sensor(State* state, double* values, int64_t t_ns, Parameters* params) noexcept nogil:
    cdef double* memory
    cdef double* a
    cdef bint same
    cdef bint fine
    cdef int64_t kind
    cdef double change
    cdef double odds
    cdef int64_t i
    cdef double _t1
    memory = state.memory + (params.imu_source) * MEMORY_SIZE
    a = state.auxiliary
    same, fine = inertial_sample_judge_axes(state, values, params), False
    for kind in range(2):
        change = (a[48] if (kind == 0) else a[49])
        if (change >= (3 * portable_square((4.0 * a[(57 + kind)])))):
            fine = True
    if (fine or (not same)):
        source_health_judge_repetition(memory, state.source_stamps + (params.imu_source) * SOURCE_STAMPS_SIZE, same, t_ns)
    if (memory[20] > 0):
        odds = 0.0
        for i in range(6):
            _t1 = state.auxiliary[(61 + i)]
            odds = (_t1 if _t1 > odds else odds)
        source_health_blame_frozen(memory, (odds / (1 + odds)))

cdef bint inertial_sample_judge_axes(State* state, double* values, Parameters* params) noexcept nogil:
    cdef double* a
    cdef double* turn
    cdef double* memory
    cdef bint same
    cdef double worst
    cdef double place
    cdef double moved[3]
    cdef int64_t kind
    cdef int64_t first
    cdef int64_t i
    cdef double sensed
    cdef int64_t j
    cdef double _t1
    cdef double _t2
    cdef double least
    cdef int64_t lively
    cdef int64_t k
    cdef bint changed
    cdef double _t3
    cdef double _t4
    cdef double odds
    cdef double _t5
    cdef double _t6
    cdef double _t7
    cdef double _t8
    cdef double chance
    cdef double _t9
    cdef bint saturated
    a = state.auxiliary
    turn = params.model_parameters + (params.imu_source) * PARAMETERS
    memory = state.memory + (params.imu_source) * MEMORY_SIZE
    same, worst, place = True, 1.0, 0.0
    for kind in range(2):
        first = (3 * kind)
        for i in range(3):
            sensed = 0.0
            for j in range(3):
                sensed += (turn[((0 + (3 * j)) + i)] * values[(first + j)])
            moved[i] = fabs((sensed - a[((51 + first) + i)]))
            a[((51 + first) + i)] = sensed
            _t1 = a[(59 + kind)]
            _t2 = fabs(sensed)
            a[(59 + kind)] = (_t2 if _t2 > _t1 else _t1)
            if (moved[i] > 1e-09):
                same = False
                if ((a[(57 + kind)] == 0) or (moved[i] < a[(57 + kind)])):
                    a[(57 + kind)] = moved[i]
        least, lively = (4.0 * a[(57 + kind)]), 0
        for i in range(3):
            lively += (1 if (moved[i] > least) else 0)
        for i in range(3):
            k = (first + i)
            changed = (moved[i] > 1e-09)
            _t3 = a[(61 + k)]
            _t4 = 1e-06
            odds = (_t4 if _t4 > _t3 else _t3)
            if changed:
                _t5 = (odds * 0.001)
                _t6 = 1e-06
                odds = (_t6 if _t6 > _t5 else _t5)
            if ((lively - (1 if (moved[i] > least) else 0)) == 2):
                if (not changed):
                    _t7 = (1 - a[(67 + k)])
                    _t8 = (0.3333333333333333 if 0.3333333333333333 > _t7 else _t7)
                    chance = (0.95 if 0.95 < _t8 else _t8)
                    _t9 = (odds / chance)
                    odds = (1000.0 if 1000.0 < _t9 else _t9)
                a[(67 + k)] += (0.01 * ((1.0 if changed else 0.0) - a[(67 + k)]))
            a[(61 + k)] = odds
            if (odds > worst):
                worst = odds
                saturated = (fabs(a[(51 + k)]) >= a[(59 + kind)])
                place = ((1.0 + k) + (6 if saturated else 0))
    memory[20] = place
    return same

# ---------------- fusiond.filter.initial_alignment

cdef void initial_alignment_gather_motion(State* state, Row* row, Parameters* params) noexcept nogil:
    cdef int64_t* stamps
    cdef double* a
    cdef double* values
    cdef int64_t t_ns
    cdef int64_t source
    cdef bint believed
    cdef int64_t i
    cdef double _t1
    cdef double _t2
    cdef bint still
    cdef int _i
    stamps = state.stamps
    a = state.auxiliary
    values = row.values
    t_ns, source = (<int64_t>row.t_ns), (<int64_t>row.source)
    stamps[0] = t_ns
    if (params.models[source] == 2):
        state.memory[(source) * MEMORY_SIZE + 0] = values[0]
    if (params.models[source] != -1):
        return
    believed = inertial_sample_judge(state, row, params)
    source_health_arrive(state.memory + (source) * MEMORY_SIZE, state.source_stamps + (source) * SOURCE_STAMPS_SIZE, values, t_ns)
    if (not believed):
        row.outcome = 1
        return
    if (stamps[1] != (<int64_t>-4611686018427387904)):
        motion_constraints_watch(state, values, values + 3, ((t_ns - stamps[1]) * 1e-09), params)
    stamps[1] = t_ns
    for i in range(3):
        _t1 = values[i]
        a[(0 + i)] = _t1
        a[(6 + i)] = _t1
        _t2 = values[(3 + i)]
        a[(3 + i)] = _t2
        a[(9 + i)] = _t2
    still = ((stamps[3] != (<int64_t>-4611686018427387904)) and ((t_ns - stamps[3]) >= params.still_after_ns))
    if (still and (not (initial_alignment__gnss_speed(state) >= params.course_speed))):
        for _i in range(3):
            (a + 21)[_i] = (a + 15)[_i]
        stamps[8] = t_ns

cdef bint initial_alignment_tells_course(double* velocity_n, double variance, Parameters* params) noexcept nogil:
    cdef double north
    cdef double east
    north, east = velocity_n[0], velocity_n[1]
    return (variance <= (((north * north) + (east * east)) * (params.heading_variance - (0.03490658503988659 * 0.03490658503988659))))

cdef double initial_alignment__gnss_speed(State* state) noexcept nogil:
    cdef int64_t first
    cdef double north
    cdef double east
    first = state.stamps[6]
    if ((first == (<int64_t>-4611686018427387904)) or ((state.stamps[0] - first) > (<int64_t>3000000000))):
        return NAN
    north, east = state.auxiliary[24], state.auxiliary[(24 + 1)]
    return sqrt((portable_square(north) + portable_square(east)))

# ---------------- fusiond.filter.measurement

cdef void measurement_share_noise(State* state, Observation* seen, double* parameter) noexcept nogil:
    cdef int64_t a
    for a in range(seen.m):
        seen.variance[a] *= parameter[10]
    model_with_rate_noise(state, seen)

cdef void measurement_remember(double* memory, int64_t model, double* values) noexcept nogil:
    if (model == 2):
        memory[0] = values[0]
    elif (model == 1):
        memory[1] = gnss_velocity_lowest_speed(values)

cdef double measurement_factor_of(int64_t* stamps, int64_t model, double* values, double* parameter, int64_t t_ns) noexcept nogil:
    if (stamps[1] == (<int64_t>-4611686018427387904)):
        return 1.0
    return measurement_update_correlation_factor(((t_ns - stamps[1]) * 1e-09), measurement_correlation_of(model, values, parameter))

cdef double measurement_correlation_of(int64_t model, double* values, double* parameter) noexcept nogil:
    return (values[2] if (model == 2) else parameter[3])

cdef void measurement__carry_error(State* state, int64_t source, double* values, Parameters* params) noexcept nogil:
    cdef int64_t slot
    cdef State rival
    gnss_error_carry(state, source, values, params)
    if (state.stamps[22] > 0):
        for slot in range(4):
            if (state.bank[(slot) * BLOCK + 0] > 0):
                rival = hypothesis_of(state, slot)
                gnss_error_carry(&rival, source, values, params)
    gnss_error_note(state, source, values, params)

cdef bint measurement_fuse_measurement(State* state, Row* row, Parameters* params) noexcept nogil:
    cdef int64_t source
    cdef int64_t t_ns
    cdef int64_t model
    cdef double* values
    cdef double* parameter
    cdef double* memory
    cdef int64_t* stamps
    cdef double elapsed
    cdef bint same
    cdef Observation seen
    cdef int64_t m
    cdef double across[3 * n]
    cdef double spread[3 * 3]
    cdef double given[3]
    cdef double learnt[3]
    cdef double factor
    cdef int64_t a
    cdef int64_t _t1
    cdef double weight
    cdef bint by_rivals
    cdef bint doubtful
    cdef double before
    cdef double whitened[3]
    cdef double lasting
    cdef double judged[3]
    cdef int _i
    cdef double wider[3 * 3]
    cdef int64_t b
    cdef bint trusted
    cdef double noisy
    cdef bint heard
    cdef double fits
    cdef double gate
    cdef double clutter
    cdef bint scaled
    cdef (double, bint) _t2
    cdef double ratio
    cdef bint fused
    cdef double _t3
    cdef double gained
    cdef double unread
    cdef double main
    cdef int64_t suspected
    cdef int64_t slot
    cdef State rival
    source, t_ns = (<int64_t>row.source), (<int64_t>row.t_ns)
    model = params.models[source]
    values = row.values
    parameter = params.model_parameters + (source) * PARAMETERS
    memory = state.memory + (source) * MEMORY_SIZE
    stamps = state.source_stamps + (source) * SOURCE_STAMPS_SIZE
    elapsed = source_health_since_last(stamps, t_ns)
    same = source_health_arrive(memory, stamps, values, t_ns)
    measurement_remember(memory, model, values)
    if (model == 0):
        measurement__carry_error(state, source, values, params)
    if (not observations_observe(state, model, values, parameter, &seen)):
        return False
    m = seen.m
    measurement_update_project(state, &seen, across, spread)
    measurement_share_noise(state, &seen, parameter)
    factor = source_health_noise_factor(memory, parameter[8], parameter[9])
    for a in range(m):
        given[a] = seen.variance[a]
        learnt[a] = (given[a] * factor)
        row.innovation[a] = seen.innovation[a]
        row.variance[a] = (spread[(a) * 3 + a] + learnt[a])
    if (model == 0):
        _t1 = 2
        m = _t1
        seen.m = _t1
    elif ((state.nominal[38] > 0.05) and source_health_is_used(memory, True)):
        for a in range(m):
            seen.variance[a] = learnt[a]
        rivals_fit_lie(state, &seen, across, spread)
    weight = measurement_factor_of(stamps, model, values, parameter, t_ns)
    if ((stamps[0] == (<int64_t>-4611686018427387904)) or ((t_ns - stamps[0]) > (<int64_t>10000000000))):
        stamps[1] = (<int64_t>-4611686018427387904)
        source_health_begin(memory)
    by_rivals = (model == 0 or model == 1)
    doubtful = motion_constraints_disputed(state, (source if (model == 1) else (<int64_t>(parameter[11]))), params)
    before = source_health_odds_of_bias(memory)
    if (not doubtful):
        lasting = measurement_correlation_of(model, values, parameter)
        for _i in range(3):
            judged[_i] = seen.innovation[_i]
        for a in range(m):
            for b in range(m):
                wider[(a) * 3 + b] = spread[(a) * 3 + b]
        if (model == 0):
            lasting = parameter[5]
            gnss_error_with_whole_error(state, source, values, params, judged, wider)
        if measurement_update_whiten(wider, judged, learnt, m, whitened):
            measurement__judge(state, source, whitened, m, same, t_ns, lasting, params)
            if (model == 0):
                rivals_weigh_consistency(state, source, whitened, wider, learnt)
        if (model == 1):
            rivals_lead_off(state, source, seen.innovation, elapsed, params)
        source_health_learn(memory, seen.innovation, given, spread, m, elapsed)
    trusted = source_health_is_used(memory, by_rivals)
    if ((model == 2) and trusted):
        trusted = (not motion_constraints_carried(state, memory[0], params))
    noisy = source_health_noisy_factor(memory)
    for a in range(m):
        seen.variance[a] = (learnt[a] * noisy)
    heard = ((not source_health_is_stuck(memory)) and (trusted or by_rivals))
    fits = (rivals_likelihood(seen.innovation, seen.variance, weight, m, spread) if heard else 0.0)
    gate, clutter, scaled = params.gates[m], parameter[12], (model == 2)
    _t2 = measurement_update_update_projected(state, &seen, gate, weight, trusted, clutter, across, spread, scaled)
    ratio = _t2[0]
    fused = _t2[1]
    _t3 = ratio
    row.ratio = _t3
    memory[2] = _t3
    gained = ((source_health_odds_of_bias(memory) / before) if (before > 0) else 1.0)
    if ((state.stamps[22] > 0) and heard):
        unread = rivals_unread(seen.variance, weight, m, spread)
        main = (fits if trusted else unread)
        measurement__weigh_rivals(state, source, values, (factor * noisy), weight, main, unread, gained, (ratio <= 1), params)
    if (by_rivals and (not doubtful)):
        measurement__suspect_receiver(state, source, values, params)
        if ((model == 0) and (not fused)):
            measurement__suspect_state(state, source, values, &seen, params)
    if (trusted and heard and (not doubtful)):
        rivals_watch_inertial(state, &seen, weight, spread, fits)
    if (state.stamps[22] > 0):
        suspected = (<int64_t>(params.model_parameters[((<int64_t>(state.stamps[23]))) * PARAMETERS + 11]))
        rivals_decide(state, motion_constraints_disputed(state, suspected, params), params)
    if ((not fused) and ((<int64_t>(parameter[13])) == 29) and (memory[6] > 0.5)):
        measurement__reset_offset(state, &seen)
        source_health_begin(memory)
        fused = True
    if (model == 0):
        measurement__fuse_height(state, source, values, (factor * noisy), elapsed, (trusted or fused), params)
        for slot in range(4):
            if ((state.bank[(slot) * BLOCK + 0] > 0) and rivals_uses(state, slot, source, params)):
                rival = hypothesis_of(state, slot)
                measurement__fuse_height(&rival, source, values, (factor * noisy), elapsed, True, params)
    if fused:
        stamps[2] = (<int64_t>-4611686018427387904)
        stamps[1] = t_ns
        if (model == 0):
            state.stamps[4] = t_ns
            state.auxiliary[47] = 0.0
    elif (stamps[2] == (<int64_t>-4611686018427387904)):
        stamps[2] = t_ns
    if ((model == 2) and (not fused)):
        source_health_note_rejected(memory, values[0], seen.innovation[0])
    return fused

cdef void measurement__judge(State* state, int64_t source, double* whitened, int64_t m, bint same, int64_t t_ns, double correlation, Parameters* params) noexcept nogil:
    cdef double* memory
    cdef int64_t* stamps
    cdef int64_t model
    cdef bint gnss
    cdef bint wheel
    memory = state.memory + (source) * MEMORY_SIZE
    stamps = state.source_stamps + (source) * SOURCE_STAMPS_SIZE
    model = params.models[source]
    gnss = (model == 0 or model == 1)
    if (memory[18] != 0):
        if (model == 1):
            if source_health_is_due(stamps, t_ns, correlation):
                source_health_judge(memory, stamps, whitened, m, same, t_ns)
        elif rivals_fits_again(state, source, whitened, m, params):
            source_health_begin(memory)
        if (source_health_odds_of_bias(memory) < 0.01):
            memory[18] = 0.0
        return
    if ((not gnss) and (state.stamps[22] > 0)):
        return
    if (same and (not source_health_is_trusted(memory))):
        source_health_judge_repeated(memory, whitened, m)
        return
    wheel = ((model == 2) and source_health_is_trusted(memory))
    if (wheel and (not motion_constraints_carried(state, memory[0], params)) and rivals_wheels_contradict(state, params)):
        rivals_suspect_motion(state, 0.01)
        return
    if source_health_is_due(stamps, t_ns, correlation):
        source_health_judge(memory, stamps, whitened, m, same, t_ns)
    elif gnss:
        source_health_look(memory, whitened, m, same)

cdef void measurement__weigh_rivals(State* state, int64_t source, double* values, double factor, double weight, double main, double unread, double gained, bint agrees, Parameters* params) noexcept nogil:
    cdef double lie
    cdef double shared
    cdef (double, double) _t1
    cdef double best
    cdef double returned
    cdef double chance
    cdef double _t2
    lie = (gained if (params.models[source] == 0 or params.models[source] == 1) else 0.1)
    shared = (0.0 if agrees else gained)
    _t1 = measurement__fuse_rivals(state, source, values, factor, weight, main, shared, params)
    best = _t1[0]
    returned = _t1[1]
    lie = (returned if returned > lie else lie)
    if (not agrees):
        chance = (((0.1 * unread) / main) if (main > 0) else 1.0)
        _t2 = (best if best > chance else chance)
        lie = (_t2 if _t2 > lie else lie)
    rivals_weigh_liar(state, source, lie, params)

cdef (double, double) measurement__fuse_rivals(State* state, int64_t source, double* values, double factor, double weight, double main, double gained, Parameters* params) noexcept nogil:
    cdef double _t1
    cdef double best
    cdef double returned
    cdef int64_t model
    cdef double* parameter
    cdef Observation seen
    cdef double across[3 * n]
    cdef double spread[3 * 3]
    cdef int64_t slot
    cdef State rival
    cdef int64_t a
    cdef double prior
    cdef double own
    cdef (double, bint) _t2
    cdef double ratio
    cdef bint _fused
    cdef double _t3
    cdef double _t4
    _t1 = 0.0
    best = _t1
    returned = _t1
    model = params.models[source]
    parameter = params.model_parameters + (source) * PARAMETERS
    for slot in range(4):
        if (state.bank[(slot) * BLOCK + 0] > 0):
            rival = hypothesis_of(state, slot)
            if ((not rivals_uses(state, slot, source, params)) or (not observations_observe(&rival, model, values, parameter, &seen))):
                continue
            measurement_update_project(&rival, &seen, across, spread)
            measurement_share_noise(&rival, &seen, parameter)
            if (model == 0):
                seen.m = 2
            for a in range(seen.m):
                seen.variance[a] *= factor
            prior = (rivals_fit_lie(&rival, &seen, across, spread) if (slot == 0) else 1.0)
            own = (prior * rivals_likelihood(seen.innovation, seen.variance, weight, seen.m, spread))
            _t2 = measurement_update_update_projected(&rival, &seen, params.gates[seen.m], weight, True, parameter[12], across, spread, (model == 2))
            ratio = _t2[0]
            _fused = _t2[1]
            if ((slot == 0) and (model == 1) and (ratio <= 1)):
                _t3 = (gained * main)
                own = (_t3 if _t3 > own else own)
            if (main > 0):
                _t4 = (own / main)
                best = (_t4 if _t4 > best else best)
                if ((slot == 2) and (state.memory[(source) * MEMORY_SIZE + 18] == 0)):
                    returned = (own / main)
            rivals_weigh(state, slot, own, main)
    return (best, returned)

cdef void measurement__fuse_height(State* state, int64_t source, double* values, double stretch, double elapsed, bint trusted, Parameters* params) noexcept nogil:
    cdef double* parameter
    cdef Observation seen
    cdef int _i
    cdef double across[3 * n]
    cdef double spread[3 * 3]
    cdef (double, bint) _t1
    cdef double ratio
    cdef bint fused
    cdef double _t2
    cdef double grown
    cdef double* down
    cdef int64_t i
    cdef int64_t j
    parameter = params.model_parameters + (source) * PARAMETERS
    if (not observations_observe(state, 0, values, parameter, &seen)):
        return
    measurement_share_noise(state, &seen, parameter)
    seen.m = 1
    for _i in range(n):
        (seen.jacobian + (0) * n)[_i] = (seen.jacobian + (2) * n)[_i]
    seen.innovation[0], seen.common[0] = seen.innovation[2], seen.common[2]
    seen.variance[0] = (seen.variance[2] * stretch)
    measurement_update_project(state, &seen, across, spread)
    _t1 = measurement_update_update_projected(state, &seen, params.gates[1], 1.0, trusted, parameter[12], across, spread, False)
    ratio = _t1[0]
    fused = _t1[1]
    if (fused or (not trusted) or (not (ratio < INFINITY))):
        return
    _t2 = (elapsed / 30.0)
    grown = (((seen.innovation[0] * seen.innovation[0]) / params.gates[1]) * (1.0 if 1.0 < _t2 else _t2))
    down = seen.jacobian + (0) * n
    for i in range(3):
        for j in range(3):
            state.covariance[((0 + i)) * n + (0 + j)] += (grown * (down[i] * down[j]))

cdef void measurement__suspect_receiver(State* state, int64_t source, double* values, Parameters* params) noexcept nogil:
    cdef State rival
    if (rivals_suspect_receiver(state, source, params) and (params.models[source] == 0)):
        rival = hypothesis_of(state, 1)
        gnss_error_forget_prior(&rival, source, values, params)

cdef void measurement__suspect_state(State* state, int64_t source, double* values, Observation* seen, Parameters* params) noexcept nogil:
    cdef double wrong
    cdef double odds
    cdef State rival
    if ((state.bank[(2) * BLOCK + 0] > 0) or (state.memory[(source) * MEMORY_SIZE + 18] != 0)):
        return
    if (state.bank[(1) * BLOCK + 0] > 0):
        if (state.stamps[23] != source):
            return
        wrong = rivals_wrong(state, motion_constraints_is_carried(state, params))
        odds = (state.bank[(1) * BLOCK + 0] * ((wrong / (1 - wrong)) / 0.001))
    elif rivals_may_lie(state, source, params):
        return
    else:
        odds = (source_health_odds_of_bias(state.memory + (source) * MEMORY_SIZE) / 10)
        state.stamps[23] = source
    if (odds < (0.01 * (1 + state.bank[(1) * BLOCK + 0]))):
        return
    rivals_open_slot(state, 2, odds)
    rival = hypothesis_of(state, 2)
    gnss_error_place(&rival, source, values, seen, params)

cdef void measurement__reset_offset(State* state, Observation* seen) noexcept nogil:
    cdef double* p
    cdef int64_t offset
    cdef int _i
    cdef double cross[n]
    cdef int64_t k
    cdef double variance
    p = state.covariance
    offset = 29
    state.nominal[30] += seen.innovation[0]
    for _i in range(n):
        (p + (offset) * n)[_i] = 0.0
    for _i in range(n):
        (p + offset)[_i * n] = 0.0
    memset(cross, 0, n * sizeof(double))
    for k in range(n):
        if (seen.jacobian[(0) * n + k] != 0.0):
            axpy(cross, (-seen.jacobian[(0) * n + k]), p + (k) * n)
    for _i in range(n):
        (p + (offset) * n)[_i] = cross[_i]
    for _i in range(n):
        (p + offset)[_i * n] = cross[_i]
    variance = seen.variance[0]
    for k in range(n):
        variance += (-(cross[k] * seen.jacobian[(0) * n + k]))
    p[(offset) * n + offset] = variance

# ---------------- fusiond.filter.measurement_update

cdef double measurement_update_correlation_factor(double interval, double correlation) noexcept nogil:
    cdef double _t1
    cdef double same
    if ((not (correlation > 0)) or (interval == INFINITY)):
        return 1.0
    _t1 = 1e-06
    same = portable_exp(((-(_t1 if _t1 > interval else interval)) / correlation))
    if (same < 1):
        return ((1 + same) / (1 - same))
    return INFINITY

cdef bint measurement_update_cholesky(double* spread, double* variance, double factor, int64_t m, double* lower) noexcept nogil:
    cdef int64_t i
    cdef int64_t j
    cdef double rest
    cdef int64_t k
    for i in range(m):
        for j in range((i + 1)):
            rest = spread[(i) * 3 + j]
            if (i == j):
                rest += (factor * variance[i])
            for k in range(j):
                rest -= (lower[(i) * 3 + k] * lower[(j) * 3 + k])
            if (i == j):
                if (not ((variance[i] >= 0) and (0 < rest < INFINITY))):
                    return False
                lower[(i) * 3 + i] = sqrt(rest)
            else:
                lower[(i) * 3 + j] = (rest / lower[(j) * 3 + j])
    return True

cdef void measurement_update_project(State* state, Observation* seen, double* across, double* spread) noexcept nogil:
    cdef int64_t a
    cdef int _i
    cdef int64_t k
    cdef int64_t i
    cdef double _t1
    for a in range(seen.m):
        for _i in range(n):
            (across + (a) * n)[_i] = 0.0
        for k in range(n):
            if (seen.jacobian[(a) * n + k] != 0.0):
                axpy(across + (a) * n, seen.jacobian[(a) * n + k], state.covariance + (k) * n)
    for a in range(seen.m):
        for i in range((a + 1)):
            _t1 = (linear_dot(seen.jacobian + (a) * n, across + (i) * n) + (seen.common[a] * seen.common[i]))
            spread[(a) * 3 + i] = _t1
            spread[(i) * 3 + a] = _t1

cdef bint measurement_update_whiten(double* spread, double* innovation, double* variance, int64_t m, double* whitened) noexcept nogil:
    cdef double lower[3 * 3]
    cdef int64_t i
    cdef double rest
    cdef int64_t k
    if (not measurement_update_cholesky(spread, variance, 1.0, m, lower)):
        return False
    for i in range(m):
        rest = innovation[i]
        for k in range(i):
            rest -= (lower[(i) * 3 + k] * whitened[k])
        whitened[i] = (rest / lower[(i) * 3 + i])
    return True

cdef (double, bint) measurement_update_update(State* state, Observation* seen, double gate, double factor, bint trusted, double clutter, bint given) noexcept nogil:
    cdef double across[3 * n]
    cdef double spread[3 * 3]
    measurement_update_project(state, seen, across, spread)
    return measurement_update_update_projected(state, seen, gate, factor, trusted, clutter, across, spread, given)

cdef (double, bint) measurement_update_update_projected(State* state, Observation* seen, double gate, double factor, bint trusted, double clutter, double* across, double* spread, bint given) noexcept nogil:
    cdef int64_t m
    cdef double* p
    cdef double whitened[3]
    cdef double distance
    cdef int64_t a
    cdef double ratio
    cdef double share
    cdef double gain[3 * n]
    cdef double before[n * n]
    cdef int64_t i
    cdef int _i
    cdef double error[n]
    cdef double mixed
    cdef double _t1
    cdef double _t2
    m = seen.m
    p = state.covariance
    if (not measurement_update_whiten(spread, seen.innovation, seen.variance, m, whitened)):
        return (INFINITY, False)
    distance = 0.0
    for a in range(m):
        distance += (whitened[a] * whitened[a])
    ratio = (distance / gate)
    if (not (ratio < INFINITY)):
        return (INFINITY, False)
    if ((not trusted) or ((clutter == 0) and (not (ratio <= 1)))):
        return (ratio, False)
    share = 1.0
    if (clutter != 0):
        share = measurement_update_detection(distance, m, clutter)
        if (share < 1e-06):
            return (ratio, False)
    if (not measurement_update_make_gain(p, seen, factor, given, across, spread, gain)):
        return (ratio, False)
    if (share < 1):
        for i in range(n):
            for _i in range(n):
                (before + (i) * n)[_i] = (p + (i) * n)[_i]
    measurement_update_joseph(p, seen, factor, across, gain)
    memset(error, 0, n * sizeof(double))
    for a in range(m):
        axpy(error, seen.innovation[a], gain + (a) * n)
    if (share < 1):
        mixed = (share * (1 - share))
        for i in range(n):
            _t1 = (1 - share)
            _t2 = error[i]
            for _i in range(n):
                (p + (i) * n)[_i] = (((share * (p + (i) * n)[_i]) + (_t1 * (before + (i) * n)[_i])) + (mixed * (_t2 * error[_i])))
        for _i in range(n):
            error[_i] *= share
    measurement_update_turn_along(p, error)
    measurement_update_inject(state, error)
    return (ratio, (share >= 0.5))

cdef bint measurement_update_make_gain(double* p, Observation* seen, double factor, bint given, double* across, double* spread, double* gain) noexcept nogil:
    cdef double weighed[3 * 3]
    cdef double lower[3 * 3]
    cdef int64_t a
    cdef int _i
    for a in range(seen.m):
        for _i in range(n):
            (gain + (a) * n)[_i] = (across + (a) * n)[_i]
        for _i in range(3):
            (weighed + (a) * 3)[_i] = (spread + (a) * 3)[_i]
    if given:
        measurement_update_give_scale(p, seen.m, gain, weighed)
    if (not measurement_update_cholesky(weighed, seen.variance, factor, seen.m, lower)):
        return False
    measurement_update__solve(lower, seen.m, gain)
    return True

cdef void measurement_update__solve(double* lower, int64_t m, double* gain) noexcept nogil:
    cdef int64_t i
    cdef int64_t k
    cdef int _i
    cdef double _t1
    cdef double _t2
    for i in range(m):
        for k in range(i):
            axpy(gain + (i) * n, (-lower[(i) * 3 + k]), gain + (k) * n)
        _t1 = lower[(i) * 3 + i]
        for _i in range(n):
            (gain + (i) * n)[_i] /= _t1
    for i in range((m - 1), (-1), (-1)):
        for k in range((i + 1), m):
            axpy(gain + (i) * n, (-lower[(k) * 3 + i]), gain + (k) * n)
        _t2 = lower[(i) * 3 + i]
        for _i in range(n):
            (gain + (i) * n)[_i] /= _t2

cdef void measurement_update_give_scale(double* p, int64_t m, double* across, double* spread) noexcept nogil:
    cdef double variance
    cdef double by[3]
    cdef int64_t a
    cdef int64_t i
    variance = p[(15) * n + 15]
    if (not (variance > 0)):
        return
    for a in range(m):
        by[a] = across[(a) * n + 15]
    for a in range(m):
        axpy(across + (a) * n, ((-by[a]) / variance), p + (15) * n)
        across[(a) * n + 15] = 0.0
        for i in range(m):
            spread[(a) * 3 + i] -= ((by[a] * by[i]) / variance)

cdef void measurement_update_joseph(double* p, Observation* seen, double factor, double* across, double* gain) noexcept nogil:
    cdef int64_t a
    cdef int _i
    cdef double kept[3 * n]
    cdef int64_t k
    cdef int64_t i
    for a in range(seen.m):
        for _i in range(n):
            axpy(p + _i * n, (-(across + (a) * n)[_i]), gain + (a) * n)
    memset(kept, 0, 3 * n * sizeof(double))
    for a in range(seen.m):
        for k in range(n):
            if (seen.jacobian[(a) * n + k] != 0.0):
                axpy(kept + (a) * n, (-seen.jacobian[(a) * n + k]), p + (k) * n)
    for a in range(seen.m):
        axpy(kept + (a) * n, (factor * seen.variance[a]), gain + (a) * n)
        for i in range((seen.m if (seen.common[a] != 0.0) else 0)):
            axpy(kept + (a) * n, (seen.common[a] * seen.common[i]), gain + (i) * n)
    for a in range(seen.m):
        for _i in range(n):
            axpy(p + _i * n, (gain + (a) * n)[_i], kept + (a) * n)
    linear_mirror(p)

cdef void measurement_update_turn_along(double* p, double* error) noexcept nogil:
    cdef int64_t phi
    cdef int64_t block
    cdef int64_t i
    cdef double x
    cdef double y
    cdef double z
    cdef int _i
    phi = 6
    measurement_update_turn_rows(p, error)
    for block in range(0, 6, 3):
        for i in range(6):
            x, y, z = p[(i) * n + phi], p[(i) * n + (phi + 1)], p[(i) * n + (phi + 2)]
            p[(i) * n + block] -= ((error[(block + 1)] * z) - (error[(block + 2)] * y))
            p[(i) * n + (block + 1)] -= ((error[(block + 2)] * x) - (error[block] * z))
            p[(i) * n + (block + 2)] -= ((error[block] * y) - (error[(block + 1)] * x))
    for i in range(6):
        for _i in range((n - i)):
            (p + i + (i) * n)[_i * n] = (p + (i) * n + i)[_i]

cdef void measurement_update_turn_rows(double* p, double* error) noexcept nogil:
    cdef double turned[6 * n]
    cdef int64_t phi
    cdef int64_t block
    cdef double _t1
    cdef double _t2
    cdef int _i
    cdef double _t3
    cdef double _t4
    cdef double _t5
    cdef double _t6
    cdef int64_t i
    phi = 6
    for block in range(0, 6, 3):
        _t1 = error[(block + 1)]
        _t2 = error[(block + 2)]
        for _i in range(n):
            (turned + (block) * n)[_i] = ((_t1 * (p + ((phi + 2)) * n)[_i]) - (_t2 * (p + ((phi + 1)) * n)[_i]))
        _t3 = error[(block + 2)]
        _t4 = error[block]
        for _i in range(n):
            (turned + ((block + 1)) * n)[_i] = ((_t3 * (p + (phi) * n)[_i]) - (_t4 * (p + ((phi + 2)) * n)[_i]))
        _t5 = error[block]
        _t6 = error[(block + 1)]
        for _i in range(n):
            (turned + ((block + 2)) * n)[_i] = ((_t5 * (p + ((phi + 1)) * n)[_i]) - (_t6 * (p + (phi) * n)[_i]))
    for i in range(6):
        axpy(p + (i) * n, (-1.0), turned + (i) * n)

cdef double measurement_update_detection(double distance, int64_t m, double clutter) noexcept nogil:
    cdef double density
    cdef double uniform
    cdef int64_t _a
    density, uniform = ((1 - clutter) * portable_exp(((-distance) / 2))), clutter
    for _a in range(m):
        uniform *= 0.025066282746310002
    return (density / (density + uniform))

cdef void measurement_update_inject(State* state, double* error) noexcept nogil:
    cdef double* x
    cdef int _i
    cdef int64_t i
    cdef double _t1[4]
    cdef double _t2[4]
    cdef double _t3[4]
    x = state.nominal
    for _i in range(3):
        x[_i] += error[_i]
    for _i in range(3):
        (x + 3)[_i] += (error + 3)[_i]
    for _i in range(3):
        (x + 10)[_i] += (error + 9)[_i]
    for _i in range(3):
        (x + 13)[_i] += (error + 12)[_i]
    for i in range(15, n):
        x[(i + 1)] += error[i]
    rotation_quaternion_exp(error + 6, _t3)
    rotation_quaternion_multiply(_t3, x + 6, _t2)
    rotation_normalised(_t2, _t1)
    for _i in range(4):
        (x + 6)[_i] = _t1[_i]

cdef void measurement_update_difference(State* one, State* other, double* out) noexcept nogil:
    cdef double* a
    cdef double* b
    cdef double error[n]
    cdef int _i
    cdef int64_t i
    cdef int64_t q
    cdef double back[4]
    cdef double turn[4]
    cdef double twice
    a = one.nominal
    b = other.nominal
    for _i in range(3):
        error[_i] = (a[_i] - b[_i])
    for _i in range(3):
        (error + 3)[_i] = ((a + 3)[_i] - (b + 3)[_i])
    for _i in range(3):
        (error + 9)[_i] = ((a + 10)[_i] - (b + 10)[_i])
    for _i in range(3):
        (error + 12)[_i] = ((a + 13)[_i] - (b + 13)[_i])
    for i in range(15, n):
        error[i] = (a[(i + 1)] - b[(i + 1)])
    q = 6
    back[0] = b[q]
    back[1] = (-b[(q + 1)])
    back[2] = (-b[(q + 2)])
    back[3] = (-b[(q + 3)])
    rotation_quaternion_multiply(a + 6, back, turn)
    twice = (2.0 if (turn[0] >= 0) else (-2.0))
    for i in range(3):
        error[(6 + i)] = (turn[(1 + i)] * twice)
    for _i in range(n):
        out[_i] = error[_i]
    return

# ---------------- fusiond.filter.motion_constraints

cdef void motion_constraints_watch(State* state, double* force_b, double* rate_b, double dt, Parameters* params) noexcept nogil:
    cdef double* auxiliary
    cdef double smooth
    cdef int _i
    cdef double share
    cdef double weight
    cdef double step
    cdef double off[3]
    auxiliary = state.auxiliary
    smooth = ((1 - portable_exp(((-dt) / 0.08))) if (auxiliary[20] > 0) else 1.0)
    for _i in range(3):
        (auxiliary + 37)[_i] += (smooth * (force_b[_i] - (auxiliary + 37)[_i]))
    share = (1 - portable_exp(((-dt) / 0.5)))
    weight = (auxiliary[20] + (share * (1 - auxiliary[20])))
    auxiliary[20] = weight
    step = ((share / weight) if (weight > 0) else 1.0)
    for _i in range(3):
        off[_i] = (force_b[_i] - (auxiliary + 12)[_i])
    for _i in range(3):
        (auxiliary + 12)[_i] += (step * off[_i])
    auxiliary[18] = motion_constraints__scatter(auxiliary[18], off, step)
    for _i in range(3):
        off[_i] = (rate_b[_i] - (auxiliary + 15)[_i])
    for _i in range(3):
        (auxiliary + 15)[_i] += (step * off[_i])
    auxiliary[19] = motion_constraints__scatter(auxiliary[19], off, step)
    if (not motion_constraints_stands(state, params)):
        state.stamps[3] = (<int64_t>-4611686018427387904)
    elif (state.stamps[3] == (<int64_t>-4611686018427387904)):
        state.stamps[3] = state.stamps[0]

cdef double motion_constraints__scatter(double before, double* off, double step) noexcept nogil:
    return ((1 - step) * (before + (step * (((off[0] * off[0]) + (off[1] * off[1])) + (off[2] * off[2])))))

cdef bint motion_constraints_carried(State* state, double wheel_speed, Parameters* params) noexcept nogil:
    cdef int64_t i
    cdef int64_t _k1
    cdef bint fresh
    if (not (fabs(wheel_speed) <= params.still_wheel)):
        return False
    for _k1 in range(params.velocities_count):
        i = params.velocities[_k1]
        fresh = ((state.stamps[0] - state.source_stamps[(i) * SOURCE_STAMPS_SIZE + 0]) <= 2000000000)
        if (fresh and (state.memory[(i) * MEMORY_SIZE + 1] > 1.0) and (not source_health_is_stuck(state.memory + (i) * MEMORY_SIZE))):
            return True
    return False

cdef bint motion_constraints_rests(State* state, Parameters* params) noexcept nogil:
    cdef bint heard
    cdef int64_t i
    cdef int64_t _k1
    heard = False
    for _k1 in range(params.wheels_count):
        i = params.wheels[_k1]
        if rivals_speaks(state, i):
            heard = True
            if (not (fabs(state.memory[(i) * MEMORY_SIZE + 0]) <= params.still_wheel)):
                return False
    return heard

cdef double motion_constraints_turn_shown(State* state, Parameters* params) noexcept nogil:
    cdef double fastest
    cdef double left
    cdef double right
    cdef int64_t i
    cdef int64_t _k1
    cdef double side
    cdef double _t2
    fastest, left, right = 0.0, INFINITY, (-INFINITY)
    for _k1 in range(params.wheels_count):
        i = params.wheels[_k1]
        if rivals_speaks(state, i):
            side = params.model_parameters[(i) * PARAMETERS + (0 + 1)]
            _t2 = fabs(state.memory[(i) * MEMORY_SIZE + 0])
            fastest, left, right = (_t2 if _t2 > fastest else fastest), (side if side < left else left), (side if side > right else right)
    return (((2 * fastest) / (right - left)) if (right > left) else 0.0)

cdef void motion_constraints_doubt_turn(State* state, double* rate_b, double dt, Parameters* params) noexcept nogil:
    cdef double _t1
    cdef double _t2[3 * 3]
    cdef double* down_e
    cdef double rate_e[3]
    cdef double _t3[3 * 3]
    cdef double _t4[3]
    cdef int _i
    cdef double turning
    cdef int64_t i
    cdef double _t5
    cdef double unseen
    cdef double turned
    cdef double doubted
    cdef double variance
    cdef double _t6
    cdef double _t7
    cdef double missing
    cdef int64_t j
    if ((state.stamps[10] != 2) or (not motion_constraints_rests(state, params)) or motion_constraints_carried(state, 0.0, params)):
        _t1 = 0.0
        state.auxiliary[45] = _t1
        state.auxiliary[46] = _t1
        return
    wgs84_mat_ne(state.nominal, _t2)
    down_e = _t2 + (2) * 3
    model_mat_eb(state, _t3)
    for _i in range(3):
        _t4[_i] = (rate_b[_i] - (state.nominal + 10)[_i])
    rotation_times(_t3, _t4, rate_e)
    rate_e[2] -= 7.292115e-05
    turning = 0.0
    for i in range(3):
        turning += (down_e[i] * rate_e[i])
    _t5 = (fabs(turning) - motion_constraints_turn_shown(state, params))
    unseen = (0.0 if 0.0 > _t5 else _t5)
    state.auxiliary[45] += ((unseen * dt) if (turning > 0) else ((-unseen) * dt))
    turned, doubted = fabs(state.auxiliary[45]), state.auxiliary[46]
    if (turned <= doubted):
        return
    state.auxiliary[46] = turned
    variance = state_variance_about(state, down_e[0], down_e[1], down_e[2])
    _t6 = (portable_square(turned) - variance)
    _t7 = (portable_square(turned) - portable_square(doubted))
    missing = (_t7 if _t7 < _t6 else _t6)
    if (missing > 0):
        for i in range(3):
            for j in range(3):
                state.covariance[((6 + i)) * n + (6 + j)] += (missing * (down_e[i] * down_e[j]))

cdef bint motion_constraints_is_carried(State* state, Parameters* params) noexcept nogil:
    return (motion_constraints_rests(state, params) and motion_constraints_carried(state, 0.0, params))

cdef bint motion_constraints_disputed(State* state, int64_t velocity, Parameters* params) noexcept nogil:
    return ((velocity >= 0) and (state.memory[(velocity) * MEMORY_SIZE + 1] > 0.0) and motion_constraints_rests(state, params))

cdef bint motion_constraints_stands(State* state, Parameters* params) noexcept nogil:
    cdef double* auxiliary
    cdef bint wheeled
    cdef double interval
    cdef double own
    cdef double _t1
    cdef double _t2
    cdef double _t3
    cdef double _t4
    auxiliary = state.auxiliary
    if ((not params.standstill) or (auxiliary[20] < 0.8)):
        return False
    wheeled = (params.wheels_count > 0)
    interval = (state.memory[(params.imu_source) * MEMORY_SIZE + 13] if wheeled else 0.0)
    own = ((6.75 / interval) if (interval > 0) else 0.0)
    _t1 = portable_square(params.still_accel)
    _t2 = (own * params.noise.accel)
    if (auxiliary[18] > (_t2 if _t2 > _t1 else _t1)):
        return False
    _t3 = portable_square(params.still_gyro)
    _t4 = (own * params.noise.gyro)
    if (auxiliary[19] > (_t4 if _t4 > _t3 else _t3)):
        return False
    return (((not wheeled) or motion_constraints_rests(state, params)) and (not motion_constraints_carried(state, 0.0, params)))

cdef void motion_constraints_constrain(State* state, Parameters* params) noexcept nogil:
    cdef (bint, bint) _t1
    cdef bint still
    cdef bint rolling
    _t1 = motion_constraints_constraints_due(state, params)
    still = _t1[0]
    rolling = _t1[1]
    if (still and motion_constraints__apply(state, 1, params, params.zero_velocity_factor)):
        motion_constraints__apply(state, 2, params, 1.0)
    elif rolling:
        motion_constraints__apply(state, 0, params, 1.0)

cdef void motion_constraints_roll(State* state, Parameters* params) noexcept nogil:
    cdef (bint, bint) _t1
    cdef bint _still
    cdef bint rolling
    _t1 = motion_constraints_constraints_due(state, params)
    _still = _t1[0]
    rolling = _t1[1]
    if (rolling and (not motion_constraints_rests(state, params))):
        motion_constraints__apply(state, 0, params, 1.0)

cdef (bint, bint) motion_constraints_constraints_due(State* state, Parameters* params) noexcept nogil:
    cdef int64_t now
    cdef bint still
    now = state.stamps[0]
    if ((now - state.stamps[2]) < params.constraint_interval_ns):
        return (False, False)
    state.stamps[2] = now
    still = ((state.stamps[3] != (<int64_t>-4611686018427387904)) and ((now - state.stamps[3]) >= params.still_after_ns))
    return (still, (params.non_holonomic and (not motion_constraints_is_carried(state, params))))

cdef bint motion_constraints_observe_constraint(State* state, int64_t which, Parameters* params, Observation* seen) noexcept nogil:
    if (which == 1):
        return zero_velocity_observe(state, params.constraints + (which) * PARAMETERS, params.constraints + (which) * PARAMETERS, seen)
    if (which == 2):
        return zero_rotation_observe(state, params.constraints + (which) * PARAMETERS, params.constraints + (which) * PARAMETERS, seen)
    return non_holonomic_observe(state, params.constraints + (which) * PARAMETERS, params.constraints + (which) * PARAMETERS, seen)

cdef bint motion_constraints__apply(State* state, int64_t which, Parameters* params, double factor) noexcept nogil:
    cdef Observation seen
    cdef double across[3 * n]
    cdef double spread[3 * 3]
    cdef double fits
    cdef (double, bint) _t1
    cdef double ratio
    cdef bint fused
    if (not motion_constraints_observe_constraint(state, which, params, &seen)):
        return False
    model_with_rate_noise(state, &seen)
    measurement_update_project(state, &seen, across, spread)
    fits = rivals_likelihood(seen.innovation, seen.variance, factor, seen.m, spread)
    _t1 = measurement_update_update_projected(state, &seen, params.gates[seen.m], factor, True, 0.0, across, spread, True)
    ratio = _t1[0]
    fused = _t1[1]
    if (state.stamps[22] > 0):
        motion_constraints__apply_to_rivals(state, which, params, factor, fits)
    if (which == 0):
        rivals_watch_inertial(state, &seen, factor, spread, fits)
    state.auxiliary[(33 + which)] = ratio
    if fused:
        state.stamps[(12 + which)] += 1
    else:
        state.stamps[(15 + which)] += 1
    return fused

cdef void motion_constraints__apply_to_rivals(State* state, int64_t which, Parameters* params, double factor, double fits) noexcept nogil:
    cdef Observation seen
    cdef double across[3 * n]
    cdef double spread[3 * 3]
    cdef int64_t slot
    cdef State rival
    cdef double own
    for slot in range(4):
        if (state.bank[(slot) * BLOCK + 0] > 0):
            rival = hypothesis_of(state, slot)
            if motion_constraints_observe_constraint(&rival, which, params, &seen):
                model_with_rate_noise(&rival, &seen)
                measurement_update_project(&rival, &seen, across, spread)
                own = rivals_likelihood(seen.innovation, seen.variance, factor, seen.m, spread)
                rivals_weigh(state, slot, own, fits)
                measurement_update_update_projected(&rival, &seen, params.gates[seen.m], factor, True, 0.0, across, spread, True)
    rivals_decide(state, motion_constraints_rests(state, params), params)

# ---------------- fusiond.filter.north_east_down

cdef void north_east_down_to_north_east_down(double* nominal, double* covariance, double* out) noexcept nogil:
    cdef double found[91]
    cdef double to_n[3 * 3]
    cdef (double, double, double) _t1
    cdef double _t2[3]
    cdef int _i
    cdef double _t3[4]
    cdef double _t4[3 * 3]
    cdef double _t5[3 * 3]
    cdef double turned[3 * 3]
    cdef int64_t a
    cdef int64_t b
    cdef int64_t i
    cdef int64_t j
    wgs84_mat_ne(nominal, to_n)
    _t1 = wgs84_geodetic(nominal)
    found[0] = _t1[0]
    found[1] = _t1[1]
    found[2] = _t1[2]
    rotation_times(to_n, nominal + 3, _t2)
    for _i in range(3):
        (found + 3)[_i] = _t2[_i]
    rotation_matrix(nominal + 6, _t5)
    rotation_matrix_product(to_n, _t5, _t4)
    rotation_quaternion(_t4, _t3)
    for _i in range(4):
        (found + 6)[_i] = _t3[_i]
    for a in range(0, 9, 3):
        for b in range(0, 9, 3):
            for i in range(3):
                for j in range(3):
                    turned[(i) * 3 + j] = (((to_n[(i) * 3 + 0] * covariance[(a) * n + (b + j)]) + (to_n[(i) * 3 + 1] * covariance[((a + 1)) * n + (b + j)])) + (to_n[(i) * 3 + 2] * covariance[((a + 2)) * n + (b + j)]))
            for i in range(3):
                for j in range(3):
                    found[(((10 + (9 * (a + i))) + b) + j)] = (((turned[(i) * 3 + 0] * to_n[(j) * 3 + 0]) + (turned[(i) * 3 + 1] * to_n[(j) * 3 + 1])) + (turned[(i) * 3 + 2] * to_n[(j) * 3 + 2]))
    for _i in range(STATE_N_SIZE):
        out[_i] = found[_i]
    return

# ---------------- fusiond.filter.observations

cdef bint observations_observe(State* state, int64_t model, double* row, double* parameter, Observation* seen) noexcept nogil:
    if model == 0:
        return gnss_position_observe(state, row, parameter, seen)
    elif model == 1:
        return gnss_velocity_observe(state, row, parameter, seen)
    elif model == 2:
        return wheel_speed_observe(state, row, parameter, seen)
    elif model == 3:
        return barometric_height_observe(state, row, parameter, seen)
    elif model == 4:
        return gnss_yaw_observe(state, row, parameter, seen)
    elif model == 5:
        return yaw_rate_observe(state, row, parameter, seen)
    elif model == 6:
        return steering_observe(state, row, parameter, seen)
    elif model == 7:
        return lateral_observe(state, row, parameter, seen)
    elif model == 8:
        return parked_observe(state, row, parameter, seen)
    return False

# ---------------- fusiond.filter.observations.barometric_height

cdef bint barometric_height_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double* x
    cdef double to_n[3 * 3]
    cdef int _i
    cdef (double, double, double) _t1
    cdef double _
    cdef double height
    x = state.nominal
    wgs84_mat_ne(x, to_n)
    model_begin(seen, 1)
    for _i in range(3):
        (seen.jacobian + (0) * n)[_i] = (-(to_n + (2) * 3)[_i])
    seen.jacobian[(0) * n + 29] = 1.0
    _t1 = wgs84_geodetic(x)
    _ = _t1[0]
    _ = _t1[1]
    height = _t1[2]
    seen.innovation[0] = ((row[0] - height) - x[30])
    seen.variance[0] = row[1]
    return True

# ---------------- fusiond.filter.observations.gnss_position

cdef bint gnss_position_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double* x
    cdef double to_n[3 * 3]
    cdef double delay
    cdef double lever_e[3]
    cdef double _t1[3]
    cdef int _i
    cdef double _t2[3]
    cdef double _t3[3 * 3]
    cdef int64_t i
    cdef double off_e[3]
    cdef double slow
    cdef double _t4[3]
    cdef double stamp
    cdef double _t5[3]
    cdef double _t6
    x = state.nominal
    wgs84_mat_ne(x, to_n)
    model_begin(seen, 3)
    delay = 0.0
    if (parameter[4] != 0.0):
        delay = x[28]
        gnss_position__calibrated(state, parameter, to_n, seen, _t1)
        for _i in range(3):
            lever_e[_i] = _t1[_i]
    else:
        model_mat_eb(state, _t3)
        rotation_times(_t3, parameter, _t2)
        for _i in range(3):
            lever_e[_i] = _t2[_i]
    for i in range(3):
        for _i in range(3):
            (seen.jacobian + (i) * n)[_i] = (to_n + (i) * 3)[_i]
    model_skew_rows(to_n, lever_e, (-1.0), 3, seen.jacobian, 6)
    for _i in range(3):
        off_e[_i] = (((row[_i] - x[_i]) - lever_e[_i]) + ((x + 3)[_i] * delay))
    slow = parameter[7]
    if (slow > 0):
        for _i in range(3):
            off_e[_i] -= (x + 19)[_i]
        for i in range(3):
            for _i in range(3):
                (seen.jacobian + (i) * n + 18)[_i] = (to_n + (i) * 3)[_i]
    rotation_times(to_n, off_e, _t4)
    for _i in range(3):
        seen.innovation[_i] = _t4[_i]
    stamp = (parameter[6] * sqrt((1 - slow)))
    if (row[7] > 0):
        stamp = sqrt(((stamp * stamp) + (row[7] * row[7])))
    rotation_times(to_n, x + 3, _t5)
    for _i in range(3):
        seen.common[_i] = (_t5[_i] * stamp)
    _t6 = ((1 - slow) * row[3])
    seen.variance[0] = _t6
    seen.variance[1] = _t6
    seen.variance[2] = ((1 - slow) * row[4])
    return True

cdef void gnss_position__calibrated(State* state, double* lever_b, double* to_n, Observation* seen, double* out) noexcept nogil:
    cdef double* x
    cdef double rotation[3 * 3]
    cdef double delay
    cdef double arm_b[3]
    cdef int _i
    cdef double swing_b[3]
    cdef double _t1[3]
    cdef double turned[3 * 3]
    cdef double _t2[3]
    cdef int64_t i
    cdef double along
    cdef int64_t j
    cdef double _t3[3]
    x = state.nominal
    model_mat_eb(state, rotation)
    delay = x[28]
    for _i in range(3):
        arm_b[_i] = (lever_b[_i] + (x + 25)[_i])
    model_rate_b(state, _t1)
    rotation_cross(_t1, arm_b, swing_b)
    rotation_matrix_product(to_n, rotation, turned)
    model_skew_rows(turned, arm_b, (-delay), 3, seen.jacobian, 9)
    model_mean_rate_b(state, _t2)
    model_skew_rows(turned, _t2, (-delay), 3, seen.jacobian, 24)
    for i in range(3):
        along = 0.0
        for j in range(3):
            seen.jacobian[(i) * n + (3 + j)] = (to_n[(i) * 3 + j] * (-delay))
            seen.jacobian[(i) * n + (24 + j)] += turned[(i) * 3 + j]
            along += ((to_n[(i) * 3 + j] * x[(3 + j)]) + (turned[(i) * 3 + j] * swing_b[j]))
        seen.jacobian[(i) * n + 27] = (-along)
    for _i in range(3):
        _t3[_i] = (arm_b[_i] - (swing_b[_i] * delay))
    rotation_times(rotation, _t3, out)
    return

# ---------------- fusiond.filter.observations.gnss_velocity

cdef double gnss_velocity_lowest_speed(double* row) noexcept nogil:
    return (sqrt(((row[0] * row[0]) + (row[1] * row[1]))) - (3 * sqrt(row[3])))

cdef bint gnss_velocity_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double* x
    cdef int64_t axes
    cdef double to_n[3 * 3]
    cdef double rotation[3 * 3]
    cdef double arm_b[3]
    cdef int _i
    cdef double swing_e[3]
    cdef double _t1[3]
    cdef double _t2[3]
    cdef double turned[3 * 3]
    cdef int64_t i
    cdef double _t3[3]
    cdef double predicted_n[3]
    cdef double _t4[3]
    cdef double _t5[3]
    cdef double _t6[3]
    cdef double _t7
    x = state.nominal
    axes = (<int64_t>(row[4]))
    wgs84_mat_ne(x, to_n)
    model_mat_eb(state, rotation)
    for _i in range(3):
        arm_b[_i] = parameter[_i]
    if (parameter[4] != 0.0):
        for _i in range(3):
            arm_b[_i] += (x + 25)[_i]
    model_rate_b(state, _t2)
    rotation_cross(_t2, arm_b, _t1)
    rotation_times(rotation, _t1, swing_e)
    rotation_matrix_product(to_n, rotation, turned)
    model_begin(seen, axes)
    for i in range(axes):
        for _i in range(3):
            (seen.jacobian + (i) * n + 3)[_i] = (to_n + (i) * 3)[_i]
    if (parameter[4] != 0.0):
        gnss_velocity__gained(state, to_n, turned, seen, _t3)
        for _i in range(3):
            swing_e[_i] -= _t3[_i]
    for i in range(axes):
        seen.jacobian[(i) * n + 6] += ((-1.0) * ((to_n[(i) * 3 + 1] * swing_e[2]) - (to_n[(i) * 3 + 2] * swing_e[1])))
        seen.jacobian[(i) * n + (6 + 1)] += ((-1.0) * ((to_n[(i) * 3 + 2] * swing_e[0]) - (to_n[(i) * 3 + 0] * swing_e[2])))
        seen.jacobian[(i) * n + (6 + 2)] += ((-1.0) * ((to_n[(i) * 3 + 0] * swing_e[1]) - (to_n[(i) * 3 + 1] * swing_e[0])))
    model_skew_rows(turned, arm_b, 1.0, axes, seen.jacobian, 9)
    for _i in range(3):
        _t4[_i] = ((x + 3)[_i] + swing_e[_i])
    rotation_times(to_n, _t4, predicted_n)
    for i in range(axes):
        seen.innovation[i] = (row[i] - predicted_n[i])
        seen.variance[i] = row[3]
    if (row[7] > 0):
        model_acceleration_e(state, _t6)
        rotation_times(to_n, _t6, _t5)
        _t7 = row[7]
        for _i in range(3):
            seen.common[_i] = (_t5[_i] * _t7)
    return True

cdef void gnss_velocity__gained(State* state, double* to_n, double* turned, Observation* seen, double* out) noexcept nogil:
    cdef double* x
    cdef double delay
    cdef double force_e[3]
    cdef double _t1[3 * 3]
    cdef double _t2[3]
    cdef int _i
    cdef double rest_e[3]
    cdef double _t3[3]
    cdef int64_t i
    cdef double along
    cdef int64_t j
    x = state.nominal
    delay = (x[28] + x[(28 + 1)])
    model_mat_eb(state, _t1)
    for _i in range(3):
        _t2[_i] = ((state.auxiliary + 37)[_i] - (x + 13)[_i])
    rotation_times(_t1, _t2, force_e)
    wgs84_gravity_e(x, rest_e)
    rest_e[0] += ((2 * 7.292115e-05) * x[(3 + 1)])
    rest_e[1] -= ((2 * 7.292115e-05) * x[3])
    model_mean_rate_b(state, _t3)
    model_skew_rows(turned, _t3, 1.0, seen.m, seen.jacobian, 24)
    model_skew_rows(to_n, rest_e, (-delay), seen.m, seen.jacobian, 6)
    for i in range(seen.m):
        along = 0.0
        for j in range(3):
            along += (to_n[(i) * 3 + j] * (force_e[j] + rest_e[j]))
            seen.jacobian[(i) * n + (12 + j)] = (turned[(i) * 3 + j] * delay)
        seen.jacobian[(i) * n + 27] = (-along)
        seen.jacobian[(i) * n + (27 + 1)] = (-along)
        seen.jacobian[(i) * n + 3] += (to_n[(i) * 3 + 1] * ((2 * 7.292115e-05) * delay))
        seen.jacobian[(i) * n + (3 + 1)] -= (to_n[(i) * 3 + 0] * ((2 * 7.292115e-05) * delay))
    for _i in range(3):
        out[_i] = ((force_e[_i] + rest_e[_i]) * delay)
    return

# ---------------- fusiond.filter.observations.gnss_yaw

cdef bint gnss_yaw_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double to_n[3 * 3]
    cdef double baseline_e[3]
    cdef double _t1[3 * 3]
    cdef double baseline_n[3]
    cdef double north
    cdef double east
    cdef double level
    cdef double by_attitude[3 * n]
    cdef int64_t i
    cdef double sine
    cdef double cosine
    wgs84_mat_ne(state.nominal, to_n)
    model_mat_eb(state, _t1)
    rotation_times(_t1, parameter + 4, baseline_e)
    rotation_times(to_n, baseline_e, baseline_n)
    north, east = baseline_n[0], baseline_n[1]
    level = ((north * north) + (east * east))
    if (level < portable_square(0.2)):
        return False
    memset(by_attitude, 0, 3 * n * sizeof(double))
    model_skew_rows(to_n, baseline_e, (-1.0), 2, by_attitude, 6)
    model_begin(seen, 1)
    for i in range(6, 9):
        seen.jacobian[(0) * n + i] = (((north * by_attitude[(1) * n + i]) - (east * by_attitude[(0) * n + i])) / level)
    sine, cosine = row[0], row[1]
    seen.innovation[0] = portable_atan2(((north * sine) - (east * cosine)), ((north * cosine) + (east * sine)))
    seen.variance[0] = row[2]
    return True

# ---------------- fusiond.filter.observations.lateral

cdef bint lateral_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double by[3 * n]
    cdef double velocity_v[3]
    cdef double speed
    cdef double axis_b[3]
    cdef double across_b[3]
    cdef double _t1[3]
    cdef double _t2[3]
    cdef double turn
    cdef double mean
    cdef double down_e[3]
    cdef double down_b[3]
    cdef double _t3[3 * 3]
    cdef double across_e[3]
    cdef double _t4[3 * 3]
    cdef int64_t k
    cdef double leaning[3 * 3]
    cdef int _i
    cdef double tilted[3 * n]
    cdef int64_t i
    cdef (double, double) _t5
    cdef double sp
    cdef double cp
    cdef (double, double) _t6
    cdef double sy
    cdef double cy
    model_begin(seen, 1)
    model_point_velocity_v(state, parameter, 1, by, velocity_v)
    speed = velocity_v[0]
    if (fabs(speed) < parameter[5]):
        seen.innovation[0], seen.variance[0] = 0.0, 1000000000000.0
        return True
    model_vertical_b(state, axis_b)
    model_right_b(state, across_b)
    model_rate_b(state, _t1)
    model_mean_rate_b(state, _t2)
    turn, mean = rotation_inner(axis_b, _t1), rotation_inner(axis_b, _t2)
    wgs84_gravity_e(state.nominal, down_e)
    model_mat_eb(state, _t3)
    rotation_transposed_times(_t3, down_e, down_b)
    model_mat_eb(state, _t4)
    rotation_times(_t4, across_b, across_e)
    for k in range(n):
        seen.jacobian[(0) * n + k] = (mean * by[(0) * n + k])
    memset(leaning, 0, 3 * 3 * sizeof(double))
    for _i in range(3):
        (leaning + (0) * 3)[_i] = across_e[_i]
    memset(tilted, 0, 3 * n * sizeof(double))
    model_skew_rows(leaning, down_e, (-1.0), 1, tilted, 6)
    for i in range(3):
        seen.jacobian[(0) * n + (6 + i)] += tilted[(0) * n + (6 + i)]
        seen.jacobian[(0) * n + (9 + i)] -= (speed * axis_b[i])
    seen.jacobian[(0) * n + 16] += (speed * model_turn_by_mount(state))
    _t5 = portable_sin_cos(state.nominal[17])
    sp = _t5[0]
    cp = _t5[1]
    _t6 = portable_sin_cos(state.nominal[(17 + 1)])
    sy = _t6[0]
    cy = _t6[1]
    seen.jacobian[(0) * n + 16] -= (sy * ((cp * down_b[2]) - (sp * down_b[0])))
    seen.jacobian[(0) * n + (16 + 1)] -= ((cy * ((cp * down_b[0]) + (sp * down_b[2]))) - (sy * down_b[1]))
    seen.innovation[0] = ((row[0] - (speed * turn)) + rotation_inner(across_b, down_b))
    seen.variance[0] = row[1]
    model_with_rate_noise(state, seen)
    return True

# ---------------- fusiond.filter.observations.model

cdef void model_begin(Observation* seen, int64_t axes) noexcept nogil:
    cdef int _i
    cdef int64_t a
    seen.m = axes
    for _i in range(3):
        seen.common[_i] = 0.0
    for a in range(axes):
        for _i in range(n):
            (seen.jacobian + (a) * n)[_i] = 0.0

cdef void model_skew_rows(double* rows, double* v, double factor, int64_t axes, double* jacobian, int64_t column) noexcept nogil:
    cdef int64_t i
    for i in range(axes):
        jacobian[(i) * n + column] = (factor * ((rows[(i) * 3 + 1] * v[2]) - (rows[(i) * 3 + 2] * v[1])))
        jacobian[(i) * n + (column + 1)] = (factor * ((rows[(i) * 3 + 2] * v[0]) - (rows[(i) * 3 + 0] * v[2])))
        jacobian[(i) * n + (column + 2)] = (factor * ((rows[(i) * 3 + 0] * v[1]) - (rows[(i) * 3 + 1] * v[0])))

cdef void model_with_rate_noise(State* state, Observation* seen) noexcept nogil:
    cdef int64_t a
    cdef double* by
    for a in range(seen.m):
        by = seen.jacobian + (a) * n + 9
        seen.variance[a] += (state.auxiliary[36] * (((by[0] * by[0]) + (by[1] * by[1])) + (by[2] * by[2])))

cdef void model_acceleration_e(State* state, double* out) noexcept nogil:
    cdef double* x
    cdef double _t1[3]
    cdef double _t2[3 * 3]
    cdef double _t3[3]
    cdef int _i
    cdef double _t4[3]
    x = state.nominal
    model_mat_eb(state, _t2)
    for _i in range(3):
        _t3[_i] = ((state.auxiliary + 37)[_i] - (x + 13)[_i])
    rotation_times(_t2, _t3, _t1)
    wgs84_gravity_e(x, _t4)
    for _i in range(3):
        out[_i] = (_t1[_i] + _t4[_i])
    return

cdef void model_mean_rate_b(State* state, double* out) noexcept nogil:
    cdef int _i
    for _i in range(3):
        out[_i] = ((state.auxiliary + 15)[_i] - (state.nominal + 10)[_i])
    return

cdef void model_vertical_b(State* state, double* out) noexcept nogil:
    cdef (double, double) _t1
    cdef double sp
    cdef double cp
    _t1 = portable_sin_cos(state.nominal[17])
    sp = _t1[0]
    cp = _t1[1]
    out[0] = (-sp)
    out[1] = 0.0
    out[2] = cp
    return

cdef void model_right_b(State* state, double* out) noexcept nogil:
    cdef (double, double) _t1
    cdef double sp
    cdef double cp
    cdef (double, double) _t2
    cdef double sy
    cdef double cy
    _t1 = portable_sin_cos(state.nominal[17])
    sp = _t1[0]
    cp = _t1[1]
    _t2 = portable_sin_cos(state.nominal[(17 + 1)])
    sy = _t2[0]
    cy = _t2[1]
    out[0] = (sy * cp)
    out[1] = cy
    out[2] = (sy * sp)
    return

cdef double model_turn_by_mount(State* state) noexcept nogil:
    cdef (double, double) _t1
    cdef double sp
    cdef double cp
    cdef double mean_b[3]
    _t1 = portable_sin_cos(state.nominal[17])
    sp = _t1[0]
    cp = _t1[1]
    model_mean_rate_b(state, mean_b)
    return (((-cp) * mean_b[0]) - (sp * mean_b[2]))

cdef void model_mat_eb(State* state, double* out) noexcept nogil:
    rotation_matrix(state.nominal + 6, out)
    return

cdef void model_rate_b(State* state, double* out) noexcept nogil:
    cdef int _i
    for _i in range(3):
        out[_i] = ((state.auxiliary + 9)[_i] - (state.nominal + 10)[_i])
    return

cdef void model_point_velocity_v(State* state, double* point_b, int64_t axes, double* jacobian, double* out) noexcept nogil:
    cdef double* x
    cdef double c[3 * 3]
    cdef double swing_b[3]
    cdef double _t1[3]
    cdef double along_b[3]
    cdef double velocity_b[3]
    cdef int _i
    cdef (double, double) _t2
    cdef double sp
    cdef double cp
    cdef (double, double) _t3
    cdef double sy
    cdef double cy
    cdef double mat_vb[3 * 3]
    cdef double turned[3 * 3]
    cdef int64_t i
    cdef int64_t j
    cdef double _t4[3]
    cdef double _t5[3]
    cdef double mean_b[3]
    cdef double by_mount[3 * 3]
    x = state.nominal
    rotation_matrix(x + 6, c)
    model_rate_b(state, _t1)
    rotation_cross(_t1, point_b, swing_b)
    rotation_transposed_times(c, x + 3, along_b)
    for _i in range(3):
        velocity_b[_i] = (along_b[_i] + swing_b[_i])
    _t2 = portable_sin_cos(x[17])
    sp = _t2[0]
    cp = _t2[1]
    _t3 = portable_sin_cos(x[(17 + 1)])
    sy = _t3[0]
    cy = _t3[1]
    mat_vb[0] = (cy * cp)
    mat_vb[1] = (-sy)
    mat_vb[2] = (cy * sp)
    mat_vb[3] = (sy * cp)
    mat_vb[4] = cy
    mat_vb[5] = (sy * sp)
    mat_vb[6] = (-sp)
    mat_vb[7] = 0.0
    mat_vb[8] = cp
    for i in range(axes):
        for _i in range(n):
            (jacobian + (i) * n)[_i] = 0.0
        for j in range(3):
            turned[(i) * 3 + j] = (((mat_vb[(i) * 3 + 0] * c[(j) * 3 + 0]) + (mat_vb[(i) * 3 + 1] * c[(j) * 3 + 1])) + (mat_vb[(i) * 3 + 2] * c[(j) * 3 + 2]))
        for _i in range(3):
            (jacobian + (i) * n + 3)[_i] = (turned + (i) * 3)[_i]
    model_skew_rows(turned, x + 3, 1.0, axes, jacobian, 6)
    model_skew_rows(mat_vb, point_b, 1.0, axes, jacobian, 9)
    model_mean_rate_b(state, _t5)
    rotation_cross(_t5, point_b, _t4)
    for _i in range(3):
        mean_b[_i] = (along_b[_i] + _t4[_i])
    by_mount[0] = ((((-cy) * sp) * mean_b[0]) + ((cy * cp) * mean_b[2]))
    by_mount[1] = (((((-sy) * cp) * mean_b[0]) - (cy * mean_b[1])) - ((sy * sp) * mean_b[2]))
    by_mount[2] = 0.0
    by_mount[3] = ((((-sy) * sp) * mean_b[0]) + ((sy * cp) * mean_b[2]))
    by_mount[4] = ((((cy * cp) * mean_b[0]) - (sy * mean_b[1])) + ((cy * sp) * mean_b[2]))
    by_mount[5] = 0.0
    by_mount[6] = (((-cp) * mean_b[0]) - (sp * mean_b[2]))
    by_mount[7] = 0.0
    by_mount[8] = 0.0
    for i in range(axes):
        jacobian[(i) * n + 16] = by_mount[(i) * 3 + 0]
        jacobian[(i) * n + (16 + 1)] = by_mount[(i) * 3 + 1]
    rotation_times(mat_vb, velocity_b, out)
    return

# ---------------- fusiond.filter.observations.non_holonomic

cdef bint non_holonomic_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    return (non_holonomic_observe_at_any_speed(state, parameter, seen) >= parameter[5])

cdef double non_holonomic_observe_at_any_speed(State* state, double* parameter, Observation* seen) noexcept nogil:
    cdef double velocity_v[3]
    non_holonomic__observe(state, parameter, seen, velocity_v)
    return sqrt(((velocity_v[0] * velocity_v[0]) + (velocity_v[1] * velocity_v[1])))

cdef void non_holonomic__observe(State* state, double* parameter, Observation* seen, double* out) noexcept nogil:
    cdef double by[3 * n]
    cdef double velocity_v[3]
    cdef int _i
    cdef int64_t i
    model_point_velocity_v(state, parameter, 3, by, velocity_v)
    seen.m = 2
    for _i in range(3):
        seen.common[_i] = 0.0
    for i in range(2):
        for _i in range(n):
            (seen.jacobian + (i) * n)[_i] = (by + ((1 + i)) * n)[_i]
        seen.innovation[i] = (-velocity_v[(1 + i)])
    seen.variance[0], seen.variance[1] = parameter[3], parameter[4]
    if ((n > 21) and (state.covariance[(32) * n + 32] > 0)):
        non_holonomic__slide(state, velocity_v[0], by, seen)
    for _i in range(3):
        out[_i] = velocity_v[_i]
    return

cdef void non_holonomic__slide(State* state, double speed, double* by, Observation* seen) noexcept nogil:
    cdef double _t1[3]
    cdef double turn
    cdef double slip
    cdef double along
    model_rate_b(state, _t1)
    turn, slip = _t1[2], state.nominal[33]
    along = (fabs(speed) * speed)
    seen.innovation[0] -= ((slip * along) * turn)
    axpy(seen.jacobian + (0) * n, (((2 * slip) * fabs(speed)) * turn), by + (0) * n)
    seen.jacobian[(0) * n + (9 + 2)] -= (slip * along)
    seen.jacobian[(0) * n + 32] = (along * turn)

# ---------------- fusiond.filter.observations.parked

cdef bint parked_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef bint stands
    cdef int64_t i
    model_begin(seen, 3)
    stands = (row[0] != 0.0)
    for i in range(3):
        seen.jacobian[(i) * n + (3 + i)] = (1.0 if stands else 0.0)
        seen.innovation[i] = ((-state.nominal[(3 + i)]) if stands else 0.0)
        seen.variance[i] = (row[1] if stands else 1000000000000.0)
    return True

# ---------------- fusiond.filter.observations.steering

cdef bint steering_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double by[3 * n]
    cdef double velocity_v[3]
    cdef double speed
    cdef double base
    cdef double* x
    cdef double axis_b[3]
    cdef double _t1[3]
    cdef double _t2[3]
    cdef double turn
    cdef double mean
    cdef double factor
    cdef double understeer
    cdef double needed
    cdef double by_speed
    cdef int64_t k
    cdef int64_t i
    model_begin(seen, 1)
    model_point_velocity_v(state, parameter, 1, by, velocity_v)
    speed = velocity_v[0]
    base = parameter[4]
    x = state.nominal
    if (fabs(speed) < parameter[5]):
        seen.innovation[0], seen.variance[0] = 0.0, 1000000000000.0
        return True
    model_vertical_b(state, axis_b)
    model_rate_b(state, _t1)
    model_mean_rate_b(state, _t2)
    turn, mean = rotation_inner(axis_b, _t1), rotation_inner(axis_b, _t2)
    factor, understeer = (1 + x[36]), x[37]
    needed = ((base / speed) + (understeer * speed))
    by_speed = ((factor * mean) * (understeer - (base / (speed * speed))))
    for k in range(n):
        seen.jacobian[(0) * n + k] = (by_speed * by[(0) * n + k])
    for i in range(3):
        seen.jacobian[(0) * n + (9 + i)] -= ((factor * needed) * axis_b[i])
    seen.jacobian[(0) * n + 16] += ((factor * needed) * model_turn_by_mount(state))
    seen.jacobian[(0) * n + 34] = 1.0
    seen.jacobian[(0) * n + 35] = (needed * mean)
    seen.jacobian[(0) * n + 36] = ((factor * speed) * mean)
    seen.innovation[0] = ((row[0] - x[35]) - ((factor * needed) * turn))
    seen.variance[0] = row[1]
    model_with_rate_noise(state, seen)
    return True

# ---------------- fusiond.filter.observations.wheel_speed

cdef bint wheel_speed_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    return wheel_speed__observe(state, row, parameter, seen, False)

cdef bint wheel_speed_observe_certain(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    return wheel_speed__observe(state, row, parameter, seen, True)

cdef bint wheel_speed__observe(State* state, double* row, double* parameter, Observation* seen, bint certain) noexcept nogil:
    cdef bint steered
    cdef double by[3 * n]
    cdef double velocity_v[3]
    cdef double forward
    cdef double sideways
    cdef double speed
    cdef int64_t which
    cdef double scale
    cdef double* jacobian
    cdef double track
    cdef double along
    cdef double across
    cdef int _i
    cdef double reading
    cdef double variance
    cdef double reach[n]
    cdef int64_t k
    cdef double spread
    cdef double sure
    cdef double rotation[3 * 3]
    cdef double gained_e[3]
    steered = (parameter[4] != 0.0)
    model_point_velocity_v(state, parameter, (2 if steered else 1), by, velocity_v)
    forward, sideways = velocity_v[0], velocity_v[1]
    speed = forward
    which = (<int64_t>(parameter[6]))
    scale = (1 + state.nominal[(which + 1)])
    jacobian = seen.jacobian + (0) * n
    track = sqrt(((forward * forward) + (sideways * sideways)))
    if (steered and (track > 0.5)):
        speed = (track if (forward >= 0) else (-track))
        along, across = (forward / speed), (sideways / speed)
        for _i in range(n):
            jacobian[_i] = (scale * ((along * (by + (0) * n)[_i]) + (across * (by + (1) * n)[_i])))
    else:
        for _i in range(n):
            jacobian[_i] = (scale * (by + (0) * n)[_i])
    jacobian[which] = speed
    reading, variance = row[0], row[1]
    if ((parameter[5] != 0.0) and (reading > 0) and (row[3] == 0.0)):
        if (certain or (fabs(speed) > 2.0)):
            if (speed < 0):
                reading = (-reading)
        else:
            memset(reach, 0, n * sizeof(double))
            for k in range(n):
                if (jacobian[k] != 0.0):
                    axpy(reach, jacobian[k], state.covariance + (k) * n)
            spread = (variance + linear_dot(jacobian, reach))
            sure = wheel_speed_direction((((reading * scale) * speed) / spread))
            variance += (((100.0 * reading) * reading) * (1 - (sure * sure)))
            reading *= sure
    seen.m = 1
    for _i in range(3):
        seen.common[_i] = 0.0
    seen.innovation[0] = (reading - (scale * speed))
    seen.variance[0] = variance
    if (row[7] > 0):
        model_mat_eb(state, rotation)
        model_acceleration_e(state, gained_e)
        along = (((rotation[(0) * 3 + 0] * gained_e[0]) + (rotation[(1) * 3 + 0] * gained_e[1])) + (rotation[(2) * 3 + 0] * gained_e[2]))
        seen.variance[0] += portable_square((along * row[7]))
    return True

cdef double wheel_speed_direction(double odds) noexcept nogil:
    cdef double other
    cdef double sure
    other = portable_exp(((-2) * fabs(odds)))
    sure = ((1 - other) / (1 + other))
    return ((-sure) if (odds < 0) else sure)

# ---------------- fusiond.filter.observations.yaw_rate

cdef bint yaw_rate_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double axis_b[3]
    cdef int64_t i
    cdef double _t1[3]
    model_begin(seen, 1)
    model_vertical_b(state, axis_b)
    for i in range(3):
        seen.jacobian[(0) * n + (9 + i)] = (-axis_b[i])
    seen.jacobian[(0) * n + 16] = model_turn_by_mount(state)
    seen.jacobian[(0) * n + 33] = 1.0
    model_rate_b(state, _t1)
    seen.innovation[0] = ((row[0] - rotation_inner(axis_b, _t1)) - state.nominal[34])
    seen.variance[0] = row[1]
    model_with_rate_noise(state, seen)
    return True

# ---------------- fusiond.filter.observations.zero_rotation

cdef bint zero_rotation_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double c[3 * 3]
    cdef int64_t i
    cdef double turned
    model_mat_eb(state, c)
    model_begin(seen, 3)
    for i in range(3):
        seen.jacobian[(i) * n + (9 + i)] = 1.0
        seen.jacobian[(i) * n + 6] = (c[(1) * 3 + i] * 7.292115e-05)
        seen.jacobian[(i) * n + (6 + 1)] = (-(c[(0) * 3 + i] * 7.292115e-05))
        turned = (state.auxiliary[(9 + i)] - state.nominal[(10 + i)])
        seen.innovation[i] = (turned - (c[(2) * 3 + i] * 7.292115e-05))
        seen.variance[i] = parameter[0]
    return True

# ---------------- fusiond.filter.observations.zero_velocity

cdef bint zero_velocity_observe(State* state, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef int64_t i
    model_begin(seen, 3)
    for i in range(3):
        seen.jacobian[(i) * n + (3 + i)] = 1.0
        seen.innovation[i] = (-state.nominal[(3 + i)])
        seen.variance[i] = parameter[0]
    return True

# ---------------- fusiond.filter.rivals

cdef double rivals_likelihood(double* innovation, double* variance, double factor, int64_t m, double* spread) noexcept nogil:
    cdef double lower[3 * 3]
    cdef double widened[3]
    cdef double whitened[3]
    cdef int64_t a
    cdef double distance
    cdef double size
    cdef double outlier
    cdef int64_t _a
    for a in range(m):
        widened[a] = (factor * variance[a])
    if ((not measurement_update_cholesky(spread, widened, 1.0, m, lower)) or (not measurement_update_whiten(spread, innovation, widened, m, whitened))):
        return 0.0
    distance, size = 0.0, 1.0
    for a in range(m):
        distance += (whitened[a] * whitened[a])
        size *= lower[(a) * 3 + a]
    outlier = portable_exp(((-(1000.0 if 1000.0 < distance else distance)) / (2 * 100.0)))
    for _a in range(m):
        outlier /= sqrt(100.0)
    return ((((1 - 0.01) * portable_exp(((-distance) / 2))) + (0.01 * outlier)) / size)

cdef double rivals_unread(double* variance, double factor, int64_t m, double* spread) noexcept nogil:
    cdef double lower[3 * 3]
    cdef double widened[3]
    cdef double expected
    cdef double size
    cdef int64_t a
    expected, size = 0.0, 1.0
    for a in range(m):
        widened[a] = (factor * variance[a])
        expected += ((spread[(a) * 3 + a] + variance[a]) / (spread[(a) * 3 + a] + widened[a]))
    if (not measurement_update_cholesky(spread, widened, 1.0, m, lower)):
        return 0.0
    for a in range(m):
        size *= lower[(a) * 3 + a]
    return (portable_exp(((-expected) / 2)) / size)

cdef double rivals_lie_variance(int64_t k) noexcept nogil:
    if (3 <= k < 6):
        return (0.05 * 0.05)
    if (6 <= k < 9):
        return (0.03 * 0.03)
    if (9 <= k < 12):
        return (0.03 * 0.03)
    if (12 <= k < 15):
        return (0.3 * 0.3)
    return 0.0

cdef void rivals_watch_inertial(State* state, Observation* seen, double factor, double* spread, double fits) noexcept nogil:
    cdef double* a
    cdef double widened[3 * 3]
    cdef double lied
    cdef double _t1
    cdef double _t2
    cdef double _t3
    a = state.auxiliary
    if ((state.bank[(0) * BLOCK + 0] > 0) or (not (fits > 0))):
        return
    rivals_with_lie(seen, spread, 0.1, widened)
    lied = rivals_likelihood(seen.innovation, seen.variance, factor, seen.m, widened)
    _t1 = a[41]
    _t2 = 1e-06
    _t3 = ((_t2 if _t2 > _t1 else _t1) * (lied / fits))
    a[41] = (1000000000000.0 if 1000000000000.0 < _t3 else _t3)
    if (a[41] >= 0.01):
        rivals_suspect_motion(state, 0.01)

cdef void rivals_suspect_motion(State* state, double odds) noexcept nogil:
    cdef State rival
    cdef int64_t k
    state.auxiliary[41] = 1e-06
    if (state.auxiliary[73] != 0):
        return
    if (state.bank[(0) * BLOCK + 0] == 0):
        rivals_open_slot(state, 0, odds)
        rival = hypothesis_of(state, 0)
        rival.nominal[38] = 1.0
        for k in range(3, 15):
            rival.covariance[(k) * n + k] += (0.1 * rivals_lie_variance(k))
    if (state.bank[(3) * BLOCK + 0] == 0):
        rivals_open_slot(state, 3, odds)

cdef void rivals_with_lie(Observation* seen, double* spread, double scale, double* widened) noexcept nogil:
    cdef int64_t i
    cdef int64_t j
    cdef int64_t k
    for i in range(seen.m):
        for j in range(seen.m):
            widened[(i) * 3 + j] = spread[(i) * 3 + j]
            for k in range(3, 15):
                widened[(i) * 3 + j] += (scale * ((seen.jacobian[(i) * n + k] * rivals_lie_variance(k)) * seen.jacobian[(j) * n + k]))

cdef double rivals_fit_lie(State* rival, Observation* seen, double* across, double* spread) noexcept nogil:
    cdef int64_t m
    cdef double widened[3 * 3]
    cdef double lower[3 * 3]
    cdef double lie[n]
    cdef double off[3]
    cdef double solved[3]
    cdef int64_t a
    cdef int64_t b
    cdef int64_t k
    cdef double size
    cdef double prior
    cdef double larger
    cdef double _t1
    cdef double _t2
    m = seen.m
    memset(lie, 0, n * sizeof(double))
    memset(off, 0, 3 * sizeof(double))
    rivals_with_lie(seen, spread, 100.0, widened)
    if ((not (rival.nominal[38] > 0.05)) or (not measurement_update_cholesky(widened, seen.variance, 1.0, m, lower))):
        return 1.0
    for a in range(m):
        solved[a] = seen.innovation[a]
        for b in range(a):
            solved[a] -= (lower[(a) * 3 + b] * solved[b])
        solved[a] /= lower[(a) * 3 + a]
    for a in range((m - 1), (-1), (-1)):
        for b in range((a + 1), m):
            solved[a] -= (lower[(b) * 3 + a] * solved[b])
        solved[a] /= lower[(a) * 3 + a]
    for k in range(3, 15):
        for a in range(m):
            lie[k] += (((100.0 * rivals_lie_variance(k)) * seen.jacobian[(a) * n + k]) * solved[a])
        for a in range(m):
            off[a] += (seen.jacobian[(a) * n + k] * lie[k])
    size = 0.0
    for a in range(m):
        size += (off[a] * solved[a])
        for b in range(m):
            widened[(a) * 3 + b] = (spread[(a) * 3 + b] + (off[a] * off[b]))
    prior = (0.3 * portable_exp(((-(1000.0 if 1000.0 < size else size)) / 2)))
    larger = (prior * rivals_likelihood(seen.innovation, seen.variance, 1.0, m, widened))
    if (not (larger > rivals_likelihood(seen.innovation, seen.variance, 1.0, m, spread))):
        return 1.0
    for k in range(3, 15):
        axpy(rival.covariance + (k) * n, lie[k], lie)
    for k in range(9, 15):
        _t1 = rival.covariance[(k) * n + k]
        _t2 = (10.0 * rivals_lie_variance(k))
        rival.covariance[(k) * n + k] = (_t2 if _t2 > _t1 else _t1)
    linear_mirror(rival.covariance)
    measurement_update_project(rival, seen, across, spread)
    return prior

cdef bint rivals_speaks(State* state, int64_t wheel) noexcept nogil:
    return (((state.stamps[0] - state.source_stamps[(wheel) * SOURCE_STAMPS_SIZE + 0]) <= 500000000) and source_health_is_trusted(state.memory + (wheel) * MEMORY_SIZE))

cdef bint rivals_wheels_contradict(State* state, Parameters* params) noexcept nogil:
    cdef int64_t _t1
    cdef int64_t heard
    cdef int64_t against
    cdef int64_t i
    cdef int64_t _k2
    _t1 = 0
    heard = _t1
    against = _t1
    for _k2 in range(params.wheels_count):
        i = params.wheels[_k2]
        if rivals_speaks(state, i):
            heard += 1
            if (state.memory[(i) * MEMORY_SIZE + 2] > 1):
                against += 1
    return ((2 * against) > heard)

cdef bint rivals_may_lie(State* state, int64_t receiver, Parameters* params) noexcept nogil:
    cdef int64_t i
    cdef int64_t _k1
    if (state.memory[(receiver) * MEMORY_SIZE + 21] != 6):
        return True
    for _k1 in range(params.wheels_count):
        i = params.wheels[_k1]
        if rivals_speaks(state, i):
            return True
    return False

cdef void rivals_open_slot(State* state, int64_t slot, double odds) noexcept nogil:
    cdef double _t1
    cdef double _t2
    cdef State rival
    cdef int _i
    cdef int64_t k
    if (state.auxiliary[73] != 0):
        return
    if (state.stamps[22] == 0):
        state.auxiliary[40] = 1.0
    if (state.bank[(slot) * BLOCK + 0] == 0):
        state.stamps[22] += 1
    _t1 = (odds * state.auxiliary[40])
    _t2 = 1e-100
    state.bank[(slot) * BLOCK + 0] = (_t2 if _t2 > _t1 else _t1)
    rival = hypothesis_of(state, slot)
    for _i in range(NOMINAL_SIZE):
        rival.nominal[_i] = state.nominal[_i]
    for k in range(n):
        for _i in range(n):
            (rival.covariance + (k) * n)[_i] = (state.covariance + (k) * n)[_i]

cdef void rivals_close_slot(State* state, int64_t slot) noexcept nogil:
    cdef int _i
    if (state.bank[(slot) * BLOCK + 0] > 0):
        state.stamps[22] -= 1
    for _i in range(BLOCK):
        (state.bank + (slot) * BLOCK)[_i] = 0.0

cdef void rivals_close_all(State* state) noexcept nogil:
    cdef int64_t slot
    for slot in range(4):
        rivals_close_slot(state, slot)

cdef bint rivals_uses(State* state, int64_t slot, int64_t source, Parameters* params) noexcept nogil:
    cdef int64_t suspect
    if ((slot == 3) and (params.models[source] == 2)):
        return False
    suspect = (<int64_t>(state.stamps[23]))
    if ((suspect >= 0) and ((source == suspect) or (source == (<int64_t>(params.model_parameters[(suspect) * PARAMETERS + 11]))))):
        if (slot == 1):
            return False
        if (slot == 2 or slot == 0):
            return True
    return (state.memory[(source) * MEMORY_SIZE + 18] == 0)

cdef void rivals_weigh(State* state, int64_t slot, double own, double main) noexcept nogil:
    cdef double _t1
    if ((own > 0) and (main > 0)):
        _t1 = (own / main)
        state.bank[(slot) * BLOCK + 0] *= (1000000000000.0 if 1000000000000.0 < _t1 else _t1)

cdef void rivals_weigh_liar(State* state, int64_t source, double lie, Parameters* params) noexcept nogil:
    cdef int64_t slot
    cdef int64_t position
    slot = 3
    if (params.models[source] != 2):
        slot, position = 1, rivals_position_of(source, params)
        if ((position < 0) or (state.stamps[23] != position)):
            return
    state.bank[(slot) * BLOCK + 0] *= (1000000000000.0 if 1000000000000.0 < lie else lie)

cdef bint rivals_suspect_receiver(State* state, int64_t source, Parameters* params) noexcept nogil:
    cdef double odds
    cdef int64_t suspect
    cdef int _i
    odds = source_health_odds_of_bias(state.memory + (source) * MEMORY_SIZE)
    suspect = rivals_position_of(source, params)
    if ((odds < 0.01) or (state.bank[(1) * BLOCK + 0] > 0) or (state.memory[(source) * MEMORY_SIZE + 18] != 0) or (suspect < 0)):
        return False
    if (not rivals_may_lie(state, suspect, params)):
        rivals_suspect_motion(state, (1000000000000.0 if 1000000000000.0 < odds else odds))
        return False
    state.stamps[23] = suspect
    for _i in range(2):
        (state.auxiliary + 42)[_i] = 0.0
    state.auxiliary[44] = 1.0
    rivals_open_slot(state, 1, (1000000000000.0 if 1000000000000.0 < odds else odds))
    rivals_suspect_motion(state, ((1000000000000.0 if 1000000000000.0 < odds else odds) / 10))
    return (state.bank[(1) * BLOCK + 0] > 0)

cdef void rivals_lead_off(State* state, int64_t source, double* innovation, double elapsed, Parameters* params) noexcept nogil:
    cdef int64_t i
    if ((state.bank[(1) * BLOCK + 0] > 0) and ((<int64_t>(params.model_parameters[((<int64_t>(state.stamps[23]))) * PARAMETERS + 11])) == source)):
        for i in range(2):
            state.auxiliary[(42 + i)] += (innovation[i] * elapsed)

cdef void rivals_weigh_consistency(State* state, int64_t source, double* whitened, double* spread, double* variance) noexcept nogil:
    cdef double off[3]
    cdef double led[3]
    cdef int64_t i
    cdef double gained
    cdef double _t1
    cdef double _t2
    cdef double odds
    if ((not (state.bank[(1) * BLOCK + 0] > 0)) or (state.stamps[23] != source)):
        return
    for i in range(2):
        off[i] = state.auxiliary[(42 + i)]
    if (not measurement_update_whiten(spread, off, variance, 2, led)):
        return
    gained = 0.0
    for i in range(2):
        gained += ((led[i] * ((2 * whitened[i]) - led[i])) / 2)
    _t1 = (0.0 if 0.0 < gained else gained)
    _t2 = (-20.0)
    odds = portable_exp((_t2 if _t2 > _t1 else _t1))
    state.bank[(1) * BLOCK + 0] *= (odds / state.auxiliary[44])
    state.auxiliary[44] = odds

cdef bint rivals_fits_again(State* state, int64_t source, double* whitened, int64_t m, Parameters* params) noexcept nogil:
    cdef int64_t companion
    cdef bint silent
    cdef double distance
    cdef int64_t a
    companion = (<int64_t>(params.model_parameters[(source) * PARAMETERS + 11]))
    silent = ((companion < 0) or ((state.stamps[0] - state.source_stamps[(companion) * SOURCE_STAMPS_SIZE + 0]) > (<int64_t>10000000000)))
    if ((not silent) and (state.memory[(companion) * MEMORY_SIZE + 18] != 0)):
        return False
    distance = 0.0
    for a in range(m):
        distance += (whitened[a] * whitened[a])
    return (distance <= (2 * m))

cdef int64_t rivals_position_of(int64_t source, Parameters* params) noexcept nogil:
    cdef int64_t i
    if (params.models[source] == 0):
        return source
    for i in range(params.models_count):
        if ((params.models[i] == 0) and ((<int64_t>(params.model_parameters[(i) * PARAMETERS + 11])) == source)):
            return i
    return (-1)

cdef double rivals_wrong(State* state, bint carried) noexcept nogil:
    cdef double since
    cdef double _t1
    if carried:
        return 0.9
    since = ((state.stamps[0] - state.stamps[4]) * 1e-09)
    _t1 = (state.auxiliary[47] + portable_square((since / 200.0)))
    return (0.9 if 0.9 < _t1 else _t1)

cdef void rivals_decide(State* state, bint disputed, Parameters* params) noexcept nogil:
    cdef bint blamed
    cdef double total
    cdef int64_t slot
    cdef State hypothesis
    cdef double _t1
    cdef double _t2
    cdef State inertial
    cdef bint young
    cdef bint excluded
    cdef double odds
    cdef double needed
    cdef double against
    cdef State rival
    cdef double apart
    cdef double blurred
    cdef int64_t i
    if ((state.bank[(1) * BLOCK + 0] > 0) and (not rivals_may_lie(state, (<int64_t>(state.stamps[23])), params))):
        rivals_close_slot(state, 1)
    blamed = ((not disputed) and ((10.0 * state.bank[(2) * BLOCK + 0]) <= state.bank[(1) * BLOCK + 0]))
    total = state.auxiliary[40]
    for slot in range(4):
        if (state.bank[(slot) * BLOCK + 0] > 0):
            hypothesis = hypothesis_of(state, slot)
            if (not state_is_sound(&hypothesis)):
                rivals_close_slot(state, slot)
            total += state.bank[(slot) * BLOCK + 0]
    _t1 = (state.auxiliary[40] / total)
    _t2 = 1e-100
    state.auxiliary[40] = (_t2 if _t2 > _t1 else _t1)
    for slot in range(4):
        state.bank[(slot) * BLOCK + 0] = (state.bank[(slot) * BLOCK + 0] / total)
    inertial = hypothesis_of(state, 0)
    young = ((state.bank[(0) * BLOCK + 0] > 0) and (inertial.nominal[38] > 0.05))
    excluded = (state.memory[((<int64_t>(state.stamps[23]))) * MEMORY_SIZE + 18] != 0)
    for slot in range(4):
        if (0 < state.bank[(slot) * BLOCK + 0] < (1e-07 if (young or (excluded and (slot == 0))) else (0.01 / 10))):
            rivals_close_slot(state, slot)
    for slot in range(4):
        odds = state.bank[(slot) * BLOCK + 0]
        if (odds > 0):
            needed = 100.0
            against = (1 - odds)
            if (slot == 1):
                rival = hypothesis_of(state, 1)
                apart, blurred = 1e-09, 0.0
                for i in range(3):
                    apart += portable_square((rival.nominal[(0 + i)] - state.nominal[(0 + i)]))
                    blurred += rival.covariance[((0 + i)) * n + (0 + i)]
                needed = (((10.0 * params.dead_reckoning_cost) / params.spoof_cost) * sqrt((blurred / apart)))
            elif (slot == 2):
                needed = ((10.0 * params.spoof_cost) / params.dead_reckoning_cost)
            if ((odds >= (needed * against)) and (blamed or (slot != 1))):
                rivals__lead(state, slot, params)
                return

cdef void rivals__lead(State* state, int64_t slot, Parameters* params) noexcept nogil:
    cdef State rival
    cdef int64_t suspect
    cdef int _i
    cdef int64_t k
    cdef int64_t other
    cdef int64_t source
    rival = hypothesis_of(state, slot)
    suspect = (<int64_t>(state.stamps[23]))
    for _i in range(NOMINAL_SIZE):
        state.nominal[_i] = rival.nominal[_i]
    for k in range(n):
        for _i in range(n):
            (state.covariance + (k) * n)[_i] = (rival.covariance + (k) * n)[_i]
    state.auxiliary[40] = state.bank[(slot) * BLOCK + 0]
    for other in range(4):
        if (not ((slot == 1) and (other == 0))):
            rivals_close_slot(state, other)
    if (slot == 0):
        state.auxiliary[47] = 0.5
        state_count_reset(state, 6)
        for source in range(state.sources):
            state.memory[(source) * MEMORY_SIZE + 18] = 0.0
            if (source != params.imu_source):
                source_health_begin(state.memory + (source) * MEMORY_SIZE)
    elif (slot == 3):
        for source in range(state.sources):
            if (params.models[source] == 2):
                source_health_distrust(state.memory + (source) * MEMORY_SIZE)
    elif (slot == 1):
        rivals_exclude(state, suspect, 1.0, params)
    else:
        rivals_exclude(state, suspect, 0.0, params)
        state_count_reset(state, 4)
        state.stamps[20] = suspect

cdef void rivals_exclude(State* state, int64_t suspect, double excluded, Parameters* params) noexcept nogil:
    cdef int64_t companion
    companion = (<int64_t>(params.model_parameters[(suspect) * PARAMETERS + 11]))
    rivals__exclude(state.memory + (suspect) * MEMORY_SIZE, excluded)
    if (companion >= 0):
        rivals__exclude(state.memory + (companion) * MEMORY_SIZE, excluded)

cdef void rivals__exclude(double* memory, double excluded) noexcept nogil:
    memory[18] = excluded
    source_health_begin(memory)
    if (excluded != 0):
        source_health_distrust(memory)

cdef double rivals_below(double z) noexcept nogil:
    cdef double t
    cdef double series
    cdef double _t1
    cdef double beyond
    t = (1 / (1 + (0.2316419 * fabs(z))))
    series = (t * (0.31938153 + (t * ((-0.356563782) + (t * (1.781477937 + (t * ((-1.821255978) + (t * 1.330274429)))))))))
    _t1 = (z * z)
    beyond = ((0.3989422804014327 * portable_exp(((-(1000.0 if 1000.0 < _t1 else _t1)) / 2))) * series)
    return (beyond if (z < 0) else (1 - beyond))

cdef double rivals_median(double* weights, double* means, double* sigmas) noexcept nogil:
    cdef double low
    cdef double high
    cdef int64_t i
    cdef double _t1
    cdef double _t2
    cdef int64_t _step
    cdef double middle
    cdef double share
    cdef double _t3
    cdef double _t4
    low, high = INFINITY, (-INFINITY)
    for i in range((4 + 1)):
        if (weights[i] > 0):
            _t1 = means[i]
            _t2 = means[i]
            low, high = (_t1 if _t1 < low else low), (_t2 if _t2 > high else high)
    for _step in range(40):
        middle, share = ((low + high) / 2), 0.0
        for i in range((4 + 1)):
            if (weights[i] > 0):
                _t3 = sigmas[i]
                _t4 = 1e-12
                share += (weights[i] * rivals_below(((middle - means[i]) / (_t4 if _t4 > _t3 else _t3))))
        if (share < 0.5):
            low = middle
        else:
            high = middle
    return ((low + high) / 2)

cdef void rivals_mix(State* state, int64_t estimate) noexcept nogil:
    cdef double weights[(4 + 1)]
    cdef double errors[(4 + 1) * n]
    cdef double total
    cdef int64_t most
    cdef int64_t slot
    cdef State rival
    cdef double _t1[n]
    cdef int _i
    cdef double chosen[n]
    cdef double means[(4 + 1)]
    cdef double sigmas[(4 + 1)]
    cdef int64_t k
    cdef double* p
    cdef int64_t j
    cdef double _t2
    cdef double _t3
    cdef double _t4
    cdef double _t5
    memset(weights, 0, (4 + 1) * sizeof(double))
    memset(errors, 0, (4 + 1) * n * sizeof(double))
    weights[4] = state.auxiliary[40]
    total, most = state.auxiliary[40], 4
    for slot in range(4):
        total += state.bank[(slot) * BLOCK + 0]
    weights[4] /= total
    for slot in range(4):
        if (state.bank[(slot) * BLOCK + 0] > 0):
            rival = hypothesis_of(state, slot)
            weights[slot] = (state.bank[(slot) * BLOCK + 0] / total)
            measurement_update_difference(&rival, state, _t1)
            for _i in range(n):
                (errors + (slot) * n)[_i] = _t1[_i]
            if (weights[slot] > weights[most]):
                most = slot
    memset(chosen, 0, n * sizeof(double))
    if (estimate == 0):
        for slot in range(4):
            axpy(chosen, weights[slot], errors + (slot) * n)
    elif (estimate == 1):
        memset(means, 0, (4 + 1) * sizeof(double))
        memset(sigmas, 0, (4 + 1) * sizeof(double))
        for k in range(n):
            sigmas[4] = sqrt(state.covariance[(k) * n + k])
            for slot in range(4):
                if (weights[slot] > 0):
                    rival = hypothesis_of(state, slot)
                    means[slot], sigmas[slot] = errors[(slot) * n + k], sqrt(rival.covariance[(k) * n + k])
            chosen[k] = rivals_median(weights, means, sigmas)
    else:
        for _i in range(n):
            chosen[_i] = (errors + (most) * n)[_i]
    p = state.covariance
    for j in range(n):
        _t2 = weights[4]
        for _i in range(n):
            (p + (j) * n)[_i] *= _t2
        axpy(p + (j) * n, (chosen[j] * weights[4]), chosen)
    for slot in range(4):
        if (weights[slot] > 0):
            rival = hypothesis_of(state, slot)
            for j in range(n):
                _t3 = (errors[(slot) * n + j] - chosen[j])
                _t4 = (errors[(slot) * n + j] - chosen[j])
                _t5 = weights[slot]
                for _i in range(n):
                    (p + (j) * n)[_i] += (_t5 * ((rival.covariance + (j) * n)[_i] + (_t4 * ((errors + (slot) * n)[_i] - chosen[_i]))))
    linear_mirror(p)
    measurement_update_inject(state, chosen)

# ---------------- fusiond.filter.smoothing

cdef int64_t smoothing_follow(State* state, Row* rows, int64_t count, int64_t* judged, double* looks, Link* links, Parameters* params) noexcept nogil:
    cdef int64_t _t1
    cdef int64_t found
    cdef int64_t following
    cdef int64_t look
    cdef int64_t i
    cdef Row* row
    cdef int64_t t_ns
    cdef int64_t source
    cdef bint coasted
    cdef Row* imu
    _t1 = 0
    found = _t1
    following = _t1
    look = _t1
    for i in range(count):
        row = (rows + i)
        following = (i if i > following else following)
        while ((following < count) and (not smoothing__is_inertial((rows + following), params))):
            following += 1
        t_ns, source = (<int64_t>row.t_ns), (<int64_t>row.source)
        coasted = step_coasts(state, t_ns, params)
        imu = ((rows + following) if (following < count) else NULL)
        step_advance(state, t_ns, imu, params)
        if (source == -1):
            smoothing__note_look(state, look, looks)
            smoothing__begin_link(state, (links + found), i, -1)
            look += 1
            found += 1
        elif (params.models[source] == -1):
            step_keep_sample(state, row, params)
            found += smoothing__constrain(state, i, True, judged, links, found, params)
            state.source_stamps[(source) * SOURCE_STAMPS_SIZE + 0] = t_ns
        else:
            found += smoothing__measure(state, row, i, judged, links, found, params)
            state.source_stamps[(source) * SOURCE_STAMPS_SIZE + 0] = t_ns
            if (coasted and (not motion_constraints_rests(state, params))):
                found += smoothing__constrain(state, i, False, judged, links, found, params)
        if (not state_is_sound(state)):
            return -1
    smoothing__begin_link(state, (links + found), count, -2)
    return (found + 1)

cdef bint smoothing__is_inertial(Row* row, Parameters* params) noexcept nogil:
    cdef int64_t source
    source = (<int64_t>row.source)
    return ((source != -1) and (params.models[source] == -1))

cdef void smoothing__note_look(State* state, int64_t look, double* looks) noexcept nogil:
    cdef int64_t at
    cdef int64_t k
    cdef int64_t i
    at = (look * ((39 + (n * n)) + 8))
    for k in range(39):
        looks[(at + k)] = state.nominal[k]
    at += 39
    for i in range(n):
        for k in range(n):
            looks[((at + (i * n)) + k)] = state.covariance[(i) * n + k]
    at += (n * n)
    for k in range(3):
        looks[(at + k)] = state.auxiliary[(9 + k)]
        looks[((at + 3) + k)] = state.auxiliary[(6 + k)]
    looks[(at + 6)] = ((state.stamps[0] - state.stamps[1]) * 1e-09)
    looks[(at + 7)] = ((state.stamps[0] - state.stamps[4]) * 1e-09)

cdef void smoothing__begin_link(State* state, Link* link, int64_t row, int64_t part) noexcept nogil:
    cdef int64_t i
    cdef int _i
    link.row, link.part, link.m, link.fused = row, part, 0, False
    for i in range(n):
        for _i in range(n):
            (link.transition + (i) * n)[_i] = (state.transition + (i) * n)[_i]
        for _i in range(n):
            (state.transition + (i) * n)[_i] = 0.0
        state.transition[(i) * n + i] = 1.0

cdef int64_t smoothing__measure(State* state, Row* row, int64_t place, int64_t* judged, Link* links, int64_t found, Parameters* params) noexcept nogil:
    cdef int64_t source
    cdef int64_t t_ns
    cdef int64_t model
    cdef double* values
    cdef double* parameter
    cdef double* memory
    cdef int64_t* stamps
    cdef Observation seen
    cdef double factor
    cdef int64_t a
    cdef double weight
    cdef int _i
    source, t_ns = (<int64_t>row.source), (<int64_t>row.t_ns)
    model = params.models[source]
    values = row.values
    parameter = params.model_parameters + (source) * PARAMETERS
    memory = state.memory + (source) * MEMORY_SIZE
    stamps = state.source_stamps + (source) * SOURCE_STAMPS_SIZE
    source_health_arrive(memory, stamps, values, t_ns)
    measurement_remember(memory, model, values)
    if (model == 0):
        gnss_error_carry(state, source, values, params)
        gnss_error_note(state, source, values, params)
    if (not observations_observe(state, model, values, parameter, &seen)):
        return 0
    measurement_share_noise(state, &seen, parameter)
    factor = source_health_noise_factor(memory, parameter[8], parameter[9])
    for a in range(seen.m):
        seen.variance[a] *= factor
    if ((stamps[0] == (<int64_t>-4611686018427387904)) or ((t_ns - stamps[0]) > (<int64_t>10000000000))):
        stamps[1] = (<int64_t>-4611686018427387904)
    weight = measurement_factor_of(stamps, model, values, parameter, t_ns)
    if (model == 0):
        seen.m = 2
    if smoothing__take(state, &seen, weight, judged[(3 * place)], place, 0, (links + found), params):
        stamps[1] = t_ns
        if (model == 0):
            state.stamps[4] = t_ns
    if (model != 0):
        return 1
    if (not observations_observe(state, model, values, parameter, &seen)):
        return 1
    measurement_share_noise(state, &seen, parameter)
    seen.m = 1
    for _i in range(n):
        (seen.jacobian + (0) * n)[_i] = (seen.jacobian + (2) * n)[_i]
    seen.innovation[0], seen.common[0], seen.variance[0] = seen.innovation[2], seen.common[2], (seen.variance[2] * factor)
    smoothing__take(state, &seen, 1.0, judged[((3 * place) + 1)], place, 1, (links + (found + 1)), params)
    return 2

cdef int64_t smoothing__constrain(State* state, int64_t place, bint sensed, int64_t* judged, Link* links, int64_t found, Parameters* params) noexcept nogil:
    cdef (bint, bint) _t1
    cdef bint still
    cdef bint rolling
    cdef Observation seen
    cdef bint taken
    cdef bint stands
    cdef int64_t made
    _t1 = motion_constraints_constraints_due(state, params)
    still = _t1[0]
    rolling = _t1[1]
    still = (still and sensed)
    taken, stands, made = False, False, 0
    if (still and motion_constraints_observe_constraint(state, 1, params, &seen)):
        model_with_rate_noise(state, &seen)
        stands = smoothing__take(state, &seen, params.zero_velocity_factor, judged[(3 * place)], place, 0, (links + found), params)
        made = 1
    if (stands and motion_constraints_observe_constraint(state, 2, params, &seen)):
        model_with_rate_noise(state, &seen)
        taken = smoothing__take(state, &seen, 1.0, judged[((3 * place) + 1)], place, 1, (links + (found + made)), params)
        made += 1
    if (rolling and (not still) and (not taken) and motion_constraints_observe_constraint(state, 0, params, &seen)):
        model_with_rate_noise(state, &seen)
        smoothing__take(state, &seen, 1.0, judged[((3 * place) + 2)], place, 2, (links + (found + made)), params)
        made += 1
    return made

cdef bint smoothing__take(State* state, Observation* seen, double weight, int64_t verdict, int64_t place, int64_t part, Link* link, Parameters* params) noexcept nogil:
    cdef double* p
    cdef int64_t m
    cdef double whitened[3]
    cdef double distance
    cdef int64_t a
    cdef int _i
    cdef double error[n]
    p = state.covariance
    m = seen.m
    smoothing__begin_link(state, link, place, part)
    measurement_update_project(state, seen, link.across, link.spread)
    distance = 0.0
    if (not measurement_update_whiten(link.spread, seen.innovation, seen.variance, m, whitened)):
        return False
    for a in range(m):
        distance += (whitened[a] * whitened[a])
        link.innovation[a], link.variance[a] = seen.innovation[a], seen.variance[a]
        for _i in range(n):
            (link.sight + (a) * n)[_i] = (seen.jacobian + (a) * n)[_i]
    link.m, link.weight = m, weight
    if ((verdict == 2) or ((verdict == 0) and (not (distance <= params.gates[m])))):
        return False
    if (not measurement_update_make_gain(p, seen, weight, False, link.across, link.spread, link.gain)):
        return False
    link.fused = True
    measurement_update_joseph(p, seen, weight, link.across, link.gain)
    memset(error, 0, n * sizeof(double))
    for a in range(m):
        axpy(error, seen.innovation[a], link.gain + (a) * n)
    measurement_update_turn_along(p, error)
    measurement_update_turn_rows(state.transition, error)
    measurement_update_inject(state, error)
    return True

cdef void smoothing_go_back(State* state, Link* links, int64_t count, Row* rows, int64_t* judged, double* vector, double* matrix, double* looks, int64_t look, Parameters* params) noexcept nogil:
    cdef int64_t i
    cdef Link* link
    for i in range((count - 1), (-1), (-1)):
        link = (links + i)
        if (link.m > 0):
            smoothing__judge(link, (rows + link.row), judged, vector, matrix, params)
            if link.fused:
                smoothing_through_update(link, vector, matrix)
        elif (link.part == -1):
            look -= 1
            smoothing__smooth_look(state, vector, matrix, looks, look)
        smoothing_through_transition(link.transition, vector, matrix)

cdef void smoothing__judge(Link* link, Row* row, int64_t* judged, double* vector, double* matrix, Parameters* params) noexcept nogil:
    cdef int64_t m
    cdef double innovation[3]
    cdef double variance[3 * 3]
    cdef double lower[3 * 3]
    cdef double none[3]
    cdef double whitened[3]
    cdef double distance
    cdef int64_t a
    cdef int64_t verdict
    m = link.m
    memset(innovation, 0, 3 * sizeof(double))
    memset(variance, 0, 3 * 3 * sizeof(double))
    if (not smoothing_against_others(link, vector, matrix, innovation, variance)):
        return
    memset(none, 0, 3 * sizeof(double))
    if ((not measurement_update_cholesky(variance, none, 1.0, m, lower)) or (not measurement_update_whiten(variance, innovation, none, m, whitened))):
        return
    distance = 0.0
    for a in range(m):
        distance += (whitened[a] * whitened[a])
    verdict = (1 if (distance <= params.gates[m]) else 2)
    judged[((3 * link.row) + link.part)] = verdict
    if (params.models[(<int64_t>row.source)] == -1):
        return
    if (link.part == 0):
        row.ratio = (distance / params.gates[m])
        for a in range(m):
            row.innovation[a], row.variance[a] = innovation[a], variance[(a) * 3 + a]
    elif (link.part == 1):
        row.innovation[2], row.variance[2] = innovation[0], variance[(0) * 3 + 0]

cdef bint smoothing_against_others(Link* link, double* vector, double* matrix, double* innovation, double* variance) noexcept nogil:
    cdef double along[3]
    cdef double back[3 * 3]
    cdef int64_t a
    cdef int64_t b
    if link.fused:
        return smoothing__against_others_fused(link, vector, matrix, innovation, variance)
    memset(along, 0, 3 * sizeof(double))
    memset(back, 0, 3 * 3 * sizeof(double))
    smoothing__seen_by(link.across, link.m, vector, matrix, along, back)
    for a in range(link.m):
        innovation[a] = (link.innovation[a] - along[a])
        for b in range(link.m):
            variance[(a) * 3 + b] = (link.spread[(a) * 3 + b] - back[(a) * 3 + b])
        variance[(a) * 3 + a] += link.variance[a]
    return True

cdef bint smoothing__against_others_fused(Link* link, double* vector, double* matrix, double* innovation, double* variance) noexcept nogil:
    cdef int64_t m
    cdef double along[3]
    cdef double back[3 * 3]
    cdef double whole[3 * 3]
    cdef double known[3 * 3]
    cdef double none[3]
    cdef int64_t a
    cdef int64_t b
    cdef double u
    cdef int64_t c
    m = link.m
    memset(along, 0, 3 * sizeof(double))
    memset(back, 0, 3 * 3 * sizeof(double))
    memset(whole, 0, 3 * 3 * sizeof(double))
    memset(known, 0, 3 * 3 * sizeof(double))
    memset(none, 0, 3 * sizeof(double))
    smoothing__seen_by(link.gain, m, vector, matrix, along, back)
    if (not smoothing_inverse(link.spread, link.variance, link.weight, m, whole)):
        return False
    for a in range(m):
        for b in range(m):
            known[(a) * 3 + b] = (whole[(a) * 3 + b] + back[(a) * 3 + b])
    if (not smoothing_inverse(known, none, 1.0, m, variance)):
        return False
    for a in range(m):
        innovation[a] = 0.0
        for b in range(m):
            u = (-along[b])
            for c in range(m):
                u += (whole[(b) * 3 + c] * link.innovation[c])
            innovation[a] += (variance[(a) * 3 + b] * u)
    for a in range(m):
        variance[(a) * 3 + a] -= ((link.weight - 1) * link.variance[a])
    return True

cdef void smoothing__seen_by(double* by, int64_t m, double* vector, double* matrix, double* along, double* back) noexcept nogil:
    cdef double product[n]
    cdef int64_t a
    cdef int _i
    cdef int64_t k
    cdef int64_t b
    for a in range(m):
        along[a] = linear_dot(by + (a) * n, vector)
        for _i in range(n):
            product[_i] = 0.0
        for k in range(n):
            if (by[(a) * n + k] != 0.0):
                axpy(product, by[(a) * n + k], matrix + (k) * n)
        for b in range(m):
            back[(a) * 3 + b] = linear_dot(product, by + (b) * n)

cdef bint smoothing_inverse(double* spread, double* variance, double factor, int64_t m, double* found) noexcept nogil:
    cdef double lower[3 * 3]
    cdef double column[3]
    cdef int64_t b
    cdef int64_t i
    cdef int64_t k
    if (not measurement_update_cholesky(spread, variance, factor, m, lower)):
        return False
    for b in range(m):
        for i in range(m):
            column[i] = (1.0 if (i == b) else 0.0)
            for k in range(i):
                column[i] -= (lower[(i) * 3 + k] * column[k])
            column[i] /= lower[(i) * 3 + i]
        for i in range((m - 1), (-1), (-1)):
            for k in range((i + 1), m):
                column[i] -= (lower[(k) * 3 + i] * column[k])
            column[i] /= lower[(i) * 3 + i]
        for i in range(m):
            found[(i) * 3 + b] = column[i]
    return True

cdef void smoothing_through_update(Link* link, double* vector, double* matrix) noexcept nogil:
    cdef int64_t m
    cdef double whole[3 * 3]
    cdef double both[3 * 3]
    cdef double by_gain[3 * n]
    cdef int64_t a
    cdef int _i
    cdef int64_t k
    cdef int64_t b
    cdef double u[3]
    m = link.m
    memset(whole, 0, 3 * 3 * sizeof(double))
    memset(both, 0, 3 * 3 * sizeof(double))
    if (not smoothing_inverse(link.spread, link.variance, link.weight, m, whole)):
        return
    for a in range(m):
        for _i in range(n):
            (by_gain + (a) * n)[_i] = 0.0
        for k in range(n):
            if (link.gain[(a) * n + k] != 0.0):
                axpy(by_gain + (a) * n, link.gain[(a) * n + k], matrix + (k) * n)
    for a in range(m):
        for b in range(m):
            both[(a) * 3 + b] = (whole[(a) * 3 + b] + linear_dot(by_gain + (a) * n, link.gain + (b) * n))
    memset(u, 0, 3 * sizeof(double))
    for a in range(m):
        u[a] = (-linear_dot(link.gain + (a) * n, vector))
        for b in range(m):
            u[a] += (whole[(a) * 3 + b] * link.innovation[b])
    for a in range(m):
        axpy(vector, u[a], link.sight + (a) * n)
        for k in range(n):
            axpy(matrix + (k) * n, (-by_gain[(a) * n + k]), link.sight + (a) * n)
            if (link.sight[(a) * n + k] != 0.0):
                axpy(matrix + (k) * n, (-link.sight[(a) * n + k]), by_gain + (a) * n)
                for b in range(m):
                    axpy(matrix + (k) * n, (link.sight[(a) * n + k] * both[(a) * 3 + b]), link.sight + (b) * n)
    linear_mirror(matrix)

cdef void smoothing_through_transition(double* transition, double* vector, double* matrix) noexcept nogil:
    cdef double before[n]
    cdef double moved[n]
    cdef int64_t k
    cdef bint same
    cdef int64_t i
    cdef double product[n * n]
    cdef int _i
    cdef double by
    memset(moved, 0, n * sizeof(double))
    for k in range(n):
        before[k] = vector[k]
        same = (transition[(k) * n + k] == 1.0)
        for i in range(n):
            if ((i != k) and (transition[(k) * n + i] != 0.0)):
                same = False
        moved[k] = (0.0 if same else 1.0)
    for k in range(n):
        if (moved[k] != 0.0):
            axpy(vector, before[k], transition + (k) * n)
            vector[k] -= before[k]
    for i in range(n):
        for _i in range(n):
            (product + (i) * n)[_i] = (matrix + (i) * n)[_i]
        for k in range(n):
            if (moved[k] != 0.0):
                axpy(product + (i) * n, matrix[(i) * n + k], transition + (k) * n)
                product[(i) * n + k] -= matrix[(i) * n + k]
    for i in range(n):
        for _i in range(n):
            (matrix + (i) * n)[_i] = (product + (i) * n)[_i]
    for k in range(n):
        if (moved[k] != 0.0):
            for i in range(n):
                by = (transition[(k) * n + i] - (1.0 if (i == k) else 0.0))
                if (by != 0.0):
                    axpy(matrix + (i) * n, by, product + (k) * n)
    linear_mirror(matrix)

cdef void smoothing__smooth_look(State* state, double* vector, double* matrix, double* looks, int64_t look) noexcept nogil:
    cdef int64_t size
    cdef int64_t at
    cdef int64_t covariance
    cdef int64_t k
    cdef int64_t i
    size = n
    at = (look * ((39 + (size * size)) + 8))
    covariance = (at + 39)
    for k in range(39):
        state.nominal[k] = looks[(at + k)]
    for i in range(n):
        for k in range(n):
            state.covariance[(i) * n + k] = looks[((covariance + (i * size)) + k)]
    smoothing_smooth(state, vector, matrix)
    for k in range(39):
        looks[(at + k)] = state.nominal[k]
    for i in range(n):
        for k in range(n):
            looks[((covariance + (i * size)) + k)] = state.covariance[(i) * n + k]

cdef void smoothing_smooth(State* state, double* vector, double* matrix) noexcept nogil:
    cdef double* p
    cdef double error[n]
    cdef double known[n * n]
    cdef double gone[n * n]
    cdef int64_t i
    cdef int _i
    cdef int64_t k
    p = state.covariance
    for i in range(n):
        error[i] = linear_dot(p + (i) * n, vector)
        for _i in range(n):
            (known + (i) * n)[_i] = 0.0
        for k in range(n):
            if (p[(i) * n + k] != 0.0):
                axpy(known + (i) * n, p[(i) * n + k], matrix + (k) * n)
    for i in range(n):
        for _i in range(n):
            (gone + (i) * n)[_i] = 0.0
        for k in range(n):
            if (known[(i) * n + k] != 0.0):
                axpy(gone + (i) * n, known[(i) * n + k], p + (k) * n)
    for i in range(n):
        axpy(p + (i) * n, (-1.0), gone + (i) * n)
    linear_mirror(p)
    measurement_update_turn_along(p, error)
    measurement_update_inject(state, error)

# ---------------- fusiond.filter.source_health

cdef void source_health_begin(double* memory) noexcept nogil:
    cdef int64_t i
    cdef double _t1
    cdef int _i
    for i in range(4):
        _t1 = PRIOR[i]
        memory[(4 + i)] = _t1
        memory[(14 + i)] = _t1
    for _i in range(3):
        (memory + 8)[_i] = 0.0
    memory[11] = 100.0

cdef void source_health_judge_repetition(double* memory, int64_t* stamps, bint same, int64_t t_ns) noexcept nogil:
    cdef double nothing[3]
    if source_health_is_due(stamps, t_ns, 0.0):
        memset(nothing, 0, 3 * sizeof(double))
        source_health_judge(memory, stamps, nothing, 0, same, t_ns)

cdef void source_health_blame_frozen(double* memory, double probability) noexcept nogil:
    cdef double rest
    cdef int64_t i
    if ((((memory[4] + memory[5]) + memory[6]) + memory[7]) == 0):
        source_health_begin(memory)
    if (memory[7] < probability):
        rest = ((1 - probability) / (1 - memory[7]))
        for i in range(4):
            memory[(4 + i)] *= rest
        memory[7] = probability

cdef bint source_health_is_due(int64_t* stamps, int64_t t_ns, double correlation) noexcept nogil:
    cdef int64_t pause
    pause = (<int64_t>((2000000000.0 * correlation)))
    return ((stamps[4] == (<int64_t>-4611686018427387904)) or ((t_ns - stamps[4]) >= (pause if pause > 50000000 else 50000000)))

cdef void source_health_judge(double* memory, int64_t* stamps, double* whitened, int64_t m, bint same, int64_t t_ns) noexcept nogil:
    cdef double elapsed
    cdef double blurred
    cdef int64_t i
    cdef double usual
    if ((((memory[4] + memory[5]) + memory[6]) + memory[7]) == 0):
        source_health_begin(memory)
    elapsed = 20.0
    if (stamps[4] != (<int64_t>-4611686018427387904)):
        elapsed = ((t_ns - stamps[4]) * 1e-09)
    stamps[4] = t_ns
    blurred = (1 - portable_exp(((-elapsed) / 20.0)))
    for i in range(4):
        usual = (PRIOR[i] if (memory[18] == 0) else PRIOR_OF_LIAR[i])
        memory[(14 + i)] = (memory[(4 + i)] + (blurred * (usual - memory[(4 + i)])))
    source_health_look(memory, whitened, m, same)
    source_health__follow_bias(memory, whitened, m)

cdef void source_health_judge_repeated(double* memory, double* whitened, int64_t m) noexcept nogil:
    cdef (double, double, double, double) _t1
    cdef double nominal
    cdef double _noisy
    cdef double biased
    cdef double frozen
    cdef double distrusted
    cdef double share
    cdef double total
    _t1 = source_health_likelihoods(memory, whitened, m, True)
    nominal = _t1[0]
    _noisy = _t1[1]
    biased = _t1[2]
    frozen = _t1[3]
    distrusted, share = (memory[6] + memory[7]), (frozen * memory[7])
    total = ((biased * memory[6]) + share)
    if ((nominal <= frozen) and (total > 0)):
        memory[7] = ((distrusted * share) / total)
        memory[6] = (distrusted - memory[7])

cdef void source_health_look(double* memory, double* whitened, int64_t m, bint same) noexcept nogil:
    cdef (double, double, double, double) _t1
    cdef double nominal
    cdef double noisy
    cdef double biased
    cdef double frozen
    cdef double total
    cdef int64_t i
    source_health__renew_bias(memory, whitened, m)
    _t1 = source_health_likelihoods(memory, whitened, m, same)
    nominal = _t1[0]
    noisy = _t1[1]
    biased = _t1[2]
    frozen = _t1[3]
    memory[4] = (memory[14] * nominal)
    memory[5] = (memory[(14 + 1)] * noisy)
    memory[6] = (memory[(14 + 2)] * biased)
    memory[7] = (memory[(14 + 3)] * frozen)
    total = 0.0
    for i in range(4):
        total += memory[(4 + i)]
    for i in range(4):
        memory[(4 + i)] = (memory[(4 + i)] / total)

cdef (double, double, double, double) source_health_likelihoods(double* memory, double* whitened, int64_t m, bint same) noexcept nogil:
    cdef double _t1
    cdef double square
    cdef double off
    cdef double stretch
    cdef int64_t a
    cdef double rest
    cdef double outlier
    cdef double good
    cdef double noisy
    cdef double biased
    _t1 = 0.0
    square = _t1
    off = _t1
    stretch = source_health__stretch(memory, m)
    for a in range(m):
        square += (whitened[a] * whitened[a])
        rest = (whitened[a] - (memory[(8 + a)] * stretch))
        off += (rest * rest)
    square, off = (1000.0 if 1000.0 < square else square), (1000.0 if 1000.0 < off else off)
    outlier = source_health__density(square, 100.0, m)
    good = (((1 - 0.01) * source_health__density(square, 1.0, m)) + (0.01 * outlier))
    noisy = (((1 - 0.01) * source_health__density(square, 16.0, m)) + (0.01 * outlier))
    biased = (((1 - 0.01) * source_health__density(off, (1 + memory[11]), m)) + (0.01 * outlier))
    if (not same):
        return (good, noisy, biased, (outlier * 0.001))
    return ((good * 0.3333333333333333), (noisy * 0.05), (biased * 0.05), outlier)

cdef void source_health__renew_bias(double* memory, double* whitened, int64_t m) noexcept nogil:
    cdef double _t1
    cdef double square
    cdef double off
    cdef int64_t a
    cdef double rest
    cdef int _i
    _t1 = 0.0
    square = _t1
    off = _t1
    for a in range(m):
        square += (whitened[a] * whitened[a])
        rest = (whitened[a] - memory[(8 + a)])
        off += (rest * rest)
    if (source_health__density(square, (1 + 100.0), m) > source_health__density(off, (1 + memory[11]), m)):
        for _i in range(3):
            (memory + 8)[_i] = 0.0
        memory[11] = 100.0

cdef double source_health__density(double square, double variance, int64_t m) noexcept nogil:
    cdef double root
    cdef double scale
    cdef int64_t _a
    root = sqrt(variance)
    scale = 1.0
    for _a in range(m):
        scale *= root
    return (portable_exp(((-square) / (2 * variance))) / scale)

cdef double source_health__stretch(double* memory, int64_t m) noexcept nogil:
    cdef double size
    cdef int64_t a
    if (memory[11] >= 1.0):
        return 1.0
    size = 0.0
    for a in range(m):
        size += (memory[(8 + a)] * memory[(8 + a)])
    size = sqrt(size)
    return ((2.0 / size) if (1e-09 < size < 2.0) else 1.0)

cdef void source_health__follow_bias(double* memory, double* whitened, int64_t m) noexcept nogil:
    cdef double variance
    cdef double gain
    cdef int64_t a
    variance = (memory[11] + 0.01)
    gain = (variance / (variance + 1))
    for a in range(m):
        memory[(8 + a)] += (gain * (whitened[a] - memory[(8 + a)]))
    memory[11] = ((1 - gain) * variance)

cdef bint source_health_is_trusted(double* memory) noexcept nogil:
    return ((memory[18] == 0) and ((memory[6] + memory[7]) <= 0.5))

cdef bint source_health_is_used(double* memory, bint by_rivals) noexcept nogil:
    return ((memory[18] == 0) and ((memory[7] + (0.0 if by_rivals else memory[6])) <= 0.5))

cdef bint source_health_is_stuck(double* memory) noexcept nogil:
    return (memory[7] > 0.5)

cdef double source_health_odds_of_bias(double* memory) noexcept nogil:
    return ((memory[6] / memory[4]) if (memory[4] > 1e-12) else (memory[6] * 1000000000000.0))

cdef void source_health_distrust(double* memory) noexcept nogil:
    cdef int64_t i
    cdef double _t1
    cdef double _t2
    cdef double _t3
    for i in range(4):
        _t1 = PRIOR[i]
        memory[(4 + i)] = _t1
        memory[(14 + i)] = _t1
    _t2 = PRIOR[(6 - 4)]
    memory[4] = _t2
    memory[14] = _t2
    _t3 = 0.997
    memory[6] = _t3
    memory[((14 + 6) - 4)] = _t3

cdef double source_health_noise_factor(double* memory, double lowest, double highest) noexcept nogil:
    cdef double beyond
    cdef double _t1
    cdef double _t2
    beyond = 0.0
    if (memory[3] > 0.2):
        beyond = (memory[3] - 0.2)
    elif (memory[3] < (-0.2)):
        beyond = (memory[3] + 0.2)
    _t1 = (1 + beyond)
    _t2 = (lowest if lowest > _t1 else _t1)
    return (highest if highest < _t2 else _t2)

cdef double source_health_noisy_factor(double* memory) noexcept nogil:
    return ((1 + ((16.0 - 1) * memory[5])) if (memory[5] > 0.1) else 1.0)

cdef void source_health_learn(double* memory, double* innovation, double* variance, double* spread, int64_t m, double elapsed) noexcept nogil:
    cdef double _t1
    cdef double found
    cdef double configured
    cdef double nis
    cdef int64_t a
    cdef double square
    cdef double expected
    cdef double _t2
    _t1 = 0.0
    found = _t1
    configured = _t1
    nis = _t1
    for a in range(m):
        square, expected = (innovation[a] * innovation[a]), (spread[(a) * 3 + a] + variance[a])
        nis += (square / expected)
        _t2 = (25.0 * expected)
        found += ((_t2 if _t2 < square else square) - spread[(a) * 3 + a])
        configured += variance[a]
    memory[19] += ((elapsed / (10.0 + elapsed)) * ((nis / m) - memory[19]))
    if (configured > 0):
        memory[3] += ((elapsed / (30.0 + elapsed)) * (((found / configured) - 1) - memory[3]))

cdef double source_health_since_last(int64_t* stamps, int64_t t_ns) noexcept nogil:
    if (stamps[0] == (<int64_t>-4611686018427387904)):
        return 0.0
    return ((t_ns - stamps[0]) * 1e-09)

cdef bint source_health_arrive(double* memory, int64_t* stamps, double* values, int64_t t_ns) noexcept nogil:
    cdef double total
    cdef bint same
    cdef double elapsed
    cdef double share
    total = ((values[0] + values[1]) + values[2])
    same = ((stamps[0] != (<int64_t>-4611686018427387904)) and (total == memory[12]))
    memory[12] = total
    elapsed = source_health_since_last(stamps, t_ns)
    if (elapsed > 0):
        share = (0.05 if (memory[13] > 0) else 1.0)
        memory[13] += (share * ((10.0 if 10.0 < elapsed else elapsed) - memory[13]))
    return same

cdef void source_health_note_rejected(double* memory, double reading, double innovation) noexcept nogil:
    cdef double expected
    cdef double share
    expected = fabs((reading - innovation))
    if (expected < 2.0):
        return
    share = (0.02 if (memory[23] > 0) else 1.0)
    memory[22] += (share * (fabs(reading) - memory[22]))
    memory[23] += (share * (expected - memory[23]))

# ---------------- fusiond.filter.state

cdef bint state_is_sound(State* state) noexcept nogil:
    cdef double spread
    cdef int64_t i
    cdef double total
    spread = 0.0
    for i in range(0, 3):
        spread += state.covariance[(i) * n + i]
    if (not (0 <= spread < (6378137.0 * 6378137.0))):
        return False
    total = 0.0
    for i in range(NOMINAL_SIZE):
        total += state.nominal[i]
    for i in range(n):
        total += state.covariance[(i) * n + i]
    return isfinite(total)

cdef double state_variance_about(State* state, double x, double y, double z) noexcept nogil:
    cdef double* p
    cdef int64_t phi
    cdef double turned[3]
    cdef int64_t a
    p = state.covariance
    phi = 6
    for a in range(3):
        turned[a] = (((p[((phi + a)) * n + phi] * x) + (p[((phi + a)) * n + (phi + 1)] * y)) + (p[((phi + a)) * n + (phi + 2)] * z))
    return (((x * turned[0]) + (y * turned[1])) + (z * turned[2]))

cdef void state_count_reset(State* state, int64_t reason) noexcept nogil:
    state.stamps[11] += 1
    state.stamps[19] = reason

# ---------------- fusiond.filter.step

cdef void step_step(State* state, Row* row, Row* imu, Parameters* params) noexcept nogil:
    cdef int64_t t_ns
    cdef int64_t source
    cdef bint coasted
    cdef double variance
    cdef bint lost
    t_ns, source = (<int64_t>row.t_ns), (<int64_t>row.source)
    step__forget_judgement(row)
    if (state.source_stamps[(source) * SOURCE_STAMPS_SIZE + 0] == t_ns):
        row.outcome = 3
        return
    row.outcome = 0
    if (state.stamps[10] == 1):
        initial_alignment_gather_motion(state, row, params)
    elif (state.stamps[10] == 3):
        step__choose(state, row, imu, params)
        step_guard(state)
    else:
        coasted = step_coasts(state, t_ns, params)
        step_advance_all(state, t_ns, imu, params)
        if (params.models[source] == -1):
            step_keep_sample(state, row, params)
            motion_constraints_constrain(state, params)
        else:
            variance = (step_yaw_variance(state) if coasted else 0.0)
            lost = (variance > portable_square(0.20943951023931956))
            if (not (step__fuse_while_lost(state, row, params, variance) if lost else measurement_fuse_measurement(state, row, params))):
                row.outcome = 1
            if (coasted and (not lost)):
                motion_constraints_roll(state, params)
        step_guard(state)
    step__name_gathered(state, row, params)
    state.source_stamps[(source) * SOURCE_STAMPS_SIZE + 0] = t_ns

cdef bint step_can_step(State* state, Row* row, Parameters* params) noexcept nogil:
    cdef int64_t* stamps
    cdef int64_t phase
    cdef int64_t t_ns
    cdef int64_t model
    cdef double* values
    cdef bint tells
    cdef double grown
    stamps = state.stamps
    phase = (<int64_t>(state.stamps[10]))
    t_ns, model = (<int64_t>row.t_ns), (<int64_t>(params.models[(<int64_t>row.source)]))
    if ((phase == 0) or ((t_ns - stamps[0]) > params.restart_gap_ns)):
        return False
    if (phase == 1):
        return (model != 0 and model != 1)
    if ((phase == 2) and (stamps[6] == (<int64_t>-4611686018427387904))):
        values = row.values
        tells = ((model == 1) and initial_alignment_tells_course(values, values[3], params))
        if (tells or (model == 4)):
            return False
    if ((phase == 2) and (model == -1) and step_coasts(state, t_ns, params)):
        if (not inertial_sample_is_believed(state, row.values, t_ns, params)):
            return True
        grown = (portable_square(0.3) * ((t_ns - stamps[0]) * 1e-09))
        return (not ((step_yaw_variance(state) + grown) > (portable_square(0.20943951023931956) / 2)))
    return True

cdef void step__forget_judgement(Row* row) noexcept nogil:
    cdef int _i
    row.ratio = 0.0
    for _i in range(3):
        row.innovation[_i] = 0.0
    for _i in range(3):
        row.variance[_i] = 0.0

cdef void step__name_gathered(State* state, Row* row, Parameters* params) noexcept nogil:
    if ((row.outcome == 0) and (not hot_start_has_state(state, params))):
        row.outcome = 6

cdef bint step__fuse_while_lost(State* state, Row* row, Parameters* params, double variance) noexcept nogil:
    cdef bint fused
    cdef double gained
    cdef double* r
    cdef int64_t phi
    cdef int64_t i
    cdef int64_t j
    fused = measurement_fuse_measurement(state, row, params)
    gained = (variance - step_yaw_variance(state))
    if (gained > 0):
        r = state.nominal
        phi = 6
        gained /= (((r[0] * r[0]) + (r[1] * r[1])) + (r[2] * r[2]))
        for i in range(3):
            for j in range(3):
                state.covariance[((phi + i)) * n + (phi + j)] += ((r[i] * r[j]) * gained)
    return fused

cdef bint step_coasts(State* state, int64_t t_ns, Parameters* params) noexcept nogil:
    return ((t_ns - state.stamps[1]) > params.imu_gap_ns)

cdef bint step_is_final(State* state, int64_t source, Parameters* params) noexcept nogil:
    return ((params.models[source] == -1) or step_coasts(state, state.stamps[0], params))

cdef double step_yaw_variance(State* state) noexcept nogil:
    cdef double* r
    cdef int64_t phi
    cdef double total
    cdef int64_t i
    cdef int64_t j
    r = state.nominal
    phi = 6
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += ((r[i] * state.covariance[((phi + i)) * n + (phi + j)]) * r[j])
    return (total / (((r[0] * r[0]) + (r[1] * r[1])) + (r[2] * r[2])))

cdef void step_advance_all(State* state, int64_t t_ns, Row* imu, Parameters* params) noexcept nogil:
    cdef int64_t begin
    cdef int64_t slot
    cdef State rival
    begin = (<int64_t>(state.stamps[0]))
    step_advance(state, t_ns, imu, params)
    if ((state.stamps[22] > 0) and (state.auxiliary[73] != 0)):
        rivals_close_all(state)
    if (state.stamps[22] > 0):
        for slot in range(4):
            if (state.bank[(slot) * BLOCK + 0] > 0):
                state.stamps[0] = begin
                rival = hypothesis_of(state, slot)
                step_advance(&rival, t_ns, imu, params)
        state.stamps[0] = (t_ns if t_ns > begin else begin)

cdef void step_advance(State* state, int64_t t_ns, Row* imu, Parameters* params) noexcept nogil:
    cdef int64_t* stamps
    cdef double* a
    cdef int64_t begin
    cdef int64_t held
    cdef double dt
    cdef bint frozen
    cdef double* sample
    cdef int64_t until
    cdef bint believed
    cdef (double, double) _t1
    cdef double accel
    cdef double gyro
    cdef double span
    cdef double _t2
    cdef double middle
    cdef double end
    cdef double force_change[3]
    cdef int _i
    cdef double rate_change[3]
    cdef double force_b[3]
    cdef double rate_b[3]
    cdef double share
    cdef double _t3[3]
    cdef double _t4[3]
    stamps = state.stamps
    a = state.auxiliary
    begin, held = (<int64_t>(stamps[0])), (<int64_t>(stamps[1]))
    if (t_ns <= begin):
        return
    dt = ((t_ns - begin) * 1e-09)
    stamps[0] = t_ns
    frozen = (not source_health_is_trusted(state.memory + (params.imu_source) * MEMORY_SIZE))
    if ((imu == NULL) or (held == (<int64_t>-4611686018427387904)) or ((imu.t_ns - held) > params.imu_gap_ns) or frozen):
        strapdown_coast(state, dt, &params.noise, motion_constraints_rests(state, params))
        a[36] = (0.05 * 0.05)
        return
    sample = imu.values
    until = (<int64_t>imu.t_ns)
    believed = inertial_sample_is_believed(state, sample, until, params)
    _t1 = inertial_sample_doubt(state, sample, t_ns, until, believed, params)
    accel = _t1[0]
    gyro = _t1[1]
    span = (<double>((until - held)))
    _t2 = 0.0
    middle = _t2
    end = _t2
    if believed:
        middle = (((<double>(((begin - held) + (t_ns - held)))) / 2) / span)
        end = ((<double>((t_ns - held))) / span)
    for _i in range(3):
        force_change[_i] = (sample[_i] - a[_i])
    for _i in range(3):
        rate_change[_i] = ((sample + 3)[_i] - (a + 3)[_i])
    for _i in range(3):
        force_b[_i] = (a[_i] + (middle * force_change[_i]))
    for _i in range(3):
        rate_b[_i] = ((a + 3)[_i] + (middle * rate_change[_i]))
    for _i in range(3):
        (a + 6)[_i] = (a[_i] + (end * force_change[_i]))
    for _i in range(3):
        (a + 9)[_i] = ((a + 3)[_i] + (end * rate_change[_i]))
    a[36] = ((params.noise.gyro / (span * 1e-09)) * (((1 - end) * (1 - end)) + (end * end)))
    strapdown_propagate(state, dt, force_b, rate_b, &params.noise)
    if believed:
        share = ((<double>((t_ns - begin))) / span)
        for _i in range(3):
            _t3[_i] = (share * force_change[_i])
        for _i in range(3):
            _t4[_i] = (share * rate_change[_i])
        inertial_delay_catch_up(state, _t3, _t4)
    if (accel > 0):
        strapdown_add_white_noise(state.covariance, dt, accel, gyro)
        a[36] += (gyro / (span * 1e-09))

cdef void step_predict(State* state, int64_t t_ns, Parameters* params) noexcept nogil:
    cdef int64_t* stamps
    cdef int64_t begin
    cdef int64_t slot
    cdef State rival
    stamps = state.stamps
    begin = (<int64_t>(stamps[0]))
    if (stamps[10] != 2):
        return
    step__predict(state, t_ns, params)
    if (stamps[22] > 0):
        for slot in range(4):
            if (state.bank[(slot) * BLOCK + 0] > 0):
                stamps[0] = begin
                rival = hypothesis_of(state, slot)
                step__predict(&rival, t_ns, params)
        rivals_mix(state, params.estimate)

cdef void step__predict(State* state, int64_t t_ns, Parameters* params) noexcept nogil:
    cdef int64_t* stamps
    cdef double* a
    cdef int64_t begin
    cdef int64_t _t1
    cdef int64_t _t2
    cdef int64_t until
    stamps = state.stamps
    a = state.auxiliary
    begin = (<int64_t>(stamps[0]))
    if (t_ns <= begin):
        return
    _t1 = (<int64_t>((stamps[1] + params.imu_gap_ns)))
    _t2 = (_t1 if _t1 < t_ns else t_ns)
    until = (_t2 if _t2 > begin else begin)
    if (not source_health_is_trusted(state.memory + (params.imu_source) * MEMORY_SIZE)):
        until = begin
    if (until > begin):
        strapdown_propagate(state, ((until - begin) * 1e-09), a, a + 3, &params.noise)
    if (t_ns > until):
        strapdown_coast(state, ((t_ns - until) * 1e-09), &params.noise, motion_constraints_rests(state, params))
    stamps[0] = t_ns

cdef void step__choose(State* state, Row* row, Row* imu, Parameters* params) noexcept nogil:
    cdef int64_t* stamps
    cdef int64_t source
    cdef int64_t t_ns
    cdef int64_t begin
    cdef int64_t model
    cdef double* values
    cdef int64_t i
    cdef State hypothesis
    cdef double* memory
    cdef int64_t* own
    cdef double* parameter
    cdef double factor
    stamps = state.stamps
    source = (<int64_t>row.source)
    t_ns = (<int64_t>row.t_ns)
    begin = (<int64_t>(stamps[0]))
    model = (<int64_t>(params.models[source]))
    values = row.values
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            stamps[0] = begin
            hypothesis = hypothesis_of(state, i)
            step_advance(&hypothesis, t_ns, imu, params)
    stamps[0] = (t_ns if t_ns > begin else begin)
    if (model == -1):
        step_keep_sample(state, row, params)
        heading_bank_constrain(state, params)
        return
    memory = state.memory + (source) * MEMORY_SIZE
    own = state.source_stamps + (source) * SOURCE_STAMPS_SIZE
    parameter = params.model_parameters + (source) * PARAMETERS
    source_health_arrive(memory, own, values, t_ns)
    measurement_remember(memory, model, values)
    if ((model == 2) and motion_constraints_carried(state, memory[0], params)):
        row.outcome = 1
        return
    factor = measurement_factor_of(own, model, values, parameter, t_ns)
    for i in range(13):
        if (state.bank[(i) * BLOCK + 0] > 0):
            if (model == 0):
                hypothesis = hypothesis_of(state, i)
                gnss_error_carry(&hypothesis, source, values, params)
            heading_bank_fuse_measurement(state, i, model, values, parameter, factor, params)
    own[1] = t_ns
    if (model == 0):
        gnss_error_note(state, source, values, params)
        stamps[4] = t_ns
    heading_bank_collapse_if_close(state, params)

cdef void step_keep_sample(State* state, Row* row, Parameters* params) noexcept nogil:
    cdef int64_t* stamps
    cdef double* a
    cdef int64_t t_ns
    cdef double dt
    cdef double* memory
    cdef int64_t* own
    cdef bint trusted
    cdef bint believed
    stamps = state.stamps
    a = state.auxiliary
    t_ns = (<int64_t>row.t_ns)
    dt = (((t_ns - stamps[1]) * 1e-09) if (stamps[1] != (<int64_t>-4611686018427387904)) else 0.0)
    memory = state.memory + (params.imu_source) * MEMORY_SIZE
    own = state.source_stamps + (params.imu_source) * SOURCE_STAMPS_SIZE
    trusted, believed = source_health_is_trusted(memory), inertial_sample_judge(state, row, params)
    source_health_arrive(memory, own, row.values, t_ns)
    inertial_sample_judge_sensor(state, row.values, t_ns, params)
    if (not (believed and trusted and source_health_is_trusted(memory))):
        row.outcome = 1
        return
    strapdown_end_coasting(state)
    step_hold(state, row.values, t_ns)
    a[36] = ((params.noise.gyro / (0.0001 if 0.0001 > dt else dt)) if (dt > 0) else 0.0)
    motion_constraints_watch(state, a, a + 3, dt, params)
    motion_constraints_doubt_turn(state, a + 3, dt, params)

cdef void step_hold(State* state, double* values, int64_t t_ns) noexcept nogil:
    cdef double* a
    cdef int64_t i
    cdef double _t1
    a = state.auxiliary
    state.stamps[1] = t_ns
    for i in range(3):
        _t1 = values[i]
        a[(0 + i)] = _t1
        a[(6 + i)] = _t1
        a[(3 + i)] = values[(3 + i)]
        if (a[73] == 0.0):
            a[(9 + i)] = values[(3 + i)]

cdef void step_guard(State* state) noexcept nogil:
    cdef int64_t i
    cdef int64_t resets
    cdef int64_t blown
    if (state.stamps[10] == 3):
        for i in range(13):
            if (state.bank[(i) * BLOCK + 0] > 0):
                return
    elif state_is_sound(state):
        return
    resets, blown = (<int64_t>(state.stamps[11])), (<int64_t>(state.stamps[18]))
    clear_state(state)
    state.stamps[11], state.stamps[18] = resets, (blown + 1)
    state_count_reset(state, 3)

cdef int64_t step_place(Row* rows, int64_t begin, int64_t end, int64_t t_ns, int64_t source, int64_t sequence) noexcept nogil:
    cdef int64_t i
    cdef Row* row
    i = end
    while (i > begin):
        row = (rows + (i - 1))
        if (row.t_ns < t_ns):
            break
        if (row.t_ns == t_ns):
            if (row.source < source):
                break
            if (row.source == source):
                if (row.sequence == sequence):
                    return (~((i - 1) - begin))
                if (row.sequence < sequence):
                    break
        i -= 1
    return (i - begin)

cdef int64_t step_first_changed(Row* rows, int64_t begin, int64_t new, Parameters* params) noexcept nogil:
    cdef int64_t i
    i = (begin + new)
    if (params.models[(<int64_t>(((rows + i)).source))] != -1):
        return new
    while ((i > begin) and (params.models[(<int64_t>(((rows + (i - 1))).source))] != -1)):
        i -= 1
    while ((begin < i < (begin + new)) and (((rows + i)).t_ns == ((rows + (i - 1))).t_ns)):
        i += 1
    return (i - begin)

# ---------------- fusiond.filter.strapdown

cdef void strapdown_propagate(State* state, double dt, double* force_b, double* rate_b, Noise* noise) noexcept nogil:
    cdef double _t1
    cdef int64_t parts
    cdef int64_t _part
    _t1 = ceil((dt / 0.05))
    parts = (<int64_t>((_t1 if _t1 > 1.0 else 1.0)))
    for _part in range(parts):
        strapdown__step(state, (dt / parts), force_b, rate_b, noise)

cdef void strapdown__step(State* state, double dt, double* force_b, double* rate_b, Noise* noise) noexcept nogil:
    cdef double* x
    cdef double force[3]
    cdef int _i
    cdef double turn[3]
    cdef double earth_turn[3]
    cdef double velocity_e[3]
    cdef double half_turned[4]
    cdef double _t1[4]
    cdef double _t2[3]
    cdef double middle[4]
    cdef double _t3[4]
    cdef double _t4[3]
    cdef double mat_eb[3 * 3]
    cdef double force_e[3]
    cdef double _t5[3]
    cdef double _t6
    cdef double _t7[3]
    cdef double free[3]
    cdef double _t8
    cdef double half[3]
    cdef double change[3]
    cdef double gradient[3 * 3]
    cdef double turned[4]
    cdef double _t9[4]
    cdef double _t10[4]
    cdef double _t11[4]
    cdef double _t12[4]
    cdef double doubt
    cdef int64_t i
    x = state.nominal
    for _i in range(3):
        force[_i] = (force_b[_i] - (x + 13)[_i])
    for _i in range(3):
        turn[_i] = ((rate_b[_i] - (x + 10)[_i]) * dt)
    earth_turn[0] = 0.0
    earth_turn[1] = 0.0
    earth_turn[2] = (7.292115e-05 * (-dt))
    for _i in range(3):
        velocity_e[_i] = (x + 3)[_i]
    for _i in range(3):
        _t2[_i] = (turn[_i] / 2)
    rotation_quaternion_exp(_t2, _t1)
    rotation_quaternion_multiply(x + 6, _t1, half_turned)
    for _i in range(3):
        _t4[_i] = (earth_turn[_i] / 2)
    rotation_quaternion_exp(_t4, _t3)
    rotation_quaternion_multiply(_t3, half_turned, middle)
    rotation_matrix(middle, mat_eb)
    rotation_times(mat_eb, force, force_e)
    _t6 = (dt / 2)
    for _i in range(3):
        _t7[_i] = (x[_i] + (velocity_e[_i] * _t6))
    wgs84_gravity_e(_t7, _t5)
    for _i in range(3):
        free[_i] = (force_e[_i] + _t5[_i])
    _t8 = (dt / 2)
    for _i in range(3):
        half[_i] = (velocity_e[_i] + (free[_i] * _t8))
    change[0] = ((free[0] + ((2 * 7.292115e-05) * half[1])) * dt)
    change[1] = ((free[1] - ((2 * 7.292115e-05) * half[0])) * dt)
    change[2] = (free[2] * dt)
    strapdown_gravity_gradient(x, gradient)
    for _i in range(3):
        x[_i] += ((velocity_e[_i] + (change[_i] / 2)) * dt)
    for _i in range(3):
        (x + 3)[_i] = (velocity_e[_i] + change[_i])
    rotation_quaternion_exp(earth_turn, _t9)
    rotation_quaternion_exp(turn, _t11)
    rotation_quaternion_multiply(x + 6, _t11, _t10)
    rotation_quaternion_multiply(_t9, _t10, turned)
    rotation_normalised(turned, _t12)
    for _i in range(4):
        (x + 6)[_i] = _t12[_i]
    strapdown__grow(state.covariance, dt, force_e, mat_eb, gradient)
    if state.tracked:
        strapdown__follow(state.transition, dt, force_e, mat_eb, gradient)
    doubt = x[38]
    strapdown__add_noise(state.covariance, dt, (noise.accel + (doubt * 0.01)), (noise.gyro + (doubt * 0.0001)), noise)
    if (doubt > 0):
        for i in range(3):
            state.covariance[((9 + i)) * n + (9 + i)] += ((doubt * 0.0001) * dt)
        x[38] = ((doubt * portable_exp(((-dt) / 1.0))) if (doubt > 0.001) else 0.0)

cdef void strapdown_gravity_gradient(double* position_e, double* out) noexcept nogil:
    cdef double r2
    cdef double strength
    cdef double gradient[3 * 3]
    cdef int64_t i
    cdef int64_t j
    r2 = (((position_e[0] * position_e[0]) + (position_e[1] * position_e[1])) + (position_e[2] * position_e[2]))
    strength = (398600441800000.0 / (r2 * sqrt(r2)))
    for i in range(3):
        for j in range(3):
            gradient[(i) * 3 + j] = (strength * (((3 * (position_e[i] * position_e[j])) / r2) - (1.0 if (i == j) else 0.0)))
    memcpy(out, gradient, 3 * 3 * sizeof(double))
    return

cdef void strapdown__grow(double* p, double dt, double* force_e, double* mat_eb, double* gradient) noexcept nogil:
    cdef double* c
    cdef double* f
    cdef double half_dt2
    cdef double earth_turn
    cdef double rows[9 * n]
    cdef double turned[3 * 9]
    cdef double felt[3 * 9]
    cdef double corner[9 * 9]
    cdef int64_t i
    cdef double _t1
    cdef double _t2
    cdef double _t3
    cdef int _i
    cdef double _t4
    cdef double _t5
    cdef double _t6
    cdef double _t7
    cdef double _t8
    cdef double _t9
    cdef double _t10
    cdef double _t11
    cdef double _t12
    cdef double* pulled
    cdef double _t13
    cdef double _t14
    cdef double _t15
    cdef double _t16
    cdef double _t17
    cdef double _t18
    cdef double _t19
    cdef double _t20
    cdef double _t21
    cdef double _t22
    cdef double _t23
    c = mat_eb
    f = force_e
    half_dt2, earth_turn = ((dt * dt) / 2), (7.292115e-05 * dt)
    strapdown__move_rows(p, dt, f, c, gradient, rows)
    for i in range(3):
        _t1 = c[(i) * 3 + 0]
        _t2 = c[(i) * 3 + 1]
        _t3 = c[(i) * 3 + 2]
        for _i in range(9):
            (turned + (i) * 9)[_i] = (((_t1 * (rows + 9)[_i * n]) + (_t2 * (rows + 10)[_i * n])) + (_t3 * (rows + 11)[_i * n]))
        _t4 = c[(i) * 3 + 0]
        _t5 = c[(i) * 3 + 1]
        _t6 = c[(i) * 3 + 2]
        for _i in range(9):
            (felt + (i) * 9)[_i] = (((_t4 * (rows + 12)[_i * n]) + (_t5 * (rows + 13)[_i * n])) + (_t6 * (rows + 14)[_i * n]))
    _t7 = f[1]
    _t8 = f[2]
    for _i in range(9):
        (felt + (0) * 9)[_i] += ((_t7 * (rows + 8)[_i * n]) - (_t8 * (rows + 7)[_i * n]))
    _t9 = f[2]
    _t10 = f[0]
    for _i in range(9):
        (felt + (1) * 9)[_i] += ((_t9 * (rows + 6)[_i * n]) - (_t10 * (rows + 8)[_i * n]))
    _t11 = f[0]
    _t12 = f[1]
    for _i in range(9):
        (felt + (2) * 9)[_i] += ((_t11 * (rows + 7)[_i * n]) - (_t12 * (rows + 6)[_i * n]))
    for i in range(3):
        pulled = gradient + (i) * 3
        for _i in range(9):
            (corner + (i) * 9)[_i] = (((rows + i)[_i * n] + (dt * (rows + (3 + i))[_i * n])) - (half_dt2 * (felt + (i) * 9)[_i]))
        _t13 = pulled[0]
        _t14 = pulled[1]
        _t15 = pulled[2]
        for _i in range(9):
            (corner + ((3 + i)) * 9)[_i] = (((rows + (3 + i))[_i * n] - (dt * (felt + (i) * 9)[_i])) + (dt * (((_t13 * (rows + 0)[_i * n]) + (_t14 * (rows + 1)[_i * n])) + (_t15 * (rows + 2)[_i * n]))))
        for _i in range(9):
            (corner + ((6 + i)) * 9)[_i] = ((rows + (6 + i))[_i * n] - (dt * (turned + (i) * 9)[_i]))
    _t16 = f[1]
    _t17 = f[2]
    _t18 = (2 * earth_turn)
    for _i in range(9):
        (corner + (3) * 9)[_i] += ((half_dt2 * ((_t16 * (turned + (2) * 9)[_i]) - (_t17 * (turned + (1) * 9)[_i]))) + (_t18 * (rows + 4)[_i * n]))
    _t19 = f[2]
    _t20 = f[0]
    _t21 = (2 * earth_turn)
    for _i in range(9):
        (corner + (4) * 9)[_i] += ((half_dt2 * ((_t19 * (turned + (0) * 9)[_i]) - (_t20 * (turned + (2) * 9)[_i]))) - (_t21 * (rows + 3)[_i * n]))
    _t22 = f[0]
    _t23 = f[1]
    for _i in range(9):
        (corner + (5) * 9)[_i] += (half_dt2 * ((_t22 * (turned + (1) * 9)[_i]) - (_t23 * (turned + (0) * 9)[_i])))
    for _i in range(9):
        (corner + (6) * 9)[_i] += (earth_turn * (rows + 7)[_i * n])
    for _i in range(9):
        (corner + (7) * 9)[_i] -= (earth_turn * (rows + 6)[_i * n])
    for i in range(9):
        for _i in range((9 - i)):
            (p + (i) * n + i)[_i] = (corner + i + (i) * 9)[_i * 9]
        for _i in range((9 - i)):
            (p + i + (i) * n)[_i * n] = (corner + i + (i) * 9)[_i * 9]
        for _i in range((n - 9)):
            (p + (i) * n + 9)[_i] = (rows + (i) * n + 9)[_i]
        for _i in range((n - 9)):
            (p + i + (9) * n)[_i * n] = (rows + (i) * n + 9)[_i]

cdef void strapdown__follow(double* a, double dt, double* force_e, double* mat_eb, double* gradient) noexcept nogil:
    cdef double rows[9 * n]
    cdef int64_t i
    cdef int _i
    strapdown__move_rows(a, dt, force_e, mat_eb, gradient, rows)
    for i in range(9):
        for _i in range(n):
            (a + (i) * n)[_i] = (rows + (i) * n)[_i]

cdef void strapdown__move_rows(double* p, double dt, double* force_e, double* mat_eb, double* gradient, double* rows) noexcept nogil:
    cdef double* c
    cdef double* f
    cdef double half_dt2
    cdef double earth_turn
    cdef double by_gyro[3 * n]
    cdef double by_force[3 * n]
    cdef int64_t i
    cdef double _t1
    cdef double _t2
    cdef double _t3
    cdef int _i
    cdef double _t4
    cdef double _t5
    cdef double _t6
    cdef double _t7
    cdef double _t8
    cdef double _t9
    cdef double _t10
    cdef double _t11
    cdef double _t12
    cdef double* pulled
    cdef double _t13
    cdef double _t14
    cdef double _t15
    cdef double _t16
    cdef double _t17
    cdef double _t18
    cdef double _t19
    cdef double _t20
    cdef double _t21
    cdef double _t22
    cdef double _t23
    cdef double _t24
    cdef double _t25
    c = mat_eb
    f = force_e
    half_dt2, earth_turn = ((dt * dt) / 2), (7.292115e-05 * dt)
    for i in range(3):
        _t1 = c[(i) * 3 + 0]
        _t2 = c[(i) * 3 + 1]
        _t3 = c[(i) * 3 + 2]
        for _i in range(n):
            (by_gyro + (i) * n)[_i] = (((_t1 * (p + (9) * n)[_i]) + (_t2 * (p + (10) * n)[_i])) + (_t3 * (p + (11) * n)[_i]))
        _t4 = c[(i) * 3 + 0]
        _t5 = c[(i) * 3 + 1]
        _t6 = c[(i) * 3 + 2]
        for _i in range(n):
            (by_force + (i) * n)[_i] = (((_t4 * (p + (12) * n)[_i]) + (_t5 * (p + (13) * n)[_i])) + (_t6 * (p + (14) * n)[_i]))
    _t7 = f[1]
    _t8 = f[2]
    for _i in range(n):
        (by_force + (0) * n)[_i] += ((_t7 * (p + (8) * n)[_i]) - (_t8 * (p + (7) * n)[_i]))
    _t9 = f[2]
    _t10 = f[0]
    for _i in range(n):
        (by_force + (1) * n)[_i] += ((_t9 * (p + (6) * n)[_i]) - (_t10 * (p + (8) * n)[_i]))
    _t11 = f[0]
    _t12 = f[1]
    for _i in range(n):
        (by_force + (2) * n)[_i] += ((_t11 * (p + (7) * n)[_i]) - (_t12 * (p + (6) * n)[_i]))
    for i in range(3):
        for _i in range(n):
            (rows + (i) * n)[_i] = (((p + (i) * n)[_i] + (dt * (p + ((3 + i)) * n)[_i])) - (half_dt2 * (by_force + (i) * n)[_i]))
        pulled = gradient + (i) * 3
        _t13 = pulled[0]
        _t14 = pulled[1]
        _t15 = pulled[2]
        for _i in range(n):
            (rows + ((3 + i)) * n)[_i] = (((p + ((3 + i)) * n)[_i] - (dt * (by_force + (i) * n)[_i])) + (dt * (((_t13 * (p + (0) * n)[_i]) + (_t14 * (p + (1) * n)[_i])) + (_t15 * (p + (2) * n)[_i]))))
        for _i in range(n):
            (rows + ((6 + i)) * n)[_i] = ((p + ((6 + i)) * n)[_i] - (dt * (by_gyro + (i) * n)[_i]))
    _t16 = f[1]
    _t17 = f[2]
    _t18 = (2 * earth_turn)
    for _i in range(n):
        (rows + (3) * n)[_i] += ((half_dt2 * ((_t16 * (by_gyro + (2) * n)[_i]) - (_t17 * (by_gyro + (1) * n)[_i]))) + (_t18 * (p + (4) * n)[_i]))
    _t19 = f[2]
    _t20 = f[0]
    _t21 = (2 * earth_turn)
    for _i in range(n):
        (rows + (4) * n)[_i] += ((half_dt2 * ((_t19 * (by_gyro + (0) * n)[_i]) - (_t20 * (by_gyro + (2) * n)[_i]))) - (_t21 * (p + (3) * n)[_i]))
    _t22 = f[0]
    _t23 = f[1]
    _t24 = f[0]
    _t25 = f[1]
    for _i in range(n):
        (rows + (5) * n)[_i] += (half_dt2 * ((_t24 * (by_gyro + (1) * n)[_i]) - (_t25 * (by_gyro + (0) * n)[_i])))
    axpy(rows + (6) * n, earth_turn, p + (7) * n)
    for _i in range(n):
        (rows + (7) * n)[_i] -= (earth_turn * (p + (6) * n)[_i])

cdef void strapdown__add_noise(double* p, double dt, double accel, double gyro, Noise* noise) noexcept nogil:
    cdef int64_t i
    strapdown_add_white_noise(p, dt, accel, gyro)
    for i in range(3):
        p[((12 + i)) * n + (12 + i)] += (noise.accel_bias * dt)
        p[((9 + i)) * n + (9 + i)] += (noise.gyro_bias * dt)
    for i in range(15, n):
        p[(i) * n + i] += (noise.calibrations[(i - 15)] * dt)

cdef void strapdown_add_white_noise(double* p, double dt, double accel, double gyro) noexcept nogil:
    cdef double cubic
    cdef double quadratic
    cdef int64_t i
    cubic, quadratic = ((((accel * dt) * dt) / 3) * dt), (((accel * dt) * dt) / 2)
    for i in range(3):
        p[((0 + i)) * n + (0 + i)] += cubic
        p[((3 + i)) * n + (3 + i)] += (accel * dt)
        p[((6 + i)) * n + (6 + i)] += (gyro * dt)
        p[((0 + i)) * n + (3 + i)] += quadratic
        p[((3 + i)) * n + (0 + i)] += quadratic

cdef void strapdown_coast(State* state, double dt, Noise* noise, bint rests) noexcept nogil:
    cdef double _t1
    cdef int64_t parts
    cdef int64_t _part
    _t1 = ceil((dt / 0.05))
    parts = (<int64_t>((_t1 if _t1 > 1.0 else 1.0)))
    for _part in range(parts):
        strapdown__coast(state, (dt / parts), noise, rests)

cdef void strapdown__coast(State* state, double dt, Noise* noise, bint rests) noexcept nogil:
    cdef double* x
    cdef double* p
    cdef int _i
    cdef int64_t i
    cdef double* r
    cdef double _t1
    cdef double up_e[3]
    cdef double sideways_e[3]
    cdef double turned[n]
    cdef double displaced[n]
    cdef double first
    cdef double second
    cdef double third
    cdef double _t2
    cdef double _t3
    cdef double _t4
    cdef double _t5
    x = state.nominal
    p = state.covariance
    for _i in range(3):
        x[_i] += ((x + 3)[_i] * dt)
    for i in range(3):
        axpy(p + (i) * n, dt, p + ((3 + i)) * n)
    for i in range(3):
        for _i in range(n):
            (p + i)[_i * n] += (dt * (p + (3 + i))[_i * n])
    linear_mirror(p)
    if state.tracked:
        for i in range(3):
            axpy(state.transition + (i) * n, dt, state.transition + ((3 + i)) * n)
    strapdown__add_noise(p, dt, (0.0 if rests else portable_square(2.0)), portable_square(0.03), noise)
    if rests:
        return
    r = x
    _t1 = sqrt((((r[0] * r[0]) + (r[1] * r[1])) + (r[2] * r[2])))
    for _i in range(3):
        up_e[_i] = (r[_i] / _t1)
    if (state.stamps[10] == 2):
        strapdown_begin_coasting(state)
        strapdown__turn(state, dt, up_e)
        linear_mirror(p)
        return
    rotation_cross(up_e, x + 3, sideways_e)
    memset(turned, 0, n * sizeof(double))
    memset(displaced, 0, n * sizeof(double))
    for _i in range(3):
        (turned + 6)[_i] = up_e[_i]
    for _i in range(3):
        (turned + 3)[_i] = sideways_e[_i]
    for _i in range(3):
        displaced[_i] = sideways_e[_i]
    first, second = (portable_square(0.3) * dt), (portable_square(0.3) * ((dt * dt) / 2))
    third = (portable_square(0.3) * (((dt * dt) * dt) / 3))
    for i in range(n):
        _t2 = (first * turned[i])
        _t3 = (third * displaced[i])
        _t4 = turned[i]
        _t5 = displaced[i]
        for _i in range(n):
            (p + (i) * n)[_i] += (((_t2 * turned[_i]) + (_t3 * displaced[_i])) + (second * ((_t4 * displaced[_i]) + (_t5 * turned[_i]))))
    linear_mirror(p)

cdef void strapdown_begin_coasting(State* state) noexcept nogil:
    cdef double* a
    cdef double* p
    cdef int64_t bias
    cdef int _i
    cdef int64_t i
    cdef int64_t j
    a = state.auxiliary
    p = state.covariance
    bias = 9
    if (a[73] == 0.0):
        a[73] = 1.0
        for _i in range(3):
            (a + 74)[_i] = (state.nominal + 10)[_i]
        for i in range(3):
            for j in range(3):
                a[((77 + (3 * i)) + j)] = p[((bias + i)) * n + (bias + j)]
    for _i in range(3):
        (a + 9)[_i] -= ((state.nominal + 10)[_i] - (a + 74)[_i])
    for _i in range(3):
        (state.nominal + 10)[_i] = (a + 74)[_i]
    a[36] = (0.05 * 0.05)

cdef void strapdown_end_coasting(State* state) noexcept nogil:
    cdef double* a
    cdef double* p
    cdef int64_t bias
    cdef int _i
    cdef int64_t i
    cdef int64_t j
    a = state.auxiliary
    p = state.covariance
    bias = 9
    if (a[73] == 0.0):
        return
    a[73] = 0.0
    for _i in range(3):
        (state.nominal + 10)[_i] = (a + 74)[_i]
    for i in range(3):
        for _i in range(n):
            (p + ((bias + i)) * n)[_i] = 0.0
        for _i in range(n):
            (p + (bias + i))[_i * n] = 0.0
    for i in range(3):
        for j in range(3):
            p[((bias + i)) * n + (bias + j)] = a[((77 + (3 * i)) + j)]
    if state.tracked:
        for i in range(3):
            for _i in range(n):
                (state.transition + ((bias + i)) * n)[_i] = 0.0

cdef void strapdown__turn(State* state, double dt, double* up_e) noexcept nogil:
    cdef double* x
    cdef double* p
    cdef double* a
    cdef int64_t bias
    cdef double c[3 * 3]
    cdef double rate_b[3]
    cdef int _i
    cdef double up_b[3]
    cdef double speed
    cdef double turn[4]
    cdef double _t1
    cdef double _t2[3]
    cdef double mat[3 * 3]
    cdef double _t3[3]
    cdef double _t4[4]
    cdef double _t5[4]
    cdef double sideways_e[3]
    cdef double rows[6 * n]
    cdef int64_t i
    cdef double columns[6 * n]
    cdef double _t6
    cdef double _t7
    cdef double _t8
    cdef double by_rate[n]
    cdef double along
    cdef double across
    cdef double _t9
    cdef double _t10
    cdef double _t11
    cdef double _t12
    cdef double _t13
    cdef double _t14
    cdef double kept
    cdef double fresh
    cdef int64_t j
    x = state.nominal
    p = state.covariance
    a = state.auxiliary
    bias = 9
    rotation_matrix(x + 6, c)
    for _i in range(3):
        rate_b[_i] = ((a + 9)[_i] - (x + 10)[_i])
    rotation_transposed_times(c, up_e, up_b)
    speed = (((up_b[0] * rate_b[0]) + (up_b[1] * rate_b[1])) + (up_b[2] * rate_b[2]))
    _t1 = (speed * dt)
    for _i in range(3):
        _t2[_i] = (up_e[_i] * _t1)
    rotation_quaternion_exp(_t2, turn)
    rotation_matrix(turn, mat)
    rotation_times(mat, x + 3, _t3)
    for _i in range(3):
        (x + 3)[_i] = _t3[_i]
    rotation_quaternion_multiply(turn, x + 6, _t5)
    rotation_normalised(_t5, _t4)
    for _i in range(4):
        (x + 6)[_i] = _t4[_i]
    rotation_cross(up_e, x + 3, sideways_e)
    strapdown__turn_rows(p, dt, mat, up_e, up_b, sideways_e, rows)
    for i in range(6):
        for _i in range(n):
            (p + ((3 + i)) * n)[_i] = (rows + (i) * n)[_i]
    if state.tracked:
        strapdown__turn_rows(state.transition, dt, mat, up_e, up_b, sideways_e, rows)
        for i in range(6):
            for _i in range(n):
                (state.transition + ((3 + i)) * n)[_i] = (rows + (i) * n)[_i]
    _t6 = up_b[0]
    _t7 = up_b[1]
    _t8 = up_b[2]
    for _i in range(n):
        by_rate[_i] = (((_t6 * (p + bias)[_i * n]) + (_t7 * (p + (bias + 1))[_i * n])) + (_t8 * (p + (bias + 2))[_i * n]))
    for i in range(3):
        along, across = ((-dt) * sideways_e[i]), ((-dt) * up_e[i])
        _t9 = mat[(i) * 3 + 0]
        _t10 = mat[(i) * 3 + 1]
        _t11 = mat[(i) * 3 + 2]
        for _i in range(n):
            (columns + (i) * n)[_i] = ((((_t9 * (p + 3)[_i * n]) + (_t10 * (p + 4)[_i * n])) + (_t11 * (p + 5)[_i * n])) + (along * by_rate[_i]))
        _t12 = mat[(i) * 3 + 0]
        _t13 = mat[(i) * 3 + 1]
        _t14 = mat[(i) * 3 + 2]
        for _i in range(n):
            (columns + ((3 + i)) * n)[_i] = ((((_t12 * (p + 6)[_i * n]) + (_t13 * (p + 7)[_i * n])) + (_t14 * (p + 8)[_i * n])) + (across * by_rate[_i]))
    for i in range(6):
        for _i in range(n):
            (p + (3 + i))[_i * n] = (columns + (i) * n)[_i]
    kept = portable_exp(((-dt) / 1.5))
    for i in range(3):
        for _i in range(n):
            (p + ((bias + i)) * n)[_i] *= kept
    for i in range(3):
        for _i in range(n):
            (p + (bias + i))[_i * n] *= kept
    if state.tracked:
        for i in range(3):
            for _i in range(n):
                (state.transition + ((bias + i)) * n)[_i] *= kept
    fresh = (portable_square(0.25) * (1 - (kept * kept)))
    for i in range(3):
        a[(9 + i)] = (x[(10 + i)] + ((speed * kept) * up_b[i]))
        for j in range(3):
            p[((bias + i)) * n + (bias + j)] += ((fresh * up_b[i]) * up_b[j])

cdef void strapdown__turn_rows(double* p, double dt, double* mat, double* up_e, double* up_b, double* sideways_e, double* rows) noexcept nogil:
    cdef int64_t bias
    cdef double _t1
    cdef double _t2
    cdef double _t3
    cdef double by_rate[n]
    cdef int _i
    cdef int64_t i
    cdef double along
    cdef double across
    cdef double _t4
    cdef double _t5
    cdef double _t6
    cdef double _t7
    cdef double _t8
    cdef double _t9
    bias = 9
    _t1 = up_b[0]
    _t2 = up_b[1]
    _t3 = up_b[2]
    for _i in range(n):
        by_rate[_i] = (((_t1 * (p + (bias) * n)[_i]) + (_t2 * (p + ((bias + 1)) * n)[_i])) + (_t3 * (p + ((bias + 2)) * n)[_i]))
    for i in range(3):
        along, across = ((-dt) * sideways_e[i]), ((-dt) * up_e[i])
        _t4 = mat[(i) * 3 + 0]
        _t5 = mat[(i) * 3 + 1]
        _t6 = mat[(i) * 3 + 2]
        for _i in range(n):
            (rows + (i) * n)[_i] = ((((_t4 * (p + (3) * n)[_i]) + (_t5 * (p + (4) * n)[_i])) + (_t6 * (p + (5) * n)[_i])) + (along * by_rate[_i]))
        _t7 = mat[(i) * 3 + 0]
        _t8 = mat[(i) * 3 + 1]
        _t9 = mat[(i) * 3 + 2]
        for _i in range(n):
            (rows + ((3 + i)) * n)[_i] = ((((_t7 * (p + (6) * n)[_i]) + (_t8 * (p + (7) * n)[_i])) + (_t9 * (p + (8) * n)[_i])) + (across * by_rate[_i]))
