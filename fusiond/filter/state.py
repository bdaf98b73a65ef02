"""The filter's whole state in two flat arrays, so that a snapshot is two copies and a compiled kernel sees plain memory.

Everything that evolves lives here: the nominal state, its covariance, the inertial sample that is held, what the motion
detector and the alignment have gathered, and what the filter remembers of each source. Position, velocity and attitude
are kept in earth-fixed axes: there is no transport rate and no singular point, and a drive over a pole is like any
other. North-east-down is made where people and messages want it (`fusiond.estimator.fusion`).
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from fusiond.maths.typed import Array, Stamps

# Nominal state: slices of FilterState.nominal
POSITION_E = slice(0, 3)  # m, of the IMU, earth-fixed
VELOCITY_E = slice(3, 6)  # m/s, over ground, in earth-fixed axes
QUATERNION_EB = slice(6, 10)  # body to earth-fixed
GYRO_BIAS_B = slice(10, 13)  # rad/s
ACCEL_BIAS_B = slice(13, 16)  # m/s^2
WHEEL_SCALE = slice(16, 17)  # 1: what wheels read too much: those of the first group, which is all unless told otherwise
MOUNT = slice(17, 19)  # rad: pitch and yaw of the IMU against the vehicle
FURTHER_SCALES = slice(19, 22)  # 1: likewise, of the second to fourth group
ANTENNA_B = slice(22, 25)  # m, what the antenna's lever arm is more than configured
DELAYS = slice(25, 27)  # s, what the position's delay is more than configured, and the velocity's more than that
HEIGHT_OFFSET = slice(27, 28)  # m, what the barometer reads too much
NOMINAL_SIZE = 28

# Error state: slices of a row or column of the covariance; true = nominal (+) error
POSITION = slice(0, 3)  # m, e axes
VELOCITY = slice(3, 6)  # m/s, e axes
ATTITUDE = slice(6, 9)  # rad, e axes: mat_eb_true = exp([attitude]x) mat_eb
GYRO_BIAS = slice(9, 12)  # rad/s, b axes
ACCEL_BIAS = slice(12, 15)  # m/s^2, b axes
SCALE = slice(15, 16)  # 1
MOUNT_ERROR = slice(16, 18)  # rad
ERROR_SIZE = 18
FURTHER_SCALES_ERROR = slice(18, 21)  # 1; from here on only in a state of WIDE_SIZE
ANTENNA_ERROR = slice(21, 24)  # m, b axes
DELAYS_ERROR = slice(24, 26)  # s
HEIGHT_OFFSET_ERROR = slice(26, 27)  # m
WIDE_SIZE = 27
CALIBRATIONS = 15  # error states from here on belong to the installation; their nominal states follow one higher

# Auxiliary numbers: slices of FilterState.auxiliary
HELD_FORCE_B = slice(0, 3)  # m/s^2, the newest inertial sample behind the state
HELD_RATE_B = slice(3, 6)  # rad/s
FORCE_B = slice(6, 9)  # m/s^2, interpolated at the state's own instant
RATE_B = slice(9, 12)  # rad/s
MEAN_FORCE_B = slice(12, 15)  # m/s^2, exponential means and variances for leveling and for the motion detector
MEAN_RATE_B = slice(15, 18)  # rad/s
SCATTER_FORCE = 18  # (m/s^2)^2
SCATTER_RATE = 19  # (rad/s)^2
MEAN_WEIGHT = 20  # 1: how much of the mean is filled, in 0..1
REST_RATE_B = slice(21, 24)  # rad/s, mean gyro of the last standstill before the start
FIRST_VELOCITY_N = slice(24, 27)  # m/s, GNSS velocity at the begin of the alignment window
FIX_E = slice(27, 30)  # m, last GNSS antenna position before the start
FIX_VARIANCE = slice(30, 32)  # m^2, horizontal, vertical
CONSTRAINT_RATIO = slice(32, 35)  # last test ratios: non-holonomic, zero velocity, zero rotation
RATE_VARIANCE = 35  # (rad/s)^2, white noise of RATE_B, per axis
SMOOTH_FORCE_B = slice(36, 39)  # m/s^2, mean over the delays of receivers
AUXILIARY_SIZE = 39

# Remembered of each source: columns of FilterState.memory
LAST_SPEED = 0  # m/s, last reading of a wheel; of a GNSS velocity, the lowest horizontal speed that it leaves possible
LAST_RATIO = 1  # test ratio of the last update
NOISE_EXCESS = 2  # learnt variance over the configured one, less 1
BELIEF = slice(3, 7)  # probabilities (fusiond.filter.source_health); all 0 before the first look
NOMINAL, NOISY, BIASED, FROZEN = 3, 4, 5, 6
BIAS = slice(7, 10)  # whitened innovation that a biased source would have
BIAS_VARIANCE = 10
LAST_SUM = 11  # of the last reading's numbers: tells a repeated one
INTERVAL = 12  # s, mean spacing of the events
LAST_INNOVATION = slice(13, 16)  # of the last rejection
MEAN_NIS = 16  # normalised innovation squared per axis, mean
MEMORY_SIZE = 17

# Stamps and counts: indices of FilterState.stamps
T = 0  # ns, instant of the state
T_IMU = 1  # ns, of the held inertial sample
T_CONSTRAINT = 2  # ns, of the last round of motion constraints
T_STILL = 3  # ns, since when the vehicle stands; NEVER if it does not
T_POSITION = 4  # ns, of the last position fused
T_FIRST_VELOCITY = 5  # ns, begin of the alignment window
T_FIX = 6  # ns, of FIX_E
T_REST = 7  # ns, end of the standstill that REST_RATE_B is the mean of
T_START = 8  # ns, when the filter began to run
PHASE = 9  # EMPTY, ALIGNING, RUNNING, CHOOSING
RESETS = 10  # count of jumps of the state
CONSTRAINT_FUSED = slice(11, 14)  # counts: non-holonomic, zero velocity, zero rotation
CONSTRAINT_REJECTED = slice(14, 17)
BLOWN = 17  # count of restarts because the state was no longer finite
RESET_REASON = 18  # of the last jump: ResetReason
RESET_SOURCE = 19  # index of the source behind it, where there is one
HOT_START = 20  # what became of the stored state: Verdict
STAMPS_SIZE = 21

# And of each source: columns of FilterState.source_stamps
T_LAST = 0  # ns, of its last event
T_FUSED = 1  # ns, of its last event fused
T_REJECTED = 2  # ns, of the first of an unbroken row of rejections; NEVER if there is none
T_JUDGED = 3  # ns, of the last look at its health
T_ALIKE = 4  # ns, since when its rejected readings are off alike; NEVER if there is none
T_BACK = 5  # ns, since when it is heard again after an outage, or for the first time
SOURCE_STAMPS_SIZE = 6

EMPTY, ALIGNING, RUNNING, CHOOSING = 0, 1, 2, 3
HYPOTHESES = 13  # of the heading, while it is being chosen (fusiond.filter.heading_bank): twelve all round, and a stored one
STORED = 12  # the number of that
NEVER = -(2**62)


class ResetReason(IntEnum):
    """Why the state jumped."""

    NONE = 0
    DATA_GAP = 1  # no data for longer than filter.restart_gap_s: it aligns anew
    HEADING_LOST = 2  # without the inertial sensor for so long that the heading was lost: it aligns anew
    NOT_FINITE = 3  # a number was no longer finite: it aligns anew
    SOURCE_RETURNED = 4  # a source that was rejected all the time with the same error was taken as right
    HEADING_DECIDED = 5  # the drive decided on the heading, which had been a stored one


class Verdict(IntEnum):
    """What became of a stored state at the start."""

    NONE = 0  # there is none, or the filter has not started yet
    BELIEVED = 1
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
        "whole",
    )

    def __init__(self, sources: int, size: int = ERROR_SIZE) -> None:
        """An empty state for a number of sources and of error states."""
        self.size = size
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
        view.core = self.core
        view.auxiliary, view.memory, view.stamps = self.auxiliary, self.memory, self.stamps
        view.source_stamps = self.source_stamps
        view.nominal = self.bank[number, 1 : 1 + NOMINAL_SIZE]
        view.covariance = self.bank[number, 1 + NOMINAL_SIZE :].reshape(self.size, self.size)
        return view

    def copy_from(self, other: FilterState) -> None:
        """Become a snapshot of another state. The bank, most of the numbers, is all 0 but while a heading is chosen."""
        if other.stamps[PHASE] == CHOOSING:
            self.bank[:] = other.bank
        elif self.stamps[PHASE] == CHOOSING:
            self.bank[:] = 0.0
        self.core[:] = other.core
        self.whole[:] = other.whole

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
