"""A measurement judged and fused: its health, its noise, its gate, and what a source does that was rejected for too long.

Part of the NumPy twin of the compiled kernel (fusiond.filter.step).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.filter import source_health as health
from fusiond.filter.measurement_update import correlation_factor, update, whiten
from fusiond.filter.motion_constraints import carried, disputed, is_carried
from fusiond.filter.observations import MODELS, gnss_velocity, wheel_speed
from fusiond.filter.observations.model import (
    CLUTTER,
    COMPANION,
    CORRELATION,
    NOISE_LEAST,
    NOISE_MOST,
    SHARED,
    Observation,
    with_rate_noise,
)
from fusiond.filter.parameters import MODEL, Plan
from fusiond.filter.state import (
    HEIGHT_OFFSET,
    HEIGHT_OFFSET_ERROR,
    LAST_RATIO,
    LAST_VALUE,
    NEVER,
    POSITION,
    POSITION_E,
    RESETS,
    T_ALIKE,
    T_BACK,
    T_FUSED,
    T_LAST,
    T_POSITION,
    T_REJECTED,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.wgs84 import Array, mat_ne

BREAK_NS = 5_000_000_000  # rejections further apart are not of one row
OUTAGE_NS = 10_000_000_000  # a source silent for longer comes back anew, and is new for as long
SUSPECT = 6  # times gnss_reset_s, where the receiver's motion is in question
RESETTABLE = {  # what a source resets that was rejected for too long: error states and nominal states
    MODEL["gnss_position"]: (POSITION, POSITION_E),
    MODEL["gnss_velocity"]: (VELOCITY, VELOCITY_E),
    MODEL["barometric_height"]: (HEIGHT_OFFSET_ERROR, HEIGHT_OFFSET),
}
NEAR = 9.0  # test ratio up to which a fix after an outage is believed soon


def shared(state: FilterState, seen: Observation, parameters: Array) -> Observation:
    """An observation with what it shares with others of its group, and with the gyro's noise on the lever arm."""
    return with_rate_noise(state, seen._replace(variance=seen.variance * parameters[SHARED]))


def remember(memory: Array, model: int, values: Array) -> None:
    """What the motion detector wants to know of a source's last reading."""
    if model == MODEL["wheel_speed"]:
        memory[LAST_VALUE] = values[wheel_speed.SPEED]
    elif model == MODEL["gnss_velocity"]:
        memory[LAST_VALUE] = gnss_velocity.least_speed(values)


def factor_of(stamps: NDArray[np.int64], model: int, values: Array, parameters: Array, t_ns: int) -> float:
    """How much less a reading is worth because its error is like that of the one before."""
    interval = (t_ns - int(stamps[T_FUSED])) * 1e-9 if stamps[T_FUSED] != NEVER else math.inf
    return correlation_factor(interval, correlation(model, values, parameters))


def correlation(model: int, values: Array, parameters: Array) -> float:
    """Time [s] over which a reading's error stays alike."""
    return float(values[wheel_speed.ALIKE] if model == MODEL["wheel_speed"] else parameters[CORRELATION])


def measure(state: FilterState, row: Any, plan: Plan) -> bool:
    """Judge and fuse one measurement, a row of the table, at the state's own instant. Returns whether it was fused."""
    source, t_ns = int(row["source"]), int(row["t_ns"])
    model, values = plan.models[source], row["values"]
    parameters, memory, stamps = plan.parameters[source], state.memory[source], state.source_stamps[source]
    same, elapsed = health.arrive(memory, stamps, values, t_ns)
    remember(memory, model, values)
    seen = MODELS[model].observe(state, values, parameters)
    assert seen is not None, "a source's model always observes"
    m = len(seen.innovation)
    predicted = np.einsum("ij,jk,ik->i", seen.jacobian, state.covariance, seen.jacobian)
    given = shared(state, seen, parameters).variance
    learnt = given * health.noise_factor(memory, parameters[NOISE_LEAST], parameters[NOISE_MOST])
    row["innovation"][:m], row["variance"][:m] = seen.innovation, predicted + learnt
    factor = factor_of(stamps, model, values, parameters, t_ns)
    if stamps[T_LAST] == NEVER or t_ns - int(stamps[T_LAST]) > OUTAGE_NS:
        stamps[T_FUSED], stamps[T_BACK] = NEVER, t_ns
        health.begin(memory)
    companion = int(parameters[COMPANION])
    doubtful = disputed(state, source if source in plan.velocities else companion, plan)
    known = stamps[T_FUSED] != NEVER and health.tells(predicted, learnt) and not doubtful
    if known and health.is_due(stamps, t_ns, correlation(model, values, parameters)):
        whitened = whiten(state, seen._replace(variance=learnt))
        if whitened is not None:
            health.judge(memory, stamps, health.Judgement(whitened, same, t_ns))
    if not doubtful:
        health.learn(memory, (seen.innovation, given), predicted, elapsed)
    trusted = health.is_trusted(memory) and (companion < 0 or health.is_trusted(state.memory[companion]))
    trusted = trusted and not (model == MODEL["wheel_speed"] and carried(state, memory[LAST_VALUE], plan))
    seen = seen._replace(variance=learnt * health.noisy_factor(memory))
    ratio, fused = update(state, seen, plan.gates[m], factor, trusted, float(parameters[CLUTTER]))
    row["ratio"] = memory[LAST_RATIO] = ratio
    if not fused and model in RESETTABLE and _locked_out(state, source, seen, t_ns, plan):
        _reset_block(state, seen, model)
        health.begin(memory)
        fused = True
    if fused:
        stamps[T_REJECTED] = stamps[T_ALIKE] = NEVER
        stamps[T_FUSED] = t_ns
        if model == MODEL["gnss_position"]:
            state.stamps[T_POSITION] = t_ns
    elif stamps[T_REJECTED] == NEVER:
        stamps[T_REJECTED] = t_ns
    return fused


def _locked_out(state: FilterState, source: int, seen: Observation, t_ns: int, plan: Plan) -> bool:
    """Whether a GNSS source has been rejected for so long, off alike all the time, that the state is the more likely
    culprit: soon after an outage, or where the vehicle is carried, whose wheels have held the state back; later otherwise;
    and much later for a velocity, or a position whose velocity is not trusted, because the rest of the vehicle then
    contradicts the receiver's motion, as in a drift-off."""
    memory, stamps = state.memory[source], state.source_stamps[source]
    gate = plan.gates[len(seen.innovation)]
    off = health.moved(memory, seen.innovation, seen.variance, gate)
    if off or stamps[T_ALIKE] == NEVER or t_ns - int(stamps[T_LAST]) > BREAK_NS:
        stamps[T_ALIKE] = t_ns
        return False
    wait = plan.gnss_reset_ns
    companion = int(plan.parameters[source, COMPANION])
    returns = stamps[T_FUSED] == NEVER or stamps[T_ALIKE] - stamps[T_BACK] <= OUTAGE_NS
    if (returns and memory[LAST_RATIO] <= NEAR) or is_carried(state, plan):
        wait = plan.gnss_return_ns
    elif source in plan.velocities or (companion >= 0 and not health.is_trusted(state.memory[companion])):
        wait = SUSPECT * wait
    return t_ns - int(stamps[T_ALIKE]) >= wait


def _reset_block(state: FilterState, seen: Observation, model: int) -> None:
    """Put position or velocity where the receiver says, with the receiver's uncertainty, and count the jump. A barometer
    puts its own offset where the height says: that is no jump."""
    block, nominal = RESETTABLE[model]
    if model == MODEL["barometric_height"]:
        _reset_offset(state, seen)
        return
    to_n = mat_ne(state.nominal[POSITION_E])
    axes = len(seen.innovation)
    state.nominal[nominal] += to_n[:axes].T @ seen.innovation
    spread = to_n @ state.covariance[block, block] @ to_n.T
    spread[:axes, :] = spread[:, :axes] = 0.0
    spread[:axes, :axes] = np.diag(seen.variance)
    state.covariance[block, :] = 0.0
    state.covariance[:, block] = 0.0
    state.covariance[block, block] = to_n.T @ spread @ to_n
    state.stamps[RESETS] += 1


def _reset_offset(state: FilterState, seen: Observation) -> None:
    """The height offset (1,) anew, offset = reading - height, with the covariances that this gives it."""
    state.nominal[HEIGHT_OFFSET] += seen.innovation
    state.covariance[HEIGHT_OFFSET_ERROR, :] = state.covariance[:, HEIGHT_OFFSET_ERROR] = 0.0
    cross = -seen.jacobian @ state.covariance
    state.covariance[HEIGHT_OFFSET_ERROR, :] = cross
    state.covariance[:, HEIGHT_OFFSET_ERROR] = cross.T
    state.covariance[HEIGHT_OFFSET_ERROR, HEIGHT_OFFSET_ERROR] = -cross @ seen.jacobian.T + seen.variance
