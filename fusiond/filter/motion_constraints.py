"""What the vehicle's motion alone says: the standstill detector, and the motion constraints applied as measurements."""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter import rivals
from fusiond.filter.measurement_update import project, update_projected
from fusiond.filter.observations import non_holonomic, zero_rotation, zero_velocity
from fusiond.filter.observations.model import LEVER_ARM_B, Observation, mat_eb, with_rate_noise
from fusiond.filter.parameters import Parameters
from fusiond.filter.source_health import is_stuck
from fusiond.filter.state import (
    ALIVE,
    ATTITUDE,
    CONSTRAINT_FUSED,
    CONSTRAINT_RATIO,
    CONSTRAINT_REJECTED,
    DOUBTED_AT_REST,
    GYRO_BIAS_B,
    INTERVAL,
    LAST_SPEED,
    LOWEST_SPEED,
    MEAN_FORCE_B,
    MEAN_RATE_B,
    MEAN_WEIGHT,
    NEVER,
    PHASE,
    POSITION_E,
    RUNNING,
    SCATTER_FORCE,
    SCATTER_RATE,
    SMOOTH_FORCE_B,
    T_CONSTRAINT,
    T_LAST,
    T_STILL,
    TURNED_AT_REST,
    FilterState,
    T,
    variance_about,
)
from fusiond.maths.portable import exp, square
from fusiond.maths.rotation import times
from fusiond.maths.typed import Vector3, compiled
from fusiond.maths.wgs84 import EARTH_RATE, mat_ne
from fusiond.units import SECOND

MEAN_TIME = 0.5  # s, time constant of the exponential means
OWN_SCATTER = 3 * 1.5 * 1.5  # of white noise of unit density in three axes, and a margin of a half
SMOOTH_TIME = 0.08  # s, time constant of the mean force that delays are learnt with
MEAN_FILLED = 0.8  # weight from which a mean is used: 0.8 s after its begin
GNSS_FRESH_NS = 2 * SECOND  # a GNSS velocity older than this says nothing of being carried
CARRIED_SPEED = 1.0  # m/s: slower than this no vehicle is called carried
NON_HOLONOMIC, ZERO_VELOCITY, ZERO_ROTATION = 0, 1, 2  # rows of Parameters.constraints


@compiled
def watch(state: FilterState, force_b: Vector3, rate_b: Vector3, dt: float, params: Parameters) -> None:
    """Take one inertial sample, `dt` [s] after the last, into the means and scatters, and decide whether the vehicle
    stands: since when is in stamps[T_STILL]."""
    auxiliary = state.auxiliary
    smooth = 1 - exp(-dt / SMOOTH_TIME) if auxiliary[MEAN_WEIGHT] > 0 else 1.0
    auxiliary[SMOOTH_FORCE_B] += smooth * (force_b - auxiliary[SMOOTH_FORCE_B])
    share = 1 - exp(-dt / MEAN_TIME)
    weight = auxiliary[MEAN_WEIGHT] + share * (1 - auxiliary[MEAN_WEIGHT])
    auxiliary[MEAN_WEIGHT] = weight
    step = share / weight if weight > 0 else 1.0  # the first samples count fully: no bias towards zero
    off = force_b - auxiliary[MEAN_FORCE_B]
    auxiliary[MEAN_FORCE_B] += step * off
    auxiliary[SCATTER_FORCE] = _scatter(auxiliary[SCATTER_FORCE], off, step)
    off = rate_b - auxiliary[MEAN_RATE_B]
    auxiliary[MEAN_RATE_B] += step * off
    auxiliary[SCATTER_RATE] = _scatter(auxiliary[SCATTER_RATE], off, step)
    if not stands(state, params):
        state.stamps[T_STILL] = NEVER
    elif state.stamps[T_STILL] == NEVER:
        state.stamps[T_STILL] = state.stamps[T]


@compiled
def _scatter(before: float, off: Vector3, step: float) -> float:
    """The exponential mean of the squared distance from the mean, with one sample more, so far `off` the mean."""
    return (1 - step) * (before + step * (off[0] * off[0] + off[1] * off[1] + off[2] * off[2]))


@compiled
def carried(state: FilterState, wheel_speed: float, params: Parameters) -> bool:
    """Whether a wheel at rest says nothing, because the vehicle is carried or towed: GNSS sees it move."""
    if not abs(wheel_speed) <= params.still_wheel:
        return False
    for i in params.velocities:
        fresh = state.stamps[T] - state.source_stamps[i, T_LAST] <= GNSS_FRESH_NS
        if fresh and state.memory[i, LOWEST_SPEED] > CARRIED_SPEED and not is_stuck(state.memory[i]):
            return True
    return False


@compiled
def rests(state: FilterState, params: Parameters) -> bool:
    """Whether every wheel that was heard lately, and is trusted, is at rest, and one was."""
    heard = False
    for i in params.wheels:
        if rivals.speaks(state, i):
            heard = True
            if not abs(state.memory[i, LAST_SPEED]) <= params.still_wheel:
                return False
    return heard


@compiled
def turn_shown(state: FilterState, params: Parameters) -> float:
    """How fast [rad/s] a vehicle may turn by what its wheels read, while all of them rest: those at one side may creep
    forward, the others backward."""
    fastest, left, right = 0.0, math.inf, -math.inf
    for i in params.wheels:
        if rivals.speaks(state, i):
            side = params.model_parameters[i, LEVER_ARM_B.start + 1]
            fastest, left, right = max(fastest, abs(state.memory[i, LAST_SPEED])), min(left, side), max(right, side)
    return 2 * fastest / (right - left) if right > left else 0.0


@compiled
def doubt_turn(state: FilterState, rate_b: Vector3, dt: float, params: Parameters) -> None:
    """Take one angular rate (3,) [rad/s], `dt` [s] long, as doubtful while all wheels rest and nothing says that the vehicle
    is carried: it may turn on a plate, or the gyro lies. So as it turns, faster than a wheel that creeps shows, its heading
    becomes as uncertain as it has turned, until a measurement tells it: a dual antenna, say."""
    if state.stamps[PHASE] != RUNNING or not rests(state, params) or carried(state, 0.0, params):
        state.auxiliary[TURNED_AT_REST] = state.auxiliary[DOUBTED_AT_REST] = 0.0
        return
    down_e = mat_ne(state.nominal[POSITION_E])[2]
    rate_e = times(mat_eb(state), rate_b - state.nominal[GYRO_BIAS_B])
    rate_e[2] -= EARTH_RATE
    turning = 0.0
    for i in range(3):
        turning += down_e[i] * rate_e[i]
    unseen = max(abs(turning) - turn_shown(state, params), 0.0)
    state.auxiliary[TURNED_AT_REST] += unseen * dt if turning > 0 else -unseen * dt
    turned, doubted = abs(state.auxiliary[TURNED_AT_REST]), state.auxiliary[DOUBTED_AT_REST]
    if turned <= doubted:
        return
    state.auxiliary[DOUBTED_AT_REST] = turned
    variance = variance_about(state, down_e[0], down_e[1], down_e[2])
    missing = min(square(turned) - variance, square(turned) - square(doubted))
    if missing > 0:
        for i in range(3):
            for j in range(3):
                state.covariance[ATTITUDE.start + i, ATTITUDE.start + j] += missing * (down_e[i] * down_e[j])


@compiled
def is_carried(state: FilterState, params: Parameters) -> bool:
    """Whether all wheels rest while GNSS sees the vehicle move: its body then goes where it is carried."""
    return rests(state, params) and carried(state, 0.0, params)


@compiled
def disputed(state: FilterState, velocity: int, params: Parameters) -> bool:
    """Whether all wheels rest while a receiver, by its source `velocity` (-1: none), moves: either it is wrong, or the
    vehicle begins to be carried. Nobody is to be blamed for that."""
    return velocity >= 0 and state.memory[velocity, LOWEST_SPEED] > 0.0 and rests(state, params)


@compiled
def stands(state: FilterState, params: Parameters) -> bool:
    """Whether this instant looks like standstill: a quiet IMU, and every fresh wheel at zero (at least one, if any is
    configured)."""
    auxiliary = state.auxiliary
    if not params.standstill or auxiliary[MEAN_WEIGHT] < MEAN_FILLED:
        return False
    wheeled = len(params.wheels) > 0
    interval = state.memory[params.imu_source, INTERVAL] if wheeled else 0.0
    own = OWN_SCATTER / interval if interval > 0 else 0.0  # wheels at zero say what the inertial sensor's noise hides
    if auxiliary[SCATTER_FORCE] > max(square(params.still_accel), own * params.noise.accel):
        return False
    if auxiliary[SCATTER_RATE] > max(square(params.still_gyro), own * params.noise.gyro):
        return False
    return (not wheeled or rests(state, params)) and not carried(state, 0.0, params)


@compiled
def constrain(state: FilterState, params: Parameters) -> None:
    """Apply the constraints that hold now, if the last round is an interval ago."""
    still, rolling = constraints_due(state, params)
    if still and _apply(state, ZERO_VELOCITY, params, params.zero_velocity_factor):  # rejected: it is a quiet drive
        _apply(state, ZERO_ROTATION, params, 1.0)
    elif rolling:
        _apply(state, NON_HOLONOMIC, params, 1.0)


@compiled
def roll(state: FilterState, params: Parameters) -> None:
    """Apply the non-holonomic constraint while the inertial sensor, which shows standstill, is silent."""
    _still, rolling = constraints_due(state, params)
    if rolling and not rests(state, params):
        _apply(state, NON_HOLONOMIC, params, 1.0)


@compiled
def constraints_due(state: FilterState, params: Parameters) -> tuple[bool, bool]:
    """Whether the vehicle stands, and whether its wheels keep it from going sideways, if it is time to look."""
    now = state.stamps[T]
    if now - state.stamps[T_CONSTRAINT] < params.constraint_interval_ns:
        return False, False
    state.stamps[T_CONSTRAINT] = now
    still = state.stamps[T_STILL] != NEVER and now - state.stamps[T_STILL] >= params.still_after_ns
    return still, params.non_holonomic and not is_carried(state, params)


@compiled
def observe_constraint(state: FilterState, which: int, params: Parameters, seen: Observation) -> bool:
    """One constraint as an observation; False where it does not hold now."""
    if which == ZERO_VELOCITY:
        return zero_velocity.observe(state, params.constraints[which], params.constraints[which], seen)
    if which == ZERO_ROTATION:
        return zero_rotation.observe(state, params.constraints[which], params.constraints[which], seen)
    return non_holonomic.observe(state, params.constraints[which], params.constraints[which], seen)


@compiled
def _apply(state: FilterState, which: int, params: Parameters, factor: float) -> bool:
    """Fuse one constraint; whether it passed the gate."""
    seen = Observation(state.size)
    if not observe_constraint(state, which, params, seen):
        return False
    with_rate_noise(state, seen)
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    project(state, seen, across, spread)
    fits = rivals.likelihood(seen.innovation, seen.variance, factor, seen.m, spread)
    ratio, fused = update_projected(state, seen, params.gates[seen.m], factor, True, 0.0, across, spread, True)
    if state.stamps[ALIVE] > 0:
        _apply_to_rivals(state, which, params, factor, fits)
    if which == NON_HOLONOMIC:  # that it stands is inferred itself: it may turn on a plate, or be carried
        rivals.watch_inertial(state, seen, factor, spread, fits)
    state.auxiliary[CONSTRAINT_RATIO.start + which] = ratio
    if fused:
        state.stamps[CONSTRAINT_FUSED.start + which] += 1
    else:
        state.stamps[CONSTRAINT_REJECTED.start + which] += 1
    return fused


@compiled
def _apply_to_rivals(state: FilterState, which: int, params: Parameters, factor: float, fits: float) -> None:
    """Weigh the rivals by a constraint, whose likelihood under the main state is `fits`, and update them."""
    seen = Observation(state.size)
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    for slot in range(rivals.RIVALS):
        if state.bank[slot, 0] > 0:
            rival = state.hypothesis(slot)
            if observe_constraint(rival, which, params, seen):
                with_rate_noise(rival, seen)
                project(rival, seen, across, spread)
                own = rivals.likelihood(seen.innovation, seen.variance, factor, seen.m, spread)
                rivals.weigh(state, slot, own, fits)
                update_projected(rival, seen, params.gates[seen.m], factor, True, 0.0, across, spread, True)
    rivals.decide(state, rests(state, params), params)
