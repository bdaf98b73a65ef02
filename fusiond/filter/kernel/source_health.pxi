# What is believed of a source: fusiond.health.

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
    cdef double elapsed = KEEPS, total = 0.0, square = 0.0, off = 0.0, stretch = 1.0, size = 0.0
    cdef double blurred, rest, outlier, alike
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
