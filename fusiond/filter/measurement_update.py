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
    SCALE,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.linear import dot, mirror
from fusiond.maths.portable import exp
from fusiond.maths.rotation import normalised, quaternion_exp, quaternion_multiply
from fusiond.maths.typed import Covariance, ErrorRows3, ErrorVector, Matrix3, Vector3, compiled

CLUTTER_FIELD = 100.0  # sigmas: how wide the field is that clutter is uniform over
CLUTTER_DENSITY = math.sqrt(2 * math.pi) / CLUTTER_FIELD  # its density per axis, in units of N(0; 0, S)
NEGLIGIBLE = 1e-6  # a reading less likely than this to be the target's changes nothing
MIN_INTERVAL = 1e-6  # s: readings are not taken as closer


@compiled
def correlation_factor(interval: float, correlation: float) -> float:
    """How much a variance must grow so that samples every `interval` [s], with errors correlated over `correlation` [s]
    (first-order Gauss-Markov), may be fused as if they were independent: (1 + r) / (1 - r) with r = exp(-dt/tau)."""
    if not correlation > 0 or interval == math.inf:
        return 1.0
    same = exp(-max(interval, MIN_INTERVAL) / correlation)
    if same < 1:
        return (1 + same) / (1 - same)
    return math.inf


@compiled
def cholesky(spread: Matrix3, variance: Vector3, factor: float, m: int, lower: Matrix3) -> bool:
    """Write the lower factor (m, m) of spread + factor * diag(variance) into `lower`. False where that is not finite and
    positive definite, or a variance is negative."""
    for i in range(m):
        for j in range(i + 1):
            rest = spread[i, j]
            if i == j:
                rest += factor * variance[i]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            if i == j:
                if not (variance[i] >= 0 and 0 < rest < math.inf):
                    return False
                lower[i, i] = math.sqrt(rest)
            else:
                lower[i, j] = rest / lower[j, j]
    return True


@compiled
def project(state: FilterState, seen: Observation, across: ErrorRows3, spread: Matrix3) -> None:
    """H P into `across` (m, n), H P H' and what the axes have in common into `spread` (m, m)."""
    for a in range(seen.m):
        across[a] = 0.0
        for k in range(state.size):
            if seen.jacobian[a, k] != 0.0:
                across[a] += seen.jacobian[a, k] * state.covariance[k]
    for a in range(seen.m):
        for i in range(a + 1):
            spread[a, i] = spread[i, a] = dot(seen.jacobian[a], across[i]) + seen.common[a] * seen.common[i]


@compiled
def whiten(spread: Matrix3, innovation: Vector3, variance: Vector3, m: int, whitened: Vector3) -> bool:
    """Write the innovation in units of its own sigma, L^-1 d with L L' = H P H' + R, into `whitened` (m,). False where that
    is not positive definite."""
    lower = np.empty((3, 3))
    if not cholesky(spread, variance, 1.0, m, lower):
        return False
    for i in range(m):
        rest = innovation[i]
        for k in range(i):
            rest -= lower[i, k] * whitened[k]
        whitened[i] = rest / lower[i, i]
    return True


@compiled
def update(
    state: FilterState,
    seen: Observation,
    gate: float,
    factor: float = 1.0,
    trusted: bool = True,
    clutter: float = 0.0,
    given: bool = False,
) -> tuple[float, bool]:
    """Fuse an observation unless its test ratio d' S^-1 d / gate exceeds 1, or it is not trusted. Returns the ratio
    (infinite where S is not positive definite, a variance negative or anything not finite) and whether it was fused.

    It is judged by its own variance, and weighed by `factor` times that: a sample whose error it shares with the ones
    before is worth little, but is no less wrong when it is far off. With `clutter`, the share of readings that are anywhere,
    there is no gate: see `detection`. With `given`, the
    wheels' scale is taken as it is: see `give_scale`.
    """
    across, spread = np.empty((3, state.size)), np.empty((3, 3))
    project(state, seen, across, spread)
    return update_projected(state, seen, gate, factor, trusted, clutter, across, spread, given)


@compiled
def update_projected(
    state: FilterState,
    seen: Observation,
    gate: float,
    factor: float,
    trusted: bool,
    clutter: float,
    across: ErrorRows3,
    spread: Matrix3,
    given: bool = False,
) -> tuple[float, bool]:
    """`update` of an observation that was projected: H P (m, n) and H P H' (m, m)."""
    m, p = seen.m, state.covariance
    whitened = np.empty(3)
    if not whiten(spread, seen.innovation, seen.variance, m, whitened):
        return math.inf, False
    distance = 0.0
    for a in range(m):
        distance += whitened[a] * whitened[a]
    ratio = distance / gate
    if not ratio < math.inf:
        return math.inf, False
    if not trusted or (clutter == 0 and not ratio <= 1):
        return ratio, False
    share = 1.0
    if clutter != 0:
        share = detection(distance, m, clutter)
        if share < NEGLIGIBLE:
            return ratio, False
    gain = np.empty((3, state.size))
    if not make_gain(p, seen, factor, given, across, spread, gain):
        return ratio, False
    before = np.empty((state.size, state.size))
    if share < 1:
        for i in range(state.size):
            before[i] = p[i]
    joseph(p, seen, factor, across, gain)
    error = np.zeros(state.size)
    for a in range(m):
        error += seen.innovation[a] * gain[a]
    if share < 1:
        mixed = share * (1 - share)
        for i in range(state.size):
            p[i] = share * p[i] + (1 - share) * before[i] + mixed * (error[i] * error)
        error *= share
    turn_along(p, error)
    inject(state, error)
    return ratio, share >= 0.5


@compiled
def make_gain(
    p: Covariance,
    seen: Observation,
    factor: float,
    given: bool,
    across: ErrorRows3,
    spread: Matrix3,
    gain: ErrorRows3,
) -> bool:
    """Write the gain's transpose K' (m, n) into `gain`; False where its S is not positive definite."""
    weighed, lower = np.empty((3, 3)), np.empty((3, 3))
    for a in range(seen.m):
        gain[a] = across[a]
        weighed[a] = spread[a]
    if given:
        give_scale(p, seen.m, gain, weighed)
    if not cholesky(weighed, seen.variance, factor, seen.m, lower):
        return False
    _solve(lower, seen.m, gain)
    return True


@compiled
def _solve(lower: Matrix3, m: int, gain: ErrorRows3) -> None:
    """Make H P (m, n) the gain's transpose K' = S^-1 (P H')', with S = lower lower'."""
    for i in range(m):
        for k in range(i):
            gain[i] += -lower[i, k] * gain[k]
        gain[i] /= lower[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            gain[i] += -lower[k, i] * gain[k]
        gain[i] /= lower[i, i]


@compiled
def give_scale(p: Covariance, m: int, across: ErrorRows3, spread: Matrix3) -> None:
    """Make H P (m, n) and H P H' (m, m) those of P given the wheels' scale, P - P_s P_s' / P_ss. The gain of that is what a
    filter would have that knew the scale: it leaves the scale alone, and what the scale's error does to the rest goes
    into the covariance (a consider filter: Schmidt 1966).

    Wheels, inertial sensor and constraints alone do not show how much too high wheels read. With the gain of the whole P
    they seem to: the speed that multiplies the scale has the noise in it that the innovation has, and the product of the
    two is a bias of scale and position, and knowledge that is none. GNSS shows it, by what the
    wheels have made of the velocity.
    Further scales are learnt against this one.
    """
    variance = p[SCALE.start, SCALE.start]
    if not variance > 0:
        return
    by = np.empty(3)
    for a in range(m):
        by[a] = across[a, SCALE.start]
    for a in range(m):
        across[a] += (-by[a] / variance) * p[SCALE.start]
        across[a, SCALE.start] = 0.0
        for i in range(m):
            spread[a, i] -= by[a] * by[i] / variance


@compiled
def joseph(p: Covariance, seen: Observation, factor: float, across: ErrorRows3, gain: ErrorRows3) -> None:
    """P = (I - K H) P (I - K H)' + K R K', as A = P - K (H P) and P = A - (A H') K' + K R K', by rows."""
    for a in range(seen.m):
        p += (-across[a])[:, None] * gain[a]  # of A' = P - (P H') K'
    kept = np.zeros((3, len(p)))
    for a in range(seen.m):
        for k in range(len(p)):
            if seen.jacobian[a, k] != 0.0:
                kept[a] += -seen.jacobian[a, k] * p[k]
    for a in range(seen.m):
        kept[a] += factor * seen.variance[a] * gain[a]
        for i in range(seen.m if seen.common[a] != 0.0 else 0):
            kept[a] += seen.common[a] * seen.common[i] * gain[i]
    for a in range(seen.m):
        p += gain[a][:, None] * kept[a]
    mirror(p)


@compiled
def turn_along(p: Covariance, error: ErrorVector) -> None:
    """Let an attitude error turn the corrections of position and velocity along: P = M P M' with -[correction]x in M's
    blocks of position and velocity by attitude, for a correction (n,).

    So the error is that of an invariant filter (Barrau and Bonnabel 2017), true velocity = exp([phi]x) velocity + error: a
    heading that nothing observes stays as uncertain as it is. Without this each correction of the velocity would turn the
    direction in which the heading cannot be seen, and the filter would take that for knowledge.
    """
    phi = ATTITUDE.start
    turn_rows(p, error)
    for block in range(0, 6, 3):
        for i in range(6):
            x, y, z = p[i, phi], p[i, phi + 1], p[i, phi + 2]
            p[i, block] -= error[block + 1] * z - error[block + 2] * y
            p[i, block + 1] -= error[block + 2] * x - error[block] * z
            p[i, block + 2] -= error[block] * y - error[block + 1] * x
    for i in range(6):
        p[i:, i] = p[i, i:]


@compiled
def turn_rows(p: Covariance, error: ErrorVector) -> None:
    """P = M P, the half of `turn_along` that acts on rows."""
    turned = np.empty((6, len(p)))
    phi = ATTITUDE.start
    for block in range(0, 6, 3):  # position, velocity
        turned[block] = error[block + 1] * p[phi + 2] - error[block + 2] * p[phi + 1]
        turned[block + 1] = error[block + 2] * p[phi] - error[block] * p[phi + 2]
        turned[block + 2] = error[block] * p[phi + 1] - error[block + 1] * p[phi]
    for i in range(6):
        p[i] += -1.0 * turned[i]


@compiled
def detection(distance: float, m: int, clutter: float) -> float:
    """Probability that a reading is the target's and not clutter (THEORY D3): P_D N(d; 0, S) against (1 - P_D) rho, with
    P_D = 1 - clutter and rho uniform over a field of CLUTTER_FIELD sigmas along each axis of S. The update is then the
    mixture of updated and predicted state, collapsed by its moments (B6)."""
    density, uniform = (1 - clutter) * exp(-distance / 2), clutter
    for _a in range(m):
        uniform *= CLUTTER_DENSITY
    return density / (density + uniform)


@compiled
def inject(state: FilterState, error: ErrorVector) -> None:
    """Add an error (n,) to the nominal state: true = nominal (+) error. The covariance is left as it is: the turn of the
    attitude error's axes by half the correction (Sola 2017, 6.3) is of the second order."""
    x = state.nominal
    x[POSITION_E] += error[POSITION]
    x[VELOCITY_E] += error[VELOCITY]
    x[GYRO_BIAS_B] += error[GYRO_BIAS]
    x[ACCEL_BIAS_B] += error[ACCEL_BIAS]
    for i in range(CALIBRATIONS, state.size):
        x[i + 1] += error[i]
    x[QUATERNION_EB] = normalised(quaternion_multiply(quaternion_exp(error[ATTITUDE]), x[QUATERNION_EB]))


@compiled
def difference(one: FilterState, other: FilterState) -> ErrorVector:
    """The error (n,) that carries the other state into the one; the rotation to the second order."""
    a, b = one.nominal, other.nominal
    error = np.empty(one.size)
    error[POSITION] = a[POSITION_E] - b[POSITION_E]
    error[VELOCITY] = a[VELOCITY_E] - b[VELOCITY_E]
    error[GYRO_BIAS] = a[GYRO_BIAS_B] - b[GYRO_BIAS_B]
    error[ACCEL_BIAS] = a[ACCEL_BIAS_B] - b[ACCEL_BIAS_B]
    for i in range(CALIBRATIONS, one.size):
        error[i] = a[i + 1] - b[i + 1]
    q = QUATERNION_EB.start
    back = np.array([b[q], -b[q + 1], -b[q + 2], -b[q + 3]])
    turn = quaternion_multiply(a[QUATERNION_EB], back)
    twice = 2.0 if turn[0] >= 0 else -2.0
    for i in range(3):
        error[ATTITUDE.start + i] = turn[1 + i] * twice
    return error
