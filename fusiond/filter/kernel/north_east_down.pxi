# The state in north-east-down, as it is published: fusiond.answer.

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
