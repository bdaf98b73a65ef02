# Observation models: fusiond.observe.

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
