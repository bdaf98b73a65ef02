# What the translated functions call, written by hand: rows in vector units, views of a state. Their counterparts are
# fusiond.maths.linear and fusiond.filter.state; tests hold both to the same bits.

cdef extern from *:
    """
    typedef double *__restrict__ vector;  /* n numbers that nothing else points to: lets the loops use vector units */
    """
    ctypedef double* vector


cdef inline void axpy(vector to, double factor, vector row) noexcept nogil:
    """to += factor * row"""
    cdef int j
    for j in range(n):
        to[j] += factor * row[j]


cdef inline void linear_mirror(double* p) noexcept nogil:
    cdef int i, j
    for i in range(n):
        for j in range(i + 1, n):
            p[j * n + i] = p[i * n + j]


cdef inline State hypothesis_of(State* state, int64_t number) noexcept nogil:
    """FilterState.hypothesis: nominal state and covariance are its own, the rest is shared."""
    cdef State view = state[0]
    view.nominal = state.bank + number * BLOCK + 1
    view.covariance = view.nominal + NOMINAL_SIZE
    view.tracked = False
    return view


cdef void clear_state(State* state) noexcept nogil:
    """FilterState.clear"""
    cdef int64_t i
    cdef int64_t numbers = NOMINAL_SIZE + n * n + AUXILIARY_SIZE + state.sources * MEMORY_SIZE + HYPOTHESES * BLOCK
    memset(state.nominal, 0, numbers * sizeof(double))
    state.nominal[QUATERNION_EB] = 1.0
    for i in range(STAMPS_SIZE + state.sources * SOURCE_STAMPS_SIZE):
        state.stamps[i] = NEVER
    for i in range(PHASE, STAMPS_SIZE):
        state.stamps[i] = 0
