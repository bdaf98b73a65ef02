# The measurement update: fusiond.update.

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
