"""The filter's whole state in two flat arrays, so that a snapshot is two copies and a compiled kernel sees plain memory.

Everything that evolves lives here: the nominal state, its covariance, the inertial sample that is held, what the motion
detector and the alignment have gathered, and what the filter remembers of each source. Position, velocity and attitude
are kept in earth-fixed axes: there is no transport rate and no singular point, and a drive over a pole is like any
other. North-east-down is made where people and messages want it (`fusiond.estimator.fusion`).
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from fusiond.maths.typed import Array, Stamps, compiled
from fusiond.maths.wgs84 import SEMI_MAJOR


class _Layout:
    """Hands out the places of one array, one after the other: what is declared next comes next."""

    def __init__(self) -> None:
        self.size = 0

    def one(self) -> int:
        """The place of a number."""
        self.size += 1
        return self.size - 1

    def block(self, count: int) -> slice:
        """The places of several."""
        self.size += count
        return slice(self.size - count, self.size)


_nominal, _error = _Layout(), _Layout()


def _state(count: int) -> tuple[slice, slice]:
    """A block of states that errors add to: its places in the nominal state, and in a row or column of the covariance."""
    return _nominal.block(count), _error.block(count)


# The state: places in FilterState.nominal, and of its error in the covariance; true = nominal (+) error
POSITION_E, POSITION = _state(3)  # m, of the IMU, earth-fixed axes
VELOCITY_E, VELOCITY = _state(3)  # m/s, over ground, earth-fixed axes
QUATERNION_EB, ATTITUDE = _nominal.block(4), _error.block(3)  # body to earth-fixed; rad, e axes: exp([error]x) mat_eb
GYRO_BIAS_B, GYRO_BIAS = _state(3)  # rad/s
ACCEL_BIAS_B, ACCEL_BIAS = _state(3)  # m/s^2
CALIBRATIONS = _error.size  # error states from here on belong to the installation, and to GNSS; nominal ones one higher
WHEEL_SCALE, SCALE = _state(1)  # 1: how much too high wheels read: those of the first group, by default all
MOUNT, MOUNT_ERROR = _state(2)  # rad: pitch and yaw of the IMU against the vehicle
GNSS_ERROR_E, GNSS_ERROR = _state(3)  # m, how far off GNSS positions are for a while (fusiond.filter.gnss_error), e axes
ERROR_SIZE = _error.size  # of the ordinary state; what follows is only in a state of WIDE_SIZE
FURTHER_SCALES, FURTHER_SCALES_ERROR = _state(3)  # 1: the same of the second to fourth group
ANTENNA_B, ANTENNA_ERROR = _state(3)  # m, what the antenna's lever arm is more than configured, b axes
DELAYS, DELAYS_ERROR = _state(2)  # s, what the position's delay is more than configured, the velocity's more than that
HEIGHT_OFFSET, HEIGHT_OFFSET_ERROR = _state(1)  # m, how much too high the barometer reads
INERTIAL_DELAYS, INERTIAL_DELAYS_ERROR = _state(2)  # s, what the delays of gyro and accelerometer are more than configured
SLIP, SLIP_ERROR = _state(1)  # rad per m/s^2: slip angle of the unsteered axle in a bend, out of it
YAW_RATE_OFFSET, YAW_RATE_OFFSET_ERROR = _state(1)  # rad/s, how much too high the car's own yaw rate reads
STEERING_OFFSET, STEERING_OFFSET_ERROR = _state(1)  # rad, of the road wheels, how much too far right they are said to point
STEERING_FACTOR, STEERING_FACTOR_ERROR = _state(1)  # 1: how much too large that is in proportion
UNDERSTEER, UNDERSTEER_ERROR = _state(1)  # rad per m/s^2, by which the road wheels point further into a bend than it needs
INERTIAL_DOUBT = _nominal.one()  # 0..1: how much process noise a lie of the inertial sensor still adds; it fades
NOMINAL_SIZE, WIDE_SIZE = _nominal.size, _error.size

# Auxiliary numbers: places in FilterState.auxiliary
_auxiliary = _Layout()
HELD_FORCE_B = _auxiliary.block(3)  # m/s^2, the newest inertial sample behind the state
HELD_RATE_B = _auxiliary.block(3)  # rad/s
FORCE_B = _auxiliary.block(3)  # m/s^2, interpolated at the state's own instant
RATE_B = _auxiliary.block(3)  # rad/s
MEAN_FORCE_B = _auxiliary.block(3)  # m/s^2, exponential means and variances for leveling and for the motion detector
MEAN_RATE_B = _auxiliary.block(3)  # rad/s
SCATTER_FORCE = _auxiliary.one()  # (m/s^2)^2
SCATTER_RATE = _auxiliary.one()  # (rad/s)^2
MEAN_WEIGHT = _auxiliary.one()  # 1: how much of the mean is filled, in 0..1
REST_RATE_B = _auxiliary.block(3)  # rad/s, mean gyro of the last standstill before the start
FIRST_VELOCITY_N = _auxiliary.block(3)  # m/s, GNSS velocity at the begin of the alignment window
FIX_E = _auxiliary.block(3)  # m, last GNSS antenna position before the start
FIX_VARIANCE = _auxiliary.block(2)  # m^2, horizontal, vertical
FIX_SLOW_SHARE = _auxiliary.one()  # share of these that is slow
CONSTRAINT_RATIO = _auxiliary.block(3)  # last test ratios: non-holonomic, zero velocity, zero rotation
RATE_VARIANCE = _auxiliary.one()  # (rad/s)^2, white noise of RATE_B, per axis
SMOOTH_FORCE_B = _auxiliary.block(3)  # m/s^2, mean over the delays of receivers
MAIN_WEIGHT = _auxiliary.one()  # weight of the main state against those of the rivals in the bank
INERTIAL_ODDS = _auxiliary.one()  # that the inertial sensor lied a moment ago
LED_OFF = _auxiliary.block(2)  # m, north and east: where a suspected receiver's velocity has led off the state so far
LED_OFF_ODDS = _auxiliary.one()  # by what its last fix makes it likelier that its position was led off so
TURNED_AT_REST = _auxiliary.one()  # rad, about the vertical, by the gyro, since all wheels rest
DOUBTED_AT_REST = _auxiliary.one()  # rad, the most of it so far: what the heading has been doubted by
STATE_DOUBT = _auxiliary.one()  # probability that the position is wrong, since the inertial sensor lied
CHANGE_FORCE = _auxiliary.one()  # (m/s^2)^2, mean square of the change from one inertial sample to the next
CHANGE_RATE = _auxiliary.one()  # (rad/s)^2
SUPPORT = _auxiliary.one()  # s, for how long samples agreed with the held one, less how long they did not
LAST_SENSED = _auxiliary.block(6)  # m/s^2, rad/s: the last sample in the sensor's own axes, believed or not
QUANTUM = _auxiliary.block(2)  # m/s^2, rad/s: the least change that was seen
PEAK = _auxiliary.block(2)  # m/s^2, rad/s: the largest reading
FROZEN_ODDS = _auxiliary.block(6)  # that an axis is frozen
SHARE_CHANGED = _auxiliary.block(6)  # share of the samples in which an axis changes while the two others of its kind do
COASTING = _auxiliary.one()  # 1 while the state coasts: the gyro bias's errors are then those of the rate
KEPT_BIAS_B = _auxiliary.block(3)  # rad/s, gyro bias from before that, and its covariance by rows
KEPT_BIAS_COVARIANCE = _auxiliary.block(9)
AUXILIARY_SIZE = _auxiliary.size

# Remembered of each source: columns of FilterState.memory
_memory = _Layout()
LAST_SPEED = _memory.one()  # m/s, last reading of a wheel
LOWEST_SPEED = _memory.one()  # m/s, lowest horizontal speed that the last GNSS velocity leaves possible
LAST_RATIO = _memory.one()  # test ratio of the last update
NOISE_EXCESS = _memory.one()  # learnt variance over the configured one, less 1
BELIEF = _memory.block(4)  # probabilities (fusiond.filter.source_health); all 0 before the first look
NOMINAL, NOISY, BIASED, FROZEN = range(BELIEF.start, BELIEF.stop)
BIAS = _memory.block(3)  # whitened innovation that a biased source would have
BIAS_VARIANCE = _memory.one()
LAST_SUM = _memory.one()  # of the last reading's numbers: shows a repeated one
INTERVAL = _memory.one()  # s, mean spacing of the events
BEFORE = _memory.block(4)  # the probabilities before the look that the newest readings share
EXCLUDED = _memory.one()  # 1: a receiver that was found to lie
MEAN_NIS = _memory.one()  # normalised innovation squared per axis, mean
FROZEN_PLACE = _memory.one()  # which axis of an inertial sensor is frozen (source_health.INERTIAL_AXES); 0: none
FIX_TYPE = _memory.one()  # of a receiver's last fix; 0 before the first
REJECTED_SPEED = _memory.one()  # m/s, mean of a wheel's readings that were rejected in motion
ACTUAL_SPEED = _memory.one()  # m/s, what they should have been, mean; 0 before the first
MEMORY_SIZE = _memory.size

# Stamps and counts: places in FilterState.stamps
_stamps = _Layout()
T = _stamps.one()  # ns, instant of the state
T_IMU = _stamps.one()  # ns, of the held inertial sample
T_CONSTRAINT = _stamps.one()  # ns, of the last round of motion constraints
T_STILL = _stamps.one()  # ns, since when the vehicle stands; NEVER if it does not
T_POSITION = _stamps.one()  # ns, of the last position fused
T_GNSS_ERROR = _stamps.one()  # ns, instant of GNSS_ERROR_E; NEVER where it is to be drawn anew
T_FIRST_VELOCITY = _stamps.one()  # ns, begin of the alignment window; from the start on NEVER if the heading is only given
T_FIX = _stamps.one()  # ns, of FIX_E
T_REST = _stamps.one()  # ns, end of the standstill that REST_RATE_B is the mean of
T_START = _stamps.one()  # ns, when the filter began to run
PHASE = _stamps.one()  # EMPTY, ALIGNING, RUNNING, CHOOSING; from here on 0 in an empty state
RESETS = _stamps.one()  # count of jumps of the state
CONSTRAINT_FUSED = _stamps.block(3)  # counts: non-holonomic, zero velocity, zero rotation
CONSTRAINT_REJECTED = _stamps.block(3)
BLOWN = _stamps.one()  # count of restarts because the state was no longer finite
RESET_REASON = _stamps.one()  # of the last jump: ResetReason
RESET_SOURCE = _stamps.one()  # index of the source behind it, where there is one
HOT_START = _stamps.one()  # result of the check of the stored state: Verdict
ALIVE = _stamps.one()  # count of rival hypotheses in the bank (fusiond.filter.rivals)
SUSPECT = _stamps.one()  # index of the position source of the receiver that a rival calls a liar
STAMPS_SIZE = _stamps.size

# And of each source: columns of FilterState.source_stamps
_source_stamps = _Layout()
T_LAST = _source_stamps.one()  # ns, of its last event
T_FUSED = _source_stamps.one()  # ns, of its last event fused
T_REJECTED = _source_stamps.one()  # ns, of the first of an unbroken run of rejections; NEVER if there is none
T_BACK = _source_stamps.one()  # ns, of its first event before the start
T_JUDGED = _source_stamps.one()  # ns, of the last look at its health
SOURCE_STAMPS_SIZE = _source_stamps.size

EMPTY, ALIGNING, RUNNING, CHOOSING = 0, 1, 2, 3
HYPOTHESES = 13  # of the heading, while it is being chosen (fusiond.filter.heading_bank): twelve all round, and one more
STORED = 12  # the number of that: a stored heading, or a course that contradicts the given one
NEVER = -(2**62)


class ResetReason(IntEnum):
    """Why the state jumped."""

    NONE = 0
    DATA_GAP = 1  # no data for longer than filter.restart_gap_s: it aligns again
    HEADING_LOST = 2  # too long without the inertial sensor: it aligns again
    NOT_FINITE = 3  # a number was no longer finite: it aligns again
    SOURCE_RETURNED = 4  # a receiver contradicted the state, and the state was likelier to be wrong
    HEADING_DECIDED = 5  # the drive decided on the heading, which had been a stored or a given one
    INERTIAL_LIED = 6  # the inertial sensor lied for a while, by all other sources: its part was taken back
    TIME_STEPPED_BACK = 7  # receipt stamps stepped back, a new session: it aligns again


class Verdict(IntEnum):
    """Result of the check of a stored state at the start."""

    NONE = 0  # there is none, or the filter has not started yet
    USED = 1
    DOUBTED = 2
    OTHERWISE_KNOWN = 3
    MOVED = 4
    IN_MOTION = 5
    VAGUE = 6
    FUTURE = 7
    STALE = 8


class FilterState:
    """Views of the two arrays. `copy_from` and `copy` are the snapshot."""

    __slots__ = (
        "auxiliary",
        "bank",
        "core",
        "covariance",
        "memory",
        "nominal",
        "numbers",
        "size",
        "source_stamps",
        "stamps",
        "tracked",
        "transition",
        "whole",
    )

    def __init__(self, sources: int, size: int = ERROR_SIZE) -> None:
        """An empty state for a number of sources and of error states."""
        self.size = size
        self.tracked = False  # whether `transition` is kept up: what has become of an error since that was the identity
        self.transition: Array = np.empty((0, 0))
        block = 1 + NOMINAL_SIZE + size * size
        sizes = [NOMINAL_SIZE, size * size, AUXILIARY_SIZE, sources * MEMORY_SIZE, HYPOTHESES * block]
        ends = np.cumsum(sizes)
        self.numbers: Array = np.zeros(int(ends[-1]))
        self.nominal: Array = self.numbers[: ends[0]]
        self.covariance: Array = self.numbers[ends[0] : ends[1]].reshape(size, size)
        self.auxiliary: Array = self.numbers[ends[1] : ends[2]]
        self.memory: Array = self.numbers[ends[2] : ends[3]].reshape(sources, MEMORY_SIZE)
        self.core: Array = self.numbers[: ends[3]]  # all of this, without the bank
        self.bank: Array = self.numbers[ends[3] :].reshape(HYPOTHESES, block)  # weight, nominal, covariance of each
        self.whole: Stamps = np.full(STAMPS_SIZE + sources * SOURCE_STAMPS_SIZE, NEVER, dtype=np.int64)
        self.stamps: Stamps = self.whole[:STAMPS_SIZE]
        self.source_stamps: Stamps = self.whole[STAMPS_SIZE:].reshape(sources, SOURCE_STAMPS_SIZE)
        self.clear()

    @property
    def sources(self) -> int:
        """Number of sources."""
        return len(self.memory)

    def hypothesis(self, number: int) -> FilterState:
        """A view of one hypothesis as a state: nominal and covariance are its own, the rest is shared."""
        view = FilterState.__new__(FilterState)
        view.size, view.numbers, view.whole, view.bank = self.size, self.numbers, self.whole, self.bank
        view.core, view.tracked, view.transition = self.core, False, self.transition
        view.auxiliary, view.memory, view.stamps = self.auxiliary, self.memory, self.stamps
        view.source_stamps = self.source_stamps
        view.nominal = self.bank[number, 1 : 1 + NOMINAL_SIZE]
        view.covariance = self.bank[number, 1 + NOMINAL_SIZE :].reshape(self.size, self.size)
        return view

    def copy_from(self, other: FilterState) -> None:
        """Become a snapshot of another state. The bank, most of the numbers, is all 0 but while it
        holds hypotheses."""
        if other.fills_bank():
            self.bank[:] = other.bank
        elif self.fills_bank():
            self.bank[:] = 0.0
        self.core[:] = other.core
        self.whole[:] = other.whole

    def track(self) -> None:
        """Keep up from now on what becomes of an error of this state: `transition` (n, n). No snapshot holds it."""
        self.tracked, self.transition = True, np.eye(self.size)

    def fills_bank(self) -> bool:
        """Whether the bank holds hypotheses: of the heading, or rivals."""
        return bool(self.stamps[PHASE] == CHOOSING or self.stamps[ALIVE] > 0)

    def clear(self) -> None:
        """Become empty."""
        self.numbers[:] = 0.0
        self.nominal[QUATERNION_EB.start] = 1.0
        self.whole[:] = NEVER
        self.stamps[PHASE:] = 0

    def copy(self) -> FilterState:
        twin = FilterState(len(self.memory), self.size)
        twin.copy_from(self)
        return twin


@compiled
def is_sound(state: FilterState) -> bool:
    """Whether the nominal state and its variances are finite, and the position is known to better than the Earth's size."""
    spread = 0.0
    for i in range(POSITION.start, POSITION.stop):
        spread += state.covariance[i, i]
    if not 0 <= spread < SEMI_MAJOR * SEMI_MAJOR:
        return False
    total = 0.0
    for i in range(len(state.nominal)):
        total += state.nominal[i]
    for i in range(state.size):
        total += state.covariance[i, i]
    return math.isfinite(total)


@compiled
def variance_about(state: FilterState, x: float, y: float, z: float) -> float:
    """Variance of the attitude's rotation about an earth-fixed axis (x, y, z) of length 1 [rad^2]."""
    p, phi = state.covariance, ATTITUDE.start
    turned = np.empty(3)
    for a in range(3):
        turned[a] = p[phi + a, phi] * x + p[phi + a, phi + 1] * y + p[phi + a, phi + 2] * z
    return x * turned[0] + y * turned[1] + z * turned[2]


@compiled
def count_reset(state: FilterState, reason: int) -> None:
    """Count a reset of the state, and keep its ResetReason."""
    state.stamps[RESETS] += 1
    state.stamps[RESET_REASON] = reason
