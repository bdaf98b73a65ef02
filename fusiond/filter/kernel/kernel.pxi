"""The compiled kernel for `n` error states; included by the files that say how many that is.

The filter's functions are translated from Python (functions.pxi, made by tools/translate_kernel). This class binds them to
memory and runs them over a table of events without the interpreter. fusiond.filter.kernel.interpreted.Kernel is its counterpart.
It is built without fused multiply-add and calls nothing of the C library that is not exact, so it gives the same bits on every
processor, and those of the interpreter.
"""

from libc.math cimport INFINITY, NAN, ceil, fabs, floor, isfinite, isnan, ldexp, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.stdlib cimport free, labs, malloc
from libc.string cimport memcpy, memmove, memset

import numpy as np

from fusiond.filter.state import NEVER as _NEVER, QUATERNION_EB as _QUATERNION_EB
from fusiond.filter.rows import Outcome

cdef int64_t NEVER = _NEVER
cdef int QUATERNION_EB = _QUATERNION_EB.start
cdef int32_t WAITING = Outcome.WAITING

include "layout.pxi"
include "primitives.pxi"
include "functions.pxi"


cdef class Kernel:
    """The compiled counterpart of fusiond.filter.kernel.interpreted.Kernel, for one set of parameters."""

    cdef Parameters params
    cdef State state  # the one that is bound
    cdef int64_t sources
    cdef int64_t[::1] models, wheels, velocities
    cdef double[:, ::1] parameters, constraints
    cdef double[::1] head_numbers
    cdef int64_t[::1] head_whole
    cdef Row[::1] table
    cdef int64_t[:, ::1] counts
    cdef double[:, ::1] kept_numbers
    cdef int64_t[:, ::1] kept_whole
    cdef int64_t[::1] kept_applied
    cdef Link* links  # of the stretch that was smoothed last
    cdef int64_t links_room
    cdef int64_t numbers_size, core_size  # of a state, with and without the bank of hypotheses

    def __init__(self, params):
        if params.size != n:
            raise ValueError(f"compiled for {n} error states, not {params.size}")
        self.sources = len(params.sources)
        self.models, self.wheels, self.velocities = (
            np.array(numbers, dtype=np.int64) for numbers in (params.models, params.wheels, params.velocities))
        self.parameters = np.ascontiguousarray(params.model_parameters)
        self.constraints = np.ascontiguousarray(params.constraints)
        load_scalars(&self.params, params)
        self.params.models, self.params.models_count = &self.models[0], len(params.models)
        self.params.wheels, self.params.wheels_count = (&self.wheels[0] if len(params.wheels) else NULL), len(params.wheels)
        self.params.velocities_count = len(params.velocities)
        self.params.velocities = &self.velocities[0] if len(params.velocities) else NULL
        self.params.model_parameters, self.params.constraints = &self.parameters[0, 0], &self.constraints[0, 0]
        for i in range(4):
            self.params.gates[i] = params.gates[i]
        noise = params.noise
        self.params.noise.accel, self.params.noise.gyro = noise.accel, noise.gyro
        self.params.noise.accel_bias, self.params.noise.gyro_bias = noise.accel_bias, noise.gyro_bias
        for i in range(n - CALIBRATIONS):
            self.params.noise.calibrations[i] = noise.calibrations[i]
        self.core_size = NOMINAL_SIZE + n * n + AUXILIARY_SIZE + self.sources * MEMORY_SIZE
        self.numbers_size = self.core_size + HYPOTHESES * BLOCK

    def __dealloc__(self):
        free(self.links)

    cdef int bind(self, double[::1] numbers, int64_t[::1] whole) except -1:
        if numbers.shape[0] != self.numbers_size:
            raise ValueError(f"a state of {self.numbers_size} numbers is needed, not {numbers.shape[0]}")
        if whole.shape[0] != STAMPS_SIZE + self.sources * SOURCE_STAMPS_SIZE:
            raise ValueError("a state of other sources")
        self.state.nominal = &numbers[0]
        self.state.covariance = self.state.nominal + NOMINAL_SIZE
        self.state.auxiliary = self.state.covariance + n * n
        self.state.memory = self.state.auxiliary + AUXILIARY_SIZE
        self.state.bank = self.state.nominal + self.core_size
        self.state.stamps = &whole[0]
        self.state.source_stamps = self.state.stamps + STAMPS_SIZE
        self.state.size, self.state.sources = n, self.sources
        self.state.tracked = False
        return 0

    def propagate(self, state, double dt, double[::1] force_b, double[::1] rate_b):
        """fusiond.filter.strapdown.propagate"""
        self.bind(state.numbers, state.whole)
        strapdown_propagate(&self.state, dt, &force_b[0], &rate_b[0], &self.params.noise)

    def predict(self, state, int64_t t_ns):
        """fusiond.filter.step.predict"""
        self.bind(state.numbers, state.whole)
        step_predict(&self.state, t_ns, &self.params)

    def follow(self, state, Row[::1] rows, int64_t[::1] judged, double[::1] looks):
        """Kernel.follow of the interpreter"""
        cdef int64_t count = rows.shape[0], found
        cdef double[:, ::1] transition = state.transition
        if judged.shape[0] < PARTS * count or transition.shape[0] != n or transition.shape[1] != n:
            raise ValueError("not the arrays of a tracked state and its rows")
        self.bind(state.numbers, state.whole)
        self.state.tracked, self.state.transition = True, &transition[0, 0]
        if self.links_room < LINKS * count + 1:
            free(self.links)
            self.links_room = LINKS * count + 1
            self.links = <Link*> malloc(self.links_room * sizeof(Link))
            if self.links is NULL:
                self.links_room = 0
                raise MemoryError("no memory for the links of a stretch")
        with nogil:
            found = smoothing_follow(&self.state, &rows[0], count, &judged[0], &looks[0], self.links, &self.params)
        return found

    def go_back(self, state, int64_t count, Row[::1] rows, int64_t[::1] judged, double[::1] vector,
                double[:, ::1] matrix, double[::1] looks, int64_t look):
        """Kernel.go_back of the interpreter"""
        if vector.shape[0] != n or matrix.shape[0] != n or matrix.shape[1] != n or count > self.links_room:
            raise ValueError(f"an adjoint of {n} error states is needed")
        self.bind(state.numbers, state.whole)
        with nogil:
            smoothing_go_back(&self.state, self.links, count, &rows[0], &judged[0], &vector[0], &matrix[0, 0], &looks[0],
                              look, &self.params)

    def to_north_east_down(self, double[::1] nominal, double[:, ::1] covariance):
        """fusiond.filter.north_east_down.to_north_east_down"""
        if nominal.shape[0] != NOMINAL_SIZE or covariance.shape[0] != n or covariance.shape[1] != n:
            raise ValueError(f"a state of {n} error states is needed, not {covariance.shape[0]}")
        cdef double[::1] found = np.empty(STATE_N_SIZE)
        north_east_down_to_north_east_down(&nominal[0], &covariance[0, 0], &found[0])
        return found.base

    def attach(self, head, Row[::1] table, int64_t[:, ::1] counts, double[:, ::1] kept_numbers,
               int64_t[:, ::1] kept_whole, int64_t[::1] kept_applied):
        """Kernel.attach of the interpreter"""
        self.head_numbers, self.head_whole = head.numbers, head.whole
        self.table, self.counts = table, counts
        self.kept_numbers, self.kept_whole, self.kept_applied = kept_numbers, kept_whole, kept_applied

    def place(self, int64_t begin, int64_t end, int64_t t_ns, int64_t source, int64_t sequence):
        """fusiond.filter.step.place"""
        return step_place(&self.table[0], begin, end, t_ns, source, sequence)

    def offer(self, int64_t begin, int64_t end, int64_t t_ns, int32_t source, int64_t sequence, int64_t t_receive_ns,
              tuple values):
        """Kernel.offer of the interpreter"""
        cdef int64_t new = step_place(&self.table[0], begin, end, t_ns, source, sequence)
        if new < 0:
            return new
        self.insert(begin + new, end, t_ns, source, sequence, t_receive_ns, WAITING, values)
        return step_first_changed(&self.table[0], begin, new, &self.params)

    cpdef insert(self, int64_t at, int64_t end, int64_t t_ns, int32_t source, int64_t sequence, int64_t t_receive_ns,
                 int32_t outcome, tuple values):
        """Kernel.insert of the interpreter"""
        cdef Row* row = &self.table[at]
        cdef Py_ssize_t i
        memmove(row + 1, row, (end - at) * sizeof(Row))
        memset(row, 0, sizeof(Row))
        row.t_ns, row.source, row.sequence, row.t_receive_ns, row.outcome = t_ns, source, sequence, t_receive_ns, outcome
        for i in range(len(values)):
            row.values[i] = values[i]
        self.counts[source, outcome] += 1

    def restore(self, int64_t kept):
        """Kernel.restore of the interpreter"""
        cdef size_t bank_bytes = HYPOTHESES * BLOCK * sizeof(double)
        memcpy(&self.head_numbers[0], &self.kept_numbers[kept - 1, 0], self.core_size * sizeof(double))
        if self.kept_whole[kept - 1, PHASE] == CHOOSING or self.kept_whole[kept - 1, ALIVE] > 0:
            memcpy(&self.head_numbers[self.core_size], &self.kept_numbers[kept - 1, self.core_size], bank_bytes)
        elif self.head_whole[PHASE] == CHOOSING or self.head_whole[ALIVE] > 0:
            memset(&self.head_numbers[self.core_size], 0, bank_bytes)
        memcpy(&self.head_whole[0], &self.kept_whole[kept - 1, 0], self.head_whole.shape[0] * sizeof(int64_t))

    def run(self, int64_t begin, int64_t end, int64_t applied, int64_t limit_ns, int64_t kept):
        """Kernel.run of the interpreter"""
        cdef bint done
        self.bind(self.head_numbers, self.head_whole)
        with nogil:
            done = self.go(&self.table[0] + begin, end - begin, &applied, limit_ns, &kept)
        return applied, kept, done

    cdef bint go(self, Row* rows, int64_t count, int64_t* applied_io, int64_t limit_ns, int64_t* kept_io) noexcept nogil:
        cdef int64_t applied = applied_io[0], kept = kept_io[0], following = applied, room = self.kept_applied.shape[0]
        cdef int32_t before
        cdef bint done = False
        cdef Row* row
        while True:
            if applied >= count or rows[applied].t_ns > limit_ns:
                done = True
                break
            row = rows + applied
            if kept == room or not step_can_step(&self.state, row, &self.params):
                break
            if following < applied:
                following = applied
            while following < count and self.params.models[rows[following].source] != IMU:
                following += 1
            before = row.outcome
            step_step(&self.state, row, rows + following if following < count else NULL, &self.params)
            if row.outcome != before:
                self.counts[row.source, before] -= 1
                self.counts[row.source, row.outcome] += 1
            applied += 1
            kept = self.keep(row.source, applied, kept)
        applied_io[0], kept_io[0] = applied, kept
        return done

    cdef inline int64_t keep(self, int64_t source, int64_t applied, int64_t kept) noexcept nogil:
        """fusiond.filter.kernel.interpreted.keep"""
        cdef int64_t size = self.core_size
        if self.state.stamps[T] - self.kept_whole[kept - 1, T] < self.params.snapshot_interval_ns:
            return kept
        if not step_is_final(&self.state, source, &self.params):
            return kept
        if self.state.stamps[PHASE] == CHOOSING or self.state.stamps[ALIVE] > 0:
            size = self.numbers_size
        memcpy(&self.kept_numbers[kept, 0], self.state.nominal, size * sizeof(double))
        memcpy(&self.kept_whole[kept, 0], self.state.stamps, self.head_whole.shape[0] * sizeof(int64_t))
        self.kept_applied[kept] = applied
        return kept + 1
