"""The measurement update: innovation gate, Kalman gain, Joseph form, and the return of the error into the nominal state."""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter.observations.model import Observation
from fusiond.filter.state import (
    ACCEL_BIAS,
    ACCEL_BIAS_B,
    ATTITUDE,
    CALIBRATIONS,
    GYRO_BIAS,
    GYRO_BIAS_B,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.portable import exp
from fusiond.maths.rotation import normalised, quaternion_exp, quaternion_multiply, skew
from fusiond.maths.wgs84 import Array

ADDED = (
    (POSITION_E, POSITION),
    (VELOCITY_E, VELOCITY),
    (GYRO_BIAS_B, GYRO_BIAS),
    (ACCEL_BIAS_B, ACCEL_BIAS),
)


FIELD = 100.0  # sigmas: how wide the field is that clutter is uniform over
UNIFORM = math.sqrt(2 * math.pi) / FIELD  # its density per axis, in units of N(0; 0, S)
NEGLIGIBLE = 1e-6  # a reading less likely than this to be the target's changes nothing


def chi_square(probability: float, freedom: int) -> float:
    """The value that a chi-square variable of `freedom` degrees stays below with `probability` (bisection on its
    distribution function, Abramowitz and Stegun 26.4.6, in arithmetic that is the same on every machine)."""

    def distribution(x: float) -> float:
        term, k = (math.sqrt(2 * x / math.pi), 1) if freedom % 2 else (x / 2, 2)  # (x/2)^(k/2) / Gamma(k/2 + 1)
        total = 0.0
        while k <= freedom or term > 1e-17 * total:
            if k >= freedom:
                total += term
            k += 2
            term *= x / k
        return total * exp(-x / 2)

    low, high = 0.0, 1.0
    while distribution(high) < probability and high < 1000:
        high *= 2
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if distribution(middle) < probability else (low, middle)
    return middle


def correlation_factor(interval: float, correlation: float) -> float:
    """How much a variance must grow so that samples every `interval` [s], whose errors stay alike over `correlation` [s]
    (first-order Gauss-Markov), may be fused as if they were independent: (1 + r) / (1 - r) with r = exp(-dt/tau)."""
    if correlation <= 0:
        return 1.0
    alike = exp(-max(interval, 1e-6) / correlation)
    return (1 + alike) / (1 - alike) if alike < 1 else math.inf


def cholesky(matrix: Array) -> Array | None:
    """Lower factor (m, m) of a finite, symmetric positive definite matrix; None where it is not."""
    m = len(matrix)
    lower = np.zeros((m, m))
    for i in range(m):
        for j in range(i + 1):
            rest = matrix[i, j] - lower[i, :j] @ lower[j, :j]
            if i == j:
                if not 0 < rest < math.inf:
                    return None
                lower[i, i] = math.sqrt(rest)
            else:
                lower[i, j] = rest / lower[j, j]
    return lower


def solve(lower: Array, right: Array) -> Array:
    """(lower lower')^-1 right, (m, k)."""
    m = len(lower)
    solution = right.copy()
    for i in range(m):
        solution[i] = (solution[i] - lower[i, :i] @ solution[:i]) / lower[i, i]
    for i in reversed(range(m)):
        solution[i] = (solution[i] - lower[i + 1 :, i] @ solution[i + 1 :]) / lower[i, i]
    return solution


def whiten(state: FilterState, seen: Observation) -> Array | None:
    """Innovation (m,) in units of its own sigma, L^-1 d with L L' = H P H' + R; None where that is not positive definite."""
    lower = cholesky(seen.jacobian @ state.covariance @ seen.jacobian.T + np.diag(seen.variance))
    if lower is None:
        return None
    whitened = seen.innovation.copy()
    for i in range(len(whitened)):
        whitened[i] = (whitened[i] - lower[i, :i] @ whitened[:i]) / lower[i, i]
    return whitened


def update(
    state: FilterState,
    seen: Observation,
    gate: float,
    factor: float = 1.0,
    trusted: bool = True,
    clutter: float = 0.0,
) -> tuple[float, bool]:
    """Fuse an observation unless its test ratio d' S^-1 d / gate exceeds 1, or it is not trusted. Returns the ratio
    (infinite where S is not positive definite, a variance negative or anything not finite) and whether it was fused.

    It is judged by its own variance, and weighed by `factor` times that: a sample whose error it shares with the ones
    before tells little, but is no less wrong when it is far off. With `clutter`, the share of readings that are anywhere,
    there is no gate: see `detection`.
    """
    innovation, jacobian, variance = seen
    if not (variance >= 0).all():
        return math.inf, False
    across = state.covariance @ jacobian.T
    predicted = jacobian @ across
    lower = cholesky(predicted + np.diag(variance))
    if lower is None:
        return math.inf, False
    distance = float(innovation @ solve(lower, innovation.reshape(-1, 1))[:, 0])
    ratio = distance / gate if distance / gate < math.inf else math.inf
    if clutter == 0 or ratio == math.inf:
        share = 1.0 if ratio <= 1 else 0.0
    else:
        share = detection(distance, len(innovation), clutter)
    variance = factor * variance
    lower = cholesky(predicted + np.diag(variance))
    if not trusted or share < NEGLIGIBLE or lower is None:
        return ratio, False
    gain = solve(lower, across.T).T
    keep = np.eye(state.size) - gain @ jacobian
    covariance = keep @ state.covariance @ keep.T + (gain * variance) @ gain.T
    error = gain @ innovation
    if share < 1:
        covariance = share * covariance + (1 - share) * state.covariance + share * (1 - share) * np.outer(error, error)
        error = share * error
    state.covariance[:] = (covariance + covariance.T) / 2
    turn_along(state.covariance, error)
    inject(state, error)
    return ratio, share >= 0.5


def turn_along(covariance: Array, error: Array) -> None:
    """Let an attitude error turn the corrections of position and velocity along: P = M P M' with -[correction]x in M's
    blocks of position and velocity by attitude, for a correction (n,).

    So the error is that of an invariant filter (Barrau and Bonnabel 2017), true velocity = exp([phi]x) velocity + error: a
    heading that nothing tells of stays as uncertain as it is. Without this each correction of the velocity would turn the
    direction in which the heading cannot be seen, and the filter would take that for knowledge.
    """
    for block in (POSITION, VELOCITY):
        covariance[block] -= skew(error[block]) @ covariance[ATTITUDE]
    for block in (POSITION, VELOCITY):
        covariance[:, block] -= covariance[:, ATTITUDE] @ skew(error[block]).T
    upper = np.triu(covariance)
    covariance[:] = upper + np.triu(covariance, 1).T


def detection(distance: float, m: int, clutter: float) -> float:
    """Probability that a reading is the target's and not clutter (THEORY D3): P_D N(d; 0, S) against (1 - P_D) rho, with
    P_D = 1 - clutter and rho uniform over a field of `FIELD` sigmas along each axis of S. The update is then the mixture
    of updated and predicted state, collapsed by its moments (B6)."""
    density, uniform = (1 - clutter) * exp(-distance / 2), clutter
    for _ in range(m):
        uniform *= UNIFORM
    return density / (density + uniform)


def inject(state: FilterState, error: Array) -> None:
    """Add an error (n,) to the nominal state: true = nominal (+) error. The covariance is left as it is: the turn of the
    attitude error's axes by half the correction (Sola 2017, 6.3) is of the second order."""
    x = state.nominal
    for nominal, block in ADDED:
        x[nominal] += error[block]
    x[CALIBRATIONS + 1 : state.size + 1] += error[CALIBRATIONS:]
    x[QUATERNION_EB] = normalised(quaternion_multiply(quaternion_exp(error[ATTITUDE]), x[QUATERNION_EB]))
