"""The slowly varying error of GNSS positions, which is a state: atmosphere, orbits, multipath.

A fix is off by e + v: e keeps its value for a while, first-order Gauss-Markov with the receiver's correlation time, and v is
white. So fixes that are alike over that time are worth what they are, the published sigma does not fall below what e leaves
open, and an offset that grows slowly moves e more than the vehicle. All receivers share one e, because what they have in
common is the sky. What stamps are off by lasts as well: an error along the track, of the speed times that. When the fix type
changes, RTK float to fixed say, e becomes another one: it is drawn anew. Brown and Hwang (2012), section 5.4; Groves (2013),
section 14.3.

It is carried from one fix to the next, not with every inertial sample: what lies between does not touch it.
"""

from __future__ import annotations

import numpy as np

from fusiond.filter.measurement_update import cholesky, inject
from fusiond.filter.observations.gnss_position import (
    ERROR_TIME,
    SLOW_SHARE,
    STAMP_SIGMA,
    TYPE_OF_FIX,
    VARIANCE_HORIZONTAL,
    VARIANCE_VERTICAL,
)
from fusiond.filter.observations.model import NOISE_MAX, NOISE_MIN, Observation
from fusiond.filter.parameters import Parameters
from fusiond.filter.source_health import noise_factor
from fusiond.filter.state import (
    FIX_TYPE,
    GNSS_ERROR,
    GNSS_ERROR_E,
    NEVER,
    POSITION,
    POSITION_E,
    T_GNSS_ERROR,
    VELOCITY_E,
    FilterState,
    T,
)
from fusiond.maths.linear import mirror
from fusiond.maths.portable import exp, square
from fusiond.maths.rotation import times, transposed_times
from fusiond.maths.typed import Covariance, Matrix3, Vector, Vector3, compiled
from fusiond.maths.wgs84 import mat_ne

KNOWN = 1.1  # times the variance of e: the estimate of e is never taken as all there is


@compiled
def carry(state: FilterState, source: int, values: Vector, params: Parameters) -> None:
    """Carry the error to the state's own instant, at which `source` has a fix of `values`. Exact for any interval: e and its
    covariances keep the share phi = exp(-dt / tau), and the variance that is lost, sigma^2 (1 - phi^2), is new. To be called
    before the fix is observed; `note` it afterwards."""
    parameter, x, p = params.model_parameters[source], state.nominal, state.covariance
    if not parameter[ERROR_TIME] > 0:
        return
    kept, last = 0.0, state.memory[source, FIX_TYPE]
    if state.stamps[T_GNSS_ERROR] != NEVER and (last == 0 or last == values[TYPE_OF_FIX]):
        kept = exp(-((state.stamps[T] - state.stamps[T_GNSS_ERROR]) * 1e-9) / parameter[ERROR_TIME])
    for i in range(3):
        x[GNSS_ERROR_E.start + i] *= kept
        p[GNSS_ERROR.start + i] *= kept
    for i in range(3):
        p[:, GNSS_ERROR.start + i] *= kept
    if state.tracked:
        for i in range(3):
            state.transition[GNSS_ERROR.start + i] *= kept
    factor = noise_factor(state.memory[source], parameter[NOISE_MIN], parameter[NOISE_MAX])
    new = factor * parameter[SLOW_SHARE] * (1 - kept * kept)
    to_n = mat_ne(x[POSITION_E])
    horizontal, vertical = new * values[VARIANCE_HORIZONTAL], new * values[VARIANCE_VERTICAL]
    _add(p, GNSS_ERROR.start, to_n, horizontal, horizontal, vertical)
    late = new * parameter[STAMP_SIGMA] * parameter[STAMP_SIGMA]
    for i in range(3):
        for j in range(3):
            along = x[VELOCITY_E.start + i] * x[VELOCITY_E.start + j]
            p[GNSS_ERROR.start + i, GNSS_ERROR.start + j] += late * along


@compiled
def note(state: FilterState, source: int, values: Vector, params: Parameters) -> None:
    """Keep the instant to which the error was carried, and the type of the fix: once for all hypotheses."""
    state.memory[source, FIX_TYPE] = values[TYPE_OF_FIX]
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
    share = noise_factor(state.memory[source], parameter[NOISE_MIN], parameter[NOISE_MAX]) * parameter[SLOW_SHARE]
    error_n, late_n = times(to_n, state.nominal[GNSS_ERROR_E]), times(to_n, state.nominal[VELOCITY_E])
    for i in range(3):
        innovation[i] += error_n[i]
        own = 0.0
        for j in range(3):
            for k in range(3):
                own += to_n[i, j] * p[GNSS_ERROR.start + j, GNSS_ERROR.start + k] * to_n[i, k]
        variance = values[VARIANCE_VERTICAL] if i == 2 else values[VARIANCE_HORIZONTAL]
        variance += square(parameter[STAMP_SIGMA] * late_n[i])
        spread[i, i] += max(share * variance - own, 0.0)


@compiled
def forget_prior(state: FilterState, source: int, values: Vector, params: Parameters) -> None:
    """Take out of a state that e is N(0, Sigma), as of a receiver that may lie by any e: with the columns C = P J' of e,
    P + C (Sigma - P_e)^-1 C' and x + C (Sigma - P_e)^-1 e, which is the information form of the same. So what the lie has
    pulled so far goes back to where the other sources have it."""
    parameter, p = params.model_parameters[source], state.covariance
    if not parameter[ERROR_TIME] > 0:
        return
    to_n, rest = mat_ne(state.nominal[POSITION_E]), np.zeros((3, 3))
    share = noise_factor(state.memory[source], parameter[NOISE_MIN], parameter[NOISE_MAX]) * parameter[SLOW_SHARE]
    late = square(parameter[STAMP_SIGMA])
    for i in range(3):
        for j in range(3):
            along = state.nominal[VELOCITY_E.start + i] * state.nominal[VELOCITY_E.start + j]
            sigma = values[VARIANCE_HORIZONTAL] * (to_n[0, i] * to_n[0, j] + to_n[1, i] * to_n[1, j])
            sigma += values[VARIANCE_VERTICAL] * (to_n[2, i] * to_n[2, j]) + late * along
            rest[i, j] = KNOWN * share * sigma - p[GNSS_ERROR.start + i, GNSS_ERROR.start + j]
    lower, none = np.empty((3, 3)), np.zeros(3)
    if not cholesky(rest, none, 1.0, 3, lower):
        return
    columns = np.empty((3, state.size))  # L^-1 C'
    whole = np.empty(3)
    for a in range(3):
        columns[a] = p[GNSS_ERROR.start + a]
        whole[a] = state.nominal[GNSS_ERROR_E.start + a]
        for b in range(a):
            columns[a] += -lower[a, b] * columns[b]
            whole[a] -= lower[a, b] * whole[b]
        columns[a] /= lower[a, a]
        whole[a] /= lower[a, a]
    error = np.zeros(state.size)
    for a in range(3):
        error += whole[a] * columns[a]
        for i in range(state.size):
            p[i] += columns[a, i] * columns[a]
    mirror(p)
    inject(state, error)


@compiled
def place(state: FilterState, source: int, values: Vector, seen: Observation, params: Parameters) -> None:
    """Put the position where a fix of `values`, observed as `seen`, says, whatever was believed: position = fix - e - v,
    with an error e that is drawn anew, so that the position has the variance of both and the covariance - P_e with it. Where
    `seen` is cut down to the two horizontal axes the height stays as it is."""
    x, p = state.nominal, state.covariance
    to_n = mat_ne(x[POSITION_E])
    slow = params.model_parameters[source, ERROR_TIME] > 0
    off, variance, common = np.zeros(3), np.zeros(3), np.zeros(3)
    if slow:
        off[:] = times(to_n, x[GNSS_ERROR_E])  # the innovation is that of a fix less the old e
        state.stamps[T_GNSS_ERROR] = NEVER
        carry(state, source, values, params)
        note(state, source, values, params)
    for a in range(seen.m):
        off[a] += seen.innovation[a]
        variance[a], common[a] = seen.variance[a], seen.common[a]
    for a in range(seen.m, 3):
        off[a] = 0.0
        for i in range(3):
            for j in range(3):
                variance[a] += to_n[a, i] * p[POSITION.start + i, POSITION.start + j] * to_n[a, j]
    x[POSITION_E] += transposed_times(to_n, off)
    for i in range(3):
        p[POSITION.start + i] = 0.0
        p[:, POSITION.start + i] = 0.0
    _add(p, POSITION.start, to_n, variance[0], variance[1], variance[2])
    along = transposed_times(to_n, common)
    for i in range(3):
        for j in range(3):
            p[POSITION.start + i, POSITION.start + j] += along[i] * along[j]
    if slow:
        _tie(p, to_n, seen.m)


@compiled
def _tie(p: Covariance, to_n: Matrix3, axes: int) -> None:
    """Let the position be off by minus the error, along the first axes of north, east, down."""
    along, across = np.zeros((3, 3)), np.zeros((3, 3))
    for a in range(axes):
        for i in range(3):
            for j in range(3):
                along[i, j] += to_n[a, i] * to_n[a, j]
    for i in range(3):
        for k in range(3):
            for j in range(3):
                across[i, j] += along[i, k] * p[GNSS_ERROR.start + k, GNSS_ERROR.start + j]
    for i in range(3):
        for j in range(3):
            p[POSITION.start + i, GNSS_ERROR.start + j] = -across[i, j]
            p[GNSS_ERROR.start + j, POSITION.start + i] = -across[i, j]
    for i in range(3):
        for j in range(i, 3):
            for k in range(3):
                p[POSITION.start + i, POSITION.start + j] += across[i, k] * along[k, j]
            p[POSITION.start + j, POSITION.start + i] = p[POSITION.start + i, POSITION.start + j]


@compiled
def _add(p: Covariance, block: int, to_n: Matrix3, north: float, east: float, down: float) -> None:
    """Add variances [m^2] along north, east, down to a block of earth-fixed axes."""
    for i in range(3):
        for j in range(3):
            p[block + i, block + j] += (
                north * (to_n[0, i] * to_n[0, j]) + east * (to_n[1, i] * to_n[1, j]) + down * (to_n[2, i] * to_n[2, j])
            )
