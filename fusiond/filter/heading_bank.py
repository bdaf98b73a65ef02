"""The bank of heading hypotheses: while the heading is not known, each is a filter of its own (THEORY B5).

Every hypothesis is a whole state and covariance, carried and updated like the one of a running filter, and weighed by the
likelihood of what is measured; they share the inertial sample and what is remembered of the sources. When the spread of
their headings is small they are collapsed by their moments (B6), and the filter runs. Until then there is no state to tell.

A measurement that fits no hypothesis is an outlier: its likelihood is floored, so that a single one decides nothing.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter.measurement_update import ADDED, cholesky, inject, update, whiten
from fusiond.filter.motion_constraints import ZERO_ROTATION, ZERO_VELOCITY, constraints_due
from fusiond.filter.observations import CONSTRAINTS, non_holonomic
from fusiond.filter.observations.model import LEVER_ARM_B, Observation, point_velocity_v, with_rate_noise
from fusiond.filter.parameters import Plan
from fusiond.filter.source_health import OUTLIER_VARIANCE, OUTLIERS
from fusiond.filter.state import (
    ATTITUDE,
    CALIBRATIONS,
    HYPOTHESES,
    NEVER,
    PHASE,
    POSITION_E,
    QUATERNION_EB,
    RUNNING,
    T_JUDGED,
    FilterState,
)
from fusiond.maths.portable import exp
from fusiond.maths.rotation import quaternion_multiply
from fusiond.maths.wgs84 import Array, mat_ne

LEAST_WEIGHT = 1e-9  # a hypothesis less likely than this is given up
FAR = math.radians(30.0)  # rad: a heading this far off is another one, not the same less sure
DOUBT = 1e-4  # the bank is not collapsed while headings that are far off are likelier than this, all together
CLUTTER = OUTLIERS  # share of measurements that fit nothing


def alive(state: FilterState) -> list[int]:
    """The hypotheses that have not been given up."""
    return [i for i in range(HYPOTHESES) if state.bank[i, 0] > 0]


def weigh(state: FilterState, i: int, hypothesis: FilterState, seen: Observation, factor: float) -> None:
    """Multiply a hypothesis's weight by the likelihood of an observation, whose error it shares with those before."""
    spread = seen.jacobian @ hypothesis.covariance @ seen.jacobian.T
    widened = seen._replace(variance=factor * seen.variance)
    lower, whitened = cholesky(spread + np.diag(widened.variance)), whiten(hypothesis, widened)
    if lower is None or whitened is None:
        return
    square, size = 0.0, 1.0
    for a in range(len(whitened)):
        square += whitened[a] * whitened[a]
        size *= lower[a, a]
    floor = exp(-min(square, 1000.0) / (2 * OUTLIER_VARIANCE))
    for _ in range(len(whitened)):
        floor /= math.sqrt(OUTLIER_VARIANCE)
    state.bank[i, 0] *= ((1 - OUTLIERS) * exp(-square / 2) + OUTLIERS * floor) / size


def take(
    state: FilterState,
    i: int,
    hypothesis: FilterState,
    seen: Observation,
    gate: float,
    factor: float,
    certain: Observation | None = None,
) -> None:
    """Weigh a hypothesis by an observation, and update it; `certain` is what it is weighed by where that is another."""
    weigh(state, i, hypothesis, certain or seen, factor)
    update(hypothesis, seen, gate, factor, True, CLUTTER)


def constrain(state: FilterState, plan: Plan) -> None:
    """Apply the motion constraints that are due to every hypothesis; one that would have the vehicle go sideways pays."""
    still, rolling = constraints_due(state, plan)
    if not (still or rolling):
        return
    for i in alive(state):
        hypothesis = state.hypothesis(i)
        if still:
            for which, factor in ((ZERO_VELOCITY, plan.zero_velocity_factor), (ZERO_ROTATION, 1.0)):
                parameters = plan.constraints[which]
                seen = CONSTRAINTS[which].observe(hypothesis, parameters, parameters)
                assert seen is not None, "a vehicle at rest is always observed"
                take(state, i, hypothesis, with_rate_noise(hypothesis, seen), plan.gates[len(seen.innovation)], factor)
    if rolling and not still:
        _roll(state, plan)
    normalise(state)


def _roll(state: FilterState, plan: Plan) -> None:
    """The non-holonomic constraint: for all or for none, by the largest speed over ground, in whatever direction."""
    parameters, kept = plan.constraints[0], alive(state)
    variance = np.array([parameters[non_holonomic.LATERAL_VARIANCE], parameters[non_holonomic.VERTICAL_VARIANCE]])
    seen, fastest = [], 0.0
    for i in kept:
        velocity_v, by_error = point_velocity_v(state.hypothesis(i), parameters[LEVER_ARM_B])
        seen.append(Observation(-velocity_v[1:], by_error[1:], variance))
        fastest = max(fastest, math.sqrt(velocity_v[0] * velocity_v[0] + velocity_v[1] * velocity_v[1]))
    if fastest < parameters[non_holonomic.LEAST_SPEED]:
        return
    for i, observation in zip(kept, seen, strict=True):
        take(state, i, state.hypothesis(i), with_rate_noise(state, observation), plan.gates[2], 1.0)


def normalise(state: FilterState) -> None:
    """Let the weights sum to 1, and give up those that have become too small."""
    weights, total = state.bank[:, 0], 0.0
    for i in range(HYPOTHESES):
        total += weights[i]
    for i in range(HYPOTHESES):
        weights[i] = weights[i] / total if total > 0 else 0.0
        if weights[i] < LEAST_WEIGHT:
            weights[i] = 0.0


def settle(state: FilterState, plan: Plan) -> None:
    """Normalise, and collapse the bank where the headings are close together and hardly any is far off: the
    filter then runs."""
    normalise(state)
    kept = alive(state)
    if not kept:
        return
    best = kept[0]
    for i in kept:
        if state.bank[i, 0] > state.bank[best, 0]:
            best = i
    down_e = mat_ne(state.hypothesis(best).nominal[POSITION_E])[2]
    errors = [difference(state.hypothesis(i), state.hypothesis(best)) for i in kept]
    mean, spread = 0.0, 0.0
    turns = [float(down_e @ error[ATTITUDE]) for error in errors]
    for i, turn in zip(kept, turns, strict=True):
        mean += state.bank[i, 0] * turn
    for i, turn in zip(kept, turns, strict=True):
        own = float(down_e @ state.hypothesis(i).covariance[ATTITUDE, ATTITUDE] @ down_e)
        spread += state.bank[i, 0] * (own + (turn - mean) * (turn - mean))
    doubt = 0.0
    for i, turn in zip(kept, turns, strict=True):
        doubt += state.bank[i, 0] if abs(turn) > FAR else 0.0
    if spread <= plan.heading_variance and doubt <= DOUBT:
        _collapse(state, best, kept, errors)


def difference(a: FilterState, b: FilterState) -> Array:
    """The error (n,) that carries b into a; the rotation to the second order."""
    error = np.zeros(a.size)
    for nominal, block in ADDED:
        error[block] = a.nominal[nominal] - b.nominal[nominal]
    error[CALIBRATIONS:] = a.nominal[CALIBRATIONS + 1 : a.size + 1] - b.nominal[CALIBRATIONS + 1 : a.size + 1]
    back = b.nominal[QUATERNION_EB] * (1.0, -1.0, -1.0, -1.0)
    turn = quaternion_multiply(a.nominal[QUATERNION_EB], back)
    error[ATTITUDE] = turn[1:] * (2.0 if turn[0] >= 0 else -2.0)
    return error


def _collapse(state: FilterState, best: int, kept: list[int], errors: list[Array]) -> None:
    """Mean and covariance of the mixture, about its likeliest component (B6)."""
    mean, covariance = np.zeros(state.size), np.zeros((state.size, state.size))
    for i, error in zip(kept, errors, strict=True):
        mean += state.bank[i, 0] * error
    for i, error in zip(kept, errors, strict=True):
        covariance += state.bank[i, 0] * (state.hypothesis(i).covariance + np.outer(error - mean, error - mean))
    state.nominal[:] = state.hypothesis(best).nominal
    state.covariance[:] = (covariance + covariance.T) / 2
    inject(state, mean)
    state.bank[:] = 0.0
    state.stamps[PHASE] = RUNNING
    state.source_stamps[:, T_JUDGED] = NEVER
