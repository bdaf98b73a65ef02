"""How the filter starts: level from gravity, heading from the GNSS course or given, gyro bias from a standstill.

While aligning, the state only gathers: means of the inertial samples (`motion.watch`), the last fix, the velocity at the
begin of a window. It starts at the first event at which position, level and heading are known. In motion, the vehicle's
own acceleration, known from the change of GNSS velocity, is taken out of the accelerometer before leveling. What an
earlier run has stored is judged in `fusiond.filter.hot_start`.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter import hot_start
from fusiond.filter.motion_constraints import MEAN_FILLED, MEAN_TIME, ZERO_VELOCITY, watch
from fusiond.filter.observations import (
    GNSS_POSITION,
    GNSS_VELOCITY,
    IMU,
    WHEEL_SPEED,
    gnss_position,
    gnss_velocity,
    wheel_speed,
    zero_velocity,
)
from fusiond.filter.observations.model import LEVER_ARM_B
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import Row
from fusiond.filter.source_health import arrive
from fusiond.filter.state import (
    ACCEL_BIAS_B,
    ALIGNING,
    ANTENNA_B,
    ANTENNA_ERROR,
    ATTITUDE,
    CHOOSING,
    DELAYS,
    DELAYS_ERROR,
    FIRST_VELOCITY_N,
    FIX_E,
    FIX_SLOW_SHARE,
    FIX_TYPE,
    FIX_VARIANCE,
    FORCE_B,
    GNSS_ERROR,
    GNSS_ERROR_E,
    GYRO_BIAS,
    GYRO_BIAS_B,
    HELD_FORCE_B,
    HELD_RATE_B,
    HOT_START,
    LAST_SPEED,
    MEAN_FORCE_B,
    MEAN_RATE_B,
    MEAN_WEIGHT,
    NEVER,
    PHASE,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    RATE_B,
    RESETS,
    REST_RATE_B,
    RUNNING,
    STORED,
    T_CONSTRAINT,
    T_FIRST_VELOCITY,
    T_FIX,
    T_GNSS_ERROR,
    T_IMU,
    T_POSITION,
    T_REST,
    T_START,
    T_STILL,
    VELOCITY,
    VELOCITY_E,
    WIDE_SIZE,
    FilterState,
    T,
)
from fusiond.filter.stored_state import StoredState
from fusiond.maths.portable import atan2, sin_cos, square
from fusiond.maths.rotation import matrix, matrix_from_euler, product, quaternion
from fusiond.maths.typed import Array, compiled
from fusiond.maths.wgs84 import geodetic_trig, mat_ne, mat_ne_from_trig
from fusiond.units import SECOND

FIX_FRESH_NS = 2 * SECOND  # a fix older than this does not start the filter
MIN_WINDOW_NS = SECOND  # the GNSS velocities that give the vehicle's acceleration lie at least so far apart
MAX_WINDOW_NS = 3 * SECOND  # and at most so far
REST_FRESH_NS = 600 * SECOND  # a standstill longer ago says nothing about the gyro bias
REST_BIAS_SIGMA = math.radians(0.05)  # rad/s, gyro bias from the mean of a standstill
ALL_ROUND = 12  # hypotheses of an unknown heading
BANK_SIGMA = math.radians(12.0)  # rad, of each: wide enough to overlap
COURSE_SIGMA = math.radians(2.0)  # rad, body against course: side slip and a careless mount


def begin(state: FilterState) -> None:
    """Forget everything but the biases and calibrations, and start to align."""
    for stamp in (T, T_IMU, T_CONSTRAINT, T_STILL, T_FIRST_VELOCITY, T_FIX, T_REST, T_START, T_POSITION, T_GNSS_ERROR):
        state.stamps[stamp] = NEVER
    state.stamps[PHASE] = ALIGNING
    state.auxiliary[:] = 0.0
    state.source_stamps[:] = NEVER


def gather(state: FilterState, row: Row, params: Parameters) -> None:
    """Take in one event while aligning, and start the filter if it completes what is needed."""
    stamps, auxiliary, values = state.stamps, state.auxiliary, row["values"]
    t_ns, source = int(row["t_ns"]), int(row["source"])
    model = params.models[source]
    stamps[T] = t_ns
    if model == GNSS_POSITION:
        auxiliary[FIX_E] = values[gnss_position.PLACE_E]
        auxiliary[FIX_VARIANCE] = values[gnss_position.VARIANCE_HORIZONTAL : gnss_position.VARIANCE_VERTICAL + 1]
        auxiliary[FIX_SLOW_SHARE] = params.model_parameters[source, gnss_position.SLOW_SHARE]
        state.memory[source, FIX_TYPE] = values[gnss_position.TYPE_OF_FIX]
        stamps[T_FIX] = t_ns
        _start_by_position(state, source, params)
    elif model == GNSS_VELOCITY:
        _gather_velocity(state, source, values, params)
    else:
        gather_motion(state, row, params)


@compiled
def gather_motion(state: FilterState, row: Row, params: Parameters) -> None:
    """Take in one event that starts nothing: an inertial sample into the means, a wheel's speed for the motion detector."""
    stamps, a, values = state.stamps, state.auxiliary, row["values"]
    t_ns, source = int(row["t_ns"]), int(row["source"])
    stamps[T] = t_ns
    if params.models[source] == WHEEL_SPEED:
        state.memory[source, LAST_SPEED] = values[wheel_speed.SPEED]
    if params.models[source] != IMU:
        return
    arrive(state.memory[source], state.source_stamps[source], values, t_ns)
    if stamps[T_IMU] != NEVER:
        watch(state, values[0:3], values[3:6], (t_ns - stamps[T_IMU]) * 1e-9, params)
    stamps[T_IMU] = t_ns
    for i in range(3):
        a[HELD_FORCE_B.start + i] = a[FORCE_B.start + i] = values[i]
        a[HELD_RATE_B.start + i] = a[RATE_B.start + i] = values[3 + i]
    still = stamps[T_STILL] != NEVER and t_ns - stamps[T_STILL] >= params.still_after_ns
    if still and not _gnss_speed(state) >= params.course_speed:  # a quiet drive without wheels
        a[REST_RATE_B] = a[MEAN_RATE_B]
        stamps[T_REST] = t_ns


def _start_by_position(state: FilterState, source: int, params: Parameters) -> None:
    """Start at rest; or, where no GNSS velocity is to be had, in a motion that only its bound is known of."""
    speed = _gnss_speed(state)
    if not _leveled(state) or speed >= params.course_speed:
        return
    if _rests(state, params):
        _start(state, source, None, params.constraints[ZERO_VELOCITY, zero_velocity.VARIANCE], None, params)
    elif _given(state, params) or not params.velocities:
        _start(state, source, None, square(params.filter.v_max_mps / 3), None, params)


def _gather_velocity(state: FilterState, source: int, values: Array, params: Parameters) -> None:
    stamps, auxiliary = state.stamps, state.auxiliary
    velocity_n = values[gnss_velocity.VELOCITY_N]
    window = stamps[T] - stamps[T_FIRST_VELOCITY]
    if stamps[T_FIRST_VELOCITY] == NEVER or window > MAX_WINDOW_NS:
        auxiliary[FIRST_VELOCITY_N] = velocity_n
        stamps[T_FIRST_VELOCITY] = stamps[T]
        return
    speed = math.sqrt(square(velocity_n[0]) + square(velocity_n[1]))
    fresh = stamps[T_FIX] != NEVER and stamps[T] - stamps[T_FIX] <= FIX_FRESH_NS
    if window < MIN_WINDOW_NS or not fresh or not _leveled(state):
        return
    variance, course = values[gnss_velocity.VARIANCE], None
    if speed >= params.course_speed:
        sigma = math.sqrt(variance / square(speed) + square(COURSE_SIGMA))
        course = atan2(velocity_n[1], velocity_n[0]), sigma
    elif stamps[T_STILL] != NEVER:
        return  # the next position starts it
    _start(state, source, velocity_n, variance, course, params)


def _given(state: FilterState, params: Parameters) -> tuple[float, float] | None:
    """The configured heading and its sigma [rad]: of the first start, and of later ones where there is no newer one."""
    if params.filter.heading_deg is None or (state.stamps[RESETS] and params.velocities):
        return None
    return math.radians(params.filter.heading_deg), math.radians(params.filter.heading_sigma_deg)


@compiled
def _gnss_speed(state: FilterState) -> float:
    """Horizontal speed [m/s] at the begin of the alignment window; nan where no GNSS velocity came of late."""
    first = state.stamps[T_FIRST_VELOCITY]
    if first == NEVER or state.stamps[T] - first > MAX_WINDOW_NS:
        return math.nan
    north, east = state.auxiliary[FIRST_VELOCITY_N.start], state.auxiliary[FIRST_VELOCITY_N.start + 1]
    return math.sqrt(square(north) + square(east))


def _rests(state: FilterState, params: Parameters) -> bool:
    """Whether more than a quiet inertial sensor says that the vehicle stands."""
    return bool(state.stamps[T_STILL] != NEVER) and (bool(params.wheels) or not math.isnan(_gnss_speed(state)))


def _leveled(state: FilterState) -> bool:
    return bool(state.auxiliary[MEAN_WEIGHT] >= MEAN_FILLED)


def _start(
    state: FilterState,
    source: int,
    measured_n: Array | None,
    variance: float,
    heading: tuple[float, float] | None,
    params: Parameters,
) -> None:
    """Start from what was gathered: with a velocity (3,) [m/s], or None where it was not measured, and its variance; with
    a heading and sigma [rad], a given one before a measured one; and where there is none, with a bank of hypotheses all
    round, and a stored one among them."""
    heading = _given(state, params) or heading
    stored, verdict = hot_start.recall(state, params)
    first = _first_variances(state, stored, params)
    if heading is not None:
        _place(state, source, measured_n, variance, heading, first, params)
        state.stamps[PHASE] = RUNNING
    else:
        kept = None
        if stored is not None:
            level = _level(state, None, 0.0) if measured_n is None and _rests(state, params) else None
            kept, verdict = hot_start.heading(stored, state, source, level, params)
        state.bank[:] = 0.0
        headings = [(2 * math.pi * i / ALL_ROUND, BANK_SIGMA) for i in range(ALL_ROUND)]
        state.bank[:ALL_ROUND, 0] = (1.0 - (kept.weight if kept else 0.0)) / ALL_ROUND
        if kept:
            headings.append((kept.yaw, kept.sigma))
            state.bank[STORED, 0] = kept.weight
        for i, turned in enumerate(headings):
            state.hypothesis(i).nominal[:] = state.nominal  # biases and calibrations of before
            _place(state.hypothesis(i), source, measured_n, variance, turned, first, params)
        state.stamps[PHASE] = CHOOSING
    if verdict:
        state.stamps[HOT_START] = verdict
    state.stamps[[T_START, T_CONSTRAINT, T_POSITION]] = state.stamps[T]
    state.stamps[T_GNSS_ERROR] = state.stamps[T_FIX]


def _first_variances(state: FilterState, stored: StoredState | None, params: Parameters) -> Array:
    """Put the first biases and calibrations into the state: stored ones, and the gyro bias of a standstill where that is
    better. Returns the variances (n - 9,) of the error states from the gyro bias on."""
    stamps, x = state.stamps, state.nominal
    rest = stamps[T_REST] != NEVER and stamps[T] - stamps[T_REST] <= REST_FRESH_NS
    gyro = square(min(REST_BIAS_SIGMA, params.imu.gyro_bias_sigma) if rest else params.imu.gyro_bias_sigma)
    variances = [gyro] * 3 + [square(params.imu.accel_bias_sigma)] * 3 + params.calibration_variances.tolist()
    measured = state.auxiliary[REST_RATE_B].copy() if rest else x[GYRO_BIAS_B].copy()
    if stored is not None:
        x[GYRO_BIAS_B.start : state.size + 1], variances = hot_start.aged(stored, state, params)
    trusted = stored is not None and not _contradicted(state, variances, params)
    for a in range(3):
        if not trusted or variances[a] > gyro:
            x[GYRO_BIAS_B.start + a], variances[a] = measured[a], gyro
    return np.array(variances)


def _contradicted(state: FilterState, variances: list[float], params: Parameters) -> bool:
    """Whether the gyro at rest reads something else than the bias in the state, whose variances come first."""
    if state.stamps[T_STILL] == NEVER:
        return False
    noise = square(REST_BIAS_SIGMA) + params.noise.gyro / MEAN_TIME
    off = state.auxiliary[MEAN_RATE_B] - state.nominal[GYRO_BIAS_B]
    return any(square(off[a]) > 9 * (variances[a] + noise) for a in range(3))


def _place(
    state: FilterState,
    source: int,
    measured_n: Array | None,
    variance: float,
    heading: tuple[float, float],
    first: Array,
    params: Parameters,
) -> None:
    """Make the first state of one heading; `first` are the variances of the error states from the gyro bias on."""
    stamps, auxiliary, x = state.stamps, state.auxiliary, state.nominal
    yaw, yaw_sigma = heading
    to_n = mat_ne_from_trig(*geodetic_trig(*(float(c) for c in auxiliary[FIX_E])))
    mat_nb = matrix_from_euler(*_level(state, measured_n, yaw), yaw)
    velocity_n = np.zeros(3) if measured_n is None else measured_n
    since = (stamps[T] - stamps[T_FIX]) * 1e-9
    lever_b = params.model_parameters[source][LEVER_ARM_B]
    x[POSITION_E] = auxiliary[FIX_E] + product(to_n.T, velocity_n * since - product(mat_nb, lever_b))
    x[VELOCITY_E] = product(to_n.T, velocity_n)
    x[QUATERNION_EB] = quaternion(product(to_n.T, mat_nb))
    horizontal, vertical = auxiliary[FIX_VARIANCE]
    level = square(math.radians(params.filter.level_sigma_deg))
    covariance = state.covariance
    covariance[:] = 0.0
    aged = variance * since * since
    covariance[POSITION, POSITION] = product(to_n.T * [horizontal + aged, horizontal + aged, vertical + aged], to_n)
    covariance[VELOCITY, VELOCITY] = np.eye(3) * variance
    covariance[ATTITUDE, ATTITUDE] = product(to_n.T * [level, level, square(yaw_sigma)], to_n)
    for i, own in enumerate(first, GYRO_BIAS.start):
        covariance[i, i] = own
    slow = auxiliary[FIX_SLOW_SHARE] * product(to_n.T * [horizontal, horizontal, vertical], to_n)
    x[GNSS_ERROR_E] = 0.0
    covariance[GNSS_ERROR, GNSS_ERROR] = slow
    covariance[POSITION, GNSS_ERROR] = covariance[GNSS_ERROR, POSITION] = -slow
    if state.size == WIDE_SIZE:
        _tie(state, _gain(state, measured_n))


def _tie(state: FilterState, gain_n: Array) -> None:
    """What the receiver's lever arm and delays are off by, the first position and velocity are off by as well: the antenna
    less the arm, and where and how fast it was before the delay; `gain_n` (3,) [m/s^2] is the change of velocity."""
    x, covariance = state.nominal, state.covariance
    rotation = matrix(x[QUATERNION_EB])
    gain_e = product(mat_ne(x[POSITION_E]).T, gain_n)
    x[POSITION_E] += x[VELOCITY_E] * x[DELAYS][0] - product(rotation, x[ANTENNA_B])
    x[VELOCITY_E] += gain_e * (x[DELAYS][0] + x[DELAYS][1])
    by = np.zeros((VELOCITY.stop, DELAYS_ERROR.stop - ANTENNA_ERROR.start))  # position and velocity, by arm and delays
    by[POSITION, 0:3] = -rotation
    by[POSITION, 3] = x[VELOCITY_E]
    by[VELOCITY, 3] = by[VELOCITY, 4] = gain_e
    own = slice(ANTENNA_ERROR.start, DELAYS_ERROR.stop)
    cross = by * np.diag(covariance)[own]
    covariance[: VELOCITY.stop, : VELOCITY.stop] += product(cross, by.T)
    covariance[: VELOCITY.stop, own] = cross
    covariance[own, : VELOCITY.stop] = cross.T


def _gain(state: FilterState, velocity_n: Array | None) -> Array:
    """Change of velocity (3,) [m/s^2] over the window before the start; none at rest, or where it was not measured."""
    if velocity_n is None or state.stamps[T_STILL] != NEVER or state.stamps[T_FIRST_VELOCITY] == NEVER:
        return np.zeros(3)
    window = (state.stamps[T] - state.stamps[T_FIRST_VELOCITY]) * 1e-9
    gained: Array = (velocity_n - state.auxiliary[FIRST_VELOCITY_N]) / window
    return gained


def _level(state: FilterState, velocity_n: Array | None, yaw: float) -> tuple[float, float]:
    """Roll and pitch [rad] at which the mean specific force is gravity's reaction and the vehicle's own acceleration."""
    force = state.auxiliary[MEAN_FORCE_B] - state.nominal[ACCEL_BIAS_B]
    north, east, _ = _gain(state, velocity_n)
    sine, cosine = sin_cos(yaw)
    force[0] -= cosine * north + sine * east
    force[1] -= cosine * east - sine * north
    return atan2(-force[1], -force[2]), atan2(force[0], math.sqrt(square(force[1]) + square(force[2])))
