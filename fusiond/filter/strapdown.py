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
    GYRO_BIAS,
    GYRO_BIAS_B,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.portable import square
from fusiond.maths.rotation import matrix, normalised, quaternion_exp, quaternion_multiply, skew
from fusiond.maths.wgs84 import EARTH_RATE, GRAVITATIONAL_CONSTANT, Array, gravity_e

COAST_ACCEL = 2.0  # m/s^2/sqrt(Hz): what a vehicle may do while the inertial sensor is silent
COAST_TURN = 0.3  # rad/s/sqrt(Hz), about the vertical: a car in a bend, where the velocity turns along
COAST_TILT = 0.03  # rad/s/sqrt(Hz), about any axis: a car's body on its springs, and a road's slope
COAST_RATE = 0.5  # rad/s: the angular rate is not known any better then
LONGEST_STEP = 0.05  # s: longer intervals are propagated in equal parts
EARTH_RATE_E = np.array([0.0, 0.0, EARTH_RATE])
EARTH_RATE_SKEW = skew(EARTH_RATE_E)


class ProcessNoise(NamedTuple):
    """Squared noise densities: what grows the covariance, per second."""

    accel: float  # (m/s^2)^2/Hz
    gyro: float  # (rad/s)^2/Hz
    accel_bias: float  # (m/s^2)^2/s
    gyro_bias: float  # (rad/s)^2/s
    calibrations: tuple[float, ...]  # of the error states from CALIBRATIONS on, per second


def propagate(state: FilterState, dt: float, force_b: Array, rate_b: Array, noise: ProcessNoise) -> None:
    """Carry the state `dt` [s] forward on the measured specific force (3,) and angular rate (3,), biases included, that
    hold at the middle of the interval."""
    parts = max(1, math.ceil(dt / LONGEST_STEP))
    for _ in range(parts):
        _step(state, dt / parts, force_b, rate_b, noise)


def _step(state: FilterState, dt: float, force_b: Array, rate_b: Array, noise: ProcessNoise) -> None:
    x = state.nominal
    force = force_b - x[ACCEL_BIAS_B]
    turn = (rate_b - x[GYRO_BIAS_B]) * dt
    earth_turn = EARTH_RATE_E * -dt
    quaternion_eb = x[QUATERNION_EB]
    half_turned = quaternion_multiply(quaternion_eb, quaternion_exp(turn / 2))
    middle = quaternion_multiply(quaternion_exp(earth_turn / 2), half_turned)
    mat_eb = matrix(middle)
    force_e = mat_eb @ force
    velocity_e = x[VELOCITY_E].copy()
    free = force_e + gravity_e(x[POSITION_E] + velocity_e * (dt / 2))
    change = (free - 2 * EARTH_RATE_SKEW @ (velocity_e + free * (dt / 2))) * dt
    gradient = gravity_gradient(x[POSITION_E])
    x[POSITION_E] += (velocity_e + change / 2) * dt
    x[VELOCITY_E] = velocity_e + change
    turned = quaternion_multiply(quaternion_exp(earth_turn), quaternion_multiply(quaternion_eb, quaternion_exp(turn)))
    x[QUATERNION_EB] = normalised(turned)

    _grow(state, _transition(state.size, dt, force_e, mat_eb, gradient), dt, noise.accel, noise.gyro, noise)


def gravity_gradient(position_e: Array) -> Array:
    """Derivative (3, 3) [1/s^2] of gravity by position, spherical Earth (Groves 14.50, with the same sign for all axes)."""
    r2 = float(position_e @ position_e)
    strength = GRAVITATIONAL_CONSTANT / (r2 * math.sqrt(r2))
    return strength * (3 * np.outer(position_e, position_e) / r2 - np.eye(3))


def _transition(size: int, dt: float, force_e: Array, mat_eb: Array, gradient: Array) -> Array:
    """Transition matrix (size, size) of the error state over `dt`: to the second order where position is reached through
    velocity, and velocity through attitude."""
    phi = np.eye(size)
    force_skew = skew(force_e)
    phi[POSITION, VELOCITY] = np.eye(3) * dt
    phi[POSITION, ATTITUDE] = force_skew * (-dt * dt / 2)
    phi[POSITION, ACCEL_BIAS] = mat_eb * (-dt * dt / 2)
    phi[VELOCITY, POSITION] = gradient * dt
    phi[VELOCITY, VELOCITY] -= EARTH_RATE_SKEW * (2 * dt)
    phi[VELOCITY, ATTITUDE] = force_skew * -dt
    phi[VELOCITY, GYRO_BIAS] = force_skew @ mat_eb * (dt * dt / 2)
    phi[VELOCITY, ACCEL_BIAS] = mat_eb * -dt
    phi[ATTITUDE, ATTITUDE] -= EARTH_RATE_SKEW * dt
    phi[ATTITUDE, GYRO_BIAS] = mat_eb * -dt
    return phi


def _grow(state: FilterState, phi: Array, dt: float, accel: float, gyro: float, noise: ProcessNoise) -> None:
    """P = Phi P Phi' + Q, with isotropic white noise on acceleration and rate, and random walks of the rest."""
    covariance = phi @ state.covariance @ phi.T
    covariance = (covariance + covariance.T) / 2
    for block, density in (
        (POSITION, accel * dt * dt / 3),
        (VELOCITY, accel),
        (ATTITUDE, gyro),
        (ACCEL_BIAS, noise.accel_bias),
        (GYRO_BIAS, noise.gyro_bias),
    ):
        for i in range(block.start, block.stop):
            covariance[i, i] += density * dt
    for i, density in enumerate(noise.calibrations, CALIBRATIONS):
        covariance[i, i] += density * dt
    for i in range(3):
        covariance[POSITION.start + i, VELOCITY.start + i] += accel * dt * dt / 2
        covariance[VELOCITY.start + i, POSITION.start + i] += accel * dt * dt / 2
    state.covariance[:] = covariance


def coast(state: FilterState, dt: float, noise: ProcessNoise, *, rests: bool = False) -> None:
    """Carry the state `dt` [s] forward without inertial samples: constant velocity and attitude over the ground, with the
    uncertainty of a vehicle that may do otherwise; one that rests neither speeds up nor turns. When it turns, its velocity
    turns along: wheels and body stay in line, whatever the heading."""
    x = state.nominal
    x[POSITION_E] += x[VELOCITY_E] * dt
    phi = np.eye(state.size)
    phi[POSITION, VELOCITY] = np.eye(3) * dt
    _grow(state, phi, dt, 0.0 if rests else square(COAST_ACCEL), square(COAST_TILT), noise)
    if rests:
        return
    up_e = x[POSITION_E] / math.sqrt(float(x[POSITION_E] @ x[POSITION_E]))
    sideways_e = np.cross(up_e, x[VELOCITY_E])
    turned = np.zeros((2, state.size))  # what a turn changes at once, and what it does from then on
    turned[0, ATTITUDE], turned[0, VELOCITY], turned[1, POSITION] = up_e, sideways_e, sideways_e
    grown = np.outer(turned[0], turned[0]) * dt + np.outer(turned[1], turned[1]) * (dt * dt * dt / 3)
    across = np.outer(turned[0], turned[1]) * (dt * dt / 2)
    state.covariance += square(COAST_TURN) * (grown + across + across.T)
