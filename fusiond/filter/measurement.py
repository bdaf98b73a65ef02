"""One measurement judged and fused: its noise, its health, its gate, and the reset where its source was locked out."""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter import gnss_error, source_health
from fusiond.filter.measurement_update import correlation_factor, project, update_projected, whiten
from fusiond.filter.motion_constraints import carried, disputed, is_carried
from fusiond.filter.observations import GNSS_POSITION, GNSS_VELOCITY, WHEEL_SPEED, observe, wheel_speed
from fusiond.filter.observations.gnss_velocity import lowest_speed
from fusiond.filter.observations.model import (
    CLUTTER,
    COMPANION,
    CORRELATION,
    NOISE_MAX,
    NOISE_MIN,
    RESETS,
    SHARED,
    Observation,
    with_rate_noise,
)
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import Row
from fusiond.filter.state import (
    HEIGHT_OFFSET,
    HEIGHT_OFFSET_ERROR,
    LAST_RATIO,
    LAST_SPEED,
    LOWEST_SPEED,
    NEVER,
    POSITION,
    POSITION_E,
    RESET_SOURCE,
    T_BACK,
    T_FUSED,
    T_LAST,
    T_POSITION,
    T_REJECTED,
    T_SAME_ERROR,
    FilterState,
    ResetReason,
    count_reset,
)
from fusiond.maths.typed import Stamps, Vector, compiled
from fusiond.maths.wgs84 import mat_ne

HORIZONTAL = 2  # axes of a fix that are judged together; its height is judged apart
DOUBT_TIME = 30.0  # s: a height that is rejected for so long is believed
BREAK_NS = 5_000_000_000  # rejections further apart do not belong together
OUTAGE_NS = 10_000_000_000  # a source that was silent for longer is new when it returns, for as long
SUSPECT = 6  # times gnss_reset_s, where the receiver's motion is in question
NEAR = 9.0  # test ratio up to which a fix after an outage is taken as right soon


@compiled
def share_noise(state: FilterState, seen: Observation, parameter: Vector) -> None:
    """Add to an observation's variance what it shares with others of its group, and the gyro's noise on the lever arm."""
    for a in range(seen.m):
        seen.variance[a] *= parameter[SHARED]
    with_rate_noise(state, seen)


@compiled
def remember(memory: Vector, model: int, values: Vector) -> None:
    """Keep what the motion detector wants to know of a source's last reading."""
    if model == WHEEL_SPEED:
        memory[LAST_SPEED] = values[wheel_speed.SPEED]
    elif model == GNSS_VELOCITY:
        memory[LOWEST_SPEED] = lowest_speed(values)


@compiled
def factor_of(stamps: Stamps, model: int, values: Vector, parameter: Vector, t_ns: int) -> float:
    """How much less a reading is worth because its error is correlated with that of the one before."""
    if stamps[T_FUSED] == NEVER:
        return 1.0
    return correlation_factor((t_ns - stamps[T_FUSED]) * 1e-9, correlation_of(model, values, parameter))


@compiled
def correlation_of(model: int, values: Vector, parameter: Vector) -> float:
    """Time [s] over which a reading's error stays correlated."""
    return values[wheel_speed.CORRELATED] if model == WHEEL_SPEED else parameter[CORRELATION]


@compiled
def fuse_measurement(state: FilterState, row: Row, params: Parameters) -> bool:  # noqa: PLR0912, PLR0915 - one way of one measurement, top to bottom
    """Judge and fuse one measurement, a row of the table, at the state's own instant. Returns whether it was fused."""
    source, t_ns = int(row["source"]), int(row["t_ns"])
    model, values = params.models[source], row["values"]
    parameter, memory, stamps = params.model_parameters[source], state.memory[source], state.source_stamps[source]
    elapsed = source_health.since_last(stamps, t_ns)
    same = source_health.arrive(memory, stamps, values, t_ns)
    remember(memory, model, values)
    seen = Observation(state.size)
    if model == GNSS_POSITION:
        gnss_error.carry(state, source, values, params)
        gnss_error.note(state, source, values, params)
    if not observe(state, model, values, parameter, seen):
        return False
    m = seen.m
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    project(state, seen, across, spread)
    share_noise(state, seen, parameter)
    given, learnt = np.empty(3), np.empty(3)
    factor = source_health.noise_factor(memory, parameter[NOISE_MIN], parameter[NOISE_MAX])
    for a in range(m):
        given[a] = seen.variance[a]
        learnt[a] = given[a] * factor
        row["innovation"][a] = seen.innovation[a]
        row["variance"][a] = spread[a, a] + learnt[a]
    if model == GNSS_POSITION:
        m = seen.m = HORIZONTAL
    weight = factor_of(stamps, model, values, parameter, t_ns)
    if stamps[T_LAST] == NEVER or t_ns - stamps[T_LAST] > OUTAGE_NS:
        stamps[T_FUSED] = NEVER
        stamps[T_BACK] = t_ns
        source_health.begin(memory)
    companion = int(parameter[COMPANION])
    doubtful = disputed(state, source if model == GNSS_VELOCITY else companion, params)
    if not doubtful:
        if source_health.is_due(stamps, t_ns, correlation_of(model, values, parameter)):
            whitened = np.empty(3)
            known = stamps[T_FUSED] != NEVER and source_health.observes_sensor(spread, learnt, m)
            if known and whiten(spread, seen.innovation, learnt, m, whitened):
                source_health.judge(memory, stamps, whitened, m, same, t_ns)
        source_health.learn(memory, seen.innovation, given, spread, m, elapsed)
    trusted = source_health.is_trusted(memory) and (companion < 0 or source_health.is_trusted(state.memory[companion]))
    if model == WHEEL_SPEED and trusted:
        trusted = not carried(state, memory[LAST_SPEED], params)
    noisy = source_health.noisy_factor(memory)
    for a in range(m):
        seen.variance[a] = learnt[a] * noisy
    ratio, fused = update_projected(state, seen, params.gates[m], weight, trusted, parameter[CLUTTER], across, spread)
    row["ratio"] = memory[LAST_RATIO] = ratio
    if not fused and parameter[RESETS] >= 0 and _locked_out(state, source, t_ns, seen, params):
        _reset(state, source, values, seen, params)
        source_health.begin(memory)
        fused = True
    if model == GNSS_POSITION:
        _fuse_height(state, source, values, factor * noisy, elapsed, trusted or fused, params)
    if fused:
        stamps[T_REJECTED] = stamps[T_SAME_ERROR] = NEVER
        stamps[T_FUSED] = t_ns
        if model == GNSS_POSITION:
            state.stamps[T_POSITION] = t_ns
    elif stamps[T_REJECTED] == NEVER:
        stamps[T_REJECTED] = t_ns
    return fused


@compiled
def _fuse_height(
    state: FilterState, source: int, values: Vector, stretch: float, elapsed: float, trusted: bool, params: Parameters
) -> None:
    """Fuse the height of a fix through a gate of its own: height and horizontal place may each be off alone. Its variance is
    `stretch` times the configured one. While it is rejected the own height becomes uncertain, until it fits."""
    parameter = params.model_parameters[source]
    seen = Observation(state.size)
    if not observe(state, GNSS_POSITION, values, parameter, seen):
        return
    share_noise(state, seen, parameter)
    seen.m = 1
    seen.jacobian[0] = seen.jacobian[2]
    seen.innovation[0], seen.common[0] = seen.innovation[2], seen.common[2]
    seen.variance[0] = seen.variance[2] * stretch
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    project(state, seen, across, spread)
    ratio, fused = update_projected(state, seen, params.gates[1], 1.0, trusted, parameter[CLUTTER], across, spread)
    if fused or not trusted or not ratio < math.inf:
        return
    grown = seen.innovation[0] * seen.innovation[0] / params.gates[1] * min(elapsed / DOUBT_TIME, 1.0)
    down = seen.jacobian[0, POSITION]
    for i in range(3):
        for j in range(3):
            state.covariance[POSITION.start + i, POSITION.start + j] += grown * (down[i] * down[j])


@compiled
def _locked_out(state: FilterState, source: int, t_ns: int, seen: Observation, params: Parameters) -> bool:
    """Whether a GNSS source has been rejected for long, with the same error all the time, so that the state is likelier
    at fault: soon after an outage, or where the vehicle is carried, whose wheels have held the state back; later otherwise;
    and much later for a velocity, or a position whose velocity is not trusted, because the rest of the vehicle then
    contradicts the receiver's motion, as in a slowly growing spoof."""
    memory, stamps = state.memory[source], state.source_stamps[source]
    off = source_health.moved(memory, seen.innovation, seen.variance, seen.m, params.gates[seen.m])
    if off or stamps[T_SAME_ERROR] == NEVER or t_ns - stamps[T_LAST] > BREAK_NS:
        stamps[T_SAME_ERROR] = t_ns
        return False
    wait = params.gnss_reset_ns
    companion = int(params.model_parameters[source, COMPANION])
    returns = stamps[T_FUSED] == NEVER or stamps[T_SAME_ERROR] - stamps[T_BACK] <= OUTAGE_NS
    if (returns and memory[LAST_RATIO] <= NEAR) or is_carried(state, params):
        wait = params.gnss_return_ns
    elif params.models[source] == GNSS_VELOCITY or (
        companion >= 0 and not source_health.is_trusted(state.memory[companion])
    ):
        wait = SUSPECT * wait
    return t_ns - stamps[T_SAME_ERROR] >= wait


@compiled
def _reset(state: FilterState, source: int, values: Vector, seen: Observation, params: Parameters) -> None:
    """Put what a source observes where it says. A barometer's is its own offset: that is no jump."""
    block = int(params.model_parameters[source, RESETS])
    if block == HEIGHT_OFFSET_ERROR.start:
        _reset_offset(state, seen)
        return
    if block == POSITION.start:
        gnss_error.place(state, source, values, seen, params)
    else:
        _reset_block(state, seen, block)
    count_reset(state, ResetReason.SOURCE_RETURNED)
    state.stamps[RESET_SOURCE] = source


@compiled
def _reset_block(state: FilterState, seen: Observation, block: int) -> None:  # noqa: PLR0912 - loops
    """Put the velocity, which begins at `block` in the error state as in the nominal one, where the receiver says, with the
    receiver's uncertainty."""
    x, p, m = state.nominal, state.covariance, seen.m
    to_n = mat_ne(x[POSITION_E])
    half, spread = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            for j in range(3):
                half[i, j] += to_n[i, k] * p[block + k, block + j]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                spread[i, j] += half[i, k] * to_n[j, k]
    for i in range(3):
        for j in range(3):
            if i < m or j < m:
                spread[i, j] = seen.variance[i] if i == j else 0.0
    for i in range(3):
        for k in range(m):
            x[block + i] += to_n[k, i] * seen.innovation[k]
        p[block + i] = 0.0
        p[:, block + i] = 0.0
        half[i] = 0.0
    for i in range(3):
        for k in range(3):
            for j in range(3):
                half[i, j] += to_n[k, i] * spread[k, j]
    for i in range(3):
        for k in range(3):
            for j in range(3):
                p[block + i, block + j] += half[i, k] * to_n[k, j]


@compiled
def _reset_offset(state: FilterState, seen: Observation) -> None:
    """Set the height offset, offset = reading - height, with the covariances that this gives it."""
    p, offset = state.covariance, HEIGHT_OFFSET_ERROR.start
    state.nominal[HEIGHT_OFFSET.start] += seen.innovation[0]
    p[offset] = 0.0
    p[:, offset] = 0.0
    cross = np.zeros(state.size)  # - H P
    for k in range(state.size):
        if seen.jacobian[0, k] != 0.0:
            cross += -seen.jacobian[0, k] * p[k]
    p[offset] = cross
    p[:, offset] = cross
    variance = seen.variance[0]
    for k in range(state.size):
        variance += -(cross[k] * seen.jacobian[0, k])
    p[offset, offset] = variance
