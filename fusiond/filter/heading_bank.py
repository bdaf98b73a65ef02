"""The bank of heading hypotheses: while the heading is not known, each is a filter of its own (THEORY B5).

Every hypothesis is a whole state and covariance, carried and updated like the one of a running filter, and weighed by the
likelihood of what is measured; they share the inertial sample and what is remembered of the sources. When the spread of
their headings is small they are collapsed by their moments (B6), and the filter runs. Until then there is no state.

A measurement that fits no hypothesis is an outlier: its likelihood is floored, so that a single one decides nothing.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter.measurement import share_noise
from fusiond.filter.measurement_update import difference, inject, project, update_projected
from fusiond.filter.motion_constraints import (
    GNSS_FRESH_NS,
    NON_HOLONOMIC,
    ZERO_ROTATION,
    ZERO_VELOCITY,
    constraints_due,
    observe_constraint,
)
from fusiond.filter.observations import WHEEL_SPEED, non_holonomic, observe, wheel_speed
from fusiond.filter.observations.model import Observation, with_rate_noise
from fusiond.filter.parameters import Parameters
from fusiond.filter.rivals import likelihood
from fusiond.filter.source_health import OUTLIERS
from fusiond.filter.state import (
    ATTITUDE,
    HOT_START,
    HYPOTHESES,
    NEVER,
    PHASE,
    POSITION_E,
    RUNNING,
    T_JUDGED,
    T_LAST,
    VELOCITY,
    FilterState,
    ResetReason,
    T,
    Verdict,
    count_reset,
    is_sound,
    variance_about,
)
from fusiond.maths.linear import mirror
from fusiond.maths.typed import ErrorRows3, Matrix3, Vector, compiled
from fusiond.maths.wgs84 import mat_ne

MIN_WEIGHT = 1e-9  # a hypothesis less likely than this is given up
FAR = math.radians(30.0)  # rad: a heading this far off is another one, not the same less sure
DOUBT = 1e-4  # the bank is not collapsed while headings that are far off are likelier than this, all together
BANK_SIGMA = math.radians(12.0)  # rad, of each heading at first, at most: wide enough to overlap
CLUTTER = OUTLIERS  # share of measurements that fit nothing


@compiled
def weigh(state: FilterState, i: int, seen: Observation, factor: float, spread: Matrix3) -> None:
    """Multiply a hypothesis's weight by the likelihood of an observation, of H P H' (m, m), whose error it shares with those
    before."""
    likely = likelihood(seen.innovation, seen.variance, factor, seen.m, spread)
    if likely > 0:
        state.bank[i, 0] *= likely


@compiled
def fuse(
    state: FilterState,
    i: int,
    hypothesis: FilterState,
    seen: Observation,
    factor: float,
    params: Parameters,
    weighed: bool = True,
) -> None:
    """Weigh a hypothesis by an observation, unless it was by another, and update it."""
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    project(hypothesis, seen, across, spread)
    if weighed:
        weigh(state, i, seen, factor, spread)
    update_projected(hypothesis, seen, params.gates[seen.m], factor, True, CLUTTER, across, spread)


@compiled
def fuse_measurement(
    state: FilterState, i: int, model: int, values: Vector, parameter: Vector, factor: float, params: Parameters
) -> None:
    """Take one measurement into a hypothesis. A wheel weighs it by the direction that the hypothesis says it turns in."""
    hypothesis = state.hypothesis(i)
    seen = Observation(state.size)
    if model == WHEEL_SPEED:
        if not _velocity_is_known(state, params):
            return
        wheel_speed.observe_certain(hypothesis, values, parameter, seen)
        share_noise(hypothesis, seen, parameter)
        across, spread = np.empty((3, state.size)), np.empty((3, 3))
        project(hypothesis, seen, across, spread)
        weigh(state, i, seen, factor, spread)
    if observe(hypothesis, model, values, parameter, seen):
        share_noise(hypothesis, seen, parameter)
        fuse(state, i, hypothesis, seen, factor, params, model != WHEEL_SPEED)


@compiled
def constrain(state: FilterState, params: Parameters) -> None:
    """Apply the motion constraints that are due to every hypothesis; one in which the vehicle goes sideways
    loses weight."""
    still, rolling = constraints_due(state, params)
    still = still and _stillness_is_known(state, params)
    if not (still or rolling):
        return
    seen = Observation(state.size)
    for i in range(HYPOTHESES):
        if still and state.bank[i, 0] > 0:
            hypothesis = state.hypothesis(i)
            observe_constraint(hypothesis, ZERO_VELOCITY, params, seen)
            with_rate_noise(hypothesis, seen)
            fuse(state, i, hypothesis, seen, params.zero_velocity_factor, params)
            observe_constraint(hypothesis, ZERO_ROTATION, params, seen)
            with_rate_noise(hypothesis, seen)
            fuse(state, i, hypothesis, seen, 1.0, params)
    if rolling and not still:
        _roll(state, params)
    normalise(state)


@compiled
def _stillness_is_known(state: FilterState, params: Parameters) -> bool:
    """Whether more than a quiet inertial sensor says that the vehicle stands: where its speed is not known, a quiet drive
    looks the same, and here no gate would notice."""
    if len(params.wheels) > 0:
        return True
    for i in params.velocities:
        silent_ns = state.stamps[T] - state.source_stamps[i, T_LAST]
        if silent_ns <= GNSS_FRESH_NS:
            return True
    return False


@compiled
def _roll(state: FilterState, params: Parameters) -> None:
    """The non-holonomic constraint: for all or for none, by the largest speed over ground, in whatever direction."""
    parameter = params.constraints[NON_HOLONOMIC]
    seen = Observation(state.size)
    fastest = 0.0
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            hypothesis = state.hypothesis(i)
            fastest = max(fastest, non_holonomic.observe_at_any_speed(hypothesis, parameter, seen))
    if fastest < parameter[non_holonomic.MIN_SPEED] or not _velocity_is_known(state, params):
        return
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            hypothesis = state.hypothesis(i)
            non_holonomic.observe_at_any_speed(hypothesis, parameter, seen)
            with_rate_noise(hypothesis, seen)
            fuse(state, i, hypothesis, seen, 1.0, params)


@compiled
def _velocity_is_known(state: FilterState, params: Parameters) -> bool:
    """Whether what a heading's error makes of the velocity's, which is left out where a measurement is linearised, lies
    within the noise of the non-holonomic constraint. Until fixes have told the velocity, the constraint and wheels would
    tell of the heading what nobody knows. For all or for none, so that all are weighed by the same measurements."""
    unsure = 0.0
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            hypothesis = state.hypothesis(i)
            variance = 0.0
            for a in range(VELOCITY.start, VELOCITY.stop):
                variance += hypothesis.covariance[a, a] / 3
            unsure = max(unsure, variance)
    return unsure * BANK_SIGMA * BANK_SIGMA <= params.constraints[NON_HOLONOMIC, non_holonomic.LATERAL_VARIANCE]


@compiled
def normalise(state: FilterState) -> None:
    """Let the weights sum to 1. Give up the hypotheses that are no longer finite, and those that have become too
    unlikely."""
    total = 0.0
    for i in range(HYPOTHESES):
        hypothesis = state.hypothesis(i)
        if not (state.bank[i, 0] > 0 and math.isfinite(state.bank[i, 0]) and is_sound(hypothesis)):
            state.bank[i, 0] = 0.0
        total += state.bank[i, 0]
    for i in range(HYPOTHESES):
        state.bank[i, 0] = state.bank[i, 0] / total if total > 0 else 0.0
        if state.bank[i, 0] < MIN_WEIGHT:
            state.bank[i, 0] = 0.0


@compiled
def collapse_if_close(state: FilterState, params: Parameters) -> None:
    """Normalise, and collapse the bank where the headings are close together and hardly any is far off: the filter then
    runs."""
    normalise(state)
    best = -1
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0 and (best < 0 or state.bank[i, 0] > state.bank[best, 0]):
            best = i
    if best < 0:
        return
    likeliest = state.hypothesis(best)
    to_n = mat_ne(likeliest.nominal[POSITION_E])
    down = to_n[2]
    errors, turns = np.zeros((HYPOTHESES, state.size)), np.zeros(HYPOTHESES)
    mean = spread = doubt = 0.0
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            hypothesis = state.hypothesis(i)
            errors[i] = difference(hypothesis, likeliest)
            turn = errors[i, ATTITUDE]
            turns[i] = down[0] * turn[0] + down[1] * turn[1] + down[2] * turn[2]
            mean += state.bank[i, 0] * turns[i]
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            hypothesis = state.hypothesis(i)
            own = variance_about(hypothesis, down[0], down[1], down[2])
            spread += state.bank[i, 0] * (own + (turns[i] - mean) * (turns[i] - mean))
            if abs(turns[i]) > FAR:
                doubt += state.bank[i, 0]
    if spread <= params.heading_variance and doubt <= DOUBT:
        _collapse(state, best, errors)


@compiled
def _collapse(state: FilterState, best: int, errors: ErrorRows3) -> None:
    """Mean and covariance of the mixture, about its likeliest component (B6), from which the hypotheses are off by `errors`
    (HYPOTHESES, n)."""
    p, mean = state.covariance, np.zeros(state.size)
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            mean += state.bank[i, 0] * errors[i]
    p[:] = 0.0
    for i in range(HYPOTHESES):
        if state.bank[i, 0] > 0:
            weight = state.bank[i, 0]
            hypothesis = state.hypothesis(i)
            for j in range(state.size):
                p[j] += weight * (hypothesis.covariance[j] + (errors[i, j] - mean[j]) * (errors[i] - mean))
    mirror(p)
    likeliest = state.hypothesis(best)
    state.nominal[:] = likeliest.nominal
    inject(state, mean)
    state.bank[:] = 0.0
    state.stamps[PHASE] = RUNNING
    if state.stamps[HOT_START] == Verdict.USED:  # its state was published meanwhile
        count_reset(state, ResetReason.HEADING_DECIDED)
    for source in range(state.sources):
        state.source_stamps[source, T_JUDGED] = NEVER
