# Propagation: fusiond.strapdown.

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


cdef void coast(double* x, double* p, double dt, Noise* noise, bint rests) noexcept nogil:
    cdef double now[n]
    cdef double since[n]
    cdef double up[3]
    cdef double* r = x + POSITION_E
    cdef double size, first = COAST_TURN2 * dt, second = COAST_TURN2 * (dt * dt / 2)
    cdef double third = COAST_TURN2 * (dt * dt * dt / 3)
    cdef int i, j
    for i in range(3):
        x[POSITION_E + i] += x[VELOCITY_E + i] * dt
    for i in range(3):
        axpy(p + i * n, dt, p + (VELOCITY + i) * n)
    for i in range(n):
        for j in range(3):
            p[i * n + j] += dt * p[i * n + VELOCITY + j]
    mirror(p)
    add_noise(p, dt, 0.0 if rests else COAST_ACCEL2, COAST_TILT2, noise)
    if rests:
        return
    size = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    for i in range(n):
        now[i] = since[i] = 0.0
    for i in range(3):
        up[i] = r[i] / size
        now[ATTITUDE + i] = up[i]
    cross(up, x + VELOCITY_E, now + VELOCITY)
    for i in range(3):
        since[POSITION + i] = now[VELOCITY + i]
    for i in range(n):
        for j in range(i, n):
            p[i * n + j] += first * now[i] * now[j] + third * since[i] * since[j] + second * (
                now[i] * since[j] + since[i] * now[j])
    mirror(p)


cdef void mirror(double* p) noexcept nogil:
    """The upper triangle decides."""
    cdef int i, j
    for i in range(n):
        for j in range(i + 1, n):
            p[j * n + i] = p[i * n + j]
