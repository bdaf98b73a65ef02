"""The compiled kernel for `n` error states; included by the files that say how many that is. What is not a method of it is
in compiled/, a file for each module of the twin.

Its NumPy twin is the reference: the same equations in the same order, held together by tests. It is built without fused
multiply-add and calls nothing of the C library but the square root, so it gives the same bits on every x86-64.
"""

from libc.math cimport INFINITY, floor, fabs, sqrt, ldexp, isfinite
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memmove, memset

from fusiond.filter import (
    heading_bank, initial_alignment, measurement, measurement_update, motion_constraints, north_east_down, observations,
    source_health, step, strapdown,
)
from fusiond.filter import state as layout
from fusiond.filter.observations import wheel_speed
from fusiond.filter.step import Outcome
from fusiond.maths import portable
from fusiond.maths.wgs84 import GRAVITY_RATIO as _GRAVITY_RATIO
from numpy import empty

include "layout.pxi"
include "maths.pxi"
include "strapdown.pxi"
include "observations.pxi"
include "measurement_update.pxi"
include "source_health.pxi"
include "north_east_down.pxi"


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
            coast(self.x, self.p, (t_ns - carried) * 1e-9, &self.noise, self.rests())
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
                if row.t_ns - self.stamps[T] > self.restart_gap or self.may_be_lost(row):
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
        cdef bint coasted
        cdef double variance
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
            coasted = self.coasts(row.t_ns)
            self.advance(row.t_ns, imu)
            variance = self.yaw_variance() if coasted else 0.0
            if self.models[row.source] == IMU:
                self.hold(row)
                self.constrain()
            elif variance > LOST_HEADING2:
                self.measure_lost(row, variance)
            else:
                self.measure(row)
            self.guard(whole_size)
        self.source_stamps[row.source * SOURCE_STAMPS_SIZE + T_LAST] = row.t_ns

    cdef bint may_be_lost(self, Row* row) noexcept nogil:
        """Whether the IMU is back after so long that the heading may be lost: the twin decides."""
        return (self.stamps[PHASE] == RUNNING and self.models[row.source] == IMU and self.coasts(row.t_ns)
                and self.yaw_variance() + COAST_TURN2 * (row.t_ns - self.stamps[T]) * 1e-9 > LOST_HEADING2 / 2)

    cdef bint coasts(self, int64_t t_ns) noexcept nogil:
        return t_ns - self.stamps[T_IMU] > self.imu_gap

    cdef double yaw_variance(self) noexcept nogil:
        """fusiond.kernel.yaw_variance"""
        cdef double* r = self.x + POSITION_E
        cdef double* block = self.p + ATTITUDE * n + ATTITUDE
        cdef double total = 0.0
        cdef int i, j
        for i in range(3):
            for j in range(3):
                total += r[i] * block[i * n + j] * r[j]
        return total / (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])

    cdef void measure_lost(self, Row* row, double variance) noexcept nogil:
        """fusiond.kernel.measure_lost"""
        cdef double* r = self.x + POSITION_E
        cdef double* block = self.p + ATTITUDE * n + ATTITUDE
        cdef double told
        cdef int i, j
        self.measure(row)
        told = variance - self.yaw_variance()
        if told > 0:
            told /= r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
            for i in range(3):
                for j in range(3):
                    block[i * n + j] += r[i] * r[j] * told

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
            coast(self.x, self.p, dt, &self.noise, self.rests())
            a[RATE_VARIANCE] = COAST_RATE2
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
