"""What the vehicle's motion alone tells: the standstill detector, and the constraints applied as measurements."""

from __future__ import annotations

from fusiond.filter.measurement_update import update
from fusiond.filter.observations import CONSTRAINTS
from fusiond.filter.observations.model import with_rate_noise
from fusiond.filter.parameters import SECOND, Plan
from fusiond.filter.source_health import is_trusted
from fusiond.filter.state import (
    CONSTRAINT_FUSED,
    CONSTRAINT_RATIO,
    CONSTRAINT_REJECTED,
    INTERVAL,
    LAST_VALUE,
    MEAN_FORCE_B,
    MEAN_RATE_B,
    MEAN_WEIGHT,
    NEVER,
    SCATTER_FORCE,
    SCATTER_RATE,
    SMOOTH_FORCE_B,
    T_CONSTRAINT,
    T_LAST,
    T_STILL,
    FilterState,
    T,
)
from fusiond.maths.portable import exp, square
from fusiond.maths.wgs84 import Array

MEAN_TIME = 0.5  # s, time constant of the exponential means
OWN_SCATTER = 3 * 1.5 * 1.5  # of white noise of unit density in three axes, and a margin of a half
SMOOTH_TIME = 0.08  # s, time constant of the mean force that delays are learnt with
MEAN_FILLED = 0.8  # weight from which a mean is used: 0.8 s after its begin
GNSS_FRESH_NS = 2 * SECOND  # a GNSS velocity older than this tells nothing of being carried
CARRIED = 1.0  # m/s: slower than this no vehicle is called carried
WHEEL_FRESH_NS = SECOND // 2  # a wheel silent for longer tells nothing of standing
NON_HOLONOMIC, ZERO_VELOCITY, ZERO_ROTATION = 0, 1, 2


def watch(state: FilterState, force_b: Array, rate_b: Array, dt: float, plan: Plan) -> None:
    """Take one inertial sample, `dt` [s] after the last, into the means and scatters, and decide whether the vehicle
    stands: since when is in stamps[T_STILL]."""
    auxiliary = state.auxiliary
    smooth = 1 - exp(-dt / SMOOTH_TIME)
    auxiliary[SMOOTH_FORCE_B] += (smooth if auxiliary[MEAN_WEIGHT] > 0 else 1.0) * (force_b - auxiliary[SMOOTH_FORCE_B])
    share = 1 - exp(-dt / MEAN_TIME)
    weight = auxiliary[MEAN_WEIGHT] + share * (1 - auxiliary[MEAN_WEIGHT])
    auxiliary[MEAN_WEIGHT] = weight
    step = share / weight if weight > 0 else 1.0  # the first samples count fully: no bias towards zero
    for mean, sample, scatter in (
        (MEAN_FORCE_B, force_b, SCATTER_FORCE),
        (MEAN_RATE_B, rate_b, SCATTER_RATE),
    ):
        off = sample - auxiliary[mean]
        auxiliary[mean] += step * off
        square = float(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])
        auxiliary[scatter] = (1 - step) * (auxiliary[scatter] + step * square)
    if not stands(state, plan):
        state.stamps[T_STILL] = NEVER
    elif state.stamps[T_STILL] == NEVER:
        state.stamps[T_STILL] = state.stamps[T]


def carried(state: FilterState, wheel_speed: float, plan: Plan) -> bool:
    """Whether a wheel at rest tells nothing, because the vehicle is carried or towed: GNSS sees it move."""
    if abs(wheel_speed) > plan.motion.still_wheel_mps:
        return False
    for i in plan.velocities:
        fresh = state.stamps[T] - state.source_stamps[i, T_LAST] <= GNSS_FRESH_NS
        if fresh and state.memory[i, LAST_VALUE] > CARRIED and is_trusted(state.memory[i]):
            return True
    return False


def rests(state: FilterState, plan: Plan) -> bool:
    """Whether every wheel that was heard lately is at rest, and one was."""
    fresh = [i for i in plan.wheels if state.stamps[T] - state.source_stamps[i, T_LAST] <= WHEEL_FRESH_NS]
    return bool(fresh) and all(abs(state.memory[i, LAST_VALUE]) <= plan.motion.still_wheel_mps for i in fresh)


def is_carried(state: FilterState, plan: Plan) -> bool:
    """Whether all wheels rest while GNSS sees the vehicle move: its body then goes where it is carried."""
    return rests(state, plan) and carried(state, 0.0, plan)


def disputed(state: FilterState, velocity: int, plan: Plan) -> bool:
    """Whether all wheels rest while a receiver, by its source `velocity` (-1: none), moves: either it is wrong, or the
    vehicle begins to be carried. Nobody is to be blamed for that."""
    return velocity >= 0 and bool(state.memory[velocity, LAST_VALUE] > 0.0) and rests(state, plan)


def stands(state: FilterState, plan: Plan) -> bool:
    """Whether this instant looks like standstill: a quiet IMU, and every fresh wheel at zero (at least one, if any is
    configured)."""
    motion, auxiliary = plan.motion, state.auxiliary
    if not motion.standstill or auxiliary[MEAN_WEIGHT] < MEAN_FILLED:
        return False
    interval = state.memory[plan.imu_source, INTERVAL] if plan.wheels else 0.0
    own = OWN_SCATTER / interval if interval > 0 else 0.0  # wheels at zero tell what the inertial sensor's noise hides
    if auxiliary[SCATTER_FORCE] > max(square(motion.still_accel_mps2), own * plan.noise.accel):
        return False
    if auxiliary[SCATTER_RATE] > max(square(plan.still_gyro), own * plan.noise.gyro):
        return False
    if plan.wheels and not rests(state, plan):
        return False
    return not carried(state, 0.0, plan)


def constrain(state: FilterState, plan: Plan) -> None:
    """Apply the constraints that hold now, if the last round is an interval ago."""
    still, rolling = constraints_due(state, plan)
    if still and _apply(state, ZERO_VELOCITY, plan, plan.zero_velocity_factor):  # rejected: it is a quiet drive
        _apply(state, ZERO_ROTATION, plan)
    elif rolling:
        _apply(state, NON_HOLONOMIC, plan)


def constraints_due(state: FilterState, plan: Plan) -> tuple[bool, bool]:
    """Whether the vehicle stands, and whether its wheels keep it from going sideways, if it is time to look."""
    now = state.stamps[T]
    if now - state.stamps[T_CONSTRAINT] < plan.constraint_interval_ns:
        return False, False
    state.stamps[T_CONSTRAINT] = now
    still = bool(state.stamps[T_STILL] != NEVER and now - state.stamps[T_STILL] >= plan.still_after_ns)
    return still, plan.motion.non_holonomic and not is_carried(state, plan)


def _apply(state: FilterState, which: int, plan: Plan, factor: float = 1.0) -> bool:
    """Fuse one constraint; whether it passed the gate."""
    parameters = plan.constraints[which]
    seen = CONSTRAINTS[which].observe(state, parameters, parameters)
    if seen is None:
        return False
    ratio, fused = update(state, with_rate_noise(state, seen), plan.gates[len(seen.innovation)], factor)
    state.auxiliary[CONSTRAINT_RATIO.start + which] = ratio
    counts = CONSTRAINT_FUSED if fused else CONSTRAINT_REJECTED
    state.stamps[counts.start + which] += 1
    return fused
