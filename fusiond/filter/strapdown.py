"""Strapdown propagation of state and covariance in earth-fixed axes, by inertial samples or, without them, by coasting.

Mechanisation: Groves (2013), section 5.3 (ECEF), with the specific force resolved at the middle of the interval. Error
model: Groves, section 14.2.3, here with the attitude error defined as mat_eb_true = exp([phi]x) mat_eb, so that
d phi/dt = -omega_ie x phi - C b_g and d v/dt = -f_e x phi - 2 omega_ie x v - C b_a + (gravity gradient) p.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusiond.filter.state import (
    ACCEL_BIAS,
    ACCEL_BIAS_B,
    ATTITUDE,
    CALIBRATIONS,
    COASTING,
    GYRO_BIAS,
    GYRO_BIAS_B,
    INERTIAL_DOUBT,
    KEPT_BIAS_B,
    KEPT_BIAS_COVARIANCE,
    PHASE,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    RATE_B,
    RATE_VARIANCE,
    RUNNING,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.linear import mirror
from fusiond.maths.portable import exp, square
from fusiond.maths.rotation import cross, matrix, normalised, quaternion_exp, quaternion_multiply, times, transposed_times
from fusiond.maths.typed import Covariance, ErrorRows6, ErrorRows9, Matrix3, Transition, Vector3, compiled
from fusiond.maths.wgs84 import EARTH_RATE, MU, gravity_e

COAST_ACCEL = 2.0  # m/s^2/sqrt(Hz): what a vehicle may do while the inertial sensor is silent
COAST_TURN = 0.3  # rad/s/sqrt(Hz), about the vertical: a car in a bend, where the velocity turns along
COAST_TILT = 0.03  # rad/s/sqrt(Hz), about any axis: a car's body on its springs, and a road's slope
DOUBT_TIME = 1.0  # s, over which the doubt in an inertial sensor that lied fades
DOUBT_ACCEL = 0.01  # (m/s^2)^2/Hz that it adds to the noise while it is full: of the specific force
DOUBT_GYRO = 1e-4  # (rad/s)^2/Hz: of the angular rate
DOUBT_BIAS = 1e-4  # (rad/s)^2/s: of the gyro bias
COAST_SWAY = 0.05  # rad/s, of roll and pitch: the angular rate is not known any better then
TURN_RATE = 0.25  # rad/s, rms: how fast a vehicle turns about the vertical while only its wheels tell
TURN_TIME = 1.5  # s, over which it keeps that rate
MAX_STEP = 0.05  # s: longer intervals are propagated in equal parts
CORNER = slice(0, 9)  # position, velocity, attitude: the error states that the transition changes


class ProcessNoise(NamedTuple):
    """Squared noise densities: what grows the covariance, per second."""

    accel: float  # (m/s^2)^2/Hz
    gyro: float  # (rad/s)^2/Hz
    accel_bias: float  # (m/s^2)^2/s
    gyro_bias: float  # (rad/s)^2/s
    calibrations: tuple[float, ...]  # of the error states from CALIBRATIONS on, per second


@compiled
def propagate(state: FilterState, dt: float, force_b: Vector3, rate_b: Vector3, noise: ProcessNoise) -> None:
    """Carry the state `dt` [s] forward on the measured specific force (3,) and angular rate (3,), biases included, that
    hold at the middle of the interval."""
    parts = int(max(1.0, math.ceil(dt / MAX_STEP)))
    for _part in range(parts):
        _step(state, dt / parts, force_b, rate_b, noise)


@compiled
def _step(state: FilterState, dt: float, force_b: Vector3, rate_b: Vector3, noise: ProcessNoise) -> None:
    x = state.nominal
    force = force_b - x[ACCEL_BIAS_B]
    turn = (rate_b - x[GYRO_BIAS_B]) * dt
    earth_turn = np.array([0.0, 0.0, EARTH_RATE * -dt])
    velocity_e = x[VELOCITY_E].copy()
    half_turned = quaternion_multiply(x[QUATERNION_EB], quaternion_exp(turn / 2))
    middle = quaternion_multiply(quaternion_exp(earth_turn / 2), half_turned)
    mat_eb = matrix(middle)
    force_e = times(mat_eb, force)
    free = force_e + gravity_e(x[POSITION_E] + velocity_e * (dt / 2))
    half = velocity_e + free * (dt / 2)
    change = np.array(  # less 2 omega_ie x v, with omega_ie along z
        [
            (free[0] + 2 * EARTH_RATE * half[1]) * dt,
            (free[1] - 2 * EARTH_RATE * half[0]) * dt,
            free[2] * dt,
        ]
    )
    gradient = gravity_gradient(x[POSITION_E])
    x[POSITION_E] += (velocity_e + change / 2) * dt
    x[VELOCITY_E] = velocity_e + change
    turned = quaternion_multiply(quaternion_exp(earth_turn), quaternion_multiply(x[QUATERNION_EB], quaternion_exp(turn)))
    x[QUATERNION_EB] = normalised(turned)
    _grow(state.covariance, dt, force_e, mat_eb, gradient)
    if state.tracked:
        _follow(state.transition, dt, force_e, mat_eb, gradient)
    doubt = x[INERTIAL_DOUBT]
    _add_noise(state.covariance, dt, noise.accel + doubt * DOUBT_ACCEL, noise.gyro + doubt * DOUBT_GYRO, noise)
    if doubt > 0:
        for i in range(3):
            state.covariance[GYRO_BIAS.start + i, GYRO_BIAS.start + i] += doubt * DOUBT_BIAS * dt
        x[INERTIAL_DOUBT] = doubt * exp(-dt / DOUBT_TIME) if doubt > 1e-3 else 0.0


@compiled
def gravity_gradient(position_e: Vector3) -> Matrix3:
    """Derivative (3, 3) [1/s^2] of gravity by position, spherical Earth (Groves 14.50, with the same sign for all axes)."""
    r2 = position_e[0] * position_e[0] + position_e[1] * position_e[1] + position_e[2] * position_e[2]
    strength = MU / (r2 * math.sqrt(r2))
    gradient = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            gradient[i, j] = strength * (3 * (position_e[i] * position_e[j]) / r2 - (1.0 if i == j else 0.0))
    return gradient


@compiled
def _grow(p: Covariance, dt: float, force_e: Vector3, mat_eb: Matrix3, gradient: Matrix3) -> None:
    """P = Phi P Phi' for the transition Phi over `dt`: to the second order where position is reached through velocity, and
    velocity through attitude.

    Only the rows and columns of position, velocity and attitude change. So Phi is applied to these rows, then to the columns
    of the corner where they meet; both times the nine new numbers are those of the error model above.
    """
    c, f = mat_eb, force_e
    half_dt2, earth_turn = dt * dt / 2, EARTH_RATE * dt
    rows = np.empty((9, len(p)))
    _move_rows(p, dt, f, c, gradient, rows)

    turned, felt = np.empty((3, 9)), np.empty((3, 9))  # the same two, of the columns
    corner = np.empty((9, 9))
    for i in range(3):
        turned[i] = c[i, 0] * rows[:, 9] + c[i, 1] * rows[:, 10] + c[i, 2] * rows[:, 11]
        felt[i] = c[i, 0] * rows[:, 12] + c[i, 1] * rows[:, 13] + c[i, 2] * rows[:, 14]
    felt[0] += f[1] * rows[:, 8] - f[2] * rows[:, 7]
    felt[1] += f[2] * rows[:, 6] - f[0] * rows[:, 8]
    felt[2] += f[0] * rows[:, 7] - f[1] * rows[:, 6]
    for i in range(3):
        pulled = gradient[i]
        corner[i] = rows[:, i] + dt * rows[:, 3 + i] - half_dt2 * felt[i]
        corner[3 + i] = (
            rows[:, 3 + i] - dt * felt[i] + dt * (pulled[0] * rows[:, 0] + pulled[1] * rows[:, 1] + pulled[2] * rows[:, 2])
        )
        corner[6 + i] = rows[:, 6 + i] - dt * turned[i]
    corner[3] += half_dt2 * (f[1] * turned[2] - f[2] * turned[1]) + 2 * earth_turn * rows[:, 4]
    corner[4] += half_dt2 * (f[2] * turned[0] - f[0] * turned[2]) - 2 * earth_turn * rows[:, 3]
    corner[5] += half_dt2 * (f[0] * turned[1] - f[1] * turned[0])
    corner[6] += earth_turn * rows[:, 7]
    corner[7] -= earth_turn * rows[:, 6]

    for i in range(9):
        p[i, i : CORNER.stop] = corner[i:, i]
        p[i : CORNER.stop, i] = corner[i:, i]
        p[i, CORNER.stop :] = rows[i, CORNER.stop :]
        p[CORNER.stop :, i] = rows[i, CORNER.stop :]


@compiled
def _follow(a: Transition, dt: float, force_e: Vector3, mat_eb: Matrix3, gradient: Matrix3) -> None:
    """A = Phi A for the same transition."""
    rows = np.empty((9, len(a)))
    _move_rows(a, dt, force_e, mat_eb, gradient, rows)
    for i in range(9):
        a[i] = rows[i]


@compiled
def _move_rows(
    p: Covariance, dt: float, force_e: Vector3, mat_eb: Matrix3, gradient: Matrix3, rows: ErrorRows9
) -> None:
    """Write the first nine rows of Phi P, which alone change, into `rows`."""
    c, f = mat_eb, force_e
    half_dt2, earth_turn = dt * dt / 2, EARTH_RATE * dt
    by_gyro, by_force = np.empty((3, len(p))), np.empty((3, len(p)))  # C b_g; C b_a + f_e x phi
    for i in range(3):
        by_gyro[i] = c[i, 0] * p[9] + c[i, 1] * p[10] + c[i, 2] * p[11]
        by_force[i] = c[i, 0] * p[12] + c[i, 1] * p[13] + c[i, 2] * p[14]
    by_force[0] += f[1] * p[8] - f[2] * p[7]
    by_force[1] += f[2] * p[6] - f[0] * p[8]
    by_force[2] += f[0] * p[7] - f[1] * p[6]
    for i in range(3):
        rows[i] = p[i] + dt * p[3 + i] - half_dt2 * by_force[i]
        pulled = gradient[i]
        rows[3 + i] = p[3 + i] - dt * by_force[i] + dt * (pulled[0] * p[0] + pulled[1] * p[1] + pulled[2] * p[2])
        rows[6 + i] = p[6 + i] - dt * by_gyro[i]
    rows[3] += half_dt2 * (f[1] * by_gyro[2] - f[2] * by_gyro[1]) + 2 * earth_turn * p[4]
    rows[4] += half_dt2 * (f[2] * by_gyro[0] - f[0] * by_gyro[2]) - 2 * earth_turn * p[3]
    rows[5] += half_dt2 * (f[0] * by_gyro[1] - f[1] * by_gyro[0])
    rows[6] += earth_turn * p[7]
    rows[7] -= earth_turn * p[6]


@compiled
def _add_noise(p: Covariance, dt: float, accel: float, gyro: float, noise: ProcessNoise) -> None:
    """P += Q, with isotropic white noise on acceleration and rate, and random walks of the rest."""
    add_white_noise(p, dt, accel, gyro)
    for i in range(3):
        p[ACCEL_BIAS.start + i, ACCEL_BIAS.start + i] += noise.accel_bias * dt
        p[GYRO_BIAS.start + i, GYRO_BIAS.start + i] += noise.gyro_bias * dt
    for i in range(CALIBRATIONS, len(p)):
        p[i, i] += noise.calibrations[i - CALIBRATIONS] * dt


@compiled
def add_white_noise(p: Covariance, dt: float, accel: float, gyro: float) -> None:
    """What isotropic white noise on acceleration [(m/s^2)^2/Hz] and rate [(rad/s)^2/Hz] adds to P over `dt` [s]."""
    cubic, quadratic = accel * dt * dt / 3 * dt, accel * dt * dt / 2
    for i in range(3):
        p[POSITION.start + i, POSITION.start + i] += cubic
        p[VELOCITY.start + i, VELOCITY.start + i] += accel * dt
        p[ATTITUDE.start + i, ATTITUDE.start + i] += gyro * dt
        p[POSITION.start + i, VELOCITY.start + i] += quadratic
        p[VELOCITY.start + i, POSITION.start + i] += quadratic


@compiled
def coast(state: FilterState, dt: float, noise: ProcessNoise, rests: bool = False) -> None:
    """Carry the state `dt` [s] forward without inertial samples: constant velocity and attitude over the ground, with the
    uncertainty of a vehicle that may do otherwise; one that rests neither speeds up nor turns. When it turns, its velocity
    turns along: wheels and body stay in line, whatever the heading.

    A running filter turns it by the rate about the vertical that wheels and receivers tell meanwhile: see `begin_coasting`.
    Hypotheses of a heading share one angular rate, so they are taken to keep their heading, with the noise of a turn."""
    parts = int(max(1.0, math.ceil(dt / MAX_STEP)))
    for _part in range(parts):
        _coast(state, dt / parts, noise, rests)


@compiled
def _coast(state: FilterState, dt: float, noise: ProcessNoise, rests: bool) -> None:
    x, p = state.nominal, state.covariance
    x[POSITION_E] += x[VELOCITY_E] * dt
    for i in range(3):
        p[i] += dt * p[VELOCITY.start + i]
    for i in range(3):
        p[:, i] += dt * p[:, VELOCITY.start + i]
    mirror(p)
    if state.tracked:
        for i in range(3):
            state.transition[i] += dt * state.transition[VELOCITY.start + i]
    _add_noise(p, dt, 0.0 if rests else square(COAST_ACCEL), square(COAST_TILT), noise)
    if rests:
        return
    r = x[POSITION_E]
    up_e = r / math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    if state.stamps[PHASE] == RUNNING:
        begin_coasting(state)
        _turn(state, dt, up_e)
        mirror(p)
        return
    sideways_e = cross(up_e, x[VELOCITY_E])
    turned, displaced = np.zeros(len(p)), np.zeros(len(p))  # what a turn changes at once, and what it does from then on
    turned[ATTITUDE], turned[VELOCITY], displaced[POSITION] = up_e, sideways_e, sideways_e
    first, second = square(COAST_TURN) * dt, square(COAST_TURN) * (dt * dt / 2)
    third = square(COAST_TURN) * (dt * dt * dt / 3)
    for i in range(len(p)):
        p[i] += (
            first * turned[i] * turned
            + third * displaced[i] * displaced
            + second * (turned[i] * displaced + displaced[i] * turned)
        )
    mirror(p)


@compiled
def begin_coasting(state: FilterState) -> None:
    """Make the angular rate a quantity that is estimated: the states of the gyro bias stand for its error meanwhile, of
    which every model knows what it does. The bias is kept."""
    a, p, bias = state.auxiliary, state.covariance, GYRO_BIAS.start
    if a[COASTING] == 0.0:
        a[COASTING] = 1.0
        a[KEPT_BIAS_B] = state.nominal[GYRO_BIAS_B]
        for i in range(3):
            for j in range(3):
                a[KEPT_BIAS_COVARIANCE.start + 3 * i + j] = p[bias + i, bias + j]
    a[RATE_B] -= state.nominal[GYRO_BIAS_B] - a[KEPT_BIAS_B]
    state.nominal[GYRO_BIAS_B] = a[KEPT_BIAS_B]
    a[RATE_VARIANCE] = COAST_SWAY * COAST_SWAY


@compiled
def end_coasting(state: FilterState) -> None:
    """Make the states of the gyro bias that bias again, as it was kept; what correlates with the rate says nothing of it."""
    a, p, bias = state.auxiliary, state.covariance, GYRO_BIAS.start
    if a[COASTING] == 0.0:
        return
    a[COASTING] = 0.0
    state.nominal[GYRO_BIAS_B] = a[KEPT_BIAS_B]
    for i in range(3):
        p[bias + i] = 0.0
        p[:, bias + i] = 0.0
    for i in range(3):
        for j in range(3):
            p[bias + i, bias + j] = a[KEPT_BIAS_COVARIANCE.start + 3 * i + j]
    if state.tracked:
        for i in range(3):
            state.transition[bias + i] = 0.0


@compiled
def _turn(state: FilterState, dt: float, up_e: Vector3) -> None:
    """Turn attitude and velocity about the vertical by the rate that is estimated, and let that fade: a first-order
    Gauss-Markov process. Roll and pitch do not turn."""
    x, p, a = state.nominal, state.covariance, state.auxiliary
    bias = GYRO_BIAS.start
    c = matrix(x[QUATERNION_EB])
    rate_b = a[RATE_B] - x[GYRO_BIAS_B]
    up_b = transposed_times(c, up_e)
    speed = up_b[0] * rate_b[0] + up_b[1] * rate_b[1] + up_b[2] * rate_b[2]
    turn = quaternion_exp(up_e * (speed * dt))
    mat = matrix(turn)
    x[VELOCITY_E] = times(mat, x[VELOCITY_E])
    x[QUATERNION_EB] = normalised(quaternion_multiply(turn, x[QUATERNION_EB]))
    sideways_e = cross(up_e, x[VELOCITY_E])
    rows = np.empty((6, len(p)))
    _turn_rows(p, dt, mat, up_e, up_b, sideways_e, rows)
    for i in range(6):
        p[3 + i] = rows[i]
    if state.tracked:
        _turn_rows(state.transition, dt, mat, up_e, up_b, sideways_e, rows)
        for i in range(6):
            state.transition[3 + i] = rows[i]
    columns = np.empty((6, len(p)))
    by_rate = up_b[0] * p[:, bias] + up_b[1] * p[:, bias + 1] + up_b[2] * p[:, bias + 2]
    for i in range(3):
        along, across = -dt * sideways_e[i], -dt * up_e[i]
        columns[i] = mat[i, 0] * p[:, 3] + mat[i, 1] * p[:, 4] + mat[i, 2] * p[:, 5] + along * by_rate
        columns[3 + i] = mat[i, 0] * p[:, 6] + mat[i, 1] * p[:, 7] + mat[i, 2] * p[:, 8] + across * by_rate
    for i in range(6):
        p[:, 3 + i] = columns[i]
    kept = exp(-dt / TURN_TIME)
    for i in range(3):
        p[bias + i] *= kept
    for i in range(3):
        p[:, bias + i] *= kept
    if state.tracked:
        for i in range(3):
            state.transition[bias + i] *= kept
    fresh = square(TURN_RATE) * (1 - kept * kept)
    for i in range(3):
        a[RATE_B.start + i] = x[GYRO_BIAS_B.start + i] + speed * kept * up_b[i]
        for j in range(3):
            p[bias + i, bias + j] += fresh * up_b[i] * up_b[j]


@compiled
def _turn_rows(
    p: Covariance, dt: float, mat: Matrix3, up_e: Vector3, up_b: Vector3, sideways_e: Vector3, rows: ErrorRows6
) -> None:
    """Write the rows of velocity and attitude of Phi P, for the transition Phi of a turn (3, 3) at the rate that is
    estimated, into `rows`."""
    bias = GYRO_BIAS.start
    by_rate = up_b[0] * p[bias] + up_b[1] * p[bias + 1] + up_b[2] * p[bias + 2]
    for i in range(3):
        along, across = -dt * sideways_e[i], -dt * up_e[i]
        rows[i] = mat[i, 0] * p[3] + mat[i, 1] * p[4] + mat[i, 2] * p[5] + along * by_rate
        rows[3 + i] = mat[i, 0] * p[6] + mat[i, 1] * p[7] + mat[i, 2] * p[8] + across * by_rate
