"""How the filter starts: level from gravity, heading from the GNSS course or given, gyro bias from a standstill.

While aligning, the state only gathers: means of the inertial samples (`motion.watch`), the last fix, the velocity at the
begin of a window. It starts at the first event at which position and level are known: with one heading where that is
known, else with a bank of them (`fusiond.filter.heading_bank`). In motion, the vehicle's own acceleration, known from the
change of GNSS velocity, is taken out of the accelerometer before leveling. Where fixes come without a velocity, only the
bound of the speed is known at first, and the bank finds velocity and heading from the way that the fixes go. What an
earlier run has stored is judged in `fusiond.filter.hot_start`.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter import hot_start, inertial_sample
from fusiond.filter.heading_bank import BANK_SIGMA
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
from fusiond.filter.rows import Outcome, Row
from fusiond.filter.source_health import arrive
from fusiond.filter.state import (
    ACCEL_BIAS_B,
    ALIGNING,
    ALIVE,
    ANTENNA_B,
    ANTENNA_ERROR,
    ATTITUDE,
    CHOOSING,
    DELAYS,
    DELAYS_ERROR,
    EXCLUDED,
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
    INERTIAL_DOUBT,
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
    SUSPECT,
    T_BACK,
    T_CONSTRAINT,
    T_FIRST_VELOCITY,
    T_FIX,
    T_GNSS_ERROR,
    T_IMU,
    T_LAST,
    T_POSITION,
    T_REST,
    T_START,
    T_STILL,
    VELOCITY,
    VELOCITY_E,
    WIDE_SIZE,
    FilterState,
    T,
    Verdict,
)
from fusiond.filter.stored_state import StoredState
from fusiond.filter.strapdown import end_coasting
from fusiond.maths.portable import atan2, exp, sin_cos, square
from fusiond.maths.rotation import cross, euler, matrix, matrix_from_euler, product, quaternion, skew
from fusiond.maths.typed import Array, Vector, compiled
from fusiond.maths.wgs84 import EQUATOR_GRAVITY, geodetic_trig, mat_ne, mat_ne_from_trig
from fusiond.units import SECOND

Heading = tuple[float, float]  # yaw and its sigma [rad]

FIX_FRESH_NS = 2 * SECOND  # a fix older than this does not start the filter
MIN_WINDOW_NS = SECOND  # the GNSS velocities that give the vehicle's acceleration lie at least so far apart
MAX_WINDOW_NS = 3 * SECOND  # and at most so far
REST_FRESH_NS = 600 * SECOND  # a standstill longer ago says nothing about the gyro bias
REST_BIAS_SIGMA = math.radians(0.05)  # rad/s, gyro bias from the mean of a standstill
ALL_ROUND = 12  # hypotheses of an unknown heading
COURSE_SIGMA = math.radians(2.0)  # rad, body against course: side slip and a careless mount
CONTRADICTED_WEIGHT = 0.5  # of a course that contradicts the given heading, in the bank that decides between them
MOVING_WEIGHT = 0.5  # of a given heading where the vehicle moves at the start, too slowly for a course
OWN_ACCELERATION = 1.0  # m/s^2, sigma of the vehicle's own, over half a second, where nothing tells it
WRAPS = 4  # rounds of the circle either way that such a heading reaches
MAX_SPREAD = 2 * math.pi  # rad: a heading less certain than this is none


def begin(state: FilterState) -> None:
    """Forget everything but the biases and calibrations, and start to align."""
    end_coasting(state)
    for stamp in (T, T_IMU, T_CONSTRAINT, T_STILL, T_FIRST_VELOCITY, T_FIX, T_REST, T_START, T_POSITION, T_GNSS_ERROR):
        state.stamps[stamp] = NEVER
    state.stamps[PHASE] = ALIGNING
    state.stamps[[ALIVE, SUSPECT]] = 0
    state.auxiliary[:] = state.bank[:] = state.nominal[INERTIAL_DOUBT] = 0.0
    state.memory[:, EXCLUDED] = 0.0
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
        if state.source_stamps[source, T_LAST] == NEVER:
            state.source_stamps[source, T_BACK] = t_ns
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
    believed = inertial_sample.judge(state, row, params)
    arrive(state.memory[source], state.source_stamps[source], values, t_ns)
    if not believed:
        row["outcome"] = Outcome.REJECTED
        return
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
    """Start at rest; or in motion, where the receiver gives no velocity, with one of which only the bound is known."""
    speed = _gnss_speed(state)
    if not _leveled(state) or speed >= params.course_speed:
        return
    if _rests(state, params):
        _start(state, source, None, params.constraints[ZERO_VELOCITY, zero_velocity.VARIANCE], None, params)
        return
    heard_ns = state.stamps[T] - state.source_stamps[source, T_BACK]
    if math.isnan(speed) and heard_ns >= MAX_WINDOW_NS:
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
        course = _course(values)
    elif stamps[T_STILL] != NEVER:
        return  # the next position starts it
    _start(state, source, velocity_n, variance, course, params)


def _given(state: FilterState, params: Parameters) -> Heading | None:
    """The configured heading and its sigma [rad], which are those of the first start."""
    if params.filter.heading_deg is None or state.stamps[RESETS]:
        return None
    return math.radians(params.filter.heading_deg), math.radians(params.filter.heading_sigma_deg)


def _course(values: Array) -> Heading:
    """The course of a GNSS velocity, and its sigma as a heading [rad]."""
    north, east = float(values[gnss_velocity.VELOCITY_N.start]), float(values[gnss_velocity.VELOCITY_N.start + 1])
    spread = values[gnss_velocity.VARIANCE] / (square(north) + square(east))
    return atan2(east, north), math.sqrt(spread + square(COURSE_SIGMA))


@compiled
def tells_course(velocity_n: Vector, variance: float, params: Parameters) -> bool:
    """Whether a GNSS velocity, north and east first, is fast enough for a course as good as a heading must be."""
    north, east = velocity_n[0], velocity_n[1]
    return variance <= (north * north + east * east) * (params.heading_variance - COURSE_SIGMA * COURSE_SIGMA)


def prove(state: FilterState, values: Array, params: Parameters) -> bool:
    """Compare a heading that was only given with the course of a GNSS velocity. Where they agree it is confirmed. False
    where they contradict each other at a speed at which the vehicle never reverses."""
    course, x = _course(values), state.nominal
    to_n = mat_ne(x[POSITION_E])
    yaw = euler(product(to_n, matrix(x[QUATERNION_EB])))[2]
    sigma = math.sqrt(float(to_n[2] @ state.covariance[ATTITUDE, ATTITUDE] @ to_n[2]))
    if not _contradict((yaw, sigma), course, params):
        state.stamps[T_FIRST_VELOCITY] = state.stamps[T]
        return True
    north, east = values[gnss_velocity.VELOCITY_N][:2]
    return bool(math.sqrt(square(north) + square(east)) < params.course_speed)


def _is_sure(heading: Heading | None, params: Parameters) -> bool:
    """Whether a heading leaves nothing to choose for a bank."""
    return heading is not None and square(heading[1]) <= params.heading_variance


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
    course: Heading | None,
    params: Parameters,
) -> None:
    """Start from what was gathered: with a velocity (3,) [m/s], or None where it was not measured, and its variance; with
    the given heading where that is sure and the vehicle does not move or the course agrees, else with the course; and where
    there is neither, or they contradict each other, with a bank of hypotheses. A given heading tells how the vehicle stood
    when it was configured: one that was stored later, and contradicts it, is preferred; a start in motion tries it among
    others."""
    given, known, rests = _given(state, params), course, measured_n is None and _rests(state, params)
    slow = rests if measured_n is None else not tells_course(measured_n, variance, params)
    stored, verdict = hot_start.recall(state, params)
    kept: hot_start.Heading | None = None
    if stored is not None and course is None:
        level = _level(state, None, 0.0) if rests else None
        kept, verdict = hot_start.heading(stored, state, source, level, params)
    if given is not None and kept is not None and _contradict(given, (kept.yaw, kept.sigma), params):
        given = None
    apart = given is not None and course is not None and _contradict(given, course, params)
    sure = given is not None and _is_sure(given, params)
    if sure and (slow or course is not None):
        known = given
    first = _first_variances(state, stored, params)
    if known is not None and not apart:
        _place(state, source, measured_n, variance, known, first, params)
        state.stamps[PHASE] = RUNNING
        if stored is not None:
            verdict = Verdict.OTHERWISE_KNOWN
    else:
        other, weight = course, CONTRADICTED_WEIGHT if course is not None else 0.0
        if kept is not None:
            other, weight = (kept.yaw, kept.sigma), _weight_of(kept, given)
        elif sure and not apart:
            other, weight = given, MOVING_WEIGHT
        if sure and not apart:
            given = None  # nothing around it: it may be wrong altogether
        hypotheses = _all_round(given, 1.0 - weight)
        if other is not None:
            hypotheses[STORED] = other, weight
        state.bank[:] = 0.0
        for i, (heading, share) in hypotheses.items():
            state.bank[i, 0] = share
            state.hypothesis(i).nominal[:] = state.nominal  # biases and calibrations of before
            _place(state.hypothesis(i), source, measured_n, variance, heading, first, params)
        state.stamps[PHASE] = CHOOSING
    if verdict:
        state.stamps[HOT_START] = verdict
    told = course is not None or (state.stamps[PHASE] == CHOOSING and given is None)
    state.stamps[T_FIRST_VELOCITY] = state.stamps[T] if told else NEVER
    state.stamps[[T_START, T_CONSTRAINT, T_POSITION]] = state.stamps[T]
    state.stamps[T_GNSS_ERROR] = state.stamps[T_FIX]


def _contradict(one: Heading, other: Heading, params: Parameters) -> bool:
    """Whether two headings are further apart than their sigmas explain."""
    return square(_wrapped(one[0] - other[0])) > params.gates[1] * (square(one[1]) + square(other[1]))


def _all_round(given: Heading | None, weight: float) -> dict[int, tuple[Heading, float]]:
    """Hypotheses by their number, and what share each has of `weight`. They are evenly spread over the circle, and equally
    likely, or, about a given heading, have the weights with which they and their own sigmas make up its normal
    distribution, wrapped around the circle; the closer together, the surer it is."""
    yaw, sigma = (0.0, MAX_SPREAD) if given is None else given
    own = min(sigma / 2, BANK_SIGMA)
    turns = [2 * math.pi * i / ALL_ROUND for i in range(ALL_ROUND)]
    shares = [1.0] * ALL_ROUND
    if given is not None:
        turns = [_wrapped(turn) * (own / BANK_SIGMA) for turn in turns]
        shares = [_density(turn, math.sqrt(square(sigma) - square(own))) for turn in turns]
    total = sum(shares)
    return {i: ((yaw + turns[i], own), weight * shares[i] / total) for i in range(ALL_ROUND) if shares[i] > 0}


def _weight_of(kept: hot_start.Heading, given: Heading | None) -> float:
    """The weight of a stored heading, where another is given as well (Bayes)."""
    if given is None:
        return kept.weight
    likelihood = kept.weight * _density(kept.yaw - given[0], math.sqrt(square(given[1]) + square(kept.sigma)))
    return likelihood / (likelihood + 1.0 - kept.weight)


def _wrapped(angle: float) -> float:
    """An angle [rad], in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _density(turn: float, sigma: float) -> float:
    """Density at an angle [rad] from the mean of a normal distribution that is wrapped around the circle, against that of
    an even one, which is 1."""
    sigma = min(sigma, MAX_SPREAD)
    rounds = [square((_wrapped(turn) + 2 * math.pi * k) / sigma) / 2 for k in range(-WRAPS, WRAPS + 1)]
    return math.sqrt(2 * math.pi) / sigma * sum(exp(-half) for half in rounds)


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
    heading: Heading,
    first: Array,
    params: Parameters,
) -> None:
    """Make the first state of one heading; `first` are the variances of the error states from the gyro bias on."""
    stamps, auxiliary, x = state.stamps, state.auxiliary, state.nominal
    yaw, yaw_sigma = heading
    to_n = mat_ne_from_trig(*geodetic_trig(*(float(c) for c in auxiliary[FIX_E])))
    mat_nb = matrix_from_euler(*_level(state, measured_n, yaw), yaw)
    lever_b = params.model_parameters[source][LEVER_ARM_B]
    swing_b = np.zeros(3) if measured_n is None else cross(auxiliary[RATE_B] - x[GYRO_BIAS_B], lever_b)
    velocity_n = np.zeros(3) if measured_n is None else measured_n - product(mat_nb, swing_b)
    since = (stamps[T] - stamps[T_FIX]) * 1e-9
    x[POSITION_E] = auxiliary[FIX_E] + product(to_n.T, velocity_n * since - product(mat_nb, lever_b))
    x[VELOCITY_E] = product(to_n.T, velocity_n)
    x[QUATERNION_EB] = quaternion(product(to_n.T, mat_nb))
    horizontal, vertical = auxiliary[FIX_VARIANCE]
    level = square(math.radians(params.filter.level_sigma_deg))
    if measured_n is None and not _rests(state, params):
        level += square(OWN_ACCELERATION / EQUATOR_GRAVITY)
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
    _tie_to_attitude(state, product(to_n.T, product(mat_nb, lever_b)), product(to_n.T, product(mat_nb, swing_b)))
    if state.size == WIDE_SIZE:
        _tie(state, _gain(state, measured_n))


def _tie_to_attitude(state: FilterState, lever_e: Array, swing_e: Array) -> None:
    """What the first attitude is off by, the first position and velocity are off by as well: they are the antenna's less the
    arm (3,) [m] and its swing (3,) [m/s]. At rest, no number of fixes tells the one from the other."""
    covariance = state.covariance
    by = np.vstack([skew(lever_e), skew(swing_e)])
    shared = product(by, covariance[ATTITUDE, ATTITUDE])
    covariance[: VELOCITY.stop, : VELOCITY.stop] += product(shared, by.T)
    covariance[: VELOCITY.stop, ATTITUDE] = shared
    covariance[ATTITUDE, : VELOCITY.stop] = shared.T


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
    shared = by * np.diag(covariance)[own]
    covariance[: VELOCITY.stop, : VELOCITY.stop] += product(shared, by.T)
    covariance[: VELOCITY.stop, own] = shared
    covariance[own, : VELOCITY.stop] = shared.T


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
