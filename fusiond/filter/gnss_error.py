"""The slowly varying error of GNSS positions, which is a state: atmosphere, orbits, multipath.

A fix is off by e + v: e keeps its value for a while, first-order Gauss-Markov with the receiver's correlation time, and v is
white. So fixes that are alike over that time are worth what they are, the published sigma does not fall below what e leaves
open, and an offset that grows slowly moves e more than the vehicle. All receivers share one e, because what they have in
common is the sky. Brown and Hwang (2012), section 5.4; Groves (2013), section 14.3.

It is carried from one fix to the next, not with every inertial sample: what lies between does not touch it.
"""

from __future__ import annotations

from fusiond.filter.observations.gnss_position import ERROR_TIME, VARIANCE_HORIZONTAL, VARIANCE_VERTICAL, slow_share
from fusiond.filter.observations.model import NOISE_MAX, NOISE_MIN, Observation
from fusiond.filter.parameters import Parameters
from fusiond.filter.source_health import noise_factor
from fusiond.filter.state import (
    GNSS_ERROR,
    GNSS_ERROR_E,
    NEVER,
    POSITION,
    POSITION_E,
    T_GNSS_ERROR,
    FilterState,
    T,
)
from fusiond.maths.portable import exp
from fusiond.maths.rotation import times, transposed_times
from fusiond.maths.typed import Covariance, Matrix3, Vector, Vector3, compiled
from fusiond.maths.wgs84 import mat_ne


@compiled
def carry(state: FilterState, source: int, values: Vector, params: Parameters) -> None:
    """Carry the error to the state's own instant, at which `source` has a fix of `values`. Exact for any interval: e and its
    covariances keep the share phi = exp(-dt / tau), and the variance that is lost, sigma^2 (1 - phi^2), is new. To be called
    before the fix is observed; `note` it afterwards."""
    parameter, x, p = params.model_parameters[source], state.nominal, state.covariance
    if not parameter[ERROR_TIME] > 0:
        return
    kept = 0.0
    if state.stamps[T_GNSS_ERROR] != NEVER:
        kept = exp(-((state.stamps[T] - state.stamps[T_GNSS_ERROR]) * 1e-9) / parameter[ERROR_TIME])
    for i in range(3):
        x[GNSS_ERROR_E.start + i] *= kept
        p[GNSS_ERROR.start + i] *= kept
    for i in range(3):
        p[:, GNSS_ERROR.start + i] *= kept
    factor = noise_factor(state.memory[source], parameter[NOISE_MIN], parameter[NOISE_MAX])
    new = factor * slow_share(parameter) * (1 - kept * kept)
    to_n = mat_ne(x[POSITION_E])
    horizontal, vertical = new * values[VARIANCE_HORIZONTAL], new * values[VARIANCE_VERTICAL]
    _add(p, GNSS_ERROR.start, to_n, horizontal, horizontal, vertical)


@compiled
def note(state: FilterState, source: int, params: Parameters) -> None:
    """Keep the instant to which the error was carried: once for all hypotheses."""
    if params.model_parameters[source, ERROR_TIME] > 0:
        state.stamps[T_GNSS_ERROR] = state.stamps[T]


@compiled
def with_whole_error(
    state: FilterState, source: int, values: Vector, params: Parameters, innovation: Vector3, spread: Matrix3
) -> None:
    """Make of the innovation (3,) of a fix, with H P H' (3, 3), what the fix is off the antenna altogether: e is put back,
    and the variance of its estimate, sigma^2 - P_e, comes in. So a receiver is judged by its whole error: an e that the
    receiver should not have shows, though no single innovation does."""
    parameter, p = params.model_parameters[source], state.covariance
    if not parameter[ERROR_TIME] > 0:
        return
    to_n = mat_ne(state.nominal[POSITION_E])
    share = noise_factor(state.memory[source], parameter[NOISE_MIN], parameter[NOISE_MAX]) * slow_share(parameter)
    error_n = times(to_n, state.nominal[GNSS_ERROR_E])
    for i in range(3):
        innovation[i] += error_n[i]
        own = 0.0
        for j in range(3):
            for k in range(3):
                own += to_n[i, j] * p[GNSS_ERROR.start + j, GNSS_ERROR.start + k] * to_n[i, k]
        variance = share * (values[VARIANCE_VERTICAL] if i == 2 else values[VARIANCE_HORIZONTAL])
        spread[i, i] += max(variance - own, 0.0)


@compiled
def place(state: FilterState, source: int, values: Vector, seen: Observation, params: Parameters) -> None:
    """Put the position where a fix of `values`, observed as `seen`, says, whatever was believed: position = fix - e - v, with
    an error e that is drawn anew, so that the position has the variance of both and the covariance - P_e with it."""
    x, p = state.nominal, state.covariance
    to_n = mat_ne(x[POSITION_E])
    slow = params.model_parameters[source, ERROR_TIME] > 0
    if slow:
        x[POSITION_E] += x[GNSS_ERROR_E]  # the innovation was less the old e
        state.stamps[T_GNSS_ERROR] = NEVER
        carry(state, source, values, params)
    x[POSITION_E] += transposed_times(to_n, seen.innovation)
    for i in range(3):
        p[POSITION.start + i] = 0.0
        p[:, POSITION.start + i] = 0.0
    _add(p, POSITION.start, to_n, seen.variance[0], seen.variance[1], seen.variance[2])
    if not slow:
        return
    note(state, source, params)
    for i in range(3):
        for j in range(3):
            variance = p[GNSS_ERROR.start + i, GNSS_ERROR.start + j]
            p[POSITION.start + i, POSITION.start + j] += variance
            p[POSITION.start + i, GNSS_ERROR.start + j] = -variance
            p[GNSS_ERROR.start + i, POSITION.start + j] = -variance


@compiled
def _add(p: Covariance, block: int, to_n: Matrix3, north: float, east: float, down: float) -> None:
    """Add variances [m^2] along north, east, down to a block of earth-fixed axes."""
    for i in range(3):
        for j in range(3):
            p[block + i, block + j] += (
                north * (to_n[0, i] * to_n[0, j]) + east * (to_n[1, i] * to_n[1, j]) + down * (to_n[2, i] * to_n[2, j])
            )
