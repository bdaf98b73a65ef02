"""The compiled kernel for `n` error states; included by the files that say how many that is.

Its NumPy twin is the reference: the same equations in the same order, held together by tests. It is built without fused
multiply-add and calls nothing of the C library but the square root, so it gives the same bits on every x86-64.
"""

from libc.math cimport INFINITY, floor, fabs, sqrt, ldexp, isfinite
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memmove, memset

from fusiond import state as layout
from fusiond import answer as answers
from fusiond import alignment, bank, elementary, health, kernel, measure, motion, observe, strapdown, update as updates
from fusiond.earth import GRAVITY_RATIO as _GRAVITY_RATIO
from fusiond.kernel import Outcome
from fusiond.observe import wheel_speed
from numpy import empty

cdef enum:
    VALUES = 8
    PARAMETERS = 16

cdef struct Row:
    int64_t t_ns
    int64_t sequence
    int64_t t_receive_ns
    int32_t source
    int32_t outcome
    double ratio
    double values[VALUES]
    double innovation[3]
    double variance[3]

cdef extern from *:
    """
    typedef double *__restrict__ vector;  /* n numbers that nothing else points to: lets the loops use vector units */
    """
    ctypedef double* vector

cdef struct Noise:
    double accel, gyro, accel_bias, gyro_bias
    double calibrations[n - 15]

# The layout of fusiond.state, as offsets. `check_layout` holds them to it.
cdef enum:
    POSITION_E = 0
    VELOCITY_E = 3
    QUATERNION_EB = 6
    GYRO_BIAS_B = 10
    ACCEL_BIAS_B = 13
    WHEEL_SCALE = 16
    MOUNT = 17
    ANTENNA_B = 22
    DELAYS = 25
    NOMINAL_SIZE = 28
    POSITION = 0
    VELOCITY = 3
    ATTITUDE = 6
    GYRO_BIAS = 9
    ACCEL_BIAS = 12
    SCALE = 15
    MOUNT_ERROR = 16
    CALIBRATIONS = 15
    ANSWER_SIZE = 91
    ANTENNA_ERROR = 21  # from here on only in the wide state
    DELAYS_ERROR = 24
    WIDE_SIZE = 27
    HELD_FORCE_B = 0
    HELD_RATE_B = 3
    FORCE_B = 6
    RATE_B = 9
    MEAN_FORCE_B = 12
    MEAN_RATE_B = 15
    SCATTER_FORCE = 18
    SCATTER_RATE = 19
    MEAN_WEIGHT = 20
    REST_RATE_B = 21
    FIRST_VELOCITY_N = 24
    CONSTRAINT_RATIO = 32
    RATE_VARIANCE = 35
    SMOOTH_FORCE_B = 36
    AUXILIARY_SIZE = 39
    LAST_VALUE = 0
    LAST_RATIO = 1
    NOISE_EXCESS = 2
    NOMINAL = 3
    NOISY = 4
    BIASED = 5
    FROZEN = 6
    BIAS = 7
    BIAS_VARIANCE = 10
    LAST_SUM = 11
    INTERVAL = 12
    LAST_INNOVATION = 13
    MEAN_NIS = 16
    MEMORY_SIZE = 17
    T = 0
    T_IMU = 1
    T_CONSTRAINT = 2
    T_STILL = 3
    T_POSITION = 4
    T_FIRST_VELOCITY = 5
    T_REST = 7
    PHASE = 9
    RESETS = 10
    CONSTRAINT_FUSED = 11
    CONSTRAINT_REJECTED = 14
    BLOWN = 17
    STAMPS_SIZE = 18
    T_LAST = 0
    T_FUSED = 1
    T_REJECTED = 2
    T_JUDGED = 3
    T_ALIKE = 4
    T_BACK = 5
    SOURCE_STAMPS_SIZE = 6
    ALIGNING = 1
    RUNNING = 2
    CHOOSING = 3
    HYPOTHESES = 13
    BLOCK = 1 + NOMINAL_SIZE + n * n  # numbers of a hypothesis: weight, nominal, covariance
    FUSED = 0
    REJECTED = 1
    DUPLICATE = 3
    WAITING = 5
    IMU = -1
    GNSS_POSITION = 0
    GNSS_VELOCITY = 1
    WHEEL_SPEED = 2
    NOISE_LEAST = 8
    NOISE_MOST = 9
    SHARED = 10
    COMPANION = 11
    CLUTTER = 12
    COMPILED = 3  # models that this kernel knows; others stop it, and the twin takes one step

cdef int64_t NEVER = -(<int64_t>1 << 62)

cdef double SEMI_MAJOR = 6378137.0
cdef double FLATTENING = 1 / 298.257223563
cdef double SEMI_MINOR = SEMI_MAJOR * (1 - FLATTENING)
cdef double ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
cdef double SECOND_ECCENTRICITY2 = ECCENTRICITY2 / (1 - ECCENTRICITY2)
cdef double EARTH_RATE = 7.292115e-5
cdef double GRAVITATIONAL_CONSTANT = 3.986004418e14
cdef double EQUATOR_GRAVITY = 9.7803253359
cdef double SOMIGLIANA = 0.00193185265241
cdef double GRAVITY_RATIO = _GRAVITY_RATIO
cdef double COAST_ACCEL2 = strapdown.COAST_ACCEL * strapdown.COAST_ACCEL
cdef double COAST_RATE2 = strapdown.COAST_RATE * strapdown.COAST_RATE
cdef double LONGEST_STEP = strapdown.LONGEST_STEP
cdef double OWN_SCATTER = motion.OWN_SCATTER
cdef double LEAST_SPAN = kernel.LEAST_SPAN
cdef double SMOOTH_TIME = motion.SMOOTH_TIME
cdef double MEAN_TIME = motion.MEAN_TIME
cdef double MEAN_FILLED = motion.MEAN_FILLED
cdef int64_t WHEEL_FRESH_NS = motion.WHEEL_FRESH_NS
cdef int64_t WINDOW_MOST_NS = alignment.WINDOW_MOST_NS
cdef double LEAST_TRACK_SPEED = wheel_speed.LEAST_TRACK_SPEED
cdef double SURE_SPEED = wheel_speed.SURE_SPEED
cdef double DIRECTION_ALIKE = wheel_speed.DIRECTION_ALIKE
cdef int64_t GNSS_FRESH_NS = motion.GNSS_FRESH_NS
cdef double CARRIED = motion.CARRIED
cdef double UNIFORM = updates.UNIFORM
cdef double NEGLIGIBLE = updates.NEGLIGIBLE
cdef int64_t BREAK_NS = measure.BREAK_NS
cdef int64_t OUTAGE_NS = measure.OUTAGE_NS
cdef int64_t SUSPECT = measure.SUSPECT
cdef double NEAR = measure.NEAR
cdef int64_t JUDGE_NS = health.JUDGE_NS
cdef double KEEPS = health.KEEPS
cdef double PRIOR[4]
PRIOR[:] = health.PRIOR
cdef double OUTLIERS = health.OUTLIERS
cdef double LEAST_WEIGHT = bank.LEAST_WEIGHT
cdef double BANK_CLUTTER = bank.CLUTTER
cdef double BANK_FAR = bank.FAR
cdef double BANK_DOUBT = bank.DOUBT
cdef double OUTLIER_VARIANCE = health.OUTLIER_VARIANCE
cdef double NOISY_VARIANCE = health.NOISY_VARIANCE
cdef double FIRST_BIAS_VARIANCE = health.FIRST_BIAS_VARIANCE
cdef double BIAS_WALK = health.BIAS_WALK
cdef double FARTHEST = health.FARTHEST
cdef double LEAST_BIAS = health.LEAST_BIAS
cdef double SAME_IF_NOMINAL = health.SAME_IF_NOMINAL
cdef double SAME_IF_FAULTY = health.SAME_IF_FAULTY
cdef double OTHER_IF_FROZEN = health.OTHER_IF_FROZEN
cdef double TELLING = health.TELLING
cdef double CHANCE = health.CHANCE
cdef double NOTED = health.NOTED
cdef double DISTRUST = health.DISTRUST
cdef double NOISE_TIME = health.NOISE_TIME
cdef double CLIPPED = health.CLIPPED
cdef double INTERVAL_SHARE = health.INTERVAL_SHARE
cdef double NIS_TIME = health.NIS_TIME
cdef double PI = 3.141592653589793
cdef double PI_LOW = elementary.PI_LOW
cdef double HALF_PI_HIGH = elementary.HALF_PI_HIGH
cdef double HALF_PI_LOW = elementary.HALF_PI_LOW
cdef double ATAN[11]
ATAN[:] = elementary.ATAN


def check_layout():
    """The offsets above against fusiond.state; an AssertionError names what moved."""
    for name, offset in (
        ("POSITION_E", POSITION_E), ("VELOCITY_E", VELOCITY_E), ("QUATERNION_EB", QUATERNION_EB),
        ("GYRO_BIAS_B", GYRO_BIAS_B), ("ACCEL_BIAS_B", ACCEL_BIAS_B), ("WHEEL_SCALE", WHEEL_SCALE), ("MOUNT", MOUNT),
        ("POSITION", POSITION), ("VELOCITY", VELOCITY), ("ATTITUDE", ATTITUDE), ("GYRO_BIAS", GYRO_BIAS),
        ("ACCEL_BIAS", ACCEL_BIAS), ("SCALE", SCALE), ("MOUNT_ERROR", MOUNT_ERROR), ("HELD_FORCE_B", HELD_FORCE_B),
        ("HELD_RATE_B", HELD_RATE_B), ("FORCE_B", FORCE_B), ("RATE_B", RATE_B), ("MEAN_FORCE_B", MEAN_FORCE_B),
        ("MEAN_RATE_B", MEAN_RATE_B), ("CONSTRAINT_RATIO", CONSTRAINT_RATIO), ("CONSTRAINT_FUSED", CONSTRAINT_FUSED),
        ("CONSTRAINT_REJECTED", CONSTRAINT_REJECTED),
        ("BIAS", BIAS), ("LAST_INNOVATION", LAST_INNOVATION), ("BELIEF", NOMINAL), ("ANTENNA_B", ANTENNA_B), ("SMOOTH_FORCE_B", SMOOTH_FORCE_B), ("DELAYS", DELAYS), ("ANTENNA_ERROR", ANTENNA_ERROR), ("DELAYS_ERROR", DELAYS_ERROR),
        ("REST_RATE_B", REST_RATE_B), ("FIRST_VELOCITY_N", FIRST_VELOCITY_N),
    ):
        assert getattr(layout, name).start == offset, name
    for name, number in (
        ("NOMINAL_SIZE", NOMINAL_SIZE), ("CALIBRATIONS", CALIBRATIONS), ("WIDE_SIZE", WIDE_SIZE), ("SCATTER_FORCE", SCATTER_FORCE), ("SCATTER_RATE", SCATTER_RATE),
        ("MEAN_WEIGHT", MEAN_WEIGHT), ("RATE_VARIANCE", RATE_VARIANCE), ("AUXILIARY_SIZE", AUXILIARY_SIZE), ("LAST_VALUE", LAST_VALUE),
        ("LAST_RATIO", LAST_RATIO), ("NOISE_EXCESS", NOISE_EXCESS), ("NOMINAL", NOMINAL), ("NOISY", NOISY),
        ("BIASED", BIASED), ("FROZEN", FROZEN), ("BIAS_VARIANCE", BIAS_VARIANCE), ("LAST_SUM", LAST_SUM),
        ("INTERVAL", INTERVAL), ("MEAN_NIS", MEAN_NIS), ("T_JUDGED", T_JUDGED), ("T_ALIKE", T_ALIKE), ("T_BACK", T_BACK), ("MEMORY_SIZE", MEMORY_SIZE), ("T", T), ("T_IMU", T_IMU),
        ("T_CONSTRAINT", T_CONSTRAINT), ("T_STILL", T_STILL), ("T_POSITION", T_POSITION),
        ("T_FIRST_VELOCITY", T_FIRST_VELOCITY), ("T_REST", T_REST), ("ALIGNING", ALIGNING), ("PHASE", PHASE),
        ("RESETS", RESETS), ("BLOWN", BLOWN), ("STAMPS_SIZE", STAMPS_SIZE), ("T_LAST", T_LAST), ("T_FUSED", T_FUSED),
        ("T_REJECTED", T_REJECTED), ("SOURCE_STAMPS_SIZE", SOURCE_STAMPS_SIZE), ("RUNNING", RUNNING), ("CHOOSING", CHOOSING), ("HYPOTHESES", HYPOTHESES), ("NEVER", NEVER),
    ):
        assert getattr(layout, name) == number, name
    assert [model.name for model in observe.MODELS[:COMPILED]] == ["gnss_position", "gnss_velocity", "wheel_speed"]
    for name, number in (
        ("NOISE_LEAST", NOISE_LEAST), ("NOISE_MOST", NOISE_MOST), ("SHARED", SHARED), ("COMPANION", COMPANION),
        ("CLUTTER", CLUTTER), ("PARAMETERS", PARAMETERS), ("VALUES", VALUES),
    ):
        assert getattr(observe.model, name) == number, name
    assert answers.ANSWER_SIZE == ANSWER_SIZE
    assert (Outcome.FUSED, Outcome.REJECTED) == (FUSED, REJECTED)
    assert (Outcome.DUPLICATE, Outcome.WAITING) == (DUPLICATE, WAITING)


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


# ---------------------------------------------------------------- propagation (fusiond.strapdown)

cdef void add_noise(double* p, double dt, double accel, double gyro, Noise* noise) noexcept nogil:
    cdef int i
    cdef double cubic = accel * dt * dt / 3 * dt, square = accel * dt * dt / 2
    for i in range(3):
        p[(POSITION + i) * (n + 1)] += cubic
        p[(VELOCITY + i) * (n + 1)] += accel * dt
        p[(ATTITUDE + i) * (n + 1)] += gyro * dt
        p[(ACCEL_BIAS + i) * (n + 1)] += noise.accel_bias * dt
        p[(GYRO_BIAS + i) * (n + 1)] += noise.gyro_bias * dt
        p[(POSITION + i) * n + VELOCITY + i] += square
        p[(VELOCITY + i) * n + POSITION + i] += square
    for i in range(n - CALIBRATIONS):
        p[(CALIBRATIONS + i) * (n + 1)] += noise.calibrations[i] * dt


cdef inline void axpy(vector to, double factor, vector row) noexcept nogil:
    cdef int j
    for j in range(n):
        to[j] += factor * row[j]


cdef void propagate_step(double* x, double* p, double dt, double* force_b, double* rate_b,
                         Noise* noise) noexcept nogil:
    cdef double force[3]
    cdef double turn[3]
    cdef double earth[3]
    cdef double half[3]
    cdef double q1[4]
    cdef double q2[4]
    cdef double q3[4]
    cdef double c[9]
    cdef double f[3]
    cdef double v[3]
    cdef double g[3]
    cdef double free[3]
    cdef double there[3]
    cdef double change[3]
    cdef double grad[9]
    cdef double r2, strength
    cdef int i, j
    for i in range(3):
        force[i] = force_b[i] - x[ACCEL_BIAS_B + i]
        turn[i] = (rate_b[i] - x[GYRO_BIAS_B + i]) * dt
        earth[i] = 0.0
        v[i] = x[VELOCITY_E + i]
    earth[2] = EARTH_RATE * -dt
    # attitude at the middle of the interval
    for i in range(3):
        half[i] = turn[i] / 2
    quaternion_exp(half, q1)
    quaternion_multiply(x + QUATERNION_EB, q1, q2)
    for i in range(3):
        half[i] = earth[i] / 2
    quaternion_exp(half, q1)
    quaternion_multiply(q1, q2, q3)
    matrix(q3, c)
    times(c, force, f)
    for i in range(3):
        there[i] = x[POSITION_E + i] + v[i] * (dt / 2)
    gravity_e(there, g)
    for i in range(3):
        free[i] = f[i] + g[i]
        half[i] = v[i] + free[i] * (dt / 2)
    # - 2 omega x v, with omega along z
    change[0] = (free[0] + 2 * EARTH_RATE * half[1]) * dt
    change[1] = (free[1] - 2 * EARTH_RATE * half[0]) * dt
    change[2] = free[2] * dt
    r2 = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
    strength = GRAVITATIONAL_CONSTANT / (r2 * sqrt(r2))
    for i in range(3):
        for j in range(3):
            grad[3 * i + j] = strength * (3 * (x[i] * x[j]) / r2 - (1.0 if i == j else 0.0))
    for i in range(3):
        x[POSITION_E + i] += (v[i] + change[i] / 2) * dt
        x[VELOCITY_E + i] = v[i] + change[i]
    quaternion_exp(turn, q1)
    quaternion_multiply(x + QUATERNION_EB, q1, q2)
    quaternion_exp(earth, q1)
    quaternion_multiply(q1, q2, q3)
    normalise(q3)
    memcpy(x + QUATERNION_EB, q3, 4 * sizeof(double))

    grow(p, dt, f, c, grad)
    add_noise(p, dt, noise.accel, noise.gyro, noise)


cdef void carry(double* out, double* row, double dt, double* f, double* c, double* grad) noexcept nogil:
    """Phi times one column: the nine numbers of position, velocity, attitude, from a column of n (given as a row)."""
    cdef double u[3]
    cdef double g[3]
    cdef double dt2 = dt * dt / 2, turn = EARTH_RATE * dt
    cdef int i
    for i in range(3):
        g[i] = c[3 * i] * row[GYRO_BIAS] + c[3 * i + 1] * row[GYRO_BIAS + 1] + c[3 * i + 2] * row[GYRO_BIAS + 2]
        u[i] = c[3 * i] * row[ACCEL_BIAS] + c[3 * i + 1] * row[ACCEL_BIAS + 1] + c[3 * i + 2] * row[ACCEL_BIAS + 2]
    u[0] += f[1] * row[ATTITUDE + 2] - f[2] * row[ATTITUDE + 1]
    u[1] += f[2] * row[ATTITUDE] - f[0] * row[ATTITUDE + 2]
    u[2] += f[0] * row[ATTITUDE + 1] - f[1] * row[ATTITUDE]
    for i in range(3):
        out[i] = row[i] + dt * row[VELOCITY + i] - dt2 * u[i]
        out[3 + i] = row[VELOCITY + i] - dt * u[i] + dt * (
            grad[3 * i] * row[0] + grad[3 * i + 1] * row[1] + grad[3 * i + 2] * row[2])
        out[6 + i] = row[ATTITUDE + i] - dt * g[i]
    out[3] += dt2 * (f[1] * g[2] - f[2] * g[1]) + 2 * turn * row[VELOCITY + 1]
    out[4] += dt2 * (f[2] * g[0] - f[0] * g[2]) - 2 * turn * row[VELOCITY]
    out[5] += dt2 * (f[0] * g[1] - f[1] * g[0])
    out[6] += turn * row[ATTITUDE + 1]
    out[7] -= turn * row[ATTITUDE]


cdef void grow(double* p, double dt, double* f, double* c, double* grad) noexcept nogil:
    """P = Phi P Phi'. Only the rows and columns of position, velocity and attitude change, and of these only the corner
    where they meet needs both factors. The rows are written out so that the compiler can use vector units."""
    cdef double top[9 * n]
    cdef double u[3 * n]
    cdef double g[3 * n]
    cdef double done[9]
    cdef double dt2 = dt * dt / 2, turn = EARTH_RATE * dt
    cdef int i, j, k
    for i in range(3):
        for j in range(n):
            g[i * n + j] = (c[3 * i] * p[9 * n + j] + c[3 * i + 1] * p[10 * n + j] + c[3 * i + 2] * p[11 * n + j])
            u[i * n + j] = (c[3 * i] * p[12 * n + j] + c[3 * i + 1] * p[13 * n + j] + c[3 * i + 2] * p[14 * n + j])
    for j in range(n):
        u[j] += f[1] * p[8 * n + j] - f[2] * p[7 * n + j]
        u[n + j] += f[2] * p[6 * n + j] - f[0] * p[8 * n + j]
        u[2 * n + j] += f[0] * p[7 * n + j] - f[1] * p[6 * n + j]
    for i in range(3):
        for j in range(n):
            top[i * n + j] = p[i * n + j] + dt * p[(3 + i) * n + j] - dt2 * u[i * n + j]
            top[(3 + i) * n + j] = p[(3 + i) * n + j] - dt * u[i * n + j] + dt * (
                grad[3 * i] * p[j] + grad[3 * i + 1] * p[n + j] + grad[3 * i + 2] * p[2 * n + j])
            top[(6 + i) * n + j] = p[(6 + i) * n + j] - dt * g[i * n + j]
    for j in range(n):
        top[3 * n + j] += dt2 * (f[1] * g[2 * n + j] - f[2] * g[n + j]) + 2 * turn * p[4 * n + j]
        top[4 * n + j] += dt2 * (f[2] * g[j] - f[0] * g[2 * n + j]) - 2 * turn * p[3 * n + j]
        top[5 * n + j] += dt2 * (f[0] * g[n + j] - f[1] * g[j])
        top[6 * n + j] += turn * p[7 * n + j]
        top[7 * n + j] -= turn * p[6 * n + j]
    for i in range(9):
        carry(done, top + i * n, dt, f, c, grad)
        for j in range(i, 9):
            p[i * n + j] = done[j]
            p[j * n + i] = done[j]
        for j in range(9, n):
            p[i * n + j] = top[i * n + j]
            p[j * n + i] = top[i * n + j]


cdef void propagate(double* x, double* p, double dt, double* force_b, double* rate_b,
                    Noise* noise) noexcept nogil:
    cdef double steps = dt / LONGEST_STEP
    cdef int parts = <int>steps, i
    if parts < steps:
        parts += 1
    if parts < 1:
        parts = 1
    for i in range(parts):
        propagate_step(x, p, dt / parts, force_b, rate_b, noise)


cdef void coast(double* x, double* p, double dt, Noise* noise) noexcept nogil:
    cdef int i, j
    for i in range(3):
        x[POSITION_E + i] += x[VELOCITY_E + i] * dt
    for i in range(3):
        axpy(p + i * n, dt, p + (VELOCITY + i) * n)
    for i in range(n):
        for j in range(3):
            p[i * n + j] += dt * p[i * n + VELOCITY + j]
    mirror(p)
    add_noise(p, dt, COAST_ACCEL2, COAST_RATE2, noise)


cdef void mirror(double* p) noexcept nogil:
    """The upper triangle decides."""
    cdef int i, j
    for i in range(n):
        for j in range(i + 1, n):
            p[j * n + i] = p[i * n + j]


# ---------------------------------------------------------------- observation models (fusiond.observe)

cdef struct Observation:
    int m
    double innovation[3]
    double jacobian[3 * n]
    double variance[3]


cdef void skew_rows(double* to_n, double* v, double sign, double* jacobian, int m, int column) noexcept nogil:
    """jacobian[:m, column:column+3] = sign * to_n @ skew(v)"""
    cdef int i
    cdef double* a
    for i in range(m):
        a = to_n + 3 * i
        jacobian[i * n + column] = sign * (a[1] * v[2] - a[2] * v[1])
        jacobian[i * n + column + 1] = sign * (a[2] * v[0] - a[0] * v[2])
        jacobian[i * n + column + 2] = sign * (a[0] * v[1] - a[1] * v[0])


cdef void matrix_product(double* a, double* b, double* out) noexcept nogil:
    cdef int i, j
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j]


cdef void gnss_position(double* x, double* auxiliary, double* row, double* parameter, Observation* seen) noexcept nogil:
    cdef double to_n[9]
    cdef double c[9]
    cdef double lever[3]
    cdef double off[3]
    cdef double delay = 0.0
    cdef int i, j
    mat_ne(x, to_n)
    matrix(x + QUATERNION_EB, c)
    seen.m = 3
    memset(seen.jacobian, 0, 3 * n * sizeof(double))
    if n > 18 and parameter[4] != 0.0:
        delay = x[DELAYS]
        calibrated_position(x, auxiliary, parameter, to_n, c, lever, seen.jacobian)
    else:
        times(c, parameter, lever)
    for i in range(3):
        off[i] = row[i] - x[POSITION_E + i] - lever[i] + x[VELOCITY_E + i] * delay
        for j in range(3):
            seen.jacobian[i * n + POSITION + j] = to_n[3 * i + j]
    skew_rows(to_n, lever, -1.0, seen.jacobian, 3, ATTITUDE)
    times(to_n, off, seen.innovation)
    seen.variance[0] = row[3]
    seen.variance[1] = row[3]
    seen.variance[2] = row[4]


cdef void calibrated_position(double* x, double* auxiliary, double* parameter, double* to_n, double* c, double* lever,
                              double* jacobian) noexcept nogil:
    """fusiond.observe.gnss_position._calibrated"""
    cdef double rate[3]
    cdef double mean[3]
    cdef double arm[3]
    cdef double swing[3]
    cdef double back[3]
    cdef double turned[9]
    cdef double delay = x[DELAYS], along
    cdef int i, j
    for i in range(3):
        rate[i] = auxiliary[RATE_B + i] - x[GYRO_BIAS_B + i]
        mean[i] = auxiliary[MEAN_RATE_B + i] - x[GYRO_BIAS_B + i]
        arm[i] = parameter[i] + x[ANTENNA_B + i]
    cross(rate, arm, swing)
    matrix_product(to_n, c, turned)
    skew_rows(turned, arm, -delay, jacobian, 3, GYRO_BIAS)
    skew_rows(turned, mean, -delay, jacobian, 3, ANTENNA_ERROR)
    for i in range(3):
        along = 0.0
        for j in range(3):
            jacobian[i * n + VELOCITY + j] = to_n[3 * i + j] * -delay
            jacobian[i * n + ANTENNA_ERROR + j] += turned[3 * i + j]
            along += to_n[3 * i + j] * x[VELOCITY_E + j] + turned[3 * i + j] * swing[j]
        jacobian[i * n + DELAYS_ERROR] = -along
        back[i] = arm[i] - swing[i] * delay
    times(c, back, lever)


cdef void calibrated_velocity(double* x, double* auxiliary, double* to_n, double* c, double* turned,
                              double* swing, double* jacobian, int m) noexcept nogil:
    """fusiond.observe.gnss_velocity._gained, taken off `swing`; the attitude's columns are those of the rest alone."""
    cdef double force_b[3]
    cdef double mean[3]
    cdef double force[3]
    cdef double rest[3]
    cdef double delay = x[DELAYS] + x[DELAYS + 1], along
    cdef int i, j
    for i in range(3):
        force_b[i] = auxiliary[SMOOTH_FORCE_B + i] - x[ACCEL_BIAS_B + i]
        mean[i] = auxiliary[MEAN_RATE_B + i] - x[GYRO_BIAS_B + i]
    times(c, force_b, force)
    gravity_e(x + POSITION_E, rest)
    rest[0] += 2 * EARTH_RATE * x[VELOCITY_E + 1]
    rest[1] -= 2 * EARTH_RATE * x[VELOCITY_E]
    skew_rows(turned, mean, 1.0, jacobian, m, ANTENNA_ERROR)
    skew_rows(to_n, rest, -delay, jacobian, m, ATTITUDE)
    for i in range(m):
        along = 0.0
        for j in range(3):
            along += to_n[3 * i + j] * (force[j] + rest[j])
            jacobian[i * n + ACCEL_BIAS + j] = turned[3 * i + j] * delay
        jacobian[i * n + DELAYS_ERROR] = -along
        jacobian[i * n + DELAYS_ERROR + 1] = -along
        jacobian[i * n + VELOCITY] += to_n[3 * i + 1] * (2 * EARTH_RATE * delay)
        jacobian[i * n + VELOCITY + 1] -= to_n[3 * i] * (2 * EARTH_RATE * delay)
    for i in range(3):
        swing[i] -= (force[i] + rest[i]) * delay


cdef void gnss_velocity(double* x, double* auxiliary, double* row, double* parameter,
                        Observation* seen) noexcept nogil:
    cdef double to_n[9]
    cdef double c[9]
    cdef double turned[9]
    cdef double rate[3]
    cdef double swing_b[3]
    cdef double swing[3]
    cdef double v[3]
    cdef double h[3]
    cdef double arm[3]
    cdef double by_turn[3 * n]
    cdef int i, j, m = <int>row[4]
    cdef bint learnt = n > 18 and parameter[4] != 0.0
    mat_ne(x, to_n)
    matrix(x + QUATERNION_EB, c)
    for i in range(3):
        rate[i] = auxiliary[RATE_B + i] - x[GYRO_BIAS_B + i]
        arm[i] = parameter[i]
        if learnt:
            arm[i] += x[ANTENNA_B + i]
    cross(rate, arm, swing_b)
    times(c, swing_b, swing)
    matrix_product(to_n, c, turned)
    seen.m = m
    memset(seen.jacobian, 0, m * n * sizeof(double))
    for i in range(m):
        for j in range(3):
            seen.jacobian[i * n + VELOCITY + j] = to_n[3 * i + j]
    if learnt:
        calibrated_velocity(x, auxiliary, to_n, c, turned, swing, seen.jacobian, m)
    skew_rows(to_n, swing, -1.0, by_turn, m, ATTITUDE)
    for i in range(m):
        for j in range(3):
            seen.jacobian[i * n + ATTITUDE + j] += by_turn[i * n + ATTITUDE + j]
    skew_rows(turned, arm, 1.0, seen.jacobian, m, GYRO_BIAS)
    for i in range(3):
        v[i] = x[VELOCITY_E + i] + swing[i]
    times(to_n, v, h)
    for i in range(m):
        seen.innovation[i] = row[i] - h[i]
        seen.variance[i] = row[3]


cdef void point_velocity(double* x, double* auxiliary, double* point, int first, int last, double* velocity,
                         double* jacobian) noexcept nogil:
    """Velocity (3,) in vehicle axes of a point, and rows first..last of its derivative, n wide each."""
    cdef double c[9]
    cdef double rate[3]
    cdef double swing[3]
    cdef double vb[3]
    cdef double r[9]
    cdef double turned[9]
    cdef double sp, cp, sy, cy
    cdef int i, j, k
    matrix(x + QUATERNION_EB, c)
    for i in range(3):
        rate[i] = auxiliary[RATE_B + i] - x[GYRO_BIAS_B + i]
    cross(rate, point, swing)
    transposed_times(c, x + VELOCITY_E, vb)
    for i in range(3):
        vb[i] = vb[i] + swing[i]
    sin_cos(x[MOUNT], &sp, &cp)
    sin_cos(x[MOUNT + 1], &sy, &cy)
    r[0] = cy * cp
    r[1] = -sy
    r[2] = cy * sp
    r[3] = sy * cp
    r[4] = cy
    r[5] = sy * sp
    r[6] = -sp
    r[7] = 0.0
    r[8] = cp
    times(r, vb, velocity)
    memset(jacobian + first * n, 0, (last - first) * n * sizeof(double))
    for i in range(first, last):
        for j in range(3):
            # rotation_vb @ rotation_eb.T
            turned[3 * i + j] = r[3 * i] * c[3 * j] + r[3 * i + 1] * c[3 * j + 1] + r[3 * i + 2] * c[3 * j + 2]
            jacobian[i * n + VELOCITY + j] = turned[3 * i + j]
    skew_rows(turned + 3 * first, x + VELOCITY_E, 1.0, jacobian + first * n, last - first, ATTITUDE)
    skew_rows(r + 3 * first, point, 1.0, jacobian + first * n, last - first, GYRO_BIAS)
    cdef double by[6]
    for i in range(3):  # with the mean rate, see fusiond.observe.model
        rate[i] = auxiliary[MEAN_RATE_B + i] - x[GYRO_BIAS_B + i]
    cross(rate, point, swing)
    transposed_times(c, x + VELOCITY_E, vb)
    for i in range(3):
        vb[i] = vb[i] + swing[i]
    by[0] = -cy * sp * vb[0] + cy * cp * vb[2]
    by[1] = -sy * cp * vb[0] - cy * vb[1] - sy * sp * vb[2]
    by[2] = -sy * sp * vb[0] + sy * cp * vb[2]
    by[3] = cy * cp * vb[0] - sy * vb[1] + cy * sp * vb[2]
    by[4] = -cp * vb[0] - sp * vb[2]
    by[5] = 0.0
    for i in range(first, last):
        for k in range(2):
            jacobian[i * n + MOUNT_ERROR + k] = by[2 * i + k]


cdef void with_rate_noise(double* auxiliary, Observation* seen) noexcept nogil:
    cdef double* by
    cdef int a
    for a in range(seen.m):
        by = seen.jacobian + a * n + GYRO_BIAS
        seen.variance[a] += auxiliary[RATE_VARIANCE] * (by[0] * by[0] + by[1] * by[1] + by[2] * by[2])


cdef void wheel(double* x, double* p, double* auxiliary, double* row, double* parameter, Observation* seen,
                bint certain) noexcept nogil:
    cdef double v[3]
    cdef double by[3 * n]
    cdef int which = <int>parameter[6]
    cdef double speed, track, along, across = 0.0, scale = 1 + x[which + 1], reading = row[0]
    cdef double reach[n]
    cdef double variance = row[1], spread, odds, alike, sure
    cdef int j, k, rows = 2 if parameter[4] != 0.0 else 1
    point_velocity(x, auxiliary, parameter, 0, rows, v, by)
    speed = v[0]
    along = 1.0
    track = sqrt(v[0] * v[0] + v[1] * v[1])
    if rows == 2 and track > LEAST_TRACK_SPEED:
        speed = track if v[0] >= 0 else -track
        along = v[0] / speed
        across = v[1] / speed
        for j in range(n):
            seen.jacobian[j] = scale * (along * by[j] + across * by[n + j])
    else:
        for j in range(n):
            seen.jacobian[j] = scale * by[j]
    seen.jacobian[which] = speed
    if parameter[5] != 0.0 and reading > 0:
        if certain or fabs(speed) > SURE_SPEED:
            if speed < 0:
                reading = -reading
        else:
            memset(reach, 0, sizeof(reach))
            for k in range(n):
                if seen.jacobian[k] != 0.0:
                    axpy(reach, seen.jacobian[k], p + k * n)
            spread = variance
            for k in range(n):
                spread += seen.jacobian[k] * reach[k]
            odds = reading * scale * speed / spread
            alike = exponential(-2 * fabs(odds))
            sure = (1 - alike) / (1 + alike)
            if odds < 0:
                sure = -sure
            variance += DIRECTION_ALIKE * reading * reading * (1 - sure * sure)
            reading *= sure
    seen.m = 1
    seen.innovation[0] = reading - scale * speed
    seen.variance[0] = variance


# ---------------------------------------------------------------- update (fusiond.update)

cdef bint cholesky(double s[3][3], double* variance, double factor, int m, double low[3][3]) noexcept nogil:
    """Lower factor of s + factor * variance; whether it is positive definite, and the variance not negative."""
    cdef double rest
    cdef int i, j, k
    for i in range(m):
        for j in range(i + 1):
            rest = s[i][j]
            if i == j:
                rest += factor * variance[i]
            for k in range(j):
                rest -= low[i][k] * low[j][k]
            if i == j:
                if not (variance[i] >= 0 and 0 < rest < INFINITY):
                    return False
                low[i][i] = sqrt(rest)
            else:
                low[i][j] = rest / low[j][j]
    return True


cdef void inject(double* x, double* error) noexcept nogil:
    cdef double part[4]
    cdef double turned[4]
    cdef int i
    for i in range(3):
        x[POSITION_E + i] += error[POSITION + i]
        x[VELOCITY_E + i] += error[VELOCITY + i]
        x[GYRO_BIAS_B + i] += error[GYRO_BIAS + i]
        x[ACCEL_BIAS_B + i] += error[ACCEL_BIAS + i]
    for i in range(CALIBRATIONS, n):
        x[i + 1] += error[i]
    quaternion_exp(error + ATTITUDE, part)
    quaternion_multiply(part, x + QUATERNION_EB, turned)
    normalise(turned)
    memcpy(x + QUATERNION_EB, turned, 4 * sizeof(double))


cdef void difference(double* a, double* b, double* error) noexcept nogil:
    """fusiond.bank.difference"""
    cdef double back[4]
    cdef double turn[4]
    cdef int i
    for i in range(3):
        error[POSITION + i] = a[POSITION_E + i] - b[POSITION_E + i]
        error[VELOCITY + i] = a[VELOCITY_E + i] - b[VELOCITY_E + i]
        error[GYRO_BIAS + i] = a[GYRO_BIAS_B + i] - b[GYRO_BIAS_B + i]
        error[ACCEL_BIAS + i] = a[ACCEL_BIAS_B + i] - b[ACCEL_BIAS_B + i]
    for i in range(CALIBRATIONS, n):
        error[i] = a[i + 1] - b[i + 1]
    back[0] = b[QUATERNION_EB]
    for i in range(1, 4):
        back[i] = -b[QUATERNION_EB + i]
    quaternion_multiply(a + QUATERNION_EB, back, turn)
    for i in range(3):
        error[ATTITUDE + i] = turn[1 + i] * (2.0 if turn[0] >= 0 else -2.0)


cdef void turn_along(double* p, double* error) noexcept nogil:
    """fusiond.update.turn_along"""
    cdef double rows[6 * n]
    cdef double* e
    cdef double* a = p + ATTITUDE * n
    cdef int block, i, j
    for block in range(2):
        e = error + 3 * block  # of position, then of velocity
        for j in range(n):
            rows[(3 * block) * n + j] = e[1] * a[2 * n + j] - e[2] * a[n + j]
            rows[(3 * block + 1) * n + j] = e[2] * a[j] - e[0] * a[2 * n + j]
            rows[(3 * block + 2) * n + j] = e[0] * a[n + j] - e[1] * a[j]
    for i in range(6):
        axpy(p + i * n, -1.0, rows + i * n)
    for i in range(n):
        a = p + i * n + ATTITUDE
        for block in range(2):
            e = error + 3 * block
            p[i * n + 3 * block] -= e[1] * a[2] - e[2] * a[1]
            p[i * n + 3 * block + 1] -= e[2] * a[0] - e[0] * a[2]
            p[i * n + 3 * block + 2] -= e[0] * a[1] - e[1] * a[0]
    mirror(p)


cdef struct Update:
    double ratio
    bint fused


cdef void project(double* p, Observation* seen, double across[3][n], double s[3][3]) noexcept nogil:
    """H P and H P H'."""
    cdef double rest, h
    cdef int i, k, a, m = seen.m
    for a in range(m):
        memset(across[a], 0, n * sizeof(double))
        for k in range(n):
            h = seen.jacobian[a * n + k]
            if h != 0.0:
                axpy(across[a], h, p + k * n)
    for a in range(m):
        for i in range(a + 1):
            rest = 0.0
            for k in range(n):
                rest += seen.jacobian[a * n + k] * across[i][k]
            s[a][i] = rest
            s[i][a] = rest


cdef bint whiten(double s[3][3], Observation* seen, double* variance, double* whitened) noexcept nogil:
    """fusiond.update.whiten, of H P H' and a variance."""
    cdef double low[3][3]
    cdef double rest
    cdef int i, k
    if not cholesky(s, variance, 1.0, seen.m, low):
        return False
    for i in range(seen.m):
        rest = seen.innovation[i]
        for k in range(i):
            rest -= low[i][k] * whitened[k]
        whitened[i] = rest / low[i][i]
    return True


cdef double detection(double distance, int m, double clutter) noexcept nogil:
    cdef double density = (1 - clutter) * exponential(-distance / 2), uniform = clutter
    cdef int i
    for i in range(m):
        uniform *= UNIFORM
    return density / (density + uniform)


cdef Update update(double* x, double* p, Observation* seen, double gate, double factor, bint trusted,
                   double clutter, double across[3][n], double s[3][3]) noexcept nogil:
    """fusiond.update.update, for an observation that was projected."""
    cdef Update result = Update(INFINITY, False)
    cdef double gain[3][n]
    cdef double kept[3][n]
    cdef double low[3][3]
    cdef double solved[3]
    cdef double error[n]
    cdef double before[n * n]
    cdef double distance = 0.0, h, share = 1.0, mixed
    cdef int i, j, k, a, m = seen.m
    if not whiten(s, seen, seen.variance, solved):
        return result
    for i in range(m):
        distance += solved[i] * solved[i]
    if not distance / gate < INFINITY:
        return result
    result.ratio = distance / gate
    if not trusted or (clutter == 0 and not result.ratio <= 1):
        return result
    if clutter != 0:
        share = detection(distance, m, clutter)
        if share < NEGLIGIBLE:
            return result
        memcpy(before, p, n * n * sizeof(double))
    if not cholesky(s, seen.variance, factor, m, low):
        return result
    # gain' = S^-1 (P H')'
    for i in range(m):
        for j in range(n):
            gain[i][j] = across[i][j]
        for k in range(i):
            axpy(gain[i], -low[i][k], gain[k])
        for j in range(n):
            gain[i][j] = gain[i][j] / low[i][i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            axpy(gain[i], -low[k][i], gain[k])
        for j in range(n):
            gain[i][j] = gain[i][j] / low[i][i]
    # Joseph: with A = P - K (H P), P = A - (A H') K' + K R K'; all by rows, so A' is what is kept for the while
    for k in range(n):
        for a in range(m):
            axpy(p + k * n, -across[a][k], gain[a])
    for a in range(m):
        memset(kept[a], 0, n * sizeof(double))
        for k in range(n):
            h = seen.jacobian[a * n + k]
            if h != 0.0:
                axpy(kept[a], -h, p + k * n)
    for a in range(m):
        axpy(kept[a], factor * seen.variance[a], gain[a])
    for k in range(n):
        for a in range(m):
            axpy(p + k * n, gain[a][k], kept[a])
    mirror(p)
    for j in range(n):
        error[j] = 0.0
    for a in range(m):
        axpy(error, seen.innovation[a], gain[a])
    if share < 1:
        mixed = share * (1 - share)
        for i in range(n):
            for j in range(n):
                p[i * n + j] = share * p[i * n + j] + (1 - share) * before[i * n + j] + mixed * (error[i] * error[j])
        for i in range(n):
            error[i] = share * error[i]
    turn_along(p, error)
    inject(x, error)
    result.fused = share >= 0.5
    return result


# ---------------------------------------------------------------- health (fusiond.health)

cdef void begin_health(double* memory) noexcept nogil:
    cdef int i
    for i in range(4):
        memory[NOMINAL + i] = PRIOR[i]
    for i in range(3):
        memory[BIAS + i] = 0.0
    memory[BIAS_VARIANCE] = FIRST_BIAS_VARIANCE


cdef double density(double square, double variance, int m) noexcept nogil:
    cdef double root = sqrt(variance), scale = 1.0
    cdef int i
    for i in range(m):
        scale *= root
    return exponential(-square / (2 * variance)) / scale


cdef void judge(double* memory, int64_t* stamps, double* whitened, int m, bint same, int64_t t_ns) noexcept nogil:
    cdef double likelihood[4]
    cdef double elapsed = KEEPS, blurred, total = 0.0, square = 0.0, off = 0.0, stretch = 1.0, size = 0.0, rest, outlier, alike
    cdef double variance, gain
    cdef int i
    if memory[NOMINAL] + memory[NOISY] + memory[BIASED] + memory[FROZEN] == 0:
        begin_health(memory)
    if stamps[T_JUDGED] != NEVER:
        elapsed = (t_ns - stamps[T_JUDGED]) * 1e-9
    stamps[T_JUDGED] = t_ns
    blurred = 1 - exponential(-elapsed / KEEPS)
    for i in range(m):
        square += whitened[i] * whitened[i]
        rest = whitened[i] - memory[BIAS + i]
        off += rest * rest
    if density(square, 1 + FIRST_BIAS_VARIANCE, m) > density(off, 1 + memory[BIAS_VARIANCE], m):
        for i in range(3):
            memory[BIAS + i] = 0.0
        memory[BIAS_VARIANCE] = FIRST_BIAS_VARIANCE
    off = 0.0
    if memory[BIAS_VARIANCE] < 1.0:
        for i in range(m):
            size += memory[BIAS + i] * memory[BIAS + i]
        size = sqrt(size)
        if 1e-9 < size < LEAST_BIAS:
            stretch = LEAST_BIAS / size
    for i in range(m):
        rest = whitened[i] - memory[BIAS + i] * stretch
        off += rest * rest
    if square > FARTHEST:
        square = FARTHEST
    outlier = density(square, OUTLIER_VARIANCE, m)
    likelihood[0] = ((1 - OUTLIERS) * density(square, 1.0, m) + OUTLIERS * outlier) * (SAME_IF_NOMINAL if same else 1.0)
    alike = SAME_IF_FAULTY if same else 1.0
    likelihood[1] = ((1 - OUTLIERS) * density(square, NOISY_VARIANCE, m) + OUTLIERS * outlier) * alike
    likelihood[2] = ((1 - OUTLIERS) * density(off, 1 + memory[BIAS_VARIANCE], m) + OUTLIERS * outlier) * alike
    likelihood[3] = outlier * (1.0 if same else OTHER_IF_FROZEN)
    for i in range(4):
        memory[NOMINAL + i] = (memory[NOMINAL + i] + blurred * (PRIOR[i] - memory[NOMINAL + i])) * likelihood[i]
        total += memory[NOMINAL + i]
    for i in range(4):
        memory[NOMINAL + i] = memory[NOMINAL + i] / total
    variance = memory[BIAS_VARIANCE] + BIAS_WALK
    gain = variance / (variance + 1)
    for i in range(m):
        memory[BIAS + i] += gain * (whitened[i] - memory[BIAS + i])
    memory[BIAS_VARIANCE] = (1 - gain) * variance


cdef bint arrive(double* memory, int64_t* stamps, Row* row) noexcept nogil:
    cdef double total = row.values[0] + row.values[1] + row.values[2], elapsed, share
    cdef bint same = stamps[T_LAST] != NEVER and total == memory[LAST_SUM]
    memory[LAST_SUM] = total
    if stamps[T_LAST] != NEVER and row.t_ns > stamps[T_LAST]:
        elapsed = (row.t_ns - stamps[T_LAST]) * 1e-9
        share = INTERVAL_SHARE if memory[INTERVAL] > 0 else 1.0
        memory[INTERVAL] += share * ((elapsed if elapsed < 10.0 else 10.0) - memory[INTERVAL])
    return same


cdef bint tells(double s[3][3], double* variance, int m) noexcept nogil:
    cdef double total = 0.0, own = 0.0
    cdef int a
    for a in range(m):
        total += s[a][a]
        own += variance[a]
    return total <= TELLING * own


cdef bint is_trusted(double* memory) noexcept nogil:
    return memory[BIASED] + memory[FROZEN] <= DISTRUST


cdef void learn(double* memory, Observation* seen, double* given, double s[3][3], double elapsed) noexcept nogil:
    cdef double found = 0.0, configured = 0.0, nis = 0.0, square, spread
    cdef int a
    for a in range(seen.m):
        square = seen.innovation[a] * seen.innovation[a]
        spread = s[a][a] + given[a]
        nis += square / spread
        found += (square if square < CLIPPED * spread else CLIPPED * spread) - s[a][a]
        configured += given[a]
    memory[MEAN_NIS] += elapsed / (NIS_TIME + elapsed) * (nis / seen.m - memory[MEAN_NIS])
    if configured > 0:
        memory[NOISE_EXCESS] += elapsed / (NOISE_TIME + elapsed) * (found / configured - 1 - memory[NOISE_EXCESS])


cdef bint moved(double* memory, Observation* seen, double gate) noexcept nogil:
    cdef double total = 0.0, step
    cdef int a
    for a in range(seen.m):
        step = seen.innovation[a] - memory[LAST_INNOVATION + a]
        total += step * step / (2 * seen.variance[a])
        memory[LAST_INNOVATION + a] = seen.innovation[a]
    return not total <= gate


# ---------------------------------------------------------------- the loop (fusiond.kernel, fusiond.motion)

# ---------------------------------------------------------------- what is published (fusiond.answer)

cdef void quaternion_of(double* m, double* q) noexcept nogil:
    cdef double trace = m[0] + m[4] + m[8], most = trace
    cdef int pick = 0, i
    for i in range(3):
        if m[4 * i] > most:
            most = m[4 * i]
            pick = i + 1
    if pick == 0:
        q[0], q[1], q[2], q[3] = 1 + trace, m[7] - m[5], m[2] - m[6], m[3] - m[1]
    elif pick == 1:
        q[0], q[1], q[2], q[3] = m[7] - m[5], 1 + 2 * m[0] - trace, m[1] + m[3], m[2] + m[6]
    elif pick == 2:
        q[0], q[1], q[2], q[3] = m[2] - m[6], m[1] + m[3], 1 + 2 * m[4] - trace, m[5] + m[7]
    else:
        q[0], q[1], q[2], q[3] = m[3] - m[1], m[2] + m[6], m[5] + m[7], 1 + 2 * m[8] - trace
    if not q[0] >= 0:
        for i in range(4):
            q[i] = -q[i]
    normalise(q)


cdef void answer(double* x, double* p, double* found) noexcept nogil:
    cdef double sa, ca, so, co
    cdef double to_n[9]
    cdef double c[9]
    cdef double turned[9]
    cdef double* out
    cdef int a, b, i, j
    geodetic_trig(x + POSITION_E, &sa, &ca, &so, &co)
    found[0] = atan2(sa, ca)
    found[1] = atan2(so, co)
    found[2] = height_of(x + POSITION_E, sa, ca)
    mat_ne(x + POSITION_E, to_n)
    times(to_n, x + VELOCITY_E, found + 3)
    matrix(x + QUATERNION_EB, c)
    matrix_product(to_n, c, turned)
    quaternion_of(turned, found + 6)
    for a in range(3):
        for b in range(3):
            for i in range(3):  # one block of the covariance, turned from both sides
                for j in range(3):
                    turned[3 * i + j] = to_n[3 * i] * p[3 * a * n + 3 * b + j] + \
                        to_n[3 * i + 1] * p[(3 * a + 1) * n + 3 * b + j] + to_n[3 * i + 2] * p[(3 * a + 2) * n + 3 * b + j]
            out = found + 10 + 27 * a + 3 * b
            for i in range(3):
                for j in range(3):
                    out[9 * i + j] = turned[3 * i] * to_n[3 * j] + turned[3 * i + 1] * to_n[3 * j + 1] + \
                        turned[3 * i + 2] * to_n[3 * j + 2]


cdef class Kernel:
    """The compiled counterpart of fusiond.kernel.Kernel, for one plan."""

    cdef int sources, imu_source
    cdef int32_t[::1] models
    cdef double[:, ::1] parameters
    cdef double[:, ::1] constraints
    cdef double gates[4]
    cdef Noise noise
    cdef int64_t imu_gap, restart_gap, gnss_reset, gnss_return, constraint_interval, still_after, snapshot_interval
    cdef bint standstill, non_holonomic, wheeled
    cdef double course_speed, still_wheel, still_gyro2, still_accel2, zero_velocity_factor
    cdef double[::1] head_numbers
    cdef int64_t[::1] head_whole
    cdef Row[::1] table
    cdef int64_t[:, ::1] counts
    cdef double[:, ::1] kept_numbers
    cdef int64_t[:, ::1] kept_whole
    cdef int64_t[::1] kept_applied
    cdef double* x  # of the state that is bound
    cdef double* p
    cdef double* auxiliary
    cdef double* memory
    cdef double* bank
    cdef int64_t* stamps
    cdef int64_t* source_stamps
    cdef double heading_variance
    cdef int numbers_size, core_size  # of a state, with and without the bank of hypotheses

    def __init__(self, plan):
        import numpy as np
        check_layout()
        if plan.size != n:
            raise ValueError(f"compiled for {n} error states, not {plan.size}")
        self.sources = len(plan.sources)
        self.imu_source = plan.imu_source
        self.wheeled = len(plan.wheels) > 0
        self.models = np.array(plan.models, dtype=np.int32)
        self.parameters = np.ascontiguousarray(plan.parameters)
        self.constraints = np.ascontiguousarray(plan.constraints)
        for i in range(4):
            self.gates[i] = plan.gates[i]
        noise = plan.noise
        self.noise.accel, self.noise.gyro = noise.accel, noise.gyro
        self.noise.accel_bias, self.noise.gyro_bias = noise.accel_bias, noise.gyro_bias
        for i in range(n - CALIBRATIONS):
            self.noise.calibrations[i] = noise.calibrations[i]
        self.imu_gap = plan.imu_gap_ns
        self.restart_gap = plan.restart_gap_ns
        self.gnss_reset = plan.gnss_reset_ns
        self.gnss_return = plan.gnss_return_ns
        self.constraint_interval = plan.constraint_interval_ns
        self.still_after = plan.still_after_ns
        self.snapshot_interval = plan.snapshot_interval_ns
        self.standstill = plan.motion.standstill
        self.non_holonomic = plan.motion.non_holonomic
        self.course_speed = plan.filter.course_speed_mps
        self.still_wheel = plan.motion.still_wheel_mps
        self.still_gyro2 = plan.still_gyro * plan.still_gyro
        self.still_accel2 = plan.motion.still_accel_mps2 * plan.motion.still_accel_mps2
        self.zero_velocity_factor = plan.zero_velocity_factor
        self.heading_variance = plan.heading_variance
        self.core_size = NOMINAL_SIZE + n * n + AUXILIARY_SIZE + self.sources * MEMORY_SIZE
        self.numbers_size = self.core_size + HYPOTHESES * BLOCK

    cdef int bind(self, double[::1] numbers, int64_t[::1] whole) except -1:
        if numbers.shape[0] != self.numbers_size:
            raise ValueError(f"a state of {self.numbers_size} numbers is needed, not {numbers.shape[0]}")
        if whole.shape[0] != STAMPS_SIZE + self.sources * SOURCE_STAMPS_SIZE:
            raise ValueError("a state of other sources")
        self.x = &numbers[0]
        self.p = self.x + NOMINAL_SIZE
        self.auxiliary = self.p + n * n
        self.memory = self.auxiliary + AUXILIARY_SIZE
        self.bank = self.x + self.core_size
        self.stamps = &whole[0]
        self.source_stamps = self.stamps + STAMPS_SIZE
        return 0

    def propagate(self, state, double dt, double[::1] force_b, double[::1] rate_b):
        """fusiond.strapdown.propagate"""
        self.bind(state.numbers, state.whole)
        propagate(self.x, self.p, dt, &force_b[0], &rate_b[0], &self.noise)

    def predict(self, state, int64_t t_ns):
        """fusiond.kernel.predict"""
        self.bind(state.numbers, state.whole)
        cdef int64_t begin = self.stamps[T], carried
        if t_ns <= begin or self.stamps[PHASE] != RUNNING:
            return
        carried = self.stamps[T_IMU] + self.imu_gap
        if t_ns < carried:
            carried = t_ns
        if carried < begin or not is_trusted(self.memory + self.imu_source * MEMORY_SIZE):
            carried = begin
        if carried > begin:
            propagate(self.x, self.p, (carried - begin) * 1e-9, self.auxiliary + HELD_FORCE_B,
                      self.auxiliary + HELD_RATE_B, &self.noise)
        if t_ns > carried:
            coast(self.x, self.p, (t_ns - carried) * 1e-9, &self.noise)
        self.stamps[T] = t_ns

    def answer(self, double[::1] nominal, double[:, ::1] covariance):
        """fusiond.answer.answer"""
        if nominal.shape[0] != NOMINAL_SIZE or covariance.shape[0] != n or covariance.shape[1] != n:
            raise ValueError(f"a state of {n} error states is needed, not {covariance.shape[0]}")
        cdef double[::1] found = empty(ANSWER_SIZE)
        answer(&nominal[0], &covariance[0, 0], &found[0])
        return found.base

    def attach(self, head, Row[::1] table, int64_t[:, ::1] counts, double[:, ::1] kept_numbers,
               int64_t[:, ::1] kept_whole, int64_t[::1] kept_applied):
        """fusiond.kernel.Kernel.attach"""
        self.head_numbers = head.numbers
        self.head_whole = head.whole
        self.table = table
        self.counts = counts
        self.kept_numbers = kept_numbers
        self.kept_whole = kept_whole
        self.kept_applied = kept_applied

    cpdef Py_ssize_t place(self, Py_ssize_t begin, Py_ssize_t end, int64_t t_ns, int32_t source, int64_t sequence):
        """fusiond.kernel.Kernel.place"""
        cdef Py_ssize_t i = end
        cdef const Row* row
        while i > begin:
            row = &self.table[i - 1]
            if row.t_ns < t_ns:
                break
            if row.t_ns == t_ns:
                if row.source < source:
                    break
                if row.source == source:
                    if row.sequence == sequence:
                        return ~(i - 1 - begin)
                    if row.sequence < sequence:
                        break
            i -= 1
        return i - begin

    cpdef insert(self, Py_ssize_t at, Py_ssize_t end, int64_t t_ns, int32_t source, int64_t sequence,
               int64_t t_receive_ns, int32_t outcome, tuple values):
        """fusiond.kernel.Kernel.insert"""
        cdef Row* row = &self.table[at]
        cdef Py_ssize_t i
        memmove(row + 1, row, (end - at) * sizeof(Row))
        memset(row, 0, sizeof(Row))
        row.t_ns = t_ns
        row.source = source
        row.sequence = sequence
        row.t_receive_ns = t_receive_ns
        row.outcome = outcome
        for i in range(len(values)):
            row.values[i] = values[i]
        self.counts[source, outcome] += 1

    cpdef Py_ssize_t first_changed(self, Py_ssize_t begin, Py_ssize_t place):
        """fusiond.kernel.Kernel.first_changed"""
        cdef Py_ssize_t i = begin + place
        if self.models[self.table[i].source] != IMU:
            return place
        while i > begin and self.models[self.table[i - 1].source] != IMU:
            i -= 1
        while begin < i < begin + place and self.table[i].t_ns == self.table[i - 1].t_ns:
            i += 1
        return i - begin

    def offer(self, Py_ssize_t begin, Py_ssize_t end, int64_t t_ns, int32_t source, int64_t sequence,
              int64_t t_receive_ns, tuple values):
        """fusiond.kernel.Kernel.offer"""
        cdef Py_ssize_t place = self.place(begin, end, t_ns, source, sequence)
        if place < 0:
            return place
        self.insert(begin + place, end, t_ns, source, sequence, t_receive_ns, WAITING, values)
        return self.first_changed(begin, place)

    def restore(self, Py_ssize_t kept):
        """fusiond.kernel.Kernel.restore"""
        cdef size_t bank_bytes = HYPOTHESES * BLOCK * sizeof(double)
        memcpy(&self.head_numbers[0], &self.kept_numbers[kept - 1, 0], self.core_size * sizeof(double))
        if self.kept_whole[kept - 1, PHASE] == CHOOSING:
            memcpy(&self.head_numbers[self.core_size], &self.kept_numbers[kept - 1, self.core_size], bank_bytes)
        elif self.head_whole[PHASE] == CHOOSING:
            memset(&self.head_numbers[self.core_size], 0, bank_bytes)
        memcpy(&self.head_whole[0], &self.kept_whole[kept - 1, 0], self.head_whole.shape[0] * sizeof(int64_t))

    def run(self, Py_ssize_t begin, Py_ssize_t end, Py_ssize_t applied, int64_t limit_ns, Py_ssize_t kept):
        """fusiond.kernel.Kernel.run"""
        cdef bint done = self.go(begin, end, &applied, limit_ns, &kept)
        return applied, kept, done

    cdef bint go(self, Py_ssize_t begin, Py_ssize_t end, Py_ssize_t* applied_io, int64_t limit_ns,
                 Py_ssize_t* kept_io) except -1:
        cdef Py_ssize_t applied = applied_io[0], kept = kept_io[0]
        cdef Row* rows = &self.table[0] + begin
        cdef Py_ssize_t count = end - begin, following = applied, room = self.kept_applied.shape[0]
        cdef Py_ssize_t whole_size = self.head_whole.shape[0], size
        cdef int32_t before
        cdef int64_t last
        cdef bint safe, done = False
        cdef Row* row
        self.bind(self.head_numbers, self.head_whole)
        with nogil:
            while True:
                if applied >= count or rows[applied].t_ns > limit_ns:
                    done = True
                    break
                row = rows + applied
                if kept == room or not self.knows(self.models[row.source]):
                    break
                if row.t_ns - self.stamps[T] > self.restart_gap:
                    break
                if following < applied:
                    following = applied
                while following < count and self.models[rows[following].source] != IMU:
                    following += 1
                before = row.outcome
                self.step(rows, applied, rows + following if following < count else NULL, whole_size)
                if row.outcome != before:
                    self.counts[row.source, before] -= 1
                    self.counts[row.source, row.outcome] += 1
                applied += 1
                last = self.kept_whole[kept - 1, T]
                safe = self.models[row.source] == IMU or self.stamps[T] - self.stamps[T_IMU] > self.imu_gap
                if safe and self.stamps[T] - last >= self.snapshot_interval:
                    size = self.numbers_size if self.stamps[PHASE] == CHOOSING else self.core_size
                    memcpy(&self.kept_numbers[kept, 0], self.x, size * sizeof(double))
                    memcpy(&self.kept_whole[kept, 0], self.stamps, whole_size * sizeof(int64_t))
                    self.kept_applied[kept] = applied
                    kept += 1
        applied_io[0] = applied
        kept_io[0] = kept
        return done

    cdef void step(self, Row* rows, Py_ssize_t index, Row* imu, Py_ssize_t whole_size) noexcept nogil:
        cdef Row* row = rows + index
        cdef int a
        row.ratio = 0.0  # all of an earlier run
        for a in range(3):
            row.innovation[a] = 0.0
            row.variance[a] = 0.0
        if self.source_stamps[row.source * SOURCE_STAMPS_SIZE + T_LAST] == row.t_ns:
            row.outcome = DUPLICATE
            return
        row.outcome = FUSED
        if self.stamps[PHASE] == ALIGNING:
            self.gather(row)
            self.source_stamps[row.source * SOURCE_STAMPS_SIZE + T_LAST] = row.t_ns
            return
        if self.stamps[PHASE] == CHOOSING:
            self.choose(row, imu)
        else:
            self.advance(row.t_ns, imu)
            if self.models[row.source] == IMU:
                self.hold(row)
                self.constrain()
            else:
                self.measure(row)
            self.guard(whole_size)
        self.source_stamps[row.source * SOURCE_STAMPS_SIZE + T_LAST] = row.t_ns

    cdef bint knows(self, int32_t model) noexcept nogil:
        """Whether this kernel can take an event of a model now; a start is left to the twin, and with it GNSS until then."""
        if self.stamps[PHASE] == RUNNING or self.stamps[PHASE] == CHOOSING:
            return model < COMPILED
        return self.stamps[PHASE] == ALIGNING and (model == IMU or model == WHEEL_SPEED)

    cdef void gather(self, Row* row) noexcept nogil:
        """fusiond.alignment.gather, for inertial samples and wheels."""
        cdef double* a = self.auxiliary
        cdef double north, east
        cdef bint still, driving
        cdef int i
        self.stamps[T] = row.t_ns
        if self.models[row.source] == WHEEL_SPEED:
            self.memory[row.source * MEMORY_SIZE + LAST_VALUE] = row.values[0]
            return
        arrive(self.memory + row.source * MEMORY_SIZE, self.source_stamps + row.source * SOURCE_STAMPS_SIZE, row)
        if self.stamps[T_IMU] != NEVER:
            self.watch(row, (row.t_ns - self.stamps[T_IMU]) * 1e-9)
        self.keep_sample(row)
        still = self.stamps[T_STILL] != NEVER and row.t_ns - self.stamps[T_STILL] >= self.still_after
        driving = False
        if self.stamps[T_FIRST_VELOCITY] != NEVER and row.t_ns - self.stamps[T_FIRST_VELOCITY] <= WINDOW_MOST_NS:
            north = a[FIRST_VELOCITY_N]
            east = a[FIRST_VELOCITY_N + 1]
            driving = sqrt(north * north + east * east) >= self.course_speed
        if still and not driving:
            for i in range(3):
                a[REST_RATE_B + i] = a[MEAN_RATE_B + i]
            self.stamps[T_REST] = row.t_ns

    cdef void keep_sample(self, Row* row) noexcept nogil:
        cdef double* a = self.auxiliary
        cdef int i
        self.stamps[T_IMU] = row.t_ns
        for i in range(3):
            a[HELD_FORCE_B + i] = row.values[i]
            a[FORCE_B + i] = row.values[i]
            a[HELD_RATE_B + i] = row.values[3 + i]
            a[RATE_B + i] = row.values[3 + i]

    cdef void guard(self, Py_ssize_t whole_size) noexcept nogil:
        """fusiond.kernel.guard: a state that is no longer finite is emptied, and aligns anew."""
        cdef double total = 0.0
        cdef int64_t resets, blown
        cdef Py_ssize_t i
        for i in range(NOMINAL_SIZE):
            total += self.x[i]
        for i in range(n):
            total += self.p[i * (n + 1)]
        if isfinite(total):
            return
        resets = self.stamps[RESETS]
        blown = self.stamps[BLOWN]
        memset(self.x, 0, self.numbers_size * sizeof(double))
        self.x[QUATERNION_EB] = 1.0
        for i in range(whole_size):
            self.stamps[i] = NEVER
        for i in range(PHASE, STAMPS_SIZE):
            self.stamps[i] = 0
        self.stamps[RESETS] = resets + 1
        self.stamps[BLOWN] = blown + 1

    cdef void advance(self, int64_t t_ns, Row* imu) noexcept nogil:
        cdef int64_t begin = self.stamps[T], held = self.stamps[T_IMU]
        cdef double dt, span, middle, end, change
        cdef double force[3]
        cdef double rate[3]
        cdef double* a = self.auxiliary
        cdef int i
        if t_ns <= begin:
            return
        dt = (t_ns - begin) * 1e-9
        self.stamps[T] = t_ns
        if imu == NULL or held == NEVER or imu.t_ns - held > self.imu_gap or \
                not is_trusted(self.memory + self.imu_source * MEMORY_SIZE):
            coast(self.x, self.p, dt, &self.noise)
            return
        span = <double>(imu.t_ns - held)
        middle = <double>((begin - held) + (t_ns - held)) / 2 / span
        end = <double>(t_ns - held) / span
        for i in range(3):
            change = imu.values[i] - a[HELD_FORCE_B + i]
            force[i] = a[HELD_FORCE_B + i] + middle * change
            a[FORCE_B + i] = a[HELD_FORCE_B + i] + end * change
            change = imu.values[3 + i] - a[HELD_RATE_B + i]
            rate[i] = a[HELD_RATE_B + i] + middle * change
            a[RATE_B + i] = a[HELD_RATE_B + i] + end * change
        a[RATE_VARIANCE] = self.noise.gyro / (span * 1e-9) * ((1 - end) * (1 - end) + end * end)
        propagate(self.x, self.p, dt, force, rate, &self.noise)

    cdef void hold(self, Row* row) noexcept nogil:
        cdef double dt = 0.0
        cdef double* memory = self.memory + row.source * MEMORY_SIZE
        cdef int64_t* stamps = self.source_stamps + row.source * SOURCE_STAMPS_SIZE
        cdef bint same
        if self.stamps[T_IMU] != NEVER:
            dt = (row.t_ns - self.stamps[T_IMU]) * 1e-9
        same = arrive(memory, stamps, row)
        if stamps[T_JUDGED] == NEVER or row.t_ns - stamps[T_JUDGED] >= JUDGE_NS:
            judge(memory, stamps, NULL, 0, same, row.t_ns)
        self.keep_sample(row)
        self.auxiliary[RATE_VARIANCE] = 0.0
        if dt > 0:
            self.auxiliary[RATE_VARIANCE] = self.noise.gyro / (dt if dt > LEAST_SPAN else LEAST_SPAN)
        self.watch(row, dt)

    cdef void watch(self, Row* row, double dt) noexcept nogil:
        cdef double* a = self.auxiliary
        cdef double smooth = 1 - exponential(-dt / SMOOTH_TIME) if a[MEAN_WEIGHT] > 0 else 1.0
        cdef double share = 1 - exponential(-dt / MEAN_TIME)
        cdef double weight = a[MEAN_WEIGHT] + share * (1 - a[MEAN_WEIGHT])
        cdef double step
        cdef double off[3]
        cdef int i, which, mean
        for i in range(3):
            a[SMOOTH_FORCE_B + i] += smooth * (row.values[i] - a[SMOOTH_FORCE_B + i])
        a[MEAN_WEIGHT] = weight
        step = share / weight if weight > 0 else 1.0
        for which in range(2):
            mean = MEAN_RATE_B if which else MEAN_FORCE_B
            for i in range(3):
                off[i] = row.values[3 * which + i] - a[mean + i]
                a[mean + i] += step * off[i]
            a[SCATTER_FORCE + which] = (1 - step) * (
                a[SCATTER_FORCE + which] + step * (off[0] * off[0] + off[1] * off[1] + off[2] * off[2]))
        if not self.stands():
            self.stamps[T_STILL] = NEVER
        elif self.stamps[T_STILL] == NEVER:
            self.stamps[T_STILL] = self.stamps[T]

    cdef bint stands(self) noexcept nogil:
        cdef double interval, own, limit
        if not self.standstill or self.auxiliary[MEAN_WEIGHT] < MEAN_FILLED:
            return False
        interval = self.memory[self.imu_source * MEMORY_SIZE + INTERVAL] if self.wheeled else 0.0
        own = OWN_SCATTER / interval if interval > 0 else 0.0
        limit = own * self.noise.accel
        if self.auxiliary[SCATTER_FORCE] > (self.still_accel2 if self.still_accel2 > limit else limit):
            return False
        limit = own * self.noise.gyro
        if self.auxiliary[SCATTER_RATE] > (self.still_gyro2 if self.still_gyro2 > limit else limit):
            return False
        return (not self.wheeled or self.rests()) and not self.carried(0.0)

    cdef bint carried(self, double speed) noexcept nogil:
        cdef int i
        cdef bint fresh
        if not fabs(speed) <= self.still_wheel:
            return False
        for i in range(self.sources):
            if self.models[i] == GNSS_VELOCITY:
                fresh = self.stamps[T] - self.source_stamps[i * SOURCE_STAMPS_SIZE + T_LAST] <= GNSS_FRESH_NS
                if fresh and self.memory[i * MEMORY_SIZE + LAST_VALUE] > CARRIED and is_trusted(self.memory + i * MEMORY_SIZE):
                    return True
        return False

    cdef bint rests(self) noexcept nogil:
        cdef int i
        cdef bint fresh = False
        for i in range(self.sources):
            if self.models[i] == WHEEL_SPEED:
                if self.stamps[T] - self.source_stamps[i * SOURCE_STAMPS_SIZE + T_LAST] <= WHEEL_FRESH_NS:
                    fresh = True
                    if not fabs(self.memory[i * MEMORY_SIZE + LAST_VALUE]) <= self.still_wheel:
                        return False
        return fresh

    cdef bint is_carried(self) noexcept nogil:
        return self.rests() and self.carried(0.0)

    cdef bint disputed(self, int velocity) noexcept nogil:
        return velocity >= 0 and self.memory[velocity * MEMORY_SIZE + LAST_VALUE] > 0.0 and self.rests()

    cdef int due(self) noexcept nogil:
        """fusiond.motion.constraints_due: 1 still, 2 rolling, 3 both."""
        cdef int64_t now = self.stamps[T]
        cdef int found = 0
        if now - self.stamps[T_CONSTRAINT] < self.constraint_interval:
            return 0
        self.stamps[T_CONSTRAINT] = now
        if self.stamps[T_STILL] != NEVER and now - self.stamps[T_STILL] >= self.still_after:
            found = 1
        if self.non_holonomic and not self.is_carried():
            found += 2
        return found

    cdef void constrain(self) noexcept nogil:
        cdef Observation seen
        cdef int due = self.due()
        if due & 1:
            self.see_rest(&seen)
            if self.apply(1, &seen, self.zero_velocity_factor):  # rejected: it is a quiet drive
                self.see_no_turn(&seen)
                self.apply(2, &seen, 1.0)
                return
        if due & 2 and fabs(self.see_rolling(&seen)) >= self.constraints[0, 5]:
            self.apply(0, &seen, 1.0)

    cdef void see_rest(self, Observation* seen) noexcept nogil:
        cdef int i
        seen.m = 3
        memset(seen.jacobian, 0, 3 * n * sizeof(double))
        for i in range(3):
            seen.jacobian[i * n + VELOCITY + i] = 1.0
            seen.innovation[i] = -self.x[VELOCITY_E + i]
            seen.variance[i] = self.constraints[1, 0]

    cdef void see_no_turn(self, Observation* seen) noexcept nogil:
        cdef double c[9]
        cdef int i
        matrix(self.x + QUATERNION_EB, c)
        seen.m = 3
        memset(seen.jacobian, 0, 3 * n * sizeof(double))
        for i in range(3):
            seen.jacobian[i * n + GYRO_BIAS + i] = 1.0
            # mat_eb' @ skew(earth rate along z)
            seen.jacobian[i * n + ATTITUDE] = c[3 + i] * EARTH_RATE
            seen.jacobian[i * n + ATTITUDE + 1] = -(c[i] * EARTH_RATE)
            seen.innovation[i] = self.auxiliary[RATE_B + i] - self.x[GYRO_BIAS_B + i] - c[6 + i] * EARTH_RATE
            seen.variance[i] = self.constraints[2, 0]

    cdef double see_rolling(self, Observation* seen) noexcept nogil:
        """The non-holonomic constraint; returns the speed [m/s] forward, or while the heading is being chosen over ground."""
        cdef double v[3]
        cdef double by[3 * n]
        cdef double* parameter = &self.constraints[0, 0]
        cdef int i
        point_velocity(self.x, self.auxiliary, parameter, 0, 3, v, by)
        seen.m = 2
        memcpy(seen.jacobian, by + n, 2 * n * sizeof(double))
        for i in range(2):
            seen.innovation[i] = -v[1 + i]
            seen.variance[i] = parameter[3 + i]
        return v[0] if self.stamps[PHASE] == RUNNING else sqrt(v[0] * v[0] + v[1] * v[1])

    # The bank of heading hypotheses (fusiond.bank)

    cdef void look_at(self, int i) noexcept nogil:
        """Let x and P be those of a hypothesis."""
        self.x = self.bank + i * BLOCK + 1
        self.p = self.x + NOMINAL_SIZE

    cdef void choose(self, Row* row, Row* imu) noexcept nogil:
        """fusiond.kernel._choose"""
        cdef double* x = self.x
        cdef double* p = self.p
        cdef double* memory = self.memory + row.source * MEMORY_SIZE
        cdef double* parameter = &self.parameters[row.source, 0]
        cdef int64_t* stamps = self.source_stamps + row.source * SOURCE_STAMPS_SIZE
        cdef int64_t begin = self.stamps[T]
        cdef int model = self.models[row.source], i
        cdef double factor
        for i in range(HYPOTHESES):
            if self.bank[i * BLOCK] > 0:
                self.stamps[T] = begin
                self.look_at(i)
                self.advance(row.t_ns, imu)
        self.stamps[T] = row.t_ns if row.t_ns > begin else begin
        if model == IMU:
            self.hold(row)
            self.constrain_bank()
        else:
            arrive(memory, stamps, row)
            self.remember(model, memory, row)
            if model == WHEEL_SPEED and self.carried(memory[LAST_VALUE]):
                row.outcome = REJECTED
            else:
                factor = self.alike(model, row, parameter, stamps)
                for i in range(HYPOTHESES):
                    if self.bank[i * BLOCK] > 0:
                        self.look_at(i)
                        self.choose_by(i, model, row, parameter, factor)
                stamps[T_FUSED] = row.t_ns
                if model == GNSS_POSITION:
                    self.stamps[T_POSITION] = row.t_ns
                self.x = x
                self.p = p
                self.settle()
        self.x = x
        self.p = p

    cdef void choose_by(self, int i, int model, Row* row, double* parameter, double factor) noexcept nogil:
        cdef Observation seen
        cdef int a
        if model == WHEEL_SPEED:
            wheel(self.x, self.p, self.auxiliary, row.values, parameter, &seen, True)
            seen.variance[0] = seen.variance[0] * parameter[SHARED]
            with_rate_noise(self.auxiliary, &seen)
            self.weigh(i, &seen, factor)
        self.observe(model, row, parameter, &seen)
        for a in range(seen.m):
            seen.variance[a] = seen.variance[a] * parameter[SHARED]
        with_rate_noise(self.auxiliary, &seen)
        if model != WHEEL_SPEED:
            self.weigh(i, &seen, factor)
        self.renew(&seen, factor)

    cdef void take(self, int i, Observation* seen, double factor) noexcept nogil:
        """fusiond.bank.take, of the hypothesis that is looked at."""
        with_rate_noise(self.auxiliary, seen)
        self.weigh(i, seen, factor)
        self.renew(seen, factor)

    cdef void renew(self, Observation* seen, double factor) noexcept nogil:
        cdef double across[3][n]
        cdef double s[3][3]
        project(self.p, seen, across, s)
        update(self.x, self.p, seen, self.gates[seen.m], factor, True, BANK_CLUTTER, across, s)

    cdef void weigh(self, int i, Observation* seen, double factor) noexcept nogil:
        cdef double across[3][n]
        cdef double s[3][3]
        cdef double low[3][3]
        cdef double widened[3]
        cdef double whitened[3]
        cdef double square = 0.0, size = 1.0, floored
        cdef int a
        project(self.p, seen, across, s)
        for a in range(seen.m):
            widened[a] = factor * seen.variance[a]
        if cholesky(s, widened, 1.0, seen.m, low) and whiten(s, seen, widened, whitened):
            for a in range(seen.m):
                square += whitened[a] * whitened[a]
                size *= low[a][a]
            floored = exponential(-(square if square < 1000.0 else 1000.0) / (2 * OUTLIER_VARIANCE))
            for a in range(seen.m):
                floored /= sqrt(OUTLIER_VARIANCE)
            self.bank[i * BLOCK] *= ((1 - OUTLIERS) * exponential(-square / 2) + OUTLIERS * floored) / size

    cdef void constrain_bank(self) noexcept nogil:
        cdef Observation seen
        cdef double fastest = 0.0, speed
        cdef int i, due = self.due()
        if due == 0:
            return
        if due == 2:
            for i in range(HYPOTHESES):
                if self.bank[i * BLOCK] > 0:
                    self.look_at(i)
                    speed = self.see_rolling(&seen)
                    if speed > fastest:
                        fastest = speed
        for i in range(HYPOTHESES):
            if self.bank[i * BLOCK] > 0:
                self.look_at(i)
                if due & 1:
                    self.see_rest(&seen)
                    self.take(i, &seen, self.zero_velocity_factor)
                    self.see_no_turn(&seen)
                    self.take(i, &seen, 1.0)
                elif fastest >= self.constraints[0, 5]:
                    self.see_rolling(&seen)
                    self.take(i, &seen, 1.0)
        self.normalise_bank()

    cdef void normalise_bank(self) noexcept nogil:
        cdef double total = 0.0
        cdef int i
        for i in range(HYPOTHESES):
            total += self.bank[i * BLOCK]
        for i in range(HYPOTHESES):
            self.bank[i * BLOCK] = self.bank[i * BLOCK] / total if total > 0 else 0.0
            if self.bank[i * BLOCK] < LEAST_WEIGHT:
                self.bank[i * BLOCK] = 0.0

    cdef void settle(self) noexcept nogil:
        """fusiond.bank.settle"""
        cdef double errors[HYPOTHESES][n]
        cdef double turns[HYPOTHESES]
        cdef double to_n[9]
        cdef double turned[3]
        cdef double mean = 0.0, spread = 0.0, doubt = 0.0, own
        cdef double* down = to_n + 6
        cdef double* best
        cdef double* p
        cdef int i, a, chosen = -1
        self.normalise_bank()
        for i in range(HYPOTHESES):
            if self.bank[i * BLOCK] > 0 and (chosen < 0 or self.bank[i * BLOCK] > self.bank[chosen * BLOCK]):
                chosen = i
        if chosen < 0:
            return
        best = self.bank + chosen * BLOCK + 1
        mat_ne(best + POSITION_E, to_n)
        for i in range(HYPOTHESES):
            if self.bank[i * BLOCK] > 0:
                difference(self.bank + i * BLOCK + 1, best, errors[i])
                turns[i] = (down[0] * errors[i][ATTITUDE] + down[1] * errors[i][ATTITUDE + 1]
                            + down[2] * errors[i][ATTITUDE + 2])
                mean += self.bank[i * BLOCK] * turns[i]
        for i in range(HYPOTHESES):
            if self.bank[i * BLOCK] > 0:
                p = self.bank + i * BLOCK + 1 + NOMINAL_SIZE
                for a in range(3):
                    turned[a] = (p[(ATTITUDE + a) * n + ATTITUDE] * down[0] + p[(ATTITUDE + a) * n + ATTITUDE + 1] * down[1]
                                 + p[(ATTITUDE + a) * n + ATTITUDE + 2] * down[2])
                own = down[0] * turned[0] + down[1] * turned[1] + down[2] * turned[2]
                spread += self.bank[i * BLOCK] * (own + (turns[i] - mean) * (turns[i] - mean))
                if fabs(turns[i]) > BANK_FAR:
                    doubt += self.bank[i * BLOCK]
        if spread <= self.heading_variance and doubt <= BANK_DOUBT:
            self.collapse(best, errors)

    cdef void collapse(self, double* best, double errors[HYPOTHESES][n]) noexcept nogil:
        """fusiond.bank._collapse"""
        cdef double mean[n]
        cdef double weight
        cdef double* p
        cdef int i, j, k
        memset(mean, 0, sizeof(mean))
        memset(self.p, 0, n * n * sizeof(double))
        for i in range(HYPOTHESES):
            if self.bank[i * BLOCK] > 0:
                axpy(mean, self.bank[i * BLOCK], errors[i])
        for i in range(HYPOTHESES):
            weight = self.bank[i * BLOCK]
            if weight > 0:
                p = self.bank + i * BLOCK + 1 + NOMINAL_SIZE
                for j in range(n):
                    for k in range(n):
                        self.p[j * n + k] += weight * (
                            p[j * n + k] + (errors[i][j] - mean[j]) * (errors[i][k] - mean[k]))
        mirror(self.p)
        memcpy(self.x, best, NOMINAL_SIZE * sizeof(double))
        inject(self.x, mean)
        memset(self.bank, 0, HYPOTHESES * BLOCK * sizeof(double))
        self.stamps[PHASE] = RUNNING
        for i in range(self.sources):
            self.source_stamps[i * SOURCE_STAMPS_SIZE + T_JUDGED] = NEVER

    cdef bint apply(self, int which, Observation* seen, double factor) noexcept nogil:
        cdef double across[3][n]
        cdef double s[3][3]
        cdef Update done
        with_rate_noise(self.auxiliary, seen)
        project(self.p, seen, across, s)
        done = update(self.x, self.p, seen, self.gates[seen.m], factor, True, 0.0, across, s)
        self.auxiliary[CONSTRAINT_RATIO + which] = done.ratio
        self.stamps[(CONSTRAINT_FUSED if done.fused else CONSTRAINT_REJECTED) + which] += 1
        return done.fused

    cdef void remember(self, int model, double* memory, Row* row) noexcept nogil:
        """fusiond.kernel.remember"""
        if model == WHEEL_SPEED:
            memory[LAST_VALUE] = row.values[0]
        elif model == GNSS_VELOCITY:
            memory[LAST_VALUE] = sqrt(row.values[0] * row.values[0] + row.values[1] * row.values[1]) - 3 * sqrt(row.values[3])

    cdef void observe(self, int model, Row* row, double* parameter, Observation* seen) noexcept nogil:
        if model == WHEEL_SPEED:
            wheel(self.x, self.p, self.auxiliary, row.values, parameter, seen, False)
        elif model == GNSS_POSITION:
            gnss_position(self.x, self.auxiliary, row.values, parameter, seen)
        else:
            gnss_velocity(self.x, self.auxiliary, row.values, parameter, seen)

    cdef double alike(self, int model, Row* row, double* parameter, int64_t* stamps) noexcept nogil:
        """fusiond.kernel._factor"""
        cdef double correlation = row.values[2] if model == WHEEL_SPEED else parameter[3], interval, same
        if not correlation > 0 or stamps[T_FUSED] == NEVER:
            return 1.0
        interval = (row.t_ns - stamps[T_FUSED]) * 1e-9
        if interval < 1e-6:
            interval = 1e-6
        same = exponential(-interval / correlation)
        return (1 + same) / (1 - same)

    cdef void measure(self, Row* row) noexcept nogil:
        cdef int model = self.models[row.source], a, companion
        cdef double* parameter = &self.parameters[row.source, 0]
        cdef double* memory = self.memory + row.source * MEMORY_SIZE
        cdef int64_t* stamps = self.source_stamps + row.source * SOURCE_STAMPS_SIZE
        cdef Observation seen
        cdef Update done
        cdef double across[3][n]
        cdef double s[3][3]
        cdef double given[3]
        cdef double learnt[3]
        cdef double whitened[3]
        cdef double factor, elapsed = 0.0, share
        cdef int64_t pause
        cdef bint same, trusted, doubtful
        same = arrive(memory, stamps, row)
        if stamps[T_LAST] != NEVER:
            elapsed = (row.t_ns - stamps[T_LAST]) * 1e-9
        self.remember(model, memory, row)
        self.observe(model, row, parameter, &seen)
        project(self.p, &seen, across, s)
        share = 1.0
        if memory[NOISE_EXCESS] > CHANCE:
            share = 1 + (memory[NOISE_EXCESS] - CHANCE)
        elif memory[NOISE_EXCESS] < -CHANCE:
            share = 1 + (memory[NOISE_EXCESS] + CHANCE)
        if share < parameter[NOISE_LEAST]:
            share = parameter[NOISE_LEAST]
        if share > parameter[NOISE_MOST]:
            share = parameter[NOISE_MOST]
        for a in range(seen.m):
            seen.variance[a] *= parameter[SHARED]
        with_rate_noise(self.auxiliary, &seen)
        for a in range(seen.m):
            given[a] = seen.variance[a]
            learnt[a] = given[a] * share
            row.innovation[a] = seen.innovation[a]
            row.variance[a] = s[a][a] + learnt[a]
        factor = self.alike(model, row, parameter, stamps)
        if stamps[T_LAST] == NEVER or row.t_ns - stamps[T_LAST] > OUTAGE_NS:
            stamps[T_FUSED] = NEVER
            stamps[T_BACK] = row.t_ns
            begin_health(memory)
        pause = <int64_t>(2e9 * (row.values[2] if model == WHEEL_SPEED else parameter[3]))
        companion = <int>parameter[COMPANION]
        doubtful = self.disputed(row.source if model == GNSS_VELOCITY else companion)
        if not doubtful and (
                stamps[T_JUDGED] == NEVER or row.t_ns - stamps[T_JUDGED] >= (pause if pause > JUDGE_NS else JUDGE_NS)):
            if stamps[T_FUSED] != NEVER and tells(s, learnt, seen.m) and whiten(s, &seen, learnt, whitened):
                judge(memory, stamps, whitened, seen.m, same, row.t_ns)
        if not doubtful:
            learn(memory, &seen, given, s, elapsed)
        trusted = is_trusted(memory) and (companion < 0 or is_trusted(self.memory + companion * MEMORY_SIZE))
        if model == WHEEL_SPEED and trusted:
            trusted = not self.carried(memory[LAST_VALUE])
        for a in range(seen.m):
            seen.variance[a] = learnt[a]
            if memory[NOISY] > NOTED:
                seen.variance[a] *= 1 + (NOISY_VARIANCE - 1) * memory[NOISY]
        done = update(self.x, self.p, &seen, self.gates[seen.m], factor, trusted, parameter[CLUTTER], across, s)
        row.ratio = done.ratio
        memory[LAST_RATIO] = done.ratio
        if not done.fused and model != WHEEL_SPEED and self.locked_out(row, memory, stamps, companion, &seen):
            self.reset_block(&seen, POSITION if model == GNSS_POSITION else VELOCITY)
            begin_health(memory)
            done.fused = True
        if done.fused:
            stamps[T_REJECTED] = NEVER
            stamps[T_ALIKE] = NEVER
            stamps[T_FUSED] = row.t_ns
            if model == GNSS_POSITION:
                self.stamps[T_POSITION] = row.t_ns
        else:
            row.outcome = REJECTED
            if stamps[T_REJECTED] == NEVER:
                stamps[T_REJECTED] = row.t_ns

    cdef bint locked_out(self, Row* row, double* memory, int64_t* stamps, int companion, Observation* seen) noexcept nogil:
        """fusiond.measure._locked_out"""
        cdef bint off = moved(memory, seen, self.gates[seen.m])
        cdef int64_t wait = self.gnss_reset
        if off or stamps[T_ALIKE] == NEVER or row.t_ns - stamps[T_LAST] > BREAK_NS:
            stamps[T_ALIKE] = row.t_ns
            return False
        cdef bint returns = stamps[T_FUSED] == NEVER or stamps[T_ALIKE] - stamps[T_BACK] <= OUTAGE_NS
        if (returns and memory[LAST_RATIO] <= NEAR) or self.is_carried():
            wait = self.gnss_return
        elif self.models[row.source] == GNSS_VELOCITY or (
                companion >= 0 and not is_trusted(self.memory + companion * MEMORY_SIZE)):
            wait = SUSPECT * wait
        return row.t_ns - stamps[T_ALIKE] >= wait

    cdef void reset_block(self, Observation* seen, int block) noexcept nogil:
        cdef double to_n[9]
        cdef double spread[9]
        cdef double half[9]
        cdef double* p = self.p
        cdef int i, j, k, m = seen.m
        mat_ne(self.x, to_n)
        for i in range(3):
            for j in range(3):
                half[3 * i + j] = 0.0
                for k in range(3):
                    half[3 * i + j] += to_n[3 * i + k] * p[(block + k) * n + block + j]
        for i in range(3):
            for j in range(3):
                spread[3 * i + j] = 0.0
                for k in range(3):
                    spread[3 * i + j] += half[3 * i + k] * to_n[3 * j + k]
        for i in range(3):
            for j in range(3):
                if i < m or j < m:
                    spread[3 * i + j] = seen.variance[i] if i == j else 0.0
        for i in range(3):
            for k in range(m):
                self.x[block + i] += to_n[3 * k + i] * seen.innovation[k]
            for j in range(n):
                p[(block + i) * n + j] = 0.0
                p[j * n + block + i] = 0.0
        for i in range(3):
            for j in range(3):
                half[3 * i + j] = 0.0
                for k in range(3):
                    half[3 * i + j] += to_n[3 * k + i] * spread[3 * k + j]
        for i in range(3):
            for j in range(3):
                p[(block + i) * n + block + j] = 0.0
                for k in range(3):
                    p[(block + i) * n + block + j] += half[3 * i + k] * to_n[3 * k + j]
        self.stamps[RESETS] += 1
